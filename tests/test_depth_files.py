"""nerfcli.media.depth: every bit and the meaning come back; previews show what they say."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from nerfcli.errors import UserError
from nerfcli.media.depth import DepthMeta, depth_range, preview, read_tiff, write_npy, write_tiff

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


def test_range_is_the_percentiles_of_all_finite_values():
    rng = np.random.default_rng(0)
    frames = [rng.gamma(2.0, 3.0, (20, 30)).astype(np.float32) for _ in range(4)]
    frames[1][5:9] = np.nan
    frames[2][0, 0] = np.inf
    values = np.concatenate([f[np.isfinite(f)] for f in frames])
    assert depth_range(iter(frames)) == pytest.approx(np.percentile(values, (1, 99)), rel=1e-6)


def test_range_of_large_frames_and_of_nothing():
    ramp = np.linspace(0, 1, 1000 * 1001, dtype=np.float32).reshape(1000, 1001)
    assert depth_range([ramp]) == pytest.approx((0.01, 0.99), abs=1e-4)  # one value of 16 is looked at
    assert depth_range([np.full((3, 4), np.nan, np.float32)]) == (0.0, 1.0)
    assert depth_range([]) == (0.0, 1.0)
    assert depth_range([np.full((3, 4), 7, np.float32)]) == (7.0, 7.0)


def test_preview_shows_turbo_above_the_legend_and_grey_where_nothing_is():
    """The ends and the middle are those of the published table of turbo (Mikhailov 2019)."""
    depth = np.tile(np.linspace(2, 6, 511, dtype=np.float32), (40, 1))
    depth[20:] = np.nan
    sheet = preview(depth, META, lo=2.0, hi=6.0)
    assert sheet.dtype == np.uint8
    assert sheet.shape[1:] == (511, 3)
    assert sheet.shape[0] > 40
    for column, colour in ((0, (48, 18, 59)), (510, (122, 4, 3)), (256, (164, 252, 60))):
        assert np.abs(sheet[0, column].astype(int) - colour).max() <= 4
    hatched = sheet[20:40]
    assert np.ptp(hatched, axis=-1).max() == 0
    assert len(np.unique(hatched)) == 2


def test_preview_clips_and_keeps_its_size_over_a_video():
    """One range, other values: legend and size stay as they are, also with nothing but NaN or infinities."""
    meta = DepthMeta("median", "z", "metre", 0.5)
    frames = [np.full((30, 20), value, np.float32) for value in (-1e30, 1e30, 3.0, np.nan, np.inf)]
    sheets = [preview(frame, meta, lo=1.0, hi=5.0) for frame in frames]
    assert len({sheet.shape for sheet in sheets}) == 1
    for sheet in sheets[1:]:
        np.testing.assert_array_equal(sheet[30:], sheets[0][30:])
    left = (sheets[0].shape[1] - 20) // 2
    pictures = [sheet[:30, left : left + 20] for sheet in sheets]
    assert tuple(pictures[0][0, 0]) == (48, 18, 59)
    assert tuple(pictures[1][0, 0]) == (122, 4, 3)
    np.testing.assert_array_equal(pictures[3], pictures[4])


@pytest.mark.parametrize(
    "other",
    [
        DepthMeta("median", "ray", "arbitrary", 0.5),
        DepthMeta("conditional", "z", "arbitrary", 0.5),
        DepthMeta("conditional", "ray", "metre", 0.5),
    ],
)
def test_the_legend_tells_convention_axis_and_unit(other):
    depth = np.zeros((4, 600), np.float32)
    assert (preview(depth, META, lo=0, hi=1) != preview(depth, other, lo=0, hi=1)).any()
    assert (preview(depth, META, lo=0, hi=1)[4:] != preview(depth, META, lo=0, hi=2)[4:]).any()


@settings(max_examples=50, deadline=None)
@given(lo=st.floats(-1e30, 1e30), span=st.one_of(st.just(0.0), st.floats(0, 1e30)), width=st.integers(1, 200))
def test_preview_draws_any_range_within_its_sheet(lo, span, width):
    """The margin of the legend stays white: no number leaves the sheet."""
    sheet = preview(np.full((2, width), lo, np.float32), META, lo=lo, hi=lo + span)
    assert (sheet[2:, :6] == 255).all()
    assert (sheet[2:, -6:] == 255).all()


def test_preview_refuses_a_range_out_of_order():
    for lo, hi in ((2.0, 1.0), (0.0, math.nan), (0.0, math.inf)):
        with pytest.raises(ValueError, match="lo <= hi must be finite"):
            preview(np.zeros((2, 2), np.float32), META, lo=lo, hi=hi)
