"""Job of the worker process, stored as a file, and the files of its completed stages.

A complete stage is a JSON file {"key", "content", "seal"} in the work folder. The key is a hash of everything that the
content depends on: a stage with another key than the requested one counts as missing. The seal is a hash of the
content: a stage that is cut off or was changed counts as missing, too.
"""

import hashlib
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from nerfcli.atomic import write_json
from nerfcli.photos.panoramas import PANORAMA

# Called with (stage, done, total) as the work proceeds.
Report = Callable[[str, int, int], None]
# Called with messages for the user, one sentence at a time.
Tell = Callable[[str], None]


@dataclass(frozen=True)
class CameraGroup:
    """Photos (by index) with a common camera: its COLMAP model and the upright size.

    choose: whether the model is only a starting point, and a better one may be chosen. params: known intrinsics, in
    COLMAP's order. fixed: whether these are kept fixed. focal_px: the initial focal length by EXIF, None if EXIF has
    none; focal_is_prior: whether it is reliable. estimated_focal_px: the initial focal length estimated from pairs of
    the photos, see `engine.initial_lens`.
    """

    photos: tuple[int, ...]
    model: str
    width: int
    height: int
    choose: bool = False
    params: tuple[float, ...] | None = None
    fixed: bool = False
    focal_px: float | None = None
    focal_is_prior: bool = False
    estimated_focal_px: float | None = None

    @property
    def is_panorama(self) -> bool:
        """Whether the photos show the whole sphere; their size then determines the camera."""
        return self.model == PANORAMA


@dataclass(frozen=True)
class WorkMask:
    """Mask of one photo: a hash of the used pixels, "" without a mask, and their fraction."""

    key: str = ""
    used_fraction: float = 1.0


@dataclass(frozen=True)
class Solver:
    """How a model is adjusted and judged: the seed of random choices, threads, ids of cameras with fixed intrinsics."""

    seed: int = 0
    threads: int = 1
    fixed: tuple[int, ...] = ()


@dataclass(frozen=True)
class Job:
    """Structure from motion of photos 0, 1, 2...

    folder: the work folder. files: the photos' names below folder/photos, which are numbers that a photo keeps as long
    as the folder exists. originals: the user's folder, and names: the photos' names there. keys: hashes of their
    content. pairs: to match. neighbours: how many look-alikes to add to the pairs of each photo; 0 once they are in
    pairs. variant: "" or the name of an attempt with other features, which has its own database and stages:
    `replace(job, variant="full-size", max_image_size=...)`. masks: one per photo, or none at all for a capture without
    masks; their pictures are in mask_folder. held_out: photos that are placed last, with everything else fixed.
    skipped_checks: (name, reason) of checks that ended an earlier process. threads: their number, never -1.
    max_image_size, max_features, halved_from: see `Search`. seed: as in `PoseSettings`.
    """

    folder: str
    files: tuple[str, ...]
    originals: str
    names: tuple[str, ...]
    keys: tuple[str, ...]
    groups: tuple[CameraGroup, ...]
    pairs: tuple[tuple[int, int], ...]
    neighbours: int
    max_image_size: int
    max_features: int
    seed: int
    threads: int
    masks: tuple[WorkMask, ...] = ()
    variant: str = ""
    held_out: tuple[int, ...] = ()
    skipped_checks: tuple[tuple[str, str], ...] = ()
    halved_from: int = 0

    @property
    def photos(self) -> Path:
        """Folder of the upright photos under their numbered names."""
        return Path(self.folder) / "photos"

    @property
    def mask_folder(self) -> Path:
        """Folder of the masks, named after the photos' files with .png appended."""
        return Path(self.folder) / "masks"

    @property
    def model_folder(self) -> Path:
        """Folder of the model that becomes the scene's."""
        return Path(self.folder) / "sparse" / "0"

    def stage_file(self, name: str) -> Path:
        """Return the path of a stage on the way to the database."""
        return Path(self.folder) / f"{self.variant}{'-' if self.variant else ''}{name}.json"

    @property
    def solver(self) -> Solver:
        """How models of these photos are adjusted; a camera's id is the position of its group, from 1."""
        fixed = tuple(number for number, group in enumerate(self.groups, start=1) if group.fixed)
        return Solver(self.seed, self.threads, fixed)

    @property
    def given_cameras(self) -> list[int]:
        """Ids of the cameras with given intrinsics."""
        return [number for number, group in enumerate(self.groups, start=1) if group.params is not None]

    @property
    def database(self) -> Path:
        """pycolmap's database of features and matches; it stays beside the model."""
        return database_path(Path(self.folder), self.variant)

    @cached_property
    def image_ids(self) -> tuple[int, ...]:
        """The photos' ids in the database, by number; pycolmap's ids start at 1."""
        return tuple(int(Path(file).stem) + 1 for file in self.files)

    @cached_property
    def name_of(self) -> dict[int, str]:
        """The photos' own names, by id in the database."""
        return dict(zip(self.image_ids, self.names, strict=True))

    @property
    def sizes(self) -> dict[int, tuple[int, int]]:
        """Width and height of each upright photo, by id in the database."""
        return {self.image_ids[photo]: (group.width, group.height) for group in self.groups for photo in group.photos}


