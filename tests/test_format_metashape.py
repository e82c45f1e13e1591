"""Metashape's XML against the formulas of its manual written out here, and by hand."""

import re
from pathlib import Path

import numpy as np
import pytest
from captures import assert_projects, refused

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.captures.formats.metashape import FORMAT, parse_metashape
from nerfcli.errors import UserError

# At (1, 2, 3) in the chunk, turned a quarter about y: the camera's z axis along chunk x.
CHUNK_FROM_CAM = np.array([[0.0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]])
# world = 2.5 R chunk + (100, -7, 0.5) with R a quarter turn about z.
WORLD = (
    "<transform><rotation>0 -1 0 1 0 0 0 0 1</rotation>"
    "<translation>100 -7 0.5</translation><scale>2.5</scale></transform>"
)

RADIAL = {"k1": 0.11, "k2": -0.05, "k3": 0.012}
FULL = {"f": 500.0, "cx": 11.5, "cy": -4.25, **RADIAL, "p1": 0.0011, "p2": -0.0023, "b1": 7.0}


def sensor_xml(
    value: dict[str, float], *, kind: str = "frame", size: tuple[int, int] = (640, 480), key: str = "0"
) -> str:
    resolution = f'<resolution width="{size[0]}" height="{size[1]}"/>'
    terms = "".join(f"<{name}>{number!r}</{name}>" for name, number in value.items())
    return f"""
      <sensor id="{key}" label="unknown" type="{kind}">
        {resolution}
        <property name="layer_index" value="0"/>
        <calibration type="{kind}" class="initial">{resolution}<f>1</f></calibration>
        <calibration type="{kind}" class="adjusted">
          {resolution}
          {terms}
        </calibration>
      </sensor>"""


def camera_xml(
    label: str, *, pose: np.ndarray | None = CHUNK_FROM_CAM, sensor: str = "0", component: str = "0", more: str = ""
) -> str:
    transform = "" if pose is None else f"<transform>{' '.join(map(repr, pose.ravel().tolist()))}</transform>"
    return f"""
      <camera id="7" sensor_id="{sensor}" component_id="{component}" label="{label}"{more}>
        {transform}
        <orientation>1</orientation>
      </camera>"""


def document(sensors: str, cameras: str, *, components: str = '<component id="0"/>') -> str:
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="1.5.0">
  <chunk label="Chunk 1" enabled="true">
    <sensors next_id="1">{sensors}
    </sensors>
    <components next_id="1" active_id="0">{components}</components>
    <cameras next_id="1" next_group_id="0">{cameras}
    </cameras>
    <reference>LOCAL_CS["Local Coordinates (m)"]</reference>
  </chunk>
</document>
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "cameras.xml"
    path.write_text(text, encoding="utf-8")
    return path


def camera_of(
    folder: Path, value: dict[str, float], *, kind: str = "frame", size: tuple[int, int] = (640, 480)
) -> Camera:
    path = write(folder, document(sensor_xml(value, kind=kind, size=size), camera_xml("a.jpg")))
    return parse_metashape(path).frames[0].camera


def metashape_pixels(value: dict[str, float], kind: str, size: tuple[int, int], points: np.ndarray) -> np.ndarray:
    """Metashape Professional user manual, appendix "Camera models"."""
    x, y, z = points.T
    width, height = size
    if kind == "spherical":
        f = width / (2 * np.pi)
        return np.stack([width / 2 + f * np.arctan2(x, z), height / 2 + f * np.arctan2(y, np.hypot(x, z))], axis=-1)
    x, y = x / z, y / z
    if kind != "frame":
        radius = np.hypot(x, y)
        x, y = x * np.arctan(radius) / radius, y * np.arctan(radius) / radius
    k1, k2, k3, k4, p1, p2, b1, cx, cy = (
        value.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2", "b1", "cx", "cy")
    )
    r = np.hypot(x, y)
    radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6 + k4 * r**8
    x, y = (x * radial + p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y, y * radial + p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y)
    return np.stack([width * 0.5 + cx + x * value["f"] + x * b1, height * 0.5 + cy + y * value["f"]], axis=-1)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("frame", {"f": 500.0}),
        ("frame", {"f": 500.0, "b1": 7.0, "cx": 3.0}),
        ("frame", {"f": 500.0, "k1": 0.1}),
        ("frame", {"f": 500.0, "k1": 0.1, "k2": -0.05, "b1": 7.0}),
        ("frame", {key: FULL[key] for key in FULL if key != "k3"}),
        ("frame", FULL),
        ("fisheye", {"f": 250.0, "cx": 3.0, "cy": -2.0, "k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": -0.001}),
        ("equidistant_fisheye", {**FULL, "f": 250.0, "k4": -0.001}),
        ("spherical", {}),
    ],
)
@pytest.mark.parametrize("size", [(640, 480), (480, 640)])
def test_lenses_project_as_in_the_manual(tmp_path, kind, value, size):
    size = (640, 320) if kind == "spherical" else size
    camera = camera_of(tmp_path, value, kind=kind, size=size)
    assert (camera.width, camera.height) == size
    assert_projects(camera, lambda points: metashape_pixels(value, kind, size, points))


