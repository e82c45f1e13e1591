"""Training photos in memory, and random pixels of them with their rays."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.errors import UserError
from nerfcli.kernels import PixelTable, backend_for
from nerfcli.photos.loading import LoadedPhoto, downscaled_camera, load_photo
from nerfcli.training.bearings import BearingTables
from nerfcli.training.storage import IN_MEMORY, PhotoStorage


@dataclass(frozen=True)
class Album:
    """Photos in one contiguous array.

    Args:
        photos: their pixels are views of `colours`; if any photo has alpha, those without are opaque.
        colours: (pixels of all photos, 3 or 4) uint8.
        fills_frame: True if any photo has no alpha of its own.
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
    # Alpha is known only after decoding: start with three channels, and restart with four if a photo has alpha.
    for channels in (3, 4):
        colours = storage.array((int(begins[-1]), channels), np.uint8)
        fills: list[bool] = []

        def place(index: int, colours: np.ndarray = colours) -> tuple[LoadedPhoto, bool] | None:
            photo = load_photo(frames[index], factor, masks)
            has_alpha = photo.pixels.shape[-1] == 4
            if has_alpha and colours.shape[-1] == 3:
                return None
            part = colours[begins[index] : begins[index + 1]].reshape(*photo.pixels.shape[:2], -1)
            part[...] = photo.pixels if has_alpha or colours.shape[-1] == 3 else _with_alpha(photo.pixels)
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
    raise AssertionError("four channels hold every photo")


class PixelBatch(NamedTuple):
    """Random pixels with their rays.

    Args:
        origins, directions: (N, 3) in the training frame; directions are unit vectors.
        colours: (N, 3 or 4) float32 in [0, 1].
        numbers: (N,) int64 indices of the pixels, counted through all photos.
        distances, trust: (K,) of the last K pixels, whose surface depth is known; see `point_depth.PointDepths`.
    """

    origins: Tensor
    directions: Tensor
    colours: Tensor
    numbers: Tensor
    distances: Tensor
    trust: Tensor


class Pool(Protocol):
    """Source of training pixels: photos with cameras and poses (P, 4, 4), in the training frame."""

    colours: Tensor
    first_pixel: Tensor
    footprint: float
    cones: Tensor
    poses: Tensor
    cameras: tuple[Camera, ...]

    @property
    def has_alpha(self) -> bool:
        """True if the colours have four channels."""
        ...

    def draw(self, count: int, generator: torch.Generator) -> PixelBatch:
        """Draw `count` random pixels, with replacement."""
        ...

    def photo_of(self, numbers: Tensor) -> Tensor:
        """Return the photo index of each pixel (N,)."""
        ...


def pixel_footprint(frames: Sequence[Frame], training_from_scene: Similarity) -> float:
    """Return the median over photos of a pixel's footprint at the centre of the training frame, in its units.

    The footprint is distance / focal length. The distance is at least 1, since cameras inside the unit ball look at
    things about one radius away.

    Args:
        frames: with the cameras of the downscaled training photos.
    """
    footprints = []
    for frame in frames:
        position = training_from_scene.apply_pose(frame.world_from_cam)[:3, 3]
        footprints.append(max(float(np.linalg.norm(position)), 1.0) / frame.camera.focal_px)
    return float(np.median(footprints))


class PixelPool:
    """All usable pixels of a set of photos, and their rays in the training frame.

    Photos of one lens share its bearings, see `BearingTables`. `frames` are those of the photos;
    `without_ray` is the number of pixels without a direction in the lens model, which are left out; `footprint` is from
    `pixel_footprint`; `cones` (P,) are the widths of a pixel of each photo at distance 1; `sizes` (P, 2) are the
    heights and widths of the photos.

    Args:
        photos: at least one.
        device: where the pixels are drawn.
        colours: of all photos in one array, if there is such an array already.
        storage: for arrays as large as the photos.
    """

    def __init__(
        self,
        photos: Sequence[LoadedPhoto],
        training_from_scene: Similarity,
        device: torch.device,
        *,
        colours: np.ndarray | None = None,
        storage: PhotoStorage = IN_MEMORY,
    ):
        self.colours = torch.from_numpy(_one_after_another(photos) if colours is None else colours).to(device)
        self._backend = backend_for(device, torch.float32)
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

    def leave_out(self, masks: Sequence[np.ndarray], *, storage: PhotoStorage = IN_MEMORY) -> None:
        """Do not draw the pixels of masks (H, W) bool, one per photo, from now on.

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

        self._use(usable, storage)

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


def _one_after_another(photos: Sequence[LoadedPhoto]) -> np.ndarray:
    any_alpha = any(photo.pixels.shape[-1] == 4 for photo in photos)
    pixels = [_with_alpha(photo.pixels) if any_alpha else photo.pixels for photo in photos]
    return np.concatenate([part.reshape(-1, part.shape[-1]) for part in pixels])


def _with_alpha(pixels: np.ndarray) -> np.ndarray:
    """Return the pixels as RGBA, opaque if the photo has no alpha."""
    if pixels.shape[-1] == 4:
        return pixels
    return np.concatenate([pixels, np.full_like(pixels[..., :1], 255)], axis=-1)