def database_path(work: Path, variant: str = "") -> Path:
    """Return the path of a work folder's database: in the scene folder above it, or inside it for a named variant."""
    return work / f"{variant}.db" if variant else work.parent / "database.db"


def write_job(path: Path, job: Job) -> None:
    """Write the job as JSON."""
    path.write_text(json.dumps(asdict(job)), encoding="utf-8")


def read_job(path: Path) -> Job:
    """Read a job that `write_job` wrote."""
    return job_from_json(json.loads(path.read_text(encoding="utf-8")))


def job_from_json(content: dict[str, Any]) -> Job:
    """Rebuild a job from the result of `dataclasses.asdict`, after a round trip through JSON."""
    content = _with_tuples(content)
    groups = tuple(CameraGroup(**group) for group in content["groups"])
    masks = tuple(WorkMask(**mask) for mask in content["masks"])
    return Job(**content | {"groups": groups, "masks": masks})


def _with_tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _with_tuples(item) for key, item in value.items()}
    return tuple(_with_tuples(item) for item in value) if isinstance(value, list) else value


def stage_key(*parts: Any) -> str:
    """Return a hash of plain values: equal for equal values, in every process and on every machine."""
    text = json.dumps(parts, sort_keys=True, ensure_ascii=False)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def file_key(path: Path) -> str:
    """Return a hash of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def write_stage(path: Path, key: str, content: Any) -> None:
    """Mark a stage as complete. Everything else that belongs to it must be on disk already."""
    write_json(path, {"key": key, "content": content, "seal": _seal(content)})


def read_stage(path: Path, key: str) -> Any | None:
    """Return the content of the complete stage with this key, None if it is missing or damaged."""
    if not path.is_file():
        return None
    try:
        stage = json.loads(path.read_bytes())
    except (ValueError, RecursionError):  # cut off, or not text
        return None
    if not isinstance(stage, dict) or stage.get("key") != key or "content" not in stage:
        return None
    return stage["content"] if stage.get("seal") == _seal(stage["content"]) else None


def _seal(content: Any) -> str:
    return stage_key(json.loads(json.dumps(content)))  # as read back from a file: keys are strings, tuples are lists


@contextmanager
def repeatedly(look: Callable[[], object], *, seconds: float = 1.0) -> Iterator[None]:
    """Call `look` each time so many seconds have passed, from a thread of its own, until the block ends."""
    finished = threading.Event()

    def watch() -> None:
        while not finished.wait(seconds):
            look()

    watcher = threading.Thread(target=watch, daemon=True)
    try:
        watcher.start()  # Ctrl-C may come while it starts
        yield
    finally:
        finished.set()
        if watcher.ident is not None:
            watcher.join()
