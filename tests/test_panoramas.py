"""Photos of 360-degree cameras: recognition, poses, stereo matching, training and rendering."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from commands import completed, error_of, nerfcli
from in_this_process import poses_in_this_process
from panorama_room import CENTRES, WIDTH, panorama, render, world_from_cam, write_panoramas
from PIL import Image
from scipy.spatial.transform import Rotation

from nerfcli.cameras.alignment import align
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.calibration import read_calibration
from nerfcli.captures.loading import load_scene
from nerfcli.doctor.compared_pairs import compare
from nerfcli.doctor.photo_facts import Source, read_all
from nerfcli.errors import BAD_INPUT, TOO_FEW_PHOTOS, UserError
from nerfcli.matching.stereo import dense_depths
from nerfcli.matching.stereo_view import FACES, Faces
from nerfcli.matching.tracks import Tracks
from nerfcli.output import Output
from nerfcli.photos.images import read_image
from nerfcli.photos.loading import LoadedPhoto, load_photos
from nerfcli.photos.panoramas import PANORAMA, is_panorama
from nerfcli.poses.input.photos import find_photos
from nerfcli.poses.input.settings import PoseSettings, Search, for_panoramas
from nerfcli.poses.judge.acceptance import nothing_placed
from nerfcli.poses.judge.parallax import panorama_rotation_fit
from nerfcli.poses.model import held_out
from nerfcli.poses.model.cameras import group_by_given, group_photos
from nerfcli.poses.model.projection import is_ahead, offsets_px, panorama_camera, projected, px_per_radian
from nerfcli.poses.model.two_views import VerifiedPair, panorama_inliers, rays
from nerfcli.training.evidence import tracks_of_model
from nerfcli.training.runs.run import load_run
from nerfcli.workflows.render import render_run
from nerfcli.workflows.report import report_runs
from nerfcli.workflows.views import PictureOptions, Views, usual_axis

DESK = Path(__file__).parent.parent / "sample_scenes" / "desk" / "images"
FEW = PoseSettings(max_features=400, threads=1)
XMP = (
    '<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
    'GPano:ProjectionType="{projection}" GPano:FullPanoWidthPixels="{full}">'
    "<GPano:CroppedAreaImageWidthPixels>{cropped}</GPano:CroppedAreaImageWidthPixels></rdf:Description>"
)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture") / "my room"
    write_panoramas(folder)
    return folder


@pytest.fixture(scope="module")
def scene(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("solved") / "scene"
    report = poses_in_this_process(photos, folder, FEW)
    assert (report.registered, report.total) == (6, 6)
    return folder


# Which photos are panoramas


def test_panoramas_without_metadata_are_recognized_by_their_edges_and_poles(photos):
    assert all(photo.is_panorama for photo in find_photos(photos).photos)


def test_a_panorama_may_begin_at_any_longitude_but_not_be_cut(photos, tmp_path):
    picture = read_image(photos / "0.png")
    for turned in (1, 100, WIDTH // 2):
        assert is_panorama(photos / "0.png", np.roll(picture, turned, axis=1))
    for cut in (picture[: WIDTH // 4], picture[:, : WIDTH // 2], picture[10:-10, 20:-20], picture[:, ::-1][:, 100:]):
        height = len(cut) - len(cut) % 2
        assert not is_panorama(photos / "0.png", np.ascontiguousarray(cut[:height, : 2 * height]))


def test_other_pictures_of_this_shape_are_no_panoramas():
    rng = np.random.default_rng(0)
    ramp = np.linspace(0, 255, 200)[:, None, None].repeat(400, axis=1).repeat(3, axis=2)
    object_on_white = np.full((200, 400, 3), 255.0)
    object_on_white[20:180, 60:340] = rng.uniform(0, 255, (160, 280, 3))
    # The edges differ less than distant columns, but more than neighbours.
    waves = np.sin(np.linspace(0, 1.08 * 2 * np.pi, 400)) * np.sin(np.linspace(0, np.pi, 200))[:, None]
    cut = (0.5 * ramp[..., 0] + 60 * (1 + waves))[..., None].repeat(3, axis=2)
    bars = rng.uniform(0, 255, (200, 400, 3))
    bars[:30] = bars[-30:] = 0
    for other in (ramp, object_on_white, cut, bars, np.zeros((200, 400, 3))):
        assert not is_panorama(DESK / "desk_000.jpg", other.astype(np.uint8))
    for path in sorted(DESK.iterdir())[:12]:
        picture = read_image(path)
        top = (len(picture) - picture.shape[1] // 2) // 2
        assert not is_panorama(path, picture[top : top + picture.shape[1] // 2])


@pytest.mark.parametrize(
    ("projection", "full", "cropped", "size", "expected"),
    [
        ("equirectangular", 64, 64, (64, 32), True),
        ("cylindrical", 64, 64, (64, 32), False),
        ("equirectangular", 128, 64, (64, 32), False),
        ("equirectangular", 64, 64, (64, 40), False),
    ],
)
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_metadata_identifies_panoramas_without_content(projection, full, cropped, size, expected, suffix, tmp_path):
    path = tmp_path / f"grey{suffix}"
    xmp = XMP.format(projection=projection, full=full, cropped=cropped).encode()
    image = Image.new("RGB", size, (90, 90, 90))
    if suffix == ".png":
        from PIL.PngImagePlugin import PngInfo

        info = PngInfo()
        info.add_itxt("XML:com.adobe.xmp", xmp.decode())
        image.save(path, pnginfo=info)
    else:
        image.save(path, xmp=xmp)
    assert is_panorama(path, read_image(path)) == expected


def test_most_photos_of_a_camera_decide(photos):
    found = find_photos(photos)
    few = replace(found, photos=tuple(replace(p, is_panorama=number > 3) for number, p in enumerate(found.photos)))
    most = replace(found, photos=tuple(replace(p, is_panorama=number > 1) for number, p in enumerate(found.photos)))
    assert [group.model for group in group_photos(few, model="auto").groups] == ["SIMPLE_RADIAL"]
    grouped = group_photos(most, model="auto")
    (group,) = grouped.groups
    assert (group.model, group.params, group.fixed) == (PANORAMA, (768.0, 384.0), True)
    assert grouped.notes == (
        "6 photos recognized as 360-degree panoramas (equirectangular); if this is wrong, give "
        "--camera-model SIMPLE_RADIAL",
    )


def test_the_user_has_the_last_word(photos):
    found = find_photos(photos)
    assert group_photos(found, model="SIMPLE_RADIAL").groups[0].model == "SIMPLE_RADIAL"
    chosen = group_photos(
        replace(found, photos=tuple(replace(p, is_panorama=False) for p in found.photos)), model=PANORAMA
    )
    assert (chosen.groups[0].model, chosen.notes) == (PANORAMA, ())
    with pytest.raises(UserError, match=r"0.png is not a panorama of the whole sphere: 768x380 pixels") as caught:
        group_photos(replace(found, photos=tuple(replace(p, height=380) for p in found.photos)), model=PANORAMA)
    assert caught.value.exit_code == BAD_INPUT


# Geometry


def test_pixels_are_those_of_our_own_camera():
    """The cameras of pycolmap and of `nerfcli.cameras` agree in every direction."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3))
    ours, valid = Camera(PANORAMA, 800, 400, (800.0, 400.0)).project(points)
    assert valid.all()
    camera = panorama_camera((800, 400))
    assert np.allclose(projected(camera, points), ours, atol=1e-9)
    assert np.allclose(rays(camera, ours), points / np.linalg.norm(points, axis=1, keepdims=True), atol=1e-9)
    assert is_ahead(camera, points).all()
    pinhole = pycolmap.Camera(model="PINHOLE", width=800, height=400, params=[500.0, 500.0, 400.0, 200.0])
    assert np.array_equal(is_ahead(pinhole, points), points[:, 2] > 0)
    assert np.isnan(projected(pinhole, points[points[:, 2] < 0])).all()


