"""Geometry taken out of fields: where surfaces are, in which frame and unit, and what the files say."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import completed, error_of, nerfcli
from fog import fog, foggy_cells

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.cameras.framing import equirectangular
from nerfcli.cameras.layout import up_direction
from nerfcli.cameras.rigid import Similarity, look_at, rotation_from_vector
from nerfcli.errors import UserError
from nerfcli.export import extent
from nerfcli.export.depth_views import DepthView, depth_views, normals_of, plane_rays, point_colours, surface_colours
from nerfcli.export.extent import Grid, SurfaceSettings, scene_box
from nerfcli.export.fusion import FusedVolume, agreed_points, fuse
from nerfcli.export.mesh_facts import read_glb_json
from nerfcli.export.meshes import mesh_of, simplified, surface_of, without_small_pieces, write_glb
from nerfcli.photos.loading import pinhole_of, undistorted
from nerfcli.ply import read_ply_header, read_ply_mesh, read_ply_vertices, write_ply
from nerfcli.render.model import Model, save_model
from nerfcli.training.runs.files import FIELD
from nerfcli.training.runs.run import Run
from nerfcli.workflows.describe import describe
from nerfcli.workflows.export import export_run

RADIUS, CENTRE = 0.5, np.array([3.0, -2.0, 1.0])
CAMERA = Camera("PINHOLE", 120, 90, (130.0, 126.0, 58.3, 46.1))


def ball_view(place: np.ndarray, *, name: str = "a.png") -> DepthView:
    """Return a camera's view of an opaque ball with nothing behind it, in closed form."""
    pose = look_at(place, CENTRE, np.array([0.1, 0.2, 1.0]))
    rays = plane_rays(CAMERA) @ pose[:3, :3].T
    off = place - CENTRE
    a, b, c = (rays * rays).sum(-1), (rays * off).sum(-1), off @ off - RADIUS**2
    root = b * b - a * c
    depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.nan).astype(np.float32)
    hit = np.isfinite(depth)
    return DepthView(
        frame=Frame(name, CAMERA, pose),
        rgb=np.full((*depth.shape, 3), 0.5, np.float32),
        opacity=hit.astype(np.float32),
        depth=depth,
        spread=np.where(hit, np.float32(1e-4), np.float32(np.nan)),
        disagreement=np.where(hit, np.float32(0), np.float32(np.nan)),
        normals=normals_of(depth, CAMERA),
    )


def around(reach: float, voxel_size: float) -> Grid:
    """Return the voxels within a distance of the ball's centre along each axis."""
    return Grid.over((*(CENTRE - reach), *(CENTRE + reach)), voxel_size)


def places_around(count: int) -> np.ndarray:
    """Places on a sphere around the ball, evenly spread (Fibonacci)."""
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    across = np.sqrt(1 - z * z)
    return CENTRE + 2.0 * np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=-1)


@pytest.fixture(scope="module")
def ball_views() -> list[DepthView]:
    return [ball_view(place, name=f"{index}.png") for index, place in enumerate(places_around(14))]


@pytest.fixture(scope="module")
def fused(ball_views) -> FusedVolume:
    return fuse(ball_views, around(0.7, 0.025))


# Depth maps to surfaces


@pytest.mark.parametrize("looks_out", [False, True])
def test_the_box_leaves_out_what_is_far_behind(looks_out, monkeypatch):
    """Also if everything seen is outside the unit ball, which is around the cameras for a narrow baseline."""
    place = CENTRE - np.array([0.0, 3.0, 0.0])
    near, far = ball_view(place), ball_view(place)
    far = replace(far, depth=far.depth[::2, ::2] * 10, frame=replace(far.frame, camera=CAMERA.resized(60, 45)))
    monkeypatch.setattr(extent, "depth_views", lambda *given, **named: [near, far])
    middle = place if looks_out else CENTRE
    model = fog(torch.ones(16, 16, 16, dtype=torch.bool), Similarity(1.0, np.eye(3), -middle))
    low, high = np.array(scene_box(model, ())).reshape(2, 3)
    np.testing.assert_allclose(low, CENTRE - [RADIUS, RADIUS, RADIUS], atol=0.15)
    assert (high < CENTRE + RADIUS + 0.15).all()


