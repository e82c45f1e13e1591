"""Write masks of the pixels that a training leaves out, to look at."""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from nerfcli.photos.masks import write_masks

# Folder of a run, named like the component that leaves pixels out.
OCCLUDERS = "occluders"


def remove_left_out(run: Path) -> None:
    """Remove the masks of an earlier training from a run folder."""
    if (run / OCCLUDERS).is_dir():
        shutil.rmtree(run / OCCLUDERS)


def write_left_out(run: Path, masks: Mapping[str, np.ndarray], *, notify: Callable[[str], None]) -> None:
    """Write RUN/occluders/PHOTO.png, black where pixels are left out, for each photo with such pixels; report how many.

    Args:
        run: its folder; masks of an earlier training are replaced.
        masks: (height, width) bool by the name of the photo, True where pixels are used.

    Raises:
        UserError: the masks cannot be written.
    """
    folder = run / OCCLUDERS
    left_out = {name: 100.0 * float(1.0 - mask.mean()) for name, mask in masks.items()}
    most = sorted((name for name in left_out if left_out[name]), key=lambda name: -left_out[name])
    shutil.rmtree(folder, ignore_errors=True)
    write_masks(folder, {name: masks[name] for name in most})
    if not most:
        notify("occluders: none found")
        return
    named = ", ".join(f"{name} {left_out[name]:.0f} %" for name in most[:3])
    mean = np.mean(list(left_out.values()))
    notify(
        f"occluders: {mean:.1f} % of the pixels left out, in {len(most)} of {len(masks)} photos, most in {named}; "
        f"masks in {folder}"
    )
