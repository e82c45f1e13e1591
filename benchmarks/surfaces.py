"""Meshes against a true or a measured surface: accuracy, completeness and F-score at 1, 2 and 5 cm.

    python benchmarks/surfaces.py desk-run
    python benchmarks/surfaces.py kitchen-run --sensor path/to/redkitchen --voxel-size 0.02

RUN was trained in metres: on the desk with its true cameras (`sample_scenes/desk/truth`), or on the scene that
`benchmarks/depth.py redkitchen` writes. The true surface consists of the points of the desk's six true depth maps, or
of every tenth depth map of the sensor, inside the box. Of a mesh, only points up to 5 cm behind the depth of one of
these views count. Three surfaces are compared with the same voxels: from signed distances of median depths, as in
`nerfcli export --to mesh`; from those of conditional depths; and from a density threshold, the one of several with the
best F-score at 1 cm.
"""

import json
import time
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import torch
import typer
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

from nerfcli.cameras.camera import Camera
from nerfcli.export.depth_views import depth_views
from nerfcli.export.extent import Grid, scene_box
from nerfcli.export.fusion import fuse
from nerfcli.export.meshes import Mesh, mesh_of, simplified, surface_of, without_small_pieces
from nerfcli.kernels import grid_coordinates
from nerfcli.render.depth import DepthRequest
from nerfcli.render.files.float_maps import read_tiff
from nerfcli.render.model import Model
from nerfcli.training.runs.run import load_run

