"""A reconstruction: the volume that was fitted to a scan, and the run folder that holds it.

RUN/reconstruction.json records what was fitted, how, and the decisions taken; RUN/volume.npy holds the attenuation, and
RUN/marks.npy marks the voxels that the views do not determine, see `grid`.
"""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.atomic import atomic_path, read_sealed, write_sealed
from nerfcli.ct.grid import VoxelGrid
from nerfcli.ct.likelihood import with_noise
from nerfcli.ct.recognise import DESCRIPTION, MEASUREMENT, is_reconstruction
from nerfcli.ct.scan import Scan, array_digest, load_scan, read_array
from nerfcli.errors import UserError

VOLUME = "volume.npy"
MARKS = "marks.npy"
METRICS = "metrics.json"
LOCK = ".train.lock"


@dataclass(frozen=True)
class ReconstructionSettings:
    """Settings for fitting a volume to a scan.

    Args:
        budget_seconds: time limit for everything, trials included; None for no limit.
        passes: number of passes over all views; None for no limit.
        voxel_size: in the scan's unit; None for the size of a pixel at the object.
        strength: weight of total variation, see `reconstruct`.
        centre: columns that the detector is moved by; None to estimate them.
        tilt: rotation of the detector in its plane in radians; None to estimate it.
        air: whether the open beam of each view is measured in its pixels beside the object; None to decide by the data.
        threads: number of CPU threads; 0 for all.

    Raises:
        UserError: there is neither a budget nor a number of passes, or a number is out of range.
    """

    budget_seconds: float | None = None
    passes: int | None = None
    voxel_size: float | None = None
    strength: float = 1.0
    centre: float | None = None
    tilt: float | None = None
    air: bool | None = None
    threads: int = 0

    def __post_init__(self) -> None:
        if self.budget_seconds is None and self.passes is None:
            raise UserError(
                "no stopping criterion: neither --budget nor --passes is given", "give --budget 2m or --passes 30"
            )
        if self.voxel_size is not None and not 0 < self.voxel_size < math.inf:
            raise UserError(f"invalid voxel size {self.voxel_size:g}", "give --voxel-size a length above 0")
        for option, value in (("--centre", self.centre), ("--tilt", self.tilt)):
            if value is not None and not math.isfinite(value):
                raise UserError(f"{option} is not a finite number", "give one, or leave it out")
        if not 0 <= self.strength < math.inf:
            raise UserError(
                f"invalid weight of total variation: {self.strength:g}",
                "give --tv a number of 0 or more, or leave it out",
            )


@dataclass(frozen=True)
class Reconstruction:
    """A volume and how it was made.

    Args:
        volume: (Z, Y, X) attenuation in 1 / unit, float32.
        marks: (Z, Y, X) uint8, see `grid`.
        grid: position and size of its voxels.
        unit: unit of lengths.
        scan: folder of the scan, as the user named it.
        scan_digest: digest of the measurements, see `Scan.digest`.
        settings: as given.
        used: the strength, centre, tilt and factors of the open beam that were used.
        decisions: a sentence for each setting that was decided by the data.
        passes, seconds: passes of the fit, and seconds in total.
        settled: whether the last pass hardly changed the volume.
        missing_wedge_deg: range of directions without rays, see `grid.missing_wedge_deg`.
        versions: versions of the programs used.
        complete: False if the fit was interrupted.
    """

    volume: np.ndarray
    marks: np.ndarray
    grid: VoxelGrid
    unit: str
    scan: Path
    scan_digest: str
    settings: ReconstructionSettings
    used: Mapping[str, Any] = field(default_factory=dict)
    decisions: Sequence[str] = ()
    passes: int = 0
    seconds: float = 0.0
    settled: bool = False
    missing_wedge_deg: float = 0.0
    versions: Mapping[str, str] = field(default_factory=dict)
    complete: bool = True


# The fields of a reconstruction that its description holds as they are.
_PLAIN = (
    *("unit", "scan_digest", "used", "decisions", "passes", "seconds", "settled"),
    *("missing_wedge_deg", "versions", "complete"),
)


def save_reconstruction(run: Path, result: Reconstruction) -> None:
    """Write a run's folder; reconstruction.json is renamed last and lists the digests of the arrays.

    The files of an earlier run stay until all of the new ones have been written.

    Raises:
        UserError: it cannot be written.
    """
    plain = {name: getattr(result, name) for name in _PLAIN}
    records = {"scan": str(result.scan), "grid": asdict(result.grid), "settings": asdict(result.settings)}
    digests = {VOLUME: array_digest(result.volume), MARKS: array_digest(result.marks)}
    with (
        atomic_path(run / DESCRIPTION) as description,
        atomic_path(run / VOLUME) as volume,
        atomic_path(run / MARKS) as marked,
    ):
        np.save(volume, result.volume, allow_pickle=False)
        np.save(marked, result.marks, allow_pickle=False)
        write_sealed(description, {"measurement": MEASUREMENT, **plain, **records, "arrays": digests})


def load_reconstruction(run: Path) -> Reconstruction:
    """Read what `save_reconstruction` wrote.

    Raises:
        UserError: there is none, or its files are damaged.
    """
    if not is_reconstruction(run):
        hint = "give a run folder that nerfcli ct train wrote"
        raise UserError(f"{run} is not a reconstruction" if os.path.exists(run) else f"{run} does not exist", hint)
    try:
        content = read_sealed(run / DESCRIPTION)
        arrays = {name: read_array(run / name, digest) for name, digest in content["arrays"].items()}
        return Reconstruction(
            arrays.pop(VOLUME),
            arrays.pop(MARKS),
            VoxelGrid.of(**content["grid"]),
            scan=Path(content["scan"]),
            settings=ReconstructionSettings(**content["settings"]),
            **{name: content[name] for name in _PLAIN},
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{run} cannot be read as a reconstruction: {error}",
            "train the scan again with --overwrite, or into another folder with -o",
        ) from error


def scan_of(result: Reconstruction, run: Path) -> Scan:
    """Load the scan of a reconstruction, with the noise that was corrected in the fit.

    Raises:
        UserError: the scan no longer exists, or has changed.
    """
    if not result.scan.exists():
        raise UserError(
            f"the scan {result.scan} of {run} does not exist",
            "run the command from the folder that train was run in, or train again",
        )
    scan = load_scan(result.scan)
    if scan.digest != result.scan_digest:
        raise UserError(f"{result.scan} has changed since {run} was trained", "train again with --overwrite")
    return with_noise(scan, lower=lower) if (lower := result.used.get("noise_lower", 1.0)) > 1 else scan
