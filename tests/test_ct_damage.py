"""Damaged and mistaken scans: two lines that say what is wrong, or the right answer; never a traceback."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
from commands import completed, nerfcli, refusal
from scan_files import (
    ANGLES_DEG,
    COLUMNS,
    ROWS,
    VIEWS,
    Written,
    data_exchange,
    heltomo,
    nikon,
    nxtomo,
    r2_gaussian,
    skyscan,
    stack,
)

from nerfcli.ct.convert import read_scan
from nerfcli.ct.scan import load_scan
from nerfcli.errors import BAD_INPUT


def rewritten(path: Path, name: str, value: object, *, units: str | None = None) -> Path:
    """An HDF5 file with another dataset."""
    with h5py.File(path, "r+") as file:
        kept = dict(file[name].attrs)
        del file[name]
        if value is not None:
            file[name] = value
            for key, attribute in kept.items():
                file[name].attrs[key] = attribute
            if units is not None:
                file[name].attrs["units"] = units
    return path


def edited(path: Path, old: str, new: str) -> Path:
    """A text file with other words."""
    text = path.read_bytes().decode("latin-1")
    assert old in text
    path.write_bytes(text.replace(old, new).encode("latin-1"))
    return path


def without(folder: Path, name: str) -> Path:
    """A folder without one of its files."""
    (folder / name).unlink()
    return folder


def cut(path: Path, fraction: float) -> Path:
    """A file of which only the first part was copied."""
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    return path


def several_scans(folder: Path) -> Path:
    path = nikon(folder).path
    shutil.copy(path, folder / "other.xtekct")
    return folder


def frame_of_another_size(folder: Path) -> Path:
    stack(folder)
    tifffile.imwrite(folder / "proj/p_004.tif", np.zeros((3, 5), np.uint16))
    return folder


def coloured(folder: Path) -> Path:
    stack(folder)
    picture = np.zeros((ROWS, COLUMNS, 3), np.uint8)
    tifffile.imwrite(folder / "proj/p_000.tif", picture, photometric="rgb")
    return folder


def ang_file(folder: Path) -> Path:
    path = nikon(folder).path
    (folder / "bone.ang").write_text("Proj Angle(deg)\n1: 0.0\n2: 30.0\n3: 60.0\n")
    return path


def other_mat(folder: Path) -> Path:
    scipy.io.savemat(folder / "b.mat", {"reconstruction": np.zeros((4, 4))})
    return folder / "b.mat"


Make = Callable[[Path], Path]


def exchange(name: str, value: object, *, units: str | None = None) -> Make:
    """Return what writes a DataExchange file with another dataset."""
    return lambda folder: rewritten(data_exchange(folder).path, f"exchange/{name}", value, units=units)


def detector(name: str, value: object, *, units: str | None = None) -> Make:
    """Return what writes an NXtomo file with another dataset of its detector."""
    return lambda folder: rewritten(nxtomo(folder).path, f"entry/instrument/detector/{name}", value, units=units)


def log(write: Callable[[Path], Written], old: str, new: str) -> Make:
    """Return what writes a scan whose log has other words."""
    return lambda folder: edited(write(folder).path, old, new)


def stack_with(**changed: object) -> Make:
    return lambda folder: stack(folder, changed=changed).path


def swapped(folder: Path) -> Path:
    path = exchange("data_white", np.full((3, ROWS, COLUMNS), 100.0))(folder)
    return rewritten(path, "exchange/data_dark", np.full((3, ROWS, COLUMNS), 1100.0))


ANGLES_WITH_NAN = np.where(ANGLES_DEG > 200, np.nan, ANGLES_DEG)
ALL = (VIEWS, ROWS, COLUMNS)

# For each case: the function that makes the input in a folder, the expected error, and options.
REFUSED: dict[str, tuple[Make, str, *tuple[str, ...]]] = {
    # HDF5.
    "zero flats": (exchange("data_white", np.zeros((3, ROWS, COLUMNS))), "no pixel sees the beam"),
    "flats and darks swapped": (swapped, "median of -1000 above the darks"),
    "no flats": (exchange("data_white", None), "has no flats"),
    "flats of another size": (exchange("data_white", np.ones((3, 4, 4))), "flats of 4 x 4 pixels"),
    "missing angles": (exchange("theta", ANGLES_DEG[:-2]), "7 angles for 9 projections"),
    "no angles": (exchange("theta", None), "has no exchange/theta"),
    "angle of NaN": (exchange("theta", ANGLES_WITH_NAN), "angle 7 is nan"),
    "one angle for all": (exchange("theta", np.full(VIEWS, 30.0)), "all 9 angles are 30"),
    "angles in an unknown unit": (exchange("theta", ANGLES_DEG, units="gon"), "'gon' is not a unit of angle"),
    "degrees called radians": (exchange("theta", ANGLES_DEG, units="radians"), "angles span 240 radians"),
    "wrong unit of a pixel": (detector("x_pixel_size", 75.0, units="m"), "a pixel of 75000 mm"),
    "all values NaN": (exchange("data", np.full(ALL, np.nan)), "only 0 % of the values are finite"),
    "all values the same": (exchange("data", np.full(ALL, 7.0)), "all values are 7"),
    "text instead of frames": (exchange("data", "lost"), "exchange/data"),
    "HDF5 cut off": (lambda f: cut(data_exchange(f).path, 0.4), "cannot be read as HDF5"),
    "keys without frames": (detector("image_key", [1, 2, 0]), "3 image keys for 13 frames"),
    "no projections": (detector("image_key", [1] * 13), "no frame has image_key 0"),
    # Scanners.
    "projection missing": (lambda f: without(nikon(f).path.parent, "bone_0004.tif"), "after number 3 the numbering"),
    "last projection missing": (lambda f: without(nikon(f).path.parent, "bone_0009.tif"), "holds 8 projections"),
    "negative distance": (log(nikon, "SrcToDetector=400", "SrcToDetector=-400"), "SrcToDetector is -400"),
    "no step of angles": (log(nikon, "AngularStep=30", ""), "has no AngularStep"),
    "angles for some views": (ang_file, "lists 3 angles for 9 projections"),
    "several scans in a folder": (several_scans, "holds several scans"),
    "picture cut off": (
        lambda f: cut(nikon(f).path.parent / "bone_0003.tif", 0.5).parent,
        "bone_0003.tif cannot be read",
    ),
    "no flat field": (log(skyscan, "Depth", "Flat Field Correction=OFF\nDepth"), "the open beam is unknown"),
    "log of another size": (
        log(skyscan, "Number Of Columns=10", "Number Of Columns=20"),
        "Number Of Columns is 20, the projections have 10",
    ),
    "other .mat file": (other_mat, "holds reconstruction, and no sinogram"),
    "mat cut off": (lambda f: cut(heltomo(f).path, 0.5), "cannot be read as a MATLAB file"),
    # Folders with JSON.
    "stack of another size": (frame_of_another_size, "has 5 x 3 pixels, the first projection 10 x 6"),
    "coloured picture": (coloured, "projections are grey|has the shape"),
    "unknown key": (stack_with(anlges=[1]), "'anlges' is not a key"),
    "no projections there": (stack_with(projections="p/*.tif"), "no projections match"),
    "counts called transmissions": (stack_with(kind="transmission"), "transmissions up to"),
    "counts called line integrals": (stack_with(kind="line_integral"), "line integrals up to"),
    "held out beyond the end": (stack_with(held_out=[40]), "held_out is"),
    "truth that is not there": (stack_with(truth={"volume": "v.npy"}), "v.npy cannot be read"),
    "truth without a size": (stack_with(truth=1), "truth is 1"),
    "unit of no length": (stack_with(unit="kg"), "'kg' is not a unit of length"),
    "vectors of another shape": (stack_with(vectors=[[1, 2]] * VIEWS), "vectors"),
    "npy missing": (lambda f: without(r2_gaussian(f).path, "proj_train/0002.npy"), "0002.npy does not exist"),
    # Options.
    "photons of line integrals": (lambda f: heltomo(f).path, "does not apply to line integrals", "--photons", "1e4"),
    "no photons": (stack_with(), "--photons -5", "--photons", "-5"),
    "unit that is none": (stack_with(), "--unit: 'parsec' is not a unit", "--unit", "parsec"),
    "a unit and no size": (
        detector("x_pixel_size", None),
        "states no pixel size, to which --unit um would apply",
        *("--unit", "um"),
    ),
    "axis far outside": (stack_with(), "far outside the 10 columns", "--centre-of-rotation", "900"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_damage_is_reported_in_two_lines_and_nothing_is_written(name: str, tmp_path: Path) -> None:
    make, expected, *options = REFUSED[name]
    place = tmp_path / "in"
    place.mkdir()
    path = make(place)
    error, hint = refusal("ct", "convert", path, tmp_path / "out", *options)
    assert re.search(expected, error), error
    assert len(hint) > 10
    assert not (tmp_path / "out").exists()


def test_a_truth_of_null_is_none(tmp_path: Path) -> None:
    """Regression: it was refused as missing, unlike null for any other key that may be left out."""
    assert "truth" not in read_scan(stack(tmp_path, changed={"truth": None}).path).history


def test_names_of_projections_are_no_patterns(tmp_path: Path) -> None:
    path = edited(nikon(tmp_path).path, "Name=bone", "Name=/data/bone")
    assert len(read_scan(path).values) == VIEWS
    edited(path, "Name=/data/bone", "Name=bone[1]")
    for picture in tmp_path.glob("*.tif"):
        picture.rename(picture.with_name(picture.name.replace("bone", "bone[1]")))
    tifffile.imwrite(tmp_path / "preview.tif", np.zeros((3, 5), np.uint16))
    assert len(read_scan(path).values) == VIEWS


@pytest.mark.parametrize("command", ["convert", "doctor", "train", "info", "evaluate", "render", "export"])
def test_a_batch_goes_on_after_names_and_folders_that_cannot_be_read(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(folder: Path) -> None:
        raise PermissionError(13, "Permission denied", str(folder))

    monkeypatch.setattr(Path, "iterdir", refused)
    target = (tmp_path / "out",) if command == "convert" else ()
    result = nerfcli("ct", command, "-", *target, stdin=f"{'x' * 300}\n{tmp_path}\nmissing\n")
    assert result.exit_code == BAD_INPUT
    errors = [line for line in result.stderr.splitlines() if line.startswith("Error:")]
    assert errors[0] == f"Error: {'x' * 300} does not exist"
    assert re.search("cannot be read: Permission denied|is not a reconstruction", errors[1])
    assert errors[2] == "Error: missing does not exist"


def test_rows_of_nan_are_left_out(tmp_path: Path) -> None:
    written = data_exchange(tmp_path)
    values = written.values.copy()
    values[3, 2], values[5, 4, 1] = np.nan, np.inf
    scan = read_scan(rewritten(written.path, "exchange/data", values))
    assert scan.usable is not None
    bad = ~np.isfinite(values)
    np.testing.assert_array_equal(np.broadcast_to(scan.usable, values.shape), ~bad)
    np.testing.assert_allclose(np.asarray(scan.values)[~bad], values[~bad])
    assert np.isfinite(scan.line_integrals(np.arange(VIEWS))).all()


def test_a_view_without_content_is_left_out(tmp_path: Path) -> None:
    written = data_exchange(tmp_path)
    values = written.values.copy()
    values[4] = 0
    scan = read_scan(rewritten(written.path, "exchange/data", values))
    assert scan.usable is not None
    assert (~scan.usable.any(axis=(1, 2))).tolist() == [view == 4 for view in range(VIEWS)]
    assert "1 empty projection left out" in " ".join(scan.history["notes"])


def test_dead_pixels_of_the_flats_are_left_out(tmp_path: Path) -> None:
    flats = np.full((3, ROWS, COLUMNS), 1100.0)
    flats[:, 1, 7] = 100
    scan = read_scan(rewritten(data_exchange(tmp_path).path, "exchange/data_white", flats))
    assert scan.usable is not None
    assert np.argwhere(~scan.usable).tolist() == [[0, 1, 7]]


def test_a_flat_with_the_object_in_the_beam_is_an_outlier(tmp_path: Path) -> None:
    """The open beam is the mean of the other flats, within 0.4 %."""
    flats = np.random.default_rng(0).normal(1100, 2, (8, ROWS, COLUMNS))
    flats[2, 2:4, 3:8] = 300
    scan = read_scan(rewritten(data_exchange(tmp_path).path, "exchange/data_white", flats))
    assert scan.open_beam is not None
    assert scan.open_beam == pytest.approx(1000, rel=4e-3)


def test_a_wrong_unit_is_mended(tmp_path: Path) -> None:
    """The file says 75 m, --unit says that its 75 are micrometres."""
    path = rewritten(nxtomo(tmp_path).path, "entry/instrument/detector/x_pixel_size", 75.0, units="m")
    completed("ct", "doctor", path, "--unit", "um")
    completed("ct", "convert", path, tmp_path / "out", "--unit", "um")
    scan = load_scan(tmp_path / "out")
    assert scan.unit == "mm"
    assert scan.geometry.pixel_at_origin[1] == pytest.approx(0.075)
