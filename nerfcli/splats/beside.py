"""Pictures of the field from cameras beside those of few photos: what splats should show where no photo looked.

Splats that are refined on photos alone show streaks and holes from there, the field a blurred guess. A small share of
its pictures among the photos keeps the guess: from cameras moved by the spread of all, splats are 3 to 7 dB closer to
the field, and on held-out photos 0.2 dB worse (17 photos) to 1 dB better (14). See docs/research/splats.md.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.photos.loading import LoadedPhoto, downscaled_camera
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture, straight_rgba

# With more photos than this, nearly everything that one looks at was photographed.
FEW = 150
# Share of the pictures among the steps: the first over the number of photos, but at most the second.
SHARE_OF_ONE, LARGEST_SHARE = 3.0, 0.4
# Distance of the cameras from those of photos, in units of the spread of these.
NEAREST, FARTHEST = 0.2, 1.0
# The pictures have half the size of the photos, and at most this many pixels together.
REDUCTION, PIXELS = 2.0, 1_000_000


def share_of_pictures(photos: int) -> float:
    """Return the share of the field's pictures among the steps of a refinement on some number of photos."""
    return min(LARGEST_SHARE, SHARE_OF_ONE / photos) if photos <= FEW else 0.0


def pictures_beside(
    model: Model, photos: Sequence[LoadedPhoto], *, seed: int = 0, on_progress: Callable[[float], None]
) -> list[LoadedPhoto]:
    """Render the field from cameras moved in random directions; none if there are many photos.

    Returns:
        Pictures with straight alpha if the photos have it, on the field's background if not.
    """
    if not share_of_pictures(len(photos)):
        return []
    rng, frames = np.random.default_rng(seed), [photo.frame for photo in photos]
    spread = float(np.sqrt(np.stack([frame.centre for frame in frames]).var(axis=0).sum()))
    size = np.mean([photo.pixels.shape[0] * photo.pixels.shape[1] for photo in photos]) / REDUCTION**2
    chosen = rng.permutation(len(photos))[: max(1, int(PIXELS / size))]
    pictures = []
    for index in chosen:
        aside = rng.normal(size=3)
        aside *= rng.uniform(NEAREST, FARTHEST) * spread / np.linalg.norm(aside)
        pictures.append(_picture(model, photos[index], aside))
        on_progress(len(pictures) / len(chosen))
    return pictures


def _picture(model: Model, photo: LoadedPhoto, aside: np.ndarray) -> LoadedPhoto:
    """Return the field's picture from the camera of a photo that is moved by `aside` (3,)."""
    pose = photo.frame.world_from_cam.copy()
    pose[:3, 3] += aside
    camera = downscaled_camera(photo.frame.camera, REDUCTION)
    frame: Frame = replace(photo.frame, camera=camera, world_from_cam=pose)
    if photo.pixels.shape[-1] == 4:
        seen = render_picture(model, frame, background=(0.0, 0.0, 0.0))
        levels = straight_rgba(seen)
    else:
        seen = render_picture(model, frame, background=model.background)
        levels = seen.rgb
    return LoadedPhoto(frame, np.rint(255.0 * levels).astype(np.uint8), None if seen.valid.all() else seen.valid)
