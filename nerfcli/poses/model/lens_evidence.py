"""Evidence of a model's observations about a lens, with free poses and points.

A lens parameter is determined as far as no motion of poses and points can imitate it. So everything that poses and
points can explain is removed from the parameters' effect on the observations (a Schur complement); the rest gives their
values and uncertainties in one Gauss-Newton step, without an adjustment.

Residuals are not independent: highlights that move with the view, or photos with rolling shutters, are wrong in the
same way many times. Noise is therefore estimated by clusters: photos, and neighbouring points of the scene. If one part
of the scene implies another lens than the rest, the uncertainty of the parameter includes that difference (a sandwich
estimate by clusters; White 1980, Cameron and Miller 2015).

Letters: x and y are a ray's coordinates at z = 1, r its distance from the axis; k1, k2, p1, p2 are terms of the Brown
model as COLMAP's OPENCV has them; f the focal length, fa the difference of the two along the axes of the picture.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from nerfcli.poses.input.job import Solver
from nerfcli.poses.model import held_out
from nerfcli.poses.model.held_out import MOST_OBSERVATIONS
from nerfcli.poses.model.projection import Array, projected

NAMES = ("f", "fa", "cx", "cy", "k1", "k2", "p1", "p2")
# Other cameras whose focal length and distortion are free too; if there are more, the rest is taken as exact.
_MOST_OTHERS = 12
# Relative to the diagonal: the seven directions in which all poses move together are free, and do not affect the lens.
_DAMPING = 1e-9


class UndeterminedError(np.linalg.LinAlgError):
    """A model has too few observations to determine its lens, as where a matrix of them is singular."""


@dataclass(frozen=True)
class OwnCameras:
    """The lens of each photo; photos may have cameras of their own, which differ in the principal point.

    lens_of: the lens of each photo, by image id. shifting: ids of the images whose principal points are free, as poses
    are.
    """

    lens_of: Mapping[int, int]
    shifting: Collection[int] = ()


@dataclass(frozen=True)
class LensEvidence:
    """Evidence about the `NAMES` of one camera.

    Args:
        current: (8,) the parameters' values, relative to the centre of the picture and to zero distortion.
        information: (8, 8) inverse covariance for unit noise.
        scores: for each way to cluster, (clusters, 8) the clusters' gradients.
        informations: for each way, (clusters, 8, 8) the clusters' contributions to the information.
        noise_px: standard deviation of an observation.
        border_px: (8,) motion of the corner of the picture per unit of each parameter.
    """

    current: Array
    information: Array
    scores: tuple[Array, ...]
    informations: tuple[Array, ...]
    noise_px: float
    border_px: Array

    def estimate(self, names: Sequence[str]) -> "Estimate":
        """Estimate the parameters `names`, with the other ones fixed at their values.

        Raises:
            UndeterminedError: the observations do not determine one of them.
        """
        index = [NAMES.index(name) for name in names]
        information = self.information[np.ix_(index, index)]
        scale = np.sqrt(np.diag(information))
        if not (scale > 0).all() or np.linalg.cond(information / np.outer(scale, scale)) > 1e10:
            raise UndeterminedError(f"the observations do not determine {', '.join(names)}")
        inverse = np.asarray(np.linalg.inv(information), dtype=np.float64)
        change = inverse @ self.scores[0][:, index].sum(axis=0)
        covariances = [self.noise_px**2 * inverse]
        for scores, informations in zip(self.scores, self.informations, strict=True):
            left = scores[:, index] - informations[:, index][:, :, index] @ change
            count = len(left)
            meat = left.T @ left * (count / max(count - 1, 1))
            covariances.append(inverse @ meat @ inverse)
        return Estimate(tuple(names), self.current[index] + change, tuple(covariances))

    def without(self, name: str) -> "LensEvidence":
        """Return the evidence with a parameter set to zero, so that what it explained is added to the residuals."""
        index = NAMES.index(name)
        value = self.current[index]
        scores = tuple(
            one + value * informations[:, :, index]
            for one, informations in zip(self.scores, self.informations, strict=True)
        )
        current = self.current.copy()
        current[index] = 0.0
        return replace(self, scores=scores, current=current)


@dataclass(frozen=True)
class Estimate:
    """Values of lens parameters, and their covariance by each way to estimate noise."""

    names: tuple[str, ...]
    values: Array
    covariances: tuple[Array, ...]

    def deviation(self, name: str) -> float:
        """Return the standard deviation of a parameter, the largest of all ways to estimate noise."""
        index = self.names.index(name)
        return float(np.sqrt(max(covariance[index, index] for covariance in self.covariances)))

    def value(self, name: str) -> float:
        """Return the value of a parameter."""
        return float(self.values[self.names.index(name)])

    def distance(self, names: Sequence[str]) -> float:
        """Return the squared Mahalanobis distance of some parameters from zero, the least of all ways."""
        index = [self.names.index(name) for name in names]
        values = self.values[index]
        own = (covariance[np.ix_(index, index)] for covariance in self.covariances)
        return float(min(values @ np.linalg.pinv(covariance) @ values for covariance in own))


def lens_evidence(
    model: pycolmap.Reconstruction, camera_id: int, solver: Solver = Solver(), *, own: OwnCameras | None = None
) -> LensEvidence:
    """Compute the evidence of a converged model's observations about a perspective camera.

    Observations are weighted as the robust adjustment does, see `held_out.adjust`.

    Args:
        camera_id: that of the lens where photos have cameras of their own.
        own: None if photos share cameras.

    Raises:
        UndeterminedError: there are fewer observations than unknowns.
    """
    own = own or OwnCameras(lenses_of(model))
    seen = _observations(model, own.lens_of, seed=solver.seed)
    others = [c for c in sorted(set(seen.lenses)) if c != camera_id and c not in solver.fixed][:_MOST_OTHERS]
    poses, points, lens, residuals = _jacobians(model, seen, camera_id, others=others)
    if own.shifting:
        moves = np.isin(seen.photos, [seen.images.index(image_id) for image_id in own.shifting])
        moves &= (poses != 0).any(axis=(1, 2))  # of points that are projected
        poses = np.concatenate([poses, moves[:, None, None] * np.eye(2)], axis=2)
    rows, columns = len(residuals), lens.shape[2]
    unknowns = poses.shape[2] * len(seen.images) + 3 * len(seen.xyz) - 7 + columns
    if 2 * rows <= unknowns:
        raise UndeterminedError(f"{rows} observations for {unknowns} unknowns")
    errors = np.linalg.norm(residuals, axis=1)
    root_weights = np.sqrt(1 / (1 + (errors / held_out.loss_scale_px(errors)) ** 2))
    for array in (poses, points, lens):
        array *= root_weights[:, None, None]
    residuals = residuals * root_weights[:, None]
    free = _freed(poses, points, lens, seen)
    # What the other cameras' lenses can explain is removed too, like that of the poses; these cameras are few.
    if others:
        flat = free.reshape(2 * rows, columns)
        first, rest = flat[:, : len(NAMES)], flat[:, len(NAMES) :]
        free = (first - rest @ np.linalg.lstsq(rest, first, rcond=1e-10)[0]).reshape(rows, 2, len(NAMES))
    scores = np.einsum("nij,ni->nj", free, residuals)
    products = np.einsum("nij,nik->njk", free, free)
    clusters = (seen.photos, _scene_clusters(seen, seed=solver.seed))
    camera = camera_of(model, camera_id, own)
    corner = np.array([[camera.width / 2, camera.height / 2, camera.mean_focal_length()]])
    return LensEvidence(
        current=lens_values(camera),
        information=products.sum(axis=0),
        scores=tuple(_summed(scores, labels) for labels in clusters),
        informations=tuple(_summed(products, labels) for labels in clusters),
        # Divided by the mean weight, since downweighted observations contribute less to the sum.
        noise_px=float(np.sqrt((residuals**2).sum() / np.mean(root_weights**2) / max(2 * rows - unknowns, 1))),
        border_px=np.linalg.norm(_lens_terms(camera, corner)[0], axis=0),
    )


def lenses_of(model: pycolmap.Reconstruction) -> dict[int, int]:
    """Return the camera id of each photo of a model whose photos share cameras, by image id."""
    return {image_id: model.image(image_id).camera_id for image_id in model.reg_image_ids()}


def camera_of(model: pycolmap.Reconstruction, lens: int, own: OwnCameras) -> pycolmap.Camera:
    """Return the camera of a lens's first photo."""
    return model.camera(model.image(next(photo for photo, number in own.lens_of.items() if number == lens)).camera_id)


