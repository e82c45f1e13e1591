"""Blocks of a large scene: cells of the ground, the photos that see each cell, and joining the fields into one.

The blocks of a run are in RUN/blocks/1, 2, ..., each a complete run; RUN itself has the joined field. The division
depends on the scene alone, so that blocks can be trained by independent processes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.formats.colmap import parse_colmap
from nerfcli.cameras.layout import horizontal_axes, up_direction
from nerfcli.cameras.rigid import Similarity
from nerfcli.errors import UserError
from nerfcli.field.blocks_field import Block, BlocksField, BlocksFieldSettings
from nerfcli.render.model import Marching, Model
from nerfcli.runs.files import BLOCKS
from nerfcli.scene import Scene, model_folder

# Margin of a cell, as a fraction of the extent of its points.
MARGIN = 0.15
# A photo belongs to a block if at least this fraction of the points that it sees is in the block's cell or margin.
LEAST_FRACTION = 0.05
# Fewest points and photos of a block.
LEAST_POINTS, LEAST_PHOTOS = 50, 2
# Percentiles of points between which cells are measured: at the edge of the scene, some are far away or wrong.
PERCENTILES = (5, 95)
# Largest number of cells along a side of the occupancy grid of a joined field: 16 MB in all.
MOST_CELLS = 256


@dataclass(frozen=True)
class Cell:
    """A rectangle of ground, including `low` and excluding `high`, both (2,) and infinite at the edge of the scene."""

    low: tuple[float, ...] = (-math.inf, -math.inf)
    high: tuple[float, ...] = (math.inf, math.inf)

    def contains(self, places: np.ndarray, margins: np.ndarray | float = 0.0) -> np.ndarray:
        """Return whether ground coordinates (N, 2) are in the cell, widened by margins (2,)."""
        low, high = np.array(self.low) - margins, np.array(self.high) + margins
        return np.all((places >= low) & (places < high), axis=1)


@dataclass(frozen=True)
class BlockDivision:
    """A scene divided into blocks.

    Args:
        ground: (2, 3) horizontal unit directions.
        cells: cells of the blocks; each place is in exactly one.
        scenes: scenes of the blocks, with the photos that see the cell or its margin, and the points in the cell.
    """

    ground: np.ndarray
    cells: tuple[Cell, ...]
    scenes: tuple[Scene, ...]


def block_path(run: Path, number: int) -> Path:
    """Return the folder of a block, counted from 1."""
    return run / BLOCKS / str(number)


def divide(scene: Scene, count: int) -> BlockDivision:
    """Divide a scene into blocks with about equally many points.

    Raises:
        UserError: it is not known which photos see which points, or there are too few points or photos.
    """
    folder = model_folder(scene.root)
    capture = parse_colmap(folder) if folder is not None else None
    seen = capture.observations if capture is not None else None
    if capture is None or seen is None or not (seen.point_index >= 0).any():
        raise UserError(
            f"{scene.root} has no points with the photos that see them, which --blocks needs",
            "use a scene written by nerfcli poses or a COLMAP model, or train without --blocks",
        )
    fewer = "use fewer blocks, or train without --blocks"
    if len(scene.train_frames) < count:
        raise UserError(f"{scene.root} has {len(scene.train_frames)} training photos, fewer than {count} blocks", fewer)
    ground = np.stack(horizontal_axes(up_direction(scene.frames)))
    places = capture.points @ ground.T
    if len(places) < LEAST_POINTS * count:
        raise UserError(f"{scene.root} has {len(places)} points, fewer than {LEAST_POINTS} for each block", fewer)
    cells = tuple(_cells(Cell(), places, count))
    of_point = seen.point_index >= 0
    photos, points = seen.frame_index[of_point], seen.point_index[of_point]
    total = np.bincount(photos, minlength=len(capture.frames))
    names = np.array([frame.name for frame in capture.frames])
    scenes = []
    for number, cell in enumerate(cells, start=1):
        own = cell.contains(places)
        margins = MARGIN * np.ptp(np.percentile(places[own], PERCENTILES, axis=0), axis=0)
        near = cell.contains(places, margins)
        fraction = np.bincount(photos, near[points], minlength=len(names)) / np.maximum(total, 1)
        of_block = _with_photos(scene, set(names[fraction >= LEAST_FRACTION].tolist()))
        if len(of_block.train_frames) < LEAST_PHOTOS:
            only = len(of_block.train_frames)
            raise UserError(f"block {number} of {count} is seen by {only} training photos of {scene.root}", fewer)
        scenes.append(replace(of_block, points=capture.points[own]))
    return BlockDivision(ground, cells, tuple(scenes))


def joined(models: Sequence[Model], division: BlockDivision) -> Model:
    """Join the models of all blocks into one.

    Its unit ball contains those of the blocks, its steps along rays are the shortest of the blocks, and its background
    is that of the first block. If all blocks have the same field, the joined model renders the same as that field.
    """
    centres = np.array([-model.training_from_scene.translation / model.training_from_scene.scale for model in models])
    radii = np.array([1.0 / model.training_from_scene.scale for model in models])
    low, high = (centres - radii[:, None]).min(axis=0), (centres + radii[:, None]).max(axis=0)
    centre = (low + high) / 2
    radius = float((np.linalg.norm(centres - centre, axis=1) + radii).max())
    ground_centre = division.ground @ centre
    settings = BlocksFieldSettings(
        contraction="l2",
        view_degree=max(model.field.settings.view_degree for model in models),
        ground=tuple(map(tuple, division.ground.tolist())),
        occupancy_side=len(models[0].occupied),
        blocks=tuple(
            Block(
                field=model.field.settings,
                centre=tuple(((own - centre) / radius).tolist()),
                radius=own_radius / radius,
                low=tuple(((cell.low - ground_centre) / radius).tolist()),
                high=tuple(((cell.high - ground_centre) / radius).tolist()),
            )
            for model, own, own_radius, cell in zip(models, centres, radii.tolist(), division.cells, strict=True)
        ),
    )
    field = BlocksField(settings, [model.field for model in models], torch.stack([model.occupied for model in models]))
    relative = (radii / radius).tolist()
    spans = [(model.marching, fraction) for model, fraction in zip(models, relative, strict=True)]
    return replace(
        models[0],
        field=field,
        occupied=_occupied(field, cells=math.ceil(settings.occupancy_side / min(relative))),
        marching=Marching(
            near=min(marching.near * fraction for marching, fraction in spans),
            far=max(marching.far * fraction for marching, fraction in spans),
            shortest_step=min(marching.shortest_step * fraction for marching, fraction in spans),
            growth=min(marching.growth for marching, _ in spans),
        ),
        training_from_scene=Similarity(1.0 / radius, np.eye(3), -centre / radius),
        sha256=None,
    )


def _cells(cell: Cell, places: np.ndarray, count: int) -> list[Cell]:
    """Divide a cell into `count` cells with equal numbers of its places (N, 2), each time across the longer side."""
    if count == 1:
        return [cell]
    first = count // 2
    axis = int(np.argmax(np.ptp(np.percentile(places, PERCENTILES, axis=0), axis=0)))
    border = float(np.quantile(places[:, axis], first / count))
    low, high = list(cell.low), list(cell.high)
    low[axis] = high[axis] = border
    below = places[:, axis] < border
    return [
        *_cells(replace(cell, high=tuple(high)), places[below], first),
        *_cells(replace(cell, low=tuple(low)), places[~below], count - first),
    ]


def _with_photos(scene: Scene, names: set[str]) -> Scene:
    """Return the scene with only the photos of these names."""
    kept = [index for index, frame in enumerate(scene.frames) if frame.name in names]
    return replace(
        scene,
        frames=tuple(scene.frames[index] for index in kept),
        test_names=scene.test_names & names,
        depth_bounds=None if scene.depth_bounds is None else scene.depth_bounds[kept],
    )


def _occupied(field: BlocksField, *, cells: int) -> Tensor:
    """Return the cells (G, G, G) of a joined field's cube that are occupied or next to an occupied one, bool.

    Args:
        cells: number of cells along a side, with cells no larger than those of a block's occupancy; the result has
            fewer if this is more than `MOST_CELLS`.
    """
    merged = math.ceil(cells / MOST_CELLS)
    side = math.ceil(cells / merged)
    along = torch.linspace(0.0, 1.0, side * merged + 1)
    y, x = torch.meshgrid(along, along, indexing="ij")
    layers = [
        field.is_occupied(torch.stack([x, y, torch.full_like(x, z)], dim=-1).reshape(-1, 3)).view(x.shape)
        for z in along.tolist()
    ]
    # A cell has `merged` + 1 vertices along each axis; one more on either side belongs to its neighbours.
    near = torch.stack(layers).float()
    for _ in range(3):  # one axis after the other
        near = torch.nn.functional.max_pool1d(near, merged + 3, stride=merged, padding=1).permute(2, 0, 1)
    return near > 0