def test_cameras_by_hand(tmp_path):
    cameras = (
        '<group id="0" label="Group 1" type="folder">' + camera_xml("DCIM/b c.jpg") + "</group>",
        camera_xml("ü"),
        camera_xml("not aligned", pose=None),
        camera_xml("empty", pose=None).replace("<orientation>", "<transform></transform><orientation>"),
        camera_xml("disabled", more=' enabled="false"'),
    )
    capture = parse_metashape(write(tmp_path, document(sensor_xml({"f": 500.0}), "".join(cameras))))
    assert [(frame.name, frame.image) for frame in capture.frames] == [("DCIM/b c.jpg", None), ("ü", None)]
    assert (capture.kind, capture.unit, capture.missing) == ("metashape", "arbitrary", ())
    assert capture.notes == (
        "2 of 5 cameras left out, not aligned: not aligned, empty",
        "1 of 5 cameras left out, disabled in Metashape: disabled",
    )
    np.testing.assert_allclose(capture.frames[0].world_from_cam, CHUNK_FROM_CAM, rtol=0, atol=1e-15)


def test_the_only_export_in_a_folder_is_found_under_any_name(tmp_path):
    path = write(tmp_path, document(sensor_xml({"f": 500.0}), camera_xml("a"))).rename(tmp_path / "my project.xml")
    (tmp_path / "lens.xml").write_text('<?xml version="1.0" encoding="UTF-8"?>\n<calibration/>')
    assert FORMAT.find(tmp_path) == path


@pytest.mark.parametrize("place", ["component", "chunk"])
def test_the_transform_to_the_world_scales_centres_and_keeps_poses_rigid(tmp_path, place):
    if place == "component":
        text = document(sensor_xml(FULL), camera_xml("a"), components=f'<component id="0">{WORLD}</component>')
    else:  # as PhotoScan 1.2 wrote it
        text = document(sensor_xml(FULL), camera_xml("a").replace(' component_id="0"', ""), components="")
        text = text.replace("</chunk>", f"{WORLD}</chunk>")
    frame = parse_metashape(write(tmp_path, text)).frames[0]
    # Chunk centre (1, 2, 3) goes to 2.5 (-2, 1, 3) + (100, -7, 0.5).
    np.testing.assert_allclose(frame.centre, [95.0, -4.5, 8.0], rtol=0, atol=1e-12)
    rotation = frame.world_from_cam[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-14)
    in_cam = np.array([[0.1, -0.2, 1.0], [0.3, 0.2, 2.0], [-0.5, 0.1, 4.0]])
    in_chunk = rigid.apply(CHUNK_FROM_CAM, in_cam)
    in_world = 2.5 * np.stack([-in_chunk[:, 1], in_chunk[:, 0], in_chunk[:, 2]], axis=-1) + [100, -7, 0.5]
    pixels, _ = frame.camera.project(frame.in_camera(in_world))
    np.testing.assert_allclose(pixels, metashape_pixels(FULL, "frame", (640, 480), in_cam), rtol=0, atol=1e-9)


def test_of_components_without_a_common_world_the_largest_is_read(tmp_path):
    cameras = "".join(
        camera_xml(f"{key} {i}", component=key) for key, count in (("0", 1), ("1", 2)) for i in range(count)
    )
    alone = '<component id="0"/><component id="1"/>'
    capture = parse_metashape(write(tmp_path, document(sensor_xml({"f": 500.0}), cameras, components=alone)))
    assert [frame.name for frame in capture.frames] == ["1 0", "1 1"]
    others = "others, which are in other coordinates:"
    assert capture.notes == (f"component '1' with 2 cameras is read; {others} '0' with 1",)
    common = f'<component id="0">{WORLD}</component><component id="1">{WORLD}</component>'
    capture = parse_metashape(write(tmp_path, document(sensor_xml({"f": 500.0}), cameras, components=common)))
    assert [frame.name for frame in capture.frames] == ["0 0", "1 0", "1 1"]
    assert capture.notes == ()


def chunks_of(*counts: int) -> list[str]:
    """Return chunks of so many cameras, whose names begin with a, b, ..."""
    texts = [
        document(sensor_xml({"f": 500.0}), "".join(camera_xml(f"{key} {i}") for i in range(count)))
        for key, count in zip("abc", counts, strict=False)
    ]
    return [text[text.index("<chunk") : text.index("</document>")] for text in texts]


def test_of_several_chunks_that_with_most_aligned_cameras_is_read(tmp_path):
    first, second, third = chunks_of(1, 3, 2)
    first = first.replace("</cameras>", 3 * camera_xml("x", pose=None) + "</cameras>")
    capture = parse_metashape(write(tmp_path, f"<document>{first}{second}{third}</document>"))
    assert [frame.name for frame in capture.frames] == ["b 0", "b 1", "b 2"]
    others = "others, which are in other coordinates: 1 (Chunk 1) with 1, 3 (Chunk 1) with 2"
    assert capture.notes[0] == f"chunk 2 (Chunk 1) with 3 cameras is read; {others}"


