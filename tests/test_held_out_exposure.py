"""Exposures of held-out photos from neighbouring photos: closed forms, and storing them in a run and using them."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_exposure_and_background import save_photo
from trainings import FEW, fit

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import from_parts
from nerfcli.captures.capture import Capture
from nerfcli.photos.held_out_exposure import (
    PhotoExposures,
    exif_slope,
    gain_sources,
    gains_between,
    gains_beyond_exif,
    log_gains_of,
)
from nerfcli.training.runs.components import Components
from nerfcli.training.runs.run import Run


def drifting(places: np.ndarray) -> np.ndarray:
    """Return (N, 3) gains that are linear in the place, with a slope per channel."""
    return places[:, None] * np.array([0.1, 0.05, -0.02]) - 0.3


def test_gains_that_drift_are_those_between_the_neighbours_and_of_the_last_beyond():
    places = np.array([0, 1, 2, 4, 5, 6, 8])
    wanted = np.array([3, 7, 9])
    reported = gains_between(places, drifting(places), wanted)
    assert reported == pytest.approx(drifting(np.array([3.0, 7.0, 8.0])), abs=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_gains_without_evidence_are_set_to_the_mean(seed):
    """The mean squared error for independent gains is 1.5 variances from two neighbours, and 1 from the mean."""
    gains = np.random.default_rng(seed).normal(size=(60, 3))
    places = np.arange(60) * 2
    assert np.array_equal(gains_between(places, gains - gains.mean(0), np.array([1, 7, 119])), np.zeros((3, 3)))


@pytest.mark.parametrize("slope", [0.6, 1.0])
def test_gains_follow_exif_as_far_as_the_tone_curve_lets_them(slope):
    rng = np.random.default_rng(0)
    exif = rng.permutation(np.linspace(-1, 1, 12))
    gains = slope * exif[:, None] + 0.3 + rng.normal(0, 0.02, (12, 3))
    assert exif_slope(np.arange(12), gains, exif) == pytest.approx(slope, abs=0.03)
    unknown = np.append(exif, np.nan)
    assert exif_slope(np.arange(13), np.append(gains, [[5.0] * 3], axis=0), unknown) == pytest.approx(slope, abs=0.03)


def test_exif_that_predicts_worse_than_neighbours_or_the_mean_is_not_used():
    places, rng = np.arange(40), np.random.default_rng(1)
    exif = rng.normal(size=40)
    assert exif_slope(places, rng.normal(size=(40, 3)), exif) == 0.0
    assert exif_slope(places, drifting(places.astype(float)), exif) == 0.0
    assert exif_slope(places, drifting(places.astype(float)), np.zeros(40)) == 0.0
    assert exif_slope(places[:2], np.ones((2, 3)), exif[:2]) == 1.0  # nothing to judge by


def test_gains_follow_exif_and_drift_beyond_it_as_those_of_the_photos_around():
    """Exposures jump, and gains drift along the capture in each channel: their sum is predicted within 0.02."""
    places, wanted = np.arange(0, 60, 2), np.array([1, 21, 47])
    rng = np.random.default_rng(2)
    exif, held_out = rng.choice([-0.4, 0.0, 0.4], 30), np.array([0.4, -0.4, 0.0])
    drift = np.sin(places / 10.0)[:, None] * np.array([0.3, 0.2, 0.1])
    gains = 0.8 * (exif - exif.mean())[:, None] + drift
    slope = exif_slope(places, gains, exif)
    assert slope == pytest.approx(0.8, abs=0.01)  # over all photos 0.82, as drift and jumps are correlated by chance
    offsets = gains_beyond_exif(places, gains, exif, wanted, slope=slope)
    predicted = slope * (held_out - exif.mean())[:, None] + offsets
    truth = 0.8 * (held_out - exif.mean())[:, None] + np.sin(wanted / 10.0)[:, None] * np.array([0.3, 0.2, 0.1])
    assert np.abs(predicted - truth).max() < 0.02
    by_exif = 0.8 * (held_out - exif.mean())[:, None]
    around = gains_between(places, gains, wanted)
    assert np.abs(by_exif - truth).max() > 0.2
    assert np.abs(around - truth).max() > 0.2


def test_exif_counts_if_it_predicts_gains_only_together_with_the_photos_around():
    """The drift is three times as large as the jumps: EXIF alone is worse than the neighbours, both together better."""
    places, rng = np.arange(60), np.random.default_rng(4)
    exif = rng.permutation(np.repeat([-0.2, 0.2], 30))
    drift = np.sin(places / 10.0)[:, None] * np.full(3, 0.6)
    assert exif_slope(places, exif[:, None] + drift, exif) == pytest.approx(1.0, abs=0.05)
    assert exif_slope(places, drift, rng.permutation(exif)) == 0.0


@pytest.mark.parametrize("places", [[0, 1, 2, 3, 4, 5, 6, 7], [0, 1, 4, 5, 9, 10, 11, 15]])
def test_the_slope_over_exif_is_exact_beside_a_drift_that_is_linear_in_the_place(places):
    """The photos before and after predict such a drift; the jumps are not those of the first or the last photo."""
    jumps = np.array([0, 0, 1, -1, 1, 1, 0, 0]) / 3.0
    gains = 0.6 * jumps[:, None] + drifting(np.array(places))
    assert exif_slope(np.array(places), gains, jumps) == pytest.approx(0.6, abs=1e-12)


@pytest.mark.parametrize("seed", range(60))
def test_one_exposure_in_exif_explains_no_drift(seed):
    """Interpolation between places that are not evenly spaced leaves rounding errors of it."""
    places = np.array([place for place in range(16) if place % 8 != 4])
    gains = np.cumsum(np.random.default_rng(seed).normal(0, 0.1, (14, 3)), axis=0)
    assert exif_slope(places, gains - gains.mean(0), np.full(14, math.log(1 / 125 * 100 / 16))) == 0.0


@pytest.mark.parametrize("seed", range(10))
def test_noise_beyond_exif_is_not_interpolated(seed):
    rng = np.random.default_rng(seed)
    exif = rng.normal(size=40)
    gains = exif[:, None] + rng.normal(0, 0.05, (40, 3))
    beyond = gains_beyond_exif(np.arange(40), gains, exif, np.array([7, 12]), slope=1.0)
    assert np.array_equal(beyond, np.zeros((2, 3)))


def test_photos_without_exif_take_no_part_in_what_is_beyond_it():
    places = np.arange(9)
    exif = np.where(places == 4, np.nan, 0.0)
    gains = drifting(places.astype(float))
    gains[4] = 100.0
    offsets = gains_beyond_exif(places, gains, exif, np.array([4]), slope=0.7)
    assert offsets == pytest.approx(drifting(np.array([4.0])), abs=1e-12)
    nothing = gains_beyond_exif(places, gains, np.full(9, np.nan), np.array([4]), slope=0.0)
    assert np.array_equal(nothing, np.zeros((1, 3)))


def test_two_photos_give_no_estimate_and_are_refused():
    assert np.array_equal(gains_between(np.array([0, 2]), np.ones((2, 3)), np.array([1])), np.zeros((1, 3)))
    assert gains_between(np.arange(4), drifting(np.arange(4.0)), np.zeros(0)).shape == (0, 3)


def trained(scene: Capture, run: Path, *, exposure: str) -> PhotoExposures:
    """Return the exposures that a short training finds."""
    settings = replace(FEW, steps=150, log2_rows=8, threads=1, components=Components(exposure=exposure))
    fit(scene, run, replace(settings, first_samples_per_step=2**10, samples_per_step=2**10))
    return Run(run).cameras.exposures


def in_a_row(folder: Path, levels: list[int], *, held_out: int, seconds: list[float] | None = None) -> Capture:
    """Return a capture of grey photos with little noise, beside each other, some with an exposure time in EXIF."""
    frames = []
    for index, level in enumerate(levels):
        path, speckle = folder / f"{index}.png", np.random.default_rng(index).integers(-3, 4, (12, 16, 1))
        pixels = np.repeat(level + speckle, 3, axis=2).astype(np.uint8)
        if seconds is None:
            Image.fromarray(pixels).save(path)
        else:
            save_photo(path, pixels, seconds=seconds[index])
        pose = from_parts(np.eye(3), np.array([0.1 * index, 0.0, -2.0]))
        frames.append(Frame(path.name, Camera.pinhole(16, 12, 14.0), pose, path))
    return Capture(tuple(frames), kind="colmap", root=folder, test_names=frozenset({f"{held_out}.png"}))


def test_training_estimates_exposures_of_held_out_photos_without_opening_them(tmp_path: Path):
    """Grey photos become brighter one by one; the last but one is held out and nearly black. Its gains are nevertheless
    between those of its neighbours, which are brighter than the mean."""
    scene = in_a_row(tmp_path, [10 if index == 7 else 60 + 12 * index for index in range(9)], held_out=7)
    known = trained(scene, tmp_path / "run", exposure="learned")
    assert set(known.exposures) == {"7.png"}
    reported = log_gains_of(scene.test_frames, known)
    assert reported.tolist() == [known.exposures["7.png"]]
    assert reported.mean() == pytest.approx(log_ratio(144, 107), rel=0.3)
    assert log_gains_of(scene.train_frames, known) == pytest.approx(np.zeros((8, 3)))  # there is no EXIF


@pytest.mark.parametrize("exposure", ["matched", "learned"])
def test_a_run_keeps_the_offset_to_exif_of_held_out_photos(tmp_path: Path, exposure: str):
    """Exposures jump as EXIF says, and also rise along the capture, which EXIF does not explain.

    These photos of plain walls have no matched pixels: with exposure=matched, all are learned, too.
    """
    drift, jumps = np.linspace(-0.5, 0.5, 13), np.array([1, -1, -1, 1, 1, -1, 1, 1, -1, -1, 1, -1, 1]) * 0.25
    levels = np.rint(255 * (1.055 * (0.15 * np.exp(drift + jumps)) ** (1 / 2.4) - 0.055)).astype(int)
    levels[9] = 10
    scene = in_a_row(tmp_path, levels.tolist(), held_out=9, seconds=(np.exp(jumps) / 100).tolist())
    known = trained(scene, tmp_path / "run", exposure=exposure)
    assert gain_sources(scene.test_frames, known) == ["EXIF and training photos around"]
    assert set(known.beyond_exif) == {"9.png"}
    assert np.mean(known.beyond_exif["9.png"]) == pytest.approx(drift[9], abs=0.12)
    assert log_gains_of(scene.test_frames, known).mean() == pytest.approx(drift[9] + jumps[9], abs=0.15)


def test_exif_of_a_held_out_photo_takes_precedence_over_its_neighbours(monkeypatch):
    """EXIF has the exposure of one photo only; a model without a mean exposure does not use it."""
    frames = [Frame(name, Camera.pinhole(4, 4, 4.0), np.eye(4)) for name in ("a", "b", "c")]
    of_exif = np.array([1.5, np.nan, np.nan])
    monkeypatch.setattr("nerfcli.photos.held_out_exposure.log_exposures", lambda frames: of_exif[: len(frames)])
    around = {"a": (9.0, 9.0, 9.0), "b": (0.1, 0.2, 0.3)}
    known = PhotoExposures(log_exposure=1.0, exposures=around)
    assert log_gains_of(frames, known).tolist() == [[0.5] * 3, [0.1, 0.2, 0.3], [0.0] * 3]
    assert gain_sources(frames, known) == ["EXIF", "training photos around", "their mean"]
    flatter = replace(known, exif_slope=0.6)
    assert log_gains_of(frames, flatter).tolist()[:2] == [[pytest.approx(0.3)] * 3, [0.1, 0.2, 0.3]]
    beyond = replace(flatter, beyond_exif={"a": (0.1, 0.0, -0.1), "b": (5.0, 5.0, 5.0)})
    assert log_gains_of(frames, beyond)[0].tolist() == pytest.approx([0.4, 0.3, 0.2])
    assert log_gains_of(frames, beyond)[1].tolist() == [0.1, 0.2, 0.3]
    sources = ["EXIF and training photos around", "training photos around", "their mean"]
    assert gain_sources(frames, beyond) == sources
    for unused in (replace(beyond, exif_slope=0.0), PhotoExposures(exposures=around)):
        assert log_gains_of(frames, unused).tolist()[0] == [9.0] * 3
        assert gain_sources(frames, unused)[0] == "training photos around"
    assert gain_sources(frames, PhotoExposures()) == ["none"] * 3


def log_ratio(one: int, other: int) -> float:
    """Return the log ratio of two levels in linear light."""
    return float(np.log(((one / 255 + 0.055) / (other / 255 + 0.055)) ** 2.4))