def test_a_panorama_shows_the_surfaces_all_around():
    """Regression: only those within 100 degrees ahead of it were in meshes, points and boxes."""
    shell = foggy_cells((-0.8, -0.8, -0.8), (0.8, 0.8, 0.8)) & ~foggy_cells((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    model, pose = replace(block(), occupied=shell), np.eye(4)
    pose[:3, 3] = SIMILARITY.inverse().apply(np.array([0.1, -0.2, 0.0]))
    views = depth_views(model, [Frame("a.jpg", equirectangular(128, 64), pose)], max_size=48)
    assert all(np.isfinite(view.depth).all() and max(view.frame.camera.size) == 24 for view in views)
    points = model.training_from_scene.apply(np.concatenate([view.points().reshape(-1, 3) for view in views]))
    np.testing.assert_allclose(np.abs(points).max(axis=1), 0.5, atol=0.02)  # on the walls, all six of them
    np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], [[-0.5] * 3, [0.5] * 3], atol=0.02)


def test_normals_of_a_plane_are_its_own():
    normal = np.array([0.3, -0.2, -1.0])
    depth = (2.0 / -(plane_rays(CAMERA) @ normal)).astype(np.float32)
    expected = np.broadcast_to(normal / np.linalg.norm(normal), (90, 120, 3))
    np.testing.assert_allclose(normals_of(depth, CAMERA), expected, atol=2e-4)
    hole = depth.copy()
    hole[40:50, 40:50] = np.nan
    assert np.isnan(normals_of(hole, CAMERA)).all(-1).sum() == 100


def test_the_mesh_of_a_ball_is_the_ball(fused):
    mesh = surface_of(fused)
    off = np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS
    assert len(mesh.faces) > 5000
    assert np.sqrt((off**2).mean()) < 0.06 * 0.025
    assert np.abs(off).max() < 0.5 * 0.025
    # Pictures shifted by half a pixel would move or swell it by 0.2 voxels.
    assert np.abs(off.mean()) < 0.03 * 0.025
    assert np.abs(mesh.vertices.mean(0) - CENTRE).max() < 0.05 * 0.025
    outwards = (mesh.normals * (mesh.vertices - CENTRE)).sum(1) / RADIUS
    assert outwards.min() > 0.9


def test_the_mesh_of_a_ball_has_no_gap_between_blocks_and_bricks(fused):
    mesh = without_small_pieces(surface_of(fused))
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 2).all()  # closed: each edge has a triangle on both sides
    assert len(mesh.vertices) - len(counts) + len(mesh.faces) == 2  # Euler's number of a sphere


def test_what_no_photo_sees_is_not_closed():
    """One side of the ball is seen: the mesh ends with it, and no face reaches the side that was not seen."""
    views = [ball_view(CENTRE + np.array([2.0, 0.1 * step, 0.05])) for step in range(3)]
    mesh = surface_of(fuse(views, around(0.7, 0.025)))
    off = np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS
    assert np.abs(off).max() < 0.025
    assert (mesh.vertices[:, 0] - CENTRE[0]).min() > -0.05
    assert np.abs((mesh.normals * (mesh.vertices - CENTRE)).sum(1)).min() > 0.5 * RADIUS


def test_the_order_of_the_photos_changes_the_last_digits_alone(ball_views, fused):
    again = fuse(ball_views[::-1], fused.grid)
    np.testing.assert_array_equal(again.index, fused.index)
    np.testing.assert_allclose(again.distance, fused.distance, atol=1e-6)


def test_rays_that_meet_nothing_clear_what_stands_in_them(ball_views):
    """A floater that one photo sees, in space that others see to be free."""
    wrong = ball_views[0]
    depth, opacity = wrong.depth.copy(), wrong.opacity.copy()
    depth[:12, :12], opacity[:12, :12] = 1.4, 1.0
    spread = np.where(np.isfinite(depth), np.float32(1e-4), np.float32(np.nan))
    floating = replace(wrong, opacity=opacity, depth=depth, spread=spread, normals=normals_of(depth, CAMERA))
    mesh = surface_of(fuse([floating, *ball_views[1:]], around(1.2, 0.03)))
    assert np.linalg.norm(mesh.vertices - CENTRE, axis=1).max() < RADIUS + 0.03


