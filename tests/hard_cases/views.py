"""Rotations near 0 and pi, lenses beyond where they can be inverted, fisheye at 90 degrees and beyond."""

import math
import time
from collections.abc import Iterator

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.kernels.selftest.measure import Errors, Row, largest_error

UNIT = 2.0**-53
TINY = float(np.finfo(np.float64).tiny)


AXES = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (2 / 3, -1 / 3, 2 / 3), (0.6, 0.0, 0.8))
NEAR_ZERO = (0.0, 1e-300, 1e-12, 1e-8, 1e-4, 9e-3, 0.1)
NEAR_PI = (math.pi - 1e-3, math.pi - 1e-7, math.pi - 1e-12, math.pi)


def rows() -> Iterator[Row]:
    """Yield the rows of all camera operations, in float64."""
    yield from _exp_rows()
    yield from _log_rows()
    yield from _lens_rows()
    yield _fisheye_row()


def _vectors(angles: tuple[float, ...]) -> np.ndarray:
    return np.array([angle * axis for angle in angles for axis in np.array(AXES)])


def _rodrigues(vector: np.ndarray, smallest_square: float = 0.0) -> np.ndarray:
    """Return R = 1 + sin(a) / a W + (1 - cos a) / a^2 W^2, with 1 - cos a as 2 sin^2(a / 2)."""
    square = max(float(vector @ vector), smallest_square)
    angle = math.sqrt(square)
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    first, second = (math.sin(angle) / angle, 2 * (math.sin(angle / 2) / angle) ** 2) if angle else (1.0, 0.5)
    return np.eye(3) + first * cross + second * (cross @ cross)


def _exp_rows() -> Iterator[Row]:
    for name, angles in (("rotations near 0", NEAR_ZERO), ("rotations near pi", NEAR_PI)):
        vectors = _vectors(angles)
        wanted = np.array([_rodrigues(vector) for vector in vectors])
        start = time.perf_counter()
        got = rigid.rotation_from_vector(vectors)
        seconds = time.perf_counter() - start
        clamped = np.array([_rodrigues(vector, 1e-4) for vector in vectors])
        # Off-diagonal errors are relative to the angle, not to 1: those entries vanish with the rotation.
        sizes = np.maximum(np.linalg.norm(vectors, axis=1), TINY)[:, None, None]

        def error(rotations: np.ndarray, wanted: np.ndarray = wanted, sizes: np.ndarray = sizes) -> float:
            off = rotations - wanted
            diagonal = np.abs(np.diagonal(off, axis1=1, axis2=2)).max(initial=0.0)
            off[:, range(3), range(3)] = 0.0
            return max(float(diagonal), float((np.abs(off) / sizes).max()))

        yield Row(
            case=name,
            operation="rotation_from_vector",
            precision="float64",
            errors=Errors(error(got)),
            bounds=Errors(8 * UNIT),
            reason="8 roundings u: of the diagonal, and of the rest relative to the angle",
            formula="Rodrigues with the squared angle clamped at 1e-4",
            textbook=Errors(error(clamped)),
            seconds=seconds,
        )


def _log_rows() -> Iterator[Row]:
    for name, angles in (("logarithm near 0", NEAR_ZERO), ("logarithm near pi", NEAR_PI)):
        vectors = _vectors(angles)
        rotations = np.array([_rodrigues(vector) for vector in vectors])
        start = time.perf_counter()
        got = rigid.vector_from_rotation(rotations)
        seconds = time.perf_counter() - start

        def error(found: np.ndarray, vectors: np.ndarray = vectors) -> float:
            # At pi an axis and its opposite are the same rotation.
            off = np.minimum(np.linalg.norm(found - vectors, axis=1), _around(found, vectors))
            size = np.maximum(np.linalg.norm(vectors, axis=1), TINY)
            return float(np.where(np.isnan(off), np.inf, off / size).max())

        yield Row(
            case=name,
            operation="vector_from_rotation",
            precision="float64",
            errors=Errors(error(got)),
            bounds=Errors(16 * UNIT),
            reason="16 roundings u of the angle: the half angle by atan2 of the quaternion's parts",
            formula="acos((trace - 1) / 2)",
            textbook=Errors(error(np.array([_log_by_acos(rotation) for rotation in rotations]))),
            seconds=seconds,
        )


