"""Depth files of every format: every bit and the meaning come back, other programs' readers see the same numbers."""

import json
import math
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
import OpenEXR
import pytest
import tifffile
from depth_maps import ALL, FLOATS, FULL_META, META, plain_depth
from examples import examples
from full_disk import files_of_at_most
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from present import present

from nerfcli.errors import UserError
from nerfcli.photos.colours import linear_light
from nerfcli.render.files.depth_meta import DepthMeta, difference_of
from nerfcli.render.files.file_facts import depth_meta_of
from nerfcli.render.files.float_maps import (
    LARGEST_LEVEL,
    chosen_scale,
    depth_of_levels,
    read_exr,
    read_tiff,
    write_exr,
    write_png16,
    write_tiff,
)


def odd_depth() -> np.ndarray:
    """Return NaN with two payloads, both infinities and zeros, the smallest and the largest floats, and noise."""
    depth = np.random.default_rng(0).standard_normal((37, 53)).astype(np.float32)
    depth[0, :2] = np.array([0x7FC00000, 0xFFC12345], np.uint32).view(np.float32)
    depth[0, 2:8] = [np.inf, -np.inf, 0.0, -0.0, 1e-45, np.finfo(np.float32).max]
    return depth


def read_elsewhere(path: Path) -> np.ndarray:
    """Read the depth in a file with the reference library of its format."""
    match path.suffix:
        case ".tiff":
            return tifffile.imread(path)
        case ".exr":
            with OpenEXR.File(str(path), separate_channels=True) as file:
                return np.array(file.channels()["Z"].pixels)
        case _:
            return np.load(path, allow_pickle=False)


@pytest.mark.parametrize("suffix", FLOATS)
def test_float_files_return_every_bit(suffix, tmp_path):
    path, depth = tmp_path / "new folder" / f"tiefe 北{suffix}", odd_depth()
    FLOATS[suffix](path, depth, META)
    np.testing.assert_array_equal(read_elsewhere(path).view(np.uint32), depth.view(np.uint32))
    others = {path.with_suffix(".json")} if suffix == ".npy" else set()
    assert set(path.parent.iterdir()) == {path} | others


@pytest.mark.parametrize("meta", [META, FULL_META, FULL_META.of("spread"), replace(META, convention="quantile:0.05")])
@pytest.mark.parametrize("suffix", FLOATS)
def test_float_files_return_their_meaning(suffix, meta, tmp_path):
    path = tmp_path / f"a.depth{suffix}"
    FLOATS[suffix](path, plain_depth(), meta)
    assert depth_meta_of(path) == meta


