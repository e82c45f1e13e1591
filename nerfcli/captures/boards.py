"""Scale from ArUco markers and ChArUco boards in the photos, found with OpenCV."""

import math
from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.layout import nearest_to_rays
from nerfcli.captures.scale import ScaleEstimate
from nerfcli.errors import UserError, several
from nerfcli.photos.images import read_image

# A corner is used if two of its directions differ by at least this; with less, its depth is hardly known.
_LEAST_PARALLAX = np.radians(1.0)

# Corners whose rays miss each other by more than this are wrong: the pattern was moved, or there are two of it.
_MOST_MISSED_PX = 5.0

# For normal errors: standard deviation / median absolute deviation, and standard error of the median / of the mean.
_SIGMA_PER_MAD = 1.4826
_MEDIAN_PER_MEAN = 1.2533


@dataclass(frozen=True)
class Side:
    """Two corners of a printed pattern and their true distance in metres; `name` is for people."""

    name: str
    first: Hashable
    second: Hashable
    metres: float


# Sightings of each corner, by any key: the frame's index, and the pixel (x, y) with pixel centres at 0.5.
Sightings = Mapping[Any, Sequence[tuple[int, np.ndarray]]]


def scale_from_corners(
    frames: Sequence[Frame], sightings: Sightings, sides: Sequence[Side], *, pattern: str
) -> ScaleEstimate:
    """Estimate metres per unit: the median over all sides of their known length divided by their triangulated length.

    The standard error is that of the median of as many independent errors as there are sides, with their spread from
    the median absolute deviation: a corner's error along one side of a square does not affect the adjacent side. It
    excludes errors that all sides share, such as from a wrong focal length. Residuals are means over sides of one name.

    Args:
        pattern: its description for messages and the source, such as "ArUco markers of 0.05 m".

    Raises:
        UserError: no side has two corners seen in two photos, in directions that differ enough, whose rays meet.
    """
    points, reasons = triangulate(frames, sightings)
    measured_sides = [side for side in sides if side.first in points and side.second in points]
    lengths = np.array([np.linalg.norm(points[side.first] - points[side.second]) for side in measured_sides])
    if not len(lengths) or not lengths.min() > 0:
        raise _no_scale(pattern, sightings, list(reasons.values()))
    metres = np.array([side.metres for side in measured_sides])
    scale = float(np.median(metres / lengths))
    deviation = _SIGMA_PER_MAD * float(np.median(np.abs(metres / lengths - scale)))
    named: dict[str, list[float]] = {}
    for side, ratio in zip(measured_sides, scale * lengths / metres, strict=True):
        named.setdefault(side.name, []).append(100 * (float(ratio) - 1))
    return ScaleEstimate(
        metres_per_unit=scale,
        standard_error=_MEDIAN_PER_MEAN * deviation / math.sqrt(len(measured_sides)),
        residuals=tuple((name, float(np.mean(values))) for name, values in named.items()),
        residual_unit="percent",
        source=f"{pattern}, {len(measured_sides)} sides",
    )


def triangulate(frames: Sequence[Frame], sightings: Sightings) -> tuple[dict[Any, np.ndarray], dict[Any, str]]:
    """Return the points (3,) that photos show in several places, and why the others cannot be triangulated."""
    found = {corner: _triangulated(rays) for corner, rays in _rays(frames, sightings).items()}
    points = {corner: point for corner, point in found.items() if not isinstance(point, str)}
    return points, {corner: reason for corner, reason in found.items() if isinstance(reason, str)}


def _rays(frames: Sequence[Frame], sightings: Sightings) -> dict[Any, list[tuple[Frame, np.ndarray]]]:
    """Return, for each corner, the frames that see it and the unit directions (3,) in which their cameras do."""
    pixels: dict[int, list[tuple[Any, np.ndarray]]] = {}
    for corner, seen in sightings.items():
        for index, pixel in seen:
            pixels.setdefault(index, []).append((corner, pixel))
    rays: dict[Any, list[tuple[Frame, np.ndarray]]] = {corner: [] for corner in sightings}
    for index, found in pixels.items():
        # All pixels of a lens at once: one by one takes twenty times as long.
        directions, valid = frames[index].camera.bearings(np.array([pixel for _, pixel in found]))
        for (corner, _), direction, there in zip(found, directions, valid, strict=True):
            if there:
                rays[corner].append((frames[index], direction))
    return rays