def parameters_of(camera: pycolmap.Camera) -> tuple[str, ...]:
    """List which of `NAMES` a camera model has, except the principal point; empty if it has other parameters."""
    return {
        "SIMPLE_PINHOLE": ("f",),
        "PINHOLE": ("f", "fa"),
        "SIMPLE_RADIAL": ("f", "k1"),
        "RADIAL": ("f", "k1", "k2"),
        "OPENCV": ("f", "fa", "k1", "k2", "p1", "p2"),
    }.get(camera.model.name, ())


@dataclass(frozen=True)
class _Seen:
    """Observations: photos and points (n,) are positions in `images` and `xyz`; pixels (n, 2).

    lenses: the lens of each of the images.
    """

    images: list[int]
    lenses: list[int]
    photos: NDArray[np.int64]
    points: NDArray[np.int64]
    pixels: Array
    xyz: Array


def _observations(model: pycolmap.Reconstruction, lens_of: Mapping[int, int], *, seed: int) -> _Seen:
    ids = np.array(sorted(i for i, point in model.points3D.items() if np.isfinite(point.xyz).all()), dtype=np.int64)
    kept = MOST_OBSERVATIONS / max(model.compute_num_observations(), 1)
    if kept < 1:
        ids = ids[np.random.default_rng(seed).uniform(size=len(ids)) < kept]
    places = {int(point_id): place for place, point_id in enumerate(ids)}
    images = sorted(model.reg_image_ids())
    seen = [
        (position, places[point.point3D_id], point.xy)
        for position, image_id in enumerate(images)
        for point in model.image(image_id).get_observation_points2D()
        if point.point3D_id in places
    ]
    return _Seen(
        images,
        lenses=[lens_of[image_id] for image_id in images],
        photos=np.array([photo for photo, _, _ in seen], dtype=np.int64),
        points=np.array([point for _, point, _ in seen], dtype=np.int64),
        pixels=np.array([pixel for _, _, pixel in seen], dtype=np.float64).reshape(-1, 2),
        xyz=np.array([model.point3D(int(i)).xyz for i in ids], dtype=np.float64).reshape(-1, 3),
    )


