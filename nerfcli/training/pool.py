"""Training photos in memory, and random pixels of them with their rays, by tables of bearings."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, replace
from functools import reduce
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.camera import Camera, by_lens
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.errors import UserError
from nerfcli.kernels import BearingGrids, PixelTable, backend_for
from nerfcli.photos.loading import LoadedPhoto, downscaled_camera, is_transparent, load_photo
from nerfcli.training.storage import IN_MEMORY, PhotoStorage


class BearingTables:
    """The bearings of the pixels of P photos.

    `values` (B, 3) are those of all tables, `first` (P,) the index of each photo's first bearing. `grids` tells how to
    interpolate them, see `BearingGrids`; None if each photo has the principal point of its table.

    Accuracy: an interpolated bearing is off by a fraction of 1 / (8 f) of a pixel, f the focal length in pixels.
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


@dataclass(frozen=True)
class Album:
    """Photos in one contiguous array.

    Args:
        photos: their pixels are views of `colours`; if any photo has alpha, those without are opaque.
        colours: (pixels of all photos, 3 or 4) uint8; 4 if any photo is transparent somewhere.
        fills_frame: True if any photo has no alpha of its own, or if alpha is opaque in all photos.
    """

    photos: tuple[LoadedPhoto, ...]
    colours: np.ndarray
    fills_frame: bool


def load_album(
    frames: Sequence[Frame], *, factor: int, threads: int, storage: PhotoStorage, masks: str = "ignore"
) -> Album:
    """Load photos with `load_photo` into one array in `storage`.

    Raises:
        UserError: a photo cannot be read, or has another size than its camera.
    """
    cameras = [downscaled_camera(frame.camera, factor) for frame in frames]
    begins = np.cumsum([0, *(camera.width * camera.height for camera in cameras)])
    # Alpha is known only after decoding: start with three channels, and restart with four if a photo is transparent.
    for channels in (3, 4):
        colours = storage.array((int(begins[-1]), channels), np.uint8)
        fills: list[bool] = []

        def place(index: int, colours: np.ndarray = colours) -> tuple[LoadedPhoto, bool] | None:
            photo = load_photo(frames[index], factor, masks)
            kept = colours.shape[-1]
            if kept == 3 and is_transparent(photo.pixels):
                return None
            has_alpha = photo.pixels.shape[-1] == kept == 4
            part = colours[begins[index] : begins[index + 1]].reshape(*photo.pixels.shape[:2], -1)
            part[..., 3:] = 255  # of a photo without alpha beside one that has it
            part[..., : photo.pixels.shape[-1]] = photo.pixels[..., :kept]
            storage.release_pages()
            return replace(photo, pixels=part), not has_alpha

        photos: list[LoadedPhoto] = []
        with ThreadPoolExecutor(max(1, threads)) as pool:
            for placed in pool.map(place, range(len(frames))):
                if placed is None:
                    pool.shutdown(cancel_futures=True)
                    break
                photos.append(placed[0])
                fills.append(placed[1])
        if len(photos) == len(frames):
            return Album(tuple(photos), colours, any(fills))
        del colours, photos, place  # the next array takes their room
    raise AssertionError("four channels hold every photo")


class PixelBatch(NamedTuple):
    """Random pixels with their rays.

    Args:
        origins, directions: (N, 3) in the training frame; directions are unit vectors.
        colours: (N, 3 or 4) float32 in [0, 1].
        numbers: (N,) int64 indices of the pixels, counted through all photos.
        distances, trust: (K,) of the last K pixels, whose surface depth is known; see `PointDepths`.
    """

    origins: Tensor
    directions: Tensor
    colours: Tensor
    numbers: Tensor
    distances: Tensor
    trust: Tensor


# One pixel at a known distance is drawn per this many other pixels.
PIXELS_PER_POINT = 8


