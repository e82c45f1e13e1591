"""nerfcli.photos.masks and poses.input.layout: found by name, turned like the photo, obeyed by feature extraction."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from captures import put_photos
from PIL import Image
from synthetic_captures import job_of

from nerfcli.errors import UserError
from nerfcli.matching.features import find_features
from nerfcli.photos.images import read_image, write_png
from nerfcli.photos.masks import find_mask, mask_of, read_mask
from nerfcli.poses.engine.features import extract, feature_keys
from nerfcli.poses.input.job import CameraGroup, Job, WorkMask, read_job, write_job
from nerfcli.poses.input.layout import lay_out_masks
from nerfcli.poses.input.photos import Photo, Photos, find_photos
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.poses.structure_from_motion import plan_poses

WIDTH, HEIGHT = 120, 80


@pytest.fixture
def photos(tmp_path) -> Photos:
    put_photos(tmp_path / "photos", *(f"p {index}.png" for index in range(4)), size=(WIDTH, HEIGHT), noise=True)
    return find_photos(tmp_path / "photos")


@pytest.fixture
def masks(tmp_path) -> Path:
    (tmp_path / "masks").mkdir()
    return tmp_path / "masks"


def laid_out(photos: Photos, masks: Path, folder: Path) -> tuple[tuple[WorkMask, ...], list[str]]:
    notes: list[str] = []
    files = [f"{number:05d}.png" for number in range(len(photos.names))]
    return lay_out_masks(photos, files, masks, folder=folder, notify=notes.append), notes


@pytest.mark.parametrize(
    ("there", "found"),
    [
        (["a.b.jpg.png", "a.b.png", "a.b.jpg"], "a.b.jpg.png"),
        (["a.b.png", "a.b.jpg"], "a.b.png"),
        (["a.b.jpg", "a.b.tif"], "a.b.jpg"),
        (["a.b.jpg.tif"], "a.b.jpg.tif"),
        (["a.b.webp"], "a.b.webp"),
        (["a.b_mask.JPG", "a.b.TIF"], "a.b.TIF"),
        (["a.b_mask.JPG", "a.b_mask.png"], "a.b_mask.png"),
        (["a.b_mask.JPG"], "a.b_mask.JPG"),
        (["a.png", "a.b.c.png", "a.b.txt", "a.b.jpg_mask.png"], None),
    ],
)
def test_a_mask_is_named_after_its_photo(masks, there, found):
    for name in there:
        (masks / name).touch()
    assert find_mask("a.b.jpg", masks) == (masks / found if found else None)


@pytest.mark.parametrize(
    ("name", "there", "found"),
    [
        ("images/left/a.jpg", ["images/left/a.png", "left/a.png", "a.png"], "images/left/a.png"),
        ("images/left/a.jpg", ["left/a.png", "a.png"], "left/a.png"),
        ("images/left/a.jpg", ["a.png", "right/a.png"], "a.png"),
        ("../images/left/a.jpg", ["left/a.png"], "left/a.png"),
        ("../images/left/a.jpg", ["right/a.png"], None),
    ],
)
def test_a_mask_is_found_by_the_end_of_its_photos_path_and_is_never_the_photo(masks, name, there, found):
    for path in ["../images/left/a.jpg", *there]:
        (masks / path).parent.mkdir(parents=True, exist_ok=True)
        (masks / path).touch()
    assert mask_of(name, masks) == (masks / found if found else None)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_mask_as_the_photo_is_stored_turns_with_it(tmp_path, orientation):
    """Evidence: the photo itself, thresholded as stored and as turned by Pillow's transposition."""
    photo = tmp_path / "p.png"
    put_photos(tmp_path, photo.name, size=(WIDTH, HEIGHT), orientation=orientation, noise=True)
    stored = np.asarray(Image.open(photo).convert("L")) > 127
    write_png(tmp_path / "upright.png", (read_image(photo).mean(-1) > 99).astype(np.uint8) * 255)
    np.testing.assert_array_equal(read_mask(tmp_path / "upright.png", photo) > 0, read_image(photo).mean(-1) > 99)
    if orientation >= 5:  # 2 to 4 keep the size: a mask is taken as upright
        write_png(tmp_path / "stored.png", stored.astype(np.uint8) * 255)
        upright = np.asarray(Image.fromarray(read_image(photo)).convert("L")) > 127
        np.testing.assert_array_equal(read_mask(tmp_path / "stored.png", photo) > 0, upright)