DESK = Path(__file__).parent.parent / "sample_scenes" / "desk" / "truth"
THRESHOLDS = (5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
SAMPLES, THINNED = 200_000, 0.0025
BEHIND, LEVELS = 0.05, (0.01, 0.02, 0.05)
SENSOR_EVERY = 10


def desk_views() -> tuple[Camera, list[tuple[np.ndarray, np.ndarray]]]:
    """Return the camera of the desk, and pose and true z of six photos."""
    recorded = json.loads((DESK / "cameras.json").read_text(encoding="utf-8"))
    depths = {image["name"]: DESK / "depth" / f"{Path(image['name']).stem}.tiff" for image in recorded["images"]}
    images = [image for image in recorded["images"] if depths[image["name"]].exists()]
    views = [(np.array(image["world_from_cam"]), read_tiff(depths[image["name"]])) for image in images]
    return Camera.from_json(recorded["camera"]), views


def sensor_views(capture: Path) -> tuple[Camera, list[tuple[np.ndarray, np.ndarray]]]:
    """Return the depth camera of an RGB-D video (pose/, depth/ in mm), and pose and measured z of some frames."""
    matrix = np.loadtxt(capture / "camera-intrinsics.txt")
    camera = Camera("PINHOLE", 640, 480, (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
    views = []
    for path in sorted((capture / "depth").glob("*.png"))[::SENSOR_EVERY]:
        levels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert levels is not None
        depth = np.where((levels > 0) & (levels < 65535), levels / 1000.0, np.nan)
        views.append((np.loadtxt(capture / "pose" / f"{path.stem}.txt"), depth))
    return camera, views


class Truth:
    """The true surface inside a box.

    Args:
        camera: of all views.
        views: world_from_cam and z of each.
        box: low and high corner, metres.
    """

    def __init__(self, camera: Camera, views: list[tuple[np.ndarray, np.ndarray]], box: tuple[float, ...]):
        self.camera, self.views = camera, views
        self.low, self.high = np.array(box[:3]), np.array(box[3:])
        parts = []
        directions, valid = self.camera.pixel_bearings()
        for pose, depth in views:
            kept = valid & np.isfinite(depth.ravel())
            points = directions[kept] * (depth.ravel()[kept] / directions[kept, 2])[:, None]
            parts.append(points @ pose[:3, :3].T + pose[:3, 3])
        points = np.concatenate(parts)
        points = points[self._inside(points)]
        cells = np.floor(points / THINNED).astype(np.int64)
        self.points = points[np.unique(cells, axis=0, return_index=True)[1]]
        self.tree = KDTree(self.points)

    def _inside(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(((points >= self.low) & (points <= self.high)).all(axis=1))

    def could_see(self, points: np.ndarray) -> np.ndarray:
        """Return which points (N,) a view shows, or would show if they were up to 5 cm nearer."""
        seen = np.zeros(len(points), dtype=bool)
        for pose, depth in self.views:
            local = (points - pose[:3, 3]) @ pose[:3, :3]
            pixels, valid = self.camera.project(local)
            column, row = np.floor(pixels).astype(int).T
            valid &= (column >= 0) & (row >= 0) & (column < self.camera.width) & (row < self.camera.height)
            seen[valid] |= local[valid, 2] <= depth[row[valid], column[valid]] + BEHIND
        return seen

    def compare(self, mesh: Mesh) -> dict[str, float]:
        """Return accuracy and completeness (mean distances, mm) and F-scores of a mesh."""
        points = samples_of(mesh)
        points = points[self._inside(points)]
        points = points[self.could_see(points)]
        accuracy = self.tree.query(points)[0]
        completeness = KDTree(points).query(self.points)[0]
        found = {"accuracy_mm": 1e3 * accuracy.mean(), "completeness_mm": 1e3 * completeness.mean()}
        found |= {"median_accuracy_mm": 1e3 * float(np.median(accuracy))}
        for level in LEVELS:
            precision, recall = (accuracy < level).mean(), (completeness < level).mean()
            name = f"{100 * level:g}cm"
            found |= {f"precision_{name}": precision, f"recall_{name}": recall}
            found |= {f"F_{name}": 2 * precision * recall / max(precision + recall, 1e-9)}
        return {key: round(float(value), 4) for key, value in found.items()}


def samples_of(mesh: Mesh) -> np.ndarray:
    """Return random points (N, 3), uniform over the area of a mesh."""
    rng = np.random.default_rng(0)
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = rng.choice(len(area), SAMPLES, p=area / area.sum())
    a, b = rng.random((2, SAMPLES, 1))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    first, second, third = corners[chosen].transpose(1, 0, 2)
    return first + a * (second - first) + b * (third - first)


@torch.no_grad()
def density_at(model: Model, points: np.ndarray) -> np.ndarray:
    """Return the field's density (N,) float32 per scene unit at points in the scene's frame; 0 in skipped cells."""
    places = torch.as_tensor(model.training_from_scene.apply(points), dtype=torch.float32, device=model.device)
    coordinates = grid_coordinates(places, model.contraction)
    inside = ((coordinates >= 0) & (coordinates <= 1)).all(-1)
    side = model.occupied.shape[0]
    x, y, z = (coordinates.clamp(0, 1) * side).long().clamp_max(side - 1).unbind(-1)
    kept = (inside & model.occupied[z, y, x]).nonzero()[:, 0]
    density = torch.zeros(len(places), device=model.device)
    medium = model.field.medium()
    for part in kept.split(2**18):
        density[part] = model.field.backend.density(coordinates[part].contiguous(), medium)
    return (density * model.training_from_scene.scale).cpu().numpy()


def main(
    run: Path,
    sensor: Annotated[Path | None, typer.Option(help="Folder of the RGB-D video; the desk without.")] = None,
    voxel_size: Annotated[float, typer.Option(help="Metres.")] = 0.005,
    max_size: Annotated[int, typer.Option(help="Longer side of the pictures that are fused, pixels.")] = 480,
) -> None:
    """Print a line of JSON for each surface."""
    opened = load_run(run)
    model = opened.model()
    box = scene_box(model, opened.cameras.train)
    grid, truth = Grid.over(box, voxel_size), Truth(*(desk_views() if sensor is None else sensor_views(sensor)), box)
    for name in ("median", "conditional"):
        began = time.perf_counter()
        views = depth_views(model, opened.cameras.train, max_size=max_size, depth=DepthRequest(name, "z"))
        rendered = time.perf_counter()
        mesh = without_small_pieces(surface_of(fuse(views, grid)))
        seconds = {"render_s": round(rendered - began, 1), "fuse_s": round(time.perf_counter() - rendered, 1)}
        _tell(f"signed distances of {name} depths", mesh, truth, seconds)
        if name == "median":
            began = time.perf_counter()
            small = simplified(mesh, 100_000, threads=1)
            seconds = {"simplify_s": round(time.perf_counter() - began, 1)}
            _tell("the same, at most 100,000 faces", small, truth, seconds)
    began = time.perf_counter()
    layers = (np.indices((1, *grid.shape[1:])).reshape(3, -1).T + np.array([x, 0, 0]) for x in range(grid.shape[0]))
    density = np.concatenate([density_at(model, grid.centres(layer)) for layer in layers]).reshape(grid.shape)
    meshes = []
    for threshold in THRESHOLDS:
        vertices, faces, _, _ = marching_cubes(density, threshold, gradient_direction="ascent")
        meshes.append((threshold, without_small_pieces(mesh_of(grid.centres(vertices.astype(float)), faces))))
    seconds = {"seconds": round(time.perf_counter() - began, 1)}
    best = max(meshes, key=lambda entry: truth.compare(entry[1])["F_1cm"])
    _tell(f"density above {best[0]:g} per metre", best[1], truth, seconds)


def _tell(name: str, mesh: Mesh, truth: Truth, seconds: dict[str, float]) -> None:
    print(json.dumps({"surface": name, "faces": len(mesh.faces), **truth.compare(mesh), **seconds}), flush=True)


if __name__ == "__main__":
    typer.run(main)
