"""The camera axes of other programs and of OpenCV: the only place where they meet.

Inside nerfcli a camera has OpenCV axes: +x right, +y down, +z forward. Turning the camera's own axes multiplies
`world_from_cam` from the right: the world stays as it is.
"""

import numpy as np

# OpenGL, Blender, NeRF, nerfstudio and instant-ngp: +x right, +y up, +z backward. Its own inverse.
# Source: docs.nerf.studio, "Data conventions"; instant-ngp docs/nerf_dataset_tips.md.
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

# LLFF: +x down, +y right, +z backward. Columns: where its axes point in OpenCV axes.
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
    """`world_from_cam` (..., 4, 4) with OpenCV axes, of a pose with OpenGL axes."""
    return world_from_opengl_cam @ OPENCV_FROM_OPENGL


def opengl_from_opencv_pose(world_from_cam: np.ndarray) -> np.ndarray:
    """Return the pose (..., 4, 4) with OpenGL axes, of `world_from_cam` with OpenCV axes."""
    return world_from_cam @ OPENCV_FROM_OPENGL


def opencv_from_llff_pose(world_from_llff_cam: np.ndarray) -> np.ndarray:
    """`world_from_cam` (..., 4, 4) with OpenCV axes, of a pose whose columns are down, right, backward, centre."""
    return world_from_llff_cam @ OPENCV_FROM_LLFF.T


def llff_from_opencv_pose(world_from_cam: np.ndarray) -> np.ndarray:
    """Return the pose (..., 4, 4) whose columns are down, right, backward, centre,
    of `world_from_cam` with OpenCV axes.
    """
    return world_from_cam @ OPENCV_FROM_LLFF
