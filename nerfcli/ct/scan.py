"""A scan: a detector's measurements behind an object, the geometry of their rays, and the folder that holds them.

SCAN/scene.json holds geometry, unit and provenance; the arrays are .npy files beside it, which are memory-mapped when
they are read. `nerfcli ct convert` writes such folders from the formats of scanners.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from nerfcli.atomic import atomic_folder, read_sealed, write_sealed
from nerfcli.ct.geometry import Beam, ScanGeometry, from_vectors
from nerfcli.ct.grid import VoxelGrid
from nerfcli.ct.recognise import MEASUREMENT, SCENE_FILE
from nerfcli.errors import UserError

FORMAT = "nerfcli scan 1"

# One in this many views is held out if the scan does not state which.
HELD_OUT_EVERY = 6

Kind = Literal["counts", "transmission", "line_integral"]
KINDS: tuple[Kind, ...] = ("counts", "transmission", "line_integral")

_ARRAYS = ("values", "open_beam", "dark", "usable")


@dataclass(frozen=True)
class Scan:
    """The measurements of a scan, I = I0 exp(-line integral) + dark.

    Args:
        geometry: geometry of all views.
        kind: type of `values`: "counts" (detector values, dark included), "transmission" ((I - dark) / I0) or
            "line_integral" (-log of the transmission).
        values: (V, rows, columns) float32.
        open_beam: detector values without object minus the dark ones, broadcastable to `values`; counts only.
        dark: detector values without beam, broadcastable to `values`; counts only.
        photons_per_value: number of photons per detector value, or for "transmission" per transmission of 1; None if
            unknown.
        usable: bool, broadcastable to `values`: False for dead pixels and other invalid values; None if all are usable.
        held_out: sorted indices of the views that no reconstruction reads.
        unit: unit of lengths: "mm", "voxel" (pixels), or "unit" if unknown; attenuation is in its inverse.
        history: provenance of the scan, as plain values.
        deviation: standard deviation of the noise of "line_integral"; None if unknown. It is not stored.
    """

    geometry: ScanGeometry
    kind: Kind
    values: np.ndarray
    open_beam: np.ndarray | None = None
    dark: np.ndarray | None = None
    photons_per_value: float | None = None
    usable: np.ndarray | None = None
    held_out: tuple[int, ...] = ()
    unit: str = "mm"
    history: Mapping[str, Any] = field(default_factory=dict)
    deviation: float | None = None

    def __post_init__(self) -> None:
        expected = (self.geometry.views, self.geometry.rows, self.geometry.columns)
        if self.values.shape != expected:
            raise ValueError(f"values have shape {self.values.shape}, the geometry {expected}")
        if self.kind not in KINDS:
            raise ValueError(f"kind must be one of {KINDS}, got {self.kind!r}")
        if (self.kind == "counts") != (self.open_beam is not None):
            raise ValueError("an open beam goes with counts, and with nothing else")
        if not set(self.held_out) <= set(range(self.geometry.views)):
            raise ValueError(f"held-out views {self.held_out} of {self.geometry.views}")

    @property
    def live_views(self) -> np.ndarray:
        """Indices of the views that have a usable pixel."""
        views = np.arange(self.geometry.views)
        return views if self.usable is None or len(self.usable) == 1 else views[[part.any() for part in self.usable]]

    @property
    def training_views(self) -> np.ndarray:
        """Indices of the views to reconstruct from: live ones that are not held out."""
        return np.setdiff1d(self.live_views, np.array(self.held_out, dtype=int))

    @property
    def digest(self) -> str:
        """Hash of geometry and measurements, which identifies the scan."""
        hasher = hashlib.blake2b(digest_size=16)
        hasher.update(self.geometry.vectors().tobytes())
        for name in _ARRAYS:
            array = getattr(self, name)
            hasher.update(b"-" if array is None else array_digest(array).encode())
        hasher.update(f"{self.kind} {self.photons_per_value} {self.held_out} {self.unit}".encode())
        return hasher.hexdigest()

    def of_views(self, name: str, views: np.ndarray) -> np.ndarray | None:
        """Return one of the arrays `open_beam`, `dark` and `usable` for some views, in its own broadcast shape."""
        array = getattr(self, name)
        return array if array is None or len(array) == 1 else array[views]

    def only_rows(self, first: int, end: int) -> "Scan":
        """Return the scan with only the detector rows from `first` to before `end`."""
        middle = (first + end - 1) / 2 - (self.geometry.rows - 1) / 2

        def cut(array: np.ndarray | None) -> np.ndarray | None:
            return array if array is None or array.shape[1] == 1 else array[:, first:end]

        return replace(
            self,
            geometry=replace(self.geometry.shifted(0, middle), rows=end - first),
            values=self.values[:, first:end],
            open_beam=cut(self.open_beam),
            dark=cut(self.dark),
            usable=cut(self.usable),
        )

    def line_integrals(self, views: np.ndarray) -> np.ndarray:
        """Return -log of the transmission of views, (len(views), rows, columns) float32, for pictures and baselines.

        Unusable pixels are interpolated along their row; rows without a usable one are 0. Smaller transmissions are
        raised to that of half a photon, or to 1e-4 if photons are unknown. The logarithm of noise is biased, so no
        likelihood is computed from the result.
        """
        integrals = self._logarithms(views)
        usable = self.of_views("usable", views)
        if usable is None:
            return integrals
        bad = ~np.broadcast_to(usable, integrals.shape)
        columns = np.arange(integrals.shape[2])
        for view, line in np.argwhere(bad.any(axis=2)):
            good, values = ~bad[view, line], integrals[view, line]
            integrals[view, line] = np.interp(columns, columns[good], values[good]) if good.any() else 0
        return integrals

    def _logarithms(self, views: np.ndarray) -> np.ndarray:
        values = np.asarray(self.values[views], dtype=np.float32)
        if self.kind == "line_integral":
            return values
        floor = np.float32(1e-4)
        if self.kind == "counts":
            dark, open_beam = self.of_views("dark", views), self.of_views("open_beam", views)
            assert open_beam is not None
            values = (values - (0 if dark is None else dark)) / open_beam
            if self.photons_per_value is not None:
                floor = np.float32(0.5) / (open_beam * np.float32(self.photons_per_value))
        elif self.photons_per_value is not None:
            floor = np.float32(0.5 / self.photons_per_value)
        return -np.log(np.maximum(values, floor)).astype(np.float32)


def save_scan(folder: Path, scan: Scan) -> None:
    """Write a scan's folder atomically; an existing folder is replaced.

    Raises:
        UserError: it cannot be written.
    """
    with atomic_folder(folder) as partial:
        digests = {}
        for name in _ARRAYS:
            array = getattr(scan, name)
            if array is None:
                continue
            stored = np.ascontiguousarray(array, dtype=bool if name == "usable" else np.float32)
            np.save(partial / f"{name}.npy", stored, allow_pickle=False)
            digests[name] = array_digest(stored)
        geometry = scan.geometry
        write_sealed(
            partial / SCENE_FILE,
            {
                "format": FORMAT,
                "measurement": MEASUREMENT,
                "kind": scan.kind,
                "unit": scan.unit,
                "beam": geometry.beam,
                "rows": geometry.rows,
                "columns": geometry.columns,
                "vectors": geometry.vectors().tolist(),
                "photons_per_value": scan.photons_per_value,
                "held_out": list(scan.held_out),
                "arrays": digests,
                "history": dict(scan.history),
            },
        )


def load_scan(folder: Path) -> Scan:
    """Read what `save_scan` wrote.

    Raises:
        UserError: there is no scan, or its files are damaged.
    """
    path = folder / SCENE_FILE
    try:
        content = read_sealed(path)
        if content.get("measurement") != MEASUREMENT or content.get("format") != FORMAT:
            raise ValueError(f"its format is {content.get('format')!r}, expected {FORMAT!r}")
        beam: Beam = content["beam"]
        geometry = from_vectors(beam, content["vectors"], rows=content["rows"], columns=content["columns"])
        arrays = {name: read_array(folder / f"{name}.npy", digest) for name, digest in content["arrays"].items()}
        return Scan(
            geometry,
            content["kind"],
            arrays["values"],
            arrays.get("open_beam"),
            arrays.get("dark"),
            content["photons_per_value"],
            arrays.get("usable"),
            tuple(content["held_out"]),
            content["unit"],
            content["history"],
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} cannot be read as a scan: {error}", "convert the scan again") from error


def held_out_views(views: int) -> tuple[int, ...]:
    """Return the views held out by default: every few from the first; none if there are too few views."""
    return tuple(range(0, views, HELD_OUT_EVERY)) if views > HELD_OUT_EVERY else ()


def read_array(path: Path, digest: str) -> np.ndarray:
    """Memory-map the array of a .npy file; raise ValueError if its digest differs."""
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    if array_digest(array) != digest:
        raise ValueError(f"{path.name} is not what was written")
    return array


def array_digest(array: np.ndarray) -> str:
    """Hash an array: shape, type and bytes."""
    hasher = hashlib.blake2b(digest_size=16)
    hasher.update(f"{array.shape} {array.dtype}".encode())
    for part in array:
        hasher.update(np.ascontiguousarray(part).tobytes())
    return hasher.hexdigest()


def described_truth(
    path: Path,
    layout: str,
    shape: Sequence[int],
    *,
    size: float,
    attenuation_per_value: float,
    first: Sequence[float] | None = None,
    dtype: str | None = None,
) -> dict[str, Any]:
    """Return the entry "truth" of a scan's history, from which `load_truth` loads the true volume.

    Args:
        path: the file: a .npy, or plain numbers of type `dtype`.
        layout: order of the axes in the file, "zyx" or "xyz".
        shape: number of voxels (z, y, x).
        size: side of a voxel, in the scan's unit.
        attenuation_per_value: in the inverse of the scan's unit.
        first: (x, y, z) centre of the first voxel; by default, the volume is centred on the origin.
    """
    return {
        "path": str(path.absolute()),
        "layout": layout,
        **({} if dtype is None else {"dtype": dtype}),
        "shape": list(shape),
        "first": [-(count - 1) / 2 * size for count in reversed(shape)] if first is None else list(first),
        "size": size,
        "attenuation_per_value": attenuation_per_value,
    }


def load_truth(history: Mapping[str, Any]) -> tuple[VoxelGrid, np.ndarray] | None:
    """Load the true volume that a scan's history refers to.

    Returns:
        Its grid and (Z, Y, X) float32 attenuation in the inverse of the scan's unit; None if the history has none.

    Raises:
        UserError: its file cannot be read, or has another shape.
    """
    stated = history.get("truth")
    if not isinstance(stated, Mapping):
        return None
    path = Path(stated["path"])
    shape = tuple(int(count) for count in stated["shape"])
    try:
        if "dtype" in stated:
            volume = np.fromfile(path, dtype=stated["dtype"])
        else:
            volume = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise UserError(
            f"the true volume {path} cannot be read: {error}",
            "restore it, or convert the scan again without it",
        ) from error
    if volume.size != np.prod(shape):
        raise UserError(
            f"{path} has {volume.size} values, expected {shape}", "it is not the volume that the scan was made of"
        )
    if stated["layout"] == "xyz":
        volume = volume.reshape(shape[::-1]).transpose(2, 1, 0)
    volume = volume.reshape(shape).astype(np.float32) * np.float32(stated["attenuation_per_value"])
    return VoxelGrid.of(shape, [float(value) for value in stated["first"]], float(stated["size"])), volume
