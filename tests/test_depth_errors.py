"""Depth intervals: from known errors in closed form, and with the truth in place of stereo matching."""

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import tifffile
from commands import completed, nerfcli
from present import present

from nerfcli.captures.formats.run_cameras import RunCameras
from nerfcli.errors import UserError
from nerfcli.evaluate import depth_errors
from nerfcli.evaluate.depth_errors import measure_depth_errors, surface_tracks
from nerfcli.matching.stereo import DenseDepth
from nerfcli.matching.tracks import Tracks, triangulate
from nerfcli.photos.images import write_png
from nerfcli.photos.loading import LoadedPhoto
from nerfcli.render.coverage import depth_maps
from nerfcli.render.depth import DepthRequest
from nerfcli.render.depth_errors import LEAST_PIXELS, DepthErrors
from nerfcli.render.files.file_facts import depth_meta_of
from nerfcli.render.files.float_maps import read_exr
from nerfcli.render.pictures import render_picture
from nerfcli.training.runs.files import DEPTH_ERRORS, left_out_mask
from nerfcli.training.runs.run import Run

TRUTH = Path(__file__).parent.parent / "sample_scenes" / "spheres" / "truth"


@pytest.fixture
def errors() -> DepthErrors:
    """Uniform errors: -40 to 40 % where one photo sees, 0 to 20 % where two or three do, -1 to 1 % from four on."""
    spread = np.linspace(-1, 1, 1001)
    of_strata = [0.4 * spread, 0.1 + 0.1 * spread, 0.01 * spread]
    coverage = np.repeat([1.0, 3.0, 7.0], 1001)
    return DepthErrors.of(np.concatenate(of_strata), coverage, np.arange(3003) % 2, matched=0.5)


def test_intervals_are_those_of_evenly_spread_errors(errors):
    coverage = np.array([0, 1, 2, 3, 4, 20, np.nan])
    lower, upper = errors.bounds(np.full(7, 2.0), coverage)
    half = 0.9 * np.array([np.nan, 0.4, 0.1, 0.1, 0.01, 0.01, np.nan])
    middle = np.array([0, 0, 0.1, 0.1, 0, 0, 0])
    np.testing.assert_allclose(lower, 2 * (1 + middle - half), rtol=1e-6)
    np.testing.assert_allclose(upper, 2 * (1 + middle + half), rtol=1e-6)
    assert lower.dtype == upper.dtype == np.float32
    assert errors.pixels == (1001, 1001, 1001)


def test_confidence_is_the_proportion_of_evenly_spread_errors(errors):
    """Closed form: errors are uniform in ±0.4, 0 to 0.2 and ±0.01; the confidence is their fraction in ±0.02."""
    coverage = np.array([0, 1, 2, 3, 4, 20, np.nan])
    confidence = errors.confidence(coverage)
    np.testing.assert_allclose(confidence, [np.nan, 0.05, 0.1, 0.1, 1, 1, np.nan], atol=1e-6)
    assert confidence.dtype == np.float32


def test_confidence_is_1_where_all_errors_are_0():
    errors = DepthErrors.of(np.zeros(600), np.repeat([1.0, 2.0, 4.0], 200), np.arange(600) % 2, matched=0.5)
    np.testing.assert_array_equal(errors.confidence(np.array([1.0, 2.0, 4.0])), 1.0)


def test_where_too_little_was_measured_there_is_no_interval():
    """The first stratum has too few pixels, the second has pixels of only one photo."""
    coverage = np.repeat([1.0, 2.0, 4.0], [LEAST_PIXELS - 1, LEAST_PIXELS, LEAST_PIXELS])
    photos = np.where(coverage == 2, 0, np.arange(len(coverage)) % 2)
    errors = DepthErrors.of(np.zeros(len(coverage)), coverage, photos, matched=0.5)
    lower, _ = errors.bounds(np.ones(3), np.array([1.0, 2.0, 4.0]))
    assert np.isnan(lower).tolist() == [True, True, False]
    np.testing.assert_array_equal(errors.confidence(np.array([1.0, 2.0, 4.0])), [np.nan, np.nan, 1])
    again = DepthErrors.from_json(json.loads(json.dumps(errors.to_json(), allow_nan=False)))
    np.testing.assert_array_equal(again.quantiles, errors.quantiles)
    assert (again.pixels, again.photos) == (errors.pixels, 2)


