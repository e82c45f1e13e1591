"""Convert lenses as other programs describe them to COLMAP's camera models, with as few parameters as needed.

Notation: focal lengths fx, fy and principal point cx, cy in pixels; k radial, p tangential, in OpenCV's order.
"""

from nerfcli.cameras.camera import Camera
from nerfcli.captures.formats.limits import checked_camera

Pair = tuple[float, float]


def brown_camera(
    size: tuple[int, int],
    focal: Pair,
    centre: Pair,
    *,
    radial: tuple[float, float, float],
    tangential: Pair = (0.0, 0.0),
    where: str,
) -> Camera:
    """Return a perspective camera with Brown's distortion.

    With x = X/Z, y = Y/Z, r^2 = x^2 + y^2:
        u = fx (x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)) + cx
        v = fy (y (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p2 x y + p1 (r^2 + 2 y^2)) + cy

    Raises:
        UserError: invalid parameters of a camera; `where` is named.

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
    radial: tuple[float, float, float, float],
    tangential: Pair = (0.0, 0.0),
    prism: Pair = (0.0, 0.0),
    where: str,
) -> Camera:
    """Return a camera with equidistant projection and Brown's distortion, thin prisms (sx, sy) included.

    With R = sqrt(X^2 + Y^2), t = atan2(R, Z), x = t X/R, y = t Y/R, r^2 = x^2 + y^2:
        u = fx (x (1 + k1 r^2 + ... + k4 r^8) + 2 p1 x y + p2 (r^2 + 2 x^2) + sx r^2) + cx
        v = fy (y (1 + k1 r^2 + ... + k4 r^8) + 2 p2 x y + p1 (r^2 + 2 y^2) + sy r^2) + cy

    Raises:
        UserError: invalid parameters of a camera; `where` is named.

    Source: docs.opencv.org, "Fisheye camera model"; COLMAP src/colmap/sensor/models.h, ThinPrismFisheyeCameraModel.
    """
    if any(tangential) or any(prism):
        params = (*focal, *centre, *radial[:2], *tangential, *radial[2:], *prism)
        return checked_camera("THIN_PRISM_FISHEYE", *size, params, where=where)
    return checked_camera("OPENCV_FISHEYE", *size, (*focal, *centre, *radial), where=where)


def spherical_camera(size: tuple[int, int], where: str) -> Camera:
    """Return the camera of a panorama of the whole sphere: pixels are equal steps of longitude and latitude.

    Raises:
        UserError: the picture is not twice as wide as high, so it cannot show the whole sphere.
    """
    return checked_camera("EQUIRECTANGULAR", *size, (float(size[0]), float(size[1])), where=where)
