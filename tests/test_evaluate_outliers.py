"""Held-out photos far below the others: named where they stand out, silent at ordinary spread."""

import numpy as np
import pytest
import torch
from examples import examples
from fog import fog
from hypothesis import given
from hypothesis import strategies as st

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, look_at
from nerfcli.evaluate.metrics import Metrics
from nerfcli.evaluate.photos import HeldOutPhoto
from nerfcli.evaluate.protocol import PhotoMetrics, evaluate_model, outlier_warnings, outliers


def images(*psnrs: float) -> list[PhotoMetrics]:
    return [PhotoMetrics(f"{index}.jpg", Metrics(psnr)) for index, psnr in enumerate(psnrs)]


def names(*psnrs: float) -> list[str]:
    return [image.name for image in outliers(images(*psnrs))]


def test_a_photo_far_below_the_others_is_named():
    """The numbers of a capture whose group of photos stood on the wrong side of the object."""
    psnrs = (24.1, 25.0, 26.9, 25.7, 23.5, 26.1, 25.9, 25.2, 26.4, 24.8, 11.3, 25.7, 26.0)
    assert names(*psnrs) == ["10.jpg"]
    (text,) = outlier_warnings(images(*psnrs))
    assert "10.jpg (11.3 dB)" in text
    assert "25.7 dB" in text
    assert "nerfcli doctor SCENE" in text


@pytest.mark.parametrize(
    "psnrs",
    [
        (25.0, 25.1, 24.9, 25.0, 25.05, 20.0),  # equal but for one, yet it lacks only 5 dB
        (30.0, 26.0, 22.0, 18.0, 14.0, 10.0, 6.0),  # as spread as views of a large scene
        (25.0, 25.2, 24.8, 25.1, 12.0, 11.0),  # a third of them is no exception
        (25.0, 25.0, 25.0, 10.0),  # too few to know what is usual
        (25.0, 25.0, 25.0, 25.0, 100.0),  # only low ones count
    ],
)
def test_ordinary_spread_gives_no_warning(psnrs):
    assert outlier_warnings(images(*psnrs)) == []


@examples(40)
@given(st.integers(0, 2**32 - 1), st.integers(5, 60), st.floats(0.1, 3.0))
def test_photos_of_normal_spread_are_named_only_beyond_five_deviations(seed, count, deviation):
    values = np.random.default_rng(seed).uniform(25 - 2 * deviation, 25 + 2 * deviation, count)
    # At most 4 deviations of the uniform range from the median, of which the floor of 6 dB hides half.
    low = outliers(images(*values))
    median = float(np.median(values))
    spread = float(np.median(np.abs(values - median)))
    assert all(image.metrics.psnr < median - max(6.0, 7.413 * spread) for image in low)


def test_evaluation_warns_of_a_photo_that_shows_something_else():
    model = fog(torch.zeros(4, 4, 4, dtype=torch.bool), Similarity.identity(), background=(0.2, 0.2, 0.2))
    pose = look_at(np.array([0.0, 0.0, -3.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    frames = [Frame(f"{index}.png", Camera.pinhole(16, 12, 16.0), pose) for index in range(6)]
    held_out = [
        HeldOutPhoto(frame, np.full((12, 16, 3), level, np.uint8), None)
        for frame, level in zip(frames, (70, 72, 74, 76, 78, 250), strict=True)
    ]
    metrics = evaluate_model(model, held_out)
    assert len(metrics.warnings) == 1
    assert "5.png" in metrics.warnings[0]
    assert evaluate_model(model, held_out[:5]).warnings == ()
