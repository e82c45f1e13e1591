"""Folder of an incomplete job: it stays when the command ends early, and the next one continues it.

    .NAME.unfinished-DIGEST/           beside the folder NAME that it will become; DIGEST tells orders apart
        rgb/...  depth/...             files, each atomic
        .frames/order.json             what is to be rendered, for people
        .frames/done/NAME.json         one for each complete frame, written last: digests of its files, facts
        .frames/lock                   held by the one command that makes the folder complete

A frame counts as complete if its note is intact and its files match the note. Several commands may fill one folder, on
one machine or on many that share a disk; one at a time finishes it.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfcli.atomic import atomic_path, cannot_write, replace_folder, write_json
from nerfcli.render.job import DESCRIPTION, RenderJob

_NOTES = ".frames"


@dataclass(frozen=True)
class UnfinishedFrames:
    """The folder that collects the frames of a job."""

    folder: Path

    def note(self, name: str, files: Sequence[Path], *, facts: dict[str, Any]) -> None:
        """Note that a frame is complete.

        Args:
            facts: further facts about the picture, plain values for render.json.
        """
        digests = {str(path.relative_to(self.folder)): _digest(path.read_bytes()) for path in files}
        write_json(self._path(name), {"files": digests, "facts": facts, "note": _digest_of_note(digests, facts)})

    def has(self, name: str) -> bool:
        """Return whether a frame is complete and undamaged."""
        try:
            note = self.noted(name)
            return note["note"] == _digest_of_note(note["files"], note["facts"]) and all(
                _digest((self.folder / file).read_bytes()) == digest for file, digest in note["files"].items()
            )
        except (OSError, ValueError, LookupError, TypeError, AttributeError):
            return False  # it is rendered again

    def noted(self, name: str) -> dict[str, Any]:
        """Return the note on a frame: "facts", and "files" relative to the folder, with digests of their contents."""
        return json.loads(self._path(name).read_text(encoding="utf-8"))

    @property
    def lock(self) -> Path:
        """The file that one command at a time holds while it makes the folder complete."""
        return self.folder / _NOTES / "lock"

    def finish(self, folder: Path) -> None:
        """Move the folder to its final place, replacing an existing one in the same step.

        Raises:
            UserError: it cannot be moved.
        """
        for leftover in self.folder.rglob(".*.partial-*"):  # of commands that were killed while they wrote
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        replace_folder(self.folder, folder)
        shutil.rmtree(folder / _NOTES)

    def _path(self, name: str) -> Path:
        return self.folder / _NOTES / "done" / f"{name}.json"


def _digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def _digest_of_note(files: dict[str, str], facts: dict[str, Any]) -> str:
    return _digest(json.dumps([files, facts], sort_keys=True).encode())


def take_over(unfinished: UnfinishedFrames, job: RenderJob, finished: Path) -> None:
    """Link the frames of a finished folder, for which `RenderJob.shares_pictures_with` is True, into an unfinished one.

    Frames with a missing or changed file are left out, as are previews and videos. Files are hard-linked, or copied if
    the file system has no links, so that the finished folder always stays intact.

    Raises:
        UserError: the files cannot be linked or copied.
    """
    made = json.loads((finished / DESCRIPTION).read_text(encoding="utf-8"))
    for name in job.names:
        digests: dict[str, str] = made["files"][name]
        if unfinished.has(name) or not all(_has_digest(finished / file, digest) for file, digest in digests.items()):
            continue
        paths = [unfinished.folder / file for file in digests]
        for file, path in zip(digests, paths, strict=True):
            with atomic_path(path) as partial:
                try:
                    os.link(finished / file, partial)
                except OSError:  # a file system without links
                    shutil.copyfile(finished / file, partial)
        unfinished.note(name, paths, facts=made["facts"][name])


def _has_digest(path: Path, digest: str) -> bool:
    return path.is_file() and _digest(path.read_bytes()) == digest


def unfinished_of(job: RenderJob, folder: Path) -> UnfinishedFrames:
    """Return the unfinished folder of a job that will become `folder`; it is created if needed.

    Raises:
        UserError: it cannot be created.
    """
    unfinished = folder.with_name(f".{folder.name}.unfinished-{job.digest}")
    try:
        (unfinished / _NOTES).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error
    write_json(unfinished / _NOTES / "order.json", job.key())
    return UnfinishedFrames(unfinished)
