"""Convert lenses as other programs describe them to COLMAP's camera models, with as few parameters as needed.

Notation: focal lengths fx, fy and principal point cx, cy in pixels; k radial, p tangential, in OpenCV's order.

Calibrations of other programs have terms that no lens here has: skew, a fourth radial term, or tangential terms that
grow with the radius. Mostly they move no pixel by a tenth of its width once the other terms are fitted to them; if they
do, the lens is refused.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.distortion import Distortion
from nerfcli.cameras.frame import Size
from nerfcli.cameras.lens import Lens
from nerfcli.cameras.projections import Equidistant, Perspective
from nerfcli.captures.formats.fields import malformed
from nerfcli.captures.formats.limits import checked_camera
from nerfcli.errors import listed, several

Pair = tuple[float, float]


def brown_camera(
    size: tuple[int, int],
    focal: Pair,
    centre: Pair,
    *,
    radial: Sequence[float],
    tangential: Sequence[float] = (0.0, 0.0),
    where: str,
) -> Camera:
    """Return a perspective camera with Brown's distortion, k1 to k3.

    With x = X/Z, y = Y/Z, r^2 = x^2 + y^2:
        u = fx (x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)) + cx
        v = fy (y (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p2 x y + p1 (r^2 + 2 y^2)) + cy

    Source: docs.opencv.org, "Camera Calibration and 3D Reconstruction".
    """
    k1, k2, k3 = radial
    if k3:
        return checked_camera(
            "FULL_OPENCV", *size, (*focal, *centre, k1, k2, *tangential, k3, 0.0, 0.0, 0.0), where=where
        )
    if any(tangential) or (focal[0] != focal[1] and (k1 or k2)):
        return checked_camera("OPENCV", *size, (*focal, *centre, k1, k2, *tangential), where=where)
    if k2:
        return checked_camera("RADIAL", *size, (focal[0], *centre, k1, k2), where=where)
    if k1:
        return checked_camera("SIMPLE_RADIAL", *size, (focal[0], *centre, k1), where=where)
    return checked_camera("PINHOLE", *size, (*focal, *centre), where=where)


def fisheye_camera(
    size: tuple[int, int],
    focal: Pair,
    centre: Pair,
    *,
    radial: Sequence[float],
    tangential: Sequence[float] = (0.0, 0.0),
    prism: Pair = (0.0, 0.0),
    where: str,
) -> Camera:
    """Return a camera with equidistant projection and Brown's distortion, k1 to k4, thin prisms (sx, sy) included.

    With R = sqrt(X^2 + Y^2), t = atan2(R, Z), x = t X/R, y = t Y/R, r^2 = x^2 + y^2:
        u = fx (x (1 + k1 r^2 + ... + k4 r^8) + 2 p1 x y + p2 (r^2 + 2 x^2) + sx r^2) + cx
        v = fy (y (1 + k1 r^2 + ... + k4 r^8) + 2 p2 x y + p1 (r^2 + 2 y^2) + sy r^2) + cy

    Source: docs.opencv.org, "Fisheye camera model"; COLMAP src/colmap/sensor/models.h, ThinPrismFisheyeCameraModel.
    """
    if any(tangential) or any(prism):
        params = (*focal, *centre, *radial[:2], *tangential, *radial[2:], *prism)
        return checked_camera("THIN_PRISM_FISHEYE", *size, params, where=where)
    return checked_camera("OPENCV_FISHEYE", *size, (*focal, *centre, *radial), where=where)


# The largest distance of a pixel that is accepted.
MOST_OFF_PX = 0.1
# A fit that is better is not improved by further terms.
_GOOD_PX = 0.01
# Skew counts as rounding if it shifts the bottom of the picture by at most this much against its top.
_NEGLIGIBLE_SKEW_PX = 0.02


class Terms(NamedTuple):
    """The terms of a lens. With x', y' as in `brown_camera` or `fisheye_camera`, and tx, ty their tangential part:

        u = fx (x' + tx (p3 r^2 + p4 r^4)) + skew y' + cx,  v = fy (y' + ty (p3 r^2 + p4 r^4)) + cy

    Args:
        radial: k1 to k4.
        tangential: p1 and p2 in OpenCV's order.
        growth: p3 and p4 of Metashape before version 1.6.
        skew: in pixels.
        skew_name: its name in the file.
    """

    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    tangential: Pair = (0.0, 0.0)
    growth: Pair = (0.0, 0.0)
    skew: float = 0.0
    skew_name: str = "skew"

    @property
    def beyond_fisheye(self) -> dict[str, float]:
        """The terms other than 0 that no fisheye here has, by name."""
        terms = {self.skew_name: self.skew, "p3": self.growth[0], "p4": self.growth[1]}
        return {name: value for name, value in terms.items() if value}

    @property
    def beyond_brown(self) -> dict[str, float]:
        """The terms other than 0 that no perspective lens here has, by name."""
        k4 = self.radial[3]
        return ({"k4": k4} if k4 else {}) | self.beyond_fisheye


def parts_of_matrix(matrix: np.ndarray, size: Size, where: str) -> tuple[Pair, Pair, float]:
    """Return the focal lengths, principal point and skew of a matrix of intrinsics, see `Fits.matrix`.

    A skew that counts as rounding is 0.

    Raises:
        UserError: the matrix is not of this form; `where` is named.
    """
    (fx, skew, cx), (lower, fy, cy), last = matrix.tolist()
    is_lower = abs(lower) * size[0] > _NEGLIGIBLE_SKEW_PX * abs(fx)  # more than rounding
    if not np.isfinite(matrix).all() or is_lower or last != [0, 0, 1]:
        raise malformed(where, "is not a matrix of intrinsics", "expected the rows fx 0 cx, 0 fy cy, 0 0 1")
    matters = abs(skew) * size[1] > _NEGLIGIBLE_SKEW_PX * abs(fy)
    return (fx, fy), (cx, cy), skew if matters else 0.0


class Fits:
    """Makes the cameras of a capture, and remembers how far each approximated lens is off."""

    def __init__(self) -> None:
        self._off: dict[tuple[str, str], list[float]] = {}

    def brown(self, size: Size, focal: Pair, centre: Pair, *, terms: Terms, where: str) -> Camera:
        """Return the perspective camera with these terms, or the one that fits them best.

        Raises:
            UserError: the best fit is off by more than `MOST_OFF_PX`; the terms and `where` are named.
        """
        radial, tangential = terms.radial[:3], terms.tangential
        plain = brown_camera(size, focal, centre, radial=radial, tangential=tangential, where=where)
        if not terms.beyond_brown:
            return plain
        params = (*focal, *centre, *radial[:2], *tangential, radial[2], 0, 0, 0)
        start = checked_camera("FULL_OPENCV", *size, params, where=where)
        return self._accepted(_best(plain, start, terms), terms.beyond_brown, where)

    def fisheye(self, size: Size, focal: Pair, centre: Pair, *, terms: Terms, where: str) -> Camera:
        """Return the equidistant camera with these terms, or the one that fits them best; errors as of `brown`."""
        radial, tangential = terms.radial, terms.tangential
        plain = fisheye_camera(size, focal, centre, radial=radial, tangential=tangential, where=where)
        if not terms.beyond_fisheye:
            return plain
        params = (*focal, *centre, *radial[:2], *tangential, *radial[2:], 0, 0)
        start = checked_camera("THIN_PRISM_FISHEYE", *size, params, where=where)
        return self._accepted(_best(plain, start, terms), terms.beyond_fisheye, where)

    def matrix(self, matrix: np.ndarray, size: Size, where: str) -> Camera:
        """Return the perspective camera of a matrix (3, 3) of intrinsics: fx, s, cx; 0, fy, cy; 0, 0, 1."""
        focal, centre, skew = parts_of_matrix(matrix, size, where)
        return self.brown(size, focal, centre, terms=Terms(skew=skew), where=where)

    def notes(self) -> tuple[str, ...]:
        """Return what was fitted and how far it is off, for people."""
        return tuple(
            f"{terms} of {several(len(off), 'camera')}, which {model} does not have: at most {max(off):.2g} px off"
            for (terms, model), off in self._off.items()
        )

    def _accepted(self, fitted: tuple[Camera, float], lost: dict[str, float], where: str) -> Camera:
        camera, off_px = fitted
        if not off_px <= MOST_OFF_PX:
            values = ", ".join(f"{name} is {value:g}" for name, value in lost.items())
            raise malformed(
                where,
                f"{values}, which no supported lens has, and the nearest one is off by {off_px:.2g} px",
                f"at most {MOST_OFF_PX:g} px is accepted; undistort the photos, or calibrate again without this term",
            )
        found = self._off.setdefault((listed(list(lost)), camera.model), [])
        if off_px not in found:
            found.append(off_px)
        return camera


@lru_cache(maxsize=1024)
def _best(plain: Camera, start: Camera, terms: Terms) -> tuple[Camera, float]:
    """Return the camera whose pixels are nearest to those of the terms, and the largest distance of a pixel.

    It is `plain` if that is good, else `start` with other distortion terms, by least squares over the picture: first
    the polynomial, then, of a perspective lens, its divisor, too.
    """
    directions, truth = _true_pixels(plain, terms)
    best, least = plain, _off_px(plain, directions, truth)
    camera = start
    for last in (9, 12):
        if least > _GOOD_PX and last <= len(start.params):
            camera = _fitted(camera, last, directions, truth)
            off_px = _off_px(camera, directions, truth)
            if off_px < 0.9 * least:
                best, least = camera, off_px
    return best, least


def _fitted(camera: Camera, last: int, directions: np.ndarray, truth: np.ndarray) -> Camera:
    """Return the camera with its parameters from the fifth to the `last` by least squares."""

    def moved(values: np.ndarray) -> Camera:
        return Camera(camera.model, *camera.size, (*camera.params[:4], *values.tolist(), *camera.params[last:]))

    def misses(values: np.ndarray) -> np.ndarray:
        pixels, seen = moved(values).project(directions)
        return np.where(seen[:, None], pixels - truth, 1e3).ravel()  # a direction without a pixel counts as far off

    def by_terms(values: np.ndarray) -> np.ndarray:
        _, by_parameters, _ = moved(values).project_jacobian(directions)
        return by_parameters[:, :, 4:last].reshape(truth.size, -1)

    start = np.array(camera.params[4:last])
    return moved(least_squares(misses, start, by_terms, method="lm", x_scale="jac", xtol=1e-12, ftol=1e-12).x)


def _true_pixels(plain: Camera, terms: Terms) -> tuple[np.ndarray, np.ndarray]:
    """Return directions (N, 3) over the picture, with its edges, and the pixels (N, 2) where the terms show them."""
    projection = Equidistant() if plain.model.endswith("FISHEYE") else Perspective()
    p1, p2 = terms.tangential
    distortion = Distortion(radial=terms.radial, tangential=(p2, p1))
    focal, centre = np.array(plain.focal_lengths)[:, None], np.array(plain.principal_point)[:, None]
    steps = [np.linspace(0.0, side, count) for side, count in zip(plain.size, (33, 25), strict=True)]
    grid = np.stack(np.meshgrid(*steps)).reshape(2, -1)
    directions, valid = Lens(projection, (distortion,), focal, centre, np.zeros((0, 0))).unproject(grid)
    plane = projection.plane(directions[:, valid])
    square = (plane**2).sum(axis=0)
    moved = distortion.apply(plane)
    tangential = Distortion(tangential=(p2, p1)).apply(plane) - plane
    moved += tangential * (terms.growth[0] * square + terms.growth[1] * square**2)
    pixels = moved * focal + centre
    pixels[0] += terms.skew * moved[1]
    return directions[:, valid].T, pixels.T


def _off_px(camera: Camera, directions: np.ndarray, truth: np.ndarray) -> float:
    """Return the largest distance of the pixels of directions from the true ones; infinite if one has no pixel."""
    pixels, seen = camera.project(directions)
    return float(np.linalg.norm(pixels - truth, axis=1).max()) if len(seen) and seen.all() else np.inf
