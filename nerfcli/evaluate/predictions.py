"""Save compared pictures in the layout of nerfbaselines, for evaluation with other programs.

predictions/color/NAME.png         the rendered picture, 8 bit sRGB
predictions/gt-color/NAME.png      the photo as it was compared: upright, averaged to the size of the training
predictions/mask/NAME.png          255 where pixels count; only where some do not
predictions/color-float/NAME.npy   the rendered picture before rounding, float32; only on request
"""

import json
from pathlib import Path

import numpy as np

from nerfcli.evaluate.metrics import to_8_bit
from nerfcli.evaluate.protocol import ComparedImages
from nerfcli.photos.images import write_png

PREDICTIONS = "predictions"
INFO = "info.json"
# Choices: 8-bit pictures only, or unrounded ones, too.
KINDS = ("png", "float")


def save_compared(folder: Path, stem: str, compared: ComparedImages, *, kind: str) -> None:
    """Write the 8-bit picture, the photo and, where pixels are left out, the mask.

    Args:
        folder: the folder of predictions.
        stem: the name of the files, without suffix; subfolders are created.
        kind: one of `KINDS`.
    """
    write_png(folder / "color" / f"{stem}.png", to_8_bit(compared.rendered))
    write_png(folder / "gt-color" / f"{stem}.png", compared.photo)
    if not compared.used.all():
        write_png(folder / "mask" / f"{stem}.png", compared.used.astype(np.uint8) * 255)
    if kind == "float":
        path = folder / "color-float" / f"{stem}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, compared.rendered.astype(np.float32))


def predictions_are_there(folder: Path, kind: str, *, checkpoint: str) -> bool:
    """Return whether predictions of this checkpoint are saved, including unrounded ones if `kind` is "float"."""
    try:
        info = json.loads((folder / INFO).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return info.get("checkpoint_sha256") == checkpoint and kind in (info.get("kind"), "png")
