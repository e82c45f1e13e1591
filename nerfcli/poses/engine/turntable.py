"""Detect an object that turns in front of a static background, from a job's features, and make masks of the object.

A few pairs of photos are compared before the long work (see `stationary`). If they show two motions, masks of the
object are made (see `still_background`), so that the poses describe the object's motion, as if the camera went around
it.
The masks are in the scene's folder, named after the photos like those of `--masks`, and training uses them too.
Existing masks of an earlier call are used unchanged, since they may have been edited by hand.
"""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from PIL import Image

from nerfcli.errors import UserError
from nerfcli.matching.features import LOOSE_RATIO, mutual_matches
from nerfcli.matching.graph import connected_groups
from nerfcli.matching.stationary import Motions, Stationary, motions, together
from nerfcli.photos.images import image_size, read_image
from nerfcli.photos.masks import read_mask
from nerfcli.poses.engine.features import feature_keys
from nerfcli.poses.engine.retrieval import coarsest
from nerfcli.poses.input import still_background as still
from nerfcli.poses.input.job import Job, WorkMask
from nerfcli.poses.input.layout import write_mask, write_no_mask
from nerfcli.poses.input.stages import read_stage, stage_key, write_stage

# If fewer than this fraction of the first pairs have static matches, no further pairs are compared.
_FEW_STILL = 0.25
# A photo from the same camera position agrees with at least this fraction of the background that some photos show.
_SAME_PLACE = 0.25
# Masks are accepted if most of the object's matches are inside and most of the background's outside, and if the
# fraction of a photo that they keep, in the median, is in this range.
_LEAST_RIGHT = 0.7
_WHITE = (0.003, 0.9)
# Change this whenever this module would find other masks or facts.
_VERSION = "two motions, 2"
_STAGE = "turntable.json"
MASKS = "masks"


@dataclass(frozen=True)
class ComparedPair:
    """Two photos by number, positions (N, 2) of matches in the first as fractions of its size, and their motions."""

    first: int
    second: int
    places: np.ndarray
    motions: Motions


def scene_masks(job: Job) -> Path:
    """Return the folder of the object masks of a job, in the scene folder."""
    return Path(job.folder).parent / MASKS


def recall_masks(job: Job) -> tuple[Job, dict[str, Any] | None] | None:
    """Return the job with the masks of an earlier call, and the facts to report; None if they must be found again.

    Masks that the user gave are used unchanged.
    """
    if job.masks:
        return job, None
    content = read_stage(Path(job.folder) / _STAGE, _key(job))
    if content is None:
        return None
    if not content or not content["masked"]:
        return job, content or None
    masks = []
    for name, file in zip(job.names, job.files, strict=True):
        photo, mask = Path(job.originals) / name, scene_masks(job) / f"{name}.png"
        target = job.mask_folder / f"{file}.png"
        target.parent.mkdir(exist_ok=True)
        if name in content["unmasked"]:
            masks.append(write_no_mask(target, image_size(job.photos / file)))
            continue
        try:
            masks.append(write_mask(target, read_mask(mask, photo) > 0))
        except UserError:
            return None
    return replace(job, masks=tuple(masks)), content


