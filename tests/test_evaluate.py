"""Metrics against closed forms and a direct call of scikit-image; the protocol on a model that is known exactly."""

import hashlib
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from examples import examples
from fog import fog, foggy_cells
from hypothesis import given
from hypothesis import strategies as st
from pools import pool_of_photos
from present import present
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity, look_at
from nerfcli.errors import BAD_INPUT, UserError
from nerfcli.evaluate.metrics import Metrics, psnr, ssim, whole_windows
from nerfcli.evaluate.photos import HeldOutPhoto, held_out_photos
from nerfcli.evaluate.protocol import PhotoMetrics, evaluate_model, outlier_warnings, outliers
from nerfcli.field.exposure import exposed
from nerfcli.photos.colours import over_white, to_8_bit
from nerfcli.photos.images import write_png
from nerfcli.training.checkpoints import HeldoutPixels
from nerfcli.training.runs.run import Run

EVERYTHING = np.ones((24, 32), dtype=bool)
# A grid without occupied cells: only the background is seen.
NOWHERE = torch.zeros(4, 4, 4, dtype=torch.bool)


def noise(seed: int, shape: tuple[int, ...] = (24, 32, 3)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)


def test_psnr_of_a_constant_error_in_closed_form():
    """The lower level is 0, so that differences of 8-bit levels would wrap around."""
    black = np.zeros((24, 32, 3), dtype=np.uint8)
    for level in (1, 51, 255):
        for pair in ((black + np.uint8(level), black), (black, black + np.uint8(level))):
            assert psnr(*pair, used=EVERYTHING) == pytest.approx(-20 * math.log10(level / 255))


def test_psnr_counts_used_pixels_only():
    picture, used = noise(0), np.zeros((24, 32), dtype=bool)
    used[3:5, 7] = True
    photo = noise(1)
    photo[used] = picture[used]
    photo[3, 7, 0] ^= 1
    assert psnr(picture, photo, used=used) == pytest.approx(10 * math.log10(255**2 * 6))


def test_psnr_and_ssim_are_those_of_torchmetrics():
    rng = np.random.default_rng(0)
    photo = rng.uniform(0.2, 0.8, (40, 30, 3))
    picture = (photo + rng.normal(0, 0.05, photo.shape)).clip(0, 1)
    one, other = (torch.from_numpy(p).permute(2, 0, 1)[None] for p in (picture, photo))
    used = np.ones((40, 30), dtype=bool)
    # The mean that it returns itself includes windows that extend beyond the border.
    full: Any = structural_similarity_index_measure(one, other, data_range=1.0, return_full_image=True)[1]
    assert ssim(picture, photo, used=used) == pytest.approx(float(full[0, :, 5:-5, 5:-5].mean()), abs=1e-12)
    assert psnr(picture, photo, used=used) == pytest.approx(float(peak_signal_noise_ratio(one, other, data_range=1.0)))


def test_ssim_leaves_out_every_window_that_holds_a_masked_pixel():
    # What is behind the mask changes nothing, and a picture cut along the mask has the same windows.
    picture, photo = noise(0, (30, 40, 3)), noise(1, (30, 40, 3))
    used = np.ones((30, 40), dtype=bool)
    used[:, 25:] = False
    other = photo.copy()
    other[:, 25:] = 0
    expected = ssim(picture[:, :25], photo[:, :25], used=used[:, :25])
    assert ssim(picture, photo, used=used) == pytest.approx(expected, abs=1e-12)
    assert ssim(picture, other, used=used) == pytest.approx(expected, abs=1e-12)
    assert whole_windows(used).sum() == (30 - 10) * (25 - 10)


def test_ssim_without_a_whole_window_is_not_known():
    used = np.ones((24, 32), dtype=bool)
    used[::8, ::8] = False
    assert ssim(noise(0), noise(1), used=used) is None


def test_ssim_of_two_flat_pictures_in_closed_form():
    # No variance anywhere: (2 a b + C1) / (a^2 + b^2 + C1), C1 = 0.01^2.
    flat = [np.full((24, 32, 3), level, dtype=np.uint8) for level in (51, 102)]
    expected = (2 * 0.2 * 0.4 + 1e-4) / (0.2**2 + 0.4**2 + 1e-4)
    assert ssim(*flat, used=EVERYTHING) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("shape", [(1, 1, 3), (2, 5, 3), (3, 3, 3), (4, 9, 3), (10, 40, 3), (11, 11, 3)])