def test_offsets_cross_the_edge_of_a_panorama():
    camera = panorama_camera((800, 400))
    behind = np.array([[1e-3, 0.0, -1.0], [-1e-3, 0.0, -1.0], [1.0, 0.0, 0.0]])
    pixels = np.array([[0.5, 200.0], [799.5, 200.0], [600.5, 201.0]])
    px = 1e-3 * px_per_radian(camera)
    expected = [[-px - 0.5, 0.0], [px + 0.5, 0.0], [-0.5, -1.0]]
    assert np.allclose(offsets_px(camera, behind, pixels), expected, atol=1e-6)
    pinhole = pycolmap.Camera(model="PINHOLE", width=800, height=400, params=[500.0, 500.0, 400.0, 200.0])
    far = offsets_px(pinhole, np.array([[0.0, 0.0, 1.0]]), np.array([[-300.0, 200.0]]))
    assert np.allclose(far, [[700.0, 0.0]])  # not shortened by 800
    assert px_per_radian(pinhole) == 500.0


def test_held_out_errors_cross_the_edge_of_a_panorama(scene):
    """An observation moved to the other side of the edge, where it is the same place, has the same error."""
    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    _, held = held_out.split(model, seed=0)
    moved = replace(held, pixels=held.pixels + np.array([WIDTH, 0.0]))
    assert len(held.points) > 20
    assert np.allclose(held_out.errors_px(model, moved), held_out.errors_px(model, held), atol=1e-6)


