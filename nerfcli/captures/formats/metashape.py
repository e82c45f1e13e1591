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

from collections import Counter
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import malformed, matrix_of, name_of, numbers, read_xml, shown, size_of
from nerfcli.captures.formats.format import Format, by_suffix, only_file
from nerfcli.captures.formats.lenses import Fits, Terms
from nerfcli.captures.formats.limits import FramePoses, checked_camera, largest_of, rigid_pose
from nerfcli.captures.formats.photo_names import with_photos
from nerfcli.errors import listed as in_words
from nerfcli.errors import several

Element = ElementTree.Element

_EXPECTED = "expected the XML that Metashape writes with File > Export > Export Cameras"

_FRAME = "frame"
_FISHEYE = ("fisheye", "equidistant_fisheye")
_SPHERICAL = "spherical"


def parse_metashape(path: Path) -> Capture:
    """Read the aligned cameras of the file's chunk, of the enabled one with most of them if there are several.

    Cameras without a label or a transform (not aligned, or a follower in a camera rig), of a sensor that is not
    calibrated, and disabled ones give no frames. If a component lacks a transform to the world, components are
    unrelated to each other, and only the one with the most cameras is read. What is left out is noted.

    The file does not say where the photos are; a frame's name is the camera's label, and where labels are equal, that
    of its group before it. The unit stays arbitrary: a component's transform comes from georeferencing (then it is in
    metres) or from moving the model by hand, and the file does not say which.
    """
    chunk, notes = _chunk(path)
    groups = {camera: group.get("label", "") for group in chunk.iterfind("cameras/group") for camera in group}
    sensors, reasons = _sensors(chunk), _reasons(chunk)
    records = [camera for camera, reason in reasons.items() if not reason]
    if reasons and not records:
        camera, reason = next(iter(reasons.items()))
        first = f"{shown(camera.get('label'))} is {reason}"
        hint = "align or enable the photos, and export again"
        raise malformed(path, f"lists no images with a pose: {first}", hint)
    notes += [_left_out(reason, reasons) for reason in dict.fromkeys(reasons.values()) if reason]
    worlds = _worlds_from_chunk(chunk, path)
    components = [record.get("component_id") for record in records]
    if None in (worlds.get(component) for component in components):
        counts = Counter(components)
        kept = max(counts, key=lambda component: counts[component])
        records = [record for record in records if record.get("component_id") == kept]
        named = {shown(component): count for component, count in counts.items()}
        notes += largest_of("component", named, shown(kept), noun="camera")
    labels = Counter(record.get("label") for record in records)
    cameras: dict[str | None, Camera] = {}
    fits, poses, frames = Fits(), FramePoses(), []
    for record in records:
        label = record.get("label")
        where = f"{path}: camera {shown(label)}"
        grouped = labels[label] > 1 and groups.get(record)
        name = name_of(f"{groups[record]}/{label}" if grouped else label, where)
        sensor = record.get("sensor_id")
        if sensor not in sensors:
            raise malformed(where, f"sensor_id is {shown(sensor)}", "expected the id of one of the file's sensors")
        if sensor not in cameras:
            cameras[sensor] = _camera(sensors[sensor], f"{path}: sensor {shown(sensor)}", fits)
        place = f"{where}: transform"
        chunk_from_cam = poses.read(name, place, partial(matrix_of, _words(record, "transform"), 4, 4, place))
        if chunk_from_cam is None:
            continue
        world_from_chunk = worlds.get(record.get("component_id"))
        world_from_cam = chunk_from_cam if world_from_chunk is None else world_from_chunk.apply_pose(chunk_from_cam)
        frames.append(Frame(name, cameras[sensor], world_from_cam))
    notes = (*notes, *poses.notes(), *fits.notes())
    return Capture(tuple(frames), kind="metashape", notes=notes)


def _sensors(chunk: Element) -> dict[str | None, Element]:
    return {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}


def _reasons(chunk: Element) -> dict[Element, str]:
    """Return for each camera of a chunk why it gives no frame; empty if it gives one."""
    sensors = _sensors(chunk)
    return {camera: _unusable(camera, sensors) for camera in chunk.iterfind("cameras//camera")}


def _unusable(camera: Element, sensors: Mapping[str | None, Element]) -> str:
    """Return why a camera gives no frame; empty if it gives one."""
    if not _is_enabled(camera):
        return "disabled in Metashape"
    if not (camera.get("label") or "").strip():
        return "without a label"
    if not _words(camera, "transform"):
        return "not aligned"
    sensor = sensors.get(camera.get("sensor_id"))
    calibrated = sensor is None or _calibration(sensor).find("f") is not None or _kind_of(sensor) == _SPHERICAL
    return "" if calibrated else "of a sensor without a calibration"


