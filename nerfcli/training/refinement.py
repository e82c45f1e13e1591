"""Cameras that learn with the field: the poses of the training photos, and the lenses that took them.

Backpropagation gives the gradients of the loss with respect to the origins and directions of a step's rays; those with
respect to poses and lenses follow in closed form.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from nerfcli.cameras.camera import Camera, by_lens
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.lens_change import FOCAL, bearings_by_change, changeable, changed, pixels_by_change
from nerfcli.cameras.rigid import from_parts, inverse, nearest_rotation, transform_from_twist, vector_from_rotation
from nerfcli.training.optimiser import Delayed, NewtonSteps, WhitenedAdam, on_device_of, whitening, without_mean
from nerfcli.training.pool import PixelBatch, PixelPool
from nerfcli.training.schedule import CameraPlan

# Least distance of a camera from the origin of the training frame, about which its points are.
_LEAST_DISTANCE = 0.2
# Radians by which a whitened step of a lens moves the picture, at most.
LENS_RATE = 3e-4
# Radians by which a step of a pose moves the picture, at most.
_FARTHEST_STEP = 2e-3


class PoseRefinement(nn.Module):
    """The poses of P photos; `poses` (P, 4, 4) are `world_from_cam` as given, in the training frame.

    `motions` (P, 4, 4) is `given_from_refined`, in the axes of each camera. A small twist x (6,) moves what a camera
    sees by sqrt(x^T `picture` x) radians, root mean square.
    """

    def __init__(self, poses: np.ndarray, cameras: Sequence[Camera]):
        super().__init__()
        self._given = poses
        self.motions = nn.Buffer(torch.eye(4, dtype=torch.float64).repeat(len(poses), 1, 1))
        at_one = {camera: _picture_by_twist(camera) for camera in dict.fromkeys(cameras)}
        distances = np.linalg.norm(poses[:, :3, 3], axis=1).clip(_LEAST_DISTANCE)
        # The effect of a translation on the picture decreases with the distance, that of a rotation does not.
        jacobians = [
            at_one[camera] * np.array([1 / distance] * 3 + [1.0] * 3)
            for camera, distance in zip(cameras, distances, strict=True)
        ]
        squares = np.array([jacobian.T @ jacobian for jacobian in jacobians])
        self.picture = torch.from_numpy(squares)
        focal = np.array([camera.focal_px for camera in cameras])
        picture_px = focal[:, None] ** 2 * np.diagonal(squares, axis1=1, axis2=2)
        self.newton = NewtonSteps(len(poses), torch.from_numpy(picture_px))

    def poses(self) -> np.ndarray:
        """Return the current `world_from_cam`, (P, 4, 4)."""
        return self._given @ self.motions.numpy()

    def moved(self, origins: Tensor, directions: Tensor, photos: Tensor) -> tuple[Tensor, Tensor]:
        """Move rays (R, 3) from the given poses to the current ones; `photos` (R,) are their photo indices."""
        now = self.poses()
        turns = now[:, :3, :3] @ np.swapaxes(self._given[:, :3, :3], -1, -2)
        turn = on_device_of(directions, turns)[photos]
        # A photo that has not moved keeps its rays to the last bit.
        shift = on_device_of(origins, now[:, :3, 3] - self._given[:, :3, 3])[photos]
        return origins + shift, (turn * directions[:, None, :]).sum(-1)

    def gradients(self, directions: Tensor, photos: Tensor, *, by_origin: Tensor, by_direction: Tensor) -> Tensor:
        """Return gradients (R, 6) by twists of the rays' cameras, from those (R, 3) by the current rays; all float64.

        Twists are in the axes of each camera. A camera with rotation R that translates by u and rotates by w in its
        axes translates its rays by R u, and rotates them by R w.
        """
        torque = torch.linalg.cross(directions, by_direction)
        cam_from_world = torch.from_numpy(self.poses()[:, :3, :3]).transpose(-1, -2)[photos]
        return (cam_from_world @ torch.stack([by_origin, torque], dim=-1)).transpose(-1, -2).flatten(-2)

    def step(self, gradients: Tensor, losses: Tensor, photos: Tensor, plan: CameraPlan, *, rate: float) -> None:
        """Take a step against gradients (R, 6) of losses (R,) of rays, and remove the mean similarity of all moves.

        Args:
            rate: fraction of the full Newton step, in [0, 1].
        """
        so_far = self.motions.numpy()
        so_far = np.concatenate([so_far[:, :3, 3], vector_from_rotation(so_far[:, :3, :3])], axis=1)
        twists = rate * self.newton.change(
            self.newton.learn(gradients, losses, photos),
            torch.from_numpy(so_far),
            damping=plan.damping,
            holding=plan.holding,
        )
        seen = (twists[:, None] @ self.picture @ twists[..., None])[..., 0].sqrt()  # (P, 1) radians
        twists = (twists * (_FARTHEST_STEP / seen.clamp_min(_FARTHEST_STEP))).numpy()
        moved = without_mean(self._given, self.poses() @ transform_from_twist(twists))
        self.motions.copy_(torch.from_numpy(inverse(self._given) @ moved))


class LensRefinement(nn.Module):
    """The lenses of cameras: `values` (L, K) are the changes of K parameters of L lenses; those a lens lacks stay 0.

    Cameras that differ in the principal point alone are of one lens, as those of stabilised photos.

    Args:
        pool: the photos, with their cameras as given.
        names: (K,) parameters that may change, of `lens_change.changeable`.
        log_focal: initial value of "focal".
    """

    def __init__(self, pool: PixelPool, names: tuple[str, ...], log_focal: float):
        super().__init__()
        lenses = list(by_lens(pool.cameras).values())
        self._cameras = tuple(camera for lens in lenses for camera in lens)
        self._lens_of = [number for number, lens in enumerate(lenses) for _ in lens]
        number = {camera: index for index, camera in enumerate(self._cameras)}
        self._camera_of = torch.tensor([number[camera] for camera in pool.cameras])
        self._widths = torch.tensor([camera.width for camera in pool.cameras])
        self._first_pixel = pool.first_pixel.cpu()
        self._turns = pool.poses[:, :3, :3].double().cpu()
        self._names = names
        self._own = [tuple(name for name in names if name in changeable(camera)) for camera in self._cameras]
        self.values = nn.Buffer(torch.zeros(len(lenses), len(names), dtype=torch.float64))
        for index, own in enumerate(self._own):
            if FOCAL in own:
                self.values[self._lens_of[index], names.index(FOCAL)] = log_focal
        first = [self._lens_of.index(number) for number in range(len(lenses))]
        self.adam = WhitenedAdam(np.array([self._whitening(index) for index in first]))

    def changed(self, camera: Camera, photo: int) -> Camera:
        """Return `camera`, that of a photo, with the current changes; its pictures may have another size."""
        return self._changed(camera, int(self._camera_of[photo]))

    def _changed(self, camera: Camera, index: int) -> Camera:
        own = [self._names.index(name) for name in self._own[index]]
        return changed(camera, self._own[index], self.values[self._lens_of[index], own].numpy())

    def directions(self, drawn: PixelBatch, photos: Tensor) -> Tensor:
        """Return ray directions (R, 3) for the given poses and the current lenses."""
        numbers, photos = torch.stack([drawn.numbers, photos]).cpu()  # with a GPU, the host waits for this
        changed = torch.full(drawn.directions.shape, torch.nan, dtype=drawn.directions.dtype)
        for index, rays, pixels in self._by_camera(numbers, photos):
            bearings, valid = self._changed(self._cameras[index], index).bearings(pixels)
            there = rays[torch.from_numpy(valid)]  # elsewhere, the given lens is better than none
            turned = self._turns[photos[there]] @ torch.from_numpy(bearings[valid])[..., None]
            changed[there] = turned[..., 0].to(changed.dtype)
        now = on_device_of(drawn.directions, changed.numpy())
        return torch.where(now.isnan(), drawn.directions, now)

    def gradient(self, numbers: Tensor, photos: Tensor, *, turns: Tensor, by_direction: Tensor) -> Tensor:
        """Return the gradient (L, K) by the changes, from gradients (R, 3) by ray directions.

        `turns` (P, 3, 3) are the photos' rotations.
        """
        gradient = torch.zeros_like(self.values)
        for index, rays, pixels in self._by_camera(numbers, photos):
            names = self._own[index]
            camera = self._changed(self._cameras[index], index)
            by_change = torch.from_numpy(bearings_by_change(camera, names, pixels))
            by_bearing = turns[photos[rays]].transpose(-1, -2) @ by_direction[rays][..., None]
            of = [self._names.index(name) for name in names]
            gradient[self._lens_of[index], of] += (by_change * by_bearing).sum((0, 1))
        return gradient

    def step(self, gradient: Tensor, rate: float) -> None:
        """Take one step against a gradient (L, K)."""
        self.values.add_(self.adam.change(gradient, rate))

    def _by_camera(self, numbers: Tensor, photos: Tensor) -> list[tuple[int, Tensor, np.ndarray]]:
        """Return index, rays (N,) and pixels (N, 2) for each camera of the rays' photos (R,) that can change."""
        of = self._camera_of[photos]
        found = []
        for index in of.unique().tolist():
            if not self._own[index]:
                continue
            rays = (of == index).nonzero()[:, 0]
            place = numbers[rays] - self._first_pixel[photos[rays]]
            width = self._widths[photos[rays]]
            pixels = torch.stack([place % width, place // width], dim=-1).double() + 0.5
            found.append((index, rays, pixels.numpy()))
        return found

    def _whitening(self, index: int) -> np.ndarray:
        matrix = np.eye(len(self._names))
        if own := [self._names.index(name) for name in self._own[index]]:
            camera = self._cameras[index]
            _, by_parameters, _ = camera.project_jacobian(_points(camera))
            by_change = pixels_by_change(camera, self._own[index], by_parameters)
            matrix[np.ix_(own, own)] = whitening(_per_point(by_change, camera))
        return matrix


class Refinement(nn.Module):
    """The current cameras of the training photos.

    Args:
        kind: "poses", "focal", or "all": poses, focal lengths and distortion.
        pool: the training photos.
        log_focal: logarithm of the initial factor of focal lengths, if these are learned.
    """

    def __init__(self, kind: str, pool: PixelPool, log_focal: float = 0.0):
        super().__init__()
        self._pool = pool
        given = pool.poses.double().cpu().numpy()
        # Each step would multiply the rotations by the rounding of float32, as `inverse` transposes them.
        self._given = from_parts(nearest_rotation(given[:, :3, :3]), given[:, :3, 3])
        self.poses = PoseRefinement(self._given, pool.cameras) if kind in ("poses", "all") else None
        names = [(FOCAL,)] if kind == "focal" else [changeable(camera) for camera in pool.cameras if kind == "all"]
        listed = tuple(dict.fromkeys(name for own in names for name in own))
        self.lenses = LensRefinement(pool, listed, log_focal) if listed else None
        self.sent = Delayed()

    @torch.no_grad()
    def refine_cameras(self, drawn: PixelBatch) -> PixelBatch:
        """Return the same pixels, with the rays of the current cameras."""
        photos = self._pool.photo_of(drawn.numbers)
        origins, directions = drawn.origins, drawn.directions
        if self.lenses is not None:
            directions = self.lenses.directions(drawn, photos)
        if self.poses is not None:
            origins, directions = self.poses.moved(origins, directions, photos)
        return drawn._replace(origins=origins, directions=directions)

    @torch.no_grad()
    def step(self, drawn: PixelBatch, losses: Tensor, plan: CameraPlan, *, factor: float) -> None:
        """Take one step against the gradients of the mean loss over rays.

        On a GPU, the gradients are those of the previous step.

        Args:
            drawn: the rays, from `refine_cameras`, with gradients.
            losses: (R,) the loss of each ray.
        """
        by_origin, by_direction, rate = drawn.origins.grad, drawn.directions.grad, factor * plan.rate
        if rate == 0.0 or by_origin is None or by_direction is None:
            return
        sent = (self._pool.photo_of(drawn.numbers), drawn.numbers, losses, drawn.directions, by_origin, by_direction)
        arrived = self.sent.exchange(*sent)
        if arrived is None:
            return
        photos, numbers, *rest = arrived
        losses, directions, by_origin, by_direction = (tensor.double() for tensor in rest)
        given = self._given if self.poses is None else self.poses.poses()
        turns = torch.from_numpy(given[:, :3, :3])
        # Compute both gradients before either step: they belong to the rays before the update.
        by_lens = None
        if self.lenses is not None:
            by_lens = self.lenses.gradient(numbers, photos, turns=turns, by_direction=by_direction)
        if self.poses is not None:
            by_pose = self.poses.gradients(directions, photos, by_origin=by_origin, by_direction=by_direction)
            self.poses.step(len(by_pose) * by_pose, losses, photos, plan, rate=rate)
        if self.lenses is not None and by_lens is not None:
            self.lenses.step(by_lens, LENS_RATE * rate)

    def frames(
        self, training: Sequence[Frame], held_out: Sequence[Frame]
    ) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
        """Return both sets of frames refined: the poses of training photos, and the lenses of all photos.

        No held-out photo is used: each keeps its pose and gets the lens estimated from the training photos.

        Args:
            training: frames of the photos of the pool, in its order; their pictures may have another size.
            held_out: further frames, of the same size as `training`.
        """
        photo_of = {frame.camera.centred(): index for index, frame in enumerate(training)}

        def refined(frame: Frame, pose: np.ndarray) -> Frame:
            photo = photo_of.get(frame.camera.centred())
            if self.lenses is None or photo is None:
                return replace(frame, world_from_cam=pose)
            return replace(frame, camera=self.lenses.changed(frame.camera, photo), world_from_cam=pose)

        poses = [frame.world_from_cam for frame in training]
        if self.poses is not None:
            motions = self.poses.motions.numpy()
            motions = from_parts(motions[:, :3, :3], motions[:, :3, 3] / self._pool.training_from_scene.scale)
            poses = [pose @ motion for pose, motion in zip(poses, motions, strict=True)]
        return (
            tuple(refined(frame, pose) for frame, pose in zip(training, poses, strict=True)),
            tuple(refined(frame, frame.world_from_cam) for frame in held_out),
        )


def _picture_by_twist(camera: Camera) -> np.ndarray:
    """Return the derivatives (2 M, 6) of the image positions of M points by a twist, scaled by `_per_point`."""
    points = _points(camera)
    by_point, _, _ = camera.project_jacobian(points)
    # In the camera, a point x moves by -u - w x x, and a . (x x w) = w . (a x x).
    by_turn = np.cross(by_point, points[:, None, :])
    return _per_point(np.concatenate([-by_point, by_turn], axis=-1), camera)


def _points(camera: Camera) -> np.ndarray:
    """Return points (M, 3) in the camera's axes that represent what it sees, at pixels where the lens has a direction.

    Their distances are multiples of the camera's from the origin of the training frame.
    """
    x, y = ((np.arange(6) + 0.5) / 6 * side for side in (camera.width, camera.height))
    bearings, valid = camera.bearings(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    return np.concatenate([bearings[valid] * distance for distance in (2 / 3, 1.0, 2.0)])


def _per_point(by_parameters: np.ndarray, camera: Camera) -> np.ndarray:
    """Convert (M, 2, K) pixels to (2 M, K) radians divided by the square root of the number of points."""
    return by_parameters.reshape(-1, by_parameters.shape[-1]) / (camera.focal_px * np.sqrt(len(by_parameters)))
