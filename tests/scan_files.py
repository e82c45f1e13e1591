"""Small scans in the formats of scanners and programs, each with its format's own projection formula.

The formulas rotate the object, as their sources do; nerfcli rotates the source.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import scipy.io
import tifffile

ROWS, COLUMNS, VIEWS = 6, 10, 9
ANGLES_DEG = np.linspace(10, 250, VIEWS)
# (view, point) -> column, row.
Projection = Callable[[int, np.ndarray], tuple[float, float]]


@dataclass(frozen=True)
class Written:
    """A scan in a file.

    Args:
        path: the argument of `nerfcli convert`.
        seen: the format's own projection formula, in the unit of the scan.
        values: the stored values that the reader should return.
    """

    path: Path
    seen: Projection
    values: np.ndarray


def numbers(rows: int = ROWS) -> np.ndarray:
    """Return transmissions between 0.2 and 0.9, all different."""
    return np.random.default_rng(0).uniform(0.2, 0.9, (VIEWS, rows, COLUMNS)).astype(np.float32)


def turned(angle: float, point: np.ndarray) -> np.ndarray:
    """Return a point rotated counter-clockwise about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * point[0] - s * point[1], s * point[0] + c * point[1], point[2]])


def data_exchange(folder: Path) -> Written:
    values, path = numbers(), folder / "a.h5"
    with h5py.File(path, "w") as file:
        file["exchange/data"] = 100 + values * 1000
        file["exchange/data_white"] = np.full((3, ROWS, COLUMNS), 1100.0)
        file["exchange/data_dark"] = np.full((3, ROWS, COLUMNS), 100.0)
        file["exchange/theta"] = ANGLES_DEG
        file["exchange/theta"].attrs["units"] = "degrees"
        file["measurement/instrument/detector/x_pixel_size"] = 2.5
        file["measurement/instrument/detector/x_pixel_size"].attrs["units"] = "um"
    return Written(path, _parallel(0.0025), 100 + values * 1000)


def nxtomo(folder: Path) -> Written:
    values, path = numbers(), folder / "a.nxs"
    flats, darks = np.full((2, ROWS, COLUMNS), 1000.0), np.full((2, ROWS, COLUMNS), 0.0)
    with h5py.File(path, "w") as file:
        detector = file.create_group("entry/instrument/detector")
        detector["data"] = np.concatenate([flats[:1], darks, values * 1000, flats[1:]])
        detector["image_key"] = [1, 2, 2, *([0] * VIEWS), 1]
        detector["x_pixel_size"] = 2e-6
        detector["x_pixel_size"].attrs["units"] = "m"
        file["entry/sample/rotation_angle"] = [0, 0, 0, *ANGLES_DEG, 0]
        file["entry/sample/rotation_angle"].attrs["units"] = "degree"
    return Written(path, _parallel(0.002), values * 1000)


def _parallel(pixel: float) -> Projection:
    def seen(view: int, point: np.ndarray) -> tuple[float, float]:
        # The object turns clockwise in front of a camera whose columns run along +y.
        at = turned(-np.radians(ANGLES_DEG[view]), point)
        return at[1] / pixel + (COLUMNS - 1) / 2, -at[2] / pixel + (ROWS - 1) / 2

    return seen


def r2_gaussian(folder: Path) -> Written:
    values = -np.log(numbers())
    frames: dict[str, list[dict[str, object]]] = {"proj_train": [], "proj_test": []}
    for view, value in enumerate(values):
        part = "proj_train" if view < 6 else "proj_test"
        (folder / part).mkdir(exist_ok=True)
        np.save(folder / part / f"{view:04d}.npy", value)
        frames[part].append({"file_path": f"{part}/{view:04d}.npy", "angle": float(np.radians(ANGLES_DEG[view]))})
    scanner = {
        "mode": "cone",
        "DSD": 7.0,
        "DSO": 5.0,
        "nDetector": [ROWS, COLUMNS],
        "sDetector": [1.8, 2.0],
        "offDetector": [0.1, 0.3],
        "nVoxel": [4, 4, 4],
        "sVoxel": [2, 2, 2],
        "offOrigin": [0, 0, 0],
    }
    np.save(folder / "vol_gt.npy", np.arange(64, dtype=np.float32).reshape(4, 4, 4))
    (folder / "meta_data.json").write_text(json.dumps({"scanner": scanner, "vol": "vol_gt.npy", **frames}))
    return Written(folder, _pinhole(5, 7, (0.2, 0.3), (0.1, -0.3)), values)


