"""Projection through lenses without nerfcli's cameras: by OpenCV, or by pycolmap if OpenCV has no such lens.

It is the independent side in the verification of a conversion, so it shares no code with `cameras`. Pixel positions are
those of nerfcli: the centre of the top-left pixel is (0.5, 0.5); the formulas do not depend on it.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap

# After the principal point, their parameters are the first of OpenCV's distortion terms k1 k2 p1 p2 k3 k4 k5 k6.
# Source: docs.opencv.org calib3d, "Detailed Description"; colmap src/colmap/sensor/models.h.
_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FISHEYE = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
_ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


@dataclass(frozen=True)
class FileLens:
    """A lens as a file describes it, with COLMAP's name and order of parameters."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


def project(lens: FileLens, points_cam: np.ndarray) -> np.ndarray:
    """Return pixels (N, 2) of points (N, 3) in OpenCV camera axes; meaningless for points that the lens cannot see."""
    if not len(points_cam):
        return np.zeros((0, 2))
    points = np.ascontiguousarray(points_cam, dtype=np.float64)[:, None]
    if lens.model in _PERSPECTIVE:
        matrix, terms = _matrix_and_terms(lens)
        distortion = np.zeros(8)
        distortion[: len(terms)] = terms
        pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
    elif lens.model in _FISHEYE:
        pixels = _fisheye_pixels(lens, points[:, 0])
    else:
        camera = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
        pixels = np.asarray(camera.img_from_cam(points[:, 0], check_cheirality=False))
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def _matrix_and_terms(lens: FileLens) -> tuple[np.ndarray, tuple[float, ...]]:
    """Return OpenCV's camera matrix (3, 3) and distortion terms."""
    fx, fy, cx, cy = lens.params[:1] * 2 + lens.params[1:3] if lens.model in _ONE_FOCAL else lens.params[:4]
    terms = lens.params[3:] if lens.model in _ONE_FOCAL else lens.params[4:]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), terms


def _fisheye_pixels(lens: FileLens, points: np.ndarray) -> np.ndarray:
    """Return pixels of the equidistant fisheye, theta_d = theta (1 + k1 theta^2 + ... + k4 theta^8), at any angle.

    cv2.fisheye.projectPoints has the same formula, but divides by z and therefore ends at 90 degrees.
    """
    matrix, terms = _matrix_and_terms(lens)
    across = np.hypot(points[:, 0], points[:, 1])
    theta = np.arctan2(across, points[:, 2])
    bent = theta * (1 + sum(term * theta ** (2 * power) for power, term in enumerate(terms, start=1)))
    scale = np.divide(bent, across, out=np.zeros_like(bent), where=across > 0)
    return (points[:, :2] * scale[:, None]) @ matrix[:2, :2].T + matrix[:2, 2]
