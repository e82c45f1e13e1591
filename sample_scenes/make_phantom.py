"""Makes sample_scenes/phantom: an X-ray scan of ellipsoids whose line integrals have a closed form.

    python make_phantom.py --out phantom

Needs NumPy and tifffile only. A pixel is the mean transmission of SUBPIXELS x SUBPIXELS rays, measured by counting
photons behind a detector with an offset and an uneven sensitivity; flats and darks come from the same detector.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import tifffile
from ellipsoids import attenuation_of_voxels, bean, line_integrals

VIEWS, ROWS, COLUMNS = 48, 48, 64
# mm: the source goes around the object once, counter-clockwise seen from above.
SOURCE_ORIGIN, SOURCE_DETECTOR, PIXEL = 60.0, 90.0, 0.6
SUBPIXELS = 3
PHOTONS, VALUES_PER_PHOTON, OFFSET, READ_NOISE = 20_000, 1.5, 100.0, 3.0
FLATS, DARKS = 6, 4
# Attenuations of the solids are multiples of the step.
VOXEL, STEP = 0.4, 0.0025


def transmissions() -> np.ndarray:
    """(views, rows, columns) the share of photons that pass."""
    angles = 2 * np.pi * np.arange(VIEWS) / VIEWS
    along = (np.arange(COLUMNS * SUBPIXELS) + 0.5) / SUBPIXELS - COLUMNS / 2
    down = (np.arange(ROWS * SUBPIXELS) + 0.5) / SUBPIXELS - ROWS / 2
    passed = []
    for cos, sin in zip(np.cos(angles), np.sin(angles), strict=True):
        source = SOURCE_ORIGIN * np.array([cos, sin, 0])
        centre = (SOURCE_ORIGIN - SOURCE_DETECTOR) * np.array([cos, sin, 0])
        right, low = PIXEL * np.array([-sin, cos, 0]), PIXEL * np.array([0, 0, -1.0])
        pixels = centre + down[:, None, None] * low + along[:, None] * right
        fine = np.exp(-line_integrals(bean(), np.broadcast_to(source, pixels.shape), pixels - source))
        passed.append(fine.reshape(ROWS, SUBPIXELS, COLUMNS, SUBPIXELS).mean((1, 3)))
    return np.stack(passed)


def measured(photons: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Values that the detector gives for expected numbers of photons, uint16."""
    values = OFFSET + VALUES_PER_PHOTON * rng.poisson(photons) + READ_NOISE * rng.normal(size=photons.shape)
    return np.clip(np.rint(values), 0, 2**16 - 1).astype(np.uint16)


def main() -> None:
    """Writes projections, flats, darks, their statement and the true volume."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of the scan")
    out = parser.parse_args().out
    (out / "truth").mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(23)
    y, x = np.meshgrid(np.linspace(-1, 1, ROWS), np.linspace(-1, 1, COLUMNS), indexing="ij")
    beam = PHOTONS * (1 - 0.15 * (x**2 + y**2)) * (1 + 0.02 * rng.normal(size=x.shape))
    frames = {
        "projections": measured(beam * transmissions(), rng),
        "flats": measured(np.broadcast_to(beam, (FLATS, ROWS, COLUMNS)), rng),
        "darks": measured(np.zeros((DARKS, ROWS, COLUMNS)), rng),
    }
    for name, values in frames.items():
        tifffile.imwrite(out / f"{name}.tif", values, photometric="minisblack", compression="zlib", predictor=2)
    z, y, x = ((np.arange(count) - (count - 1) / 2) * VOXEL for count in (ROWS, COLUMNS, COLUMNS))
    true = attenuation_of_voxels(bean(), x=x, y=y, z=z, samples=4)
    np.save(out / "truth" / "volume.npy", np.rint(true / STEP).astype(np.uint8))
    content = {
        "note": "computed from closed-form chords of ellipsoids by make_phantom.py",
        **{name: f"{name}.tif" for name in frames},
        "kind": "counts",
        "beam": "cone",
        "unit": "mm",
        "pixel_size": PIXEL,
        "source_origin": SOURCE_ORIGIN,
        "source_detector": SOURCE_DETECTOR,
        "angles_deg": {"first": 0, "step": 360 / VIEWS},
        "truth": {"volume": "truth/volume.npy", "voxel_size": VOXEL, "attenuation_per_value": STEP},
    }
    (out / "scan.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
