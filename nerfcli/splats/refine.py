"""Refinement of Gaussians on training photos and pictures of the field: Adam on one picture after another."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from nerfcli.cameras.rigid import Similarity
from nerfcli.errors import NON_FINITE, UserError
from nerfcli.field.checkpoint import load_tensors, save_tensors
from nerfcli.field.exposure import linear_from_srgb, srgb_from_linear
from nerfcli.kernels.interface import SplatView
from nerfcli.kernels.numba_cpu.similarity import similarity_gradient
from nerfcli.kernels.numba_cpu.splats import SplatAdam, prepare_splats, render_splats, step_splats
from nerfcli.photos.loading import LoadedPhoto, downscaled_camera
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture, straight_rgba
from nerfcli.splats.gaussians import Gaussians, gaussians_of
from nerfcli.splats.render import splat_view

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
    model: Model, photos: Sequence[LoadedPhoto], *, on_progress: Callable[[float], None]
) -> list[LoadedPhoto]:
    """Render the field from cameras moved in random directions; none if there are many photos.

    Returns:
        Pictures with straight alpha if the photos have it, on the field's background if not.
    """
    if not share_of_pictures(len(photos)):
        return []
    rng, frames = np.random.default_rng(0), [photo.frame for photo in photos]
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
    frame = replace(photo.frame, camera=camera, world_from_cam=pose)
    if photo.pixels.shape[-1] == 4:
        seen = render_picture(model, frame, background=(0.0, 0.0, 0.0))
        levels = straight_rgba(seen)
    else:
        seen = render_picture(model, frame, background=model.background)
        levels = seen.rgb
    return LoadedPhoto(frame, np.rint(255.0 * levels).astype(np.uint8), None if seen.valid.all() else seen.valid)


# Learning rates of means in units of the Gaussian's own size, of log scales, quaternions, logits, and of harmonics of
# degree 0 and above: four and more times those of 3DGS, as a few hundred steps do what 30,000 do there.
RATES = np.array([0.1, 0.1, 0.02, 0.2, 0.04, 0.01], np.float32)
# They decay by this factor over the budget, after some steps of warm-up.
DECAY, WARM_UP = 0.1, 10
BETAS = (0.9, 0.99)
# Weight of the structural similarity in the loss.
SIMILARITY_WEIGHT = 0.2
# Steps between two checks that all numbers are finite.
CHECK_EVERY = 100


@dataclass(frozen=True)
class SplatPhoto:
    """A photo to refine on.

    Args:
        pixels: (H, W, 3 or 4) uint8 sRGB, straight alpha.
        used: (H, W) bool, or None for all pixels.
        levels: (3, 256) float32, what a level of the photo would be at mean exposure.
    """

    view: SplatView
    pixels: np.ndarray
    used: np.ndarray | None
    levels: np.ndarray

    def target(self, background: np.ndarray) -> np.ndarray:
        """Return the picture (H, W, 3) that the splats should show on a background."""
        rgb = np.stack([self.levels[channel][self.pixels[..., channel]] for channel in range(3)], axis=-1)
        if self.pixels.shape[-1] == 3:
            return rgb
        alpha = self.pixels[..., 3:] * np.float32(1 / 255)
        return alpha * rgb + (1 - alpha) * background


@dataclass
class Refinement:
    """State of a refinement.

    Args:
        rows: see `rows_of`, in the frame of the views.
        sizes: (N,) unit of the rate of each mean.
    """

    rows: np.ndarray
    adam: SplatAdam
    sizes: np.ndarray
    steps: int = 0
    seconds: float = 0.0

    @staticmethod
    def of(rows: np.ndarray) -> "Refinement":
        """Return the state before the first step."""
        sizes = np.exp(np.sort(rows[:, 3:6], axis=1)[:, 1])
        adam = SplatAdam(np.zeros_like(rows), np.zeros_like(rows), np.zeros(len(rows), np.int32))
        return Refinement(rows.copy(), adam, sizes)


def splat_photos(
    photos: Sequence[LoadedPhoto], log_gains: np.ndarray, *, splats_from_scene: Similarity, near: float
) -> list[SplatPhoto]:
    """Return photos to refine on.

    Args:
        log_gains: (P, 3) of the photos in linear light; their levels are divided by the gains.
        splats_from_scene, near: see `splat_view`.
    """
    views = [splat_view(photo.frame, splats_from_scene=splats_from_scene, near=near) for photo in photos]
    return [
        SplatPhoto(view, photo.pixels, photo.used, _levels(gains))
        for view, photo, gains in zip(views, photos, log_gains, strict=True)
    ]


def _levels(log_gains: np.ndarray) -> np.ndarray:
    light = linear_from_srgb(torch.arange(256) / 255.0) / torch.from_numpy(np.exp(log_gains))[:, None]
    return srgb_from_linear(light).float().clamp(0.0, 1.0).numpy()


def refine(
    state: Refinement,
    photos: Sequence[SplatPhoto],
    *,
    background: Sequence[float],
    beside: Sequence[SplatPhoto] = (),
    share: float = 0.0,
    seconds: float | None = None,
    steps: int | None = None,
    on_step: Callable[[float], None] = lambda fraction: None,
    is_ended: Callable[[], bool] = lambda: False,
    notify: Callable[[str], None] = lambda text: None,
) -> None:
    """Refine until a total of `seconds` or of `steps`, those of earlier calls included, in place.

    With `steps` the result is the same, bit for bit, for any number of threads.

    Args:
        background: sRGB behind photos without alpha; photos with alpha get a random one at each step.
        beside, share: further pictures, and their share of the steps; see `pictures_beside`.
        is_ended: whether to end before the budget is used, asked before each step.
        notify: called with a line if kernels have to be compiled first, which does not count.
    """
    prepare_splats(notify)
    rng = np.random.default_rng([0, state.steps])
    order: list[int] = []
    began, before = time.perf_counter(), state.seconds
    while (fraction := max(state.seconds / seconds if seconds else 0.0, state.steps / steps if steps else 0.0)) < 1.0:
        if is_ended():
            break
        if not order:
            order = rng.permutation(len(photos)).tolist()
        if beside and rng.random() < share:
            photo = beside[int(rng.integers(len(beside)))]
        else:
            photo = photos[order.pop()]
        has_alpha = photo.pixels.shape[-1] == 4
        behind = rng.random(3, dtype=np.float32) if has_alpha else np.asarray(background, np.float32)
        picture = render_splats(state.rows, photo.view, behind)
        by_image = loss_gradient(picture.image, photo.target(behind), photo.used)
        rates = RATES * np.float32(DECAY**fraction * min(1.0, (state.steps + 1) / WARM_UP))
        nothing = np.zeros(picture.transmittance.shape, np.float32)
        step_splats(picture, by_image, nothing, state.adam, rates=rates, sizes=state.sizes, betas=BETAS)
        state.steps += 1
        state.seconds = before + time.perf_counter() - began
        if state.steps % CHECK_EVERY == 0:
            refuse_non_finite(state.rows)
        on_step(fraction)
    refuse_non_finite(state.rows)


def loss_gradient(image: np.ndarray, target: np.ndarray, used: np.ndarray | None = None) -> np.ndarray:
    """Return the derivative (H, W, 3) by `image` of the loss of a picture.

    mean of (1 - w) |image - target| + w (1 - SSIM),  w = 0.2

    Absolute errors alone leave surfaces smooth: texture of low contrast has small errors, but a low similarity.

    Args:
        image, target: (H, W, 3) float32 sRGB.
        used: (H, W) bool, the pixels that count; others are taken to be as in the target. None if all count.

    Source: Kerbl et al. 2023, 3D Gaussian splatting, ACM TOG 42(4), eq. 7.
    """
    if used is not None:
        image = np.where(used[..., None], image, target)
    by_image = np.sign(image - target)
    by_image *= np.float32(1.0 - SIMILARITY_WEIGHT)
    by_image -= np.float32(SIMILARITY_WEIGHT) * similarity_gradient(image, target)
    if used is not None:
        by_image *= used[..., None]
    by_image *= np.float32(1 / by_image.size)
    return by_image


def refuse_non_finite(rows: np.ndarray) -> None:
    """Raise a UserError if a number is NaN or infinite."""
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        raise UserError(
            f"{bad.sum()} of {len(rows)} Gaussians are not finite",
            "export again with another --count, and please report this",
            NON_FINITE,
        )


FORMAT = "nerfcli splats 1"


@dataclass(frozen=True)
class RunSplats:
    """Splats of a run.

    Args:
        refinement: in the training frame.
        log_gains: (P, 3) of the training photos, see `Start`.
        background: sRGB.
        training_from_scene: the normalisation of the field.
        field_sha256: of the field that they began with.
        count: the largest number of Gaussians that was asked for.
    """

    refinement: Refinement
    log_gains: np.ndarray
    background: tuple[float, float, float]
    training_from_scene: Similarity
    field_sha256: str
    count: int

    @property
    def degree(self) -> int:
        """Degree of the harmonics."""
        return gaussians_of(self.refinement.rows[:1]).degree

    def gaussians(self) -> Gaussians:
        """Return the Gaussians in the scene's frame."""
        return gaussians_of(self.refinement.rows).moved(self.training_from_scene.inverse())


