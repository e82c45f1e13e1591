"""Storage of training photos: in memory or in memory-mapped files, chosen by their sizes.

Resident memory is what counts. Pages of mapped files are released when too much is resident, and read again from the
system's cache or the disk when they are needed; results are the same, bit for bit.
"""

import mmap
import os
import tempfile
import weakref
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from nerfcli.atomic import cannot_write
from nerfcli.cameras.frame import Frame
from nerfcli.errors import OUT_OF_MEMORY, UserError
from nerfcli.field.fourier_field import FourierFieldSettings
from nerfcli.field.hash_field import HashFieldSettings
from nerfcli.field.interface import FieldSettings
from nerfcli.field.kinds import chosen_size, parameter_bytes
from nerfcli.machine import resident_bytes
from nerfcli.matching.tracks import MOST_POINTS
from nerfcli.training.runs.settings import TrainSettings


@dataclass(frozen=True)
class MemoryNeeds:
    """Memory that a training run needs, in bytes.

    Args:
        photos: for the photos.
        step: for the field, its optimiser and a training step.
        rest: for everything except the photos, in the machine's main memory.
    """

    photos: int
    step: int
    rest: int


# Of a mask and the list of the pixels that it leaves, for each pixel of the photos.
MASK_BYTES = 9


def needs_of(frames: Sequence[Frame], factor: int, *, settings: TrainSettings) -> MemoryNeeds:
    """Estimate the memory of photos and field from their sizes; `rest` includes what is resident now."""
    sizes = [(frame.camera.width // factor) * (frame.camera.height // factor) for frame in frames]
    # Photos that differ in the principal point alone share bearings.
    of_cameras = {frame.camera.centred(): size for frame, size in zip(frames, sizes, strict=True)}
    may_have_alpha = any(
        frame.image is not None and frame.image.suffix.lower() not in (".jpg", ".jpeg") for frame in frames
    )
    photos = (4 if may_have_alpha else 3) * sum(sizes) + 12 * sum(of_cameras.values())
    selects, components = settings.model == "auto", settings.components
    # Occluders also have masks of the sky, and trials train on pixels that they are not scored on. What is attached to
    # a camera is counted where it is found.
    masks = any(frame.mask is not None for frame in frames) + settings.may_have_occluders + selects
    photos += (MASK_BYTES * masks + settings.may_have_occluders) * sum(sizes)
    largest = max(frame.camera.width * frame.camera.height for frame in frames)
    # The field, its gradient and two moments, and the sentinel's copy of all of these except the gradient.
    field = planned_field(settings)
    neurons = field.layers * field.width if isinstance(field, FourierFieldSettings) else 0
    step = 7 * parameter_bytes(field) + (6000 + 4 * 2 * neurons) * settings.samples[1]
    # Before there is a field, stereo matching has the directions from all photos to all points, float64 and float32.
    has_stereo = selects or components.stereo or components.occluders or components.exposure == "matched"
    stereo = 36 * len(frames) * MOST_POINTS if has_stereo else 0
    # To decode a photo: Pillow's picture, the array, and the intermediate results of downscaling.
    rest = 12 * largest * min(settings.threads, len(frames)) + max(step, stereo)
    return MemoryNeeds(photos, step, rest + resident_bytes())


def planned_field(settings: TrainSettings) -> FieldSettings:
    """Return the size of a training's field, the largest where it depends on the photos."""
    tables = HashFieldSettings("l2", log2_rows=settings.chosen_log2_rows)
    return chosen_size(settings.field, hash_grid=tables, footprint=1e-9, memory_bytes=settings.field_memory_bytes)


class InMemory:
    """Storage in ordinary arrays."""

    def array(self, shape: tuple[int, ...], dtype: np.dtype | type) -> np.ndarray:
        """Return an array to be filled."""
        return np.empty(shape, dtype)

    def release_pages(self) -> None:
        """Do nothing: ordinary arrays have no pages to release."""


class InFiles:
    """Storage in files without a name, which vanish with the process, however it ends.

    Args:
        limit: bytes that may be resident.
    """

    def __init__(self, folder: Path, limit: int):
        self._folder = folder
        self._limit = limit
        self._maps = weakref.WeakSet[mmap.mmap]()  # a file goes with its array

    def array(self, shape: tuple[int, ...], dtype: np.dtype | type) -> np.ndarray:
        """Return an array to be filled."""
        size = max(1, int(np.prod(shape)) * np.dtype(dtype).itemsize)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self._folder, prefix=".photos-") as file:
                # Reserved now: if the disk filled up later, writing a page would kill the process.
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(file.fileno(), 0, size)
                else:
                    file.truncate(size)
                pages = mmap.mmap(file.fileno(), size)
        except OSError as error:
            raise cannot_write(self._folder, error) from error
        self._maps.add(pages)
        return np.frombuffer(pages, dtype=dtype, count=int(np.prod(shape))).reshape(shape)

    def release_pages(self) -> None:
        """Release pages if too much memory is resident."""
        if resident_bytes() > self._limit:
            for pages in self._maps:
                with suppress(AttributeError, ValueError):  # not available on every system
                    pages.madvise(mmap.MADV_DONTNEED)


PhotoStorage = InMemory | InFiles
IN_MEMORY = InMemory()


def check_device_memory(needs: MemoryNeeds, device: torch.device, limit: int | None) -> str:
    """Limit the memory that torch uses on a CUDA device, and return a message for the user.

    Args:
        limit: bytes that it may use there; None for all free memory.

    Raises:
        UserError: photos and training do not fit into the limit or the free memory.
    """
    free, total = torch.cuda.mem_get_info(device)
    needed = needs.photos + needs.step
    if needed > min(free, limit or free):
        least = f"{_gigabytes(free)} are free" if limit is None or free < limit else f"the limit is {_gigabytes(limit)}"
        raise UserError(
            f"training needs about {_gigabytes(needed)} of memory on {device}, where {least}",
            "reduce the photos with --downscale 4, lower --log2-rows or --batch, or use --device cpu",
            OUT_OF_MEMORY,
        )
    if limit is not None:
        torch.cuda.set_per_process_memory_fraction(min(1.0, limit / total), device)
    return f"memory on {device}: about {_gigabytes(needed)} of {_gigabytes(free)} that are free"


def storage_for(needs: MemoryNeeds, limit: int | None, *, folder: Path) -> tuple[PhotoStorage, str]:
    """Choose the storage of the photos, and a message for the user.

    Args:
        limit: bytes that may be resident; None for no limit.

    Raises:
        UserError: the training does not fit, even with the photos on the disk.
    """
    total = needs.photos + needs.rest
    if limit is None or total <= limit:
        return IN_MEMORY, f"memory: about {_gigabytes(total)}, of which photos {_gigabytes(needs.photos)}"
    if needs.rest > limit:
        raise UserError(
            f"training needs about {_gigabytes(needs.rest)} of memory in addition to the photos, but the limit is "
            f"{_gigabytes(limit)}",
            "raise --memory, reduce the photos with --downscale 4, or use fewer --threads",
            OUT_OF_MEMORY,
        )
    text = (
        f"memory: about {_gigabytes(total)} needed, limit {_gigabytes(limit)}: the photos ({_gigabytes(needs.photos)}"
        f") are kept in temporary files in {folder}"
    )
    # Leave room for the pages that a step reads again: the system maps 16 of them around each pixel that is read.
    return InFiles(folder, limit - (limit - needs.rest) // 2), text


def _gigabytes(count: int) -> str:
    return f"{count / 1e9:.2f} GB"
