"""Exposures from pixels that photos have in common, on photos whose gains are known."""

import numpy as np
import pytest
from test_stereo import OFFSETS, PINHOLE, photo, truth

from nerfcli.matching.exposures import matched_log_gains
from nerfcli.matching.stereo import DenseDepth
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.training.evidence import Evidence, confirmed_by_exif

GAINS = np.array([[0.0, 0.1, -0.1], [0.4, 0.4, 0.4], [-0.5, -0.4, -0.3], [0.1, -0.1, 0.0]])
NOTHING = DenseDepth(np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0))


def exposed(one: LoadedPhoto, log_gains: np.ndarray) -> LoadedPhoto:
    """Return the same photo with other gains in linear light."""
    light = ((one.pixels / 255 + 0.055) / 1.055) ** 2.4 * np.exp(log_gains)
    levels = 255 * (1.055 * light ** (1 / 2.4) - 0.055)
    return LoadedPhoto(one.frame, np.clip(np.rint(levels), 0, 255).astype(np.uint8), None)


def depth(one: LoadedPhoto) -> DenseDepth:
    """Return the true depth of every second pixel of every second row."""
    rows, columns = (axis.ravel() for axis in np.mgrid[:150:2, :200:2])
    distances = truth(PINHOLE, one.frame.world_from_cam)[0][rows, columns]
    return DenseDepth(np.stack([columns, rows], axis=-1), distances, np.full(len(rows), 0.01))


def test_gains_are_found_to_a_hundredth():
    photos = [exposed(photo(x, contrast=1.5), gains) for x, gains in zip(OFFSETS, GAINS, strict=True)]
    found = matched_log_gains(photos, [depth(one) for one in photos])
    assert found == pytest.approx(GAINS - GAINS.mean(0), abs=0.02)
    assert found.mean(0) == pytest.approx(np.zeros(3), abs=1e-3)


def test_photos_that_share_nothing_have_no_gains():
    photos = [exposed(photo(x, contrast=1.5), gains) for x, gains in zip(OFFSETS, GAINS, strict=True)]
    depths = [depth(one) for one in photos]
    found = matched_log_gains(photos, [*depths[:3], NOTHING])
    assert np.isfinite(found).all(axis=1).tolist() == [True, True, True, False]
    assert found[:3] == pytest.approx(GAINS[:3] - GAINS[:3].mean(0), abs=0.02)
    for few in ([NOTHING] * 4, [NOTHING] * 3 + depths[3:]):
        assert np.isnan(matched_log_gains(photos, few)).all()
    assert np.isnan(matched_log_gains(photos[:1], depths[:1])).all()


def test_white_pixels_give_no_evidence():
    white = exposed(photo(0.0), np.full(3, 5.0))
    photos = [white, *(photo(x) for x in OFFSETS[1:3])]
    found = matched_log_gains(photos, [depth(one) for one in photos])
    assert np.isnan(found[0]).all()
    assert found[1:] == pytest.approx(np.zeros((2, 3)), abs=0.02)


@pytest.mark.parametrize(
    ("exif", "is_kept"),
    [
        ([-0.6, 0.6, -0.3, 0.3, 0.0, 0.1], True),
        ([0.0] * 6, False),
        ([np.nan] * 6, False),
        ([0.6, -0.6, 0, 0.3, 0, 0], False),
    ],
    ids=["confirms", "all alike", "unknown", "contradicts"],
)
def test_exposures_count_where_exif_confirms_them(exif, is_kept):
    """EXIF has to confirm them because shiny surfaces differ from photo to photo, too."""
    gains = [-0.6, 0.6, -0.3, 0.3, 0.0, 0.1]
    photos = [exposed(photo(0.12 * k, contrast=1.5), np.full(3, gain)) for k, gain in enumerate(gains)]
    found = matched_log_gains(photos, [depth(one) for one in photos])
    assert found.mean(1) == pytest.approx(np.array(gains) - np.mean(gains), abs=0.03)
    confirmed = confirmed_by_exif(found, np.array(exif))
    assert np.isfinite(confirmed).all() == is_kept
    spread = Evidence(may_match=True, log_gains=confirmed).exposure_spread
    assert spread == pytest.approx(np.std(gains) if is_kept else 0.0, abs=0.03)
