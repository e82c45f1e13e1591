"""nerfcli.media.depth: every bit and the meaning come back."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import tifffile
from PIL import Image

from nerfcli.errors import UserError
from nerfcli.media.depth import DepthMeta, read_tiff, write_npy, write_tiff

META = DepthMeta("conditional", "ray", "arbitrary", 0.5)


def odd_depth() -> np.ndarray:
    """NaN with two payloads, both infinities and zeros, the smallest and the largest floats, and noise."""
    depth = np.random.default_rng(0).standard_normal((37, 53)).astype(np.float32)
    depth[0, :2] = np.array([0x7FC00000, 0xFFC12345], np.uint32).view(np.float32)
    depth[0, 2:8] = [np.inf, -np.inf, 0.0, -0.0, 1e-45, np.finfo(np.float32).max]
    return depth


@pytest.mark.parametrize(
    "meta",
    [
        META,
        DepthMeta("expected", "z", "metre", 0.0, background_distance=12.25),
        DepthMeta("höchste Dichte", "ray", "Elle", 1 / 3, invalid="nan"),
    ],
)
def test_tiff_returns_every_bit_and_the_meaning(tmp_path, meta):
    path, depth = tmp_path / "new folder" / "tiefe 北.tif", odd_depth()
    write_tiff(path, depth, meta)
    found, found_meta = read_tiff(path)
    np.testing.assert_array_equal(found.view(np.uint32), depth.view(np.uint32))
    assert found_meta == meta
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_tiff_is_compressed_and_open_to_other_readers(tmp_path):
    """Pillow decodes with libtiff, another implementation than tifffile; the description is plain JSON."""
    path, depth = tmp_path / "a.tiff", odd_depth()
    write_tiff(path, depth, META)
    with Image.open(path) as image:
        np.testing.assert_array_equal(np.asarray(image).view(np.uint32), depth.view(np.uint32))
        description = json.loads(image.getexif()[270])
    with tifffile.TiffFile(path) as tiff:
        assert len(tiff.pages) == 1
        assert [tag.code for tag in tiff.pages[0].aspage().tags].count(270) == 1
    assert description == {
        "convention": "conditional",
        "axis": "ray",
        "unit": "arbitrary",
        "opacity_floor": 0.5,
        "invalid": "nan",
        "background_distance": None,
    }
    write_tiff(path, np.zeros((500, 500), np.float32), META)
    assert path.stat().st_size < 10_000  # 1,000,000 uncompressed


def test_npy_returns_every_bit_and_has_its_meaning_beside_it(tmp_path):
    path, depth = tmp_path / "view 1.depth.npy", odd_depth()
    write_npy(path, depth, META)
    np.testing.assert_array_equal(np.load(path, allow_pickle=False).view(np.uint32), depth.view(np.uint32))
    sidecar = tmp_path / "view 1.depth.json"
    assert DepthMeta(**json.loads(sidecar.read_text(encoding="utf-8"))) == META
    assert sorted(tmp_path.iterdir()) == [sidecar, path]


@pytest.mark.parametrize("write", [write_tiff, write_npy])
def test_what_is_no_depth_map_is_not_written(tmp_path, write):
    for wrong in (np.zeros((3, 4)), np.zeros((3, 4, 1), np.float32)):
        with pytest.raises(ValueError, match=r"depth must be float32 \(H, W\), got"):
            write(tmp_path / "a.tif", wrong, META)
    with pytest.raises(ValueError, match="JSON compliant"):
        write(tmp_path / "a.tif", odd_depth(), replace(META, background_distance=math.inf))
    assert list(tmp_path.iterdir()) == []


def test_meta_refuses_an_unknown_axis():
    with pytest.raises(ValueError, match="axis must be one of ray, z, got y"):
        DepthMeta("median", "y", "metre", 0.5)


def test_reading_what_is_no_depth_map_tells_why(tmp_path):
    path = tmp_path / "a.tif"
    with pytest.raises(UserError, match=r"cannot read .*a\.tif: No such file"):
        read_tiff(path)
    path.write_bytes(b"")
    with pytest.raises(UserError, match=r"a\.tif is damaged or no TIFF"):
        read_tiff(path)
    path.write_text("this is text\n" * 50)
    with pytest.raises(UserError, match=r"a\.tif is damaged or no TIFF"):
        read_tiff(path)
    write_tiff(path, np.random.default_rng(0).random((64, 64), np.float32), META)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(UserError, match=r"a\.tif is damaged or no TIFF"):
        read_tiff(path)
    tifffile.imwrite(path, np.zeros((4, 5), np.uint16))
    with pytest.raises(UserError, match=r"a\.tif holds uint16 \(4, 5\), not a float32 depth map"):
        read_tiff(path)
    for description in ("", "a depth map", "[1]", '{"axis": "ray"}', "3"):
        tifffile.imwrite(path, np.zeros((4, 5), np.float32), description=description, metadata=None)
        with pytest.raises(UserError, match=r"a\.tif does not say what its depth means"):
            read_tiff(path)
