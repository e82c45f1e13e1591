"""Render pictures for a page: coarse first, then finer, in tiles from the middle out, until the view changes.

One thread renders for all clients, one tile each in turn, so a tile waits for at most one tile of each other client.
"""

import math
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from queue import SimpleQueue
from statistics import median
from typing import Any

import numpy as np
import torch

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.field.background import colours_behind
from nerfcli.machine import use_threads
from nerfcli.render.depth import MEDIAN
from nerfcli.render.model import Model
from nerfcli.render.tracing import pixel_rays, render_rays

# Target times of a tile, and of the first picture of a view, which is as coarse as needed to be done in that time.
TILE_SECONDS = 0.02
COARSE_SECONDS = 0.03
COARSEST, SMALLEST_SIDE = 16, 32
# Fixed cost of a tile, in rays; without it, small tiles would seem slow and be made even smaller.
_TILE_RAYS = 400
# Ratio of strides from one picture to the next finer one.
FINER = 4
# Seconds per ray before any measurement, and number of recent tiles whose median is used, as some have to wait.
_FIRST_RATE, _RATES = 1e-5, 9
LARGEST_PX = 8192
# Values per pixel: rgb, opacity; mean, spread, median, heaviest; quantiles 5 %, 95 %, the requested one; unused.
NUMBERS = 12
_HEAD = struct.Struct("<8I")


