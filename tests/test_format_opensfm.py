"""OpenSfM's reconstruction.json against OpenSfM's own formulas written out here, by hand, and in round trips."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from captures import assert_projects, refused, ring

from nerfcli.cameras.camera import Camera
from nerfcli.captures.formats.opensfm import FORMAT, losses_opensfm, parse_opensfm, write_opensfm
from nerfcli.errors import UserError

AFFINE = {"focal_x": 0.9, "focal_y": 0.93, "c_x": 0.021, "c_y": -0.013}
RADIAL = {"k1": 0.11, "k2": -0.05}
LONG = {**RADIAL, "k3": 0.012, "k4": -0.004}
TANGENTIAL = {"p1": 0.0011, "p2": -0.0023}

RECORDS = {
    "perspective": {"focal": 0.9, **RADIAL},
    "simple_radial": {**AFFINE, "k1": 0.11},
    "radial": {**AFFINE, **RADIAL},
    "brown": {**AFFINE, **RADIAL, "k3": 0.012, **TANGENTIAL},
    "fisheye": {"focal": 0.9, **RADIAL},
    "fisheye_opencv": {**AFFINE, **LONG},
    "fisheye62": {**AFFINE, **LONG, "k5": 0.001, "k6": -0.0002, "p1": 0, "p2": 0},
    "fisheye62 with p": {**AFFINE, **LONG, "k5": 0, "k6": 0, **TANGENTIAL},
    "fisheye624": {**AFFINE, **LONG, "k5": 0, "k6": 0, **TANGENTIAL, "s0": 0.003, "s1": 0, "s2": -0.002, "s3": 0},
    "spherical": {},
    "equirectangular": {},
}


def opensfm_pixels(kind: str, record: dict[str, Any], points: np.ndarray) -> np.ndarray:
    """Pixels as OpenSfM computes them: camera_{projections,distortions}_functions.h, then features.py."""
    x, y, z = points.T
    width, height = record["width"], record["height"]
    if kind in ("spherical", "equirectangular"):
        latitude = np.arctan2(-y, np.hypot(x, z))
        u, v = np.arctan2(x, z) / (2 * np.pi), -latitude / (2 * np.pi)
    else:
        if kind.startswith("fisheye"):
            radius = np.hypot(x, y)
            theta = np.arctan2(radius, z)
            u, v = theta / radius * x, theta / radius * y
        else:
            u, v = x / z, y / z
        r2 = u * u + v * v
        factor = 1 + sum(record.get(f"k{i}", 0) * r2**i for i in range(1, 7))
        p1, p2 = record.get("p1", 0), record.get("p2", 0)
        s0, s1, s2, s3 = (record.get(f"s{i}", 0) for i in range(4))
        u, v = (
            u * factor + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + s0 * r2 + s1 * r2 * r2,
            v * factor + 2 * p2 * u * v + p1 * (r2 + 2 * v * v) + s2 * r2 + s3 * r2 * r2,
        )
        u = record.get("focal_x", record.get("focal")) * u + record.get("c_x", 0)
        v = record.get("focal_y", record.get("focal")) * v + record.get("c_y", 0)
    size = max(width, height)
    whole_at_centres = np.stack([u * size - 0.5 + width / 2, v * size - 0.5 + height / 2], axis=-1)
    return whole_at_centres + 0.5


def write_file(path: Path, *reconstructions: dict[str, Any]) -> Path:
    path.write_text(json.dumps(list(reconstructions)), encoding="utf-8")
    return path


def reconstruction(record: dict[str, Any] | None = None, names: tuple[str, ...] = ("a.jpg",)) -> dict[str, Any]:
    camera = record or {"projection_type": "perspective", "width": 640, "height": 480, **RECORDS["perspective"]}
    shot = {"rotation": [0.0, np.pi / 2, 0.0], "translation": [1.0, 2.0, 3.0], "camera": "v2 phone"}
    return {
        "cameras": {"v2 phone": camera},
        "shots": {name: {**shot, "orientation": 6, "gps_dop": 5.0, "merge_cc": 0} for name in names},
        "points": {"17": {"color": [10.0, 20.4, 255.0], "coordinates": [1.0, 2.0, 30.0]}},
    }


@pytest.mark.parametrize("kind", RECORDS)
@pytest.mark.parametrize("size", [(640, 480), (480, 640)])
def test_lenses_project_as_in_opensfm(tmp_path, kind, size):
    width, height = (640, 320) if kind in ("spherical", "equirectangular") else size
    record = {"projection_type": kind.split()[0], "width": width, "height": height, **RECORDS[kind]}
    camera = parse_opensfm(write_file(tmp_path / "reconstruction.json", reconstruction(record))).frames[0].camera
    assert (camera.width, camera.height) == (width, height)
    assert_projects(camera, lambda points: opensfm_pixels(kind, record, points))


def test_shots_points_and_names_by_hand(tmp_path):
    one = reconstruction(names=("b c.jpg", "ü.jpg"))
    path = write_file(tmp_path / "reconstruction.json", reconstruction(), one)
    capture = parse_opensfm(path)
    assert [frame.name for frame in capture.frames] == ["b c.jpg", "ü.jpg"]  # of the larger of the two reconstructions
    others = "others, which are in other coordinates: 0 with 1"
    assert capture.notes == (f"reconstruction 1 with 2 photos is read; {others}",)
    assert capture.frames[1].image == tmp_path / "images" / "ü.jpg"
    assert capture.kind == "opensfm"
    assert capture.unit == "arbitrary"
    # A quarter turn about y: cam x is world z, cam y is world y, cam z is world -x; X_cam = R X + (1, 2, 3).
    world_from_cam = [[0, 0, -1, 3], [0, 1, 0, -2], [1, 0, 0, -1], [0, 0, 0, 1]]
    np.testing.assert_allclose(capture.frames[0].world_from_cam, world_from_cam, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(capture.points, [[1, 2, 30]])
    np.testing.assert_array_equal(capture.colours, [[10, 20, 255]])


@pytest.mark.parametrize(
    ("reference", "unit"),
    [
        ({"latitude": 48.1, "longitude": 11.6, "altitude": 500.0}, "metre"),
        ({"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}, "arbitrary"),
    ],
)
def test_the_unit_is_the_metre_after_scaling_by_gps(tmp_path, reference, unit):
    path = write_file(tmp_path / "reconstruction.json", {**reconstruction(), "reference_lla": reference})
    assert parse_opensfm(path).unit == unit


def test_losses_are_reported(tmp_path):
    ratio = Camera("FULL_OPENCV", 64, 48, (50, 50, 32, 24, 0.1, 0, 0, 0, 0, 0.2, 0, 0.3))
    capture = ring(ratio, Camera("FOV", 64, 48, (50, 50, 32, 24, 0.5)))
    assert capture.observations is not None
    frames = (*capture.frames[:-1], replace(capture.frames[-1], mask=Path("m.png"), split="test"))
    full = replace(capture, frames=frames, depth_bounds=np.ones((6, 2)), unit="metre")
    assert losses_opensfm(full) == (
        "k4 of 1 camera",
        "k6 of 1 camera",
        "the FOV lens of 1 camera",
        "1 mask",
        f"{len(capture.observations.pixels)} observations",
        "the split of 1 frame",
        "depth bounds",
        "the unit of length (metre)",
    )
    with pytest.raises(UserError, match="FOV cannot be written"):
        write_opensfm(full, tmp_path / "reconstruction.json")
    assert not list(tmp_path.iterdir())


CAMERA = reconstruction()["cameras"]["v2 phone"]
SHOT = reconstruction()["shots"]["a.jpg"]


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"shots": None}, "reconstruction 0: shots: is None"),
        ({"shots": {}}, "lists no images with a pose"),
        ({"shots": {"a.jpg": {**SHOT, "camera": "v1"}}}, r"shots\.'a.jpg': camera is 'v1'"),
        ({"shots": {"a.jpg": {**SHOT, "rotation": [1, 2]}}}, r"shots\.'a.jpg': rotation is a list of 2"),
        ({"shots": {"a.jpg": {**SHOT, "translation": [1, 2, None]}}}, "translation contains a number that is not"),
        ({"shots": {"a\\b": SHOT, "a/b": SHOT}}, "'a/b' is listed twice"),
        ({"shots": {"\ud800": SHOT}}, "the image's name is"),
        ({"cameras": {"v2 phone": {**CAMERA, "focal": "wide"}}}, r"cameras\.'v2 phone': focal is 'wide'"),
        ({"cameras": {"v2 phone": {**CAMERA, "focal": -1}}}, "invalid parameters"),
        ({"cameras": {"v2 phone": {**CAMERA, "width": 0.5}}}, "width and height are 0.5 and 480"),
        ({"cameras": {"v2 phone": {**CAMERA, "width": 1e12}}}, "width and height are"),
        ({"cameras": {"v2 phone": {**CAMERA, "projection_type": "dual"}}}, "'dual' is not supported"),
        ({"cameras": {"v2 phone": {**CAMERA, "projection_type": "spherical"}}}, "invalid size .* picture: 640x480"),
        (
            {"cameras": {"v2 phone": {**CAMERA, **RECORDS["fisheye624"], "projection_type": "fisheye624", "k6": 1}}},
            "k5, k6, s1 or s3 beside p1",
        ),
        ({"points": {"3": {"color": [1, 2, 3]}}}, r"points\.'3': coordinates is missing"),
        (
            {"points": {"3": {"color": [1, 2, 3], "coordinates": [1, 2, float("nan")]}}},
            "coordinates contains a number that is not finite",
        ),
        ({"points": {"3": 5}}, r"points\.'3': is 5"),
        ({"reference_lla": [1]}, "reference_lla: is a list of 1"),
    ],
)
def test_malformed_files_are_refused_with_file_and_field(tmp_path, change, what):
    path = write_file(tmp_path / "reconstruction.json", {**reconstruction(), **change})
    with refused(what, path):
        FORMAT.parse(path)


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (b"", "not valid JSON"),
        (b"{}", "holds a dict of 0"),
        (b"[]", "holds a list of 0"),
        (b"[3]", "reconstruction 0: is 3"),
        (b"[" * 100_000, "not valid JSON"),
        (b"9" * 5000, "not valid JSON"),
        (b"\xfe", "not UTF-8"),
    ],
)
def test_what_is_no_list_of_reconstructions_is_refused(tmp_path, data, what):
    path = tmp_path / "reconstruction.json"
    path.write_bytes(data)
    with pytest.raises(UserError, match=what):
        parse_opensfm(path)
    with pytest.raises(UserError, match="No such file"):
        parse_opensfm(tmp_path / "none.json")