def test_given_panorama_cameras_are_fixed(photos, tmp_path):
    (tmp_path / "cameras.txt").write_text("1 EQUIRECTANGULAR 768 384 768 384\n")
    given = read_calibration(tmp_path / "cameras.txt", images=photos)
    (group,) = group_by_given(find_photos(photos), given).groups
    assert (group.model, group.params, group.fixed, group.is_panorama) == (PANORAMA, (768.0, 384.0), True, True)


def test_pixels_per_radian_are_those_of_a_small_turn():
    camera = panorama_camera((800, 400))
    turned = projected(camera, np.array([[np.sin(1e-6), 0.0, np.cos(1e-6)], [0.0, np.sin(1e-6), np.cos(1e-6)]]))
    assert np.allclose((turned - [400.0, 200.0]).max(axis=1) / 1e-6, px_per_radian(camera), rtol=1e-6)


def seen_twice(shift: float, *, wrong: int = 0) -> VerifiedPair:
    """Return matches of two panoramas: turned by 100 degrees, moved by `shift` with points 2 to 5 away."""
    rng = np.random.default_rng(1)
    points = rng.normal(size=(120, 3))
    points *= (rng.uniform(2, 5, 120) / np.linalg.norm(points, axis=1))[:, None]
    camera = panorama_camera((800, 400))
    turn = Rotation.from_euler("yx", [100.0, 5.0], degrees=True).as_matrix()
    other = projected(camera, (points - [shift, 0.0, 0.0]) @ turn.T)
    other[:wrong] = rng.uniform((0, 0), (800, 400), (wrong, 2))
    return VerifiedPair(1, 2, projected(camera, points), other)


@pytest.mark.parametrize(("shift", "turned"), [(0.0, True), (0.005, True), (0.3, False)])
def test_rotation_alone_explains_panoramas_only_without_a_baseline(shift, turned):
    fit = panorama_rotation_fit([seen_twice(shift)], {1: (800, 400), 2: (800, 400)})
    assert fit is not None
    assert fit.explains_all == turned
    assert fit.parallax_px < 1e-6 if shift == 0 else fit.parallax_px > 0
    assert [failure.kind for failure in nothing_placed(fit).failures] == ["no baseline (pure rotation)"] * turned
    assert panorama_rotation_fit([], {}) is None