def mask_turning_object(job: Job, featured: Job) -> tuple[Job, dict[str, Any] | None]:
    """Return the job with masks of the object, if one turns in front of a static background, and the facts to report.

    The database has the features of the job `featured`, with the same photos or some of them. The job is unchanged if
    no masks can be accepted; the facts are None if there is nothing to report.
    """
    start = time.perf_counter()
    compared = _compare_photos(featured)
    motions = _together(compared)
    if not motions.two_motions:
        write_stage(Path(job.folder) / _STAGE, _key(job), {})
        return job, None
    facts: dict[str, Any] = {
        "pairs": motions.two + motions.still + motions.moved,
        "pairs_two_motions": motions.two,
        "pairs_still": motions.still,
        "pairs_one_motion": motions.moved,
        "still_share": round(motions.cells, 4),
        "wide": motions.wide,
        "found": motions.found,
    }
    masks: list[np.ndarray | None] = [None] * len(job.files)
    if motions.found:
        number = [job.files.index(file) for file in featured.files]
        compared = [replace(pair, first=number[pair.first], second=number[pair.second]) for pair in compared]
        masks = _make_masks(job, compared)
        facts |= _judge_masks(masks, compared)
    facts["masked"] = facts.get("why_not") is None and motions.found
    facts["unmasked"] = [name for name, mask in zip(job.names, masks, strict=True) if mask is None]
    if facts["masked"]:
        job = replace(job, masks=_write_masks(job, masks))
    facts["seconds"] = round(time.perf_counter() - start, 3)
    write_stage(Path(job.folder) / _STAGE, _key(job), facts)
    return job, facts


def describe_motions(facts: dict[str, Any]) -> str:
    """Describe the result for the user."""
    text = (
        f"an object moves in front of a static background, as on a turntable ({facts['pairs_two_motions']} of "
        f"{facts['pairs']} pairs show both motions)"
    )
    if not facts["masked"]:
        return f"{text}; no masks of the object could be created, because {facts['why_not']}: give masks with --masks"
    several = len(facts["unmasked"])
    rest = f", except for {several} photos" if several else ""
    return f"{text}: its masks are in {MASKS}/ of the scene{rest}, and the poses are relative to the object"


def add_advice(error: UserError, facts: dict[str, Any] | None) -> UserError:
    """Return a refusal with advice on an object that turns in front of a static background, if there is one."""
    if facts is None or not facts["wide"]:
        return error
    masks = f"the edited masks in {MASKS}/ of the scene" if facts["masked"] else "white where the object is"
    hint = f"an object moves in front of a static background: give masks of it with --masks, {masks}; or {error.hint}"
    return UserError(error.message, hint, error.exit_code)


def _compare_photos(job: Job) -> list[ComparedPair]:
    """Compare photos near and far in the order of names; all pairs of a selection if names seem to have no order."""

    @cache
    def features(number: int) -> tuple[np.ndarray, np.ndarray]:
        with pycolmap.Database.open(job.database) as database:
            return coarsest(database, job.image_ids[number], 1200)

    def compare(chosen: Iterable[tuple[int, int]]) -> list[ComparedPair]:
        found = []
        for first, second in sorted(chosen):
            if sizes[first] == sizes[second]:
                (x, one), (y, other) = features(first), features(second)
                a, b = mutual_matches(one, other, ratio=LOOSE_RATIO)
                moves = motions(x[a], y[b], sizes[first])
                found.append(ComparedPair(first, second, x[a] / sizes[first], moves))
        return found

    sizes = [job.sizes[image_id] for image_id in job.image_ids]
    few_anchors, anchors = 8, 24
    few, more = _pairs(len(sizes), few_anchors), _pairs(len(sizes), anchors)
    pairs = compare(few)
    if sum(pair.motions.still > 0 for pair in pairs) < _FEW_STILL * len(pairs):
        return pairs
    pairs += compare(more - few)
    found = _together(pairs)
    if found.still > found.moved and not found.two_motions:
        pairs += compare(set(combinations(_anchors(len(sizes), anchors), 2)) - more - few)
    return pairs


def _together(pairs: Sequence[ComparedPair]) -> Stationary:
    return together([(pair.first, pair.second, pair.motions) for pair in pairs])


def _anchors(count: int, most: int) -> list[int]:
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int)).tolist()


