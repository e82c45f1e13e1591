"""nerfcli doctor: check photos before poses and training."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nerfcli.cli.batch import Given, for_each_input
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Printing, Threads, Writing, one_of
from nerfcli.cli.poses import Intrinsics, Subfolders
from nerfcli.errors import GATE_NOT_MET, UserError, listed
from nerfcli.machine import Resources
from nerfcli.pages.findings import VERDICTS, Finding

if TYPE_CHECKING:
    from nerfcli.ct.examine import ScanDiagnosis
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
    *,
    writing: Writing,
    intrinsics: Intrinsics = None,
    subfolders: Subfolders = False,
    require: Gate = None,
    threads: Threads = 0,
    printing: Printing,
) -> None:
    """Check photos for problems before poses and training.

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
    from nerfcli.doctor.examination import content, find_subject
    from nerfcli.doctor.page import examine_capture

    console, resources = printing.console, Resources(threads)

    def work(given: Given) -> None:
        path = given.path
        if find_run(path) is not None:
            hint = "nerfcli report RUN shows how many photos see what; render has --outputs coverage,parallax"
            raise UserError(f"{path} is a run: doctor examines photos and scenes", hint)
        page = writing.beside(given, "-doctor.html")
        with console.stage(f"doctor {path.name}") as reporter:
            subject = find_subject(path, subfolders=subfolders)
            for text in subject.scene.notes if subject.scene is not None else ():
                reporter.warn(text)
            diagnosis = examine_capture(subject, page, intrinsics, resources=resources, reporter=reporter)
        show_findings(diagnosis, page.at(path), content(diagnosis), console)
        check_gate(diagnosis.findings, require)

    for_each_input(capture, work, command="doctor")


def show_findings(diagnosis: "Diagnosis | ScanDiagnosis", page: Path, record: dict[str, Any], console: Console) -> None:
    """Print a table of the findings and the result."""
    rows = []
    for finding in diagnosis.findings:
        found = ": ".join(filter(None, (finding.summary, listed(finding.names))))
        rows.append((finding.check, finding.verdict, found, finding.threshold, finding.advice))
    console.table(("check", "verdict", "found", "threshold", "what to do"), rows, styles=_STYLES)
    for check, reason in diagnosis.not_checked:
        console.note(f"not checked: {check}: {reason}")
    console.result(page, record)


def check_gate(findings: Sequence[Finding], require: str | None) -> None:
    """Refuse findings that are worse than required, with the exit code `GATE_NOT_MET`."""
    if require is None:
        return
    worse = [f for f in findings if VERDICTS.index(f.verdict) > VERDICTS.index(require)]
    if worse:
        what = f"--require {require} is not met by {', '.join(f'{f.check} ({f.verdict})' for f in worse)}"
        raise UserError(what, worse[0].advice or "see the table", GATE_NOT_MET)
