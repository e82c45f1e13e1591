"""DataExchange and NXtomo, both HDF5: parallel beams of synchrotrons, with flats and darks.

These files state neither the direction of rotation nor the side from which columns are numbered. The source is assumed
to turn counter-clockwise seen from +z, and columns to run from left to right seen from the source.
"""

from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.ct.formats.assemble import ReaderOutput, open_beam_of
from nerfcli.ct.formats.statement import angles_in_radians, millimetres
from nerfcli.ct.geometry import Circle
from nerfcli.ct.recognise import datasets_in, open_hdf5
from nerfcli.errors import UserError

# Names of the pixel size, in order of preference: the size at the object before that of the camera.
_PIXEL_WIDTH = (
    *("sample_x_pixel_size", "actual_pixel_size_x", "x_actual_pixel_size", "pixel_size_x"),
    *("x_pixel_size", "pixel_size", "resolution"),
)
_PIXEL_HEIGHT = tuple(name.replace("_x", "_y").replace("x_", "y_") for name in _PIXEL_WIDTH)
# Values of image_key.
_PROJECTION, _FLAT, _DARK = 0, 1, 2


def read_data_exchange(path: Path) -> ReaderOutput:
    """Read a DataExchange file: exchange/data, data_white, data_dark and theta."""
    with open_hdf5(path) as file:
        data = _frames(file, "exchange/data", path)
        theta = _dataset(file, "exchange/theta", path, "the angles of the projections")
        angles = angles_in_radians(theta[...], views=len(data), unit=_unit(theta), where=f"{path}: exchange/theta")
        flats = _frames(file, "exchange/data_white", path) if "exchange/data_white" in file else None
        darks = _frames(file, "exchange/data_dark", path) if "exchange/data_dark" in file else None
        sides = _pixel_size(file, path)
    return _parallel(path, "data-exchange", data, angles, flats=flats, darks=darks, sides=sides)


def read_nxtomo(path: Path) -> ReaderOutput:
    """Read a NeXus file with an NXtomo entry: frames with an image_key (0 projections, 1 flats, 2 darks)."""
    with open_hdf5(path) as file:
        key_name = _first(file, "image_key", path)
        key = np.asarray(file[key_name][...]).reshape(-1)
        folder = key_name.rpartition("/")[0]
        data_name = f"{folder}/data" if f"{folder}/data" in file else _first(file, "data", path)
        data = _frames(file, data_name, path)
        if len(key) != len(data):
            raise UserError(
                f"{path}: {len(key)} image keys for {len(data)} frames", "each frame needs one: write the file again"
            )
        angle_name = _first(file, "rotation_angle", path)
        all_angles = np.asarray(file[angle_name][...]).reshape(-1)
        unit = _unit(file[angle_name])
        control = [name for name in datasets_in(file) if name.endswith("image_key_control")]
        # Frames for alignment have key 0 and a control of -1.
        aligned = np.asarray(file[control[0]][...]).reshape(-1) < 0 if control else np.zeros(len(key), bool)
        sides = _pixel_size(file, path)
    chosen = (key == _PROJECTION) & ~aligned if len(aligned) == len(key) else key == _PROJECTION
    if not chosen.any():
        raise UserError(f"{path}: no frame has image_key 0", "projections have the key 0, flats 1, darks 2")
    if len(all_angles) == len(key):
        all_angles = all_angles[chosen]
    angles = angles_in_radians(all_angles, views=int(chosen.sum()), unit=unit, where=f"{path}: {angle_name}")
    flats, darks = data[key == _FLAT], data[key == _DARK]
    return _parallel(
        *(path, "nxtomo", data[chosen], angles),
        flats=flats if len(flats) else None,
        darks=darks if len(darks) else None,
        sides=sides,
    )


def _parallel(
    path: Path,
    form: str,
    data: np.ndarray,
    angles: np.ndarray,
    *,
    flats: np.ndarray | None,
    darks: np.ndarray | None,
    sides: tuple[float, float, float] | None,
) -> ReaderOutput:
    notes = ["the file does not say which way the source moved: counter-clockwise around the object is assumed"]
    width, height, mm = (1.0, 1.0, None) if sides is None else sides
    circle = Circle("parallel", tuple(angles.tolist()), width, height, data.shape[1], data.shape[2])
    if sides is None:
        notes.append("the file does not state the pixel size: lengths are in pixels")
    beam = None if flats is None else open_beam_of(flats, darks, projections=data.shape, path=path)
    if beam is None:
        if float(np.nanquantile(data, 0.999)) > 1.5:
            raise UserError(
                f"{path} has no flats: the open beam is unknown",
                "add them (data_white, or image_key 1), or store transmissions instead of detector values",
            )
        notes.append("there are no flats: values are taken as transmissions")
    kind = "transmission" if beam is None else "counts"
    unit = "voxel" if sides is None else "mm"
    return ReaderOutput(path, form, data, kind, circle, unit, beam=beam, notes=notes, mm=mm)


def _dataset(file: Any, name: str, path: Path, what: str) -> Any:
    import h5py

    if name not in file or not isinstance(file[name], h5py.Dataset):
        raise UserError(f"{path} has no {name}", f"it should hold {what}: write the file again with them")
    return file[name]


def _frames(file: Any, name: str, path: Path) -> np.ndarray:
    dataset = _dataset(file, name, path, "frames")
    try:
        array = np.asarray(dataset[...], dtype=np.float32)
    except (OSError, ValueError, TypeError) as error:
        raise UserError(f"{path}: {name} cannot be read: {error}", "the file is damaged: copy it again") from error
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3:
        raise UserError(f"{path}: {name} has shape {array.shape}", "expected frames x rows x columns")
    return array


def _first(file: Any, name: str, path: Path) -> str:
    for found in datasets_in(file):
        if found.rpartition("/")[2] == name:
            return found
    raise UserError(f"{path} has no {name}", "an NXtomo entry has image_key, data and rotation_angle")


def _unit(dataset: Any) -> str | None:
    for name in ("units", "unit"):
        if name in dataset.attrs:
            value = dataset.attrs[name]
            return value.decode() if isinstance(value, bytes) else str(value)
    return None


def _pixel_size(file: Any, path: Path) -> tuple[float, float, float] | None:
    """Return width and height of a pixel in the unit of the width, and that unit in mm; None if no size is stated."""
    names = {found.rpartition("/")[2]: found for found in datasets_in(file)}
    width = next((names[name] for name in _PIXEL_WIDTH if name in names), None)
    if width is None:
        return None
    height = next((names[name] for name in _PIXEL_HEIGHT if name in names), width)
    sides, units = [], []
    for name in (width, height):
        value = np.asarray(file[name][...]).reshape(-1)
        if len(value) == 0 or not np.issubdtype(value.dtype, np.number):
            return None
        sides.append(float(value[0]))
        units.append(millimetres(_unit(file[name]) or "m", where=f"{path}: {name}"))  # metres are the unit of NeXus
    return sides[0], sides[1] * (units[1] / units[0]), units[0]
