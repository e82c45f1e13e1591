"""PLY files of points and of cameras: by hand in all encodings, and against pycolmap's."""

import struct
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from captures import CAMERAS, refused, ring

from nerfcli.captures.formats.colmap import write_colmap_binary
from nerfcli.captures.formats.ply import read_points, write_points

POINTS = np.array([[1.5, -2.0, 3.0], [4.0, 5.0, -6.25]])
COLOURS = np.array([[255, 128, 0], [1, 2, 3]], dtype=np.uint8)
XYZ, LIST = [f"property float {name}" for name in "xyz"], "property list uchar int vertex_indices"


def header(encoding: str, *lines: str) -> bytes:
    return "\n".join(["ply", f"format {encoding} 1.0", *lines, "end_header", ""]).encode()


def by_hand(encoding: str) -> bytes:
    """Properties in an odd order, an element before the vertices and faces after them."""
    start = header(
        encoding,
        "comment made by hand",
        *("element camera 1", "property float fov"),
        *("element vertex 2", "property uchar red", "property double z", "property uchar blue", "property float x"),
        *("property short quality", "property float y", "property uint8 green"),
        *("element face 1", LIST),
    )
    if encoding == "ascii":
        return start + b"0.9\n255 3.0 0 1.5 7 -2 128\n1 -6.25 3 4 7 5.0 2\n3 0 1 0\n"
    order = "<" if "little" in encoding else ">"
    body = struct.pack(f"{order}f", 0.9)
    for (x, y, z), (red, green, blue) in zip(POINTS, COLOURS.tolist(), strict=True):
        body += struct.pack(f"{order}BdBfhfB", red, z, blue, x, 7, y, green)
    return start + body + struct.pack(f"{order}B3i", 3, 0, 1, 0)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_points_by_hand(tmp_path, encoding):
    (tmp_path / "ä b.ply").write_bytes(by_hand(encoding))
    points, colours = read_points(tmp_path / "ä b.ply")
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_array_equal(colours, COLOURS)
    (tmp_path / "dos.ply").write_bytes(by_hand(encoding).replace(b"\n", b"\r\n", by_hand(encoding).count(b"\n") - 1))
    if encoding == "ascii":
        np.testing.assert_array_equal(read_points(tmp_path / "dos.ply")[0], POINTS)


def test_colours_as_floats_and_none(tmp_path):
    names = ("x", "y", "z", "red", "green", "blue")
    start = header("ascii", "element vertex 1", *(f"property float {name}" for name in names))
    (tmp_path / "a.ply").write_bytes(start + b"1 2 3 1.0 0.5 0\n")
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply")[1], [[255, 128, 0]])
    start = header("ascii", "element vertex 1", *(f"property float {name}" for name in names[:5]))
    (tmp_path / "a.ply").write_bytes(start + b"1 2 3 1.0 0.5\n")
    assert read_points(tmp_path / "a.ply")[1] is None
    (tmp_path / "a.ply").write_bytes(header("ascii", "element vertex 0", *XYZ))
    assert read_points(tmp_path / "a.ply")[0].shape == (0, 3)


def test_written_points_are_read_back(tmp_path):
    capture = ring(CAMERAS["OPENCV"])
    write_points(capture, tmp_path / "a.ply")
    points, colours = read_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(points, capture.points)
    np.testing.assert_array_equal(colours, capture.colours)
    write_points(replace(capture, colours=None), tmp_path / "b.ply")
    points, colours = read_points(tmp_path / "b.ply")
    np.testing.assert_array_equal(points, capture.points)
    assert colours is None


def test_points_that_colmap_exports(tmp_path):
    """An independent writer: binary, float32 positions and uchar colours."""
    capture = ring(CAMERAS["OPENCV"])
    write_colmap_binary(capture, tmp_path / "model")
    pycolmap.Reconstruction(str(tmp_path / "model")).export_PLY(str(tmp_path / "a.ply"))
    points, colours = read_points(tmp_path / "a.ply")
    order, expected = np.argsort(points[:, 0]), np.argsort(capture.points[:, 0])
    assert capture.colours is not None
    assert colours is not None
    np.testing.assert_array_equal(points[order], capture.points.astype(np.float32)[expected])
    np.testing.assert_array_equal(colours[order], capture.colours[expected])


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (b"", "does not begin with the word ply"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\n", "header has no end"),
        (header("ascii", "element face 1", "property float x"), "no element vertex"),
        (header("ascii", "element vertex 1", "property float x") + b"1\n", "vertices have the properties x"),
        (header("ascii", "element vertex many"), "has the line 'element vertex many'"),
        (header("ascii", "element vertex 1", *XYZ) + b"1 2\n", "fewer than 3"),
        (header("ascii", "element vertex 9", *XYZ) + b"1 2 3\n", "1 lines are"),
        (header("binary_little_endian", "element vertex 999999999999", *XYZ), "announces 999999999999 vertices, but 0"),
        (header("binary_little_endian", "element a 1", LIST, "element vertex 0", *XYZ), "element a contains lists"),
        (header("pdf", "element vertex 0"), "its format is 'pdf'"),
    ],
)
def test_what_is_no_cloud_is_refused(tmp_path, data, what):
    (tmp_path / "a.ply").write_bytes(data)
    with refused(what, tmp_path / "a.ply"):
        read_points(tmp_path / "a.ply")
