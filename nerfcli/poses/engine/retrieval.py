"""Image retrieval: find similar photos from a few of their features, for large captures.

The largest-scale features of each photo are compared with those of every other one by the matcher's rule (mutual
nearest neighbours that are clearly nearer than the second). They are few, visible from farthest away, and the most
repeatable: the photos most similar to each one include nearly all pairs with many verified matches, more than with VLAD
vectors, which cost no less.

Descriptors are integers, so their squared distances are exact: the result does not depend on threads, library or seed.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np
import pycolmap

from nerfcli.poses.engine.features import feature_keys
from nerfcli.poses.input.job import Job, Report, read_stage, stage_key, write_stage
from nerfcli.poses.input.pairs import in_blocks, pairs_of_nearest, retrieval_feature_count

# Ratio of the squared distances to the nearest and the second nearest: 0.8 of the distance, as in pycolmap.
_RATIO = 0.64
# Pairs with fewer common features than this are left out, except this many, the best, of each photo.
_FEW = 4
# Two photos that both have this many pairs with so many common features are not matched with each other for fewer: this
# leaves out a third of the pairs of an orbit and half of those of a plain object, which hold 3 to 7 % of the verified
# matches.
_MANY = 12
# Change this whenever this module would find other pairs.
_VERSION = (
    "256 coarsest, ties kept, no padding, pairs without common features left out, or with few where there are many"
)


def select_pairs(job: Job, report: Report) -> Job:
    """Return the job with its final pairs: look-alikes of each photo added, pairs without common features removed."""
    if job.neighbours == 0:
        return job
    path = job.stage_file("pairs")
    key = stage_key(_VERSION, feature_keys(job), job.pairs, job.neighbours)
    found = read_stage(path, key)
    if found is None:
        most = retrieval_feature_count(len(job.files))
        with pycolmap.Database.open(job.database) as database:
            descriptors = [_coarsest(database, image_id, most) for image_id in job.image_ids]
        common = likeness(descriptors, report)
        found = [*promising(common, job.pairs), *alike(common, job.neighbours, paired=job.pairs)]
        write_stage(path, key, found)
    return replace(job, pairs=in_blocks((i, j) for i, j in found), neighbours=0)


def likeness(descriptors: Sequence[np.ndarray], report: Report) -> np.ndarray:
    """Count the common features of all pairs of photos, (photos, photos), symmetric, 0 on the diagonal.

    `descriptors` are, per photo, (features, 128) integers up to 255.
    """
    count = len(descriptors)
    most = max((len(rows) for rows in descriptors), default=0)
    # Photos with fewer features are padded with rows that are infinitely far from all others.
    padded = np.zeros((count, max(most, 2), 128), np.float32)
    for photo, rows in enumerate(descriptors):
        padded[photo, : len(rows)] = rows
    sizes = (padded**2).sum(axis=2)
    for photo, rows in enumerate(descriptors):
        sizes[photo, len(rows) :] = np.inf
    shared = np.zeros((count, count), np.int64)
    block = 8  # other photos compared at a time: their distances stay in the processor's cache
    for i in range(count):
        report("pair", i, count)
        for start in range(i + 1, count, block):
            others = slice(start, min(start + block, count))
            products = padded[i] @ padded[others].reshape(-1, 128).T
            products = products.reshape(padded.shape[1], -1, padded.shape[1])  # (features of i, others, their features)
            distances = sizes[i][:, None, None] + sizes[others][None] - 2 * products
            shared[i, others] = shared[others, i] = _clear_matches(distances)
    report("pair", count, count)
    return shared


def alike(likeness: np.ndarray, count: int, *, paired: Collection[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the sorted pairs (i, j), i < j, of each photo and its `count` most similar ones that are not `paired`."""
    distances = -likeness.astype(np.float64)
    np.fill_diagonal(distances, np.inf)
    for i, j in paired:
        distances[i, j] = distances[j, i] = np.inf
    return sorted(pairs_of_nearest(distances, count))


def promising(likeness: np.ndarray, pairs: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the pairs with enough common features, and for each photo its few most similar pairs in any case."""
    ordered = sorted(pairs, key=lambda pair: (-likeness[pair], pair))
    in_strong = [photo for pair in ordered if likeness[pair] >= _MANY for photo in pair]
    strong = np.bincount(in_strong, minlength=len(likeness))
    kept: list[tuple[int, int]] = []
    taken = np.zeros(len(likeness), dtype=int)
    for i, j in ordered:
        common = likeness[i, j]
        enough = min(strong[i], strong[j]) >= _MANY
        if common >= (_MANY if enough else _FEW) or min(taken[i], taken[j]) < _FEW:
            kept.append((i, j))
            taken[[i, j]] += 1
    return kept


def _clear_matches(distances: np.ndarray) -> np.ndarray:
    """Count matches per other photo from squared distances (features, photos, their features), overwriting these."""
    nearest = distances.argmin(axis=2)[:, :, None]
    first = np.take_along_axis(distances, nearest, axis=2)
    mutual = first == np.take_along_axis(distances.min(axis=0)[None], nearest, axis=2)
    np.put_along_axis(distances, nearest, np.inf, axis=2)
    return (mutual & (first < _RATIO * distances.min(axis=2, keepdims=True))).sum(axis=(0, 2))


def _coarsest(database: pycolmap.Database, image_id: int, most: int) -> np.ndarray:
    """Return the descriptors (N, 128) of the largest-scale features of a photo, the largest first."""
    order = np.argsort(-database.read_keypoints(image_id)[:, 2], kind="stable")[:most]
    return database.read_descriptors(image_id).data[order]