def _jacobians(
    model: pycolmap.Reconstruction, seen: _Seen, camera_id: int, *, others: list[int]
) -> tuple[Array, Array, Array, Array]:
    """Return pixels per unit of pose (n, 2, 6), point (n, 2, 3) and lenses (n, 2, 8 + 2 others); residuals (n, 2)."""
    count = len(seen.photos)
    poses, points = np.zeros((count, 2, 6)), np.zeros((count, 2, 3))
    lens, residuals = np.zeros((count, 2, len(NAMES) + 2 * len(others))), np.zeros((count, 2))
    for position, image_id in enumerate(seen.images):
        rows = np.flatnonzero(seen.photos == position)
        image = model.image(image_id)
        camera, pose = model.camera(image.camera_id), image.cam_from_world()
        rotation = pose.rotation.matrix()
        rotated = seen.xyz[seen.points[rows]] @ rotation.T
        local = rotated + pose.translation
        local[local[:, 2] <= 1e-6 * np.abs(local).max(axis=1, initial=1e-300)] = np.nan
        jacobian = projection_jacobians(camera, local)
        poses[rows], points[rows] = pose_jacobians(jacobian, rotated), jacobian @ rotation
        residuals[rows] = seen.pixels[rows] - projected(camera, local)
        terms, of = _lens_terms(camera, local), seen.lenses[position]
        if of == camera_id:
            lens[rows, :, : len(NAMES)] = terms
        elif of in others:
            start = len(NAMES) + 2 * others.index(of)
            lens[rows, :, start : start + 2] = terms[:, :, [NAMES.index("f"), NAMES.index("k1")]]
    # Points that cannot be projected contribute nothing.
    finite = np.isfinite(poses).all(axis=(1, 2)), np.isfinite(lens).all(axis=(1, 2)), np.isfinite(residuals).all(axis=1)
    bad = ~np.all(finite, axis=0)
    for array in (poses, points, lens, residuals):
        array[bad] = 0
    return poses, points, lens, residuals


def projection_jacobians(camera: pycolmap.Camera, local: Array) -> Array:
    """Return pixels per unit of points (n, 3) in the camera's axes, (n, 2, 3), by central differences."""
    step = 1e-5 * np.linalg.norm(local, axis=1, keepdims=True)
    columns = [
        (projected(camera, local + step * offset) - projected(camera, local - step * offset)) / (2 * step)
        for offset in np.eye(3)
    ]
    return np.stack(columns, axis=-1)


def pose_jacobians(jacobians: Array, rotated: Array) -> Array:
    """Return pixels per unit of a rotation w after R and of t (n, 2, 6), at points RX (n, 3): d(w x RX)/dw = -[RX]x."""
    x, y, z = rotated.T
    turned = np.zeros((len(rotated), 3, 3))
    turned[:, 0, 1], turned[:, 0, 2], turned[:, 1, 2] = z, -y, x
    turned -= turned.transpose(0, 2, 1)
    return np.concatenate([jacobians @ turned, jacobians], axis=2)


def _lens_terms(camera: pycolmap.Camera, local: Array) -> Array:
    """Return pixels per unit of the `NAMES`, (n, 2, 8)."""
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    r2 = x * x + y * y
    focal, none, one = camera.mean_focal_length(), np.zeros_like(x), np.ones_like(x)
    terms = (
        (x, y),
        (x / 2, -y / 2),
        (one, none),
        (none, one),
        (focal * x * r2, focal * y * r2),
        (focal * x * r2**2, focal * y * r2**2),
        (2 * focal * x * y, focal * (r2 + 2 * y * y)),
        (focal * (r2 + 2 * x * x), 2 * focal * x * y),
    )
    return np.stack([np.stack(term, axis=-1) for term in terms], axis=-1)


