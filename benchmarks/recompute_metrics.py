"""Are the numbers of `nerfcli evaluate` those of other programs? Recomputed from saved predictions, as they do it.

    nerfcli evaluate RUN --save-predictions float --overwrite
    python benchmarks/recompute_metrics.py RUN [RUN...] [-o table.csv]

Nothing of nerfcli is imported. Pictures are read by imageio, and measured as

    nerfbaselines  (nerfbaselines/metrics.py): both pictures 8 bit, divided by 255 in float32, -10 log10 of the mean
                   squared error, and SSIM as dm_pix has it: Gaussian 11 x 11, sigma 1.5, data range 1, windows inside
                   the picture only. It is written out here, with SciPy's convolution.
    nerfstudio     (models/nerfacto.py): the unrounded picture, torchmetrics' PSNR with data range 1 and SSIM without
                   one: it then takes the range of values that the pictures have, and (torchmetrics 1.9; older ones did
                   not) a border of windows that hang over the picture, filled with its reflection. "nerfstudio,
                   inside" is the same with data range 1 and the windows inside, which is our definition.
    scikit-image   peak_signal_noise_ratio and structural_similarity, Gaussian, of 8-bit pictures.

Photos with masked pixels are left out of the comparison: these programs know no masks. Exit code 1 where a definition
that is ours differs from metrics.json by 1e-3 dB or 1e-4 of SSIM.
"""

import argparse
import csv
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch
from scipy.signal import convolve2d
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import peak_signal_noise_ratio as torchmetrics_psnr
from torchmetrics.functional.image import structural_similarity_index_measure as torchmetrics_ssim

MOST_PSNR, MOST_SSIM = 1e-3, 1e-4
BORDER = 5
Pair = Callable[[np.ndarray, np.ndarray], tuple[float, float]]


def nerfbaselines(picture: np.ndarray, photo: np.ndarray) -> tuple[float, float]:
    """PSNR and SSIM of 8-bit pictures."""
    one, other = (np.asarray(p / 255.0, dtype=np.float32) for p in (picture, photo))
    taps = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    window = np.outer(taps, taps) / taps.sum() ** 2

    def mean(values: np.ndarray) -> np.ndarray:
        channels = [convolve2d(values[..., channel], window, mode="valid") for channel in range(3)]
        return np.stack(channels, axis=-1)

    mu0, mu1 = mean(one), mean(other)
    tiny = np.finfo(np.float32).eps ** 2
    var0, var1 = (np.maximum(tiny, mean(p**2) - mu**2) for p, mu in ((one, mu0), (other, mu1)))
    both = mean(one * other) - mu0 * mu1
    both = np.sign(both) * np.minimum(np.sqrt(var0 * var1), np.abs(both))
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * mu0 * mu1 + c1) * (2 * both + c2) / ((mu0**2 + mu1**2 + c1) * (var0 + var1 + c2))
    return float(-10 * np.log10(((one - other) ** 2).mean())), float(ssim.mean())


