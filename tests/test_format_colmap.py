"""COLMAP models written and read, against pycolmap, by round trips and by hand."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from captures import CAMERAS, assert_same, reprojection_px, ring
from readback import assert_holds, read_colmap

from nerfcli.cameras import rigid
from nerfcli.captures.capture import Capture, Observations
from nerfcli.captures.formats.colmap import (
    FILES,
    is_model,
    losses_colmap,
    losses_colmap_text,
    parse_colmap,
    read_model,
    write_colmap_binary,
    write_colmap_text,
)
from nerfcli.errors import UserError

WRITERS = {"bin": write_colmap_binary, "txt": write_colmap_text}


def without_spaces(capture: Capture) -> Capture:
    frames = tuple(replace(frame, name=frame.name.replace(" ", "_")) for frame in capture.frames)
    return replace(capture, frames=frames)


@pytest.mark.parametrize("suffix", WRITERS)
def test_pycolmap_reads_all_cameras_in_one_model_and_the_tracks(tmp_path, suffix):
    capture = ring(*CAMERAS.values(), num_frames=2 * len(CAMERAS))
    if suffix == "txt":
        capture = without_spaces(capture)  # pycolmap cuts names at the first space
    WRITERS[suffix](capture, tmp_path / "model")
    assert_holds(capture, read_colmap(tmp_path / "model", capture))
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    assert sorted(camera.model.name for camera in model.cameras.values()) == sorted(CAMERAS)
    assert model.num_reg_images() == len(capture.frames)
    seen = capture.observations
    assert seen is not None
    for index in range(len(capture.points)):
        track = sorted((element.image_id, element.point2D_idx) for element in model.points3D[index + 1].track.elements)
        places = np.flatnonzero(seen.point_index == index)
        starts = np.searchsorted(seen.frame_index, seen.frame_index[places])
        assert track == [(f + 1, p - s) for f, p, s in zip(seen.frame_index[places], places, starts, strict=True)]
    assert model.compute_mean_reprojection_error() < 1e-9


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_written_model_is_read_back_exactly(tmp_path, suffix):
    capture = ring(*CAMERAS.values(), num_frames=len(CAMERAS) + 3)
    WRITERS[suffix](capture, tmp_path / "model")
    back = parse_colmap(tmp_path / "model")
    assert_same(capture, back, pose_tolerance=2e-15)
    assert reprojection_px(capture, back) < 1e-10
    assert back.frames[0].camera is back.frames[len(CAMERAS)].camera


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_model_of_a_rig_is_read_as_pycolmap_wrote_it(tmp_path, suffix):
    """COLMAP 4 with rigs.bin and frames.bin: poses are the images' own; features and tracks are COLMAP's."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 3, 4
    options.num_points3D = 30
    options.sensor_from_rig_translation_stddev, options.sensor_from_rig_rotation_stddev = 0.3, 20.0
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    rig = model.rigs[min(model.rigs)]
    assert max(np.abs(s.translation).max() for s in rig.non_ref_sensors.values() if s is not None) > 0.1
    (model.write_binary if suffix == "bin" else model.write_text)(str(tmp_path))
    assert (tmp_path / f"rigs.{suffix}").is_file()
    capture = parse_colmap(tmp_path)
    assert capture.observations is not None
    assert capture.colours is None  # COLMAP left them black
    images = [model.images[image_id] for image_id in sorted(model.images)]
    assert [frame.name for frame in capture.frames] == [image.name for image in images]
    point_ids = sorted(model.points3D)
    np.testing.assert_array_equal(capture.points, [model.points3D[point_id].xyz for point_id in point_ids])
    for index, (frame, image) in enumerate(zip(capture.frames, images, strict=True)):
        expected = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        np.testing.assert_allclose(rigid.inverse(frame.world_from_cam), expected, rtol=0, atol=1e-14)
        own = capture.observations.frame_index == index
        np.testing.assert_array_equal(capture.observations.pixels[own], [p.xy for p in image.points2D])
        places = [point_ids.index(p.point3D_id) if p.has_point3D() else -1 for p in image.points2D]
        np.testing.assert_array_equal(capture.observations.point_index[own], places)
        pixels, valid = frame.camera.project(frame.in_camera(capture.points))
        assert valid.all()
        with_point = own & (capture.observations.point_index >= 0)
        observed = capture.observations.pixels[with_point]
        seen = pixels[capture.observations.point_index[with_point]]
        np.testing.assert_allclose(seen, observed, rtol=0, atol=1e-9)


def test_features_whose_points_are_gone(tmp_path):
    """A model without any points keeps its features; one with some of them missing is inconsistent and refused."""
    capture = ring(CAMERAS["PINHOLE"])
    assert capture.observations is not None
    write_colmap_text(capture, tmp_path / "model")
    lines = (tmp_path / "model/points3D.txt").read_text().splitlines()
    (tmp_path / "model/points3D.txt").write_text("\n".join(lines[:-1]))
    what = r"images\.txt and points3D\.txt .* a feature refers to point 40, which does not"
    with pytest.raises(UserError, match=what):
        parse_colmap(tmp_path / "model")
    (tmp_path / "model/points3D.txt").write_text("\n".join([*lines, lines[-1]]))
    with pytest.raises(UserError, match=r"points3D\.txt .*: two points have the id 40"):
        parse_colmap(tmp_path / "model")
    (tmp_path / "model/points3D.txt").write_text("")
    bare = parse_colmap(tmp_path / "model")
    assert bare.points.shape == (0, 3)
    assert bare.observations is not None
    np.testing.assert_array_equal(bare.observations.pixels, capture.observations.pixels)
    assert (bare.observations.point_index == -1).all()