def _left_out(reason: str, reasons: Mapping[Element, str]) -> str:
    names = [camera.get("label") or f"id {camera.get('id')}" for camera, why in reasons.items() if why == reason]
    return f"{len(names)} of {several(len(reasons), 'camera')} left out, {reason}: {in_words(names)}"


def _is_enabled(record: Element) -> bool:
    return record.get("enabled", "true") not in ("false", "0")


def _chunk(path: Path) -> tuple[Element, list[str]]:
    """Return the chunk with most cameras that give frames, an enabled one first, and a note on the others.

    If no camera gives a frame, it is the first chunk with cameras, so that the error can say why. A chunk is the root's
    child in an exported file, the root itself in the file of a project.
    """
    root = read_xml(path, _EXPECTED)
    chunks = [root] if root.tag == "chunk" else root.findall("chunk")
    if not chunks:
        raise malformed(path, f"has no chunk element, but a {shown(root.tag)}", _EXPECTED)
    names = [f"{number} ({chunk.get('label', '')})" for number, chunk in enumerate(chunks, start=1)]
    reasons = [list(_reasons(chunk).values()) for chunk in chunks]
    usable = [of_chunk.count("") for of_chunk in reasons]
    ranks = [
        (count * _is_enabled(chunk), count, len(of_chunk) > 0)
        for chunk, count, of_chunk in zip(chunks, usable, reasons, strict=True)
    ]
    best = ranks.index(max(ranks))
    return chunks[best], [*largest_of("chunk", dict(zip(names, usable, strict=True)), names[best], noun="camera")]


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
        rotation = matrix_of(_words(record, "rotation"), 3, 3, f"{where}: rotation")
    translation = np.zeros(3)
    if record.find("translation") is not None:
        translation = np.array(numbers(_words(record, "translation"), 3, f"{where}: translation"))
    scale = _number(record, "scale", where, default=1.0)
    if scale <= 0:
        raise malformed(where, f"scale is {scale:g}", "expected a number above 0")
    pose = rigid_pose(np.column_stack([rotation, translation]), where)
    return rigid.Similarity(scale, pose[:3, :3], translation)


def _calibration(sensor: Element) -> Element:
    """Return the adjusted calibration of a sensor, else its initial one, else the sensor itself."""
    calibrations = sensor.findall("calibration")
    adjusted = [record for record in calibrations if record.get("class") == "adjusted"]
    return (adjusted or calibrations or [sensor])[0]


def _kind_of(sensor: Element) -> str | None:
    kind = _calibration(sensor).get("type", sensor.get("type"))
    return kind.lower() if kind else kind


def _camera(sensor: Element, where: str, fits: Fits) -> Camera:
    calibration, kind = _calibration(sensor), _kind_of(sensor)
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise malformed(where, "has no resolution", "expected the picture's size in pixels")
    width, height = numbers([resolution.get("width", ""), resolution.get("height", "")], 2, f"{where}: resolution")
    size = size_of(width, height, where)
    if kind == _SPHERICAL:
        return checked_camera("EQUIRECTANGULAR", *size, size, where=where)
    if kind != _FRAME and kind not in _FISHEYE:
        supported = ", ".join((_FRAME, *_FISHEYE, _SPHERICAL))
        raise malformed(where, f"camera type {shown(kind)} is not supported", f"expected one of {supported}")
    focal = _number(calibration, "f", where)
    cx, cy, k1, k2, k3, k4, p1, p2, p3, p4, b1, b2 = (
        _number(calibration, key, where, default=0.0)
        for key in ("cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2")
    )
    terms = Terms((k1, k2, k3, k4), (p2, p1), (p3, p4), b2, "b2")
    make = fits.fisheye if kind in _FISHEYE else fits.brown
    return make(size, (focal + b1, focal), (size[0] / 2 + cx, size[1] / 2 + cy), terms=terms, where=where)


def _number(record: Element, key: str, where: str, *, default: float | None = None) -> float:
    if default is not None and record.find(key) is None:
        return default
    return numbers(_words(record, key), 1, f"{where}: {key}")[0]


def _words(record: Element, key: str) -> list[str]:
    return (record.findtext(key) or "").split()


_BEGINS = '<?xml version="1.0" encoding="UTF-8"?>\n<document '


def find_metashape(path: Path) -> Path | None:
    """Find a file .xml; in a folder, cameras.xml, or the only one that begins as Metashape's, as it has any name."""
    return by_suffix(".xml", "cameras.xml")(path) or only_file(path, "*.xml", _BEGINS)


FORMAT = Format(
    "metashape",
    "Agisoft Metashape",
    find_metashape,
    lambda path, given: with_photos(parse_metashape(path), path.parent, given=given.images),
)