def scikit_image(picture: np.ndarray, photo: np.ndarray) -> tuple[float, float]:
    """PSNR and SSIM of 8-bit pictures."""
    ssim: Any = structural_similarity(
        photo, picture, channel_axis=2, data_range=255, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    return float(peak_signal_noise_ratio(photo, picture, data_range=255)), float(ssim)


def nerfstudio(picture: np.ndarray, photo: np.ndarray) -> tuple[float, float]:
    """PSNR and SSIM of unrounded pictures, as nerfacto calls torchmetrics."""
    rgb, image = _tensors(picture, photo)
    ssim: Any = torchmetrics_ssim(image, rgb)
    return float(torchmetrics_psnr(image, rgb, data_range=1.0)), float(ssim)


def nerfstudio_inside(picture: np.ndarray, photo: np.ndarray) -> tuple[float, float]:
    """PSNR and SSIM like `nerfstudio`, but with data range 1 and only windows inside the picture."""
    rgb, image = _tensors(picture, photo)
    full: Any = torchmetrics_ssim(image, rgb, data_range=1.0, return_full_image=True)[1]
    inside = full[..., BORDER:-BORDER, BORDER:-BORDER]
    return float(torchmetrics_psnr(image, rgb, data_range=1.0)), float(inside.mean())


def _tensors(*pictures: np.ndarray) -> list[torch.Tensor]:
    floats = [p / np.float32(255) if p.dtype == np.uint8 else p for p in pictures]
    return [torch.from_numpy(np.ascontiguousarray(p, dtype=np.float32)).permute(2, 0, 1)[None] for p in floats]


# Name, function, whether it takes unrounded pictures, and whether its definition is the same as ours.
DEFINITIONS: tuple[tuple[str, Pair, bool, bool], ...] = (
    ("nerfbaselines", nerfbaselines, False, True),
    ("scikit-image", scikit_image, False, True),
    ("nerfstudio, inside", nerfstudio_inside, True, True),
    ("nerfstudio", nerfstudio, True, False),
)


def compare(run: Path) -> list[dict[str, Any]]:
    """Return for each definition our mean, the recomputed mean, and the largest difference for a single photo."""
    folder = run / "predictions"
    info = json.loads((folder / "info.json").read_text())
    metrics = json.loads((run / "metrics.json").read_text())
    if info["checkpoint_sha256"] != metrics["checkpoint_sha256"]:
        sys.exit(f"{folder} is not of the run that {run / 'metrics.json'} measured")
    rows = []
    for name, measure, unrounded, same in DEFINITIONS:
        if unrounded and info["kind"] != "float":
            continue
        suffix = "_float" if unrounded else ""
        ours, theirs = [], []
        for image in metrics["images"]:
            stem = info["files"][image["name"]]
            if (folder / "mask" / f"{stem}.png").exists():
                continue
            photo = iio.imread(folder / "gt-color" / f"{stem}.png")
            if unrounded:
                picture = np.load(folder / "color-float" / f"{stem}.npy")
            else:
                picture = iio.imread(folder / "color" / f"{stem}.png")
            ours.append((image[f"psnr{suffix}"], image[f"ssim{suffix}"]))
            theirs.append(measure(picture, photo))
        differences = np.abs(np.subtract(ours, theirs)).max(axis=0)
        rows.append(
            {
                "run": run.name,
                "definition": name,
                "photos": len(ours),
                "ours_psnr": np.mean(ours, axis=0)[0],
                "theirs_psnr": np.mean(theirs, axis=0)[0],
                "largest_psnr_difference": differences[0],
                "ours_ssim": np.mean(ours, axis=0)[1],
                "theirs_ssim": np.mean(theirs, axis=0)[1],
                "largest_ssim_difference": differences[1],
                "same_definition": same,
            }
        )
    return rows


def main() -> None:
    """Print and write the table; exit with 1 if a difference exceeds its bound."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    rows = [row for run in arguments.runs for row in compare(run)]
    print(f"{'run':20} {'definition':20} photos   PSNR ours    theirs  largest |d|  SSIM ours   theirs  largest |d|")
    bad = False
    for row in rows:
        wrong = row["same_definition"] and (
            row["largest_psnr_difference"] >= MOST_PSNR or row["largest_ssim_difference"] >= MOST_SSIM
        )
        bad = bad or wrong
        verdict = "DIFFERS" if wrong else "" if row["same_definition"] else "(another definition)"
        numbers = (
            f"{row['ours_psnr']:11.4f} {row['theirs_psnr']:9.4f} {row['largest_psnr_difference']:12.1e}",
            f"{row['ours_ssim']:10.5f} {row['theirs_ssim']:8.5f} {row['largest_ssim_difference']:12.1e}",
        )
        print(f"{row['run']:20} {row['definition']:20} {row['photos']:6}", *numbers, f" {verdict}")
    if arguments.output:
        with arguments.output.open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)
    sys.exit(bad)


if __name__ == "__main__":
    main()
