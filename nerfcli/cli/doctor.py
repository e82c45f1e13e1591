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

GATES = ("good", "look")
Gate = Annotated[
    str | None, typer.Option(help="good or look: exit code 7 if any finding is worse.", show_default=False)
]
_STYLES = {"good": "green", "look": "yellow", "bad": "bold red"}


@command
def doctor(
    capture: Annotated[
        str, typer.Argument(help="Folder of photos, or a scene, or - to read paths from standard input.")
    ],
    output: Output = None,
    intrinsics: Intrinsics = None,
    subfolders: Subfolders = False,
    require: Gate = None,
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Check photos for problems before any long work.

    Checks blur, exposure, duplicates, lenses, overlap, camera movement and moving objects; for a scene, also its
    cameras. Prints a table on stderr and writes a page with thumbnails next to the capture, CAPTURE-doctor.html. Each
    finding is good, look or bad, with its number, its threshold and advice.

    \b
    Examples:
      nerfcli doctor photos/kitchen
      nerfcli doctor photos/kitchen --json -o kitchen.html | jq .verdict
      nerfcli doctor photos/kitchen --intrinsics calibration/cameras.txt
      nerfcli doctor photos/kitchen --require look
      nerfcli doctor stereo-rig/ --subfolders
      ls -d captures/*/ | nerfcli doctor - -o pages/
    """
    one_of(require, GATES, "--require")
    from nerfcli.captures.formats.run_cameras import find_run
    from nerfcli.doctor.examination import content
    from nerfcli.workflows.doctor import examine_capture

    console = Console(quiet=quiet, json_lines=json)

    def work(path: Path, one_of_many: bool) -> None:
        if find_run(path) is not None:
            raise UserError(
                f"{path} is a run: doctor examines photos and scenes",
                "nerfcli report RUN shows how many photos see what; render has --outputs coverage,parallax",
            )
        page = result_path(path, suffix="-doctor.html", output=output, one_of_many=one_of_many)
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
        show_findings(diagnosis, page, content(diagnosis), console, require=require)

    for_each_input(capture, work, command="doctor")


def show_findings(
    diagnosis: "Diagnosis | ScanDiagnosis", page: Path, record: dict[str, Any], console: Console, *, require: str | None
) -> None:
    """Print a table of the findings and the result.

    Raises:
        UserError: a finding is worse than required.
    """
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
