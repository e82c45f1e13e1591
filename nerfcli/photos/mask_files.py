"""Masks of photos as files."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nerfcli.media.images import write_png


def write_masks(folder: Path, masks: Mapping[str, np.ndarray]) -> None:
    """Write FOLDER/PHOTO.png for masks (height, width) bool by the name of the photo: white is used, black ignored.

    Raises:
        UserError: they cannot be written.
    """
    for name, mask in masks.items():
        write_png(folder / f"{name}.png", np.where(mask, 255, 0).astype(np.uint8))
