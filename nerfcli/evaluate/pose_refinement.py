"""Pose alignment: separate the error of a held-out photo's pose from that of the field.

The pose is refined on the left half of the photo, with the field fixed, and the picture is measured on the right half,
which the refinement did not see.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from nerfcli.cameras.frame import Frame
from nerfcli.cameras.rigid import transform_from_twist, vector_from_rotation
from nerfcli.field.background import Background, colours_behind
from nerfcli.field.exposure import exposed
from nerfcli.render.model import Model
from nerfcli.render.rays import CENTRES, pixel_rays
from nerfcli.render.tracing import render_rays

PIXELS = 2048
SEED = 1
# Fewer pixels do not constrain six unknowns against noise.
LEAST_PIXELS = 64
# Steps of the finite differences, in pixels: large at first, to average over the field's own noise. First the camera is
# only rotated: in half a picture a translation looks much like a rotation, and a wrong one spoils the other half.
TURNS_PX = (2.0, 2.0, 1.0, 1.0, 0.5)
STEPS_PX = (1.0, 1.0, 0.5, 0.5, 0.5, 0.5)
_FIRST_DAMPING = 1e-3
_TRIES = 5


@dataclass(frozen=True)
class RefinedPose:
    """A refined frame, and how far it moved: rotation in degrees, translation of its centre in scene units, and the
    mean squared errors of the pixels used, before and after."""

    frame: Frame
    rotation_deg: float
    translation: float
    error_before: float
    error_after: float

    def to_json(self) -> dict[str, Any]:
        """Return rotation, translation and the refined pose as plain values."""
        return {
            "rotation_deg": self.rotation_deg,
            "translation": self.translation,
            "world_from_cam": self.frame.world_from_cam.tolist(),
        }


def halves(used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the used pixels in the left half of a picture and those in the right half, both (H, W) bool."""
    left = np.zeros_like(used)
    left[:, : used.shape[1] // 2] = True
    return used & left, used & ~left


@torch.no_grad()
def align_pose(
    model: Model,
    frame: Frame,
    colours: np.ndarray,
    *,
    used: np.ndarray,
    background: Background,
    log_gains: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> RefinedPose | None:
    """Refine the pose of a photo so that the model's picture comes closest to the photo; the model is not changed.

    Levenberg-Marquardt on the squared error of 2048 random pixels, with derivatives by finite differences of renders.
    The six unknowns are in units of pixels: rotations by one over the focal length, and translations that shift a point
    at the distance of the scene's radius by one pixel. A step is accepted only if it reduces the error. The search
    recovers from an error of about one pixel of the measured picture; from three it ends in the nearest local minimum.

    Args:
        frame: the photo's camera and pose.
        colours: (H, W, 3) the photo, float in [0, 1].
        used: (H, W) bool, the pixels to use.
        log_gains: the photo's exposure, as in `protocol.HeldOutPhoto`.

    Returns:
        The refined pose; None if too few pixels are used.
    """
    chosen = np.flatnonzero(used)
    if len(chosen) < LEAST_PIXELS:
        return None
    generator = np.random.default_rng(SEED)
    chosen = np.sort(generator.choice(chosen, min(PIXELS, len(chosen)), replace=False))
    wanted = colours.reshape(-1, 3)[chosen]
    focal = frame.camera.focal_px
    unit = np.array([1.0 / model.training_from_scene.scale / focal] * 3 + [1.0 / focal] * 3)

    def residuals(pose: np.ndarray) -> np.ndarray:
        moved = replace(frame, world_from_cam=pose)
        rays = pixel_rays(moved, model.training_from_scene, pixels=chosen, places=CENTRES, device=model.device)
        behind = colours_behind(background, rays.directions)
        origins = rays.origin.expand_as(rays.directions)
        rgb = render_rays(model, origins, rays.directions, background=behind, cones=rays.cones).rgb
        if any(log_gains):
            rgb = exposed(rgb, rgb.new_tensor(log_gains))
        return (rgb.clamp(0.0, 1.0).cpu().numpy().astype(np.float64) - wanted).ravel()

    pose, current = frame.world_from_cam, residuals(frame.world_from_cam)
    before = float(np.square(current).mean())
    turns = [(step_px, slice(3, 6)) for step_px in TURNS_PX]
    for step_px, free in [*turns, *((step_px, slice(0, 6)) for step_px in STEPS_PX)]:
        moves = (np.eye(6) * step_px * unit)[free]
        columns = [(residuals(pose @ transform_from_twist(move)) - current) / step_px for move in moves]
        jacobian = np.stack(columns, axis=1)
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ current
        damping = _FIRST_DAMPING  # reset: small steps may succeed where large ones failed
        for _ in range(_TRIES):
            damped = normal + damping * np.diag(np.diag(normal)) + 1e-12 * np.eye(len(moves))
            step = np.zeros(6)
            step[free] = -np.linalg.solve(damped, gradient)
            trial = pose @ transform_from_twist(step * unit)
            found = residuals(trial)
            if np.square(found).sum() < np.square(current).sum():
                pose, current = trial, found
                break
            damping *= 10
    turn = frame.world_from_cam[:3, :3].T @ pose[:3, :3]
    return RefinedPose(
        frame=replace(frame, world_from_cam=pose),
        rotation_deg=float(np.degrees(np.linalg.norm(vector_from_rotation(turn)))),
        translation=float(np.linalg.norm(pose[:3, 3] - frame.world_from_cam[:3, 3])),
        error_before=before,
        error_after=float(np.square(current).mean()),
    )