def matched_by_truth(fraction: float = 1.0) -> Callable[..., list[DenseDepth]]:
    """Return a replacement for stereo matching: true distances for a fraction of the held-out photos' pixels."""

    def dense_depths(photos: Sequence[LoadedPhoto], tracks: Tracks, **_: object) -> list[DenseDepth]:
        found = []
        for photo in photos:
            path = TRUTH / f"{Path(photo.frame.name).stem}_distance.tiff"
            pixels, distances = np.zeros((0, 2), np.int64), np.zeros(0)
            if "test" in photo.frame.name:
                truth = tifffile.imread(path).astype(np.float64)
                rows, columns = np.nonzero(np.isfinite(truth))
                kept = slice(round(fraction * len(rows)))
                pixels, distances = np.stack([columns, rows], axis=1)[kept], truth[rows, columns][kept]
            found.append(DenseDepth(pixels, distances, np.zeros(len(pixels))))
        return found

    return dense_depths


@pytest.fixture
def copied(spheres_run, tmp_path, small_photo_depths) -> Path:
    """A copy of the run, to write into, beside it, where the relative paths of its photos stay valid."""
    return Path(shutil.copytree(spheres_run, spheres_run.with_name(f"{tmp_path.name}-run")))


def test_errors_are_those_between_matched_and_median_distances(spheres_run, monkeypatch):
    run = Run(spheres_run)
    model = run.model()
    maps = depth_maps(model, run.cameras.train, max_size=48)
    monkeypatch.setattr(depth_errors, "dense_depths", matched_by_truth())
    found = measure_depth_errors(run, model, maps, threads=1)
    expected, matched = [], []
    for frame in run.cameras.test:
        picture = render_picture(model, frame, background=model.background, depth=DepthRequest("median", "ray"))
        truth = tifffile.imread(TRUTH / f"{Path(frame.name).stem}_distance.tiff")
        matched.append(np.isfinite(truth).mean())
        expected.append(truth / present(picture.depth) - 1)
    every = np.concatenate([errors[np.isfinite(errors)] for errors in expected])
    assert found.photos == 3
    assert found.matched == pytest.approx(np.mean(matched))
    assert 0.9 * len(every) < sum(found.pixels) <= len(every)
    # Nearly all pixels are in the last stratum.
    np.testing.assert_allclose(found.quantiles[2][20:181], np.quantile(every, np.linspace(0.1, 0.9, 161)), atol=0.01)


def test_pixels_that_the_training_left_out_are_not_measured(copied, monkeypatch):
    """Regression: what is attached to the camera was matched, and its depth held against the field."""
    run, matched = Run(copied), list[LoadedPhoto]()
    left_out = [run.cameras.train[2].name, run.cameras.test[1].name]
    kept = np.tile(np.arange(96) >= 40, (72, 1))
    for name in left_out:
        write_png(left_out_mask(copied, name), np.where(kept, 255, 0).astype(np.uint8))

    def dense_depths(photos: Sequence[LoadedPhoto], tracks: Tracks, **_: object) -> list[DenseDepth]:
        matched.extend(photos)
        return matched_by_truth()(photos, tracks)

    monkeypatch.setattr(depth_errors, "dense_depths", dense_depths)
    model = run.model()
    measure_depth_errors(run, model, depth_maps(model, run.cameras.train, max_size=48), threads=1)
    used = {photo.frame.name: photo.used for photo in matched}
    assert [name for name, pixels in used.items() if pixels is not None] == left_out
    for name in left_out:
        np.testing.assert_array_equal(used[name], kept)


def test_tracks_of_a_surface_are_rays_to_its_points(spheres_run):
    run = Run(spheres_run)
    maps = depth_maps(run.model(), run.cameras.train[:5], max_size=48)
    tracks = surface_tracks(maps)
    found = triangulate([view.frame for view in maps], tracks)
    points = found.points[np.isfinite(found.points).all(axis=1)]
    everything = np.concatenate([view.points() for view in maps])
    away = np.linalg.norm(points[:, None] - everything[None], axis=-1).min(axis=1)
    assert len(points) > 100
    assert away.max() < 1e-6


def test_a_run_without_held_out_photos_has_no_intervals(spheres_run):
    run = Run(spheres_run)
    run.__dict__["cameras"] = RunCameras(run.cameras.train, ())
    with pytest.raises(UserError, match="has no held-out photos"):
        measure_depth_errors(run, run.model(), [], threads=1)


