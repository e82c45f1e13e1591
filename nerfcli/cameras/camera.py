"""Camera models: from pixels to directions and back, through COLMAP's own lens models.

A model has COLMAP's name and COLMAP's order of parameters. The centre of the top-left pixel is (0.5, 0.5), and the
picture spans [0, width] x [0, height]. Camera axes are OpenCV's: +x right, +y down, +z forward.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import pycolmap

from nerfcli.cameras.lens import DISTORTIONS, Lens, lens_of
from nerfcli.errors import UserError
from nerfcli.interrupts import restore_sigterm

# COLMAP warns through glog on stderr; real problems are reported as an exception or as NaN.
pycolmap.logging.minloglevel = 2
# Importing pycolmap makes glog answer SIGTERM with a stack trace, as if it were a crash.
restore_sigterm()

# Number of rows processed at a time.
BLOCK_SIZE = 2**15

# Far beyond any real lens; above this, powers of the coefficients overflow.
LARGEST_PARAMETER = 1e30


@dataclass(frozen=True)
class Camera:
    """A camera's intrinsics.

    Args:
        model: COLMAP's name: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, OPENCV_FISHEYE, ...
        width, height: of the picture in pixels.
        params: in COLMAP's order for the model, in pixels of this picture.

    Raises:
        UserError: an unknown model, a wrong number of parameters, or invalid values of parameters.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in DISTORTIONS:
            hint = f"expected one of COLMAP's: {', '.join(sorted(DISTORTIONS))}"
            raise UserError(f"unknown camera model {self.model!r}", hint)
        if self.width < 1 or self.height < 1:
            hint = "width and height must be integers of at least 1"
            raise UserError(f"invalid size of a camera: {self.width}x{self.height} pixels", hint)
        object.__setattr__(self, "params", tuple(float(value) for value in self.params))
        names = parameter_names(self.model)
        if len(self.params) != len(names):
            hint = f"expected {', '.join(names)}, in this order"
            raise UserError(f"camera model {self.model} has {len(names)} parameters, got {len(self.params)}", hint)
        if complaint := _complaint(self.model, self.values):
            raise UserError(f"invalid parameters {self.params} for camera model {self.model}", complaint)

    @property
    def values(self) -> dict[str, float]:
        """The parameters by COLMAP's names."""
        return dict(zip(parameter_names(self.model), self.params, strict=True))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture in pixels."""
        return self.width, self.height

    @staticmethod
    def pinhole(width: int, height: int, focal_px: float) -> "Camera":
        """Return an ideal camera with square pixels and the principal point in the middle."""
        return Camera("PINHOLE", width, height, (focal_px, focal_px, width / 2, height / 2))

    @property
    def is_spherical(self) -> bool:
        """True if the picture covers the whole sphere (EQUIRECTANGULAR) and so has no focal length."""
        return self.model == "EQUIRECTANGULAR"

    @property
    def focal_px(self) -> float:
        """Mean focal length in pixels; for a spherical picture, pixels per radian at its equator."""
        return self.width / (2 * np.pi) if self.is_spherical else sum(self.focal_lengths) / 2

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """Focal lengths along x and y in pixels; infinite for a spherical picture, which has none."""
        values = self.values
        only = values.get("f", np.inf)
        return values.get("fx", only), values.get("fy", only)

    @property
    def pixel_aspect(self) -> float:
        """Focal length along y over that along x: 1 for square pixels."""
        fx, fy = self.focal_lengths
        return 1.0 if self.is_spherical else fy / fx

    @property
    def principal_point(self) -> tuple[float, float]:
        """Principal point in pixels (x, y)."""
        values = self.values
        return values.get("cx", self.width / 2), values.get("cy", self.height / 2)

    @property
    def fov_deg(self) -> tuple[float, float]:
        """Angles (horizontal, vertical) in degrees between the picture's opposite edges, lens distortion included.

        They are measured through the principal point. If the model does not cover an edge, the last valid pixel counts.
        """
        if self.is_spherical:
            return 360.0, 180.0
        cx, cy = self.principal_point
        across = np.stack([np.linspace(0, self.width, 257), np.full(257, cy)], axis=-1)
        down = np.stack([np.full(257, cx), np.linspace(0, self.height, 257)], axis=-1)
        return self._opening_deg(across), self._opening_deg(down)

    def bearings(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the viewing directions of pixels (N, 2), x and y, through the exact lens model.

        Returns:
            directions (N, 3), unit, in camera axes, also behind the camera if the lens sees there; valid (N,) bool.
            Where the model has no direction for a pixel (beyond the radius at which its distortion turns back, or
            beyond the angle at which the model ends), valid is False and the direction is (0, 0, 1). It is never
            NaN and never a wrong root.

        Accuracy: projecting a valid direction gives the pixel to 1e-9 px, or, if a lens has more than 250,000 px per
        radian, to 4e-15 of that, which is the rounding of the direction.
        """
        pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        directions, valid = np.empty((len(pixels), 3)), np.empty(len(pixels), dtype=bool)
        for block in _blocks(len(pixels)):
            finite = np.isfinite(pixels[block]).all(axis=1)
            seen, found = _lens(self).unproject(np.where(finite, pixels[block].T, 0.0))
            seen[:, ~finite] = np.array([[0.0], [0.0], [1.0]])
            directions[block], valid[block] = seen.T, found & finite
        return directions, valid

    def project(self, points_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points (N, 3) in camera axes to pixels.

        Returns:
            pixels (N, 2), which may lie outside the picture; valid (N,) bool. A point at the camera's centre, beyond
            the angle at which the lens model ends (90 degrees from the axis for the perspective models) or beyond the
            one at which it turns back has valid False and the pixel (0, 0), never NaN.
        """
        points_cam = np.asarray(points_cam, dtype=np.float64).reshape(-1, 3)
        pixels, valid = np.empty((len(points_cam), 2)), np.empty(len(points_cam), dtype=bool)
        for block in _blocks(len(points_cam)):
            directions, length = _towards(points_cam[block])
            found, seen = _lens(self).project(directions)
            found[:, length == 0] = 0.0
            pixels[block], valid[block] = found.T, seen & (length > 0)
        return pixels, valid

    def shows(self, points_cam: np.ndarray) -> np.ndarray:
        """Return which points (N, 3) in camera axes are inside the picture or on its edge; (N,) bool."""
        pixels, valid = self.project(points_cam)
        return valid & ((pixels >= 0) & (pixels <= self.size)).all(axis=1)

    def contains(self, pixels: np.ndarray) -> np.ndarray:
        """Return which positions (N, 2) are in a pixel of the picture, so not on its right or lower edge; (N,) bool."""
        return np.asarray(((pixels >= 0) & (pixels < self.size)).all(axis=1))

    def project_jacobian(self, points_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute the Jacobian of pixels with respect to points (N, 3) in camera axes and camera parameters.

        Returns:
            d pixel / d point (N, 2, 3), pixels per unit of the points; d pixel / d parameters (N, 2, P) in the order of
            `params`; valid (N,) bool. Where `project` is not valid both are zero.

        Accuracy: closed forms; error of a few 1e-13 relative to each column's own size.
        """
        directions, length = _towards(np.asarray(points_cam, dtype=np.float64).reshape(-1, 3))
        by_direction, by_parameters, valid = _lens(self).jacobians(directions)
        valid &= length > 0
        # A direction's length does not change its pixel: the derivative at the point is that at the unit direction,
        # divided by the distance.
        by_point = by_direction * valid / np.where(valid, length, 1.0)
        return np.moveaxis(by_point, -1, 0), np.moveaxis(by_parameters * valid, -1, 0), valid

    def bearing_jacobian(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the Jacobian of bearings with respect to pixels (N, 2).

        Returns:
            d direction / d pixel (N, 3, 2) in radians per pixel, whose columns are normal to the direction; valid (N,)
            bool as in `bearings`. Zero where not valid.

        It is the inverse of d pixel / d direction on the plane normal to the direction: J^T (J J^T)^-1.
        """
        directions, valid = self.bearings(pixels)
        by_direction, _, smooth = self.project_jacobian(directions)
        valid &= smooth
        by_direction[~valid] = np.eye(2, 3)
        # With the rows a and b of J: (|b|^2 a - (a.b) b, |a|^2 b - (a.b) a) / |a x b|^2.
        a, b = by_direction[:, 0], by_direction[:, 1]
        mixed = (a * b).sum(axis=1, keepdims=True)
        area = (np.cross(a, b) ** 2).sum(axis=1, keepdims=True)
        by_x = ((b * b).sum(axis=1, keepdims=True) * a - mixed * b) / area
        by_y = ((a * a).sum(axis=1, keepdims=True) * b - mixed * a) / area
        return np.stack([by_x, by_y], axis=-1) * valid[:, None, None], valid

    def pixel_bearings(self) -> tuple[np.ndarray, np.ndarray]:
        """Return `bearings` of all pixel centres by rows: directions (height * width, 3), valid (height * width,)."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return self.bearings(np.stack([x.ravel(), y.ravel()], axis=-1))

    def has_shape(self, width: int, height: int) -> bool:
        """Return whether a picture of this size has the camera's aspect ratio, up to rounding to whole pixels."""
        off_height = abs(self.height * width / self.width - height)
        off_width = abs(self.width * height / self.height - width)
        return min(off_height, off_width) <= 1.0

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of the same picture resampled to another size.

        Raises:
            UserError: the aspect ratio of the new size differs by more than rounding to whole pixels.
        """
        if (width, height) == (self.width, self.height):
            return self
        if not self.has_shape(width, height):
            what = f"a picture of {width}x{height} pixels does not match a camera of {self.width}x{self.height} pixels"
            if self.is_spherical:
                hint = "EQUIRECTANGULAR pictures are twice as wide as high; ordinary photos have another camera model"
                raise UserError(what, hint)
            raise UserError(
                what,
                "the aspect ratios differ: the picture was cropped or rotated, not resized; use the picture that the "
                "camera was calibrated with",
            )
        colmap = pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))
        colmap.rescale(width, height)
        return Camera(self.model, width, height, tuple(colmap.params))

    def with_principal_point(self, x: float, y: float) -> "Camera":
        """Return the same lens with its principal point at (x, y) pixels; a spherical picture has none and is kept."""
        return self.with_values({"cx": x, "cy": y})

    def shifted(self, x: float, y: float) -> "Camera":
        """Return the camera with its principal point moved by (x, y) pixels."""
        cx, cy = self.principal_point
        return self.with_principal_point(cx + x, cy + y)

    def with_values(self, values: Mapping[str, float]) -> "Camera":
        """Return the camera with other values of some parameters; names that its model does not have are ignored."""
        return replace(self, params=tuple(values.get(name, value) for name, value in self.values.items()))

    def centred(self) -> "Camera":
        """Return the same lens with its principal point in the middle: equal for all cameras of one lens."""
        return self.with_principal_point(self.width / 2, self.height / 2)

    def undistorted(self) -> "Camera":
        """Return a PINHOLE camera of the same size and focal length, for rendered views."""
        return Camera.pinhole(self.width, self.height, self.focal_px)

    def to_json(self) -> dict[str, Any]:
        """Return {"model", "width", "height", "params"}; floats survive a round trip exactly."""
        return {**asdict(self), "params": list(self.params)}

    @staticmethod
    def from_json(content: dict[str, Any]) -> "Camera":
        """Return the camera that `to_json` described."""
        try:
            model, params = str(content["model"]), tuple(float(value) for value in content["params"])
            width, height = int(content["width"]), int(content["height"])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            hint = 'expected {"model": COLMAP\'s name, "width": pixels, "height": pixels, "params": [numbers]}'
            raise UserError(f"not a valid camera: {type(error).__name__}: {error}", hint) from error
        return Camera(model, width, height, params)

    def _opening_deg(self, pixels: np.ndarray) -> float:
        directions, valid = self.bearings(pixels)
        if not valid.any():
            return 0.0
        # Summed over small steps, so that angles above 180 degrees are counted in full.
        seen = directions[valid]
        sine = np.linalg.norm(np.cross(seen[:-1], seen[1:]), axis=1)
        return float(np.degrees(np.arctan2(sine, (seen[:-1] * seen[1:]).sum(axis=1)).sum()))


@lru_cache(maxsize=256)
def parameter_names(model: str) -> tuple[str, ...]:
    """Return the names of a model's parameters in COLMAP's order, such as ("f", "cx", "cy", "k")."""
    camera = pycolmap.Camera.create_from_model_name(1, model, 1.0, 2, 2)
    return tuple(name.strip() for name in camera.params_info.split(","))


def by_lens(cameras: Sequence[Camera]) -> dict[Camera, list[Camera]]:
    """Return the different cameras of each lens: cameras of a lens differ in the principal point alone.

    The key is the lens's camera with the principal point in the middle.
    """
    lenses: dict[Camera, list[Camera]] = {}
    for camera in dict.fromkeys(cameras):
        lenses.setdefault(camera.centred(), []).append(camera)
    return lenses


def _complaint(model: str, values: dict[str, float]) -> str:
    """Return a hint for invalid parameters of a model; empty if they are valid."""
    focal = [values[name] for name in ("f", "fx", "fy", "w", "h") if name in values]
    if not (np.abs(list(values.values())) < LARGEST_PARAMETER).all() or min(focal) <= 0:
        return "focal lengths must be positive and all parameters finite"
    if model == "EUCM" and not (0 <= values["alpha"] <= 1 and values["beta"] > 0):
        return "alpha must be in [0, 1] and beta positive"
    if model == "FOV" and not abs(values["omega"]) < np.pi:
        return "omega is an angle in radians and must lie between -pi and pi"
    return ""


@lru_cache(maxsize=256)
def _lens(camera: Camera) -> Lens:
    return lens_of(camera.model, camera.values)


def _blocks(count: int) -> Iterator[slice]:
    """Return slices that cover `count` rows in blocks whose intermediate results stay in the processor's cache."""
    return (slice(first, first + BLOCK_SIZE) for first in range(0, count, BLOCK_SIZE))


def _towards(points_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions (3, N) and distances (N,) of points (N, 3); (0, 0, 1) and 0 if there is no direction."""
    points = np.ascontiguousarray(points_cam.T)
    # Scaled first, so that no square overflows or underflows.
    largest = np.abs(points).max(axis=0)
    there = (largest > 0) & (largest < np.inf)  # False at NaN
    if not there.all():
        points = np.where(there, points, np.array([[0.0], [0.0], [1.0]]))
        largest = np.where(there, largest, 1.0)
    points = points / largest
    length = np.sqrt((points * points).sum(axis=0))
    return points / length, np.where(there, length * largest, 0.0)