def _pairs(count: int, most: int) -> set[tuple[int, int]]:
    """Return pairs of evenly chosen photos with those that soon follow them, and with one far away."""
    anchors = _anchors(count, most)
    near = {(i, i + step) for i in anchors for step in (1, 2, 4) if i + step < count}
    far = {(anchors[k], anchors[k + len(anchors) // 2]) for k in range(len(anchors) - len(anchors) // 2)}
    return {pair for pair in near | far if pair[0] < pair[1]}


def _make_masks(job: Job, pairs: Sequence[ComparedPair]) -> list[np.ndarray | None]:
    """Return a small mask of the object for each photo, None for photos without a matching background."""
    # Photos connected by static matches have one camera position.
    static = [(pair.first, pair.second) for pair in pairs if pair.motions.two or pair.motions.only_still]
    groups = [group for group in connected_groups(range(len(job.files)), static) if len(group) > 1]
    pictures = [still.small(read_image(job.photos / file)[..., :3]) for file in job.files]
    behinds = []
    for group in groups:
        members = [number for number in group if pictures[number].shape == pictures[group[0]].shape]
        inside = set(members)
        stay = [pair.places[pair.motions.stays] for pair in pairs if {pair.first, pair.second} <= inside]
        if len(members) >= still.LEAST_PHOTOS and stay:
            behinds.append(still.background([pictures[number] for number in members], np.concatenate(stay)))
    masks: list[np.ndarray | None] = []
    for picture in pictures:
        fitting = [behind for behind in behinds if behind.colours.shape == picture.shape]
        agreements = [still.agreement(picture, behind) for behind in fitting]
        best = max(agreements, default=0.0)
        masks.append(still.differs(picture, fitting[agreements.index(best)]) if best >= _SAME_PLACE else None)
    return masks


def _judge_masks(masks: Sequence[np.ndarray | None], pairs: Sequence[ComparedPair]) -> dict[str, Any]:
    """Return the fraction of the photos that the masks keep, and of either motion's matches on the right side of them.

    "why_not" is there if the masks cannot be accepted.
    """
    moving, staying = [], []
    for pair in pairs:
        mask = masks[pair.first]
        if mask is None or not pair.motions.two:
            continue
        height, width = mask.shape
        columns, rows = (pair.places * (width, height)).astype(int).clip(0, (width - 1, height - 1)).T
        inside = mask[rows, columns]
        moving.append(inside[pair.motions.moves].mean())
        staying.append(1 - inside[pair.motions.stays].mean())
    if not moving:
        return {"why_not": "too few photos show the same background"}
    white = np.quantile([mask.mean() for mask in masks if mask is not None], [0, 0.5, 1])
    right = float(np.median(moving)), float(np.median(staying))
    facts: dict[str, Any] = {
        "white_share": [round(float(fraction), 4) for fraction in white],
        "object_matches_in_white": round(right[0], 4),
        "background_matches_in_black": round(right[1], 4),
    }
    if not _WHITE[0] <= white[1] <= _WHITE[1]:
        facts["why_not"] = f"they would cover {100 * white[1]:.1f} % of a photo"
    elif min(right) < _LEAST_RIGHT:
        facts["why_not"] = (
            f"they would contain {100 * right[0]:.0f} % of the object's matches and {100 - 100 * right[1]:.0f} % of "
            "the background's"
        )
    return facts


def _write_masks(job: Job, masks: Sequence[np.ndarray | None]) -> tuple[WorkMask, ...]:
    """Write a mask of each photo for pycolmap, and the object masks that were found for the user."""
    job.mask_folder.mkdir(exist_ok=True)
    scene_masks(job).mkdir(exist_ok=True)
    laid_out = []
    for name, file, mask in zip(job.names, job.files, masks, strict=True):
        size, target = image_size(job.photos / file), job.mask_folder / f"{file}.png"
        if mask is None:
            laid_out.append(write_no_mask(target, size))
            continue
        used = still.enlarged(mask, size)
        laid_out.append(write_mask(target, used))
        Image.fromarray(used).save(scene_masks(job) / f"{name}.png")
    return tuple(laid_out)


def _key(job: Job) -> str:
    return stage_key(_VERSION, feature_keys(replace(job, masks=())), job.held_out)
