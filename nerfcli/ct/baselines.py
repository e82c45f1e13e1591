"""Filtered back-projection of the views of a fit, to compare with; of logarithms of the data, as is usual."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from nerfcli.ct.geometry import CIRCULAR, ScanGeometry
from nerfcli.ct.grid import VoxelGrid
from nerfcli.ct.scan import Scan
from nerfcli.errors import UserError


def logarithms(scan: Scan, air: Sequence[float] | None) -> np.ndarray:
    """Return line integrals (V, rows, columns) of the training views, with the open beam of each view corrected.

    Rows without a usable pixel are those of the nearest row with one.
    """
    views = scan.training_views
    integrals, usable = scan.line_integrals(views), scan.of_views("usable", views)
    if usable is not None:
        rows = np.arange(scan.geometry.rows)
        for picture, is_live in zip(integrals, np.broadcast_to(usable.any(axis=2), integrals.shape[:2]), strict=True):
            if not is_live.all():
                live = rows[is_live]
                picture[:] = picture[live[np.abs(live - rows[:, None]).argmin(1)]]
    return integrals if air is None else integrals + np.log(np.asarray(air, dtype=np.float32))[:, None, None]


def filtered_back_projection(geometry: ScanGeometry, integrals: np.ndarray, grid: VoxelGrid) -> Tensor:
    """Reconstruct by Feldkamp's algorithm (parallel beams: filtered back-projection), ramp filter, not clipped.

    Args:
        geometry: views at equal steps, over a full turn, or half a turn for parallel beams.
        integrals: (V, rows, columns) line integrals.

    Returns:
        (Z, Y, X) attenuation in 1 / unit.

    Raises:
        UserError: the scan is not a circle around z.

    Source: Feldkamp, Davis and Kress 1984, Practical cone-beam algorithm, JOSA A 1(6), equation 28.
    """
    height, width = geometry.pixel_at_origin
    outward = -geometry.emitter if geometry.beam == "parallel" else geometry.emitter
    radius = float(np.median(np.linalg.norm(outward, axis=1)))
    down = geometry.row_step / np.linalg.norm(geometry.row_step, axis=1, keepdims=True)
    if not geometry.is_circular or np.abs(down[:, :2]).max() >= CIRCULAR:
        raise UserError(
            "filtered back-projection needs a source on a circle around z and an upright detector",
            "use it for scans on a circle",
        )
    columns = np.arange(geometry.columns) - (geometry.columns - 1) / 2
    rows = np.arange(geometry.rows) - (geometry.rows - 1) / 2
    # Coordinates on a detector through the axis.
    along, down = columns * width, rows * height
    weighted = np.asarray(integrals, dtype=np.float64)
    if geometry.beam == "cone":
        weighted = weighted * (radius / np.sqrt(radius**2 + along[None, None] ** 2 + down[None, :, None] ** 2))
    filtered = torch.from_numpy(_ramp(weighted, width).astype(np.float32))

    z, y, x = (torch.from_numpy(grid.axis(name)) for name in "zyx")
    volume = torch.zeros(grid.shape)
    for view in range(geometry.views):
        direction = outward[view] / radius
        if geometry.beam == "cone":
            depth = 1 - (x * direction[0] + y[:, None] * direction[1]) / radius  # (Y, X), 1 on the axis
        else:
            depth = torch.ones(len(y), len(x), dtype=torch.float64)
        right, centre = geometry.column_step[view], geometry.centre[view]
        right = right / np.linalg.norm(right)
        across = (x * right[0] + y[:, None] * right[1]) / depth
        offset = float(centre @ right) / float(geometry.magnification[view])
        column = (across - offset) / width  # from the middle, in pixels
        lift = float(centre[2]) / float(geometry.magnification[view])
        row = -(z[:, None, None] / depth - lift) / height
        place = torch.stack(
            [
                (column * 2 / max(geometry.columns, 2)).expand(row.shape),
                row * 2 / max(geometry.rows, 2) if geometry.rows > 1 else torch.zeros_like(row),
            ],
            dim=-1,
        )
        picture = filtered[view][None, None]
        seen = grid_sample(
            picture, place.reshape(1, -1, 1, 2).float(), mode="bilinear", padding_mode="zeros", align_corners=False
        )
        volume += seen.view(grid.shape) / depth.square().float()
    return volume * (np.pi / geometry.views)  # over a full turn, each line is measured from both of its ends


def _ramp(projections: np.ndarray, width: float) -> np.ndarray:
    """Filter projections along their rows by the ramp, sampled in space (Kak and Slaney 1988, equation 3.61)."""
    count = projections.shape[-1]
    length = 1 << int(np.ceil(np.log2(2 * count)))
    place = np.arange(length) - length // 2
    kernel = np.zeros(length)
    kernel[place == 0] = 1 / (4 * width**2)
    odd = place % 2 != 0
    kernel[odd] = -1 / (np.pi * place[odd] * width) ** 2
    response = np.fft.rfft(np.fft.ifftshift(kernel))
    return np.fft.irfft(np.fft.rfft(projections, length) * response, length)[..., :count] * width
