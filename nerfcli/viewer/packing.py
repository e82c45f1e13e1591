"""Pack the parameters of a field for the page: rows as 16-bit levels, weights as 4 x 4 blocks, cells as bits.

The quantization step is 2^-11, or the largest magnitude in the grid divided by 32,767 if that is more. Rows beyond the
vertices of a small grid are left out, and rows that no occupied cell reads are set to 0, which compresses to nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfcli.errors import UserError
from nerfcli.field.background import SphereBackground
from nerfcli.field.hash_field import GEOMETRY, HARMONICS, HashField
from nerfcli.field.voxel_field import VoxelField
from nerfcli.kernels import CONTRACTIONS, grid_coordinates
from nerfcli.kernels.reference.encoding import corner_rows
from nerfcli.render.coverage import DepthMap, coverage_and_parallax
from nerfcli.render.model import Model
from nerfcli.render.tracing import uniform_cuts

# Features per texel of the table, and neurons along a side of a block of the networks.
FOUR = 4
LEVELS = 32767
# This step changes colours by 5e-5 (rms) and keeps a page of 2^18 rows below 10 MB.
FINEST_LEVEL = 2.0**-11
# Occupied cells of hashed grids with more vertices than this are taken to reach every row.
MOST_VERTICES = 2**24
# Every WebGL2 device has room for this many in a uniform block: 16 KiB, 64 bytes each.
MOST_BLOCKS = 256


@dataclass(frozen=True)
class PackedField:
    """A field ready for the page.

    Args:
        field, march: plain values from which the shader is generated.
        arrays: by the name of the page element, little endian, as browsers read them.
    """

    field: dict[str, Any]
    march: dict[str, Any]
    arrays: dict[str, np.ndarray]


def pack_model(model: Model) -> PackedField:
    """Pack the field of a model with everything that rendering needs.

    Raises:
        UserError: the page cannot draw this kind or size of field.
    """
    resolutions, table, networks, more = _numbers(model)
    rows = table.shape[1]
    kept = [min(rows, (side + 1) ** 3) if side else 0 for side in resolutions]
    occupied = model.occupied.cpu()
    reached = {side: reached_rows(occupied, side, rows) for side in set(resolutions)}
    levels = [
        quantised((table[index] * reached[side][:, None])[:count].numpy())
        for index, (side, count) in enumerate(zip(resolutions, kept, strict=True))
    ]
    cuts = uniform_cuts(model.marching).to(torch.float32).numpy()
    behind = model.background
    sky = quantised(behind.logits.detach().cpu().numpy()) if isinstance(behind, SphereBackground) else None
    field = {
        **more,
        "contraction": CONTRACTIONS.index(model.contraction),
        "resolutions": list(resolutions),
        "firstRows": np.cumsum([0, *kept[:-1]]).tolist(),
        "scales": [scale for _, scale in levels],
        "rows": sum(kept),
        "rowMask": rows - 1,
        "largestDense": max((side for side in resolutions if (side + 1) ** 3 <= rows), default=0),
        "networks": len(networks),
        "background": [0.0, 0.0, 0.0] if isinstance(behind, SphereBackground) else list(behind),
        "sky": None if sky is None else {"side": sky[0].shape[-1], "scale": sky[1]},
    }
    march = {"intervals": len(cuts) - 1, "side": len(occupied), "far": model.marching.far}
    arrays = {
        "table": np.concatenate([values for values, _ in levels]),
        "networks": networks.astype("<f4"),
        "cuts": cuts.astype("<f4"),
        "occupied": np.packbits(occupied.numpy().ravel(), bitorder="little"),
        **({} if sky is None else {"sky": sky[0]}),
    }
    return PackedField(field, march, arrays)


def quantised(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Return 16-bit levels of values and the size of one level; the error is at most half a level."""
    scale = max(FINEST_LEVEL, float(np.abs(values).max(initial=0.0)) / LEVELS)
    return np.rint(values / scale).astype("<i2"), scale


def reached_rows(occupied: Tensor, side: int, rows: int) -> Tensor:
    """Mark the rows of a table that interpolation in occupied cells reads.

    Args:
        occupied: (G, G, G) bool, indexed [z, y, x].
        side: cells per axis of the grid in the table; 0 for none.
        rows: number of rows of the table.

    Returns:
        (rows,) bool; all true for grids of more than 2^24 vertices.
    """
    if (side + 1) ** 3 > MOST_VERTICES:
        return torch.ones(rows, dtype=torch.bool)
    cell, vertex = torch.arange(len(occupied)), torch.arange(side + 1)[:, None]
    first, last = cell * side // len(occupied), (cell + 1) * side // len(occupied) + 1
    touches = ((first <= vertex) & (vertex <= last)).float()
    vertices = occupied.float()
    for _ in range(3):
        # Works along the slowest axis and moves it to the end; after three rounds the axes are in their original order.
        vertices = torch.tensordot(touches, vertices, 1).clamp_max(1.0).movedim(0, -1)
    reached = torch.zeros(rows, dtype=torch.bool)
    reached[corner_rows(vertices.nonzero().flip(-1), side, rows)] = True
    return reached