def _pinhole(origin: float, detector: float, pixel: tuple[float, float], offset: tuple[float, float]) -> Projection:
    """Return R2-Gaussian's projection: uu = (i + 0.5 - W / 2) d + off, for a camera with x right, y down, z forward."""

    def seen(view: int, point: np.ndarray) -> tuple[float, float]:
        at = turned(-np.radians(ANGLES_DEG[view]), point)  # the source is on +x
        x, y, z = at[1], -at[2], origin - at[0]
        across, down = x / z * detector, y / z * detector
        return (across - offset[0]) / pixel[0] - 0.5 + COLUMNS / 2, (down - offset[1]) / pixel[1] - 0.5 + ROWS / 2

    return seen


def nikon(folder: Path, *, top: float = 3.0, bottom: float = 3.0, recorded: bool = False) -> Written:
    values, path, step = numbers(), folder / "bone.xtekct", 30.0
    for view, value in enumerate(values):
        tifffile.imwrite(folder / f"bone_{view + 1:04d}.tif", np.round(value * 60000).astype(np.uint16))
    lines = [
        *("[XTekCT]", "Name=bone", f"Projections={VIEWS}", "WhiteLevel=60000", "Operator=Jos\xe9"),
        *(f"DetectorPixelsX={COLUMNS}", f"DetectorPixelsY={ROWS}", "DetectorPixelSizeX=0.2", "DetectorPixelSizeY=0.3"),
        *("SrcToObject=100", "SrcToDetector=400", "InitialAngle=7", f"AngularStep={step:g}"),
        *(f"CentreOfRotationTop={top:g}", f"CentreOfRotationBottom={bottom:g}"),
    ]
    path.write_bytes("\r\n".join(lines).encode("latin-1"))
    if recorded:
        rows = "\n".join(f"{view + 1} {-step * view:.3f} 1.5" for view in range(VIEWS))
        (folder / "_ctdata.txt").write_text(f"x-ray data\n10 20\nProjection Angle(deg) Time(s)\n{rows}\n")
    lean = np.arctan2(top - bottom, ROWS * 0.3)
    offset = (top + bottom) / 2 * 100 / 400

    def seen(view: int, point: np.ndarray) -> tuple[float, float]:
        # As in the Core Imaging Library: source at 0 looking along +y, axis at (-offset, 100), first pixel top right.
        at = turned(np.radians(-step * view - 7 + 180), point)
        roll = -lean
        at = np.array(
            [at[0] * np.cos(roll) + at[2] * np.sin(roll), at[1], -at[0] * np.sin(roll) + at[2] * np.cos(roll)]
        )
        at = at + np.array([-offset, 100, 0])
        x, z = at[0] / at[1] * 400, at[2] / at[1] * 400
        return -x / 0.2 + (COLUMNS - 1) / 2, -z / 0.3 + (ROWS - 1) / 2

    return Written(path, seen, np.round(values * 60000) / 60000)


def skyscan(folder: Path) -> Written:
    values, path, step = numbers(), folder / "shell.log", 0.7
    for view, value in enumerate(values):
        tifffile.imwrite(folder / f"shell{view:04d}.tif", np.round(value * 57000).astype(np.uint16))
    tifffile.imwrite(folder / "shell_rec0001.tif", np.zeros((4, 4), np.uint8))
    lines = [
        *("[System]", "Scanner=Skyscan1172", "[Acquisition]", "Filename Prefix=shell", f"Number of Files={VIEWS}"),
        *(f"Number Of Rows={ROWS}", f"Number Of Columns={COLUMNS}", "Optical Axis (line)=   2"),
        *("Object to Source (mm)=80.0", "Camera to Source (mm)=240.0", "Image Pixel Size (um)=200"),
        *("Rotation Step (deg)=0.700", "Rotation Direction=CC", "Reference Intensity=57000", "Depth (bits)=16"),
    ]
    path.write_text("\n".join(lines))

    def seen(view: int, point: np.ndarray) -> tuple[float, float]:
        # The object turns counter-clockwise, the source is at +y, and the picture is seen from behind the camera.
        at = turned(np.radians(step * view), point)
        larger = 240 / (80 - at[1])
        return at[0] * larger / 0.6 + (COLUMNS - 1) / 2, 2 - at[2] * larger / 0.6

    return Written(path, seen, np.round(values * 57000) / 57000)


