"""What backends are given and return: code above them works per ray, code inside them per sample.

Letters in shapes: R rays; N samples of all rays, packed ray after ray, where ray r owns samples offsets[r] up to, not
including, offsets[r + 1], with `offsets` (R + 1,) int64; S intervals per ray; G cells along a side of the occupancy
grid; L levels of a table, T rows per level, F features per row.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from torch import Tensor

# Widths that compiled kernels are written for: of rows of a table, of codes and hidden layers, of the density network's
# outputs and of spherical harmonics.
FEATURES, WIDTH, OUT = 4, 32, 16
# Of splats: added to the diagonal of covariances, px^2, as every program that shows splats does; limits of opacities.
LOW_PASS, SMALLEST_ALPHA, LARGEST_ALPHA = 0.3, 1 / 255, 0.99
# Fraction of a picture's size beyond its edge at which splats end: there the lens is no longer its tangent.
BEYOND = 0.15
# Assumed colour of samples whose colour is not evaluated; the error is at most half of their weight.
UNSEEN = 0.5


class Rays(NamedTuple):
    """R rays in the training frame.

    Args:
        origins, directions: (R, 3), unit directions.
        jitter: (R,) in [0, 1): fraction by which each cut is shifted towards the next edge.
        cones: (R,) width of a ray's footprint per unit of distance; None for rays without width.
    """

    origins: Tensor
    directions: Tensor
    jitter: Tensor
    cones: Tensor | None = None

    def detached(self) -> "Rays":
        """Return the same rays without gradients."""
        return self._replace(origins=self.origins.detach(), directions=self.directions.detach())


class March(NamedTuple):
    """Sampling of rays.

    Args:
        edges: (S + 2,) increasing distances, shared by the rays, for S intervals: ray r is cut at
            edges[k] + jitter[r] * (edges[k + 1] - edges[k]).
        occupied: (G, G, G) bool over the unit cube of `grid_coordinates`, indexed [z, y, x].
        contraction: see `grid_coordinates`; outside the cube of a bounded scene nothing is occupied.
        max_optical_depth: > 0; each ray ends at the sample where its optical depth reaches this.
        least_weight: >= 0; samples that absorb a smaller fraction of their ray's light may be left out, but never all.
        distances: `reference.distances_to_occupied` of `occupied`, to skip empty space faster; None if that is not
            worthwhile.
    """

    edges: Tensor
    occupied: Tensor
    contraction: str
    max_optical_depth: float
    least_weight: float = 0.0
    distances: Tensor | None = None


class HashGrid(NamedTuple):
    """A radiance field made of a multiresolution hash grid and two small networks, with compiled kernels in backends.

    Args:
        table: (L, T, F).
        resolutions: cells per axis of each level; 0 leaves a level out.
        layers: weights of the networks: W1 (H, L * F), W2 (A, H), C1 (H, A + 16), C2 (H, H), C3 (3, H), see `radiance`.
        view_degree: highest degree of the direction's spherical harmonics that colours depend on, 0 to 3.
        antialias: whether levels finer than a ray's cone fade out.
        table_grad: of the table's shape; the gradient by the table is added to it instead of being passed to autograd,
            which saves making, filling and adding a buffer of megabytes at every step. None to use autograd.
    """

    table: Tensor
    resolutions: tuple[int, ...]
    layers: tuple[Tensor, ...]
    view_degree: int = 3
    antialias: bool = False
    table_grad: Tensor | None = None


class Medium(Protocol):
    """A radiance field of another type, evaluated by its own code."""

    def density(self, coordinates: Tensor) -> Tensor:
        """Return the density (N,), in 1 / training unit, at coordinates (N, 3) of the unit cube."""

    def radiance(self, coordinates: Tensor, directions: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
        """Return density (N,) and sRGB colour (N, 3) at coordinates (N, 3) along `directions` (R, 3) of `rays` (N,)."""


class Targets(NamedTuple):
    """Losses of training besides the colour loss.

    Args:
        near: > 0, distance below which gradients of samples are scaled down, see `scale_gradients`; None for nowhere.
        distortion: whether `RaySums.distortion` is computed.
        distances: (K,) > 0 at which the light of the last K rays should be absorbed, K <= R; None without such rays.
    """

    near: float | None = None
    distortion: bool = False
    distances: Tensor | None = None


class RaySums(NamedTuple):
    """Sums over the samples of R training rays.

    Args:
        rgb: (R, 3) sRGB on the background.
        transmittance: (R,) fraction of the light that passes all samples.
        distortion: (R,) in contracted distance, see `contracted_distance`; (0,) if it is not a target.
        depth_loss: (K,) in [0, 1], see `depth_loss`; (0,) without such targets.
        samples: () int64, total number of samples of the rays.
    """

    rgb: Tensor
    transmittance: Tensor
    distortion: Tensor
    depth_loss: Tensor
    samples: Tensor


class TraceOptions(NamedTuple):
    """What rays of pictures give besides their colours, and how exact these are.

    Args:
        fractions: of light for the quantiles to compute, each between 0 and 1.
        negligible: largest total weight of the samples of a ray whose colours are not evaluated.
        keep_intervals: whether to return the samples; a backend may return them even if this is False.
    """

    fractions: tuple[float, ...] = ()
    negligible: float = 0.0
    keep_intervals: bool = True


class AdamStep(NamedTuple):
    """A step of Adam on rows, see `adam_rows`.

    Args:
        number: from 1.
        rate, betas, eps: of Adam.
        decay: >= 0, weight in the loss of the sum of table^2 / 2 over the touched rows.
    """

    number: int
    rate: float
    betas: tuple[float, float]
    eps: float
    decay: float = 0.0


class RayTermination(NamedTuple):
    """Distribution of absorption along each of R rays; see `ray_termination`."""

    opacity: Tensor
    transmittance: Tensor
    mean: Tensor
    spread: Tensor
    peak: Tensor
    quantiles: Tensor


class Intervals(NamedTuple):
    """The samples of R rays: distances along the ray in the training frame."""

    density: Tensor
    starts: Tensor
    ends: Tensor
    offsets: Tensor


class RaysSeen(NamedTuple):
    """Rendered values of R rays.

    Args:
        rgb: (R, 3) sRGB on the background.
        ends: where their light is absorbed, as distances along the ray in the training frame.
        truncation_error: (R,) bound on the error of each channel of rgb from what was left out.
        intervals: the samples; may be empty, with 0 rays, if they were not to be kept.
    """

    rgb: Tensor
    ends: RayTermination
    truncation_error: Tensor
    intervals: Intervals


class Samples(NamedTuple):
    """The samples of rays that light reaches, without gradients.

    Args:
        starts, ends: (N,) distances along the ray.
        density: (N,).
        encoded: (N, L * F) features of the hash grid at the samples; None for another medium.
        coordinates: (N, 3) in the field's unit cube.
        offsets: (R + 1,).
        rays: (N,) int64, the ray of each sample.
        widths: (N,) of a pixel at the samples, see `contraction.cube_widths`; None if details do not fade out.
    """

    starts: Tensor
    ends: Tensor
    density: Tensor
    encoded: Tensor | None
    coordinates: Tensor
    offsets: Tensor
    rays: Tensor
    widths: Tensor | None = None


class BearingGrids(NamedTuple):
    """Grids of bearings larger than the photos of a lens, for photos whose pixels are between those of the grid.

    Args:
        widths: (P, 2) int64, of each photo and of its grid.
        corners: (P, 4) weights of the four bearings around a pixel: upper left, upper right, lower left, lower right.
            Their sum is normalised. If the first is 1, that bearing is used as it is; else all four have to exist.
    """

    widths: Tensor
    corners: Tensor


class PixelTable(NamedTuple):
    """The pixels of P photos, numbered through all photos, row by row.

    Args:
        first_pixel: (P,) int64, the number of the first pixel of each photo, increasing from 0.
        first_bearing: (P,) int64, index of the first bearing of each photo.
        bearings: (B, 3) directions of pixels in the axes of their cameras.
        poses: (P, 4, 4) `world_from_cam`.
        colours: (M, C) uint8 values of all pixels.
        grids: of the bearings; None if each photo has the bearings of its own pixels.
    """

    first_pixel: Tensor
    first_bearing: Tensor
    bearings: Tensor
    poses: Tensor
    colours: Tensor
    grids: BearingGrids | None = None


class Splats(NamedTuple):
    """N Gaussians: means (N, 3), log_scales (N, 3), quaternions (N, 4), logits (N,) of opacity, harmonics (N, K, 3)."""

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    logits: Tensor
    harmonics: Tensor


class Footprints(NamedTuple):
    """N Gaussians in a picture.

    Args:
        centres: (N, 2) pixels.
        covariances: (N, 2, 2) square pixels, with `LOW_PASS` on the diagonal.
        opacities: (N,) at the centres.
        colours: (N, 3) sRGB.
        distances: (N,) of the means from the camera.
    """

    centres: Tensor
    covariances: Tensor
    opacities: Tensor
    colours: Tensor
    distances: Tensor


class SplatView(NamedTuple):
    """A camera of splats: NumPy arrays, float64.

    Args:
        rotation, translation: (3, 3) and (3,), camera axes from the frame of the splats.
        width, height: of the picture.
        near: distance below which Gaussians are left out.
        table: (2, G, G) coefficients of bicubic B-splines of the pixel's x and y, indexed [axis, y, x], over the
            stereographic coordinates s = (x, y) / (|p| + z) of points p in camera axes.
        first, step: (2,) s at the first coefficient, and between two.
    """

    rotation: np.ndarray
    translation: np.ndarray
    width: int
    height: int
    near: float
    table: np.ndarray
    first: np.ndarray
    step: np.ndarray


# Called with a name, a tensor whose rows belong to samples, and the ray (N,) of each row.
Trace = Callable[[str, Tensor, Tensor], None]