def test_a_tiff_is_read_alike_by_four_libraries(tmp_path):
    """Independent: OpenCV, Pillow and imageio decode with libtiff or their own code; tifffile wrote the file."""
    path, depth = tmp_path / "a.tiff", odd_depth()
    write_tiff(path, depth, META)
    with Image.open(path) as image:
        pillow = np.asarray(image)
        description = json.loads(image.getexif()[270])
    opencv = present(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
    for found in (pillow, opencv, imageio.imread(path), tifffile.imread(path)):
        np.testing.assert_array_equal(np.asarray(found).view(np.uint32), depth.view(np.uint32))
    with tifffile.TiffFile(path) as tiff:
        assert len(tiff.pages) == 1
        assert [tag.code for tag in tiff.pages[0].aspage().tags].count(270) == 1
    assert (description["convention"], description["axis"], description["invalid"]) == ("conditional", "ray", "nan")
    write_tiff(path, np.zeros((500, 500), np.float32), META)
    assert path.stat().st_size < 10_000  # 1,000,000 uncompressed


def test_levels_are_read_alike_by_three_libraries(tmp_path):
    """Levels are millimetres, the unit that a reader assumes without further information."""
    path, depth = tmp_path / "a.png", plain_depth()
    write_png16(path, depth, FULL_META, units_per_level=1e-3)
    expected = np.where(np.isnan(depth), 0, np.rint(depth.astype(np.float64) * 1000)).astype(np.uint16)
    opencv = present(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
    for found in (opencv, imageio.imread(path), np.asarray(Image.open(path))):
        assert found.dtype == np.uint16
        np.testing.assert_array_equal(found, expected)
    meta = present(depth_meta_of(path))
    rounding = meta.error_bounds["rounding_max"]
    bounds = {**FULL_META.error_bounds, "rounding_max": rounding}
    assert meta == replace(FULL_META, invalid="0", units_per_level=1e-3, error_bounds=bounds)
    assert np.nanmax(np.abs(expected * 1e-3 - depth.astype(np.float64))[expected > 0]) == pytest.approx(rounding)
    with Image.open(path) as image:
        assert "one level is 1 mm, 0 means no value" in image.info["Comment"]


def test_an_exr_has_the_channels_that_compositing_programs_look_for(tmp_path):
    generator = np.random.default_rng(0)
    depth, opacity, spread = (generator.random((4, 5), np.float32) for _ in range(3))
    rgb = generator.random((4, 5, 3), np.float32)
    maps = {"depth": depth, "opacity": opacity, "spread": spread, "disagreement": spread * 2, "coverage": spread * 3}
    write_exr(tmp_path / "a.exr", {"rgb": rgb, **maps}, META)
    write_exr(tmp_path / "b.exr", maps, META)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        assert file.header()["comments"].startswith("conditional depth along the ray, in arbitrary units")
    assert set(channels) == {"R", "G", "B", "Z", "opacity.V", "spread.V", "disagreement.V", "coverage.V"}
    np.testing.assert_array_equal(channels["opacity.V"], opacity)
    np.testing.assert_array_equal(channels["disagreement.V"], spread * 2)
    np.testing.assert_array_equal(channels["G"], linear_light(rgb)[..., 1])
    with OpenEXR.File(str(tmp_path / "b.exr"), separate_channels=True) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    assert set(channels) == {"Y", "Z", "opacity.V", "spread.V", "disagreement.V", "coverage.V"}
    np.testing.assert_array_equal(channels["Y"], depth)


def test_colour_with_alpha_is_premultiplied_in_an_exr(tmp_path):
    rgba = np.zeros((1, 2, 4), np.float32)
    rgba[0, 0] = (1.0, 0.5, 0.0, 0.25)
    write_exr(tmp_path / "a.exr", {"rgb": rgba}, META)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        pixel = [float(file.channels()[name].pixels[0, 0]) for name in "RGBA"]
    assert pixel == pytest.approx([0.25, 0.25 * 0.2140411, 0.0, 0.25], rel=1e-5)


def test_maps_that_threads_read_leave_the_terminal_as_it_is(tmp_path):
    """Regression: what each took for the terminal was what another one listened to, and the command fell silent."""
    depth = np.random.default_rng(0).random((500, 500), np.float32)
    write_exr(tmp_path / "a.exr", {"depth": depth}, META)
    before = sys.stdout, os.fstat(2).st_ino
    with ThreadPoolExecutor(4) as pool:
        assert len(list(pool.map(lambda _: read_exr(tmp_path / "a.exr"), range(40)))) == 40
    assert (sys.stdout, os.fstat(2).st_ino) == before


def test_linear_light_of_known_colours():
    """Of IEC 61966-2-1: the ends, the joint, middle grey."""
    srgb = np.array([0.0, 0.04045, 0.5, 0.7353570, 1.0], np.float32)
    np.testing.assert_allclose(linear_light(srgb), [0.0, 0.0031308, 0.2140411, 0.5, 1.0], rtol=1e-5)


@pytest.mark.parametrize("suffix", ALL)
def test_what_is_no_depth_map_is_not_written(suffix, tmp_path):
    for wrong in (np.zeros((3, 4)), np.zeros((3, 4, 1), np.float32)):
        with pytest.raises(ValueError, match=r"depth must be float32 \(H, W\), got"):
            ALL[suffix](tmp_path / f"a{suffix}", wrong, META)
    with pytest.raises(ValueError, match="JSON compliant"):
        ALL[suffix](tmp_path / f"a{suffix}", plain_depth(), replace(META, background_distance=math.inf))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", ALL)
def test_a_full_disk_leaves_the_earlier_file_as_it_was(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    ALL[suffix](path, plain_depth(), META)
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    with files_of_at_most(1000), pytest.raises(UserError, match=r"cannot write .*a\."):
        ALL[suffix](path, plain_depth() + 1, META)
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


@examples(100)
@given(largest=st.floats(1e-6, 1e6), unit=st.sampled_from(["metre", "arbitrary"]))
def test_the_chosen_scale_holds_the_clip_and_is_the_finest_round_one(largest, unit):
    scale = chosen_scale(largest, unit)
    assert np.rint(largest / scale) <= LARGEST_LEVEL
    mantissa = scale / 10 ** math.floor(math.log10(scale * (1 + 1e-9)))
    assert min(abs(mantissa - digit) for digit in (1, 2, 5)) < 1e-9
    if unit == "metre":
        assert scale >= 1e-3
    if not (unit == "metre" and scale == 1e-3):
        assert largest > LARGEST_LEVEL * scale / 2.5 * (1 - 1e-8)  # the next finer would not hold it


def test_scales_in_metres_are_millimetres_where_those_fit():
    scales = [chosen_scale(largest, "metre") for largest in (0.0, 0.01, 65.535, 65.6, 400.0)]
    assert scales == [1e-3, 1e-3, 1e-3, 2e-3, 1e-2]
    assert chosen_scale(3.0, "arbitrary") == 5e-5
    assert chosen_scale(0.0, "arbitrary") == 1.0


@examples(50)
@given(seed=st.integers(0, 2**32 - 1), size=st.floats(1e-3, 1e5))
def test_levels_are_within_half_a_level_of_the_depth(seed, size, tmp_path_factory):
    path = tmp_path_factory.mktemp("levels") / "a.png"
    depth = (np.random.default_rng(seed).uniform(0.01, 1.0, (5, 7)) * size).astype(np.float32)
    depth[0, 0] = np.nan
    scale = chosen_scale(float(np.nanmax(depth)), "arbitrary")
    write_png16(path, depth, META, units_per_level=scale)
    levels = imageio.imread(path)
    assert levels[0, 0] == 0
    assert (levels.ravel()[1:] > 0).all()
    error = np.abs(levels.astype(np.float64) * scale - depth.astype(np.float64))
    assert np.nanmax(np.where(levels > 0, error, np.nan)) <= scale / 2 * (1 + 1e-9)
    assert np.isnan(depth_of_levels(levels, scale)[0, 0])


def test_what_does_not_fit_into_levels_is_refused(tmp_path):
    """Values are neither wrapped nor clipped, and no depth becomes the level for "no depth"."""
    path = tmp_path / "a.png"
    for value, message in (
        (65.536, r"16 bits hold depth up to 65.535 at 0.001 per level, but the maximum is 65.536"),
        (math.inf, r"maximum is inf"),
        (4e-4, r"a depth of 0.0004 would become 0 \(no value\) in levels of 0.001"),
        (0.0, r"a depth of 0 would become 0"),
        (-2.0, r"a depth of -2 would become 0"),
    ):
        with pytest.raises(UserError, match=message):
            write_png16(path, np.full((2, 2), value, np.float32), META, units_per_level=1e-3)
    assert list(tmp_path.iterdir()) == []
    write_png16(path, np.full((2, 2), 65.5354, np.float32), META, units_per_level=1e-3)
    assert imageio.imread(path).max() == LARGEST_LEVEL


def test_meta_refuses_an_unknown_axis_and_quantity():
    with pytest.raises(ValueError, match="axis must be one of ray, z, got y"):
        DepthMeta("median", "y", "metre", 0.5)
    with pytest.raises(ValueError, match=r"quantity must be one of depth, .*, confidence, got speed"):
        replace(META, quantity="speed")


def test_files_of_the_first_version_keep_their_meaning(tmp_path):
    """Six entries, as nerfcli wrote them before there were quantities and bounds."""
    entries = {"convention": "median", "axis": "z", "unit": "metre", "opacity_floor": 0.5, "invalid": "nan"}
    entries |= {"background_distance": None}
    path = tmp_path / "a.tiff"
    tifffile.imwrite(path, plain_depth(), description=json.dumps(entries), metadata=None)
    assert depth_meta_of(path) == DepthMeta("median", "z", "metre", 0.5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"convention": "median"}, "convention conditional and median"),
        ({"axis": "z"}, "axis ray and z"),
        ({"unit": "metre"}, "unit arbitrary and metre"),
        ({"opacity_floor": 0.1}, "opacity floor 0.5 and 0.1"),
        ({"background_distance": 3.0}, "background distance None and 3.0"),
        ({"quantity": "spread"}, "quantity depth and spread"),
        ({"units_per_level": 1e-3}, "units per level None and 0.001"),
    ],
)
def test_maps_of_another_meaning_are_not_mixed(change, message):
    other = replace(META, **change)
    assert difference_of(META, other) == message


def test_maps_that_differ_in_view_and_bounds_belong_together():
    other = replace(META, view={"name": "b"}, error_bounds={"truncation_max": 1.0}, provenance={"run": "r"})
    assert difference_of(META, other) is None


def test_reading_what_is_no_depth_map_gives_the_reason(tmp_path):
    path = tmp_path / "a.tif"
    with pytest.raises(UserError, match=r"cannot read .*a\.tif: No such file"):
        read_tiff(path)
    write_tiff(path, np.random.default_rng(0).random((64, 64), np.float32), META)
    for content in (path.read_bytes()[:5000], b"this is text\n" * 50, b""):
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"a\.tif is damaged or not a TIFF"):
            read_tiff(path)
    for description in ("", "a depth map", "[1]", '{"axis": "ray"}', "3"):
        tifffile.imwrite(path, np.zeros((4, 5), np.float32), description=description, metadata=None)
        assert depth_meta_of(path) is None
