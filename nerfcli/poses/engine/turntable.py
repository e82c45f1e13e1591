"""Detect an object that turns in front of a background that does not, before the long work, and make masks of it.

Features of a few reduced photos are compared first (see `stationary`), which takes seconds. If they show two motions,
masks of the object are made (see `still_background`), so that the poses describe the object's motion, as if the camera
went around it.
The masks are in the scene's folder, named after the photos like those of `--masks`, and training uses them too.
Existing masks of an earlier call are used unchanged, since they may have been edited by hand.
"""

from collections.abc import Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from nerfcli.errors import UserError, several
from nerfcli.matching.features import LOOSE_RATIO, Features, find_features, mutual_matches
from nerfcli.matching.stationary import Motions, Stationary, in_place, motions, together
from nerfcli.photos.images import image_size, read_image, reduced
from nerfcli.photos.masks import read_mask
from nerfcli.poses.engine.attached import mask_attached, recalled, remembered
from nerfcli.poses.engine.features import feature_keys
from nerfcli.poses.input import still_background as still
from nerfcli.poses.input.job import Job, Tell, WorkMask, file_key, read_stage, stage_key, write_stage
from nerfcli.poses.input.layout import write_mask

# Features are searched in photos reduced to this longer side, and so many are kept.
_SIDE_PX = 1000
_MOST_FEATURES = 1200
# If fewer than this fraction of the first pairs have static matches, no further pairs are compared.
_FEW_STILL = 0.25
# So many positions of the camera, each with a background of its own, are searched for.
_MOST_POSITIONS = 8
# Masks are accepted if most of the object's matches are inside and most of the background's outside, and if the
# fraction of a photo that they keep, in the median, is in this range.
_LEAST_RIGHT = 0.7
_WHITE = (0.003, 0.9)
# Change this whenever this module would find other masks or facts.
_VERSION = "two motions, displaced backgrounds, attached things"
_STAGE = "turntable.json"
# Hashes of each photo and of its mask as written, by the photo's name, so that masks that were edited since are kept.
_WRITTEN, _WRITTEN_VERSION = "turntable-masks.json", "two motions, displaced backgrounds"
MASKS = "masks"


@dataclass(frozen=True)
class ComparedPair:
    """The first of two photos by number, positions (N, 2) of matches in it as fractions of its size, and motions."""

    first: int
    places: np.ndarray
    motions: Motions


@dataclass(frozen=True)
class _Photo:
    """What is kept of a photo: size (width, height), the picture reduced to `still.SIDE_PX`, and features."""

    size: tuple[int, int]
    picture: np.ndarray
    features: Features


class _Photos:
    """Photos of a job by number, read when first needed."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._read: dict[int, _Photo] = {}

    def __getitem__(self, number: int) -> _Photo:
        return self._read[number]

    def read(self, numbers: Collection[int]) -> None:
        """Read photos that were not read before, several at a time."""
        missing = sorted(set(numbers) - self._read.keys())
        with ThreadPoolExecutor(self._job.threads) as pool:
            self._read.update(zip(missing, pool.map(self._photo, missing), strict=True))

    def _photo(self, number: int) -> _Photo:
        pixels = np.ascontiguousarray(read_image(self._job.photos / self._job.files[number])[..., :3])
        grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        features = find_features(grey, longer_side_px=_SIDE_PX, most=_MOST_FEATURES)
        return _Photo((grey.shape[1], grey.shape[0]), reduced(pixels, still.SIDE_PX), features)

    def matches(self, first: int, second: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (N, 2) in two photos at which they match; none in photos of other sizes."""
        one, other = self[first].features, self[second].features
        if self[first].size != self[second].size:
            return np.zeros((0, 2)), np.zeros((0, 2))
        a, b = mutual_matches(one.descriptors, other.descriptors, ratio=LOOSE_RATIO)
        return one.pixels[a], other.pixels[b]


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
    if content.get("attached"):
        masked = recalled(job, content["attached"])
        facts = {key: value for key, value in content.items() if key != "attached"}
        return None if masked is None else (masked, facts or None)
    if not content or not content["masked"]:
        return job, content or None
    unmasked = [name for name in content["unmasked"] if not (scene_masks(job) / f"{name}.png").is_file()]
    masks, content = [], content | {"unmasked": unmasked}
    for name, file in zip(job.names, job.files, strict=True):
        photo, mask = Path(job.originals) / name, scene_masks(job) / f"{name}.png"
        target = job.mask_folder / f"{file}.png"
        target.parent.mkdir(exist_ok=True)
        if name in unmasked:
            masks.append(WorkMask())
            continue
        try:
            masks.append(write_mask(target, read_mask(mask, photo) > 0))
        except UserError:
            return None
    return replace(job, masks=tuple(masks)), content


