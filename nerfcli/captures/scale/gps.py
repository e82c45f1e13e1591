"""Scale from the GPS positions that cameras and phones write into their photos.

The GPS of phones is off by metres, and its errors last for minutes: it gives the scale of a street, not of a teapot.
In up to 1 of 100 captures, errors that drift as slowly as the photographer walks are taken for the walk, and no
residual shows that.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from nerfcli.cameras.alignment import align_robustly
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import centres_of
from nerfcli.captures.scale.estimate import SPREAD_PER_NOISE, ScaleEstimate, jackknife
from nerfcli.errors import UserError
from nerfcli.photos.exif import read_exif
from nerfcli.photos.geodesy import Position, east_north_up

# GPS noise per coordinate in metres, assumed if there are too few photos to estimate it. Smartphones under open sky
# are within 4.9 m. Source: gps.gov, "GPS accuracy", after van Diggelen & Enge 2015.
_TYPICAL_NOISE = 3.0
_ENOUGH_TO_TELL = 6


def gps_positions(frames: Sequence[Frame]) -> dict[str, Position]:
    """Read the GPS positions of photos from EXIF, by frame name; photos without a position are omitted.

    Latitude 0, longitude 0 is omitted too: some cameras write it before they have a fix.

    Raises:
        UserError: a photo cannot be read.
    """
    found = {frame.name: read_exif(frame.image).gps for frame in frames if frame.image is not None}
    return {name: gps for name, gps in found.items() if gps is not None and gps[:2] != (0.0, 0.0)}


def scale_from_gps(frames: Sequence[Frame], positions: Mapping[str, Position]) -> ScaleEstimate:
    """Estimate metres per unit from the GPS positions of the photos.

    It fits a similarity from camera centres to ENU metres, by least squares without outliers (`align_robustly`). The
    standard error is the larger of the jackknife's, over up to 20 groups of neighbouring photos, and
    sigma / sqrt(sum |x - mean|^2), where sigma is the GPS noise per coordinate, at least 3 m with fewer than 6 photos.

    Args:
        frames: the cameras; those without a position are not used.

    Raises:
        UserError: fewer than two positions, all cameras or positions at one place, or a spread of the photos below 3
            times the GPS noise; the error gives the numbers.
    """
    used = sorted((frame for frame in frames if frame.name in positions), key=lambda frame: frame.name)
    if len(used) < 2:
        raise UserError(
            f"{'only 1' if used else 'none'} of {len(frames)} photos with a pose has a GPS position in its EXIF",
            "at least 2 are needed; give a known distance instead",
        )
    x = centres_of(used)
    y = east_north_up([positions[frame.name] for frame in used])
    if not (np.ptp(x, axis=0).max() > 0 and np.ptp(y, axis=0).max() > 0):
        which = "GPS positions" if np.ptp(x, axis=0).max() > 0 else "cameras"
        raise UserError(
            f"the {which} of all {len(used)} photos are identical", "this gives no scale; give a known distance instead"
        )
    fit = align_robustly(x, y)
    keep = fit.follows
    enough = int(keep.sum()) >= _ENOUGH_TO_TELL
    sigma = fit.sigma if enough else float(np.fmax(fit.sigma, _TYPICAL_NOISE))
    spread = float(np.sqrt(np.mean(np.sum((y[keep] - y[keep].mean(axis=0)) ** 2, axis=1))))
    noise = float(np.sqrt(3)) * sigma
    if not spread >= SPREAD_PER_NOISE * noise:
        how = "estimated from the fit to the poses" if enough else f"as assumed for {int(keep.sum())} photos"
        raise UserError(
            f"GPS is too inaccurate for a scale: the photos are spread over {spread:.2g} m, and the GPS error is "
            f"{noise:.2g} m ({how})",
            f"a spread of at least {SPREAD_PER_NOISE * noise:.2g} m is needed; give a known distance instead",
        )
    scale = fit.b_from_a.scale
    residuals = np.linalg.norm(fit.b_from_a.apply(x) - y, axis=1)
    left_out = [frame.name for frame, kept in zip(used, keep, strict=True) if not kept]
    off = f"; outliers ignored: {', '.join(left_out)}" if left_out else ""
    return ScaleEstimate(
        metres_per_unit=scale,
        standard_error=max(jackknife(x[keep], y[keep]), scale * sigma / (np.sqrt(keep.sum()) * spread)),
        residuals=tuple((frame.name, float(r)) for frame, r in zip(used, residuals, strict=True)),
        residual_unit="metre",
        source=f"GPS of {int(keep.sum())} photos (EXIF)",
        details=f"the photos are spread over {spread:.3g} m, and the GPS error is {noise:.2g} m{off}",
    )
