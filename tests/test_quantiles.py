"""nerfcli.render.presentation: exact order statistics of data that do not fit in memory."""

import numpy as np
import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st

from nerfcli.render.files.depth_files import quantiles

FRACTIONS = (0.0, 0.01, 0.5, 0.99, 1.0)


@examples(100)
@given(
    lists=st.lists(st.lists(st.floats(width=32), max_size=30), max_size=5),
    fraction=st.floats(0, 1),
)
def test_quantiles_are_those_of_sorted_values(lists, fraction):
    """Any floats, NaN and infinities among them, of any sign and size; NumPy's inverted_cdf is the same definition."""
    maps = [np.array(values, np.float32) for values in lists]
    values = np.concatenate([np.empty(0, np.float32), *maps])
    finite = np.sort(values[np.isfinite(values)])
    found = quantiles(lambda: maps, [fraction, fraction])
    if finite.size == 0:
        assert found == []
        return
    expected = finite[max(int(np.ceil(fraction * finite.size)) - 1, 0)]
    assert found == [expected, expected]


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_quantiles_of_many_maps_are_numpys(scale):
    rng = np.random.default_rng(0)
    maps = [(scale * rng.normal(1, 2, (50, 40))).astype(np.float32) for _ in range(20)]
    maps[3][:20] = np.nan
    values = np.concatenate([m[np.isfinite(m)] for m in maps])
    assert quantiles(lambda: iter(maps), FRACTIONS) == np.quantile(values, FRACTIONS, method="inverted_cdf").tolist()