def save_splats(path: Path, splats: RunSplats) -> None:
    """Write splats with their state; the file appears whole or not at all."""
    state = splats.refinement
    arrays = {
        "rows": state.rows,
        "sizes": state.sizes,
        "first": state.adam.first,
        "second": state.adam.second,
        "steps_of_rows": state.adam.steps,
        "log_gains": splats.log_gains,
    }
    description = {
        "format": FORMAT,
        "steps": state.steps,
        "seconds": state.seconds,
        "background": list(splats.background),
        "training_from_scene": splats.training_from_scene.to_json(),
        "field_sha256": splats.field_sha256,
        "count": splats.count,
    }
    save_tensors(path, {name: torch.from_numpy(values) for name, values in arrays.items()}, description)


def load_splat_state(path: Path) -> RunSplats:
    """Read splats that `save_splats` wrote.

    Raises:
        UserError: the file is missing, damaged, or of another version.
    """
    tensors, description = load_tensors(path, "cpu")
    if description.get("format") != FORMAT:
        raise UserError(
            f"{path} is of format {description.get('format')!r}, expected {FORMAT!r}", "delete it and export again"
        )
    arrays = {name: tensor.numpy() for name, tensor in tensors.items()}
    adam = SplatAdam(arrays["first"], arrays["second"], arrays["steps_of_rows"])
    red, green, blue = description["background"]
    return RunSplats(
        Refinement(arrays["rows"], adam, arrays["sizes"], description["steps"], description["seconds"]),
        arrays["log_gains"],
        (red, green, blue),
        Similarity.from_json(description["training_from_scene"]),
        description["field_sha256"],
        description["count"],
    )