def mask_turning_object(job: Job, tell: Tell) -> tuple[Job, dict[str, Any] | None]:
    """Return the job with masks of the object, if one turns in front of a static background, and the facts to report.

    If none does, masks are those of what is attached to the camera. The job is unchanged if no masks can be accepted;
    the facts are None if there is nothing to report. Held-out photos get masks too, but only training photos decide
    whether and which. `tell` receives what was found.
    """
    photos = _Photos(job)
    training = [number for number in range(len(job.files)) if number not in job.held_out]
    compared = _compare_photos(photos, training)
    motions = _together(compared)
    facts: dict[str, Any] = {}
    if not motions.found:
        moving = [(pair.first, pair.places[pair.motions.moves]) for pair in compared]
        if attached := mask_attached(job, training, moving, tell):
            facts["attached"] = remembered(attached)
            job = replace(job, masks=tuple(attached))
    if not motions.two_motions:
        write_stage(Path(job.folder) / _STAGE, _key(job), facts)
        return job, None
    facts |= {
        "pairs": motions.two + motions.still + motions.moved,
        "pairs_two_motions": motions.two,
        "pairs_still": motions.still,
        "pairs_one_motion": motions.moved,
        "still_share": round(motions.cells, 4),
        "wide": motions.wide,
        "found": motions.found,
    }
    masks: list[np.ndarray | None] = [None] * len(job.files)
    edited: Collection[str] = ()
    if motions.found:
        tell("the object turns in front of a background that does not, as on a turntable: making masks of it")
        edited, masks = _edited_masks(job, tell), _make_masks(photos, training, others=job.held_out)
        facts |= _judge_masks(masks, compared)
        if "why_not" in facts:  # masks that the user has edited are still used
            masks = [None] * len(masks)
    unmasked = [name for name, mask in zip(job.names, masks, strict=True) if mask is None and name not in edited]
    facts |= {"masked": len(unmasked) < len(masks), "unmasked": unmasked}
    if facts["masked"]:
        job = replace(job, masks=_write_masks(job, masks, edited))
    write_stage(Path(job.folder) / _STAGE, _key(job), facts)
    facts.pop("attached", None)
    return job, facts


def describe_motions(facts: dict[str, Any]) -> str:
    """Describe the result for the user."""
    text = (
        f"the object turns in front of a background that does not ({facts['pairs_two_motions']} of {facts['pairs']} "
        "pairs show both motions)"
    )
    if not facts["masked"]:
        return (
            f"{text}; no masks of the object could be created, because {facts['why_not']}: give masks with --masks, "
            "white where the object is and black elsewhere"
        )
    unmasked = len(facts["unmasked"])
    rest = f", except for {several(unmasked, 'photo')}" if unmasked else ""
    text = f"{text}: its masks are in {MASKS}/ of the scene{rest}, and the poses are relative to the object"
    if unmasked and "why_not" in facts:
        text += f"; no masks of the rest could be created, because {facts['why_not']}"
    return text


def add_advice(error: UserError, facts: dict[str, Any] | None) -> UserError:
    """Return a refusal with advice on an object that turns in front of a static background, if there is one."""
    if facts is None or not facts["wide"]:
        return error
    masks = f"the edited masks in {MASKS}/ of the scene" if facts["masked"] else "white where the object is"
    found = "the object turns in front of a background that does not"
    hint = f"{found}: give masks of it with --masks, {masks}; or {error.hint}"
    return UserError(error.message, hint, error.exit_code)


def _compare_photos(photos: _Photos, numbers: Sequence[int]) -> list[ComparedPair]:
    """Compare photos near and far in the order of names; all pairs of a selection if names seem to have no order."""

    def compare(chosen: Iterable[tuple[int, int]]) -> list[ComparedPair]:
        pairs = sorted((numbers[first], numbers[second]) for first, second in chosen)
        photos.read({number for pair in pairs for number in pair})
        found = []
        for first, second in pairs:
            size = photos[first].size
            x, y = photos.matches(first, second)
            found.append(ComparedPair(first, x / size, motions(x, y, size)))
        return found

    few_anchors, anchors = 6, 24
    few, more = _pairs(len(numbers), few_anchors), _pairs(len(numbers), anchors)
    pairs = compare(few)
    if _together(pairs).found or sum(pair.motions.still > 0 for pair in pairs) < _FEW_STILL * len(pairs):
        return pairs
    pairs += compare(more - few)
    found = _together(pairs)
    if found.still > found.moved and not found.two_motions:
        pairs += compare(set(combinations(_anchors(len(numbers), anchors), 2)) - more - few)
    return pairs


def _together(pairs: Sequence[ComparedPair]) -> Stationary:
    return together([pair.motions for pair in pairs])


def _anchors(count: int, most: int) -> list[int]:
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int)).tolist()