@dataclass(frozen=True)
class View:
    """View that a page requests.

    Args:
        quantile: fraction of the light for the requested quantile depth, in (0, 1).
    """

    frame: Frame
    quantile: float

    def coarse(self, stride: int) -> Frame:
        """Return the frame with one pixel per stride x stride pixels, with a ray through the middle of each block."""
        camera = self.frame.camera
        width, height = (-(-size // stride) for size in (camera.width, camera.height))
        lens = tuple(value / stride for value in camera.params)
        return Frame(self.frame.name, Camera("PINHOLE", width, height, lens), self.frame.world_from_cam)


@dataclass(frozen=True)
class Tile:
    """A rectangle of a picture that has one pixel per stride x stride pixels of the view."""

    stride: int
    x: int
    y: int
    width: int
    height: int


def view_from_json(content: Any) -> View:
    """Return the view that a page describes.

    Raises:
        ValueError: something is missing, not a number, or out of range.
    """
    try:
        width, height = int(content["width"]), int(content["height"])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = np.array(content["turn"], float), np.array(content["place"], float)
        lens = tuple(float(value) for value in content["lens"])
        quantile = float(content["share"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"not a view: {error!r}") from error
    sizes = 1 <= width <= LARGEST_PX and 1 <= height <= LARGEST_PX
    if not sizes or len(lens) != 4 or min(lens[:2]) <= 0 or not np.isfinite([*pose.ravel(), *lens]).all():
        raise ValueError("a view has numbers out of range")
    if not 0.0 < quantile < 1.0 or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-3):
        raise ValueError("a view has numbers out of range")
    return View(Frame("view", Camera("PINHOLE", width, height, lens), pose), quantile)


@torch.no_grad()
def render_tile(model: Model, view: View, tile: Tile) -> np.ndarray:
    """Render the rays of a tile: (height, width, NUMBERS) float32.

    Colours and opacities are those of `render_picture`; distances are along the ray in the training frame, -1 where
    undefined.
    """
    frame = view.coarse(tile.stride)
    rows, columns = np.arange(tile.y, tile.y + tile.height), np.arange(tile.x, tile.x + tile.width)
    pixels = (rows[:, None] * frame.camera.width + columns).ravel()
    rays = pixel_rays(frame, model.training_from_scene, pixels=pixels, device=model.device)
    seen = render_rays(
        model,
        rays.origin.expand_as(rays.directions),
        rays.directions,
        background=colours_behind(model.background, rays.directions),
        fractions=(MEDIAN, 0.05, 0.95, view.quantile),
        cones=rays.cones,
        keep_intervals=False,
    )
    ends = seen.ends
    quantiles = ends.quantiles
    values = torch.cat(
        [
            *(seen.rgb.clamp(0.0, 1.0), ends.opacity[:, None], ends.mean[:, None], ends.spread[:, None]),
            *(quantiles[:, :1], ends.peak[:, None], quantiles[:, 1:], torch.zeros_like(ends.mean)[:, None]),
        ],
        dim=1,
    )
    return values.nan_to_num(nan=-1.0).cpu().numpy().reshape(tile.height, tile.width, NUMBERS)


def strides_of(width: int, height: int, seconds_per_ray: float) -> list[int]:
    """Return the strides of a view's pictures, coarse to fine; the first is quick enough while the camera moves."""
    stride = 1
    while stride < COARSEST and width * height / stride**2 * seconds_per_ray > COARSE_SECONDS:
        stride *= 2
    strides = [stride]
    while strides[-1] > 1:
        strides.append(max(1, strides[-1] // FINER))
    return strides


def tiles_of(view: View, stride: int, seconds_per_ray: float) -> list[Tile]:
    """Return the tiles of a picture, from its middle out; a single one if the whole picture is quick."""
    small = view.coarse(stride).camera
    width, height = small.width, small.height
    camera = view.frame.camera
    if camera.width * camera.height / stride**2 * seconds_per_ray <= COARSE_SECONDS or stride == COARSEST:
        return [Tile(stride, 0, 0, width, height)]
    side = max(SMALLEST_SIDE, math.isqrt(max(0, int(TILE_SECONDS / seconds_per_ray) - _TILE_RAYS)))
    tiles = [
        Tile(stride, x, y, min(side, width - x), min(side, height - y))
        for y in range(0, height, side)
        for x in range(0, width, side)
    ]
    return sorted(tiles, key=lambda t: math.hypot(t.x + (t.width - width) / 2, t.y + (t.height - height) / 2))


class Painter:
    """Renders views for clients; a new view of a client replaces its previous one after the current tile."""

    def __init__(self, model: Callable[[], tuple[int, Model]], *, threads: int):
        self._model = model
        self._rates = deque([_FIRST_RATE], maxlen=_RATES)
        # The tiles to come of each client's newest view, as records.
        self._newest: dict[str, Iterator[bytes]] = {}
        self._lock = threading.Lock()
        self._waiting: SimpleQueue[Callable[[], None]] = SimpleQueue()
        # Python waits for the threads of an executor when it ends, and not for this one.
        threading.Thread(target=self._work, args=(threads,), daemon=True).start()

    def paint(self, client: str, view: View) -> Iterator[bytes]:
        """Yield the finished tiles of a view: a header of 8 numbers, then three planes of four values per pixel.

        The header is stride, x, y, width, height, width and height of the picture, version of the model.
        """
        tiles, finished = self._tiles(view), SimpleQueue[bytes | Exception | None]()

        def render_one() -> None:
            """Render the next tile, and queue up for the one after it behind those of other clients."""
            try:
                record = next(tiles, None) if self._newest.get(client) is tiles else None
            except Exception as error:  # raised again in the thread of the client
                record = error
            finished.put(record)
            if isinstance(record, bytes):
                self._waiting.put(render_one)

        with self._lock:
            self._newest[client] = tiles
        self._waiting.put(render_one)
        try:
            while (record := finished.get()) is not None:
                if isinstance(record, Exception):
                    raise record
                yield record
        finally:
            with self._lock:
                if self._newest.get(client) is tiles:
                    del self._newest[client]

    def _work(self, threads: int) -> None:
        use_threads(threads)  # OpenMP keeps a thread count for each calling thread
        while True:
            self._waiting.get()()

    def _tiles(self, view: View) -> Iterator[bytes]:
        """Render the tiles of a view, coarse pictures first."""
        number, model = self._model()
        camera = view.frame.camera
        for stride in strides_of(camera.width, camera.height, median(self._rates)):
            small = view.coarse(stride).camera
            for tile in tiles_of(view, stride, median(self._rates)):
                began = time.perf_counter()
                seen = render_tile(model, view, tile)
                self._rates.append((time.perf_counter() - began) / (tile.width * tile.height + _TILE_RAYS))
                head = (tile.stride, tile.x, tile.y, tile.width, tile.height, small.width, small.height, number)
                planes = np.moveaxis(seen.reshape(tile.height, tile.width, 3, 4), 2, 0)
                yield _HEAD.pack(*head) + np.ascontiguousarray(planes, "<f4").tobytes()
