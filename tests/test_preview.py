"""nerfcli.media.preview: one range over all frames; previews show what they say."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerfcli.media.depth import DepthMeta
from nerfcli.media.preview import depth_range, preview

META = DepthMeta("conditional", "ray", "arbitrary", 0.5)


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
