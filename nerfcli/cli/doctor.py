"""nerfcli doctor: check photos before any long work."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nerfcli.cli.batch import for_each_input, result_path
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Json, Output, Overwrite, Quiet, Threads, one_of
from nerfcli.cli.poses import Intrinsics, Subfolders
from nerfcli.errors import GATE_NOT_MET, UserError, listed
from nerfcli.machine import thread_count
from nerfcli.pages.findings import VERDICTS

if TYPE_CHECKING:
    from nerfcli.ct.checks.examine import ScanDiagnosis
    from nerfcli.doctor.examination import Diagnosis

_GATES = ("good", "look")
_STYLES = {"good": "green", "look": "yellow", "bad": "bold red"}


@command
def doctor(
    capture: Annotated[
        str, typer.Argument(help="Folder of photos, or a scene, or - to read paths from standard input.")
    ],
    output: Output = None,
    intrinsics: Intrinsics = None,
    subfolders: Subfolders = False,
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
      nerfcli doctor stereo-rig/ --subfolders
      ls -d captures/*/ | nerfcli doctor - -o pages/
    """
    one_of(require, _GATES, "--require")
    from nerfcli.captures.formats.run_cameras import find_run
    from nerfcli.ct.formats.read import recognise
    from nerfcli.ct.result import is_reconstruction
    from nerfcli.doctor.examination import content
    from nerfcli.workflows.doctor import examine_capture

    console = Console(quiet=quiet, json_lines=json)

    def work(path: Path, one_of_many: bool) -> None:
        if find_run(path) is not None:
            raise UserError(
                f"{path} is a run: doctor examines photos, scenes and scans",
                "nerfcli report RUN shows how many photos see what; render has --outputs coverage,parallax",
            )
        if is_reconstruction(path):
            raise UserError(
                f"{path} is the reconstruction of an X-ray scan", "doctor examines the scan itself: give its folder"
            )
        page = result_path(path, suffix="-doctor.html", output=output, one_of_many=one_of_many)
        if recognise(path) is not None:
            if intrinsics is not None or subfolders:
                raise UserError(
                    f"{path}: --intrinsics and --subfolders are for photos, and this is a scan", "leave them out"
                )
            from nerfcli.ct.scans import examine_scan_input, scan_diagnosis_record

            with console.callbacks(f"doctor {path.name}") as callbacks:
                of_scan = examine_scan_input(path, page, overwrite=overwrite, **callbacks)
            _show(of_scan, page, scan_diagnosis_record(of_scan), console, require=require)
            return
        with console.callbacks(f"doctor {path.name}") as callbacks:
            diagnosis = examine_capture(
                path,
                page,
                threads=thread_count(threads),
                overwrite=overwrite,
                intrinsics=intrinsics,
                subfolders=subfolders,
                **callbacks,
            )
        _show(diagnosis, page, content(diagnosis), console, require=require)

    for_each_input(capture, work, command="doctor")


def _show(
    diagnosis: "Diagnosis | ScanDiagnosis", page: Path, record: dict[str, Any], console: Console, *, require: str | None
) -> None:
    """Print a table of the findings and the result, and raise if a finding is worse than required."""
    rows = []
    for finding in diagnosis.findings:
        found = ": ".join(filter(None, (finding.summary, listed(finding.names))))
        rows.append((finding.check, finding.verdict, found, finding.threshold, finding.advice))
    console.table(("check", "verdict", "found", "threshold", "what to do"), rows, styles=_STYLES)
    for check, reason in diagnosis.not_checked:
        console.note(f"not checked: {check}: {reason}")
    console.result(page, record)
    if require is None:
        return
    worse = [f for f in diagnosis.findings if VERDICTS.index(f.verdict) > VERDICTS.index(require)]
    if worse:
        raise UserError(
            f"--require {require} is not met by {', '.join(f'{f.check} ({f.verdict})' for f in worse)}",
            worse[0].advice or "see the table",
            GATE_NOT_MET,
        )
