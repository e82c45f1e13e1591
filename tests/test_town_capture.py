"""benchmarks/town_capture.py: rendered photos agree with the poses of their cameras."""

import cv2
import numpy as np
from town_capture import photo, walk

SIZE, FOCAL_PX = (160, 120), 112.0
K = np.array([[FOCAL_PX, 0, 80], [0, FOCAL_PX, 60], [0, 0, 1]])


def test_the_ground_moves_as_a_plane_does():
    """Independent: photo 10, warped by OpenCV with the ground's homography, matches photo 11 below the horizon."""
    one, other = walk(12)[10:12]
    first, second = (photo(pose, size=SIZE, focal_px=FOCAL_PX).mean(axis=2) for pose in (one, other))

    def from_ground(world_from_cam: np.ndarray) -> np.ndarray:
        """Return the homography from points (x, y, 1) on the ground, z = 0, to pixels."""
        cam_from_world = np.linalg.inv(world_from_cam)[:3]
        return K @ cam_from_world[:, [0, 1, 3]]

    moved = cv2.warpPerspective(first, from_ground(other) @ np.linalg.inv(from_ground(one)), SIZE)
    below = np.zeros((120, 160), bool)
    below[85:118, 60:100] = True  # the street in front, not the walls
    still = np.abs(first - second)[below].mean()
    warped = np.abs(moved - second)[below].mean()
    assert warped < 0.35 * still


def test_the_walk_has_equal_steps_and_comes_back():
    """By the plan of the loops: around a block of 24 m with cut corners, back after 151 photos at steps of 0.6 m."""
    poses = walk(1000)
    centres = poses[:, :3, 3]
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert 0.4 < steps.min() < np.median(steps) < steps.max() < 1.0
    np.testing.assert_allclose(
        np.swapaxes(poses[:, :3, :3], 1, 2) @ poses[:, :3, :3], np.tile(np.eye(3), (1000, 1, 1)), atol=1e-12
    )
    assert np.linalg.norm(centres[[151, 459, 765]] - centres[0], axis=1).max() < 2.5
    assert np.linalg.norm(centres[40:110] - centres[0], axis=1).min() > 20
