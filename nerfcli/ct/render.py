"""Pictures of a reconstruction: projections, residuals, slices."""

from pathlib import Path

import numpy as np
import tifffile
import torch

from nerfcli.atomic import atomic_path
from nerfcli.ct.evaluate import held_out_air
from nerfcli.ct.grid import MEANINGS, UNSEEN
from nerfcli.ct.likelihood import Likelihood, likelihood_of
from nerfcli.ct.reconstruct import Projector
from nerfcli.ct.result import Reconstruction, load_reconstruction, scan_of
from nerfcli.errors import UserError
from nerfcli.machine import Resources
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.photos.images import write_png
from nerfcli.render.presentation import ColourRange, coloured

# Outputs that can be rendered from a reconstruction.
OUTPUTS = ("projection", "transmission", "residual")
# Residuals are shown from minus to plus this many standard deviations of the noise.
RESIDUAL_RANGE = 4.0


def render_scan(
    run: str | Path,
    output: Output = Output(),
    *,
    outputs: tuple[str, ...] = ("projection",),
    views: str = "test",
    slices: tuple[tuple[str, float], ...] = (),
    resources: Resources = Resources(),
    reporter: Reporter = Reporter(),
) -> list[Path]:
    """Write projections of a reconstruction, or slices through it, as float32 TIFF with a PNG to look at.

    Args:
        run: the folder that `train_scan` wrote.
        output: the folder to write, RUN/renders by default.
        outputs: some of `OUTPUTS`: line integrals, transmissions, and (measured - predicted) in units of the noise.
        views: "test" for the held-out ones, "train" for the fitted ones.
        slices: (axis, position in the scan's unit); if given, slices and their marks replace the projections.
        resources: threads.

    Returns:
        The paths of the float files.

    Raises:
        UserError: there is no reconstruction or no held-out view, a slice is outside the volume, or a file exists.
    """
    run = Path(run)
    target = output.at(run / "renders")
    resources.begin()
    result = load_reconstruction(run)
    if slices:
        cuts = {target / f"{name}.tif": cut for axis, at in slices for name, cut in _slice(result, axis, at).items()}
        output.refuse_existing(*cuts)
        for path, (values, high) in cuts.items():
            # Picture rows run downwards, but the vertical axis of a slice points up.
            _write_picture(path, values[::-1].copy(), 0.0, high)
        return list(cuts)
    scan = scan_of(result, run)
    chosen = np.array(scan.held_out, dtype=int) if views == "test" else scan.training_views
    if len(chosen) == 0:
        raise UserError(f"{run} has no held-out views", "render the training views with --cameras train")
    paths = {(view, name): target / name / f"{view:04d}.tif" for view in chosen for name in outputs}
    output.refuse_existing(*paths.values())
    corrected = scan.geometry.corrected(result.used["centre"], result.used["tilt"])
    geometry = corrected.select(chosen)
    projector, likelihood = Projector(geometry, result.grid), None
    if "residual" in outputs:
        air = held_out_air(scan, corrected, result) if views == "test" else result.used.get("air")
        likelihood = likelihood_of(scan, chosen, air=air)
    volume = torch.from_numpy(np.array(result.volume))
    top = float(np.nanmax(scan.line_integrals(chosen)))
    for number, view in enumerate(chosen):
        index = np.array([number])
        integrals = projector.forward(volume, index)
        pictures = {
            "projection": (integrals, 0.0, top),
            "transmission": (torch.exp(-integrals), 0.0, 1.0),
        }
        if likelihood is not None:
            residual = residual_of(likelihood, integrals, torch.from_numpy(index))
            pictures["residual"] = (residual, -RESIDUAL_RANGE, RESIDUAL_RANGE)
        for name in outputs:
            values, low, high = pictures[name]
            _write_picture(paths[view, name], values.view(geometry.rows, geometry.columns).numpy(), low, high)
        reporter.progress((number + 1) / len(chosen), f"view {view}")
    reporter.note(f"{len(paths)} pictures of {len(chosen)} views; line integrals up to {top:.3g}")
    return list(paths.values())


def slice_of(result: Reconstruction, axis: str, at: float) -> np.ndarray:
    """Interpolate a slice across an axis at a position in the scan's unit; NaN where no view sees the volume.

    Raises:
        UserError: the position is outside the volume.
    """
    grid = result.grid
    positions = grid.axis(axis)
    half = grid.size / 2
    if not positions[0] - half <= at <= positions[-1] + half:
        raise UserError(
            f"{axis}={at:g} is outside the volume ({positions[0]:.4g} to {positions[-1]:.4g} {result.unit})",
            "choose a position in this range",
        )
    place = float(np.clip((at - positions[0]) / grid.size, 0, len(positions) - 1))
    low = min(int(place), max(len(positions) - 2, 0))
    high = min(low + 1, len(positions) - 1)
    number = "zyx".index(axis)
    lower, upper = (
        np.where(np.take(result.marks, k, number) & UNSEEN, np.nan, np.take(result.volume, k, number))
        for k in (low, high)
    )
    fraction = place - low
    between = (1 - fraction) * lower + fraction * upper if fraction else lower
    return between.astype(np.float32)


def residual_of(likelihood: Likelihood, integrals: torch.Tensor, views: torch.Tensor) -> torch.Tensor:
    """Return measured minus predicted line integrals in units of their noise."""
    # The slope is that of the negative log likelihood: negative where the measured integral exceeds the predicted one.
    return -torch.sign(likelihood.slope(integrals, views)) * likelihood.deviance(integrals, views).sqrt()


def _slice(result: Reconstruction, axis: str, at: float) -> dict[str, tuple[np.ndarray, float]]:
    """Return a slice and, if it has any, the marks of the nearest layer: values and upper display limit, by name."""
    top = float(np.nanquantile(np.asarray(result.volume), 0.999))
    layer = int(np.argmin(np.abs(result.grid.axis(axis) - at)))
    found = np.take(result.marks, layer, "zyx".index(axis)).astype(np.float32)
    pictures = {f"{axis}={at:g}": (slice_of(result, axis, at), top)}
    if found.any():
        pictures[f"{axis}={at:g}-marks"] = (found, float(sum(MEANINGS)))
    return pictures


def _write_picture(path: Path, values: np.ndarray, low: float, high: float) -> None:
    with atomic_path(path) as partial:
        tifffile.imwrite(partial, values.astype(np.float32), photometric="minisblack", compression="zlib")
    write_png(path.with_suffix(".png"), coloured(values, ColourRange(low, high), "grey"))
