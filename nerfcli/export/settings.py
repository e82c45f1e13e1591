"""Settings of exported geometry: region, resolution, size."""

from dataclasses import dataclass

# Longer side in pixels of the pictures whose depths are fused, and most photos to render.
MAX_SIZE, MOST_VIEWS = 480, 150
FACES = 300_000


@dataclass(frozen=True)
class SurfaceSettings:
    """Settings for extracting geometry from a field.

    Args:
        box: low and high corner x0, y0, z0, x1, y1, z1 in the scene's frame and unit; None for the photos'
            subject.
        voxel_size: scene units; None for the resolution of the photos.
        faces: most triangles.
        max_size: longer side of the pictures whose depths are fused, pixels.
    """

    box: tuple[float, ...] | None = None
    voxel_size: float | None = None
    faces: int = FACES
    max_size: int = MAX_SIZE
