"""Pairs of photos whose matches mislead: no motion with the rotations that the other pairs agree on explains them.

Textures that repeat, such as knitted cloth, give pairs with many wrong matches that agree on a wrong motion. Where such
pairs are many, mapping takes wrong turns, slowly. Before any photo is placed, rotations can tell: around each loop of
pairs they multiply to the identity, and those of all photos that fit the pairs best take a tenth of a second.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pycolmap

from nerfcli.poses.input.job import Solver
from nerfcli.poses.model.projection import Array
from nerfcli.poses.model.two_views import VerifiedPair, compared, fitting, own_pose, rays

# Rotations of all photos are known if, of all matches, this fraction is in pairs that they fit to within this angle.
_CONSISTENT, _CONSISTENT_DEG = 0.9, 5.0
# A pair that they do not fit to within this angle is tested; a motion that turns farther away is another one.
_FAR_DEG = 10.0
# Pairs mislead if those with this many matches are at least this fraction of all: a few are outvoted.
_STRONG_MATCHES, _MANY = 50, 0.01
# Matches of a pair that are used.
_MATCHES = 200
# Distance of rays from the plane of a match, in radians, beyond which a match hardly counts for the direction.
_NOISE = 0.01


def misleading_pairs(
    pairs: Sequence[VerifiedPair], cameras: Mapping[int, pycolmap.Camera], solver: Solver
) -> frozenset[frozenset[int]]:
    """Return the pairs, as image ids, that no motion with the rotations of the other pairs explains.

    `cameras` are those of the photos, by image id. Empty unless such pairs are many and strong, and most others agree:
    with a wrong focal length, they do not.
    """
    with ThreadPoolExecutor(solver.threads) as pool:
        poses = pool.map(partial(_own_pose, cameras=cameras, seed=solver.seed), pairs)
        found = [(pair, pose) for pair, pose in zip(pairs, poses, strict=True) if pose is not None]
        rotations = averaged_rotations(found, seed=solver.seed)
        judged = [(pair, pose) for pair, pose in found if {pair.one, pair.other} <= rotations.keys()]
        turns = [rotations[pair.other] * rotations[pair.one].inverse() for pair, _ in judged]
        off = [pose.rotation * turn.inverse() for (_, pose), turn in zip(judged, turns, strict=True)]
        degrees = np.degrees([rotation.angle() for rotation in off])
        matches = np.array([pair.matches for pair, _ in judged])
        if not judged or matches[degrees < _CONSISTENT_DEG].sum() < _CONSISTENT * matches.sum():
            return frozenset()
        far = [index for index in range(len(judged)) if degrees[index] > _FAR_DEG]
        explained = pool.map(lambda index: explains(turns[index], judged[index][0], cameras), far)
        misleading = [judged[index][0] for index, fits in zip(far, explained, strict=True) if not fits]
    strong = sum(pair.matches >= _STRONG_MATCHES for pair in misleading)
    if strong < _MANY * len(pairs):
        return frozenset()
    return frozenset(frozenset((pair.one, pair.other)) for pair in misleading)


def averaged_rotations(
    pairs: Sequence[tuple[VerifiedPair, pycolmap.Rigid3d]], *, seed: int
) -> dict[int, pycolmap.Rotation3d]:
    """Return the rotations of the photos from the world, by image id, that fit the relative poses of pairs best.

    Photos that no chain of pairs connects with the largest group are left out.

    Source: Chatterjee and Govindu 2013, Efficient and Robust Large-Scale Rotation Averaging.
    """
    # pycolmap asks for photos and cameras, and uses nothing of them.
    photos, graph = pycolmap.Reconstruction(), pycolmap.PoseGraph()
    photos.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 1.0, 1, 1))
    for photo in sorted({photo for pair, _ in pairs for photo in (pair.one, pair.other)}):
        photos.add_image_with_trivial_frame(pycolmap.Image(image_id=photo, camera_id=1, name=str(photo)))
    for pair, pose in pairs:
        edge = pycolmap.PoseGraphEdge(cam2_from_cam1=pose, num_matches=pair.matches)
        graph.add_edge(pair.one, pair.other, edge)
    pycolmap.run_rotation_averaging(pycolmap.RotationEstimatorOptions(random_seed=seed), graph, photos, [])
    return {photo: photos.image(photo).cam_from_world().rotation for photo in photos.reg_image_ids()}


def _own_pose(pair: VerifiedPair, *, cameras: Mapping[int, pycolmap.Camera], seed: int) -> pycolmap.Rigid3d | None:
    found = own_pose((cameras[pair.one], cameras[pair.other]), _some(pair), seed=seed)
    return None if found is None else found[0]


def explains(rotation: pycolmap.Rotation3d, pair: VerifiedPair, cameras: Mapping[int, pycolmap.Camera]) -> bool:
    """Return whether most matches of a pair fit a motion with about this rotation.

    The direction of the motion is perpendicular to the normal of each match's plane; then both are refined.
    """
    lenses, pixels = (cameras[pair.one], cameras[pair.other]), _some(pair)
    one, other = (rays(camera, places) for camera, places in zip(lenses, pixels, strict=True))
    normals = np.cross(one @ rotation.matrix().T, other)
    seen = np.isfinite(normals).all(axis=1)
    direction, distances = np.zeros(3), np.zeros(int(seen.sum()))
    for _ in range(10):
        weighted = normals[seen] / np.sqrt(1.0 + (distances / _NOISE) ** 2)[:, None]
        direction = np.linalg.eigh(weighted.T @ weighted)[1][:, 0]
        distances = normals[seen] @ direction
    near = np.abs(distances) < 5.0 * _NOISE
    if 2 * near.sum() < len(normals):  # without any, pycolmap's refinement ends the process
        return False
    start = pycolmap.Rigid3d(rotation, direction)
    refined = pycolmap.refine_relative_pose(
        start, lenses[0], pixels[0][seen], lenses[1], pixels[1][seen], inlier_mask=near[:, None]
    )
    if refined is None:
        return False
    pose = refined["cam2_from_cam1"]
    if np.degrees((pose.rotation * rotation.inverse()).angle()) > _FAR_DEG:
        return False
    opposite = pycolmap.Rigid3d(pose.rotation, -pose.translation)
    return max(fitting(compared(lenses, pixels, each)) for each in (pose, opposite)) >= 0.5


def _some(pair: VerifiedPair) -> tuple[Array, Array]:
    step = -(-pair.matches // _MATCHES)
    return pair.pixels_one[::step], pair.pixels_other[::step]