def test_points_of_a_ball_are_on_it_and_say_how_well_they_are_seen(ball_views):
    grid = around(0.7, 0.05)
    points = agreed_points(ball_views, grid)
    off = np.linalg.norm(points.places - CENTRE, axis=1) - RADIUS
    assert np.abs(off).max() < 1e-5
    outwards = (points.places - CENTRE) / RADIUS
    assert (points.normals * outwards).sum(1).min() > 0.95
    cells = np.floor((points.places - grid.low) / 0.05)
    assert len(np.unique(cells, axis=0)) == len(cells) > 300
    # A photo sees a point of the ball if it looks at its tangent plane from outside, not from the side.
    cosines = np.array([[facing(view.frame.centre, place) for view in ball_views] for place in points.places])
    wanted = cosines > 0.1
    assert np.abs(wanted.sum(axis=1) - points.photos).max() <= 3  # a pixel of an outline may be another's
    firm = np.flatnonzero(np.abs(cosines - 0.1).min(axis=1) > 0.2)
    assert len(firm) > 30
    np.testing.assert_array_equal(points.photos[firm], wanted[firm].sum(axis=1))
    for index in firm:
        rays = [ball_views[view].frame.centre - points.places[index] for view in np.flatnonzero(wanted[index])]
        between = [a @ b / np.linalg.norm(a) / np.linalg.norm(b) for a in rays for b in rays]
        assert points.parallax_deg[index] == pytest.approx(np.degrees(np.arccos(min(between))), abs=1e-2)


def facing(centre: np.ndarray, point: np.ndarray) -> float:
    """Return the cosine between the ball's normal at a point and the direction to a camera."""
    return float((centre - point) @ (point - CENTRE) / np.linalg.norm(centre - point) / RADIUS)


def test_a_point_that_one_photo_alone_sees_is_left_out(ball_views):
    assert len(agreed_points(ball_views[:1], around(0.7, 0.05)).places) == 0


def test_fewer_faces_are_about_the_same_ball(fused):
    mesh = surface_of(fused)
    small = simplified(mesh, 2000, threads=1)
    assert 1000 < len(small.faces) <= 2100
    off = np.linalg.norm(small.vertices - CENTRE, axis=1) - RADIUS
    assert np.abs(off).max() < 0.4 * 0.025
    assert simplified(mesh, len(mesh.faces), threads=1) is mesh


def test_small_pieces_are_left_out(fused):
    mesh = surface_of(fused)
    speck = np.array([[9.0, 9, 9], [9, 9, 9.1], [9, 9.1, 9]])
    faces = np.concatenate([mesh.faces, len(mesh.vertices) + np.arange(3)[None]])
    both = mesh_of(np.concatenate([mesh.vertices, speck]), faces)
    kept = without_small_pieces(both)
    assert len(kept.faces) == len(mesh.faces)
    assert np.abs(kept.vertices).max() < 9


# Of fields

SIMILARITY = Similarity(0.4, rotation_from_vector(np.array([0.3, 0.5, -0.2])), np.array([0.2, -0.1, 0.4]))


def block(similarity: Similarity = SIMILARITY) -> Model:
    """A dense grey block, [-0.5, 0.5]^3 of the training frame."""
    model = fog(foggy_cells((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)), similarity, unit="metre", step=1 / 64)
    with torch.no_grad():
        model.field.weights[1][0, 0] = 7.0  # type: ignore[index]
    return model


def test_colours_are_those_of_the_field():
    model, inverse = block(), SIMILARITY.inverse()
    points = inverse.apply(np.array([[0.5, 0.1, 0.2], [-0.2, -0.5, 0.0]]))
    normals = np.array([[1.0, 0, 0], [0, -1.0, 0]]) @ SIMILARITY.rotation
    np.testing.assert_allclose(surface_colours(model, points, normals, voxel_size=0.02), 128, atol=1)
    np.testing.assert_allclose(point_colours(model, inverse.apply(np.zeros((1, 3)))), 0.5, atol=1e-3)


# Files


def ball_mesh() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) + 0.25
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [128, 128, 128]], np.uint8)
    return vertices, faces, colours