def _pairs(count: int, most: int) -> set[tuple[int, int]]:
    """Return pairs of evenly chosen photos with those that soon follow them, and with one far away."""
    anchors = _anchors(count, most)
    near = {(i, i + step) for i in anchors for step in (1, 2, 4) if i + step < count}
    far = {(anchors[k], anchors[k + len(anchors) // 2]) for k in range(len(anchors) - len(anchors) // 2)}
    return {pair for pair in near | far if pair[0] < pair[1]}


def _make_masks(photos: _Photos, training: Sequence[int], *, others: Collection[int]) -> list[np.ndarray | None]:
    """Return a small mask of the object for each photo, None for photos without a matching background.

    The backgrounds are those of the training photos. From one position of the camera, they are equal but for a
    similarity: each photo that has one with the middle photo of those left, or with the first or last of those that
    have, has the same position.
    """
    left = sorted({*training, *others})
    photos.read(left)
    masks: dict[int, np.ndarray | None] = dict.fromkeys(left)
    for _ in range(_MOST_POSITIONS):
        candidates = [number for number in left if number in training]
        if len(candidates) < still.LEAST_PHOTOS:
            break
        middle = candidates[len(candidates) // 2]
        size, picture = photos[middle].size, photos[middle].picture
        found, places = {middle: np.eye(3)}, []
        for choose in (min, min, max):  # the middle one, then the first and the last that were found
            reference = choose(found)
            for number in left:
                if number in found:
                    continue
                x, y = photos.matches(reference, number)
                stays, similarity = in_place(x, y, size)
                if stays.any():
                    found[number] = np.vstack([similarity, (0, 0, 1)]) @ found[reference]
                    if reference == middle:
                        places.append(x[stays] / size)
        left = [number for number in left if number not in found]
        members = [number for number in found if number in training]
        if len(members) < still.LEAST_PHOTOS:
            continue
        pictures = [photos[number].picture for number in members]
        similarities = {number: placed[:2] * (1, 1, picture.shape[1] / size[0]) for number, placed in found.items()}
        behind = still.background(pictures, [similarities[number] for number in members], np.concatenate(places))
        for number, similarity in similarities.items():
            shown = photos[number].picture
            masks[number] = still.differs(shown, behind.seen_with(similarity, (shown.shape[1], shown.shape[0])))
    return [masks[number] for number in sorted(masks)]


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


def _edited_masks(job: Job, tell: Tell) -> set[str]:
    """Return the names of the photos whose masks the user has changed since they were written for this photo.

    Those of photos that got none are the user's too. Those that cannot be read or do not fit are renamed.
    """
    written, edited = read_stage(Path(job.folder) / _WRITTEN, _WRITTEN_VERSION) or {}, set[str]()
    for name, key in zip(job.names, job.keys, strict=True):
        path = scene_masks(job) / f"{name}.png"
        photo_key, mask_key = written.get(name, (key, "") if written else ("", ""))
        if key == photo_key and path.is_file() and file_key(path) != mask_key:
            try:
                read_mask(path, Path(job.originals) / name)
                edited.add(name)
            except UserError as error:
                unusable = path.with_name(f"unusable-{path.name}")
                path.replace(unusable)
                tell(f"{error.message}: it is now {unusable.name}, and is not used")
    return edited


def _write_masks(job: Job, masks: Sequence[np.ndarray | None], edited: Collection[str]) -> tuple[WorkMask, ...]:
    """Write the masks for the search for features, and those that were found for the user, except edited ones."""
    job.mask_folder.mkdir(exist_ok=True)
    stage = Path(job.folder) / _WRITTEN
    made = [name for name, mask in zip(job.names, masks, strict=True) if mask is not None and name not in edited]
    # If this call is interrupted, the next one must not take these masks for edited ones.
    written = (read_stage(stage, _WRITTEN_VERSION) or {}) | {name: ["", ""] for name in made}
    write_stage(stage, _WRITTEN_VERSION, written)
    laid_out = []
    for name, file, key, mask in zip(job.names, job.files, job.keys, masks, strict=True):
        path, target = scene_masks(job) / f"{name}.png", job.mask_folder / f"{file}.png"
        if name in edited:
            laid_out.append(write_mask(target, read_mask(path, Path(job.originals) / name) > 0))
            continue
        if mask is None:
            laid_out.append(WorkMask())
            photo_key, mask_key = written.pop(name, (None, None))
            if path.is_file() and (photo_key in ("", key) or file_key(path) == mask_key):  # training would use it
                path.unlink()
            continue
        mask = still.enlarged(mask, image_size(job.photos / file))
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(path)
        written[name] = [key, file_key(path)]
        laid_out.append(write_mask(target, mask))
    write_stage(stage, _WRITTEN_VERSION, written)
    return tuple(laid_out)


def _key(job: Job) -> str:
    return stage_key(_VERSION, feature_keys(replace(job, masks=())), job.held_out)
