"""Lens parameters that refinement can change: a factor of the focal length and the first two radial terms.

Changes do not depend on the resolution: the same change applies to a photo and its downscaled version in training.
"""

from collections.abc import Sequence

import numpy as np

from nerfcli.cameras.camera import Camera, parameter_names
from nerfcli.cameras.lens import DISTORTIONS

FOCAL = "focal"
_FOCAL_NAMES = ("f", "fx", "fy")


def changeable(camera: Camera) -> tuple[str, ...]:
    """List the parameters that can change: "focal" and the radial terms; none for a spherical camera."""
    radial = [name for group in DISTORTIONS[camera.model] for name in group.get("radial", ())]
    has_focal = any(name in _FOCAL_NAMES for name in camera.values)
    # Further terms are hard to tell apart from the first two, and diverge where few pixels constrain them.
    return (*([FOCAL] if has_focal else []), *radial[:2])


def changed(camera: Camera, names: Sequence[str], values: np.ndarray) -> Camera:
    """Return the camera with its parameters changed.

    The focal length is multiplied by exp(values[focal]), and values[k] is added to a radial term k.

    Args:
        names: some of `changeable`.
        values: one per name; zeros change nothing.

    Raises:
        UserError: the changed parameters are not valid.
    """
    change = dict(zip(names, values, strict=True))
    factor = float(np.exp(change.get(FOCAL, 0.0)))
    return camera.with_values(
        {
            name: value * factor if name in _FOCAL_NAMES else value + change.get(name, 0.0)
            for name, value in camera.values.items()
        }
    )


def pixels_by_change(camera: Camera, names: Sequence[str], by_parameters: np.ndarray) -> np.ndarray:
    """Return d pixel / d change (N, 2, K) of a camera, from its d pixel / d parameters (N, 2, P)."""
    parameters = parameter_names(camera.model)
    focal = [index for index, name in enumerate(parameters) if name in _FOCAL_NAMES]
    columns = [
        by_parameters[..., focal] @ np.array(camera.params)[focal]
        if name == FOCAL
        else by_parameters[..., parameters.index(name)]
        for name in names
    ]
    return np.stack(columns, axis=-1)


def bearings_by_change(camera: Camera, names: Sequence[str], pixels: np.ndarray) -> np.ndarray:
    """Return d direction / d change (N, 3, K) of fixed pixels (N, 2); zero where there is no direction.

    The pixel is to stay fixed, so d direction / d change = - d direction / d pixel  d pixel / d change.
    """
    directions, _ = camera.bearings(pixels)
    by_pixel, _ = camera.bearing_jacobian(pixels)
    _, by_parameters, _ = camera.project_jacobian(directions)
    return -by_pixel @ pixels_by_change(camera, names, by_parameters)
