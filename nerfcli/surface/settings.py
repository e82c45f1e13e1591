"""Settings of an exported geometry: region, resolution, size."""

from dataclasses import dataclass

# Sides of the pictures whose depths are fused, in pixels, and how many photos are looked through.
MAX_SIZE, MOST_VIEWS = 480, 150
FACES = 300_000


@dataclass(frozen=True)
class SurfaceSettings:
    """Settings of extracting a geometry from a field.

    Args:
        box: low and high corner x0, y0, z0, x1, y1, z1 in the scene's frame and unit; None for what the photos see.
        voxel_size: scene units; None for what the photos resolve.
        faces: triangles at most.
        max_size: longer side of the pictures whose depths are fused, pixels.
    """

    box: tuple[float, ...] | None = None
    voxel_size: float | None = None
    faces: int = FACES
    max_size: int = MAX_SIZE