def test_a_ply_comes_back_and_says_what_it_is(tmp_path):
    vertices, faces, _ = ball_mesh()
    source = "2 known distances (Hügel.txt), ± 0.3 %"
    described = {"format": "nerfcli geometry 1", "unit": "metre", "unit_source": source, "frame": "of the scene"}
    write_ply(tmp_path / "a.ply", dict(zip("xyz", vertices.T, strict=True)), faces=faces, description=described)
    again, triangles = read_ply_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(again, vertices)
    np.testing.assert_array_equal(triangles, faces)
    comments = read_ply_header(tmp_path / "a.ply").comments
    assert r"unit metre (2 known distances (H\xfcgel.txt), +- 0.3 %)" in comments
    assert json.loads(comments[-1].partition(" ")[2])["unit_source"] == source
    assert "frame of the scene" in comments
    facts = describe(tmp_path / "a.ply")
    assert (facts["kind"], facts["vertices"], facts["faces"], facts["unit"]) == ("mesh", 4, 4, "metre")
    assert facts["format"] == "PLY"


@pytest.mark.parametrize("far", [0.0, 1e6])
def test_a_glb_holds_the_frame_and_turns_it_in_its_root_node(far, tmp_path):
    vertices, faces, colours = ball_mesh()
    z_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    path = tmp_path / "a.glb"
    mesh = mesh_of(vertices + far, faces)
    write_glb(path, mesh, colours=colours, y_up_from_frame=z_up, description={"unit": "metre"})
    content = read_glb_json(path)
    assert content["asset"]["extras"] == {"unit": "metre"}
    data = path.read_bytes()
    assert int.from_bytes(data[8:12], "little") == len(data)
    start = 20 + int.from_bytes(data[12:16], "little") + 8
    view, accessor = content["bufferViews"][0], content["accessors"][0]
    stored = np.frombuffer(data, "<f4", 12, start + view["byteOffset"]).reshape(4, 3)
    root, child = content["nodes"]
    in_frame = stored + np.array(child["translation"])
    np.testing.assert_allclose(in_frame, vertices + far, atol=1e-6)
    np.testing.assert_allclose(accessor["min"], stored.min(0))
    turned = (np.array(root["matrix"]).reshape(4, 4).T @ np.append(in_frame[3], 1))[:3]
    np.testing.assert_allclose(turned, z_up @ (vertices[3] + far), rtol=1e-6)
    light = np.frombuffer(data, "<u2", 16, start + content["bufferViews"][2]["byteOffset"]).reshape(4, 4)
    assert light[0].tolist() == [65535, 0, 0, 65535]
    assert light[3, 0] == round(65535 * ((128 / 255 + 0.055) / 1.055) ** 2.4)  # linear light, as glTF has it


@pytest.mark.parametrize("name", ["a.ply", "a.glb", "a.nrrd"])
def test_damaged_files_are_refused(name, tmp_path):
    (tmp_path / name).write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\n")
    with pytest.raises(UserError, match=r"a\."):
        describe(tmp_path / name)


def test_a_mesh_without_vertices_is_refused(tmp_path):
    (tmp_path / "a.obj").write_text("# nothing\n")
    with pytest.raises(UserError, match="has no vertices"):
        describe(tmp_path / "a.obj")


# Photos without distortion


def test_undistorted_photos_have_straight_lines_and_half_pixels():
    """A picture that encodes bearings: after resampling, each pixel has the bearing of its own centre."""
    camera = Camera("OPENCV", 160, 120, (150.0, 148.0, 81.0, 58.5, -0.2, 0.05, 1e-3, -1e-3))
    pinhole = pinhole_of(camera)
    assert pinhole.params == (camera.focal_px, camera.focal_px, 81.0, 58.5)
    directions, valid = camera.pixel_bearings()
    levels = np.rint(128 + 100 * directions[:, :2] / directions[:, 2:]).reshape(120, 160, 2).astype(np.uint8)
    assert valid.all()
    pixels, shown = undistorted(levels, camera, pinhole)
    wanted = 128 + 100 * plane_rays(pinhole)[..., :2]
    inner = shown & (np.abs(wanted - 128).max(-1) < 45)
    assert inner.mean() > 0.6
    off = pixels[inner].astype(float) - wanted[inner]
    assert np.abs(off).max() < 1.1  # rounding to levels, twice
    assert np.abs(off.mean()) < 0.02  # half a pixel is 0.33 levels


# The command


