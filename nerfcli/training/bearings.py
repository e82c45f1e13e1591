"""Bearings of the pixels of photos: a table for each lens, which photos share.

Photos of a stabilised lens have principal points of their own and see the same bearings, moved by a fraction of a
pixel. They share one table that is a little larger than a photo, and their bearings are interpolated in it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from nerfcli.cameras.camera import Camera, by_lens
from nerfcli.kernels import BearingGrids
from nerfcli.training.storage import PhotoStorage


class BearingTables:
    """The bearings of the pixels of P photos.

    `values` (B, 3) are those of all tables, `first` (P,) the index of each photo's first bearing. `grids` tells how to
    interpolate them, see `BearingGrids`; None if each photo has the principal point of its table.

    Accuracy: an interpolated bearing is off by a fraction of 1 / (8 f) of a pixel, f the focal length in pixels.

    Args:
        cameras: (P,) of the photos.
        storage: for the tables, which may be as large as photos.
    """

    def __init__(self, cameras: Sequence[Camera], device: torch.device, *, storage: PhotoStorage):
        table_of = {camera: table for lens in by_lens(cameras).values() for camera, table in _tables(lens).items()}
        tables = list(dict.fromkeys(table_of.values()))
        begins = np.cumsum([0, *(table.width * table.height for table in tables)]).tolist()
        values = storage.array((begins[-1], 3), np.float32)
        self._valid = {
            table: _fill(table, values[begin : begin + table.width * table.height], storage)
            for table, begin in zip(tables, begins[:-1], strict=True)
        }
        self._table_of = table_of
        self.values = torch.from_numpy(values).to(device)
        offsets = [_offset(camera, table_of[camera]) for camera in cameras]
        shifts = np.array([offset or (0.0, 0.0) for offset in offsets]).reshape(-1, 2)
        whole = np.floor(shifts).astype(np.int64)
        grid_widths = np.array([table_of[camera].width for camera in cameras])
        begin = dict(zip(tables, begins[:-1], strict=True))
        first = np.array([begin[table_of[camera]] for camera in cameras]) + whole[:, 1] * grid_widths + whole[:, 0]
        self.first = torch.from_numpy(first).to(device)
        self.grids: BearingGrids | None = None
        if any(offset is not None for offset in offsets):
            x, y = (shifts - whole).T
            corners = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=-1)
            widths = np.stack([[camera.width for camera in cameras], grid_widths], axis=-1)
            self.grids = BearingGrids(
                torch.from_numpy(widths).to(device), torch.from_numpy(corners.astype(np.float32)).to(device)
            )

    def valid(self, camera: Camera) -> np.ndarray:
        """Return which pixels of a camera have a bearing, (N,) bool: all four around it, if it is interpolated."""
        table = self._table_of[camera]
        valid, offset = self._valid[table], _offset(camera, table)
        if valid is None:
            return np.ones(camera.width * camera.height, dtype=bool)
        if offset is None:
            return valid.ravel()
        x, y = int(offset[0]), int(offset[1])
        part = valid[y : y + camera.height + 1, x : x + camera.width + 1]
        return (part[:-1, :-1] & part[:-1, 1:] & part[1:, :-1] & part[1:, 1:]).ravel()


def _tables(cameras: list[Camera]) -> dict[Camera, Camera]:
    """Return the camera whose pixels are the table of each camera of a lens: a larger one for all, or its own."""
    points = np.array([camera.principal_point for camera in cameras])
    most = points.max(axis=0)
    wider, higher = np.ceil(most - points.min(axis=0)).astype(int).tolist()
    camera = cameras[0]
    shared = replace(
        camera.with_principal_point(*most.tolist()), width=camera.width + wider + 1, height=camera.height + higher + 1
    )
    if shared.width * shared.height >= len(cameras) * camera.width * camera.height:
        return {camera: camera for camera in cameras}
    return dict.fromkeys(cameras, shared)


def _offset(camera: Camera, table: Camera) -> tuple[float, float] | None:
    """Return where the first pixel of a camera is in its table; None if the table is the camera's own."""
    if camera == table:
        return None
    (x, y), (table_x, table_y) = camera.principal_point, table.principal_point
    return table_x - x, table_y - y


def _fill(table: Camera, values: np.ndarray, storage: PhotoStorage) -> np.ndarray | None:
    """Fill in a table's bearings block by block, and return which pixels have one, (height, width) bool; None if all.

    Most lenses have a bearing everywhere: then nothing more is kept in memory.
    """
    valid = np.empty(len(values), dtype=bool)
    block = 2**18  # in float64, the bearings of a whole large photo would take more memory than the photo
    for begin in range(0, len(values), block):
        part = slice(begin, min(begin + block, len(values)))
        numbers = np.arange(part.start, part.stop)
        centres = np.stack([numbers % table.width, numbers // table.width], axis=-1) + 0.5
        values[part], valid[part] = table.bearings(centres)
        storage.release_pages()
    return None if valid.all() else valid.reshape(table.height, table.width)
