"""Pictures of the page: photos of the run, and reference pictures by which a page checks its own."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame, chosen_evenly
from nerfcli.cameras.layout import centres_of, gaps_between
from nerfcli.pages.page import data_uri, jpeg_bytes
from nerfcli.photos.colours import over_white
from nerfcli.photos.held_out_exposure import PhotoExposures, log_gains_of
from nerfcli.photos.images import reduced
from nerfcli.photos.loading import load_photo, pinhole_of, undistorted
from nerfcli.render.depth import DepthRequest
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture

# Longer sides to try, in pixels, and the JPEG quality.
LONGEST_PX = (800, 640, 480, 360, 280, 200, 140)
QUALITY = 80
# Most photos with a picture; cameras beyond are still drawn.
MOST_PICTURES = 200
# Number of photos that are encoded to choose the size of all.
_SAMPLE = 4


def page_photos(
    exposures: PhotoExposures,
    train: Sequence[Frame],
    test: Sequence[Frame],
    *,
    room_bytes: int,
    on_progress: Callable[[float], None] = lambda fraction: None,
) -> tuple[list[dict[str, Any]], int]:
    """Return the entries of a run's photos, undistorted to pinhole cameras, sorted by name, and how many are missing.

    Args:
        room_bytes: budget for all pictures, as text in the page.
    """
    frames = _sorted(train, test)
    there = [index for index, (frame, _) in enumerate(frames) if frame.image is not None and frame.image.exists()]
    shown = chosen_evenly(there, MOST_PICTURES)
    longest = _longest(frames, shown, room_bytes)
    pictures = {}
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        of = shown if longest else []
        encoded = pool.map(lambda index: jpeg_bytes(_small_photo(frames[index][0], longest), quality=QUALITY), of)
        for count, (index, jpeg) in enumerate(zip(of, encoded, strict=True)):
            pictures[index] = data_uri(jpeg, "jpeg")
            on_progress((count + 1) / len(of))
    entries = [{**entry, "picture": pictures.get(index)} for index, entry in enumerate(_entries(exposures, frames))]
    return entries, len(frames) - len(there)


def fetched_photos(exposures: PhotoExposures, train: Sequence[Frame], test: Sequence[Frame]) -> list[dict[str, Any]]:
    """Return the entries of `page_photos` with server addresses of the pictures, which `photo_jpeg` answers."""
    frames = _sorted(train, test)
    there = [frame.image is not None and frame.image.exists() for frame, _ in frames]
    return [
        {**entry, "picture": f"photo?n={index}" if there[index] else None}
        for index, entry in enumerate(_entries(exposures, frames))
    ]


def photo_jpeg(train: Sequence[Frame], test: Sequence[Frame], index: int, *, longest_px: int) -> bytes:
    """Return the JPEG of the photo of an entry of `fetched_photos`.

    Raises:
        LookupError: there is no such photo.
        UserError: it cannot be read.
    """
    frames = _sorted(train, test)
    if not 0 <= index < len(frames) or frames[index][0].image is None:
        raise LookupError(index)
    return jpeg_bytes(_small_photo(frames[index][0], longest_px), quality=QUALITY)


def frustum_depth(frames: Sequence[Frame], size: float) -> float:
    """Return the drawn depth of frusta: half the median distance between neighbours, at most a tenth of the scene."""
    centres = centres_of(frames)
    gap = float(np.median(gaps_between(centres))) if len(frames) > 1 else size
    return min(0.5 * gap, 0.1 * size) or 0.1 * size


def view_of(frame: Frame) -> dict[str, Any]:
    """Return position, rotation and intrinsics of a pinhole frame in the page's format."""
    return {
        "place": frame.centre.tolist(),
        "turn": frame.world_from_cam[:3, :3].tolist(),
        "lens": list(frame.camera.params),
        "width": frame.camera.width,
        "height": frame.camera.height,
    }


def _sorted(train: Sequence[Frame], test: Sequence[Frame]) -> list[tuple[Frame, str]]:
    """Return the frames with their split, sorted by name."""
    frames = [*((frame, "train") for frame in train), *((frame, "test") for frame in test)]
    return sorted(frames, key=lambda entry: entry[0].name)


