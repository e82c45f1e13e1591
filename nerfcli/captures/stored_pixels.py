"""Pixels that cameras refer to for photos with an EXIF orientation (stored or upright), and conversion between them.

COLMAP, nerfstudio, instant-ngp and OpenSfM read pixels as they are stored. nerfcli shows photos upright, and the
cameras of its own scenes refer to upright photos.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame, Size
from nerfcli.captures.capture import Capture, Observations
from nerfcli.captures.orientation import (
    Measure,
    counted,
    fit_to_picture,
    rescaling,
    turn_back,
    turn_to_upright,
    turned,
    turned_pixels,
)
from nerfcli.errors import UserError
from nerfcli.photos.exif import read_exif
from nerfcli.photos.images import image_size

STORED, UPRIGHT = "stored", "upright"

# Most photos that are measured for a note: reading 10,000 headers takes longer than a conversion.
_MOST_MEASURED = 200


@dataclass(frozen=True)
class ReorientedCapture:
    """Capture whose cameras refer to the requested pixels.

    Args:
        num_turned: number of cameras that were turned according to their photos' EXIF orientation.
        num_unknown: number of photos that are not on disk, so that their orientation is unknown.
        masks_left_out: names of frames whose mask was dropped, as its orientation differs from the turned camera's.
    """

    capture: Capture
    num_turned: int = 0
    num_unknown: int = 0
    masks_left_out: tuple[str, ...] = ()


def measure(path: Path) -> tuple[int, int, int]:
    """Return the width and height of a photo shown upright, and its EXIF orientation."""
    exif = read_exif(path)
    return exif.width, exif.height, exif.orientation


def measure_of(capture: Capture) -> Measure:
    """Return the function that measures photos so that a capture's cameras can be fitted to the upright photos."""
    # Cameras of upright photos have orientation 1: nothing is left to turn.
    return (lambda path: (*image_size(path), 1)) if capture.pixels == UPRIGHT else measure


def in_pixels(capture: Capture, pixels: str) -> ReorientedCapture:
    """Return the capture with cameras, poses and observations for stored or upright pixels, at the cameras' own size.

    Frames without a photo on disk are left as they are, and reported.

    Raises:
        UserError: a photo cannot be read, is mirrored by its orientation, or has another shape than its camera.
    """
    if capture.pixels == pixels:
        return ReorientedCapture(capture)
    frames, masks_left_out, num_unknown = list(capture.frames), [], 0
    turns = np.ones(len(frames), dtype=np.int64)
    for index, frame in enumerate(capture.frames):
        if not frame.has_photo:
            num_unknown += 1
            continue
        orientation = _turn(frame, pixels)
        if orientation == 1:
            continue
        turns[index] = orientation
        camera, pose = turned(frame.camera, frame.world_from_cam, orientation=orientation)
        mask = frame.mask
        if mask is not None and not _fits(mask, camera, frame.camera, pixels):
            masks_left_out.append(frame.name)
            mask = None
        frames[index] = replace(frame, camera=camera, world_from_cam=pose, mask=mask)
    turned_capture = replace(
        capture, frames=tuple(frames), observations=_turned_observations(capture, turns), pixels=pixels
    )
    return ReorientedCapture(turned_capture, int((turns != 1).sum()), num_unknown, tuple(masks_left_out))


def upright(frame: Frame, measure: Measure) -> Frame:
    """Return a frame fitted to its upright photo on disk; its camera may be for another size or the stored pixels."""
    assert frame.image is not None
    camera, pose = fit_to_picture(frame.camera, frame.world_from_cam, path=frame.image, measure=measure)
    return replace(frame, camera=camera, world_from_cam=pose)


def other_sizes(capture: Capture) -> dict[tuple[Size, Size], int]:
    """Count the photos on disk whose intrinsics are for another size, as in `Capture.rescaled`.

    At most 200 photos, spread over the capture, are measured; those that do not fit their camera are skipped.
    """
    chosen = np.unique(np.linspace(0, len(capture.frames) - 1, _MOST_MEASURED).round().astype(int))
    sizes = []
    for frame in (capture.frames[index] for index in chosen):
        if not frame.has_photo:
            continue
        try:
            sizes.append(rescaling(frame.camera, upright(frame, measure_of(capture)).camera))
        except UserError:  # --detect and the commands that use the photos say what is wrong with them
            continue
    return counted(sizes)


def _turned_observations(capture: Capture, turns: np.ndarray) -> Observations | None:
    """Return the observations of a capture after the pictures of its frames were turned by orientations (frames,)."""
    seen = capture.observations
    if seen is None:
        return None
    pixels = seen.pixels.copy()
    sizes = np.array([frame.camera.size for frame in capture.frames])
    for orientation in set(turns.tolist()) - {1}:
        rows = turns[seen.frame_index] == orientation
        pixels[rows] = turned_pixels(pixels[rows], sizes[seen.frame_index[rows]], orientation=orientation)
    return replace(seen, pixels=pixels)


def _turn(frame: Frame, pixels: str) -> int:
    """Return the EXIF orientation that turns the pixels of a frame's camera into the requested ones."""
    assert frame.image is not None
    width, height, written = measure(frame.image)
    orientation, size = turn_to_upright(frame.camera, path=frame.image, measure=lambda _: (width, height, written))
    if pixels == STORED:
        orientation, size = turn_back(written), (width, height)
    try:
        frame.camera.resized(*size)
    except UserError as error:
        raise UserError(f"{frame.image}: {error.message}", error.hint) from error
    return orientation


def _fits(mask: Path, camera: Camera, before: Camera, pixels: str) -> bool:
    """Return whether a mask can be used after a camera was turned.

    Its shape has to be that of the turned picture, or, for upright pixels, of the one before: nerfcli then turns the
    mask (`photos.masks.read_mask`).
    """
    return _closer_in_shape(mask, camera, before) or (pixels == UPRIGHT and _closer_in_shape(mask, before, camera))


def _closer_in_shape(mask: Path, camera: Camera, before: Camera) -> bool:
    """Return whether the shape of a mask is closer to the picture of `camera` than to that of `before`."""
    if not mask.is_file():
        return False
    width, height = image_size(mask)
    off, off_before = (abs(width * of.height - height * of.width) for of in (camera, before))
    return off < off_before