@pytest.mark.parametrize(
    "off", [('<chunk label="Chunk 1" enabled="true">', '<chunk enabled="0">'), ("<camera ", '<camera enabled="false" ')]
)
def test_a_disabled_chunk_and_one_of_disabled_cameras_are_not_read_before_another(off, tmp_path):
    first, second = chunks_of(2, 3)
    capture = parse_metashape(write(tmp_path, f"<document>{first}{second.replace(*off)}</document>"))
    assert [frame.name for frame in capture.frames] == ["a 0", "a 1"]
    assert capture.notes[0].startswith("chunk 1 (Chunk 1) with 2 cameras is read; others")


def test_of_chunks_without_usable_cameras_that_with_cameras_is_described(tmp_path):
    text = document(sensor_xml({"f": 500.0}), camera_xml("a", more=' enabled="false"'))
    path = write(tmp_path, text.replace("<chunk", '<chunk label="empty"/><chunk', 1))
    with pytest.raises(UserError, match="no images with a pose: 'a' is disabled in Metashape"):
        parse_metashape(path)


def test_each_camera_has_its_sensor(tmp_path):
    sensors = sensor_xml({"f": 500.0}) + sensor_xml({"f": 300.0}, size=(100, 80), key="3")
    capture = parse_metashape(write(tmp_path, document(sensors, camera_xml("a") + camera_xml("b", sensor="3"))))
    assert [frame.camera for frame in capture.frames] == [
        Camera("PINHOLE", 640, 480, (500, 500, 320, 240)),
        Camera("PINHOLE", 100, 80, (300, 300, 50, 40)),
    ]


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (("</chunk>", "</clump>"), "not valid XML"),
        (("chunk", "clump"), "has no chunk element, but a 'document'"),
        (("<camera id", "<cam id"), "not valid XML"),
        (("<transform>0.0", "<transform>"), "camera 'a.jpg': transform: has 15 numbers"),
        (("<transform>0.0", "<transform>nan"), "camera 'a.jpg': transform: 'nan' is not finite"),
        (("<transform>0.0", "<transform>2"), "camera 'a.jpg': transform: the upper left 3x3 block is not a rotation"),
        (('sensor_id="0"', 'sensor_id="4"'), "camera 'a.jpg': sensor_id is '4'"),
        (('label="a.jpg"', 'label=""'), "lists no images with a pose: '' is without a label"),
        (("<f>500.0</f>", ""), "no images with a pose: 'a.jpg' is of a sensor without a calibration"),
        (("<f>500.0</f>", "<f>-500.0</f>"), "sensor '0': .*invalid parameters"),
        (("<f>500.0</f>", "<f>wide</f>"), "sensor '0': f: 'wide' is not a number"),
        (("<f>500.0</f>", "<f>500.0</f><b2>0.6</b2>"), r"b2 is 0.6, .* off by 0.29 px"),
        (("<f>500.0</f>", "<f>500.0</f><p1>0.01</p1><p3>0.2</p3>"), "p3 is 0.2, which no supported lens has"),
        (('type="frame"', 'type="equisolid_fisheye"'), "type 'equisolid_fisheye' is not supported"),
        (('type="frame"', 'type="spherical"'), "invalid size of an EQUIRECTANGULAR picture: 640x480"),
        (('width="640"', 'width="6.5"'), "width and height are 6.5"),
        (("<resolution", "<revolution"), "has no resolution"),
        (('<component id="0"/>', f'<component id="0">{WORLD.replace("2.5<", "0<")}</component>'), "scale is 0"),
        (('<component id="0"/>', f'<component id="0">{WORLD.replace("-1 ", "")}</component>'), "rotation: has 8"),
        (("</cameras>", camera_xml("a.jpg") + "</cameras>"), "'a.jpg' is listed twice"),
    ],
)
def test_malformed_files_are_refused_with_file_and_field(tmp_path, change, what):
    text = document(sensor_xml({"f": 500.0}), camera_xml("a.jpg"))
    assert change[0] in text
    path = write(tmp_path, text.replace(*change))
    with refused(what, path):
        FORMAT.parse(path)


def test_no_camera_aligned_is_refused(tmp_path):
    path = write(tmp_path, document(sensor_xml({"f": 500.0}), camera_xml("a", pose=None)))
    with pytest.raises(UserError, match="lists no images with a pose"):
        parse_metashape(path)
    with pytest.raises(UserError, match="No such file"):
        parse_metashape(tmp_path / "none.xml")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_entities_are_not_expanded(tmp_path, encoding):
    lines = "".join(f'<!ENTITY b{i} "{f"&b{i - 1};" * 10 if i else "ha"}">' for i in range(12))
    text = document(sensor_xml({"f": 500.0}), camera_xml("&b11;"))
    text = re.sub("<[?].*[?]>", f'<?xml version="1.0" encoding="{encoding}"?><!DOCTYPE x [{lines}]>', text)
    path = tmp_path / "cameras.xml"
    path.write_text(text, encoding=encoding)
    with pytest.raises(UserError, match="declares a document type"):
        parse_metashape(path)