def pixel_footprint(frames: Sequence[Frame], training_from_scene: Similarity) -> float:
    """Return the median over photos of a pixel's footprint at the centre of the training frame, in its units.

    The footprint is distance / focal length. The distance is at least 1, since cameras inside the unit ball look at
    things about one radius away.
    """
    footprints = []
    for frame in frames:
        position = training_from_scene.apply_pose(frame.world_from_cam)[:3, 3]
        footprints.append(max(float(np.linalg.norm(position)), 1.0) / frame.camera.focal_px)
    return float(np.median(footprints))


class PixelPool:
    """All usable pixels of an album, and their rays in the training frame.

    Photos of one lens share its bearings, see `BearingTables`. `frames` are those of the photos, in the scene's frame;
    `without_ray` is the number of pixels without a direction in the lens model, which are left out; `footprint` is from
    `pixel_footprint`; `cones` (P,) are the widths of a pixel of each photo at distance 1; `sizes` (P, 2) are the
    heights and widths of the photos.
    """

    def __init__(
        self,
        album: Album,
        training_from_scene: Similarity,
        device: torch.device,
        *,
        storage: PhotoStorage = IN_MEMORY,
    ):
        photos = album.photos
        self.colours = torch.from_numpy(album.colours).to(device)
        self._backend = backend_for(device, torch.float32)
        self.training_from_scene = training_from_scene
        counts = [photo.pixels.shape[0] * photo.pixels.shape[1] for photo in photos]
        self.first_pixel = torch.tensor(np.cumsum([0, *counts[:-1]]), device=device)
        self.sizes = torch.tensor([photo.pixels.shape[:2] for photo in photos], device=device)
        self.frames = tuple(photo.frame for photo in photos)
        self.cameras = tuple(photo.frame.camera for photo in photos)
        poses = [training_from_scene.apply_pose(photo.frame.world_from_cam) for photo in photos]
        self.poses = torch.tensor(np.array(poses), dtype=torch.float32, device=device)

        widths = [1.0 / photo.frame.camera.focal_px for photo in photos]
        self.cones = torch.tensor(widths, dtype=torch.float32, device=device)
        self.footprint = pixel_footprint([photo.frame for photo in photos], training_from_scene)

        self._bearings = BearingTables(self.cameras, device, storage=storage)
        self.without_ray = sum(int((~self._bearings.valid(camera)).sum()) for camera in self.cameras)

        def usable(index: int) -> np.ndarray:
            photo = photos[index]
            good = self._bearings.valid(photo.frame.camera)
            return good if photo.used is None else good & photo.used.ravel()

        self._use(usable, storage)

    def without(self, masks: Sequence[np.ndarray], *, storage: PhotoStorage = IN_MEMORY) -> "PixelPool":
        """Return a pool that does not draw the pixels of masks (H, W) bool, one per photo; all else is shared.

        Raises:
            UserError: no pixel would be left.
        """
        earlier = None if self.usable is None else self.usable.cpu().numpy()
        firsts = self.first_pixel.tolist()

        def usable(index: int) -> np.ndarray:
            kept = ~masks[index].ravel()
            if earlier is None:
                return kept
            begin, end = np.searchsorted(earlier, (firsts[index], firsts[index] + len(kept)))
            before = np.zeros_like(kept)
            before[earlier[begin:end] - firsts[index]] = True
            return kept & before

        other = copy(self)
        other._use(usable, storage)
        return other

    def _use(self, usable: Callable[[int], np.ndarray], storage: PhotoStorage) -> None:
        """List the usable pixels; `usable` gives those of a photo by its index, (pixels of the photo,) bool."""
        counts = [int(usable(index).sum()) for index in range(len(self.frames))]
        self.usable_count = sum(counts)
        if self.usable_count == 0:
            raise UserError(
                "no pixels are left to train on", "check the masks: white pixels are used, black ones are ignored"
            )
        self.usable: Tensor | None = None
        if self.usable_count < len(self.colours):  # a list of all pixels would be larger than the photos
            numbers = storage.array((self.usable_count,), np.int64)
            for index, (first, count, end) in enumerate(
                zip(self.first_pixel.tolist(), counts, np.cumsum(counts), strict=True)
            ):
                numbers[end - count : end] = first + np.flatnonzero(usable(index))
                storage.release_pages()
            self.usable = torch.from_numpy(numbers).to(self.colours.device)

    @property
    def has_alpha(self) -> bool:
        return self.colours.shape[-1] == 4

    def draw(self, count: int, generator: torch.Generator) -> PixelBatch:
        """Draw `count` random pixels, with replacement."""
        return self.rays_of(self.numbers(count, generator))

    def numbers(self, count: int, generator: torch.Generator) -> Tensor:
        """Return the indices of `count` random pixels, with replacement."""
        chosen = torch.randint(self.usable_count, (count,), generator=generator, device=self.colours.device)
        return chosen if self.usable is None else self.usable[chosen]

    def is_usable(self, numbers: Tensor) -> Tensor:
        """Return whether pixels (N,), counted through all photos, may be used for training; (N,) bool."""
        if self.usable is None:
            return torch.ones_like(numbers, dtype=torch.bool)
        places = torch.searchsorted(self.usable, numbers).clamp_max(self.usable_count - 1)
        return self.usable[places] == numbers

    def rays_of(self, numbers: Tensor) -> PixelBatch:
        """Return the rays and colours of pixels (N,), counted through all photos."""
        bearings = self._bearings
        pixels = PixelTable(self.first_pixel, bearings.first, bearings.values, self.poses, self.colours, bearings.grids)
        origins, directions, colours = self._backend.pixel_rays(numbers, pixels)
        none = torch.zeros(0, device=numbers.device)
        return PixelBatch(origins, directions, colours, numbers, distances=none, trust=none)

    def photo_of(self, numbers: Tensor) -> Tensor:
        """Return the photo index of each pixel (N,)."""
        return torch.searchsorted(self.first_pixel, numbers, right=True) - 1

    def place(self, number: int) -> tuple[str, int, int]:
        """Return the photo's name, the column and the row of the pixel with an index."""
        photo = int(self.photo_of(torch.tensor(number, device=self.first_pixel.device)))
        row, column = divmod(number - int(self.first_pixel[photo]), self.cameras[photo].width)
        return self.frames[photo].name, column, row


