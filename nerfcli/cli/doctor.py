"""nerfcli doctor: check photos before any long work."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli.batch import for_each_input, result_path
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Json, Output, Overwrite, Quiet, Threads, one_of, thread_count
from nerfcli.cli.poses import Intrinsics
from nerfcli.errors import GATE_NOT_MET, UserError

if TYPE_CHECKING:
    from nerfcli.doctor.examination import Diagnosis
    from nerfcli.tomography.checks.examine import ScanDiagnosis

_NAMES_SHOWN = 4
_GATES = ("good", "look")
_STYLES = {"good": "green", "look": "yellow", "bad": "bold red"}


@command
def doctor(
    capture: Annotated[
        str, typer.Argument(help="Folder of photos or a scene, or - to read paths from standard input.")
    ],
    output: Output = None,
    intrinsics: Intrinsics = None,
    require: Annotated[
        str | None, typer.Option(help="good or look: exit code 7 if any finding is worse.", show_default=False)
    ] = None,
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Check photos for problems before any long work.

    Checks blur, exposure, duplicates, lenses, overlap, camera movement and moving objects; for a scene, also its
    cameras. Prints a table on stderr and writes a page with thumbnails next to the capture, CAPTURE-doctor.html. Each
    finding is good, look or bad, with its number, its threshold and advice.

    Of a scan by X-rays: I > I0, drift, rings, counts, truncation, directions and number of views, the centre of
    rotation, beam hardening.

    \b
    Examples:
      nerfcli doctor photos/kitchen
      nerfcli doctor photos/kitchen --json -o kitchen.html | jq .verdict
      nerfcli doctor photos/kitchen --intrinsics calibration/cameras.txt
      nerfcli doctor photos/kitchen --require look
      ls -d captures/*/ | nerfcli doctor - -o pages/
    """
    one_of(require, _GATES, "--require")
    from nerfcli.doctor.examination import content
    from nerfcli.tomography.formats.read import recognise
    from nerfcli.workflows.doctor import examine_capture

    console = Console(quiet=quiet, json_lines=json)

    def work(path: Path, one_of_many: bool) -> None:
        page = result_path(path, suffix="-doctor.html", output=output, one_of_many=one_of_many)
        if recognise(path) is not None:
            if intrinsics is not None:
                raise UserError(f"{path}: --intrinsics is for photos, and this is a scan", "leave --intrinsics out")
            _examine_scan(path, page, console, overwrite=overwrite, require=require)
            return
        with console.progress(f"doctor {path.name}") as update:
            diagnosis = examine_capture(
                path,
                page,
                threads=thread_count(threads),
                overwrite=overwrite,
                intrinsics=intrinsics,
                notify=console.note,
                progress=update,
            )
        _print_table(diagnosis, console)
        console.result(page, content(diagnosis))
        if require is not None:
            _hold_against(diagnosis, require)

    for_each_input(capture, work)


def _examine_scan(path: Path, page: Path, console: Console, *, overwrite: bool, require: str | None) -> None:
    """The same for a scan by transmission."""
    from nerfcli.workflows.scans import examine_scan_input, scan_diagnosis_record

    with console.progress(f"doctor {path.name}") as update:
        diagnosis = examine_scan_input(path, page, overwrite=overwrite, notify=console.note, progress=update)
    _print_table(diagnosis, console)
    console.result(page, scan_diagnosis_record(diagnosis))
    if require is not None:
        _hold_against(diagnosis, require)


def _print_table(diagnosis: "Diagnosis | ScanDiagnosis", console: Console) -> None:
    rows = []
    for finding in diagnosis.findings:
        names = ", ".join(finding.names[:_NAMES_SHOWN])
        more = f" and {len(finding.names) - _NAMES_SHOWN} more" if len(finding.names) > _NAMES_SHOWN else ""
        found = f"{finding.summary}{': ' + names + more if names else ''}"
        rows.append((finding.check, finding.verdict, found, finding.threshold, finding.advice))
    console.table(("check", "verdict", "found", "threshold", "what to do"), rows, styles=_STYLES)
    for check, reason in diagnosis.not_checked:
        console.note(f"not checked: {check}: {reason}")


def _hold_against(diagnosis: "Diagnosis | ScanDiagnosis", require: str) -> None:
    """Raise if a finding is worse than required."""
    from nerfcli.findings import VERDICTS

    worse = [f for f in diagnosis.findings if VERDICTS.index(f.verdict) > VERDICTS.index(require)]
    if worse:
        raise UserError(
            f"--require {require} is not met by {', '.join(f'{f.check} ({f.verdict})' for f in worse)}",
            worse[0].advice or "see the table",
            GATE_NOT_MET,
        )