def heltomo(folder: Path) -> Written:
    values, path = -np.log(numbers(rows=1)), folder / "a.mat"
    parameters = {
        "distanceSourceOrigin": 410.66,
        "distanceSourceDetector": 553.74,
        "distanceUnit": "mm",
        "pixelSizePost": 0.2,
        "numDetectorsPost": COLUMNS,
        "angles": ANGLES_DEG,
        "projectName": "test",
    }
    scipy.io.savemat(path, {"CtDataFull": {"type": "2d", "sinogram": values[:, 0], "parameters": parameters}})

    def seen(view: int, point: np.ndarray) -> tuple[float, float]:
        # ASTRA's geometry "fanflat".
        at = turned(-np.radians(ANGLES_DEG[view]), point)
        return at[0] * 553.74 / (410.66 + at[1]) / 0.2 + (COLUMNS - 1) / 2, 0.0

    return Written(path, seen, values)


def stack(folder: Path, *, changed: dict[str, object] | None = None) -> Written:
    values = numbers()
    (folder / "proj").mkdir()
    for view, value in enumerate(values):
        tifffile.imwrite(folder / f"proj/p_{view:03d}.tif", (100 + 50000 * value).astype(np.uint16))
    tifffile.imwrite(folder / "flats.tif", np.full((3, ROWS, COLUMNS), 50100, np.uint16), photometric="minisblack")
    tifffile.imwrite(folder / "darks.tif", np.full((3, ROWS, COLUMNS), 100, np.uint16), photometric="minisblack")
    stated = {
        "projections": "proj/*.tif",
        "flats": "flats.tif",
        "darks": "darks.tif",
        "kind": "counts",
        "beam": "cone",
        "unit": "cm",
        "pixel_size": [0.02, 0.03],
        "source_origin": 41.0,
        "source_detector": 55.0,
        "angles_deg": ANGLES_DEG.tolist(),
        "direction": "clockwise",
        "mirrored": True,
        "centre_of_rotation": 5.5,
        "centre_row": 2.0,
        "held_out": [1, 4],
    }
    (folder / "scan.json").write_text(json.dumps(stated | (changed or {})))

    def seen(view: int, point: np.ndarray) -> tuple[float, float]:
        at = turned(np.radians(ANGLES_DEG[view]), point)
        larger = 550 / (410 - at[0])
        return 5.5 - at[1] * larger / 0.2, 2.0 - at[2] * larger / 0.3

    return Written(folder, seen, (100 + 50000 * values).astype(np.uint16).astype(np.float32))


def transforms(folder: Path) -> Written:
    values = numbers()
    (folder / "p").mkdir()
    lens = {"cx": 5.5, "cy": 2.0, "w": COLUMNS, "h": ROWS}
    frames: dict[str, list[dict[str, object]]] = {"train": [], "test": []}
    for view, value in enumerate(values):
        tifffile.imwrite(folder / f"p/p_{view:03d}.tif", np.round(value * 65535).astype(np.uint16))
        c, s = np.cos(np.radians(ANGLES_DEG[view])), np.sin(np.radians(ANGLES_DEG[view]))
        pose = [[-s, 0, c, 40 * c], [c, 0, s, 40 * s], [0, 1, 0, 0], [0, 0, 0, 1]]
        part = "test" if view % 3 == 0 else "train"
        frames[part].append({"file_path": f"p/p_{view:03d}.tif", "transform_matrix": pose})
    for part, listed in frames.items():
        content = {**lens, "measurement": "transmission I/I0", "frames": listed}
        (folder / f"transforms_{part}.json").write_text(json.dumps(content))
    np.arange(24, dtype=np.uint8).tofile(folder / "v_4x3x2_uint8.raw")
    geometry = {
        "source_origin_distance": 40.0,
        "source_detector_distance": 60.0,
        "detector_pitch": 2.0,
        "voxel_size": 1.0,
        "volume": "v_4x3x2_uint8.raw",
        "mu_per_unit_value": 0.5,
    }
    (folder / "geometry.json").write_text(json.dumps(geometry))

    def seen(view: int, point: np.ndarray) -> tuple[float, float]:
        at = turned(-np.radians(ANGLES_DEG[view]), point)
        x, y, z = at[1], -at[2], 40 - at[0]
        return 30 * x / z + 5.5 - 0.5, 30 * y / z + 2.0 - 0.5

    return Written(folder, seen, np.round(values * 65535) / 65535)


WRITERS: dict[str, Callable[[Path], Written]] = {
    "data-exchange": data_exchange,
    "nxtomo": nxtomo,
    "r2-gaussian": r2_gaussian,
    "nikon": nikon,
    "skyscan": skyscan,
    "heltomo": heltomo,
    "stack": stack,
    "transmission-transforms": transforms,
}
