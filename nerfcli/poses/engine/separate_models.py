"""Describe the separate models of a capture, and why they are not joined."""

from collections.abc import Sequence
from contextlib import closing
from typing import Any

import pycolmap

from nerfcli.poses.engine.mapping import photo_numbers
from nerfcli.poses.input.job import Job
from nerfcli.poses.model.reasons import FEW_MATCHES


def describe_components(models: Sequence[pycolmap.Reconstruction], job: Job) -> list[dict[str, Any]]:
    """Describe each model: its photos, and why it is not part of the largest.

    Args:
        models: of the job, the largest first.
        job: its database has the verified matches.

    Returns:
        Per model {"size", "photos": numbers, "apart": why it is not part of the largest, None for that one}.
    """
    if not models:
        return []
    members = [photo_numbers(model, job) for model in models]
    numbers = {image_id: number for number, image_id in enumerate(job.image_ids)}
    with closing(pycolmap.Database.open(str(job.database))) as database:
        pair_ids, counts = database.read_two_view_geometry_num_inliers()
    pairs: list[tuple[int, int, int]] = []
    for pair_id, count in zip(pair_ids, counts, strict=True):
        one, other = pycolmap.pair_id_to_image_pair(pair_id)
        pairs.append((count, numbers[one], numbers[other]))
    described: list[dict[str, Any]] = []
    for index, photos in enumerate(members):
        apart = None if index == 0 else _apart(set(photos), set(members[0]), pairs, job)
        described.append({"size": len(photos), "photos": photos, "apart": apart})
    return described


def _apart(photos: set[int], largest: set[int], pairs: Sequence[tuple[int, int, int]], job: Job) -> str:
    between = [pair for pair in pairs if _joins(pair, photos - largest, largest)]
    strong = [pair for pair in between if pair[0] >= FEW_MATCHES]
    if strong:
        count, one, other = max(strong)
        pairs_connect = "1 pair connects" if len(strong) == 1 else f"{len(strong)} pairs connect"
        return (
            f"{pairs_connect} it to the largest (strongest: {job.names[one]} and {job.names[other]}, "
            f"{count} matches), but no consistent alignment was found"
        )
    if between:
        count, one, other = max(between)
        best = f"{job.names[one]} and {job.names[other]}, {count} matches"
        return f"no pair connects it well enough to the largest (best: {best})"
    return "none of its photos matches a photo of the largest"


def _joins(pair: tuple[int, int, int], photos: set[int], largest: set[int]) -> bool:
    _, one, other = pair
    return (one in photos and other in largest) or (other in photos and one in largest)
