"""Examine a capture: findings, and a page with thumbnails."""

from pathlib import Path

import cv2

from nerfcli.atomic import refuse_read_only
from nerfcli.captures.calibration import read_calibration
from nerfcli.doctor.examination import Diagnosis, estimated_seconds, examine, find_subject
from nerfcli.doctor.page import page_html
from nerfcli.errors import UserError
from nerfcli.notices import Notify, Progress, no_progress, silent
from nerfcli.pages.page import Mark, refuse_foreign, write_page


def examine_capture(
    path: Path,
    page: Path,
    *,
    threads: int,
    overwrite: bool = False,
    intrinsics: Path | None = None,
    subfolders: bool = False,
    notify: Notify = silent,
    progress: Progress = no_progress,
) -> Diagnosis:
    """Examine a capture and write its page.

    Args:
        path: a folder of photos, or a scene.
        intrinsics: a file with the intrinsics of the cameras, if they are known.

    Raises:
        UserError: see `find_subject`, `read_calibration` and `refuse_foreign`; or the page cannot be written.
    """
    subject = find_subject(path, subfolders=subfolders)
    calibration = None if intrinsics is None else read_calibration(intrinsics, images=path)
    if page.is_dir():
        raise UserError(f"{page} is a folder", "give a file name for the page with -o")
    if not overwrite:
        refuse_foreign(page, Mark("doctor", path), about="capture")
    refuse_read_only(page)
    count = len(subject.sources)
    notify(f"{path}: {count} photos, about {_time(estimated_seconds(count, threads))}")
    cv2.setNumThreads(1)  # photos and pairs are processed in parallel; OpenCV's threads would only wait for each other
    diagnosis = examine(subject, threads=threads, progress=progress, calibration=calibration)
    write_page(page_html(diagnosis), page)
    return diagnosis


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
