"""What hides a surface in one photo, on textured walls with a disc of leaves painted into one of the photos."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from pools import pool_of_photos
from test_matched_exposures import exposed
from test_stereo import LENS, OFFSETS, PINHOLE, TEXTURE, found, photo, truth, written
from trainings import FEW, fit

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.rigid import Similarity
from nerfcli.captures.capture import Capture
from nerfcli.errors import UserError
from nerfcli.matching import occluders
from nerfcli.matching.occluders import occluder_masks
from nerfcli.matching.stereo import DenseDepth
from nerfcli.photos.images import read_image
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.training import preparation, schedule, selection
from nerfcli.training.fitting import TrainingInputs
from nerfcli.training.runs.components import Components
from nerfcli.training.runs.run import Run
from nerfcli.training.trials import Trials

SAME = Similarity(scale=1.0, rotation=np.eye(3), translation=np.zeros(3))
UNKNOWN = np.full((4, 3), np.nan)
DISC = cv2.circle(np.zeros((150, 200), np.uint8), (120, 70), 22, 1, -1) > 0


def walls(**of_photo) -> list[LoadedPhoto]:
    return [photo(x, contrast=1.5, **of_photo) for x in OFFSETS]


def painted(one: LoadedPhoto, where: np.ndarray, colours: np.ndarray) -> LoadedPhoto:
    return replace(one, pixels=np.where(where[..., None], colours, one.pixels).astype(np.uint8))


def leaves(seed: int = 5) -> np.ndarray:
    """Return green and yellow texture, (150, 200, 3)."""
    noise = np.random.default_rng(seed).uniform(0.2, 1.0, (150, 200)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 2)[..., None] * (160.0, 220.0, 30.0)


def known(one: LoadedPhoto, where: np.ndarray | None = None) -> DenseDepth:
    """Return the true depths of the walls in a photo, everywhere or where a mask is True."""
    distances = truth(one.frame.camera, one.frame.world_from_cam)[0]
    rows, columns = np.nonzero(np.ones(distances.shape, bool) if where is None else where)
    return DenseDepth(np.stack([columns, rows], axis=-1), distances[rows, columns], np.full(len(rows), 0.002))


def masks(photos: list[LoadedPhoto], dense: list[DenseDepth], *, log_gains=UNKNOWN, skies=None) -> list[np.ndarray]:
    none = [np.zeros(one.pixels.shape[:2], bool) for one in photos]
    return occluder_masks(photos, dense, none if skies is None else skies, log_gains[: len(photos)], threads=2)


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("hidden", range(len(OFFSETS)))
def test_what_one_photo_shows_in_front_of_the_walls_is_found(camera, hidden):
    """Depths are from stereo matching of the photos as they are."""
    photos = walls(camera=camera)
    photos[hidden] = painted(photos[hidden], DISC, leaves())
    for number, mask in enumerate(masks(photos, found(photos))):
        if number == hidden:
            assert mask[DISC].mean() > 0.8
            grown = cv2.dilate(DISC.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
            assert not mask[~grown].any()
        else:
            assert not mask.any()


def test_nothing_is_found_where_nothing_is_hidden():
    photos = walls()
    assert not np.any(masks(photos, found(photos)))
    assert not np.any(masks(photos, [known(one) for one in photos]))


@pytest.mark.parametrize("factor", [0.3, 1.8])
@pytest.mark.parametrize("contrast", [0.1, 1.0])
def test_light_on_a_surface_hides_nothing(factor, contrast):
    """A soft shadow or highlight, on surfaces with and without detail, whose depth it makes unknown."""
    weight = cv2.GaussianBlur(DISC.astype(np.float64), (0, 0), 6)[..., None]
    photos = [replace(one, pixels=(100 + contrast * (one.pixels - 128.0)).astype(np.uint8)) for one in walls()]
    lit = photos[0].pixels * (1.0 + weight * (factor - 1.0))
    photos[0] = replace(photos[0], pixels=np.clip(lit, 0, 255).astype(np.uint8))
    dense = [known(photos[0], ~DISC), *(known(one) for one in photos[1:])]
    assert not np.any(masks(photos, dense))


def test_photos_of_different_exposure_agree_if_the_exposures_are_known():
    """The disc has the colour of the wall, but noise for detail."""
    gains = np.array([[-1.5, -1.5, -1.5], [0.6, 0.6, 0.6], [0.3, 0.5, 0.4], [0.6, 0.6, 0.6]])
    noise = np.random.default_rng(3).normal(128, 30, (150, 200, 1))
    photos = walls()
    photos[0] = painted(photos[0], DISC, np.repeat(np.clip(noise, 0, 255), 3, axis=2))
    photos = [exposed(one, gain) for one, gain in zip(photos, gains, strict=True)]
    dense = [known(photos[0], ~DISC), *(known(one) for one in photos[1:])]
    assert not np.any(masks(photos, dense, log_gains=gains))
    assert masks(photos, dense)[0].any()


def test_sky_and_ignored_pixels_hide_nothing():
    photos = walls()
    photos[0] = painted(photos[0], DISC, leaves())
    dense = [known(photos[0], ~DISC), *(known(one) for one in photos[1:])]
    assert masks(photos, dense)[0].any()
    grown = cv2.dilate(DISC.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    none = np.zeros_like(grown)
    assert not np.any(masks(photos, dense, skies=[grown, none, none, none]))
    assert not np.any(masks([replace(photos[0], used=~grown), *photos[1:]], dense))
    clear = np.concatenate([photos[0].pixels, np.where(grown, 0, 255)[..., None].astype(np.uint8)], axis=-1)
    assert not np.any(masks([replace(photos[0], pixels=clear), *photos[1:]], dense))


def card(one: LoadedPhoto) -> tuple[LoadedPhoto, np.ndarray]:
    """Put a card in front of the walls, at z = 2; return the photo, and where it shows the card."""
    x, y = np.meshgrid(np.arange(200) + 0.5 - 100.0, np.arange(150) + 0.5 - 75.0)
    x, y = x / 180.0 * 2.0 + one.frame.centre[0], y / 180.0 * 2.0
    shown = (np.abs(x - 0.1) < 0.35) & (np.abs(y) < 0.3)
    texture = cv2.remap(
        TEXTURE, (150 * x + 200).astype(np.float32), (150 * y + 200).astype(np.float32), cv2.INTER_CUBIC
    )
    colours = np.clip(128 + 1.5 * (texture - 128), 0, 255)[..., None] * (0.9, 0.4, 0.2)
    return painted(one, shown, colours), shown


def test_an_object_whose_depth_is_known_in_part_is_kept():
    photos = walls()
    photos[0], shown = card(photos[0])
    behind = [known(one) for one in photos[1:]]
    assert masks(photos, [known(photos[0], ~shown), *behind])[0][shown].mean() > 0.9
    middle = np.median(np.nonzero(shown)[1])
    rows, columns = np.nonzero(shown & (np.arange(200) < middle))
    on_card = 2.0 / PINHOLE.pixel_bearings()[0].reshape(150, 200, 3)[rows, columns, 2]
    half = DenseDepth(np.stack([columns, rows], axis=-1), on_card, np.full(len(rows), 0.002))
    pairs = zip(vars(known(photos[0], ~shown)).values(), vars(half).values(), strict=True)
    assert not masks(photos, [DenseDepth(*(np.concatenate(pair) for pair in pairs)), *behind])[0].any()


def test_what_a_single_photo_knows_to_be_nearer_is_no_contradiction():
    photos = walls()
    (photos[0], own), (photos[1], shown) = card(photos[0]), card(photos[1])
    dense = [known(photos[0], ~own), known(photos[1], ~shown), *(known(one) for one in photos[2:])]
    assert masks(photos, dense)[0].any()
    rows, columns = np.nonzero(shown)
    on_card = 2.0 / PINHOLE.pixel_bearings()[0].reshape(150, 200, 3)[rows, columns, 2]
    dense[1] = DenseDepth(np.stack([columns, rows], axis=-1), on_card, np.full(len(rows), 0.002))
    assert not masks(photos, dense)[0].any()


def test_an_occluder_is_kept_where_its_outline_is_unknown():
    """Leaves cover the right half of a photo. Of the other photos, it is the left two thirds that have a depth."""
    columns = np.broadcast_to(np.arange(200), (150, 200))
    photos = walls()
    photos[0] = painted(photos[0], columns > 95, leaves())
    own, others = known(photos[0], columns <= 95), photos[1:]
    assert masks(photos, [own, *(known(one) for one in others)])[0][columns > 95].mean() > 0.9
    assert not masks(photos, [own, *(known(one, columns < 130) for one in others)])[0].any()


def test_a_photo_in_which_hardly_any_depth_is_found_is_not_judged():
    """Its pose may be wrong."""
    photos = walls()
    photos[0] = painted(photos[0], DISC, leaves())
    few = np.random.default_rng(0).random((150, 200)) < 0.02
    others = [known(one) for one in photos[1:]]
    assert masks(photos, [known(photos[0], ~DISC), *others])[0].any()
    assert not masks(photos, [known(photos[0], few & ~DISC), *others])[0].any()


@pytest.mark.filterwarnings("error")
def test_too_little_evidence_gives_empty_masks():
    photos = walls()
    photos[0] = painted(photos[0], DISC, leaves())
    dense = [known(photos[0], ~DISC), *(known(one) for one in photos[1:])]
    nothing = DenseDepth(np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0))
    vague = [replace(depth, errors=np.full(len(depth.errors), 2 * occluders.SAME_SURFACE)) for depth in dense]
    for some, depths in ((1, dense), (2, dense), (4, [nothing] * 4), (4, [dense[0], dense[1], nothing, nothing])):
        assert not np.any(masks(photos[:some], depths[:some]))
    assert not np.any(masks(photos, vague))


@pytest.mark.parametrize("is_masked", [False, True])
def test_a_pool_draws_no_pixel_that_is_left_out(is_masked):
    generator = np.random.default_rng(2)
    used = generator.random((150, 200)) < 0.5 if is_masked else None
    photos = [replace(one, used=used) for one in walls()[:2]]
    left_out = [generator.random((150, 200)) < 0.3, np.zeros((150, 200), bool)]
    pool = pool_of_photos(photos).without(left_out)
    wanted = [~mask if used is None else used & ~mask for mask in left_out]
    masked = [replace(one, used=mask) for one, mask in zip(photos, wanted, strict=True)]
    whole = pool_of_photos(masked)
    assert pool.usable is not None
    assert whole.usable is not None
    assert pool.usable.tolist() == whole.usable.tolist()
    drawn = pool.numbers(2000, torch.Generator().manual_seed(0))
    assert np.concatenate([mask.ravel() for mask in wanted])[drawn.numpy()].all()
    with pytest.raises(UserError, match="no pixels are left"):
        pool.without([np.ones((150, 200), bool)] * 2)


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """Six photos of the walls with the disc in front of the second one, and an odd one out that is held out."""
    photos = [photo(x, camera=Camera.pinhole(400, 300, 360.0), contrast=1.5) for x in np.linspace(-0.5, 0.5, 7)]
    large = [cv2.resize(part.astype(np.uint8), (400, 300), interpolation=cv2.INTER_LINEAR) for part in (DISC, leaves())]
    photos[1] = painted(photos[1], large[0] > 0, large[1])
    frames = written(tmp_path / "walls", photos)
    return Capture(frames, np.zeros((0, 3)), root=tmp_path / "walls", test_names=frozenset({frames[-1].name}))


@pytest.mark.parametrize("model", ["default", "auto"])
def test_a_training_leaves_out_what_it_finds_and_writes_masks(capture, tmp_path, monkeypatch, model):
    """With auto, the trials are without these pixels, too."""
    monkeypatch.setattr(selection, "FEWEST_STEPS", 1)
    monkeypatch.setattr(schedule, "FEWEST_STEPS", 1)
    seen: list[TrainingInputs] = []
    monkeypatch.setattr(preparation, "Trials", lambda inputs: seen.append(inputs) or Trials(inputs))
    settings = replace(FEW, steps=40, model=model, components=Components(occluders=model == "default"))
    fit(capture, tmp_path / "run", settings, notes=(notes := []))
    written = {path.name: read_image(path) for path in (tmp_path / "run" / "occluders").rglob("*.png")}
    assert list(written) == ["1.png.png"]
    disc = cv2.resize(DISC.astype(np.uint8), (400, 300), interpolation=cv2.INTER_NEAREST) > 0
    left_out = written["1.png.png"].reshape(300, 400, -1)[..., 0] == 0
    assert left_out[disc].mean() > 0.8
    assert left_out[~disc].mean() < 0.05
    assert any(note.startswith("occluders: ") and "in 1 of 6 photos" in note for note in notes)
    if model == "auto":
        (inputs,) = seen
        used = inputs.pool.is_usable(torch.arange(6 * 300 * 400)).numpy().reshape(6, 300, 400)
        assert used[[0, 2, 3, 4, 5]].all()
        np.testing.assert_array_equal(used[1], ~left_out)
        assert Run(tmp_path / "run").config.components.occluders
