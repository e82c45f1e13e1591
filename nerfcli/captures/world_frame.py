"""Change of the world frame during a conversion: up axis, origin, and unit of length."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.captures.capture import Capture
from nerfcli.captures.scale.boards import CharucoBoard, scale_from_charuco, scale_from_markers
from nerfcli.captures.scale.distances import known_distance, scale_from_distances
from nerfcli.captures.scale.estimate import ScaleEstimate
from nerfcli.captures.scale.gps import gps_positions, scale_from_gps
from nerfcli.captures.stored_pixels import measure_of, upright
from nerfcli.captures.world import moved_to_origin, transformed, up_aligned
from nerfcli.errors import UserError

GPS = "gps"
# Beyond this factor or its inverse, squares of lengths of ordinary scenes come near the ends of float32.
SMALLEST_SCALE = 1e-9


@dataclass(frozen=True)
class WorldFrame:
    """The requested world frame of a capture; None leaves a property unchanged.

    Args:
        up: the axis that points up: x, y, z, -x, -y or -z.
        origin: centre-of-cameras, focus, or a point "x,y,z" in the old frame.
        scale: a factor for all lengths, or "gps" for metres from the positions in the photos' EXIF.
        markers: ArUco markers in the photos, "DICTIONARY:SIDE", or a ChArUco board,
            "DICTIONARY:COLUMNSxROWS:SQUARE:MARKER", with sides in metres: lengths become metres. Append ":legacy" for
            boards with an even number of rows that were made with OpenCV before 4.6.
        distances: known distances, "A B METRES", between images by name or points x,y,z: lengths become metres.
    """

    up: str | None = None
    origin: str | None = None
    scale: str | None = None
    markers: str | None = None
    distances: Sequence[str] = ()


@dataclass(frozen=True)
class Moved:
    """A capture in another world frame.

    Args:
        scale: the estimate of the scale if lengths became metres.
    """

    capture: Capture
    new_from_old: Similarity
    scale: ScaleEstimate | None = None


def in_world_frame(capture: Capture, wanted: WorldFrame) -> Moved:
    """Move a capture to another world frame: first the origin, then the up axis, then the scale about the new origin.

    Raises:
        UserError: a value is invalid, or the photos do not determine the scale.
    """
    _check_combination(wanted)
    estimate = _estimate(capture, wanted)
    change = Similarity.identity()
    if wanted.origin is not None:
        change = moved_to_origin(capture.frames, wanted.origin)
    if wanted.up is not None:
        change = up_aligned(capture.frames, wanted.up).compose(change)
    factor = _factor(wanted.scale) if estimate is None else estimate.metres_per_unit
    if factor != 1:
        change = Similarity(factor, np.eye(3), np.zeros(3)).compose(change)
    moved = transformed(capture, change)
    if estimate is not None:
        moved = replace(moved, unit="metre", unit_source=_source(estimate))
    return Moved(moved, change, estimate)


def _check_combination(wanted: WorldFrame) -> None:
    given = {"--scale": wanted.scale, "--markers": wanted.markers, "--distance": wanted.distances or None}
    if len(named := [name for name, value in given.items() if value is not None]) > 1:
        raise UserError(f"{' and '.join(named)} cannot be combined", "give only one of them", exit_code=2)


def _source(estimate: ScaleEstimate) -> str:
    """Describe how the scale in metres was determined, with its relative error."""
    relative = None if estimate.standard_error is None else estimate.standard_error / estimate.metres_per_unit
    return estimate.source if relative is None else f"{estimate.source}, ± {100 * relative:.2g} %"


def _estimate(capture: Capture, wanted: WorldFrame) -> ScaleEstimate | None:
    if wanted.distances:
        return scale_from_distances([known_distance(text, capture.frames) for text in wanted.distances])
    frames = _with_photos(capture)
    if wanted.markers is not None:
        return _scale_from_markers([upright(frame, measure_of(capture)) for frame in frames], wanted.markers)
    if wanted.scale == GPS:
        return scale_from_gps(frames, gps_positions(frames))
    return None


def _with_photos(capture: Capture) -> list[Frame]:
    return [frame for frame in capture.frames if frame.has_photo]


def _scale_from_markers(frames: Sequence[Frame], text: str) -> ScaleEstimate:
    dictionary, *numbers = text.split(":")
    try:
        if len(numbers) == 1:
            return scale_from_markers(frames, float(numbers[0]), dictionary=dictionary)
        size, square, marker, *more = numbers
        if more not in ([], ["legacy"]):
            raise ValueError(more)
        columns, rows = (int(part) for part in size.split("x"))
        board = CharucoBoard(columns, rows, float(square), float(marker), dictionary, legacy=bool(more))
        return scale_from_charuco(frames, board)
    except ValueError as error:
        raise UserError(
            f"invalid --markers {text!r}",
            "expected markers DICT_4X4_50:0.05, or a ChArUco board DICT_5X5_100:7x5:0.04:0.03, sides in metres",
            exit_code=2,
        ) from error


def _factor(text: str | None) -> float:
    if text is None:
        return 1.0
    try:
        factor = float(text)
    except ValueError:
        factor = 0.0
    if not SMALLEST_SCALE <= factor <= 1 / SMALLEST_SCALE:
        hint = f"expected a number from {SMALLEST_SCALE:g} to {1 / SMALLEST_SCALE:g}, or gps"
        raise UserError(f"invalid --scale {text!r}", hint, exit_code=2)
    return factor
