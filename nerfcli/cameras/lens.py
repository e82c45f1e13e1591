"""A lens: a projection, then up to two distortions, then focal length and principal point, as in COLMAP's models.

Arrays have coordinates first here: directions are (3, N), pixels (2, N).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nerfcli.cameras import projections
from nerfcli.cameras.distortion import Distortion

# A pixel's direction is valid only if it projects back to within this distance of the pixel.
MAX_MISMATCH_PX = 1e-3

# The parameters of each model's distortions, by the name of the term: one group for F(q), a second for F2(F1(q)).
# OpenCV's tangential terms are du = 2 p1 u v + p2 (s + 2 u^2), dv = 2 p2 u v + p1 (s + 2 v^2): the vector is (p2, p1).
DISTORTIONS: dict[str, tuple[dict[str, tuple[str, ...]], ...]] = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ({"radial": ("k",)},),
    "RADIAL": ({"radial": ("k1", "k2")},),
    "OPENCV": ({"radial": ("k1", "k2"), "tangential": ("p2", "p1")},),
    "FULL_OPENCV": ({"radial": ("k1", "k2", "k3"), "divisor": ("k4", "k5", "k6"), "tangential": ("p2", "p1")},),
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "SIMPLE_RADIAL_FISHEYE": ({"radial": ("k",)},),
    "RADIAL_FISHEYE": ({"radial": ("k1", "k2")},),
    "OPENCV_FISHEYE": ({"radial": ("k1", "k2", "k3", "k4")},),
    "THIN_PRISM_FISHEYE": ({"radial": ("k1", "k2", "k3", "k4"), "tangential": ("p2", "p1"), "prism": ("sx1", "sy1")},),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        {"radial": ("k0", "k1", "k2", "k3", "k4", "k5")},
        {"tangential": ("p0", "p1"), "prism": ("s0", "s2"), "prism_fourth": ("s1", "s3")},
    ),
    "FOV": (),
    "SIMPLE_DIVISION": (),
    "DIVISION": (),
    "EUCM": (),
    "EQUIRECTANGULAR": (),
}
# The projections that are neither perspective nor equidistant, and their parameters.
_PROJECTIONS: dict[str, tuple[Callable[..., projections.Projection], tuple[str, ...]]] = {
    "FOV": (projections.FieldOfView, ("omega",)),
    "SIMPLE_DIVISION": (projections.Division, ("k",)),
    "DIVISION": (projections.Division, ("k",)),
    "EUCM": (projections.EnhancedUnified, ("alpha", "beta")),
    "EQUIRECTANGULAR": (projections.Equirectangular, ()),
}


@dataclass(frozen=True)
class Lens:
    """The map between directions and pixels; `lens_of` makes one.

    Args:
        projection: from directions to the plane.
        distortions: of the plane, the innermost first.
        focal_px: (2, 1).
        principal_point: (2, 1) in pixels.
        spread: (inner, parameters), d inner / d parameters. The inner parameters are those of the projection, then
            those of the distortions in their order, then fx, fy, cx and cy.
    """

    projection: projections.Projection
    distortions: tuple[Distortion, ...]
    focal_px: np.ndarray
    principal_point: np.ndarray
    spread: np.ndarray

    def project(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project unit directions (3, N) to pixels (2, N), zeros where the lens does not see; valid (N,) bool."""
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            valid = self.projection.sees(directions)
            plane = self.projection.plane(_where_seen(directions, valid))
            for distortion in self.distortions:
                valid = valid & (np.sqrt(plane[0] ** 2 + plane[1] ** 2) < distortion.reach)
                plane = distortion.apply(plane)
            pixels = plane * self.focal_px + self.principal_point
        valid = valid & np.isfinite(pixels).all(axis=0)
        pixels[:, ~valid] = 0.0
        return pixels, valid

    def unproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unproject finite pixels (2, N) to unit directions (3, N), +z where there is none; valid (N,) bool."""
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            plane = (pixels - self.principal_point) / self.focal_px
            valid = np.ones(pixels.shape[1], dtype=bool)
            for distortion in reversed(self.distortions):
                plane, found = distortion.invert(plane)
                valid &= found
            directions, found = self.projection.directions(plane)
            valid &= found & np.isfinite(directions).all(axis=0)
            # A round trip as a check, for the very edge of the domain and for parameters that no real lens has.
            again, seen = self.project(_where_seen(directions, valid))
            valid &= seen & (np.abs(again - pixels) < MAX_MISMATCH_PX).all(axis=0)
        directions[:, ~valid] = np.array([[0.0], [0.0], [1.0]])
        return directions, valid

    def jacobians(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the derivatives of `project` at unit directions (3, N).

        Returns:
            d pixel / d direction (2, 3, N) and d pixel / d parameters (2, P, N), zeros where the lens does not see;
            valid (N,) bool.
        """
        _, valid = self.project(directions)
        directions = _where_seen(directions, valid)
        plane = self.projection.plane(directions)
        by_direction = self.projection.jacobian(directions)
        columns = self.projection.parameter_jacobian(directions)
        for distortion in self.distortions:
            by_plane = distortion.jacobian(plane)
            by_direction = np.einsum("ijn,jkn->ikn", by_plane, by_direction)
            columns = np.einsum("ijn,jkn->ikn", by_plane, columns)
            columns = np.concatenate([columns, distortion.coefficient_jacobian(plane)], axis=1)
            plane = distortion.apply(plane)
        axes = np.repeat(np.eye(2)[:, :, None], plane.shape[1], axis=2)
        columns = np.concatenate([columns * self.focal_px[:, :, None], axes * plane[:, None], axes], axis=1)
        by_parameters = np.einsum("ikn,kp->ipn", columns, self.spread)
        return by_direction * self.focal_px[:, :, None] * valid, by_parameters * valid, valid


def lens_of(model: str, values: dict[str, float]) -> Lens:
    """Return the lens of one of COLMAP's models."""
    groups = DISTORTIONS[model]
    distortions = tuple(
        Distortion(**{term: tuple(values[name] for name in names) for term, names in group.items()}) for group in groups
    )
    usual = projections.Equidistant if model.endswith("FISHEYE") else projections.Perspective
    project, parameters = _PROJECTIONS.get(model, (usual, ()))
    inner = [{name: 1.0} for name in parameters]
    inner += [{name: 1.0} for group in groups for names in group.values() for name in names]
    if model == "EQUIRECTANGULAR":
        width, height = values["w"], values["h"]
        focal, centre = (width, height), (width / 2, height / 2)
        inner += [{"w": 1.0}, {"h": 1.0}, {"w": 0.5}, {"h": 0.5}]
    else:
        focal_names = ("f", "f") if "f" in values else ("fx", "fy")
        focal, centre = tuple(values[name] for name in focal_names), (values["cx"], values["cy"])
        inner += [{name: 1.0} for name in (*focal_names, "cx", "cy")]
    spread = np.array([[fractions.get(name, 0.0) for name in values] for fractions in inner])
    projection = project(*(values[name] for name in parameters))
    return Lens(projection, distortions, np.array(focal)[:, None], np.array(centre)[:, None], spread)


def _where_seen(directions: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return the directions, with those that are not seen replaced by the optical axis."""
    return np.where(seen, directions, np.array([[0.0], [0.0], [1.0]]))
