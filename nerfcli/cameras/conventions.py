"""Conversions between the camera axes of OpenCV and of other programs, all in this one place.

Inside nerfcli a camera has OpenCV axes: +x right, +y down, +z forward. A change of camera axes multiplies
`world_from_cam` from the right; the world frame stays the same.
"""

import numpy as np

# OpenGL, Blender, NeRF, nerfstudio and instant-ngp: +x right, +y up, +z backward. Its own inverse.
# Source: docs.nerf.studio, "Data conventions"; instant-ngp docs/nerf_dataset_tips.md.
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

# LLFF: +x down, +y right, +z backward. The columns are LLFF's axes in OpenCV axes.
# Source: Fyusion/LLFF README, "Using your own poses without running COLMAP": "[-y, x, z]" of the NeRF axes.
OPENCV_FROM_LLFF = np.array(
    [
        [0.0, 1.0, 0.0, 0.0],
        [1.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, -1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def opencv_from_opengl_pose(world_from_opengl_cam: np.ndarray) -> np.ndarray:
    """Return `world_from_cam` (..., 4, 4) with OpenCV axes, given a pose with OpenGL axes."""
    return world_from_opengl_cam @ OPENCV_FROM_OPENGL


def opengl_from_opencv_pose(world_from_cam: np.ndarray) -> np.ndarray:
    """Return the pose (..., 4, 4) with OpenGL axes, given `world_from_cam` with OpenCV axes."""
    return world_from_cam @ OPENCV_FROM_OPENGL


def opencv_from_llff_pose(world_from_llff_cam: np.ndarray) -> np.ndarray:
    """Return `world_from_cam` (..., 4, 4) with OpenCV axes, given a pose with columns down, right, backward, centre."""
    return world_from_llff_cam @ OPENCV_FROM_LLFF.T


def llff_from_opencv_pose(world_from_cam: np.ndarray) -> np.ndarray:
    """Return the pose (..., 4, 4) with columns down, right, backward, centre, given `world_from_cam` (OpenCV axes)."""
    return world_from_cam @ OPENCV_FROM_LLFF
