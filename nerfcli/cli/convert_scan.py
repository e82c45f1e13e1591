"""The part of nerfcli convert for X-ray scans."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nerfcli.cli.console import Console
from nerfcli.cli.options import holdout_rule
from nerfcli.errors import UserError

if TYPE_CHECKING:
    from nerfcli.ct.hypotheses import Hypothesis, Judgement

Photons = Annotated[
    float | None, typer.Option(help="Scans: photons that an open pixel counts per view.", show_default=False)
]
Unit = Annotated[str | None, typer.Option(help="Scans: unit of lengths in IN, m, mm, um or nm, before what IN says.")]
Mirrored = Annotated[
    bool, typer.Option("--mirrored", help="Scans: columns are numbered from the other side than IN says.")
]
CentreOfRotation = Annotated[
    float | None, typer.Option(help="Scans: the column of the axis of rotation; 0 is the middle of the first.")
]
# Options that only scans have, and those that both kinds of input have.
OF_SCANS = ("photons", "unit", "mirrored", "centre_of_rotation", "holdout")
OF_BOTH = ("source", "target", "to", "detect", "overwrite", "json", "quiet")


def scan_work(values: dict[str, Any], defaults: dict[str, Any], console: Console) -> Callable[[Path, bool], bool]:
    """Return a function that runs the command on a scan, and returns False for any other input.

    Args:
        values: values of all parameters of the command, by name.
        defaults: default values of the same parameters.
        console: prints notes and results.

    Raises:
        UserError: by the function, if options for photos are given for a scan, or vice versa.
    """
    given = [name for name, value in values.items() if value != defaults[name]]
    target, to = values["target"], values["to"]

    def work(path: Path, one_of_many: bool) -> bool:
        from nerfcli.ct.formats.read import recognise

        if recognise(path) is None:
            _refuse(path, [name for name in given if name in OF_SCANS], of="X-ray scans, and this is not one")
            return False
        from nerfcli.ct.formats.scan_options import ScanOptions
        from nerfcli.ct.scans import OWN, convert_scan, detect_scan, judgement_record

        _refuse(
            path, [name for name in given if name not in (*OF_SCANS, *OF_BOTH)], of="photos, and this is an X-ray scan"
        )
        options = ScanOptions(
            photons=values["photons"],
            unit=values["unit"],
            centre_column=values["centre_of_rotation"],
            holdout=holdout_rule(values["holdout"]),
            mirrored=values["mirrored"],
        )
        if values["detect"]:
            if to is not None or target is not None:
                raise typer.BadParameter("--detect writes nothing; leave OUT and --to out")
            with console.callbacks(f"detect {path.name}") as callbacks:
                found = detect_scan(path, given=options, **callbacks)
            console.facts(path, judgement_record(found), "\n".join([str(path), *_table(found)]))
            return True
        if target is None:
            raise typer.BadParameter("say where the result goes", param_hint="OUT")
        place = target
        if one_of_many:
            place = target / (path.stem if path.is_file() else path.name)
        record = convert_scan(
            path, place, to=to or OWN, given=options, overwrite=values["overwrite"], notify=console.note
        )
        console.result(place, record)
        return True

    return work


def _refuse(path: Path, names: list[str], *, of: str) -> None:
    if names:
        flag = "--" + names[0].replace("_", "-")
        raise UserError(f"{path}: {flag} is for {of}", f"leave {flag} out")


def _table(found: "Judgement") -> list[str]:
    lines = [f"  {'reading':<52}{'axis at column':>16}{'rms error':>12}"]
    for hypothesis in found.hypotheses:
        lines.append(f"  {_reading(hypothesis):<52}{hypothesis.centre_column:>16.2f}{hypothesis.rms:>12.4g}")
    verdict = {
        "holds": "as stated; the mirrored reading is worse",
        "mirrored": "mirrored or reversed; as stated is worse",
        "undecided": "the data do not decide",
    }[found.verdict]
    lines.append(f"  direction and side: {verdict} ({found.ratio:.3g} times, {found.margin:.1f} standard errors)")
    centre = f"{found.centre_column:.2f} +- {found.centre_error:.2f}"
    if found.centre_holds:
        lines.append(f"  centre of rotation: column {centre}; {found.stated_column:.2f} as stated fits as well")
    else:
        lines.append(
            f"  centre of rotation: column {centre}; {found.stated_column:.2f} as stated is {found.centre_ratio:.3g} "
            "times worse"
        )
    lines.append(f"  {found.ambiguity}")
    if found.options:
        lines.append(f"  To read it so: nerfcli convert IN OUT {found.options}")
    return lines


def _reading(hypothesis: "Hypothesis") -> str:
    words = [word for word, holds in (("reversed", hypothesis.reversed), ("mirrored", hypothesis.mirrored)) if holds]
    return " and ".join(words) if words else "as stated"