def voxels(run: Path, size: float) -> tuple[str, str]:
    """Return the option for voxels of a size in units of the training frame."""
    return "--voxel-size", f"{size / Run(run).model().training_from_scene.scale:.9g}"


@pytest.fixture
def blocked(finished: Path) -> Path:
    """A run of six views whose field is a block, dense from its surface on."""
    save_model(finished / FIELD, block(Run(finished).model().training_from_scene))
    return finished


def sides_of(run: Path, points: np.ndarray) -> np.ndarray:
    """Return the largest coordinate of each point in the training frame, where the block ends at 0.5."""
    return np.abs(Run(run).model().training_from_scene.apply(points)).max(axis=1)


def test_a_mesh_is_written_in_the_frame_of_the_scene(blocked, tmp_path):
    for form in ("ply", "glb", "obj"):
        result = completed("export", blocked, "--to", "mesh", *voxels(blocked, 0.06), "-o", tmp_path / f"a.{form}")
        assert result.stdout.strip() == str(tmp_path / f"a.{form}")
    vertices, _ = vertices_of(tmp_path / "a.ply")
    assert len(vertices) > 200
    off = sides_of(blocked, vertices) - 0.5
    # Four photos of 48 pixels, and steps of 1/64 along rays: half a voxel.
    assert np.quantile(np.abs(off), 0.9) < 0.03
    facts = json.loads(nerfcli("info", tmp_path / "a.glb", "--json").stdout)
    assert (facts["kind"], facts["unit"], facts["frame"]) == ("mesh", "metre", "of the scene, as its cameras have it")
    assert facts["vertices"] == len(vertices)
    assert "unit: metre" in nerfcli("info", tmp_path / "a.glb").stdout
    turn = np.array(read_glb_json(tmp_path / "a.glb")["nodes"][0]["matrix"]).reshape(4, 4).T[:3, :3]
    np.testing.assert_allclose(turn @ up_direction(Run(blocked).cameras.train), [0, 1, 0], atol=1e-6)
    lines = (tmp_path / "a.obj").read_text().splitlines()
    assert "# unit metre" in lines
    first = next(line for line in lines if line.startswith("v "))
    np.testing.assert_allclose([float(word) for word in first.split()[1:4]], vertices[0], rtol=1e-6)


def vertices_of(path: Path) -> tuple[np.ndarray, int]:
    table = read_ply_vertices(path)
    return np.stack([table[axis] for axis in "xyz"], -1), read_ply_header(path).count("face")


def test_points_are_written(blocked, tmp_path):
    completed("export", blocked, "--to", "points", *voxels(blocked, 0.05), "-o", tmp_path / "p.ply")
    places, _ = vertices_of(tmp_path / "p.ply")
    assert np.abs(sides_of(blocked, places) - 0.5).max() < 0.02
    facts = describe(tmp_path / "p.ply")
    assert facts["properties"] == "x y z nx ny nz red green blue photos parallax_deg spread"


def test_what_cannot_be_exported_is_refused_in_two_lines(blocked, tmp_path):
    away = ("--box=90,90,90,91,91,91", "--voxel-size", "0.1")
    for to in ("mesh", "points"):
        result = nerfcli("export", blocked, "--to", to, *away, "-o", tmp_path / "a.ply")
        assert result.exit_code == 3
        assert error_of(result)[0].startswith("Error: no ")
    result = nerfcli("export", blocked, "--to", "mesh", "--voxel-size", "1e-9", "-o", tmp_path / "a.ply")
    assert "along a side of the box" in error_of(result)[0]
    assert not (tmp_path / "a.ply").exists()
    (tmp_path / "a.ply").write_text("mine")
    result = nerfcli("export", blocked, "--to", "points", "-o", tmp_path / "a.ply")
    assert "exists" in error_of(result)[0]
    assert (tmp_path / "a.ply").read_text() == "mine"


def test_exports_stand_beside_the_run_under_its_name(blocked):
    _, size = voxels(blocked, 0.25)
    result = completed("export", blocked, "--to", "points", "--quiet", "--voxel-size", size)
    assert result.stderr == ""
    assert Path(result.stdout.strip()) == blocked.with_name("spheres-run-points.ply")
    settings = SurfaceSettings(voxel_size=float(size), max_size=48)
    assert export_run(blocked, to="mesh", settings=settings) == blocked.with_name("spheres-run-mesh.ply")