def test_levels_of_a_mask(tmp_path):
    """White may be 255 or 1; grey edges stay; what JPEG leaves around an edge does not."""
    photo = tmp_path / "p.png"
    put_photos(tmp_path, photo.name, size=(WIDTH, HEIGHT))
    half = np.zeros((HEIGHT, WIDTH), np.uint8)
    half[:, WIDTH // 2 :] = 1
    write_png(tmp_path / "one.png", half)
    np.testing.assert_array_equal(read_mask(tmp_path / "one.png", photo), 255 * half)
    half[:, WIDTH // 2] = 40
    write_png(tmp_path / "grey.png", half)
    np.testing.assert_array_equal(read_mask(tmp_path / "grey.png", photo), half)
    edges = np.zeros((HEIGHT, WIDTH), np.uint8)
    edges[:, 53:] = 255
    Image.fromarray(edges).save(tmp_path / "lossy.jpg", quality=30)
    assert len(np.unique(read_image(tmp_path / "lossy.jpg"))) > 2
    np.testing.assert_array_equal(read_mask(tmp_path / "lossy.jpg", photo), edges)


def test_masks_that_do_not_fit_are_named(photos, masks, tmp_path):
    write_png(masks / "p 0.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    write_png(masks / "p 1.png", np.full((HEIGHT, WIDTH - 1), 255, np.uint8))
    write_png(masks / "p 3.png", np.full((WIDTH, HEIGHT), 255, np.uint8))  # the photo is stored upright: not turned
    (masks / "p 2.png").write_bytes(b"no picture")
    said = (
        r"3 masks cannot be used: .*p 1\.png is 119x80, but its photo is 120x80, .*p 2\.png is not a readable picture"
    )
    with pytest.raises(UserError, match=said):
        laid_out(photos, masks, tmp_path / "work")


def test_photos_without_a_mask_are_named(photos, masks, tmp_path):
    write_png(masks / "p 1.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    write_png(masks / "p 2.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    result, notes = laid_out(photos, masks, tmp_path / "work")
    assert notes == [
        "2 of 4 photos have no mask and are used completely: p 0.png, p 3.png",
        "photos whose masks are completely black are not used (1): p 2.png",
    ]
    assert [mask.used_fraction for mask in result] == [1, 1, 0, 1]
    assert [bool(mask.key) for mask in result] == [False, True, True, False]
    laid = {path.name: read_image(path).max() for path in (tmp_path / "work").iterdir()}
    assert laid == {"00001.png.png": 255, "00002.png.png": 0}


def test_a_folder_without_masks_is_reported_before_the_work(photos, masks):
    """In a dry run, too."""

    def plan(folder: Path) -> None:
        settings = PoseSettings(masks=str(folder))
        plan_poses(photos.folder, settings=settings, progress=lambda stage, *done: stages.append(stage))

    stages: list[str] = []

    with pytest.raises(UserError, match="contains no mask for any photo") as error:
        plan(masks)
    assert "p 0.png.png or p 0.png" in error.value.hint
    with pytest.raises(UserError, match="contains photos, such as"):
        plan(photos.folder)
    stages.clear()
    with pytest.raises(UserError, match=r"the mask folder .*absent does not exist"):
        plan(masks / "absent")
    assert stages == []  # before photos are read


def test_masks_may_be_in_the_folder_above_the_photos(photos, masks, tmp_path):
    write_png(photos.folder.parent / "p 0.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    found, _ = laid_out(photos, photos.folder.parent, tmp_path / "work")
    assert found[0].used_fraction == 0


def job_for(photos: Photos, masks: tuple[WorkMask, ...], folder: Path) -> Job:
    files = tuple(f"{number:05d}.png" for number in range(len(photos.names)))
    (folder / "photos").mkdir(parents=True)
    for name, file in zip(photos.names, files, strict=True):
        (folder / "photos" / file).symlink_to(photos.folder / name)
    first: Photo = photos.photos[0]
    group = CameraGroup(tuple(range(len(files))), "SIMPLE_RADIAL", first.width, first.height)
    given: dict[str, Any] = {"originals": str(photos.folder), "names": photos.names, "masks": masks}
    return job_of(folder, files, (group,), max_image_size=1600, max_features=1000, **given)


def test_features_lie_where_the_mask_is_white(photos, masks, tmp_path):
    """A masked photo has those features of the whole photo that are in its white half; one without a mask has all."""
    half = np.zeros((HEIGHT, WIDTH), np.uint8)
    half[:, WIDTH // 2 :] = 255
    write_png(masks / "p 0.png", half)
    work = tmp_path / "scene" / "work"
    job = job_for(photos, laid_out(photos, masks, work / "masks")[0], work)
    write_job(tmp_path / "job.json", job)
    assert read_job(tmp_path / "job.json") == job
    whole = job_for(photos, (), tmp_path / "whole" / "work")
    found = []
    for searched in (replace(job, max_features=800), replace(whole, max_features=800)):
        extract(searched, lambda stage, done, total: None)
        with pycolmap.Database.open(str(searched.database)) as database:
            found.append([database.read_keypoints(image_id) for image_id in searched.image_ids])
    (masked, *others), (all_of_it, *same) = found
    assert masked[:, 0].min() >= WIDTH / 2 - 0.5
    assert all_of_it[:, 0].min() < WIDTH / 2
    inside, expected = (found[found[:, 0] > WIDTH / 2 + 0.5] for found in (masked, all_of_it))
    assert len(inside) > 50
    np.testing.assert_array_equal(inside, expected)
    for one, other in zip(others, same, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_small_part_gets_as_many_features_as_a_whole_photo_would(masks, tmp_path):
    """A quarter of the picture gets at least half as many features as the whole of the same picture."""
    photos = tmp_path / "photos"
    photos.mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8)
    for index in range(4):
        Image.fromarray(noise).resize((640, 480), Image.Resampling.BICUBIC).save(photos / f"p {index}.png")
    quarter = np.zeros((480, 640), np.uint8)
    quarter[:, 480:] = 255
    write_png(masks / "p 0.png", quarter)
    work = tmp_path / "scene" / "work"
    found = find_photos(photos)
    job = replace(job_for(found, laid_out(found, masks, work / "masks")[0], work), max_features=300)
    extract(job, lambda stage, done, total: None)
    with pycolmap.Database.open(str(job.database)) as database:
        masked, whole = (database.num_keypoints_for_image(image_id) for image_id in (1, 2))
    assert masked > 0.5 * whole


def test_the_strongest_features_of_the_used_part_are_kept():
    """As many as requested, and further ones only if they are as strong as the last."""
    grey = np.full((240, 320), 128, np.uint8)
    grey[:, 160:] = np.random.default_rng(0).integers(0, 255, (240, 160), dtype=np.uint8)
    used = np.tile(np.arange(320) >= 160, (240, 1))
    responses = find_features(grey, longer_side_px=320, most=50, used=used).responses
    assert len(responses) >= 50
    assert np.sort(responses)[-50] == responses.min()


def test_another_mask_means_other_features(photos, masks, tmp_path):
    """The keys change so that features are extracted again, only for the photo whose mask has changed."""
    keys = []
    for level in (255, 0):
        for index in range(2):
            mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
            mask[0] = level if index else 255
            write_png(masks / f"p {index}.png", mask)
        work = tmp_path / f"scene {level}" / "work"
        keys.append(feature_keys(job_for(photos, laid_out(photos, masks, work / "masks")[0], work)))
    assert [keys[0][i] == keys[1][i] for i in "1234"] == [True, False, True, True]
    assert json.loads(json.dumps(keys[0])) == keys[0]
