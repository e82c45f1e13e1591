"""Write masks of what moves in the training photos, to look at and to edit."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from nerfcli.fit.movers import Movers
from nerfcli.photos.mask_files import write_masks
from nerfcli.photos.pool import PixelPool

FOLDER = "movers"
# Number of photos named in the message.
_NAMED = 3


def write_moving_masks(run: Path, movers: Movers, pool: PixelPool, *, notify: Callable[[str], None]) -> None:
    """Write RUN/movers/PHOTO.png, black where something moves, for each photo with movers; report how much it is.

    Raises:
        UserError: the masks cannot be written.
    """
    masks = {frame.name: movers.mask(photo).cpu().numpy() for photo, frame in enumerate(pool.frames)}
    moving = {name: 100.0 * float(1.0 - mask.mean()) for name, mask in masks.items()}
    most = sorted((name for name in moving if moving[name]), key=lambda name: -moving[name])
    shutil.rmtree(run / FOLDER, ignore_errors=True)
    write_masks(run / FOLDER, {name: masks[name] for name in most})
    if not most:
        notify("movers: none found")
        return
    named = ", ".join(f"{name} {moving[name]:.0f} %" for name in most[:_NAMED])
    mean = np.mean(list(moving.values()))
    notify(
        f"movers: {mean:.1f} % of the pixels left out, in {len(most)} of {len(moving)} photos, "
        f"most in {named}; masks in {run / FOLDER}"
    )
