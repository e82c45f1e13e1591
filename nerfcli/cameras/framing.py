"""Change the size, crop or lens of a camera's picture, without ever stretching it.

Notation: the camera's picture is w x h; the new picture is W x H.
"""

import math
from dataclasses import replace

from nerfcli.cameras.camera import Camera
from nerfcli.errors import UserError

LENSES = ("pinhole", "fisheye", "equirectangular")


def sized(camera: Camera, width: int | None, height: int | None) -> Camera:
    """Return the camera of the picture resized to another size.

    If only one of width and height is given, the other follows from the aspect ratio. Where the aspect ratio changes,
    the scaled picture covers the new one and is cropped evenly on two sides: the scale is s = max(W / w, H / h), and
    the principal point moves by (W - s w) / 2 and (H - s h) / 2.
    """
    if width is None and height is None:
        return camera
    if width is None:
        assert height is not None
        width = max(1, round(camera.width * height / camera.height))
    elif height is None:
        height = max(1, round(camera.height * width / camera.width))
    if camera.is_spherical:
        return equirectangular(width, height)
    scale = max(width / camera.width, height / camera.height)
    names = ("f", "fx", "fy", "cx", "cy")
    scaled = camera.with_values({name: scale * value for name, value in camera.values.items() if name in names})
    covering = replace(scaled, width=width, height=height)
    return covering.shifted((width - scale * camera.width) / 2, (height - scale * camera.height) / 2)


def cropped(camera: Camera, x: int, y: int, width: int, height: int) -> Camera:
    """Return the camera of a crop of the picture: left and top edge, width and height in pixels.

    Raises:
        UserError: the crop is empty or extends beyond the picture, or the picture is equirectangular.
    """
    if camera.is_spherical:
        raise UserError("an equirectangular picture cannot be cropped", "remove --crop", exit_code=2)
    inside = min(x, y) >= 0 and min(width, height) >= 1 and x + width <= camera.width and y + height <= camera.height
    if not inside:
        what = f"--crop {x},{y},{width},{height} is not inside a picture of {camera.width}x{camera.height}"
        hint = "give X,Y,WIDTH,HEIGHT in pixels from the top-left corner, after --width and --height are applied"
        raise UserError(what, hint, exit_code=2)
    return replace(camera, width=width, height=height).shifted(-x, -y)


def with_lens(camera: Camera, lens: str, fov_deg: float | None) -> Camera:
    """Return a camera with another lens for the picture's size, its axis through the picture's centre.

    pinhole: focal length (w / 2) / tan(fov / 2), or the camera's own. fisheye: equidistant, radius = focal length *
    angle, focal length w / fov with fov in radians, 180 degrees if not given. equirectangular: the whole sphere, in
    a picture of the same height, twice as wide.

    Args:
        fov_deg: angle between the left and right edge in degrees; None for the default of the lens.
    """
    width, height = camera.width, camera.height
    if lens == "equirectangular":
        if fov_deg is not None:
            what = "--fov cannot be used with equirectangular pictures, which cover 360 degrees"
            raise UserError(what, "remove --fov", exit_code=2)
        return equirectangular(2 * height, height)
    most = 179.0 if lens == "pinhole" else 360.0
    if fov_deg is not None and not 0 < fov_deg <= most:  # True at NaN
        hint = f"expected degrees above 0 and up to {most:g}"
        raise UserError(f"--fov {fov_deg:g} is out of range for a {lens} lens", hint, exit_code=2)
    if lens == "fisheye":
        focal_px = width / math.radians(180.0 if fov_deg is None else fov_deg)
        return Camera("SIMPLE_FISHEYE", width, height, (focal_px, width / 2, height / 2))
    if fov_deg is not None:
        return Camera.pinhole(width, height, width / 2 / math.tan(math.radians(fov_deg) / 2))
    return camera.undistorted()


def equirectangular(width: int, height: int) -> Camera:
    """Return the camera of an equirectangular picture, which covers all directions.

    Raises:
        UserError: the width is not twice the height, which would stretch the picture.
    """
    if width != 2 * height:
        hint = "its width must be twice its height; give only an even --width, or only --height"
        raise UserError(f"invalid size of an equirectangular picture: {width}x{height}", hint, exit_code=2)
    return Camera("EQUIRECTANGULAR", width, height, (width, height))
