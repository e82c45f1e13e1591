"""Agisoft Metashape's XML of cameras (File > Export > Export Cameras), read only; PhotoScan's from version 1.2 on.

A lens maps the point (X, Y, Z) in camera axes (OpenCV's) to the pixel (u, v), where the centre of the top-left pixel is
(0.5, 0.5) and w, h are the picture's size:
    x = X/Z, y = Y/Z  (frame),  x = t X/R, y = t Y/R with R = sqrt(X^2 + Y^2), t = atan2(R, Z)  (equidistant fisheye)
    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p2 (r^2 + 2 y^2) + 2 p1 x y
    u = w/2 + cx + x' f + x' b1 + y' b2,  v = h/2 + cy + y' f
so OpenCV's p1 is Metashape's p2 and vice versa. A camera's transform is chunk_from_cam; that of its component
(before version 1.3: of the chunk) is the similarity world_from_chunk.
Source: Metashape Professional user manual, appendix "Camera models"; agisoft-llc/metashape-scripts
src/export_for_gaussian_splatting.py (pixel centres, principal point, use of the transforms).
"""

from pathlib import Path
from typing import NoReturn
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats import lenses
from nerfcli.captures.formats.fields import check_unique_names, malformed, name_of, numbers, shown, size_of
from nerfcli.captures.formats.format import Format, by_suffix
from nerfcli.captures.formats.limits import rigid_pose
from nerfcli.captures.formats.photo_names import with_photos

Element = ElementTree.Element

_EXPECTED = "expected the XML that Metashape writes with File > Export > Export Cameras"

_FRAME = "frame"
_FISHEYE = ("fisheye", "equidistant_fisheye")
_SPHERICAL = "spherical"

# A term that no camera model here has counts as rounding if it moves the edge of the picture by at most this much.
_NEGLIGIBLE_PX = 1e-9


def parse_metashape(path: Path) -> Capture:
    """Read the aligned cameras of the file's first chunk.

    Cameras without a transform (not aligned, or a follower in a camera rig) and disabled ones give no frames, as in
    Agisoft's own export script. If a component lacks a transform to the world, components are unrelated to each other,
    and only the one with the most cameras is read. The file does not say where the photos are; a frame's name is the
    camera's label. The unit stays arbitrary: a component's transform comes from georeferencing (then it is in metres)
    or from moving the model by hand, and the file does not say which.

    Raises:
        UserError: the file is damaged (file and field are named), or has a lens that no COLMAP model holds.
    """
    chunk = _chunk(path)
    records = [record for record in chunk.iterfind("cameras//camera") if _is_aligned(record)]
    worlds = _worlds_from_chunk(chunk, path)
    components = [record.get("component_id") for record in records]
    if None in (worlds.get(component) for component in components):
        kept = max(dict.fromkeys(components), key=components.count)
        records = [record for record in records if record.get("component_id") == kept]
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    cameras: dict[str | None, Camera] = {}
    frames = []
    for record in records:
        where = f"{path}: camera {shown(record.get('label'))}"
        name = name_of(record.get("label"), where)
        sensor = record.get("sensor_id")
        if sensor not in sensors:
            raise malformed(where, f"sensor_id is {shown(sensor)}", "expected the id of one of the file's sensors")
        if sensor not in cameras:
            cameras[sensor] = _camera(sensors[sensor], f"{path}: sensor {shown(sensor)}")
        matrix = np.array(numbers(_words(record, "transform"), 16, f"{where}: transform")).reshape(4, 4)
        chunk_from_cam = rigid_pose(matrix, f"{where}: transform")
        world_from_chunk = worlds.get(record.get("component_id"))
        world_from_cam = chunk_from_cam if world_from_chunk is None else world_from_chunk.apply_pose(chunk_from_cam)
        frames.append(Frame(name, cameras[sensor], world_from_cam))
    check_unique_names((frame.name for frame in frames), path)
    return Capture(tuple(frames), np.zeros((0, 3)), (), None, "metashape")


def _chunk(path: Path) -> Element:
    """Return the first chunk: the root's child in an exported file, the root itself in the file of a project."""
    root = _parse_xml(path)
    chunk = root if root.tag == "chunk" else root.find("chunk")
    if chunk is None:
        raise malformed(str(path), f"has no chunk element, but a {shown(root.tag)}", _EXPECTED)
    return chunk


