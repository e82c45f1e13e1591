"""Options and printed results of commands for X-ray scans."""

import inspect
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from nerfcli.cli.batch import STDIN
from nerfcli.cli.console import Console
from nerfcli.errors import UserError

if TYPE_CHECKING:
    from nerfcli.ct.result import ReconstructionSettings
    from nerfcli.ct.training_scores import ScanEvaluation

# Options whose parameters have other names.
_OPTIONS = {"include": "with", "exclude": "without", "form": "format"}
_COMPONENTS = "tv=WEIGHT, centre=COLUMNS, tilt=DEGREES, air=measured"


def reconstruction_settings(
    given: dict[str, Any], *, budget_seconds: float | None, threads: int
) -> "ReconstructionSettings":
    """Build the settings of a reconstruction.

    Args:
        given: values of the parameters of train, by name.
        budget_seconds, threads: the budget and the threads in it, parsed.

    Raises:
        UserError: scans do not have such a component or type of field, or a component's value is not a number.
    """
    from nerfcli.ct.result import FIELDS, ReconstructionSettings

    field = given["field"]
    if field is not None and field not in FIELDS:
        raise UserError(f"scans cannot use --field {field}", f"choose {' or '.join(FIELDS)}")
    values: dict[str, float | bool | None] = {"tv": None, "centre": None, "tilt": None, "air": None}
    for text in given["exclude"] or ():
        values.update({_component(text, "--without"): 0.0 if text != "air" else False})
    for text in given["include"] or ():
        name, _, value = text.partition("=")
        name = _component(name, "--with")
        values[name] = value == "measured" if name == "air" else _number(text, value)
    tilt = values["tilt"]
    return ReconstructionSettings(
        budget_seconds=budget_seconds,
        passes=given["steps"],
        field=field or "voxels",
        voxel_size=given["voxel_size"],
        strength=1.0 if values["tv"] is None else values["tv"],
        centre=values["centre"],
        tilt=None if tilt is None else math.radians(tilt),
        air=None if values["air"] is None else bool(values["air"]),
        seed=given["seed"] if field == "hash" else 0,
        threads=threads,
    )


def slices_of(texts: list[str]) -> tuple[tuple[str, float], ...]:
    """Parse the axes and positions of --slices.

    Raises:
        typer.BadParameter: a text does not have the form z=0.3.
    """
    found = []
    for text in texts:
        axis, _, value = text.partition("=")
        try:
            position = float(value)
        except ValueError:
            position = float("nan")
        if axis not in ("x", "y", "z") or position != position:
            raise typer.BadParameter(f"{text!r}; write x=, y= or z= and a position, as in z=0.3", param_hint="--slices")
        found.append((axis, position))
    return tuple(found)


def refuse_photo_options(path: Path, command: Callable[..., None], values: dict[str, Any], *, of_scans: str) -> None:
    """Refuse options that are for photos where a scan, or its run, is given.

    Args:
        path: the scan or its run.
        command: the function of the command, whose parameters have the defaults.
        values: of its parameters, by name.
        of_scans: the parameters that scans have, separated by spaces.

    Raises:
        UserError: another one has a value other than its default.
    """
    defaults = {name: parameter.default for name, parameter in inspect.signature(command).parameters.items()}
    for name, default in defaults.items():
        if name not in of_scans.split() and values[name] != default:
            option = "--" + _OPTIONS.get(name, name.replace("_", "-"))
            raise UserError(f"{path} is of an X-ray scan; {option} is for photos", f"remove {option}", exit_code=2)


def refuse_scan(path: Path, command: str) -> None:
    """Refuse an X-ray scan, or a reconstruction of one, in a command for photos.

    Raises:
        UserError: the path is a scan or a reconstruction.
    """
    from nerfcli.ct.formats.read import recognise
    from nerfcli.ct.result import is_reconstruction

    hint = f"{command} is for photos; commands for scans: convert, doctor, train, evaluate, render, export, info"
    if is_reconstruction(path):
        raise UserError(f"{path} is the reconstruction of an X-ray scan, not a run of photos", hint)
    if recognise(path) is not None:
        raise UserError(f"{path} is an X-ray scan, not a scene of photos", hint)


def is_of_scan(run: str, *, outputs: str | None, slices: list[str] | None) -> bool:
    """Return whether the options given to render, or its only run, are for scans."""
    from nerfcli.ct.result import OUTPUTS, is_reconstruction

    if slices or (outputs is not None and set(outputs.split(",")) & set(OUTPUTS)):
        return True
    return run != STDIN and is_reconstruction(Path(run))


def print_scan_numbers(run: Path, evaluation: "ScanEvaluation", console: Console) -> None:
    """Print a table of the methods; print nothing if the metrics were kept from an earlier call."""
    if evaluation.is_kept:
        return
    metrics = evaluation.metrics
    console.note(f"{run}: {metrics['fitted_views']} fitted views, {metrics['held_out_views']} held out")
    rows = []
    columns = ["", "rms of line integrals", "dB", "chi-square", "volume dB", "SSIM"]
    if metrics["reference"] is not None:
        columns += ["dB to reference", "SSIM"]
    for name, found in metrics["methods"].items():
        cells = [
            *(("-",) * 3 if found["projections"] is None else _projection_cells(found["projections"])),
            *_volume_cells(found["volume"]),
            *_volume_cells(found["against_reference"]),
        ]
        rows.append((name, *cells[: len(columns) - 1]))
    console.table(columns, rows, styles={})
    if metrics["reference"] is not None:
        console.note(f"the reference {metrics['reference']['run']} is a reconstruction, not the truth")
    peaks = {found["projections"]["peak"] for found in metrics["methods"].values() if found["projections"]}
    if peaks:
        console.note(f"dB of projections refer to a line integral of {max(peaks):.3g}; chi-square: 1 is noise alone")


def _volume_cells(scores: dict | None) -> tuple[str, str]:
    return ("-", "-") if scores is None else (f"{scores['psnr']:.2f}", f"{scores['ssim']:.3f}")


def _projection_cells(projections: dict) -> tuple[str, str, str]:
    return f"{projections['rms']:.4f}", f"{projections['psnr']:.2f}", f"{projections['chi_square']:.3f}"


def _component(name: str, option: str) -> str:
    if name not in ("tv", "centre", "tilt", "air"):
        raise UserError(f"{option} {name}: unknown component for scans", f"choose from {_COMPONENTS}")
    return name


def _number(text: str, value: str) -> float:
    try:
        return float(value)
    except ValueError as error:
        raise UserError(f"--with {text}: expected a number", f"write {_COMPONENTS}") from error
