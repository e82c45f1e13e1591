"""Scale from ArUco markers and ChArUco boards in the photos, found with OpenCV."""

from collections import Counter
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.media.images import read_image
from nerfcli.scale.corners import Side, scale_from_corners
from nerfcli.scale.edges import refined_corners
from nerfcli.scale.estimate import ScaleEstimate

# OpenCV puts the centre of the top-left pixel at (0, 0).
_OPENCV_PIXEL_CENTRE = 0.5


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
            raise UserError(
                f"invalid ChArUco board of {self.columns}x{self.rows} squares", "it needs at least 2x2 squares"
            )
        if not 0 < self.marker < self.square < np.inf:
            raise UserError(
                f"invalid ChArUco board with squares of {self.square:g} m and markers of {self.marker:g} m",
                "expected positive lengths in metres, with markers smaller than squares",
            )


def scale_from_markers(frames: Sequence[Frame], side: float, *, dictionary: str) -> ScaleEstimate:
    """Estimate metres per unit from ArUco markers, each of which is in the scene once; see `scale_from_corners`.

    In a given photo, a marker is not used if it appears twice or its edges are not visible.

    Args:
        side: length of the black square's side in metres.
        dictionary: OpenCV's name, such as DICT_4X4_50.

    Raises:
        UserError: an unknown dictionary, an invalid side, a photo that cannot be read, or no marker that two photos
            show.
    """
    if not 0 < side < np.inf:
        raise UserError(f"invalid side length of markers: {side:g} m", "expected a positive length in metres")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX  # near enough for `refined_corners`
    detector = cv2.aruco.ArucoDetector(_dictionary(dictionary), parameters)
    sightings: dict[Hashable, list[tuple[int, np.ndarray]]] = {}
    found: set[int] = set()
    for index, grey in _photos(frames):
        corners, numbers, _ = detector.detectMarkers(grey)
        numbers = [] if numbers is None else [int(number) for number in np.ravel(numbers)]
        times = Counter(numbers)
        found |= set(numbers)
        for number, four in zip(numbers, corners, strict=True):
            pixels = refined_corners(grey, np.reshape(four, (4, 2))) if times[number] == 1 else None
            for k, pixel in enumerate(() if pixels is None else pixels):
                sightings.setdefault((number, k), []).append((index, pixel + _OPENCV_PIXEL_CENTRE))
    sides = [
        Side(f"marker {number}", (number, k), (number, (k + 1) % 4), side) for number in sorted(found) for k in range(4)
    ]
    return scale_from_corners(frames, sightings, sides, pattern=f"ArUco markers ({dictionary}, {side:g} m)")


def scale_from_charuco(frames: Sequence[Frame], board: CharucoBoard) -> ScaleEstimate:
    """Estimate metres per unit from all neighbouring inner corners of a ChArUco board; see `scale_from_corners`.

    Raises:
        UserError: an unknown dictionary or one with too few markers, a photo that cannot be read, or no corners that
            two photos show.
    """
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
    """Yield the index and grey picture (H, W) uint8 of each frame with a photo."""
    for index, frame in enumerate(frames):
        if frame.image is None:
            continue
        picture = read_image(frame.image)
        if picture.shape[:2] != (frame.camera.height, frame.camera.width):
            raise UserError(
                f"{frame.image} is {picture.shape[1]}x{picture.shape[0]} pixels, but its camera is for "
                f"{frame.camera.width}x{frame.camera.height}",
                "give the photos that belong to these cameras",
            )
        yield index, cv2.cvtColor(np.ascontiguousarray(picture[..., :3]), cv2.COLOR_RGB2GRAY)
