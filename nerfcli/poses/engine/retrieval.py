"""Image retrieval: find similar photos from a few of their features, for large captures.

Of each photo the features of the largest scale are compared with those of every other one, by the same rule that the
matcher has (mutual nearest neighbours that are clearly nearer than the second). They are few, seen from farthest, and
found again best. Measured on fox (50 photos, 1225 pairs): the 20 most alike of each photo hold 98 % of the pairs with
100 verified matches or more, at 0.4 ms a pair; VLAD vectors, which cost no less, hold 89 to 93 %.

Descriptors are whole numbers and so are their distances, exactly: the result depends on no thread, no library, no seed.
"""

from collections.abc import Collection, Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from nerfcli.poses.engine.features import feature_keys
from nerfcli.poses.input.job import Job, Report
from nerfcli.poses.input.pairs import in_blocks, looked_at_features
from nerfcli.poses.input.stages import read_stage, stage_key, write_stage

# Nearest and second nearest, squared: 0.8 of the distance, as in pycolmap.
_RATIO = 0.64
# So many other photos at a time: some tens of megabytes.
_BLOCK = 64
# Pairs of the order or of GPS with fewer features in common are left out, beyond so many of each photo. Measured on
# 302, 160 and 50 photos: of the pairs with fewer, at most 3 in 7 have 30 verified matches, none has more than 115.
_LEAST_COMMON = 4
_SURE_PAIRS = 4
# To be changed with anything here that changes which pairs are found.
_VERSION = "256 coarsest, ties kept, pairs without common features left out"


def with_neighbours(job: Job, report: Report) -> Job:
    """Return the job with its final pairs: each photo's look-alikes are among them, those without common features not.

    A complete stage is not done again.
    """
    if job.neighbours == 0:
        return job
    path = Path(job.folder) / f"{job.rung}{'-' if job.rung else ''}pairs.json"
    key = stage_key(_VERSION, feature_keys(job), job.pairs, job.neighbours)
    found = read_stage(path, key)
    if found is None:
        common = likeness(_coarsest(job), report)
        found = [*promising(common, job.pairs), *alike(common, job.neighbours, known=job.pairs)]
        write_stage(path, key, found)
    return replace(job, pairs=in_blocks((i, j) for i, j in found), neighbours=0)


def likeness(descriptors: Sequence[np.ndarray], report: Report) -> np.ndarray:
    """Count the common features of all pairs of photos.

    Args:
        descriptors: per photo (features, 128) whole numbers up to 255.
        report: receives ("pair", photos done, photos in all).

    Returns:
        (photos, photos) counts, symmetric, 0 on the diagonal.
    """
    count = len(descriptors)
    most = max((len(rows) for rows in descriptors), default=0)
    # Photos with fewer features are filled with zeros, which are no photo's clear neighbour.
    padded = np.zeros((count, max(most, 2), 128), np.float32)
    for photo, rows in enumerate(descriptors):
        padded[photo, : len(rows)] = rows
    sizes = (padded**2).sum(axis=2)
    shared = np.zeros((count, count), np.int64)
    for i in range(count):
        report("pair", i, count)
        for start in range(i + 1, count, _BLOCK):
            others = slice(start, min(start + _BLOCK, count))
            products = padded[i] @ padded[others].reshape(-1, 128).T
            products = products.reshape(padded.shape[1], -1, padded.shape[1])  # (features of i, others, their features)
            distances = sizes[i][:, None, None] + sizes[others][None] - 2 * products
            shared[i, others] = shared[others, i] = _clear_matches(distances)
    report("pair", count, count)
    return shared


def alike(likeness: np.ndarray, count: int, *, known: Collection[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, sorted:
    for each photo the `count` most similar ones that are not in `known` with it.
    """
    likeness = likeness.astype(np.float64)
    np.fill_diagonal(likeness, -np.inf)
    for i, j in known:
        likeness[i, j] = likeness[j, i] = -np.inf
    pairs: set[tuple[int, int]] = set()
    for i, row in enumerate(likeness):
        best = np.argsort(-row, kind="stable")[:count]
        pairs |= {(min(i, j), max(i, j)) for j in best.tolist() if row[j] > -np.inf}
    return sorted(pairs)


def promising(likeness: np.ndarray, pairs: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return those of some pairs that have features in common; of each photo the few most alike, whatever they have."""
    kept: list[tuple[int, int]] = []
    taken = np.zeros(len(likeness), dtype=int)
    for i, j in sorted(pairs, key=lambda pair: (-likeness[pair], pair)):
        if likeness[i, j] >= _LEAST_COMMON or min(taken[i], taken[j]) < _SURE_PAIRS:
            kept.append((i, j))
            taken[[i, j]] += 1
    return kept


def _clear_matches(distances: np.ndarray) -> np.ndarray:
    """Per other photo, the matches in squared distances (features, photos, their features), which are overwritten."""
    nearest = distances.argmin(axis=2)[:, :, None]
    first = np.take_along_axis(distances, nearest, axis=2)
    mutual = first == np.take_along_axis(distances.min(axis=0)[None], nearest, axis=2)
    np.put_along_axis(distances, nearest, np.inf, axis=2)
    return (mutual & (first < _RATIO * distances.min(axis=2, keepdims=True))).sum(axis=(0, 2))


def _coarsest(job: Job) -> list[np.ndarray]:
    """Per photo the descriptors of its features of the largest scale."""
    most = looked_at_features(len(job.files))
    found: list[np.ndarray] = []
    with closing(pycolmap.Database.open(str(job.database))) as database:
        for image_id in job.image_ids:
            if not database.exists_descriptors(image_id):
                found.append(np.zeros((0, 128), np.uint8))
                continue
            shapes = database.read_keypoints(image_id)[:, 2:6]  # the affine shape, row by row
            areas = np.abs(shapes[:, 0] * shapes[:, 3] - shapes[:, 1] * shapes[:, 2])
            order = np.argsort(-areas, kind="stable")[:most]
            found.append(database.read_descriptors(image_id).data[order])
    return found