def _triangulated(rays: Sequence[tuple[Frame, np.ndarray]]) -> np.ndarray | str:
    """Return the point (3,) where the rays meet, or the reason why there is none."""
    if len({frame.name for frame, _ in rays}) < 2:
        return "visible in only one photo"
    c = np.stack([frame.centre for frame, _ in rays])
    d = np.stack([frame.world_from_cam[:3, :3] @ direction for frame, direction in rays])
    f = np.array([frame.camera.focal_px for frame, _ in rays])
    if (d @ d.T).min() > np.cos(_LEAST_PARALLAX):
        return "visible only from nearly the same direction"
    point, missed = nearest_in_pixels(c, d, f)
    if np.median(missed) > _MOST_MISSED_PX:
        return f"its rays miss each other by {np.median(missed):.1f} px"
    if np.median(np.sum((point - c) * d, axis=1)) <= 0:
        return "its rays intersect behind the cameras"
    return point


def nearest_in_pixels(c: np.ndarray, d: np.ndarray, f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the point (3,) nearest to rays in terms of pixels, and by how many pixels each ray misses it, (n,).

    p = argmin sum_i log(1 + e_i^2),  e_i = f_i |(1 - d_i d_i^T) (p - c_i)| / |p - c_i|

    The errors e_i are in pixels; the logarithm (Cauchy) limits the effect of a wrong ray.

    Args:
        c, d: (n, 3) origins and unit directions, n >= 2, not all parallel.
        f: (n,) pixels per radian.
    """

    def pixels_per_length(offsets: np.ndarray) -> np.ndarray:
        return f / np.maximum(np.linalg.norm(offsets, axis=1), 1e-150)

    def weigh(off: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        squared = pixels_per_length(offsets) ** 2
        return squared / (1 + squared * off**2)

    point = nearest_to_rays(c, d, weigh)
    off = np.linalg.norm(np.cross(d, point - c), axis=1)
    return point, pixels_per_length(point - c) * off


def _no_scale(pattern: str, sightings: Sightings, reasons: Sequence[str]) -> UserError:
    if not sightings:
        return UserError(
            f"no photo shows the {pattern}",
            "check the dictionary and the size, and that the pattern is large enough in the photos",
        )
    photos = len({index for seen in sightings.values() for index, _ in seen})
    most = max(set(reasons), key=reasons.count) if reasons else "no side has two triangulated corners"
    return UserError(
        f"no scale from the {pattern} in {several(photos, 'photo')}: {len(reasons)} of {len(sightings)}"
        f" corners cannot be triangulated, mostly {most}",
        "the pattern must not move, and at least two photos must show it from different directions",
    )


# Profiles across an edge: their number, the part of the edge that they cover, and their sampling step in pixels.
_PROFILES = 48
_PART = (0.1, 0.9)
_STEP_PX = 0.25

# Reach of profiles to both sides: as a fraction of the edge, well within the dark rim (1/9 in a 7x7 marker), because
# blur brings in light from behind the rim; and its limits in pixels.
_REACH = 1 / 12
_REACH_PX = (1.5, 8.0)

# Number of rounds: profiles must be centred on the edge to be unbiased, so each round starts from the last lines.
_ROUNDS = 4

# Least contrast across an edge in grey levels of 255, and least number of the 48 profiles that must show the edge.
_LEAST_CONTRAST = 20.0
_LEAST_PROFILES = 12
# OpenCV puts the centre of the top-left pixel at (0, 0).
_OPENCV_PIXEL_CENTRE = 0.5


def refine_corners(grey: np.ndarray, corners: np.ndarray) -> np.ndarray | None:
    """Return the corners of a dark square on white, to a few hundredths of a pixel; None if an edge is not visible.

    On each profile across an edge, the edge is at the mean position of the rise in brightness. A line is fitted to
    these positions, and neighbouring lines intersect in the corners.

    Args:
        grey: (H, W) uint8.
        corners: (4, 2) approximate, in either sense of rotation; pixel centres at whole numbers, as in OpenCV.

    Returns:
        (4, 2) float64, in the same order.
    """
    corners = np.asarray(corners, dtype=np.float64)
    start = corners
    for _ in range(_ROUNDS):
        lines = [_edge(grey, corners[k], corners[(k + 1) % 4], corners.mean(axis=0)) for k in range(4)]
        found = np.array([line for line in lines if line is not None])
        if len(found) < 4:
            return None
        # A corner is where its own edge meets the one before: rows [normal, offset] of n . p = offset.
        pairs = np.stack([found, np.roll(found, 1, axis=0)], axis=1)
        if np.abs(np.linalg.det(pairs[:, :, :2])).min() < 0.05:
            return None
        corners = np.linalg.solve(pairs[:, :, :2], pairs[:, :, 2:])[..., 0]
    side = np.linalg.norm(start - np.roll(start, 1, axis=0), axis=1).mean()
    return corners if np.abs(corners - start).max() < max(_REACH_PX[0], 2 * _REACH * side) else None


def _edge(grey: np.ndarray, a: np.ndarray, b: np.ndarray, middle: np.ndarray) -> np.ndarray | None:
    """Return the line [nx, ny, offset] of the edge from a to b of a dark square around `middle`, if visible."""
    length = float(np.linalg.norm(b - a))
    if length < 1:
        return None
    along = (b - a) / length
    outwards = np.array([along[1], -along[0]])
    outwards *= np.sign(outwards @ ((a + b) / 2 - middle)) or 1.0
    reach = float(np.clip(_REACH * length, *_REACH_PX))
    across = np.arange(-reach, reach + _STEP_PX / 2, _STEP_PX)
    feet = a + np.linspace(*_PART, _PROFILES)[:, None] * (b - a)
    places = (feet[:, None, :] + across[:, None] * outwards).astype(np.float32)
    profiles = cv2.remap(grey, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    rises = np.clip(np.diff(profiles.astype(np.float64), axis=1), 0.0, None)
    contrast = rises.sum(axis=1)
    seen = contrast >= max(_LEAST_CONTRAST, 0.5 * float(np.median(contrast)))
    if seen.sum() < _LEAST_PROFILES:
        return None
    between = (across[:-1] + across[1:]) / 2
    points = feet[seen] + (rises[seen] @ between / contrast[seen])[:, None] * outwards
    near = np.ones(len(points), dtype=bool)
    line = np.zeros(3)
    for _ in range(2):
        mean = points[near].mean(axis=0)
        normal = np.linalg.svd(points[near] - mean)[2][1]
        line = np.array([*normal, normal @ mean])
        off = np.abs(points @ normal - line[2])
        near = off <= 3 * _SIGMA_PER_MAD * np.median(off) + 1e-3
    return line


@dataclass(frozen=True)
class CharucoBoard:
    """A chessboard with ArUco markers in its white squares.

    Args:
        columns, rows: squares across and down.
        square, marker: length of their sides in metres.
        dictionary: OpenCV's name, such as DICT_5X5_100.
        legacy: True for boards of OpenCV before 4.6, whose first square is white if the number of rows is even.
    """

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str
    legacy: bool = False

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 2:
            hint = "it needs at least 2x2 squares"
            raise UserError(f"invalid ChArUco board of {self.columns}x{self.rows} squares", hint)
        if not 0 < self.marker < self.square < np.inf:
            what = f"invalid ChArUco board with squares of {self.square:g} m and markers of {self.marker:g} m"
            raise UserError(what, "expected positive lengths in metres, with markers smaller than squares")


def scale_from_markers(frames: Sequence[Frame], side: float, *, dictionary: str) -> ScaleEstimate:
    """Estimate metres per unit from ArUco markers, each of which is in the scene once; see `scale_from_corners`.

    In a given photo, a marker is not used if it appears twice or its edges are not visible.

    Args:
        frames: with cameras that fit the photos on disk, see `orientation.upright`.
        side: length of the black square's side in metres.
        dictionary: OpenCV's name, such as DICT_4X4_50.
    """
    if not 0 < side < np.inf:
        raise UserError(f"invalid side length of markers: {side:g} m", "expected a positive length in metres")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX  # near enough for `refine_corners`
    detector = cv2.aruco.ArucoDetector(_dictionary(dictionary), parameters)
    sightings: dict[Hashable, list[tuple[int, np.ndarray]]] = {}
    found: set[int] = set()
    for index, grey in _photos(frames):
        corners, numbers, _ = detector.detectMarkers(grey)
        numbers = [] if numbers is None else [int(number) for number in np.ravel(numbers)]
        times = Counter(numbers)
        found |= set(numbers)
        for number, four in zip(numbers, corners, strict=True):
            pixels = refine_corners(grey, np.reshape(four, (4, 2))) if times[number] == 1 else None
            for k, pixel in enumerate(() if pixels is None else pixels):
                sightings.setdefault((number, k), []).append((index, pixel + _OPENCV_PIXEL_CENTRE))
    sides = [
        Side(f"marker {number}", (number, k), (number, (k + 1) % 4), side) for number in sorted(found) for k in range(4)
    ]
    return scale_from_corners(frames, sightings, sides, pattern=f"ArUco markers ({dictionary}, {side:g} m)")


def scale_from_charuco(frames: Sequence[Frame], board: CharucoBoard) -> ScaleEstimate:
    """Estimate metres per unit from all neighbouring inner corners of a ChArUco board; see `scale_from_corners`."""
    dictionary = _dictionary(board.dictionary)
    if board.columns * board.rows // 2 > len(dictionary.bytesList):
        raise UserError(
            f"{board.dictionary} has only {len(dictionary.bytesList)} markers, but a board of {board.columns}x"
            f"{board.rows} squares needs {board.columns * board.rows // 2}",
            "give the dictionary of the board",
        )
    size = (board.columns, board.rows)
    printed = cv2.aruco.CharucoBoard(size, board.square, board.marker, dictionary)
    printed.setLegacyPattern(board.legacy)
    detector = cv2.aruco.CharucoDetector(printed)
    sightings: dict[Hashable, list[tuple[int, np.ndarray]]] = {}
    for index, grey in _photos(frames):
        corners, numbers, _, _ = detector.detectBoard(grey)
        if numbers is None or corners is None:
            continue
        for number, pixel in zip(np.ravel(numbers).tolist(), np.reshape(corners, (-1, 2)), strict=True):
            sightings.setdefault(number, []).append((index, pixel + _OPENCV_PIXEL_CENTRE))
    across, down = board.columns - 1, board.rows - 1  # inner corners, numbered row by row
    right = [(n, n + 1) for n in range(across * down) if (n + 1) % across]
    below = [(n, n + across) for n in range(across * (down - 1))]
    sides = [Side(f"corners {a} and {b}", a, b, board.square) for a, b in right + below]
    pattern = f"ChArUco board ({board.columns}x{board.rows}, {board.dictionary}, {board.square:g} m)"
    return scale_from_corners(frames, sightings, sides, pattern=pattern)


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    dictionaries = sorted(key for key in vars(cv2.aruco) if key.startswith("DICT_"))
    if name not in dictionaries:
        raise UserError(f"unknown dictionary of markers {name!r}", f"OpenCV has {', '.join(dictionaries)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _photos(frames: Sequence[Frame]) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the index and grey picture (H, W) uint8 of each frame, whose camera is for the photo as it is on disk."""
    for index, frame in enumerate(frames):
        assert frame.image is not None
        picture = read_image(frame.image)
        assert picture.shape[1::-1] == frame.camera.size, "see orientation.upright"
        yield index, cv2.cvtColor(np.ascontiguousarray(picture[..., :3]), cv2.COLOR_RGB2GRAY)