def test_ssim_of_pictures_smaller_than_its_window(shape):
    used = np.ones(shape[:2], dtype=bool)
    assert ssim(noise(0, shape), noise(0, shape), used=used) == 1
    assert -1 <= present(ssim(noise(0, shape), noise(1, shape), used=used)) < 1


def test_8_bit_rounds_to_the_nearest_level_and_clips():
    levels = np.arange(256)
    assert np.array_equal(to_8_bit(levels / 255), levels)
    assert np.array_equal(to_8_bit(np.array([-1.0, 0.4999 / 255, 0.5001 / 255, 1.5])), [0, 0, 1, 255])


def test_rgba_over_white_in_closed_form():
    pixels = np.array([[[10, 20, 30, 255], [10, 20, 30, 0], [0, 100, 255, 51]]], dtype=np.uint8)
    # 0.2 of the colour and 0.8 of 255 = 204.
    assert over_white(pixels).tolist() == [[[10, 20, 30], [255, 255, 255], [204, 224, 255]]]
    rgb = noise(0)
    assert np.array_equal(over_white(rgb), rgb)


def frame(name: str, width: int = 16, height: int = 12) -> Frame:
    pose = look_at(np.array([0.0, 0.0, -3.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    return Frame(name, Camera.pinhole(width, height, 16.0), pose)


def test_evaluation_of_an_empty_model_is_the_distance_to_its_background():
    # Photos without alpha are compared on the model's background (0.2 grey), photos with alpha on white.
    model = fog(NOWHERE, Similarity.identity(), background=(0.2, 0.2, 0.2))
    opaque = HeldOutPhoto(frame("a.png"), np.full((12, 16, 3), 102, dtype=np.uint8), None)
    clear = HeldOutPhoto(frame("b.png"), np.zeros((12, 16, 4), dtype=np.uint8), None)
    calls: list[tuple[int, int]] = []
    metrics = evaluate_model(model, [opaque, clear], on_image=lambda done, total: calls.append((done, total)))
    first, second = metrics.images
    assert (first.name, second.name) == ("a.png", "b.png")
    assert first.metrics.psnr == pytest.approx(-20 * math.log10(0.2))
    assert (second.metrics.psnr, second.metrics.ssim) == (100, 1)
    assert first.pixels == 12 * 16
    assert metrics.mean.psnr == pytest.approx((first.metrics.psnr + 100) / 2)
    assert metrics.mean.ssim == pytest.approx((present(first.metrics.ssim) + 1) / 2)
    assert calls[-1] == (2 * 12 * 16, 2 * 12 * 16)
    assert metrics.seconds_per_image > 0
    # White is saturated: photos on white give no colour correction.
    assert second.metrics.psnr_colour_aligned is None
    assert first.metrics.psnr_colour_aligned is not None


def test_a_photo_with_alpha_does_not_put_others_on_white(finished: Path, tmp_path: Path):
    """Regression: a transparent pixel in one held-out photo hid the learned sky behind all of them."""
    run, frames = Run(finished), []
    for name, alpha in (("a.png", 255), ("b.png", 254)):
        view = run.cameras.test[0]
        pixels = np.full((view.camera.height, view.camera.width, 4), 255, np.uint8)
        pixels[:8, :8, 3] = alpha
        write_png(tmp_path / name, pixels)
        frames.append(replace(view, name=name, image=tmp_path / name))
    assert [photo.pixels.shape[-1] for photo in held_out_photos(run, frames)] == [3, 4]


def test_the_gains_of_a_photo_are_applied_to_its_picture():
    model = fog(NOWHERE, Similarity.identity(), background=(0.2, 0.2, 0.2))
    pixels = np.full((12, 16, 3), 102, dtype=np.uint8)
    photo = HeldOutPhoto(frame("a.png"), pixels, None, log_gains=(0.1, 0.1, 0.1), gains_from="their mean")
    (entry,) = evaluate_model(model, [photo]).images
    given = round(255 * float(exposed(torch.tensor(0.2), torch.tensor(0.1))))
    assert entry.metrics.psnr == pytest.approx(-20 * math.log10(0.4 - given / 255))
    assert entry.exposure == {"from": "their mean", "log_gains": [0.1, 0.1, 0.1]}


@pytest.mark.parametrize("gain", [0.0, -0.7])
def test_evaluation_of_fog_in_closed_form(gain):
    """Straight through a cube of side 2 with density 1: opacity 1 - exp(-2) of colour 1/2 on white.

    Gains apply to the fog and not to the white.
    """
    model = fog(foggy_cells((-1, -1, -1), (1, 1, 1)), Similarity.identity(), background=(1.0, 1.0, 1.0))
    shown = float(exposed(torch.tensor(0.5), torch.tensor(gain)))
    seen = shown * (1 - math.exp(-2)) + math.exp(-2)
    narrow = Frame("a", Camera.pinhole(3, 3, 3000.0), frame("a").world_from_cam)
    photo = HeldOutPhoto(narrow, np.zeros((3, 3, 4), dtype=np.uint8), None, log_gains=(gain,) * 3)  # white
    error, unrounded = 1 - round(255 * seen) / 255, 1 - seen
    metrics = evaluate_model(model, [photo])
    assert metrics.images[0].metrics.psnr == pytest.approx(-20 * math.log10(error))
    assert metrics.images[0].metrics.psnr_float == pytest.approx(-20 * math.log10(unrounded), abs=1e-3)
    pixels = pool_of_photos([photo])
    measured = HeldoutPixels(pixels).psnr(model, log_gains=np.full((1, 3), gain))
    assert measured == pytest.approx(-20 * math.log10(unrounded), abs=1e-3)


def test_masked_pixels_do_not_count():
    model = fog(NOWHERE, Similarity.identity(), background=(0.0, 0.0, 0.0))
    pixels, used = noise(0, (12, 16, 3)), np.zeros((12, 16), dtype=bool)
    used[4, 5] = True
    pixels[4, 5] = 51
    metrics = evaluate_model(model, [HeldOutPhoto(frame("a"), pixels, used)])
    assert metrics.images[0].metrics.psnr == pytest.approx(-20 * math.log10(0.2))
    assert (metrics.images[0].pixels, metrics.images[0].masked_pixels) == (1, 12 * 16 - 1)
    assert metrics.images[0].whole_windows == 0
    assert metrics.mean.ssim is None


def test_a_photo_that_its_mask_hides_is_left_out_and_named():
    """Regression: the evaluation of a run failed because of a single black mask."""
    model, pixels = fog(NOWHERE, Similarity.identity()), noise(0, (12, 16, 3))
    seen = HeldOutPhoto(frame("a.png"), pixels, None)
    hidden = HeldOutPhoto(frame("b.png"), pixels, np.zeros((12, 16), dtype=bool))
    metrics = evaluate_model(model, [seen, hidden])
    assert [image.name for image in metrics.images] == ["a.png"]
    assert metrics.protocol.startswith("nerfcli-2: 1 held-out photos")
    assert metrics.warnings == ("1 held-out photo hidden by masks and not compared: b.png",)
    with pytest.raises(UserError, match="no pixels of the photos are left to compare"):
        evaluate_model(model, [hidden])


def test_protocol_says_what_was_measured():
    model = fog(NOWHERE, Similarity.identity())
    photos = [HeldOutPhoto(frame(name), np.zeros((12, 16, 4), dtype=np.uint8), None) for name in ("x.png", "y.png")]
    protocol = evaluate_model(model, photos).protocol
    names = hashlib.sha256(b"x.png\ny.png").hexdigest()[:12]
    assert protocol.startswith(f"nerfcli-2: 2 held-out photos (names sha256 {names}) at 16x12, area-averaged")
    assert "RGBA on white" in protocol
    small = HeldOutPhoto(frame("x.png", 8, 6), np.zeros((6, 8, 3), dtype=np.uint8), None)
    protocol = evaluate_model(model, [small]).protocol
    assert "1 held-out photos" in protocol
    assert "at 8x6" in protocol
    assert "RGBA" not in protocol


def test_nothing_held_out_is_reported():
    with pytest.raises(UserError, match="no held-out photos to evaluate on") as caught:
        evaluate_model(fog(NOWHERE, Similarity.identity()), [])
    assert caught.value.exit_code == BAD_INPUT


# Photos far below the others: named where they stand out, silent at ordinary spread


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
    model = fog(NOWHERE, Similarity.identity(), background=(0.2, 0.2, 0.2))
    held_out = [
        HeldOutPhoto(frame(f"{index}.png"), np.full((12, 16, 3), level, np.uint8), None)
        for index, level in enumerate((70, 72, 74, 76, 78, 250))
    ]
    metrics = evaluate_model(model, held_out)
    assert len(metrics.warnings) == 1
    assert "5.png" in metrics.warnings[0]
    assert evaluate_model(model, held_out[:5]).warnings == ()