def _entries(exposures: PhotoExposures, frames: Sequence[tuple[Frame, str]]) -> list[dict[str, Any]]:
    """Return the page entry of each frame, without its picture."""
    gains = log_gains_of([frame for frame, _ in frames], exposures)
    return [
        {
            "name": frame.name,
            **view_of(replace(frame, camera=pinhole_of(frame.camera))),
            "split": split,
            "log_gains": gains[index].tolist(),
        }
        for index, (frame, split) in enumerate(frames)
    ]


def _longest(frames: Sequence[tuple[Frame, str]], shown: Sequence[int], room_bytes: int) -> int:
    """Return the largest size at which all pictures fit, estimated from a few; 0 if none fits."""
    if not shown:
        return 0
    sample = shown[:: max(1, len(shown) // _SAMPLE)][:_SAMPLE]
    # Read once at the largest size, then scaled down.
    largest = [_small_photo(frames[index][0], LONGEST_PX[0]) for index in sample]
    for longest in LONGEST_PX:
        mean = np.mean([4 * len(jpeg_bytes(reduced(photo, longest), quality=QUALITY)) / 3 for photo in largest])
        if 1.1 * mean * len(shown) <= room_bytes:
            return longest
    return 0


def _small_photo(frame: Frame, longest_px: int) -> np.ndarray:
    """Return an undistorted photo, its longer side at most about `longest_px`; on white where it is transparent."""
    factor = max(1.0, max(frame.camera.width, frame.camera.height) / longest_px)
    photo = load_photo(replace(frame, mask=None), factor, "ignore")  # masks are not shown
    small = photo.frame.camera
    pixels, _ = undistorted(photo.pixels, small, pinhole_of(small))
    return over_white(pixels)


WIDTH, HEIGHT = 64, 48
CAMERAS = 3
FRACTION = 0.25
# Maps of the proof after the colour, in this order; see `compare` in check.js.
MAPS = (
    *("opacity", "conditional", "median", "max-weight", "moment", "background", "quantile"),
    *("spread", "disagreement"),
)


@dataclass(frozen=True)
class Proof:
    """Reference pictures for the page.

    Args:
        description: cameras and maps, plain values.
        expected: float32, by camera, then map, then row; depths along the optical axis in scene units, NaN where
            undefined.
    """

    description: dict[str, Any]
    expected: np.ndarray


def make_proof(model: Model, frames: Sequence[Frame]) -> Proof:
    """Render the proof of a model: small pinhole pictures of a few frames, spread evenly."""
    chosen = chosen_evenly(frames, CAMERAS)
    small = [Frame(frame.name, _small(frame.camera), frame.world_from_cam) for frame in chosen]
    columns = [values for frame in small for values in _maps(model, frame)]
    description = {
        "width": WIDTH,
        "height": HEIGHT,
        "share": FRACTION,
        "maps": list(MAPS),
        "cameras": [view_of(frame) for frame in small],
    }
    return Proof(description, np.concatenate(columns).astype("<f4"))


def _small(camera: Camera) -> Camera:
    """Return a 64 x 48 pinhole camera with the view cropped to that aspect ratio."""
    scale = max(WIDTH / camera.width, HEIGHT / camera.height)
    return Camera.pinhole(WIDTH, HEIGHT, camera.focal_px * scale)


def _maps(model: Model, frame: Frame) -> list[np.ndarray]:
    """Render the colour and `MAPS` of one camera as `nerfcli render` does, each flattened."""
    farthest = model.marching.far / model.training_from_scene.scale
    pictures = {}
    for name in ("conditional", "max-weight", "moment", "background", "quantile"):
        convention = f"quantile:{FRACTION}" if name == "quantile" else name
        request = DepthRequest(convention, "z", background_distance=farthest)
        pictures[name] = render_picture(model, frame, background=model.background, depth=request)
    first = pictures["conditional"]
    maps = {name: getattr(first, name) for name in ("opacity", "median", "spread", "disagreement")}
    maps |= {name: picture.depth for name, picture in pictures.items()}
    return [first.rgb.reshape(-1), *(np.asarray(maps[name]).reshape(-1) for name in MAPS)]
