"""Photos as three cameras would have taken them: exposure, colour matrix, contrast and vignetting are known.

    python benchmarks/colour_capture.py sample_scenes/desk captures/desk-three-cameras
    python benchmarks/colour_capture.py sample_scenes/desk captures/desk-exposures --only gains
    nerfcli train captures/desk-three-cameras --with exposure=learned

The photos are those of three cameras in turn. Each camera has a 3x3 colour matrix whose rows sum to 1, a contrast and
vignetting; each photo has its own gains. In linear light, with r^2 = 1 in the corners of the picture:

    light' = gains * 0.18 * (matrix @ light * (1 + v1 r^2 + v2 r^4) / 0.18)^contrast

Writes images/, transforms.json and colours.json, which holds the truth.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from nerfcli.media.colours import linear_light

Array = NDArray[np.float64]

EFFECTS = ("gains", "matrix", "contrast", "vignetting")
MATRICES = np.array(
    [
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        [[1.25, -0.2, -0.05], [-0.1, 1.2, -0.1], [0.0, -0.2, 1.2]],
        [[0.85, 0.1, 0.05], [0.05, 0.9, 0.05], [0.0, 0.1, 0.9]],
    ]
)
CONTRASTS = (1.0, 1.2, 0.85)
VIGNETTING = ((0.0, 0.0), (-0.3, -0.1), (-0.1, -0.2))
MIDDLE = 0.18
# Standard deviations of log gains: of the part common to a photo's channels, and of each channel's own.
GAIN, WHITE_BALANCE = 0.25, 0.08


def developed(light: Array, truth: dict[str, Any]) -> Array:
    """Return linear light (H, W, 3) developed with a photo's parameters, not clipped."""
    height, width = light.shape[:2]
    y, x = np.mgrid[:height, :width] + 0.5
    squared = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / ((width / 2) ** 2 + (height / 2) ** 2)
    first, second = truth["vignetting"]
    seen = light @ np.array(truth["matrix"]).T * (1.0 + first * squared + second * squared**2)[..., None]
    return np.exp(truth["log_gains"]) * MIDDLE * (np.maximum(seen, 0.0) / MIDDLE) ** truth["contrast"]


def truths(count: int, *, effects: tuple[str, ...], seed: int = 0) -> list[dict[str, Any]]:
    """Return each photo's parameters; effects that are left out are neutral."""
    rng = np.random.default_rng(seed)
    gains = rng.normal(0.0, GAIN, (count, 1)) + rng.normal(0.0, WHITE_BALANCE, (count, 3))
    return [
        {
            "camera": (camera := photo % len(MATRICES)),
            "log_gains": gains[photo].tolist() if "gains" in effects else [0.0] * 3,
            "matrix": (MATRICES[camera] if "matrix" in effects else np.eye(3)).tolist(),
            "contrast": CONTRASTS[camera] if "contrast" in effects else 1.0,
            "vignetting": VIGNETTING[camera] if "vignetting" in effects else (0.0, 0.0),
        }
        for photo in range(count)
    ]


def write(source: Path, out: Path, *, effects: tuple[str, ...], reduction: int) -> None:
    """Write images/, transforms.json and colours.json from photos with known cameras.

    Args:
        source: a folder like sample_scenes/desk.
        out: the folder to write into.
        effects: some of `EFFECTS`.
        reduction: factor by which the photos' sides are reduced.
    """
    recorded = json.loads((source / "truth" / "cameras.json").read_text())
    (focal, x, y, k1, k2), names = recorded["camera"]["params"], sorted(image["name"] for image in recorded["images"])
    poses = {image["name"]: np.array(image["world_from_cam"]) for image in recorded["images"]}
    (out / "images").mkdir(parents=True, exist_ok=True)
    effects_by_photo = dict(zip(names, truths(len(names), effects=effects), strict=True))
    width, height = recorded["camera"]["width"] // reduction, recorded["camera"]["height"] // reduction
    for name in names:
        photo = Image.open(source / "images" / name).resize((width, height), Image.Resampling.BOX)
        light = developed(linear_light(np.asarray(photo) / 255.0), effects_by_photo[name])
        curved = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)
        levels = np.round(255 * curved.clip(0, 1)).astype(np.uint8)
        Image.fromarray(levels).save(out / "images" / f"{Path(name).stem}.png")
    flip = np.diag([1.0, -1.0, -1.0, 1.0])  # to the OpenGL axes of the format
    frames = [
        {"file_path": f"images/{Path(name).stem}.png", "transform_matrix": (poses[name] @ flip).tolist()}
        for name in names
    ]
    described = {
        "camera_model": "OPENCV",
        "w": width,
        "h": height,
        "fl_x": focal / reduction,
        "fl_y": focal / reduction,
        "cx": x / reduction,
        "cy": y / reduction,
        "k1": k1,
        "k2": k2,
        "p1": 0.0,
        "p2": 0.0,
        "frames": frames,
    }
    (out / "transforms.json").write_text(json.dumps(described, indent=1))
    (out / "colours.json").write_text(json.dumps(effects_by_photo, indent=1))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", nargs="*", choices=EFFECTS, default=EFFECTS)
    parser.add_argument("--reduction", type=int, default=2)
    chosen = parser.parse_args()
    write(chosen.source, chosen.out, effects=tuple(chosen.only), reduction=chosen.reduction)
