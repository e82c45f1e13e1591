"""Pictures of Gaussian splats on CPU threads, their gradients, and a step of Adam on the rows of splats."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
import torch

from nerfcli.kernels.interface import RayTermination, SplatView
from nerfcli.kernels.numba_cpu import machine_code, splat_compositing
from nerfcli.kernels.numba_cpu.similarity import similarity_gradient
from nerfcli.kernels.numba_cpu.splat_compositing import into_tiles
from nerfcli.kernels.numba_cpu.splat_gradient import BUFFER, gather_lane, gradient_of_lane, gradients_of_lanes
from nerfcli.kernels.numba_cpu.splat_projection import (
    COLOUR,
    FOOTPRINT,
    FUSED,
    LOGIT,
    MEAN,
    QUATERNION,
    SCALE,
    SUMS,
    degree_of,
    project,
)
from nerfcli.kernels.numba_cpu.threads import use_threads
from nerfcli.kernels.numba_cpu.vector import LANES

# Number of Gaussians for which buffers are made once.
_BLOCK = 16 * LANES
# Of Adam; gradients of a pixel's colour are about 1e-6.
_EPS, _ONE = np.float32(1e-12), np.float32(1.0)
# Gaussians with a larger gradient, of astronomic extent or at the camera, are not moved: its square is no float32.
_LARGEST_GRADIENT = np.float32(1e15)


class SplatPicture(NamedTuple):
    """A picture of splats, and what its gradient needs.

    Args:
        image: (H, W, 3) float32 sRGB on the background, not clipped above 1.
        transmittance: (H, W) float32 fraction of the background that is visible.
    """

    image: np.ndarray
    transmittance: np.ndarray
    rows: np.ndarray
    view: SplatView
    order: np.ndarray
    footprints: np.ndarray
    boxes: np.ndarray
    starts: np.ndarray
    ends: np.ndarray
    entries: np.ndarray
    slots: np.ndarray
    first_slots: np.ndarray


class SplatAdam(NamedTuple):
    """State of Adam for N rows: first and second moments (N, columns) float32, and the steps of each row (N,) int32."""

    first: np.ndarray
    second: np.ndarray
    steps: np.ndarray


def render_splats(rows: np.ndarray, view: SplatView, background: np.ndarray) -> SplatPicture:
    """Render splats; see `reference.project_splats` and `reference.composite_splats`.

    Args:
        rows: (N, 11 + 3 K) float32: mean, log scales, quaternion, logit, harmonics with their channels together.
        background: (3,) sRGB.
    """
    threads = use_threads()
    footprints, boxes = np.empty((len(rows), FOOTPRINT), np.float32), np.empty((len(rows), 4), np.int32)
    project(rows, _camera(view), view.width, view.height, view.near, footprints, boxes)
    order, footprints, boxes, starts, entries, slots, first_slots = into_tiles(
        footprints, boxes, view.width, view.height
    )
    image = np.empty((view.height, view.width, 3), np.float32)
    transmittance, ends = np.empty(image.shape[:2], np.float32), np.empty(len(starts) - 1, np.int64)
    behind = np.asarray(background, np.float32)
    splat_compositing.forward(starts, entries, footprints, boxes, behind, image, transmittance, ends, threads)
    return SplatPicture(
        image, transmittance, rows, view, order, footprints, boxes, starts, ends, entries, slots, first_slots
    )


def splat_depths(picture: SplatPicture, fractions: tuple[float, ...]) -> RayTermination:
    """Return where the light of each pixel ends, row by row, each Gaussian at its distance; see `ray_termination`."""
    height, width = picture.transmittance.shape
    columns = np.empty((height * width, 5 + len(fractions)), np.float32)
    splat_compositing.depths(
        picture.starts, picture.entries, picture.footprints, picture.boxes, np.array(fractions), height, width, columns,
        use_threads(),
    )  # fmt: skip
    values = torch.from_numpy(columns)
    return RayTermination(*values[:, :5].unbind(-1), quantiles=values[:, 5:])


def step_splats(
    picture: SplatPicture,
    by_image: np.ndarray,
    by_transmittance: np.ndarray,
    adam: SplatAdam,
    *,
    rates: np.ndarray,
    sizes: np.ndarray,
    betas: tuple[float, float],
) -> None:
    """Take a step of Adam on the Gaussians that the picture shows, in place.

    Args:
        by_image, by_transmittance: d loss / d image and d loss / d transmittance.
        rates: (6,) of means in units of `sizes`, log scales, quaternions, logits, harmonics of degree 0, of the others.
        sizes: (N,).
    """
    sums = np.empty((len(picture.entries), SUMS), np.float32)
    splat_compositing.backward(
        picture.starts, picture.ends, picture.entries, picture.slots, picture.footprints, picture.boxes,
        picture.image, picture.transmittance, np.ascontiguousarray(by_image, np.float32),
        np.ascontiguousarray(by_transmittance, np.float32), sums, use_threads(),
    )  # fmt: skip
    columns = np.empty(picture.rows.shape[1], np.float32)
    parts = (MEAN, SCALE, QUATERNION, LOGIT, COLOUR, COLOUR + 3, len(columns))
    for rate, first, last in zip(rates, parts[:-1], parts[1:], strict=True):
        columns[first:last] = rate
    _step(
        picture.rows, picture.order, picture.footprints, picture.first_slots, sums, _camera(picture.view),
        *adam, columns, sizes, np.float32(betas[0]), np.float32(betas[1]),
    )  # fmt: skip


def _camera(view: SplatView) -> tuple[Any, ...]:
    return view.rotation, view.translation, view.table, view.first, view.step


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy", fastmath=FUSED)
def _step(
    rows: Any, order: Any, footprints: Any, first_slots: Any, sums: Any, camera: Any, moments: Any, squares: Any,
    steps: Any, rates: Any, sizes: Any, beta1: Any, beta2: Any,
) -> None:  # fmt: skip
    columns = rows.shape[1]
    for block in numba.prange((len(order) + _BLOCK - 1) // _BLOCK):
        buffer, scratch = np.zeros(BUFFER, np.float32), (np.empty(3), np.empty(12), np.empty(6), np.empty(6))
        gradient, change = np.empty(columns, np.float32), np.empty(columns, np.float32)
        for begin in range(block * _BLOCK, min(len(order), (block + 1) * _BLOCK), LANES):
            end = min(len(order), begin + LANES)
            for i in range(begin, end):
                own = sums[first_slots[i] : first_slots[i + 1]]
                gather_lane(i - begin, rows[order[i]], footprints[i], own, camera, scratch, buffer)
            gradients_of_lanes(buffer, degree_of(columns), camera[0])
            for i in range(begin, end):
                n, total = order[i], np.float32(0.0)
                for k in range(columns):
                    gradient[k] = gradient_of_lane(buffer, i - begin, k)
                    total += abs(gradient[k])
                if not total < _LARGEST_GRADIENT:  # also if it is NaN
                    continue
                steps[n] += 1
                # Each row has its own count of steps: only those in front of the photo are updated.
                unbiased = np.float32(1.0 / (1.0 - np.float64(beta1) ** steps[n]))
                unbiased *= np.float32(np.sqrt(1.0 - np.float64(beta2) ** steps[n]))
                row, m, v = rows[n], moments[n], squares[n]
                for k in range(columns):
                    g = gradient[k]
                    m[k] = beta1 * m[k] + (_ONE - beta1) * g
                    v[k] = beta2 * v[k] + (_ONE - beta2) * g * g
                    change[k] = rates[k] * unbiased * m[k] / (np.sqrt(v[k]) + _EPS)
                for k in range(SCALE):
                    change[k] *= sizes[n]
                for k in range(columns):
                    row[k] -= change[k]


def prepare_splats(notify: Callable[[str], None]) -> None:
    """Compile the kernels of splats or load them from the cache, before any time budget starts to run."""
    if not any(machine_code.folder().glob("splat_compositing*.nbi")):
        notify("compiling the kernels of splats (once per machine, half a minute)")
    table = np.zeros((2, 8, 8))
    view = SplatView(np.eye(3), np.array([0.0, 0.0, 1.0]), 16, 16, 0.0, table, np.full(2, -4.0), np.ones(2))
    rows = np.zeros((1, 14), np.float32)
    rows[0, QUATERNION] = 1.0
    picture = render_splats(rows, view, np.zeros(3))
    nothing = np.zeros_like(picture.image)
    splat_depths(picture, (0.5,))
    adam = SplatAdam(np.zeros_like(rows), np.zeros_like(rows), np.zeros(1, np.int32))
    rates, sizes = np.zeros(6, np.float32), np.zeros(1, np.float32)
    by_image = similarity_gradient(picture.image, nothing)
    step_splats(picture, by_image, picture.transmittance, adam, rates=rates, sizes=sizes, betas=(0.9, 0.99))
