"""What the parent process asks of the worker, as a file between them."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

# Told (stage, done, total) as the work goes on.
Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class CameraGroup:
    """Photos (by number) that share one camera: its COLMAP model and the upright size."""

    photos: tuple[int, ...]
    model: str
    width: int
    height: int


@dataclass(frozen=True)
class Job:
    """Structure from motion of photos 0, 1, 2...

    folder: where to work. files: the numbered names below folder/photos. originals: the user's folder, and names:
    the photos' names there. pairs: which to compare. The rest is as in `PoseSettings`.
    """

    folder: str
    files: tuple[str, ...]
    originals: str
    names: tuple[str, ...]
    groups: tuple[CameraGroup, ...]
    pairs: tuple[tuple[int, int], ...]
    max_image_size: int
    max_features: int
    seed: int
    threads: int

    @property
    def photos(self) -> Path:
        """The upright photos under their numbered names."""
        return Path(self.folder) / "photos"

    @property
    def database(self) -> Path:
        """pycolmap's database of features and matches."""
        return Path(self.folder) / "database.db"


def write_job(path: Path, job: Job) -> None:
    """The job as JSON."""
    path.write_text(json.dumps(asdict(job)), encoding="utf-8")


def read_job(path: Path) -> Job:
    """A job that `write_job` wrote."""
    content = json.loads(path.read_text(encoding="utf-8"))
    content["groups"] = tuple(CameraGroup(**group | {"photos": tuple(group["photos"])}) for group in content["groups"])
    content["pairs"] = tuple((i, j) for i, j in content["pairs"])
    content["files"], content["names"] = tuple(content["files"]), tuple(content["names"])
    return Job(**content)