def _freed(poses: Array, points: Array, lens: Array, seen: _Seen) -> Array:
    """Return the effect of lens parameters that no motion of poses and points can imitate, (n, 2, columns).

    `poses` are (n, 2, 6), or (n, 2, 8) with principal points.
    """
    count, columns = len(poses), lens.shape[2]
    by_pose = _sparse(poses, seen.photos, width=poses.shape[2] * len(seen.images))
    by_point = _sparse(points, seen.points, width=3 * len(seen.xyz))
    flat = lens.reshape(2 * count, columns)
    blocks = np.zeros((len(seen.xyz), 3, 3))
    np.add.at(blocks, seen.points, np.einsum("nij,nik->njk", points, points))
    blocks += _DAMPING * (np.trace(blocks, axis1=1, axis2=2) + 1e-300)[:, None, None] * np.eye(3)
    inverse = _sparse(np.linalg.inv(blocks), np.arange(len(blocks)), width=3 * len(blocks))
    cross = csr_array(by_point.T @ by_pose)
    cross_lens = by_point.T @ flat
    # Scaled and damped in place: with 1,000 photos, each copy has 288 MB.
    normal = (by_pose.T @ by_pose - cross.T @ (inverse @ cross)).toarray(order="F")
    right = by_pose.T @ flat - cross.T @ (inverse @ cross_lens)
    scale = np.sqrt(np.maximum(by_pose.power(2).sum(axis=0), 1e-300))
    normal /= scale
    normal /= scale[:, None]
    normal[np.diag_indices_from(normal)] += _DAMPING
    by_lens = cho_solve(cho_factor(normal, overwrite_a=True), right / scale[:, None]) / scale[:, None]
    left = flat - by_pose @ by_lens - by_point @ (inverse @ (cross_lens - cross @ by_lens))
    return np.asarray(left).reshape(count, 2, columns)


def _sparse(blocks: Array, columns: NDArray[np.int64], *, width: int) -> csr_array:
    """Return a sparse matrix of blocks (n, rows, size), with block i in row block i and column block `columns[i]`."""
    count, rows, size = blocks.shape
    places = np.repeat((columns[:, None] * size + np.arange(size))[:, None, :], rows, axis=1)
    pointers = np.arange(0, blocks.size + 1, size)
    return csr_array((blocks.ravel(), places.ravel(), pointers), shape=(rows * count, width))


def _scene_clusters(seen: _Seen, *, seed: int) -> NDArray[np.int64]:
    """Return the scene part of each observation, (n,); far points are moved nearer, so that they form one part."""
    offsets = seen.xyz - np.median(seen.xyz, axis=0)
    distances = np.linalg.norm(offsets, axis=1)
    typical = np.median(distances) + 1e-300
    drawn = offsets / np.maximum(distances / (3 * typical), 1)[:, None]
    count = min(8, len(drawn))
    _, labels = kmeans2(drawn / typical, count, minit="++", rng=np.random.default_rng(seed), missing="warn")
    return labels.astype(np.int64)[seen.points]


def _summed(values: Array, labels: NDArray[np.int64]) -> Array:
    _, places = np.unique(labels, return_inverse=True)
    total = np.zeros((int(places.max(initial=-1)) + 1, *values.shape[1:]))
    np.add.at(total, places, values)
    return total


def lens_values(camera: pycolmap.Camera) -> Array:
    """Return the values of the `NAMES` of a camera, (8,): a principal point from the centre, 0 for absent terms."""
    extra = camera.params[list(camera.extra_params_idxs())] if parameters_of(camera) else ()
    x, y = camera.principal_point_x - camera.width / 2, camera.principal_point_y - camera.height / 2
    values = [camera.mean_focal_length(), camera.focal_length_x - camera.focal_length_y, x, y, *extra]
    return np.array([*values, *[0.0] * (len(NAMES) - len(values))])


def camera_with(camera: pycolmap.Camera, name: str, values: Array) -> pycolmap.Camera:
    """Return a camera of the COLMAP model `name` with these values of the `NAMES`, as far as the model has them."""
    focal, difference, x, y, *extra = values.tolist()
    new = pycolmap.Camera.create_from_model_name(camera.camera_id, name, focal, camera.width, camera.height)
    if len(new.focal_length_idxs()) == 2:
        new.focal_length_x, new.focal_length_y = focal + difference / 2, focal - difference / 2
    new.principal_point_x, new.principal_point_y = camera.width / 2 + x, camera.height / 2 + y
    indices = list(new.extra_params_idxs())
    params = np.array(new.params)
    params[indices] = extra[: len(indices)]
    new.params = params.tolist()
    new.has_prior_focal_length = camera.has_prior_focal_length
    return new