def _numbers(model: Model) -> tuple[tuple[int, ...], Tensor, np.ndarray, dict[str, Any]]:
    """Return cells per axis of each grid, the table, the blocks of the networks, and constants of the shader."""
    field = model.field
    if isinstance(field, HashField):
        settings = field.settings
        if settings.features != FOUR or settings.width % FOUR:
            sizes = f"{settings.features} features a row and {settings.width} neurons"
            raise _too_large(f"it has {sizes}, expected {FOUR} and a multiple of it")
        layers = [layer.detach().cpu().numpy().astype(np.float32) for layer in field.weights]
        # Harmonics above the view degree do not affect colours.
        layers[2] = layers[2].copy()
        layers[2][:, GEOMETRY + (settings.view_degree + 1) ** 2 :] = 0.0
        layers[4] = np.pad(layers[4], ((0, FOUR - len(layers[4])), (0, 0)))
        networks = np.concatenate([blocks_of(layer) for layer in layers])
        if len(networks) > MOST_BLOCKS:
            raise _too_large(f"its networks have {64 * len(networks)} bytes, expected {64 * MOST_BLOCKS} at most")
        more = {"kind": "hash", "width": settings.width, "antialias": settings.antialias, "harmonics": HARMONICS}
        return settings.resolutions, field.table.detach().cpu(), networks, more
    if isinstance(field, VoxelField):
        sizes = field.settings
        more = {"kind": "voxels", "width": 0, "antialias": False, "harmonics": sizes.harmonics}
        networks = np.zeros((0, FOUR, FOUR), np.float32)
        return (sizes.resolution,) * sizes.layers, field.table.detach().cpu(), networks, more
    raise UserError(
        f"the page cannot render a field of type {field.settings.kind}: its network is too large for a shader",
        "train with --field hash or --field voxels, or render pictures and videos: nerfcli render RUN",
    )


def blocks_of(layer: np.ndarray) -> np.ndarray:
    """Split a layer (outputs, inputs) into (blocks, 4, 4), indexed [input, output]; groups of outputs vary slowest."""
    outputs, inputs = (size // FOUR for size in layer.shape)
    return layer.reshape(outputs, FOUR, inputs, FOUR).transpose(0, 2, 3, 1).reshape(-1, FOUR, FOUR)


def _too_large(what: str) -> UserError:
    return UserError(
        f"the page cannot render this field: {what}", "train a field of the default size: nerfcli train SCENE"
    )


# Candidate numbers of cells along each axis of the unit cube: the first with at least this many pixels per occupied
# cell is used. Large cells mix seen and unseen places; small ones may fall between the pixels of all depth maps.
SIDES, _LEAST_PIXELS = (192, 128, 96, 64, 48, 32), 10
_MOST_PIXELS = 4_000_000
_MOST_PHOTOS = 255


def seen_cells(model: Model, photos: Sequence[DepthMap]) -> np.ndarray:
    """Return coverage and parallax of the surface in the cells of the unit cube, measured at one point per cell.

    Returns:
        uint16 (side, side, side), indexed [z, y, x], side from `SIDES`: coverage, at most 255, + 256 times the
        parallax in whole degrees; 0 where no photo sees a surface.
    """
    step = 1 + sum(int(np.isfinite(view.distances).sum()) for view in photos) // _MOST_PIXELS
    points = np.concatenate([view.points()[::step] for view in photos])
    in_training = torch.from_numpy(model.training_from_scene.apply(points))
    places = grid_coordinates(in_training, model.contraction).numpy()
    inside = ((places >= 0) & (places <= 1)).all(axis=1)
    points, places = points[inside], places[inside]
    side = next((side for side in SIDES if _pixels_per_cell(places, side) >= _LEAST_PIXELS), SIDES[-1])
    keys, first = np.unique(_cells_of(places, side), return_index=True)
    coverage, parallax = coverage_and_parallax(photos, points[first])
    cells = np.zeros(side**3, "<u2")
    cells[keys] = np.minimum(coverage, _MOST_PHOTOS) + 256 * np.rint(parallax)
    return cells.reshape(side, side, side)


def _cells_of(places: np.ndarray, side: int) -> np.ndarray:
    """Return the indices (N,) of the cells that contain points (N, 3) of the unit cube."""
    x, y, z = np.minimum((places * side).astype(np.int64), side - 1).T
    return (z * side + y) * side + x


def _pixels_per_cell(places: np.ndarray, side: int) -> float:
    return len(places) / max(1, len(np.unique(_cells_of(places, side))))