@dataclass(frozen=True)
class PointDepths:
    """Pixels at known distances: M of them.

    Args:
        numbers: (M,) int64, pixels of the pool.
        distances: (M,) along their rays, training frame.
        trust: (M,) in (0, 1].
    """

    numbers: Tensor
    distances: Tensor
    trust: Tensor

    def among(self, pool: PixelPool) -> "PointDepths":
        """Select the pixels that are usable in a pool."""
        return self._chosen(pool.is_usable(self.numbers))

    def joined(self, other: "PointDepths") -> "PointDepths":
        """Return the pixels of both."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return PointDepths(*(torch.cat(pair) for pair in pairs))

    def draw(self, count: int, generator: torch.Generator) -> "PointDepths":
        """Draw `count` of these pixels at random, with replacement."""
        device = self.numbers.device
        return self._chosen(torch.randint(len(self.numbers), (count,), generator=generator, device=device))

    def _chosen(self, which: Tensor) -> "PointDepths":
        return PointDepths(self.numbers[which], self.distances[which], self.trust[which])


class PointRays:
    """Pixels at known distances that are added to each step: as many from each set, whatever its size."""

    def __init__(self, sets: Sequence[PointDepths], pool: PixelPool):
        self.sets = [depths for depths in sets if len(depths.numbers)]
        self._pool = pool

    def added_to(self, drawn: PixelBatch, generator: torch.Generator) -> PixelBatch:
        """Append pixels at known distances to those in `drawn`. Their colours count like all others."""
        count = max(1, len(drawn.numbers) // PIXELS_PER_POINT // len(self.sets))
        chosen = reduce(PointDepths.joined, [depths.draw(count, generator) for depths in self.sets])
        both = self._pool.rays_of(torch.cat([drawn.numbers, chosen.numbers]))
        return both._replace(distances=chosen.distances, trust=chosen.trust)