def _around(found: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return the distance of rotation vectors if `found` turns the other way around; inf for angles up to 3."""
    angle = np.linalg.norm(found, axis=1, keepdims=True)
    other = found - 2 * math.pi * found / np.where(angle > 0, angle, 1.0)
    return np.where(angle[:, 0] > 3, np.linalg.norm(other - vectors, axis=1), np.inf)


def _log_by_acos(rotation: np.ndarray) -> np.ndarray:
    cosine = (np.trace(rotation) - 1) / 2
    if not -1 <= cosine <= 1:
        return np.full(3, math.nan)  # acos raises
    angle = math.acos(cosine)
    skew = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return skew / 2 * (angle / math.sin(angle) if angle > 0 else 1.0)


def _lens_rows() -> Iterator[Row]:
    """Measure a barrel lens, k1 = -0.3, whose radius stops growing at 46.5 degrees from the axis."""
    focal, k = 500.0, -0.3
    camera = Camera("OPENCV", 2000, 2000, (focal, focal, 1000.0, 1000.0, k, 0.0, 0.0, 0.0))
    turn = math.sqrt(-1 / (3 * k))
    # Distorted radii r = rho + k rho^3 of known rho, so that the inverse is known.
    inside = np.linspace(0.01, 0.999, 200) * turn
    images = inside * (1 + k * inside**2)
    start = time.perf_counter()
    directions, valid = camera.bearings(np.stack([1000 + focal * images, np.full(200, 1000.0)], axis=1))
    seconds = time.perf_counter() - start
    got = np.where(valid, directions[:, 0] / directions[:, 2], np.nan)
    conditioning = float((images / inside / (1 + 3 * k * inside**2)).max())
    yield Row(
        case="undistortion up to where the lens turns back",
        operation="Camera.bearings",
        precision="float64",
        errors=Errors(largest_error(got, inside.tolist(), tiny=TINY)),
        bounds=Errors(32 * UNIT * conditioning * 1000 / (focal * float(images[0]))),
        reason="32 u of the pixel, as much magnified as the lens magnifies there",
        formula="10 steps of Newton from the pixel",
        textbook=Errors(largest_error(_newton(images, k), inside.tolist(), tiny=TINY)),
        seconds=seconds,
    )
    beyond = np.array([1.1, 1.2, 1.5, 1.8])
    points = np.stack([beyond, np.zeros(4), np.ones(4)], axis=1)
    too_far = np.array([turn * (1 + k * turn**2) * factor for factor in (1.0001, 1.01, 1.5, 100.0)])
    start = time.perf_counter()
    _, seen = camera.project(points)
    _, found = camera.bearings(np.stack([1000 + focal * too_far, np.full(4, 1000.0)], axis=1))
    seconds = time.perf_counter() - start
    yield Row(
        case="undistortion beyond where the lens turns back",
        operation="Camera.project, Camera.bearings",
        precision="float64",
        errors=Errors(float(np.concatenate([seen, found]).mean())),
        bounds=Errors(0.0),
        reason="share of pixels that get a direction where there is none: no wrong root",
        formula="10 steps of Newton from the pixel: another root",
        textbook=Errors(largest_error(_newton(beyond * (1 + k * beyond**2), k), beyond.tolist(), tiny=TINY)),
        seconds=seconds,
    )


def _newton(images: np.ndarray, k: float) -> np.ndarray:
    radius = images.copy()
    for _ in range(10):
        radius = radius - (radius * (1 + k * radius**2) - images) / (1 + 3 * k * radius**2)
    return radius


def _fisheye_row() -> Row:
    """Measure an ideal fisheye (theta = pixel radius / focal length) at 60 to 179.9 degrees from the axis."""
    focal = 500.0
    camera = Camera("OPENCV_FISHEYE", 4000, 4000, (focal, focal, 2000.0, 2000.0, 0.0, 0.0, 0.0, 0.0))
    angles = np.radians([60.0, 89.0, 90.0, 90.0001, 91.0, 120.0, 150.0, 179.9])
    pixels = np.stack([2000 + focal * angles, np.full(len(angles), 2000.0)], axis=1)
    start = time.perf_counter()
    directions, valid = camera.bearings(pixels)
    seconds = time.perf_counter() - start
    wanted = np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], axis=1)
    tangents = np.tan(angles)
    plain = np.stack([tangents, np.zeros_like(angles), np.ones_like(angles)], axis=1) / np.hypot(tangents, 1)[:, None]
    got = np.where(valid[:, None], directions, np.nan)
    bound = 4 * UNIT * 4000 / focal
    return Row(
        case="fisheye at 90 degrees and beyond",
        operation="Camera.bearings",
        precision="float64",
        errors=Errors(largest_error(got, wanted.tolist(), tiny=1.0)),
        bounds=Errors(bound),
        reason="4 u of a pixel coordinate of 4000, over the focal length",
        formula="(tan theta, 1)",
        textbook=Errors(float(np.abs(plain - wanted).max())),
        seconds=seconds,
    )
