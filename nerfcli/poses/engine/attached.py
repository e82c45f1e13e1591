"""Masks of what is attached to the camera, for the search for features: its own would hold all photos at one place."""

import shutil
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.errors import several
from nerfcli.matching.attached import Lens, enlarged, examined, fixed_mask, lens_of, small
from nerfcli.photos.images import image_size, read_image
from nerfcli.poses.input.job import Job, Tell, WorkMask
from nerfcli.poses.input.layout import write_mask

# A mask is not used if more than this fraction of the matches that move lie in it: it would be of the object.
MOST_MOVING = 0.02


def mask_attached(
    job: Job, numbers: Collection[int], moving: Sequence[tuple[int, np.ndarray]], tell: Tell
) -> Sequence[WorkMask]:
    """Write masks of what has the same place in the photos of a camera, and return them; none if nothing has.

    They are for the search for features alone: without poses, an edge along which the scene moves looks the same, such
    as a rail before a train. Training finds what is attached again, with the poses.

    Args:
        numbers: of the photos that decide.
        moving: photos by number with places (N, 2) in them of matches that move, as fractions of the photo's size.
    """
    sizes = [image_size(job.photos / file) for file in job.files]
    lenses = [lens_of(name, size) for name, size in zip(job.names, sizes, strict=True)]
    groups: dict[Lens, list[int]] = {}
    for number in sorted(numbers):
        groups.setdefault(lenses[number], []).append(number)
    masks: dict[Lens, np.ndarray] = {}
    with ThreadPoolExecutor(job.threads) as pool:
        for lens, group in groups.items():
            files = [job.photos / job.files[group[index]] for index in examined(len(group))]
            pictures = list(pool.map(lambda file: small(read_image(file)[..., :3]), files))
            mask = fixed_mask(np.stack(pictures)) if pictures else None
            if mask is None:
                continue
            places = np.concatenate([np.zeros((0, 2)), *(found for number, found in moving if lenses[number] == lens)])
            columns, rows = (places * mask.shape[::-1]).astype(int).clip(0, np.array(mask.shape[::-1]) - 1).T
            if mask[rows, columns].sum() < MOST_MOVING * len(places):
                masks[lens] = enlarged(mask, lens[1])
    if not masks:
        return ()
    fraction = 100.0 * np.mean([mask.mean() for mask in masks.values()])
    masked = several(sum(lens in masks for lens in lenses), "photo")
    tell(f"attached to the camera: {fraction:.1f} % of the pixels of {masked}, where no features are searched for")
    job.mask_folder.mkdir(exist_ok=True)
    written: dict[Lens, tuple[Path, WorkMask]] = {}
    used = []
    for file, lens in zip(job.files, lenses, strict=True):
        path = job.mask_folder / f"{file}.png"
        if lens in written:
            shutil.copyfile(written[lens][0], path)
        elif lens in masks:
            written[lens] = path, write_mask(path, ~masks[lens])
        used.append(written[lens][1] if lens in masks else WorkMask())
    return used


def remembered(masks: Sequence[WorkMask]) -> list[Any]:
    """Return masks as `recalled` takes them."""
    return [astuple(mask) for mask in masks]


def recalled(job: Job, masks: Sequence[Any]) -> Job | None:
    """Return the job with the masks that `mask_attached` wrote for it; None if one of their files is missing."""
    found = tuple(WorkMask(*mask) for mask in masks)
    paths = [job.mask_folder / f"{file}.png" for file, mask in zip(job.files, found, strict=True) if mask.key]
    return replace(job, masks=found) if all(path.is_file() for path in paths) else None
