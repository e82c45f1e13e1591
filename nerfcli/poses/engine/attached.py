"""Masks of what is attached to the camera, for the search for features: its own would hold all photos at one place."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from nerfcli.errors import UserError, several
from nerfcli.matching.attached import Lens, enlarged, examined, fixed_mask, lens_of, reduced
from nerfcli.photos.images import image_size, read_image
from nerfcli.poses.input.job import Job, Tell
from nerfcli.poses.input.layout import write_mask, write_no_mask


def mask_attached(job: Job, pictures: Mapping[int, np.ndarray], tell: Tell) -> Job | None:
    """Return the job with masks of what has the same place in the photos of a camera; None if nothing has.

    They are for the search for features alone: without poses, an edge along which the scene moves looks the same, such
    as a rail before a train. Training finds what is attached again, with the poses.

    Args:
        pictures: reduced pictures (h, w, 3) of some of the photos, by number; these decide.
    """
    sizes = [image_size(job.photos / file) for file in job.files]
    lenses = [lens_of(name, size) for name, size in zip(job.names, sizes, strict=True)]
    groups: dict[Lens, list[int]] = {}
    for number in sorted(pictures):
        groups.setdefault(lenses[number], []).append(number)
    masks: dict[Lens, np.ndarray] = {}
    for lens, group in groups.items():
        chosen = [reduced(pictures[group[index]]) for index in examined(len(group))]
        mask = fixed_mask(np.stack(chosen)) if chosen else None
        if mask is not None:
            masks[lens] = ~enlarged(mask, lens[1])
    if not masks:
        return None
    fraction = 100.0 * np.mean([1.0 - mask.mean() for mask in masks.values()])
    masked = several(sum(lens in masks for lens in lenses), "photo")
    tell(f"attached to the camera: {fraction:.1f} % of the pixels of {masked}, where no features are searched for")
    job.mask_folder.mkdir(exist_ok=True)
    return replace(
        job,
        masks=tuple(
            write_mask(job.mask_folder / f"{file}.png", masks[lens])
            if lens in masks
            else write_no_mask(job.mask_folder / f"{file}.png", lens[1])
            for file, lens in zip(job.files, lenses, strict=True)
        ),
    )


def recall_attached(job: Job) -> Job | None:
    """Return the job with the masks that `mask_attached` wrote for it; None if one is missing or damaged."""
    try:
        masks = [read_image(job.mask_folder / f"{file}.png")[..., 0] > 0 for file in job.files]
    except UserError:
        return None
    laid_out = [write_mask(job.mask_folder / f"{file}.png", mask) for file, mask in zip(job.files, masks, strict=True)]
    return replace(job, masks=tuple(laid_out))
