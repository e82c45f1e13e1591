"""nerfcli doctor: what to know of a capture before any long work."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nerfcli.cli.batch import for_each_input, result_path
from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Json, Output, Overwrite, Quiet, Threads, thread_count
from nerfcli.cli.poses import Intrinsics
from nerfcli.errors import GATE_NOT_MET, UserError

if TYPE_CHECKING:
    from nerfcli.doctor.examination import Diagnosis

_NAMES_SHOWN = 4
_GATES = ("good", "look")
_STYLES = {"good": "green", "look": "yellow", "bad": "bold red"}


@command
def doctor(
    capture: Annotated[str, typer.Argument(help="A folder of photos or a scene, or - for such on standard input.")],
    output: Output = None,
    intrinsics: Intrinsics = None,
    require: Annotated[
        str | None, typer.Option(help="good or look: end with exit code 7 if a finding is worse.", show_default=False)
    ] = None,
    threads: Threads = 0,
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Tell what an expert would say of photos before any long work.

    Blur, exposure, doubles, lenses, overlap, movement, moving things. Prints a table on stderr and writes a page with
    thumbnails beside the capture, CAPTURE-doctor.html. Of a scene it judges the cameras too. Each finding is good, look
    or bad, with its number, its threshold and what to do.

    \b
    Examples:
      nerfcli doctor photos/kitchen
      nerfcli doctor photos/kitchen --json -o kitchen.html | jq .verdict
      nerfcli doctor photos/kitchen --intrinsics calibration/cameras.txt
      nerfcli doctor photos/kitchen --require look
      ls -d captures/*/ | nerfcli doctor - -o pages/
    """
    if require is not None and require not in _GATES:
        raise typer.BadParameter(f"{require!r}; choose {' or '.join(_GATES)}", param_hint="--require")
    console = Console(quiet=quiet, json_lines=json)

    def work(path: Path, one_of_many: bool) -> None:
        page = result_path(path, suffix="-doctor.html", output=output, one_of_many=one_of_many)
        diagnosis = examine_capture(
            path,
            page,
            threads=thread_count(threads),
            overwrite=overwrite,
            console=console,
            intrinsics=intrinsics,
        )
        from nerfcli.doctor.examination import content

        console.result(page, content(diagnosis))
        if require is not None:
            _hold_against(diagnosis, require)

    for_each_input(capture, work)


def examine_capture(
    path: Path, page: Path, *, threads: int, overwrite: bool, console: Console, intrinsics: Path | None = None
) -> "Diagnosis":
    """Examine a capture, write its page and print the table of findings; with a file of intrinsics, if they are known.

    Raises:
        UserError: see `find_subject`, `read_calibration` and `refuse_foreign`; or the page cannot be written.
    """
    import cv2

    from nerfcli.atomic import cannot_write
    from nerfcli.convert.intrinsics import read_calibration
    from nerfcli.doctor.examination import estimated_seconds, examine
    from nerfcli.doctor.page import refuse_foreign, write_page
    from nerfcli.doctor.subject import find_subject

    subject = find_subject(path)
    calibration = None if intrinsics is None else read_calibration(intrinsics, images=path)
    if page.is_dir():
        raise UserError(f"{page} is a folder", "give the page's file name with -o")
    if not overwrite:
        refuse_foreign(page, path)
    home = next(folder for folder in page.absolute().parents if folder.exists())
    if not os.access(home, os.W_OK):  # before the work rather than after it
        raise cannot_write(page, PermissionError(13, "no permission to write there"))
    count = len(subject.sources)
    seconds = estimated_seconds(count, threads)
    console.note(f"{path}: {count} photos, about {_time(seconds)}")
    cv2.setNumThreads(1)  # photos and pairs are worked on in parallel; threads within them only wait for each other
    with console.progress(f"doctor {path.name}") as update:
        diagnosis = examine(subject, threads=threads, progress=update, calibration=calibration)
    write_page(diagnosis, page)
    _print_table(diagnosis, console)
    return diagnosis


def _print_table(diagnosis: "Diagnosis", console: Console) -> None:
    rows = []
    for finding in diagnosis.findings:
        names = ", ".join(finding.names[:_NAMES_SHOWN])
        more = f" and {len(finding.names) - _NAMES_SHOWN} more" if len(finding.names) > _NAMES_SHOWN else ""
        found = f"{finding.summary}{': ' + names + more if names else ''}"
        rows.append((finding.check, finding.verdict, found, finding.threshold, finding.advice))
    console.table(("check", "verdict", "found", "threshold", "what to do"), rows, styles=_STYLES)
    for check, reason in diagnosis.not_checked:
        console.note(f"not checked: {check}: {reason}")


def _hold_against(diagnosis: "Diagnosis", require: str) -> None:
    """Raise if a finding is worse than required."""
    from nerfcli.doctor.findings import VERDICTS

    worse = [f for f in diagnosis.findings if VERDICTS.index(f.verdict) > VERDICTS.index(require)]
    if worse:
        raise UserError(
            f"--require {require} is not met by {', '.join(f'{f.check} ({f.verdict})' for f in worse)}",
            worse[0].advice or "see the table",
            GATE_NOT_MET,
        )


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
