"""Camera models: from pixels to directions and back, through COLMAP's own lens models.

A model has COLMAP's name and COLMAP's order of parameters. The centre of the top-left pixel is (0.5, 0.5), and the
picture spans [0, width] x [0, height]. Camera axes are OpenCV's: +x right, +y down, +z forward.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pycolmap

from nerfcli.errors import UserError

# COLMAP warns through glog on stderr; what matters comes back as an exception or as NaN.
pycolmap.logging.minloglevel = 2

# A direction counts as the pixel's own only if it projects back onto it.
MAX_MISMATCH_PX = 1e-3

# COLMAP's undistortion stops at 1e-7 px or so; a Newton step on what is left brings it to rounding.
POLISH_ABOVE_PX = 1e-11


@dataclass(frozen=True)
class Camera:
    """A camera's intrinsics.

    Args:
        model: COLMAP's name: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, OPENCV_FISHEYE, ...
        width, height: of the picture in pixels.
        params: in COLMAP's order for the model, in pixels of this picture.

    Raises:
        UserError: an unknown model, a wrong number of parameters, or numbers that make no camera.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in pycolmap.CameraModelId.__members__ or self.model == "INVALID":
            raise UserError(
                f"unknown camera model {self.model!r}",
                f"expected one of COLMAP's: {', '.join(sorted(set(pycolmap.CameraModelId.__members__) - {'INVALID'}))}",
            )
        if self.width < 1 or self.height < 1:
            raise UserError(
                f"a camera of {self.width}x{self.height} pixels",
                "width and height must be whole numbers of at least 1",
            )
        object.__setattr__(self, "params", tuple(float(value) for value in self.params))
        names = parameter_names(self.model)
        if len(self.params) != len(names):
            raise UserError(
                f"camera model {self.model} has {len(names)} parameters, got {len(self.params)}",
                f"expected {', '.join(names)}, in this order",
            )
        focal = [self.params[i] for i in _colmap_camera(self).focal_length_idxs()]
        if not np.isfinite(self.params).all() or min(focal, default=1.0) <= 0:
            raise UserError(
                f"camera parameters {self.params} of model {self.model} make no camera",
                "focal lengths must be above 0 and every parameter a finite number",
            )

    @staticmethod
    def pinhole(width: int, height: int, focal_px: float) -> "Camera":
        """An ideal camera with square pixels and the principal point in the middle."""
        return Camera("PINHOLE", width, height, (focal_px, focal_px, width / 2, height / 2))

    @property
    def is_spherical(self) -> bool:
        """Whether the picture covers the whole sphere (EQUIRECTANGULAR), where there is no focal length."""
        return _colmap_camera(self).is_spherical()

    @property
    def focal_px(self) -> float:
        """Mean focal length in pixels; of a spherical picture the pixels per radian at its equator."""
        return self.width / (2 * np.pi) if self.is_spherical else _colmap_camera(self).mean_focal_length()

    @property
    def principal_point(self) -> tuple[float, float]:
        """Where the optical axis meets the picture, in pixels (x, y)."""
        index = _colmap_camera(self).principal_point_idxs()
        return (self.params[index[0]], self.params[index[1]]) if index else (self.width / 2, self.height / 2)

    @property
    def fov_deg(self) -> tuple[float, float]:
        """Angles (horizontal, vertical) in degrees between the picture's opposite edges, lens distortion included.

        They are measured through the principal point. An edge that the model cannot see counts as its last valid pixel.
        """
        if self.is_spherical:
            return 360.0, 180.0
        cx, cy = self.principal_point
        across = np.stack([np.linspace(0, self.width, 257), np.full(257, cy)], axis=-1)
        down = np.stack([np.full(257, cx), np.linspace(0, self.height, 257)], axis=-1)
        return self._opening_deg(across), self._opening_deg(down)

    def bearings(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The directions in which pixels see, through the true lens model.

        Args:
            pixels: (N, 2) positions x, y in pixels.

        Returns:
            directions (N, 3), unit, camera axes; valid (N,) bool. Where the model has no direction for a pixel (beyond
            the radius at which a distortion polynomial turns back, or beyond 90 degrees for the models that end
            there), valid is False and the direction (0, 0, 1). It is never NaN and never a wrong root.

        Accuracy: projecting a valid direction gives the pixel to 1e-9 px.
        """
        pixels = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 2)
        finite = np.asarray(np.isfinite(pixels).all(axis=1))
        if not finite.all():
            pixels = np.where(finite[:, None], pixels, 0.0)
        colmap = _colmap_camera(self)
        directions = np.asarray(colmap.cam_ray_from_img(pixels))
        mismatch = _mismatch_px(colmap, directions, pixels)
        for _ in range(3):
            coarse = np.flatnonzero((mismatch > POLISH_ABOVE_PX) & (mismatch < np.inf))
            if not len(coarse):
                break
            better = _newton_step(colmap, directions[coarse], pixels[coarse])
            mismatch_better = _mismatch_px(colmap, better, pixels[coarse])
            gain = mismatch_better < mismatch[coarse]
            directions[coarse[gain]] = better[gain]
            mismatch[coarse[gain]] = mismatch_better[gain]
        valid = finite & (mismatch < MAX_MISMATCH_PX) & self._within_domain(directions)
        directions[~valid] = (0.0, 0.0, 1.0)
        return directions, valid

    def project(self, points_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points appear in the picture.

        Args:
            points_cam: (N, 3) in camera axes.

        Returns:
            pixels (N, 2), which may lie outside the picture; valid (N,) bool. A point behind the camera, at its centre,
            or beyond the angle at which the lens model turns back has valid False and the pixel (0, 0), never NaN.
        """
        points_cam = np.ascontiguousarray(points_cam, dtype=np.float64).reshape(-1, 3)
        length = np.linalg.norm(points_cam, axis=1, keepdims=True)
        seen = np.isfinite(length[:, 0]) & (length[:, 0] > 0)
        directions = np.where(seen[:, None], points_cam, (0.0, 0.0, 1.0)) / np.where(seen[:, None], length, 1.0)
        pixels = _projected(_colmap_camera(self), directions)
        valid = seen & self._within_domain(directions) & np.isfinite(pixels).all(axis=1)
        pixels[~valid] = 0.0
        return pixels, valid

    def pixel_bearings(self) -> tuple[np.ndarray, np.ndarray]:
        """`bearings` of all pixel centres, row by row: directions (height * width, 3), valid (height * width,)."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return self.bearings(np.stack([x.ravel(), y.ravel()], axis=-1))

    def resized(self, width: int, height: int) -> "Camera":
        """The camera of the same picture resampled to another size.

        Raises:
            UserError: the new size is no resizing of the old one: its aspect differs by more than rounding to pixels.
        """
        if (width, height) == (self.width, self.height):
            return self
        off_height = abs(self.height * width / self.width - height)
        off_width = abs(self.width * height / self.height - width)
        if min(off_height, off_width) > 1.0:
            raise UserError(
                f"a picture of {width}x{height} pixels does not fit a camera of {self.width}x{self.height} pixels",
                "the two have different shapes: it is cropped or rotated, not resized; use the picture that the camera "
                "was calibrated with",
            )
        colmap = pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))
        colmap.rescale(width, height)
        return Camera(self.model, width, height, tuple(colmap.params))

    def undistorted(self) -> "Camera":
        """A PINHOLE camera of the same size and focal length, for views that nobody photographed."""
        return Camera.pinhole(self.width, self.height, self.focal_px)

    def to_json(self) -> dict[str, Any]:
        """{"model", "width", "height", "params"}; floats survive a round trip exactly."""
        return {
            "model": self.model,
            "width": self.width,
            "height": self.height,
            "params": list(self.params),
        }

    @staticmethod
    def from_json(content: dict[str, Any]) -> "Camera":
        """The camera that `to_json` described.

        Raises:
            UserError: a key is missing or holds something else than the camera needs.
        """
        try:
            model, params = str(content["model"]), tuple(float(value) for value in content["params"])
            width, height = int(content["width"]), int(content["height"])
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(
                f"this is not a camera: {type(error).__name__}: {error}",
                'expected {"model": COLMAP\'s name, "width": pixels, "height": pixels, "params": [numbers]}',
            ) from error
        return Camera(model, width, height, params)

    def _within_domain(self, directions: np.ndarray) -> np.ndarray:
        """Whether unit directions lie on the branch of the lens model that starts at the optical axis; (N,) bool."""
        if self.is_spherical:
            return np.asarray(np.isfinite(directions).all(axis=1))
        return directions[:, 2] > _least_cosine(self)

    def _opening_deg(self, pixels: np.ndarray) -> float:
        directions, valid = self.bearings(pixels)
        if not valid.any():
            return 0.0
        first, last = directions[valid][[0, -1]]
        return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(first, last)), first @ last)))


@lru_cache(maxsize=256)
def parameter_names(model: str) -> tuple[str, ...]:
    """The names of a model's parameters in COLMAP's order, such as ("f", "cx", "cy", "k")."""
    camera = pycolmap.Camera.create_from_model_name(1, model, 1.0, 2, 2)
    return tuple(name.strip() for name in camera.params_info.split(","))


@lru_cache(maxsize=256)
def _colmap_camera(camera: Camera) -> pycolmap.Camera:
    return pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height, params=list(camera.params))


@lru_cache(maxsize=256)
def _least_cosine(camera: Camera) -> float:
    """Cosine of the angle from the optical axis up to which the picture's radius grows with the angle.

    A distortion polynomial may turn back: from there on two directions share a pixel, and only the inner one is real.
    The angle is found by following 24 meridians outwards in steps of 1/20 degree; at the turn the radius is flat, so
    that the pixels lost to the step are less than 1e-3 px wide.
    """
    angles = np.radians(np.arange(0, 1800) / 20.0)  # below 90 degrees
    azimuths = np.linspace(0, 2 * np.pi, 24, endpoint=False)[:, None]
    directions = np.stack(
        np.broadcast_arrays(np.sin(angles) * np.cos(azimuths), np.sin(angles) * np.sin(azimuths), np.cos(angles)),
        axis=-1,
    )
    pixels = _projected(_colmap_camera(camera), directions.reshape(-1, 3))
    radius = np.linalg.norm(pixels - camera.principal_point, axis=1).reshape(len(azimuths), -1)
    grows = np.diff(radius, axis=1) > 0  # False at NaN
    steps = np.where(grows.all(axis=1), len(angles), np.argmin(grows, axis=1)).min()
    return float(np.cos(angles[steps])) if steps < len(angles) else 0.0


def _projected(colmap: pycolmap.Camera, directions: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of directions (N, 3) by the bare formula, for directions behind the camera too; may be NaN."""
    return np.asarray(colmap.img_from_cam(directions, check_cheirality=False))


def _mismatch_px(colmap: pycolmap.Camera, directions: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """How far from their pixels directions project; infinite where one of them is NaN. (N,)"""
    mismatch = np.linalg.norm(_projected(colmap, directions) - pixels, axis=1)
    return np.where(np.isfinite(mismatch), mismatch, np.inf)


def _newton_step(colmap: pycolmap.Camera, directions: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """One step of Newton's method towards the pixels, in the plane tangent to the sphere at each direction."""
    axis = np.where(np.abs(directions[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    first = np.cross(directions, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(directions, first)
    here = _projected(colmap, directions)
    step = 1e-6
    columns = [(_projected(colmap, directions + step * tangent) - here) / step for tangent in (first, second)]
    (a, c), (b, d) = columns[0].T, columns[1].T
    x, y = (pixels - here).T
    determinant = a * d - b * c
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = (
            directions
            + ((d * x - b * y) / determinant)[:, None] * first
            + ((a * y - c * x) / determinant)[:, None] * second
        )
        return moved / np.linalg.norm(moved, axis=1, keepdims=True)