@pytest.mark.parametrize("suffix", WRITERS)
def test_observations_in_any_order_and_none_at_all(tmp_path, suffix):
    capture = ring(CAMERAS["PINHOLE"])
    seen = capture.observations
    assert seen is not None
    shuffle = np.random.default_rng(0).permutation(len(seen.pixels))
    shuffled = Observations(seen.frame_index[shuffle], seen.point_index[shuffle], seen.pixels[shuffle])
    WRITERS[suffix](replace(capture, observations=shuffled), tmp_path / "a")
    back = parse_colmap(tmp_path / "a").observations
    assert back is not None
    rows = np.column_stack([seen.frame_index, seen.point_index, seen.pixels])
    rows_back = np.column_stack([back.frame_index, back.point_index, back.pixels])
    np.testing.assert_array_equal(rows_back[np.lexsort(rows_back.T)], rows[np.lexsort(rows.T)])
    bare = replace(capture, observations=None, colours=None, points=np.zeros((0, 3)))
    WRITERS[suffix](bare, tmp_path / "b")
    assert_same(bare, parse_colmap(tmp_path / "b"), pose_tolerance=2e-15)
    assert len(pycolmap.Reconstruction(str(tmp_path / "b")).images) == 6


def test_what_a_model_cannot_hold_is_listed(tmp_path):
    capture = ring(CAMERAS["PINHOLE"])
    assert losses_colmap(capture) == ()
    assert losses_colmap_text(capture) == ("6 names with spaces (COLMAP truncates them at the first space)",)
    first = replace(capture.frames[0], mask=tmp_path / "m.png", split="test")
    more = replace(capture, frames=(first, *capture.frames[1:]), unit="metre", depth_bounds=np.tile([1.0, 2.0], (6, 1)))
    assert losses_colmap(more) == ("1 mask", "the split of 1 frame", "depth bounds", "the unit of length (metre)")


@pytest.mark.parametrize(
    ("suffix", "name"), [("bin", "a\0b"), ("bin", ""), ("txt", "a\nb"), ("txt", " a"), ("txt", "")]
)
def test_names_that_a_model_cannot_hold_are_refused(tmp_path, suffix, name):
    capture = ring(CAMERAS["PINHOLE"])
    named = replace(capture, frames=(replace(capture.frames[0], name=name), *capture.frames[1:]))
    with pytest.raises(UserError, match="cannot be written to a COLMAP model"):
        WRITERS[suffix](named, tmp_path / "model")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("count", [2**20, 2**32, 2**62])
def test_an_announced_count_is_not_believed(tmp_path, name, count):
    write_colmap_binary(ring(CAMERAS["PINHOLE"]), tmp_path / "model")
    path = tmp_path / "model" / name
    path.write_bytes(count.to_bytes(8, "little") + path.read_bytes()[8:])
    with pytest.raises(UserError, match=f"{name} is damaged: it announces {count} records"):
        parse_colmap(tmp_path / "model")


@pytest.mark.parametrize("name", [f"{name}.{suffix}" for suffix in WRITERS for name in FILES])
def test_a_damaged_file_is_named(tmp_path, name):
    """A truncated file never causes a hang or passes as complete; pycolmap loops forever on some of them."""
    WRITERS[name[-3:]](ring(CAMERAS["PINHOLE"]), tmp_path)
    path = tmp_path / name
    whole = path.read_bytes()
    if name.endswith("bin"):
        damaged = [whole[:size] for size in (0, 5, 20, len(whole) // 2, len(whole) - 1)] + [b"garbage " * 100]
    else:
        damaged = [b"garbage " * 100, b"\xff\xfe\xfd", b"1 2 3\n"]
    for data in damaged:
        path.write_bytes(data)
        with pytest.raises(UserError, match=name.replace(".", r"\.")):
            read_model(tmp_path)
    path.unlink()
    if name.startswith("points3D"):
        assert is_model(tmp_path)
        assert len(read_model(tmp_path).points) == 0
        return
    with pytest.raises(UserError, match=r"No such file|cameras\.txt"):
        read_model(tmp_path)
    assert not is_model(tmp_path)


def test_text_by_hand(tmp_path):
    """Names with spaces, images without points (an empty line), comments and a model without points."""
    (tmp_path / "cameras.txt").write_text("# cameras\n3 PINHOLE 64 48 50 51 33 23\n")
    (tmp_path / "images.txt").write_text("# images\n\n1 1 0 0 0 1 2 3 3 b c.jpg\n\n2 0 0 0 1 0 0 0 3 a.jpg\n1 2 -1\n")
    (tmp_path / "points3D.txt").write_text("# points\n")
    model = read_model(tmp_path)
    assert [image.name for image in model.images] == ["a.jpg", "b c.jpg"]
    np.testing.assert_allclose(model.images[1].world_from_cam[:3, 3], [-1, -2, -3])
    np.testing.assert_allclose(model.images[0].world_from_cam[:3, :3], np.diag([-1, -1, 1]), rtol=0, atol=1e-15)
    assert model.points.shape == (0, 3)
    for text, what in (
        ("1 1 0 0 0 1 2 3 4 a.jpg\n\n", "image a.jpg refers to camera 4, which does not exist"),
        ("1 1 0 0 0 1 2 3 3 a.jpg\n\n2 1 0 0 0 1 2 3 3 a.jpg\n\n", "a.jpg is registered twice"),
        ("1 0 0 0 0 1 2 3 3 a.jpg\n\n", r"the pose of image a\.jpg is not .* of length 0; only 0 of 1 frame"),
        ("1 1 0 0 0 nan 2 3 3 a.jpg\n\n", r"images\.txt: the pose of image a\.jpg is not finite"),
        ("# nothing\n", "no registered images"),
    ):
        (tmp_path / "images.txt").write_text(text)
        with pytest.raises(UserError, match=what):
            read_model(tmp_path)
