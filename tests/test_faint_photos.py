"""Photos with hardly any contrast: the room corner of `corner` in the dark."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from corner import CENTRES, HEIGHT, WIDTH, render
from in_this_process import worker_in_this_process
from PIL import Image
from test_masks import job_for

from nerfcli.cameras.alignment import align
from nerfcli.matching.features import Features, find_features
from nerfcli.photos.exif import read_exif
from nerfcli.poses.engine import features
from nerfcli.poses.engine.database import feature_counts
from nerfcli.poses.engine.features import extract
from nerfcli.poses.input.job import Job
from nerfcli.poses.input.photos import Photo, Photos
from nerfcli.poses.input.settings import PoseSettings
from nerfcli.poses.structure_from_motion import estimate_poses

SETTINGS = PoseSettings(max_features=200, threads=1, camera_model="SIMPLE_RADIAL")
SCALE = 0.6
# A tenth of a picture's contrast leaves 8 to 12 features in it that SIFT's usual threshold accepts, this none.
CONTRAST = 0.06


def dark(centre: np.ndarray) -> Image.Image:
    picture = render(centre, SCALE, np.zeros(2)).astype(float)
    return Image.fromarray(np.round(40 + CONTRAST * (picture - 128)).astype(np.uint8))


def write_photos(folder: Path, count: int) -> Path:
    folder.mkdir()
    for index, centre in enumerate(CENTRES[:count]):
        dark(centre).save(folder / f"{index}.png")
    return folder


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    return write_photos(tmp_path / "photos", 3)


def test_poses_of_dark_photos_agree_with_the_truth(tmp_path: Path):
    """Without the second search, none of the photos has a feature."""
    photos = write_photos(tmp_path / "photos", 5)
    with worker_in_this_process():
        report = estimate_poses(photos, tmp_path / "scene", settings=SETTINGS)
    assert report.registered == 5
    model = pycolmap.Reconstruction(str(tmp_path / "scene" / "sparse/0"))
    centres = np.array([model.find_image_with_name(f"{i}.png").projection_center() for i in range(5)])
    aligned = align(centres, CENTRES[:5]).apply(centres)
    assert np.linalg.norm(aligned - CENTRES[:5], axis=1).max() < 0.03


def job_of(folder: Path, work: Path) -> Job:
    pictures = sorted(folder.iterdir())
    photos = tuple(Photo(path.name, round(SCALE * WIDTH), round(SCALE * HEIGHT), read_exif(path)) for path in pictures)
    return replace(job_for(Photos(folder, photos, {}), (), work), max_features=600)


def keypoints(job: Job) -> list[np.ndarray]:
    """Return positions and shapes of the features of each photo."""
    with closing(pycolmap.Database.open(str(job.database))) as database:
        return [database.read_keypoints(image_id) for image_id in job.image_ids]


def test_only_photos_with_very_few_features_are_searched_for_faint_ones(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A photo with contrast keeps its features whatever the others need; a second call searches nothing again."""
    Image.fromarray(render(CENTRES[0], SCALE, np.zeros(2))).save(photos / "0.png")
    job = replace(job_of(photos, tmp_path / "work" / "inner"), max_features=1200)
    searches: list[tuple[float, float]] = []

    def searching(grey: np.ndarray, **options) -> Features:
        searches.append((options["contrast"], options.get("enlargement", 1.0)))
        return find_features(grey, **options)

    monkeypatch.setattr(features, "find_features", searching)
    extract(job, lambda stage, done, total: None)
    assert sorted(searches) == [(0.005, 1.5)] * 2 + [(0.02, 1.0)] * 3 + [(0.02, 1.5)] * 2
    counts = feature_counts(job)
    assert counts[0] > 600
    assert min(counts) > 150
    before = keypoints(job)
    extract(job, lambda stage, done, total: None)
    assert len(searches) == 7
    for again, found in zip(keypoints(job), before, strict=True):
        np.testing.assert_array_equal(again, found)


def test_an_interrupted_search_goes_on(photos: Path, tmp_path: Path):
    """Photos that have no features yet get what an undisturbed call gives."""
    whole = job_of(photos, tmp_path / "whole" / "inner")
    extract(whole, lambda stage, done, total: None)

    def stop(stage: str, done: int, total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    job = job_of(photos, tmp_path / "work" / "inner")
    with pytest.raises(KeyboardInterrupt):
        extract(job, stop)
    assert feature_counts(job)[0] > feature_counts(job)[1] == 0
    seen: list[int] = []
    extract(job, lambda stage, done, total: seen.append(done))
    assert seen == [1, 2, 3]
    for resumed, undisturbed in zip(keypoints(job), keypoints(whole), strict=True):
        np.testing.assert_array_equal(resumed, undisturbed)


def test_features_are_where_the_pattern_is_and_their_descriptors_are_root_sift(photos: Path, tmp_path: Path):
    """A blob at a known place: its keypoint is there to a tenth of a pixel, with its scale; squares of each descriptor
    sum to 512 squared, as Arandjelovic's normalisation makes them.
    """
    x, y, sigma = 61.7, 40.2, 4.0
    columns, rows = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    blob = 40 + 180 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
    for path in photos.iterdir():
        Image.fromarray(np.round(blob).astype(np.uint8)).save(path)
    job = job_of(photos, tmp_path / "work" / "inner")
    extract(job, lambda stage, done, total: None)
    with closing(pycolmap.Database.open(str(job.database))) as database:
        found, descriptors = database.read_keypoints(1), database.read_descriptors(1).data
    nearest = np.hypot(found[:, 0] - x, found[:, 1] - y).argmin()
    np.testing.assert_allclose(found[nearest, :2], (x, y), atol=0.1)
    assert found[nearest, 2] == pytest.approx(sigma, rel=0.15)
    assert descriptors.dtype == np.uint8
    np.testing.assert_allclose((descriptors.astype(float) ** 2).sum(axis=1), 512**2, rtol=0.02)