def _parse_xml(path: Path) -> Element:
    """Read the root of an XML file; refuse a document type declaration, so that there are no entities to expand."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise malformed(str(path), error.strerror or str(error), _EXPECTED) from error

    def refuse(*_: object) -> NoReturn:
        raise malformed(str(path), "declares a document type (DOCTYPE)", _EXPECTED)

    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, ValueError, LookupError) as error:  # the latter two: an encoding that Python lacks
        raise malformed(str(path), f"not valid XML: {error}", _EXPECTED) from error
    return builder.close()


def _is_aligned(record: Element) -> bool:
    return record.find("transform") is not None and record.get("enabled", "true") not in ("false", "0")


def _worlds_from_chunk(chunk: Element, path: Path) -> dict[str | None, rigid.Similarity | None]:
    """Return `world_from_chunk` by component id; the key None is for cameras without a component."""
    worlds: dict[str | None, rigid.Similarity | None] = {None: _similarity(chunk.find("transform"), f"{path}: chunk")}
    for component in chunk.iterfind("components/component"):
        key = component.get("id")
        worlds[key] = _similarity(component.find("transform"), f"{path}: component {shown(key)}")
    return worlds


def _similarity(record: Element | None, where: str) -> rigid.Similarity | None:
    if record is None or len(record) == 0:
        return None
    where = f"{where}: transform"
    rotation = np.eye(3)
    if record.find("rotation") is not None:
        rotation = np.array(numbers(_words(record, "rotation"), 9, f"{where}: rotation")).reshape(3, 3)
    translation = np.zeros(3)
    if record.find("translation") is not None:
        translation = np.array(numbers(_words(record, "translation"), 3, f"{where}: translation"))
    scale = _number(record, "scale", where, default=1.0)
    if scale <= 0:
        raise malformed(where, f"scale is {scale:g}", "expected a number above 0")
    pose = rigid_pose(np.column_stack([rotation, translation]), where)
    return rigid.Similarity(scale, pose[:3, :3], translation)


def _camera(sensor: Element, where: str) -> Camera:
    calibrations = sensor.findall("calibration")
    adjusted = [record for record in calibrations if record.get("class") == "adjusted"]
    calibration = (adjusted or calibrations or [sensor])[0]
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise malformed(where, "has no resolution", "expected the picture's size in pixels")
    width, height = numbers([resolution.get("width", ""), resolution.get("height", "")], 2, f"{where}: resolution")
    size = size_of(width, height, where)
    kind = calibration.get("type", sensor.get("type"))
    if kind == _SPHERICAL:
        return lenses.spherical_camera(size, where)
    if kind != _FRAME and kind not in _FISHEYE:
        supported = ", ".join((_FRAME, *_FISHEYE, _SPHERICAL))
        raise malformed(where, f"camera type {shown(kind)} is not supported", f"expected one of {supported}")
    if calibration.find("f") is None:
        raise malformed(where, "has no focal length f", "align the photos before exporting the cameras")
    focal = _number(calibration, "f", where)
    value = {
        key: _number(calibration, key, where, default=0.0)
        for key in ("cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2")
    }
    centre = (size[0] / 2 + value["cx"], size[1] / 2 + value["cy"])
    _refuse_term("b2", value["b2"] * size[1] / max(abs(focal), 1e-9), "non-orthogonality (skew)", where)
    for key in ("p3", "p4"):
        _refuse_term(key, value[key] * focal, "a tangential term that Metashape dropped in version 1.6", where)
    focals, tangential = (focal + value["b1"], focal), (value["p2"], value["p1"])
    if kind in _FISHEYE:
        radial = (value["k1"], value["k2"], value["k3"], value["k4"])
        return lenses.fisheye_camera(size, focals, centre, radial=radial, tangential=tangential, where=where)
    _refuse_term("k4", value["k4"] * focal, "a fourth radial term of a frame camera", where)
    radial = (value["k1"], value["k2"], value["k3"])
    return lenses.brown_camera(size, focals, centre, radial=radial, tangential=tangential, where=where)


def _refuse_term(key: str, effect_px: float, what: str, where: str) -> None:
    if abs(effect_px) > _NEGLIGIBLE_PX:
        raise malformed(
            where,
            f"{key} is not 0: {what}, which is not supported",
            f"set {key} to 0, or exclude it from the optimization (Optimize Cameras), and export again",
        )


def _number(record: Element, key: str, where: str, *, default: float | None = None) -> float:
    if default is not None and record.find(key) is None:
        return default
    return numbers(_words(record, key), 1, f"{where}: {key}")[0]


def _words(record: Element, key: str) -> list[str]:
    return (record.findtext(key) or "").split()


FORMAT = Format(
    "metashape",
    "Agisoft Metashape",
    ".xml",
    by_suffix(".xml", "cameras.xml"),
    lambda path, given: with_photos(parse_metashape(path), path.parent, given=given.images),
)
