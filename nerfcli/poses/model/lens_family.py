"""Detect fisheye lenses from pairs of photos, before there is a model.

If the lens was a fisheye, a mapper that starts from a perspective lens finds few photos that fit together, or many that
fit badly. A pair of photos alone can tell: with the right projection, more of its matches agree on one motion of the
camera. Without a known lens, matches may agree on any fundamental matrix, which is more general than a motion with a
known lens; so a perspective photo never gains by a fisheye.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pycolmap

from nerfcli.poses.input.job import CameraGroup, Job
from nerfcli.poses.model.held_out import MOST_ERROR_PX
from nerfcli.poses.model.intrinsics import START_FISHEYE, START_MODEL
from nerfcli.poses.model.projection import Array

# Focal lengths to try, as a fraction of the longer side: an equidistant lens shows 1 / fraction radians along it.
_FOCAL_FRACTIONS = np.geomspace(0.25, 0.85, 8)
# More matches must agree by this factor.
_CLEARLY = 1.1
_LEAST_MATCHES = 60


def as_fisheye(job: Job) -> Job | None:
    """Return the job with cameras that start from a fisheye where pairs of photos indicate one; None if none do.

    Only cameras without a model from a file or the user are tested.
    """
    groups = []
    with pycolmap.Database.open(job.database) as database:
        for group in job.groups:
            is_open = group.choose and group.model == START_MODEL and group.params is None
            focal_px = _fisheye_focal_px(group, job, database) if is_open else None
            groups.append(group if focal_px is None else _fisheye(group, focal_px))
    return None if tuple(groups) == job.groups else replace(job, groups=tuple(groups))


def _fisheye(group: CameraGroup, focal_px: float) -> CameraGroup:
    params = (focal_px, focal_px, group.width / 2, group.height / 2, 0.0, 0.0, 0.0, 0.0)
    return replace(group, model=START_FISHEYE, params=params)


def _fisheye_focal_px(group: CameraGroup, job: Job, database: pycolmap.Database) -> float | None:
    """Return the focal length of a fisheye with which clearly more matches agree than without one; None without any."""
    pairs = _strongest_pairs({job.image_ids[number] for number in group.photos}, database)
    if not pairs:
        return None
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = job.seed
    options.ransac.max_error = MOST_ERROR_PX
    options.ransac.max_num_trials = 1000
    camera = pycolmap.Camera.create_from_model_name(1, START_MODEL, 1.2 * group.width, group.width, group.height)
    freely = sum(_agreeing(pycolmap.estimate_two_view_geometry, camera, pair, options) for pair in pairs)
    longer = max(group.width, group.height)
    found = []
    for focal_px in longer * _FOCAL_FRACTIONS:
        start = _fisheye(group, float(focal_px))
        camera = pycolmap.Camera.create_from_model_name(1, start.model, focal_px, group.width, group.height)
        camera.params = list(start.params or ())
        count = sum(_agreeing(pycolmap.estimate_calibrated_two_view_geometry, camera, pair, options) for pair in pairs)
        found.append((count, float(focal_px)))
    best, focal_px = max(found)
    return focal_px if best > _CLEARLY * freely else None


def _agreeing(
    estimate: Callable[..., pycolmap.TwoViewGeometry],
    camera: pycolmap.Camera,
    pair: tuple[Array, Array],
    options: pycolmap.TwoViewGeometryOptions,
) -> int:
    """Return how many of a pair's matches agree on one geometry."""
    matches = np.repeat(np.arange(len(pair[0]), dtype=np.uint32)[:, None], 2, axis=1)
    return len(estimate(camera, pair[0], camera, pair[1], matches=matches, options=options).inlier_matches)


def _strongest_pairs(images: set[int], database: pycolmap.Database) -> list[tuple[Array, Array]]:
    """Return pixels (matches, 2) in both photos of the pairs with the most matches, each photo in at most one pair.

    All matches of photos that were taken side by side agree whatever the lens, so that one pair per photo is enough.
    """
    pair_ids, counts = database.read_num_matches()
    pairs = [(count, *pycolmap.pair_id_to_image_pair(pair_id)) for pair_id, count in zip(pair_ids, counts, strict=True)]
    chosen: list[tuple[Array, Array]] = []
    for count, one, other in sorted(pairs, reverse=True):
        if count < _LEAST_MATCHES or len(chosen) == 8:
            break
        if {one, other} <= images:
            images = images - {one, other}
            matches = np.asarray(database.read_matches(one, other), dtype=np.int64)
            matches = matches[:: max(1, len(matches) // 400)]
            first, second = (np.asarray(database.read_keypoints(i), dtype=np.float64)[:, :2] for i in (one, other))
            chosen.append((first[matches[:, 0]], second[matches[:, 1]]))
    return chosen