def maps_in(views: Path, *names: str) -> list[np.ndarray]:
    """Return the maps (views, height, width) of each name, and the true distances."""
    paths = [(views / name).rglob("*.tiff") for name in names]
    return [np.stack([tifffile.imread(path) for path in sorted(of)]) for of in (*paths, TRUTH.glob("*_distance.tiff"))]


def test_render_writes_the_interval_and_keeps_the_errors(copied, tmp_path, monkeypatch):
    monkeypatch.setattr(depth_errors, "dense_depths", matched_by_truth())
    common = ("render", copied, "--depth", "median", "--depth-axis", "ray", "--threads", "2")
    completed(*common, "--outputs", "depth,coverage,lower,upper", "-o", tmp_path / "views")
    depth, coverage, lower, upper, truth = maps_in(tmp_path / "views", "depth", "coverage", "lower", "upper")
    seen = coverage >= 4
    inside = (lower <= truth) & (truth <= upper)
    assert inside[seen & np.isfinite(truth)].mean() == pytest.approx(0.9, abs=0.01)
    np.testing.assert_allclose((lower / depth)[seen], (lower / depth)[seen][0], rtol=1e-5)
    assert np.isnan(lower[coverage == 0]).all()
    assert np.isnan(upper[np.isnan(depth)]).all()
    path = next((tmp_path / "views/lower").rglob("*.tiff"))
    meta = present(depth_meta_of(path))
    assert (meta.quantity, meta.convention, meta.provenance["measured_photos"]) == ("lower", "lower:0.9", 3)
    assert "lower end of the 90 % interval of depth along the ray" in nerfcli("info", path).stdout
    # The errors are read, not measured again.
    monkeypatch.setattr(depth_errors, "dense_depths", pytest.fail)
    completed(*common, "--outputs", "lower,upper", "--depth-format", "exr", "-o", tmp_path / "other")
    assert json.loads((copied / DEPTH_ERRORS).read_text())["photos"] == 3


def test_render_writes_the_proportion_of_depths_within_the_tolerance(copied, tmp_path, monkeypatch):
    """With errors measured from the true distances of the same pictures, confidence equals this proportion."""
    monkeypatch.setattr(depth_errors, "dense_depths", matched_by_truth())
    common = ("render", copied, "--depth", "median", "--depth-axis", "ray", "--depth-format", "tiff,exr")
    outputs = ("--outputs", "depth,coverage,confidence", "-o", tmp_path / "views")
    completed(*common, *outputs)
    depth, coverage, confidence, truth = maps_in(tmp_path / "views", "depth", "coverage", "confidence")
    compared = (coverage >= 4) & np.isfinite(truth)
    within = np.abs(truth - depth)[compared] <= 0.02 * depth[compared]
    assert 0.2 < within.mean() < 0.95
    np.testing.assert_allclose(confidence[coverage >= 4], within.mean(), atol=0.01)
    assert np.isnan(confidence[coverage == 0]).all()
    assert np.isnan(confidence[np.isnan(depth)]).all()
    exr = min((tmp_path / "views").rglob("*.exr"))
    np.testing.assert_array_equal(read_exr(exr)["confidence.V"], confidence[0])
    path = min((tmp_path / "views" / "confidence").rglob("*.tiff"))
    meta = present(depth_meta_of(path))
    assert (meta.quantity, meta.convention, meta.unit) == ("confidence", "confidence:0.02", "fractions of 1")
    assert "confidence, in fractions of 1: the proportion of depths" in nerfcli("info", path).stdout
    preview = nerfcli("info", path.with_suffix(".png")).stdout
    assert "confidence: proportion of depths with an error of at most 2 %" in meta.title
    assert 'range={"low": 0.0, "high": 1.0, "inverse": false}' in preview
    assert "is kept: it is complete" in nerfcli(*common, *outputs).stderr


def test_render_says_where_there_is_no_interval(copied, tmp_path, monkeypatch):
    monkeypatch.setattr(depth_errors, "dense_depths", matched_by_truth(0.01))
    result = completed("render", copied, "--outputs", "lower", "--threads", "2", "-o", tmp_path / "views")
    assert "no intervals or confidence where 4 photos see the surface: " in result.stderr
    assert "pixels were measured, and 200 are needed, in 2 held-out photos" in result.stderr
    assert "what cannot be matched is usually worse" in result.stderr
    assert np.isnan(tifffile.imread(next((tmp_path / "views/lower").rglob("*.tiff")))).all()
