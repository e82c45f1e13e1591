"""Previews of depth maps, and the quantiles of many maps that bound their colours."""

import math
from dataclasses import replace

import numpy as np
import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from matplotlib import colormaps

from nerfcli.photos.colours import COLOUR_MAPS
from nerfcli.render.files.depth_files import quantiles
from nerfcli.render.files.depth_meta import DepthMeta
from nerfcli.render.presentation import ColourRange, coloured, preview

META = DepthMeta("conditional", "ray", "arbitrary", 0.5)


def test_preview_shows_turbo_above_the_legend_and_grey_where_nothing_is():
    """The ends and the middle are those of the published table of turbo (Mikhailov 2019)."""
    depth = np.tile(np.linspace(2, 6, 511, dtype=np.float32), (40, 1))
    depth[20:] = np.nan
    sheet = preview(depth, META, ColourRange(2.0, 6.0))
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
    sheets = [preview(frame, meta, ColourRange(1.0, 5.0)) for frame in frames]
    assert len({sheet.shape for sheet in sheets}) == 1
    for sheet in sheets[1:]:
        np.testing.assert_array_equal(sheet[30:], sheets[0][30:])
    left = (sheets[0].shape[1] - 20) // 2
    pictures = [sheet[:30, left : left + 20] for sheet in sheets]
    assert tuple(pictures[0][0, 0]) == (48, 18, 59)
    assert tuple(pictures[1][0, 0]) == (122, 4, 3)
    np.testing.assert_array_equal(pictures[3], pictures[4])


@pytest.mark.parametrize("change", [{"convention": "median"}, {"axis": "z"}, {"unit": "metre"}])
def test_the_legend_states_convention_axis_and_unit(change):
    depth, other = np.zeros((4, 600), np.float32), replace(META, **change)
    assert (preview(depth, META, ColourRange(0.0, 1.0)) != preview(depth, other, ColourRange(0.0, 1.0))).any()
    assert (preview(depth, META, ColourRange(0.0, 1.0))[4:] != preview(depth, META, ColourRange(0.0, 2.0))[4:]).any()


@examples(50)
@given(lo=st.floats(-1e30, 1e30), span=st.one_of(st.just(0.0), st.floats(0, 1e30)), width=st.integers(1, 200))
def test_preview_draws_any_range_within_its_sheet(lo, span, width):
    """The margin of the legend stays white: no number leaves the sheet."""
    sheet = preview(np.full((2, width), lo, np.float32), META, ColourRange(lo, lo + span))
    assert (sheet[2:, :6] == 255).all()
    assert (sheet[2:, -6:] == 255).all()


def test_preview_refuses_a_range_out_of_order():
    for lo, hi in ((2.0, 1.0), (0.0, math.nan), (0.0, math.inf)):
        with pytest.raises(ValueError, match="low <= high must be finite"):
            ColourRange(lo, hi)


def test_colours_follow_inverse_depth_where_most_depths_are_near():
    """Closed form: depths with even steps of 1 / depth have even steps of colour; the ends are the same."""
    depth = 1.0 / np.linspace(1.0, 0.01, 900)[None]
    far = ColourRange.of_depths(*np.quantile(depth, (0.0, 0.5, 1.0)).tolist())
    assert (far.low, far.high, far.inverse) == (1.0, pytest.approx(100.0), True)
    np.testing.assert_allclose(far.positions(depth)[0], np.linspace(0, 1, 900), atol=1e-12)
    np.testing.assert_allclose([far.at(place) for place in np.linspace(0, 1, 900)], depth[0], rtol=1e-12)
    assert (preview(depth, META, far)[2:] != preview(depth, META, ColourRange(1.0, 100.0))[2:]).any()
    for low, median, high in ((1.0, 3.0, 6.0), (-1.0, 0.0, 100.0), (0.0, 1.0, 100.0), (2.0, 2.0, 2.0)):
        assert not ColourRange.of_depths(low, median, high).inverse


@pytest.mark.parametrize("colour_map", COLOUR_MAPS)
def test_false_colours_are_those_of_matplotlib(colour_map):
    depth = np.linspace(0, 1, 256, dtype=np.float32).repeat(2)[None]
    expected = colormaps[COLOUR_MAPS[colour_map]](np.arange(256))[:, :3] * 255
    assert np.abs(coloured(depth, ColourRange(0.0, 1.0), colour_map)[0, ::2] - expected).max() <= 0.5


@examples(100)
@given(
    lists=st.lists(st.lists(st.floats(width=32) | st.floats(1, 1 + 2**-10, width=32), max_size=30), max_size=5),
    fractions=st.lists(st.floats(0, 1), min_size=1, max_size=5),
)
def test_quantiles_are_those_of_sorted_values(lists, fractions):
    """Any floats, NaN and infinities among them, of any sign and size, and some with the same upper 16 bits."""
    maps = [np.array(values, np.float32) for values in lists]
    values = np.concatenate([np.empty(0, np.float32), *maps])
    finite = np.sort(values[np.isfinite(values)])
    found = quantiles(lambda: maps, fractions)
    if finite.size == 0:
        assert found == []
        return
    assert found == [finite[max(int(np.ceil(fraction * finite.size)) - 1, 0)] for fraction in fractions]
