"""benchmarks/colour_capture.py: the colours of photos are changed exactly as the file beside them says."""

import numpy as np
import pytest
import torch
from colour_capture import MATRICES, developed, truths

from nerfcli.field.exposure import exposed, linear_from_srgb, srgb_from_linear

LIGHT = np.random.default_rng(0).uniform(0.01, 1.0, (30, 41, 3))


def test_a_photo_without_effects_is_as_it_was():
    (truth,) = truths(1, effects=())
    np.testing.assert_allclose(developed(LIGHT, truth), LIGHT, rtol=1e-12)


def test_gains_are_those_that_the_model_learns():
    truth = truths(5, effects=("gains",))[4]
    levels = srgb_from_linear(torch.from_numpy(LIGHT))
    expected = linear_from_srgb(exposed(levels, torch.tensor(truth["log_gains"], dtype=torch.float64))).numpy()
    np.testing.assert_allclose(developed(LIGHT, truth), expected, rtol=1e-5)


def test_contrast_leaves_middle_grey_matrices_every_grey_and_vignetting_the_middle():
    contrast, matrix, vignetting = (truths(2, effects=(name,))[1] for name in ("contrast", "matrix", "vignetting"))
    middle = np.full_like(LIGHT, 0.18)
    np.testing.assert_allclose(developed(middle, contrast), middle)
    np.testing.assert_allclose(developed(2.0 * middle, contrast), 2.0**1.2 * middle)
    grey = np.repeat(LIGHT[..., :1], 3, axis=2)
    np.testing.assert_allclose(developed(grey, matrix), grey)
    assert MATRICES.sum(-1) == pytest.approx(np.ones((3, 3)))
    darker = developed(middle, vignetting) / middle
    assert darker[15, 20] == pytest.approx(np.ones(3), abs=1e-3)
    assert darker[0, 0] == pytest.approx(np.full(3, 0.6), abs=0.03)  # 1 - 0.3 - 0.1 in the corner
