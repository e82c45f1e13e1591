"""Which photos look alike, from their features alone: for large captures, where comparing all pairs takes hours.

A photo is summed up in one vector of unit length (VLAD): each descriptor is assigned to the nearest word of a small
vocabulary, made from these photos themselves, and what is left over is summed per word. Photos that share much have
vectors with a large scalar product. Everything is deterministic.

Source: Jegou et al. 2010, Aggregating local descriptors into a compact image representation; normalisation per word
after Arandjelovic and Zisserman 2013, All about VLAD.
"""

from collections.abc import Collection, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from nerfcli.poses.features import feature_keys
from nerfcli.poses.job import Job
from nerfcli.poses.pairs import in_blocks
from nerfcli.poses.stages import read_stage, stage_key, write_stage

_WORDS = 64
_ROUNDS = 12
# Enough to place the words; more only take longer.
_SAMPLE = 40_000
# To be changed with anything here that changes which neighbours are found.
_VERSION = "VLAD 64"


def with_neighbours(job: Job) -> Job:
    """The job with its pairs complete: each photo's look-alikes are among them. A complete stage is not done again."""
    if job.neighbours == 0:
        return job
    path = Path(job.folder) / f"{job.rung}{'-' if job.rung else ''}pairs.json"
    key = stage_key(_VERSION, feature_keys(job), job.pairs, job.neighbours, job.seed)
    found = read_stage(path, key)
    if found is None:
        found = alike(photo_vectors(_descriptors(job), seed=job.seed), job.neighbours, known=job.pairs)
        write_stage(path, key, found)
    return replace(job, pairs=in_blocks({*job.pairs, *((i, j) for i, j in found)}), neighbours=0)


def photo_vectors(descriptors: Sequence[np.ndarray], *, seed: int) -> np.ndarray:
    """One vector of unit length per photo; zero for a photo without features.

    Args:
        descriptors: per photo (features, 128), of any type.
        seed: of the sample that the vocabulary is made from.

    Returns:
        (photos, 64 * 128) float32.
    """
    words = _vocabulary(descriptors, seed)
    vectors = np.zeros((len(descriptors), *words.shape), np.float32)
    for photo, found in enumerate(descriptors):
        rows = found.astype(np.float32)
        nearest = _nearest(rows, words)
        for word in range(len(words)):
            left = (rows[nearest == word] - words[word]).sum(axis=0)
            size = np.linalg.norm(left)
            # Per word: a texture that fills the picture counts once, like everything else.
            vectors[photo, word] = left / size if size > 0 else 0.0
    vectors = vectors.reshape(len(descriptors), -1)
    sizes = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, sizes, out=np.zeros_like(vectors), where=sizes > 0)


def alike(vectors: np.ndarray, count: int, *, known: Collection[tuple[int, int]]) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, sorted: of each photo with the `count` that are most like it and not in `known` with it."""
    likeness = (vectors @ vectors.T).astype(np.float64)
    np.fill_diagonal(likeness, -np.inf)
    for i, j in known:
        likeness[i, j] = likeness[j, i] = -np.inf
    pairs: set[tuple[int, int]] = set()
    for i, row in enumerate(likeness):
        best = np.argsort(-row, kind="stable")[:count]
        pairs |= {(min(i, j), max(i, j)) for j in best.tolist() if row[j] > -np.inf}
    return sorted(pairs)


def _descriptors(job: Job) -> list[np.ndarray]:
    with closing(pycolmap.Database.open(str(job.database))) as database:
        return [
            database.read_descriptors(image_id).data
            if database.exists_descriptors(image_id)
            else np.zeros((0, 128), np.uint8)
            for image_id in job.image_ids
        ]


def _vocabulary(descriptors: Sequence[np.ndarray], seed: int) -> np.ndarray:
    """(words, 128) centres of clusters of a sample (Lloyd's algorithm); fewer words if there are fewer descriptors."""
    rng = np.random.default_rng(seed)
    share = _SAMPLE // max(len(descriptors), 1) + 1
    samples = [found[rng.permutation(len(found))[:share]] for found in descriptors]
    sample = np.concatenate(samples).astype(np.float32)
    words = sample[rng.permutation(len(sample))[:_WORDS]].copy()
    for _ in range(_ROUNDS):
        nearest = _nearest(sample, words)
        for word in range(len(words)):
            members = sample[nearest == word]
            if len(members):
                words[word] = members.mean(axis=0)
    return words


def _nearest(rows: np.ndarray, words: np.ndarray) -> np.ndarray:
    """For each row the index of the nearest word. |row|^2 is the same for all words and left out."""
    return np.argmin((words**2).sum(axis=1) - 2 * rows @ words.T, axis=1)
