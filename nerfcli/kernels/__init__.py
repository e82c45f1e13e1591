"""The hot operations of the program behind one interface: `reference` defines them, faster modules agree with it.

Contracts, shapes and sources stand with each operation in `reference`. A fast version is taken where device, dtype,
sizes and the wanted gradients fit; everything else, float64 and CUDA tensors among it, goes through the reference.
"""

import functools
import warnings
from collections.abc import Callable
from types import ModuleType

import torch
from torch import Tensor

from nerfcli.kernels import depth as depth_reference
from nerfcli.kernels import marching, reference
from nerfcli.kernels.contraction import CONTRACTIONS, contract, contract_to_cube, grid_coordinates, sample_widths
from nerfcli.kernels.depth import LightEnds
from nerfcli.kernels.reference import sum_along_rays

__all__ = [
    "CONTRACTIONS",
    "adam_rows",
    "composite",
    "contract",
    "contract_to_cube",
    "density",
    "distortion",
    "grid_coordinates",
    "has_compiled",
    "hash_encode",
    "interval_weights",
    "light_ends",
    "lit_samples",
    "mixture_quantile",
    "occupied_samples",
    "optical_depth_before",
    "pixel_rays",
    "prepare",
    "radiance",
    "ray_indices",
    "sample_coordinates",
    "sample_widths",
    "sum_along_rays",
    "visible_samples",
]


