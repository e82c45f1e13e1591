"""RealityScan's table of cameras against its own export formulas written out here, and by hand."""

from pathlib import Path

import numpy as np
import pytest
from captures import put_photos, refused

from nerfcli.cameras.camera import Camera
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.reality_capture import TABLE, parse_reality_capture

OLD = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
NEW = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"
RADIAL = {"k1": 0.11, "k2": -0.05, "k3": 0.012, "k4": 0}
LENS = {"f": 28.5, "px": 0.013, "py": -0.0071, **RADIAL, "t1": 0.0011, "t2": -0.0023}
DIVISION = {**LENS, "k1": -0.38, **dict.fromkeys(("k2", "k3", "t1", "t2"), 0)}
SIZES = {"wide": (64, 48), "tall": (48, 64)}


def row(name: str, pose: tuple[float, ...] = (1, 2, 3, 0, 0, 0), lens: dict[str, float] | None = None) -> str:
    return ",".join([name, *map(repr, (*pose, *(lens or LENS).values()))])


def write(folder: Path, *rows: str, header: str = OLD) -> Path:
    path = folder / "cameras.csv"
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def world_from_opengl(heading: float, pitch: float, roll: float) -> np.ndarray:
    """nerfstudio's _get_rotation_matrix(-heading, pitch, roll), written out."""
    h, p, r = np.radians([-heading, pitch, roll])
    about_x = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
    about_y = np.array([[np.cos(r), 0, np.sin(r)], [0, 1, 0], [-np.sin(r), 0, np.cos(r)]])
    about_z = np.array([[np.cos(h), -np.sin(h), 0], [np.sin(h), np.cos(h), 0], [0, 0, 1]])
    return about_z @ about_x @ about_y


def opencv_pixels(lens: dict[str, float], size: tuple[int, int], points: np.ndarray) -> np.ndarray:
    """The templates of calibration.xml: $(f*scale), $(px*scale+width*0.5), and k1, k2, t2, t1, k3 in OpenCV's order."""
    width, height = size
    scale = max(width, height)
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    k1, k2, p1, p2, k3 = lens["k1"], lens["k2"], lens["t2"], lens["t1"], lens["k3"]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    x, y = (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
    f = lens["f"] / 36
    u = x * f * scale + (lens["px"] * scale + width * 0.5)
    v = y * f * scale + (lens["py"] * scale + height * 0.5)
    return np.stack([u, v], axis=-1)


@pytest.mark.parametrize("header", [OLD, NEW])
def test_both_programs_tables_project_as_their_exports_for_opencv(tmp_path, header):
    rng = np.random.default_rng(0)
    poses = [tuple(rng.uniform(-180, 180, 6).tolist()) for _ in range(2)]
    for name, size in SIZES.items():
        put_photos(tmp_path, f"{name}.jpg", size=size)
    path = write(tmp_path, *(row(f"{name}.jpg", pose) for name, pose in zip(SIZES, poses, strict=True)), header=header)
    capture = parse_reality_capture(path)
    in_cam = np.column_stack([rng.uniform(-0.5, 0.5, (100, 2)), np.ones(100)]) * rng.uniform(1, 9, (100, 1))
    for frame, pose, size in zip(capture.frames, poses, SIZES.values(), strict=True):
        in_world = (in_cam * [1, -1, -1]) @ world_from_opengl(*pose[3:]).T + pose[:3]
        pixels, valid = frame.camera.project(frame.in_camera(in_world))
        assert valid.all()
        np.testing.assert_allclose(pixels, opencv_pixels(LENS, size, in_cam), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("angles", "view", "up"),
    [
        ((0, 0, 0), (0, 0, -1), (0, 1, 0)),  # straight down, north at the top
        ((90, 0, 0), (0, 0, -1), (1, 0, 0)),  # straight down, east at the top: headings go clockwise
        ((0, 90, 0), (0, 1, 0), (0, 0, 1)),  # level towards the north
        ((90, 90, 0), (1, 0, 0), (0, 0, 1)),  # level towards the east
        ((0, 0, 90), (-1, 0, 0), (0, 1, 0)),  # flying north with the right wing down: the belly looks west
    ],
)
def test_angles_by_hand(tmp_path, angles, view, up):
    put_photos(tmp_path, "a.jpg")
    frame = parse_reality_capture(write(tmp_path, row("a.jpg", (1, 2, 3, *angles)))).frames[0]
    np.testing.assert_array_equal(frame.centre, [1, 2, 3])
    np.testing.assert_allclose(frame.world_from_cam[:3, 2], view, rtol=0, atol=1e-15)
    np.testing.assert_allclose(-frame.world_from_cam[:3, 1], up, rtol=0, atol=1e-15)


def test_names_photos_and_a_line_before_the_header(tmp_path):
    images = tmp_path / "photos"
    put_photos(images, "b c.jpg", "ü, 2.jpg")
    put_photos(images, "on.jpg", orientation=6)
    plain = {**dict.fromkeys(LENS, 0), "f": 36.0}
    rows = (row("b c.jpg", lens=plain), row('"ü, 2.jpg"', lens=plain), row("gone.jpg"), row("on.jpg", lens=plain), "")
    capture = parse_reality_capture(write(tmp_path, *rows, header=f"#cameras 4\n{OLD}"), UserInputs(images))
    names = ("b c.jpg", "ü, 2.jpg", "on.jpg")
    assert [(frame.name, frame.image) for frame in capture.frames] == [(name, images / name) for name in names]
    assert capture.missing == ("gone.jpg",)
    assert (capture.kind, capture.unit) == ("reality_capture", "arbitrary")
    # The last photo is stored sideways, 64 x 48, and its camera refers to this orientation.
    assert {frame.camera for frame in capture.frames} == {Camera("PINHOLE", 64, 48, (64, 64, 32, 24))}


@pytest.mark.parametrize(
    ("rows", "header", "what"),
    [
        ((row("a.jpg"),), "", "has no header line #name"),
        ((row("a.jpg"),), OLD.replace("pitch", "pitches"), "line 1: has no column pitch"),
        ((row("a.jpg"),), OLD.replace(",heading", ",head"), "line 1: has no column heading or yaw"),
        ((), OLD, "lists no image"),
        (("a.jpg,1,2",), OLD, "line 2: has 3 columns"),
        ((row("a.jpg"), row("b.jpg").replace("28.5", "wide")), OLD, "line 3: 'wide' is not a number"),
        ((row("a.jpg", (1, 2, float("inf"), 0, 0, 0)),), OLD, "line 2: 'inf' is not finite"),
        ((row("a.jpg", lens={**LENS, "f": 0.0}),), OLD, "line 2: .*invalid parameters"),
        ((row("a.jpg"), row("b.jpg", lens=DIVISION)), OLD, "line 3: has k1 alone, as of the Division model"),
        ((row("a.jpg"), row("a.jpg")), OLD, "'a.jpg' is listed twice"),
        ((row(""),), OLD, "line 2: the image's name is ''"),
        ((row('"a.jpg'),), OLD, "line 2: is not a valid line of a table"),
        ((row("x.jpg"), row("y.jpg")), OLD, "none of the 2 listed photos .* such as 'x.jpg'"),
    ],
)
def test_malformed_files_are_refused_with_file_and_line(tmp_path, rows, header, what):
    put_photos(tmp_path, "a.jpg", "b.jpg")
    path = write(tmp_path, *rows, header=header)
    with refused(what, path):
        TABLE.parse(path)