def test_matches_of_panoramas_that_agree_on_one_motion():
    pair = seen_twice(0.5, wrong=40)
    agree = panorama_inliers(pair.pixels_one, pair.pixels_other, ((800, 400), (800, 400)), within_px=2.0)
    assert agree[40:].all()
    assert agree[:40].mean() < 0.2  # wrong ones near their epipolar line
    assert panorama_inliers(np.zeros((0, 2)), np.zeros((0, 2)), ((8, 4), (8, 4)), within_px=2.0).shape == (0,)


# Faces of a cube


def by_direction(directions: np.ndarray) -> np.ndarray:
    """Return a colour for each direction, levels (N, 3), that changes smoothly over the sphere."""
    return 128 + 100 * directions


def loaded(picture: np.ndarray, used: np.ndarray | None = None) -> LoadedPhoto:
    height, width = picture.shape[:2]
    camera = Camera(PANORAMA, width, height, (float(width), float(height)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", [10, 50, -20], degrees=True).as_matrix(), (1, 2, 3)
    return LoadedPhoto(Frame("a.png", camera, pose, image=None), picture.astype(np.uint8), used)


def test_faces_show_what_the_panorama_shows_in_their_directions():
    camera = Camera(PANORAMA, 100, 50, (100.0, 50.0))
    photo = loaded(by_direction(camera.pixel_bearings()[0]).reshape(50, 100, 3))
    faces = Faces.of([photo])
    assert len(faces.photos) == FACES == 6
    seen = np.zeros((50, 100), bool)
    for number, face in enumerate(faces.photos):
        frame = face.frame
        in_panorama = (
            frame.camera.pixel_bearings()[0] @ (photo.frame.world_from_cam[:3, :3].T @ frame.world_from_cam[:3, :3]).T
        )
        assert np.allclose(face.pixels.reshape(-1, 3), by_direction(in_panorama), atol=1.8), number
        assert np.array_equal(frame.centre, photo.frame.centre)
        assert np.isclose(np.linalg.det(frame.world_from_cam[:3, :3]), 1)
        every = np.stack(np.meshgrid(np.arange(frame.camera.width), np.arange(frame.camera.height)), -1).reshape(-1, 2)
        nothing = np.zeros((0, 2), np.int64)
        pixels, index = faces.joined(0, [every if other == number else nothing for other in range(6)])
        assert np.abs(by_direction(in_panorama)[index] - photo.pixels[pixels[:, 1], pixels[:, 0]]).max() < 8
        seen[pixels[:, 1], pixels[:, 0]] = True
    assert seen[13:37].mean() > 0.95  # around the poles a panorama has more pixels than the faces
    assert seen[[1, -2]].any(axis=1).all()


def test_other_photos_stay_as_they_are_among_faces():
    panorama = loaded(np.zeros((20, 40, 3)), used=np.arange(800).reshape(20, 40) >= 400)  # the upper half is masked
    pinhole = LoadedPhoto(
        Frame("b.png", Camera.pinhole(8, 6, 5.0), np.eye(4), image=None), np.zeros((6, 8, 3), np.uint8), None
    )
    faces = Faces.of([pinhole, panorama, pinhole])
    assert faces.photos[0] is faces.photos[7] is pinhole
    assert [faces.own(number) for number in range(3)] == [slice(0, 1), slice(1, 7), slice(7, 8)]
    *_, up, down = faces.photos[1:7]
    assert up.used is not None
    assert not up.used.any()
    assert down.used is not None
    assert down.used.all()
    tracks = faces.tracks(Tracks(np.array([0, 1, 2]), np.array([0, 0, 1]), np.ones((3, 3))))
    assert tracks.photos.tolist() == [0, 1, 7]
    pixels, index = faces.joined(2, [np.array([[3, 4], [1, 2]])])
    assert pixels.tolist() == [[3, 4], [1, 2]]
    assert index.tolist() == [0, 1]


def test_stereo_measures_distances_all_around(scene):
    found = load_scene(scene)
    photos = load_photos(found.frames[:4], factor=1, threads=2)
    tracks = tracks_of_model(found, photos)
    depths = dense_depths(photos, tracks, longer_side_px=220, threads=2)
    numbers = [int(Path(frame.name).stem) for frame in found.frames]
    scale = align(np.array([frame.centre for frame in found.frames]), CENTRES[numbers]).scale
    for number, depth in zip(numbers[:4], depths, strict=True):
        _, truth = panorama(number)
        columns, rows = depth.pixels.T
        errors = np.abs(scale * depth.distances / truth[rows, columns] - 1)
        assert len(errors) > 0.08 * truth.size
        assert np.median(errors) < 0.01
        assert (errors < 0.05).mean() > 0.9
        quarters = np.bincount(columns * 4 // WIDTH, minlength=4)
        assert quarters.min() > 0.03 * quarters.sum()  # not only in front


# From photos to pictures


def test_poses_of_panoramas_are_the_true_ones(scene):
    found = load_scene(scene)
    numbers = [int(Path(frame.name).stem) for frame in found.frames]
    assert {frame.camera for frame in found.frames} == {Camera(PANORAMA, 768, 384, (768.0, 384.0))}
    poses = np.array([frame.world_from_cam for frame in found.frames])
    truth_from_scene = align(poses[:, :3, 3], CENTRES[numbers])
    assert np.abs(truth_from_scene.apply(poses[:, :3, 3]) - CENTRES[numbers]).max() < 2e-3  # metres
    for number, pose in zip(numbers, poses, strict=True):
        apart = world_from_cam(number).T @ truth_from_scene.rotation @ pose[:3, :3]
        assert np.degrees(Rotation.from_matrix(apart).magnitude()) < 0.1
    report = json.loads((scene / "poses_report.json").read_text())
    assert report["verdict"]["accepted"]
    assert report["verdict"]["measures"]["share_in_front"] == 1.0
    assert report["verdict"]["measures"]["parallax_px"] > 10
    assert report["verdict"]["measures"]["focal_over_longer_side"] == []
    assert not report["not_computed"]


def test_features_of_panoramas_are_more_and_of_larger_pictures():
    assert for_panoramas(Search(1600, 400)) == Search(3200, 800)
    assert for_panoramas(Search(1600, 2048, halved_from=4096)) == Search(3200, 4096, halved_from=8192)


@pytest.mark.slow
def test_a_panorama_camera_that_only_turns_is_refused(tmp_path):
    folder = tmp_path / "turning"
    folder.mkdir()
    for number in range(5):
        Image.fromarray(render(CENTRES[0], world_from_cam(number))[0]).save(folder / f"{number}.png")
    with pytest.raises(UserError, match=r"no baseline \(pure rotation\)|explains all matches") as caught:
        poses_in_this_process(folder, tmp_path / "scene", FEW)
    assert caught.value.exit_code == TOO_FEW_PHOTOS


@pytest.mark.slow
def test_panoramas_and_other_photos_share_a_scene(photos, tmp_path):
    """Each panorama has a photo beside it, whose focal length is found: that of a face, whose pixels are as large."""
    folder = tmp_path / "mixed"
    folder.mkdir()
    beside = CENTRES + np.random.default_rng(1).uniform(-0.25, 0.25, CENTRES.shape)
    for number, path in enumerate(sorted(photos.iterdir())):
        (folder / path.name).write_bytes(path.read_bytes())
        front = Faces.of([loaded(render(beside[number], world_from_cam(number))[0])]).photos[0].pixels
        Image.fromarray(front[len(front) // 8 : -len(front) // 8]).save(folder / f"photo {number}.png")
    report = poses_in_this_process(folder, tmp_path / "scene", replace(FEW, max_features=2000))
    assert (report.registered, report.total) == (12, 12)
    frames = load_scene(tmp_path / "scene").frames
    truth = np.array([beside[int(f.name[6])] if f.name[0] == "p" else CENTRES[int(f.name[0])] for f in frames])
    centres = np.array([frame.centre for frame in frames])
    errors = np.linalg.norm(align(centres, truth).apply(centres) - truth, axis=1)
    assert errors.max() < 0.01  # metres; a pixel at the distance of the walls is 0.016
    focals = {frame.camera.focal_px for frame in frames if not frame.camera.is_spherical}
    assert np.allclose(list(focals), WIDTH / (2 * np.pi), rtol=0.01)


@pytest.mark.usefixtures("coarse_steps", "small_photo_depths")
def test_a_field_of_panoramas_renders_distances_along_rays(scene, tmp_path):
    run = tmp_path / "run"
    small = ("--steps", "2", "--downscale", "8", "--log2-rows", "10", "--model", "default")
    assert nerfcli("train", scene, "-o", run, *small).exit_code == 0
    assert nerfcli("render", run, "--outputs", "rgb,depth", "--depth-format", "npy").exit_code == 0
    (picture,) = (run / "renders" / "test-conditional-ray" / "rgb").glob("*.png")
    assert read_image(picture).shape == (48, 96, 3)
    completed("render", run, "--cameras", "orbit", "--count", "2", "--lens", "pinhole", "--outputs", "depth")
    assert (run / "renders" / "orbit-pinhole-conditional-z").is_dir()
    cameras = tmp_path / "pinholes"
    assert nerfcli("render", run, "--cameras", "orbit", "--count", "2", "--lens", "pinhole", "--cameras-only",
                   "-o", cameras).exit_code == 0  # fmt: skip
    frames = load_run(run).cameras
    axes = {views: usual_axis(load_run(run), Views(views)) for views in ("test", "train", "orbit", str(cameras))}
    assert axes == {"test": "ray", "train": "ray", "orbit": "z", str(cameras): "z"}
    assert usual_axis(load_run(run), Views("test", look=PictureOptions(lens="pinhole"))) == "z"
    assert usual_axis(load_run(run), Views("orbit", look=PictureOptions(lens="equirectangular"))) == "ray"
    assert all(frame.camera.is_spherical for frame in frames.test)
    written = render_run(run, Output(tmp_path / "by-python"))
    assert {path.name for path in written} == {"rgb", "depth", "opacity"}
    page = report_runs([run], Output(tmp_path / "page.html")).read_text()
    assert "along the ray" in page
    error, hint = error_of(nerfcli("render", run, "--outputs", "depth", "--depth-axis", "z"))
    assert "equirectangular" in error
    assert "--depth-axis ray" in hint


def test_doctor_recognizes_panoramas(photos, tmp_path):
    few = tmp_path / "four of them"
    shutil.copytree(photos, few, ignore=shutil.ignore_patterns("4.png", "5.png"))
    done = nerfcli("doctor", few, "-o", tmp_path / "page.html", "--json")
    found = json.loads(done.stdout)
    verdicts = {finding["check"]: finding for finding in found["findings"]}
    assert verdicts["focal length"]["summary"] == "not needed for panoramas of the whole sphere"
    assert verdicts["connectivity"]["verdict"] == "good"
    assert not {"moving content", "movement", "depth relief"} & verdicts.keys()
    assert any("panoramas" in item["reason"] for item in found["not_checked"])


def test_doctor_measures_no_movement_between_a_panorama_and_another_photo(photos):
    panorama, *_ = read_all([Source("0.png", photos / "0.png")], threads=1, progress=lambda done: None)[0]
    other, *_ = read_all([Source("1.png", photos / "1.png")], threads=1, progress=lambda done: None)[0]
    both = compare((panorama, replace(other, is_panorama=False)), (0, 1), (400.0, 400.0))
    assert both.views is None
    assert (both.patches, both.motions) == ((), None)
    pinholes = [replace(photo, is_panorama=False) for photo in (panorama, other)]
    assert compare((pinholes[0], pinholes[1]), (0, 1), (400.0, 400.0)).inliers > 0