def pixel_rays(
    chosen: Tensor, first_pixel: Tensor, first_bearing: Tensor, *, bearings: Tensor, poses: Tensor, photos: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.pixel_rays`."""
    return _module_for(bearings, poses).pixel_rays(
        chosen, first_pixel, first_bearing, bearings=bearings, poses=poses, photos=photos
    )


def ray_indices(offsets: Tensor) -> Tensor:
    """See `reference.ray_indices`."""
    numba_cpu = _numba_cpu() if offsets.device.type == "cpu" else None
    return (numba_cpu or reference).ray_indices(offsets)


def sample_coordinates(
    origins: Tensor,
    directions: Tensor,
    starts: Tensor,
    ends: Tensor,
    *,
    offsets: Tensor,
    contraction: str,
    known: Tensor | None = None,
) -> Tensor:
    """See `reference.sample_coordinates`.

    Args:
        known: (N, 3), the answer, where it has been computed before without gradients.
    """
    module = _module_for(origins, directions, starts, ends, constant=(starts, ends))
    if module is reference:
        return reference.sample_coordinates(origins, directions, starts, ends, offsets=offsets, contraction=contraction)
    return module.sample_coordinates(
        origins, directions, starts, ends, offsets=offsets, contraction=contraction, known=known
    )


def hash_encode(
    points: Tensor,
    table: Tensor,
    resolutions: tuple[int, ...],
    *,
    sink: Tensor | None = None,
    known: Tensor | None = None,
    widths: Tensor | None = None,
) -> Tensor:
    """See `reference.hash_encode`.

    Args:
        sink: of the table's shape; the gradient with respect to the table is added to it, and autograd gets none: a
            buffer of megabytes need not be made, filled and added at every step.
        known: (N, L * F), the answer, where it has been computed before without gradients.
    """
    numba_cpu = _numba_cpu()
    if numba_cpu is not None and numba_cpu.can_hash_encode(points, table, resolutions):
        return numba_cpu.hash_encode(points, table, resolutions, sink, known, widths)
    if sink is not None and table.requires_grad and torch.is_grad_enabled():
        leaf = table.detach().to(sink.dtype).requires_grad_()  # half precision's gradients go on unrounded

        def add_to_sink(given: Tensor) -> None:
            if given.grad is not None:
                sink.add_(given.grad)

        leaf.register_post_accumulate_grad_hook(add_to_sink)
        return reference.hash_encode(points, leaf, resolutions, widths)
    return reference.hash_encode(points, table, resolutions, widths)


def density(encoded: Tensor, weights: tuple[Tensor, ...]) -> Tensor:
    """See `reference.density`."""
    numba_cpu = _numba_cpu()
    needs_gradient = torch.is_grad_enabled() and (encoded.requires_grad or any(w.requires_grad for w in weights))
    if numba_cpu is not None and not needs_gradient and numba_cpu.can_radiance(encoded, weights[:2]):
        return numba_cpu.density(encoded, weights)
    return reference.density(encoded, weights)


def radiance(encoded: Tensor, harmonics: Tensor, rays: Tensor, weights: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """See `reference.radiance`."""
    numba_cpu = _numba_cpu()
    if numba_cpu is not None and numba_cpu.can_radiance(encoded, weights):
        return numba_cpu.radiance(encoded, harmonics, rays, weights)
    return reference.radiance(encoded, harmonics, rays, weights)


def composite(
    density: Tensor, rgb: Tensor, lengths: Tensor, *, offsets: Tensor, background: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.composite`."""
    module = _module_for(density, rgb, lengths, background, constant=(lengths, background))
    return module.composite(density, rgb, lengths, offsets=offsets, background=background)


def distortion(weights: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.distortion`."""
    return _module_for(weights, starts, ends, constant=(starts, ends)).distortion(weights, starts, ends, offsets)


def optical_depth_before(density: Tensor, lengths: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.optical_depth_before`."""
    module = _module_for(density, lengths, constant=(density, lengths))
    return module.optical_depth_before(density, lengths, offsets)


def interval_weights(density: Tensor, lengths: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """See `reference.interval_weights`."""
    return _module_for(density, lengths, constant=(density, lengths)).interval_weights(density, lengths, offsets)


def light_ends(
    density: Tensor, starts: Tensor, ends: Tensor, *, offsets: Tensor, shares: tuple[float, ...]
) -> LightEnds:
    """See `depth.light_ends`."""
    module = _module_for(density, starts, ends, constant=(density, starts, ends))
    module = depth_reference if module is reference else module
    return module.light_ends(density, starts, ends, offsets=offsets, shares=shares)


def mixture_quantile(
    density: Tensor, starts: Tensor, ends: Tensor, *, offsets: Tensor, rays_per_pixel: int, share: float
) -> Tensor:
    """See `depth.mixture_quantile`."""
    module = _module_for(density, starts, ends)
    module = depth_reference if module is reference else module
    return module.mixture_quantile(density, starts, ends, offsets=offsets, rays_per_pixel=rays_per_pixel, share=share)


def occupied_samples(
    origins: Tensor,
    directions: Tensor,
    edges: Tensor,
    *,
    jitter: Tensor,
    occupied: Tensor,
    contraction: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See `marching.occupied_samples`."""
    module = _module_for(origins, directions, edges, jitter)
    module = marching if module is reference else module
    return module.occupied_samples(
        origins, directions, edges, jitter=jitter, occupied=occupied, contraction=contraction
    )


def lit_samples(density: Tensor, lengths: Tensor, offsets: Tensor, *, deepest: float) -> tuple[Tensor, Tensor]:
    """See `marching.lit_samples`."""
    lit = optical_depth_before(density, lengths, offsets) < deepest
    return lit, torch.nn.functional.pad(lit.cumsum(0), (1, 0))[offsets]


def visible_samples(
    origins: Tensor,
    directions: Tensor,
    edges: Tensor,
    *,
    jitter: Tensor,
    occupied: Tensor,
    contraction: str,
    table: Tensor,
    resolutions: tuple[int, ...],
    weights: tuple[Tensor, ...],
    deepest: float,
    cones: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """See `reference.visible_samples`."""
    numba_cpu = _numba_cpu()
    fits = (
        numba_cpu is not None
        and _module_for(origins, directions, edges, jitter) is numba_cpu
        and numba_cpu.can_hash_encode(origins, table, resolutions)
        and numba_cpu.can_radiance(table.new_empty(0, table.shape[0] * table.shape[2]), weights[:2])
    )
    return (numba_cpu if fits and numba_cpu is not None else reference).visible_samples(
        origins,
        directions,
        edges,
        jitter=jitter,
        occupied=occupied,
        contraction=contraction,
        table=table,
        resolutions=resolutions,
        weights=weights,
        deepest=deepest,
        cones=cones,
    )


def adam_rows(
    table: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    *,
    step: int,
    rate: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """See `reference.adam_rows`."""
    module = _module_for(table, gradient) if table.shape[-1] == 4 else reference
    module.adam_rows(table, gradient, first, second, step=step, rate=rate, betas=betas, eps=eps)


def _module_for(*tensors: Tensor, constant: tuple[Tensor, ...] = ()) -> ModuleType:
    """Where to run: Numba for float32 on the CPU, unless a gradient is wanted that it does not give."""
    fits = all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors)
    wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in constant)
    return (_numba_cpu() or reference) if fits and not wanted else reference


def has_compiled() -> bool:
    """Whether the compiled CPU kernels work here."""
    return _numba_cpu() is not None


def prepare(notify: Callable[[str], None]) -> None:
    """Compile what has to be compiled for this machine, so that no clock runs meanwhile; once per machine."""
    numba_cpu = _numba_cpu()
    if numba_cpu is not None:
        if not numba_cpu.is_compiled():
            notify("compiling the CPU kernels for this machine, once; this takes about a minute")
        numba_cpu.warm_up()


@functools.cache
def _numba_cpu() -> ModuleType | None:
    """The CPU kernels, or None with one warning where Numba does not work."""
    try:
        from nerfcli.kernels import numba_cpu
    except ImportError as error:
        warnings.warn(f"Numba does not work here ({error}); the CPU kernels fall back to plain torch", stacklevel=3)
        return None
    return numba_cpu
