"""The .npz archive of a capture: every number exactly, readable with NumPy alone, two hundred kinds of damage."""

import io
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import CAMERAS, assert_same, ring
from corruption import assert_refused_or_sound, corrupted_binary

from nerfcli.cameras.formats.archive import array_from_npy, losses_npz, parse_npz, write_npz
from nerfcli.cameras.frame import Capture
from nerfcli.errors import UserError


def full(folder: Path) -> Capture:
    """Return a capture with everything that one can have."""
    capture = ring(*CAMERAS.values(), num_frames=len(CAMERAS))
    frames = [replace(frame, image=folder / frame.name) for frame in capture.frames]
    frames[0] = replace(frames[0], split="val", mask=folder.parent / "masks" / "ö.png", image=None)
    frames[1] = replace(frames[1], split="test")
    bounds = np.random.default_rng(0).uniform(1, 2, size=(len(frames), 2)).cumsum(axis=1)
    return replace(
        capture, frames=tuple(frames), unit="metre", depth_bounds=bounds, kind="opensfm", missing=("gone ü.jpg", "b")
    )


def test_everything_is_kept_exactly(tmp_path):
    capture = full(tmp_path / "a")
    assert losses_npz(capture) == ()
    write_npz(capture, tmp_path / "a" / "my capture.npz")
    back = parse_npz(tmp_path / "a" / "my capture.npz")
    assert_same(capture, back)
    assert back.kind == "opensfm"
    (tmp_path / "b").mkdir()
    (tmp_path / "a/my capture.npz").rename(tmp_path / "b/capture.npz")
    assert parse_npz(tmp_path / "b/capture.npz").frames[1].image == tmp_path / "b" / capture.frames[1].name


def test_what_is_not_there_stays_away(tmp_path):
    capture = replace(ring(CAMERAS["PINHOLE"]), points=np.zeros((0, 3)), colours=None, observations=None)
    write_npz(capture, tmp_path / "a.npz")
    assert_same(capture, parse_npz(tmp_path / "a.npz"))


def test_numpy_alone_reads_it(tmp_path):
    capture = full(tmp_path)
    write_npz(capture, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        assert arrays["names"].tolist() == [frame.name for frame in capture.frames]
        np.testing.assert_array_equal(arrays["world_from_cam"][3], capture.frames[3].world_from_cam)
        index = arrays["camera_index"][4]
        assert arrays["camera_models"][index] == capture.frames[4].camera.model
        params = arrays["camera_params"][index]
        assert tuple(params[~np.isnan(params)]) == capture.frames[4].camera.params


@pytest.mark.parametrize("compress", [True, False])
def test_arrays_of_other_writers_are_read(tmp_path, compress):
    """float32, big endian, Fortran order and compression, as other programs may save them."""
    capture = replace(ring(CAMERAS["PINHOLE"]), observations=None)
    write_npz(capture, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as loaded:
        arrays = dict(loaded)
    arrays["points"] = np.asfortranarray(arrays["points"].astype(">f4"))
    arrays["camera_index"] = arrays["camera_index"].astype(np.uint8)
    arrays["world_from_cam"] = arrays["world_from_cam"].astype(np.float32)
    (np.savez_compressed if compress else np.savez)(tmp_path / "b.npz", **arrays)
    back = parse_npz(tmp_path / "b.npz")
    np.testing.assert_allclose(back.points, capture.points, rtol=1e-6)
    for frame, again in zip(capture.frames, back.frames, strict=True):
        np.testing.assert_allclose(again.world_from_cam, frame.world_from_cam, rtol=0, atol=1e-6)
        rotation = again.world_from_cam[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("name", "array", "what"),
    [
        ("version", np.array(2), "unknown version 2"),
        ("names", np.array(["a"] * 6), "names: no frames, a frame without a name, or two frames with the same"),
        ("names", np.arange(6), r"names: \(6,\) values of type int64, expected a row of texts"),
        ("splits", np.array(["train"] * 5 + ["x"]), "splits: a value other than"),
        ("unit", np.array("feet"), "unit: 'feet'"),
        ("camera_index", np.full(6, 1), "camera_index: a camera index outside the list of 1"),
        ("camera_index", np.full(6, 0.0), "camera_index: .* expected 6 numbers"),
        ("camera_models", np.array(["PENTAGON"]), "camera 0: unknown camera model 'PENTAGON'"),
        ("camera_sizes", np.array([[2**60, 1]]), "camera 0: invalid size of a picture: 1.15e"),
        ("camera_params", np.array([[500, np.nan, 320, 240]]), "camera 0: a parameter is NaN"),
        (
            "camera_params",
            np.array([[500, 1e300, 320, 240]]),
            r"camera 0: invalid camera parameters 500, 1e\+300, 320, 240",
        ),
        ("world_from_cam", np.full((6, 4, 4), np.nan), r"world_from_cam\[0\]: contains a number that is not finite"),
        ("points", np.zeros((40, 2)), r"points: \(40, 2\) values"),
        ("points", np.full((40, 3), np.inf), "points: a position"),
        ("colours", np.full((40, 3), 256), "colours: a number that is not between 0 and 255"),
        ("depth_bounds", np.ones((6, 2)), "depth_bounds: expected 0 < near < far"),
        ("observation_points", np.full(252, 40), "observation_points: a point index outside the list of 40"),
        ("observation_frames", np.full(252, -1), "observation_frames: a frame index outside the list of 6"),
        ("points", np.array([{"a": 1}]), "points: it contains values of type object"),
    ],
)
def test_a_wrong_array_is_named(tmp_path, name, array, what):
    path = tmp_path / "a.npz"
    write_npz(ring(CAMERAS["PINHOLE"]), path)
    with np.load(path) as loaded:
        arrays = dict(loaded)
    assert len(arrays["observation_points"]) == 252
    np.savez(path, **{**arrays, name: array})
    with pytest.raises(UserError, match=what) as caught:
        parse_npz(path)
    assert str(path) in caught.value.message
    del arrays[name if name in arrays else "points"]
    np.savez(path, **arrays)
    if name in ("colours", "depth_bounds"):
        return
    with pytest.raises(UserError, match=r"a\.npz: \w+ is missing"):
        parse_npz(path)


def test_what_is_no_archive_is_refused(tmp_path):
    with pytest.raises(UserError, match="No such file"):
        parse_npz(tmp_path / "a.npz")
    (tmp_path / "a.npz").write_bytes(b"PK\3\4 no")
    with pytest.raises(UserError, match=r"a\.npz is not a readable \.npz file"):
        parse_npz(tmp_path / "a.npz")


def test_two_hundred_corruptions(tmp_path):
    write_npz(full(tmp_path), tmp_path / "a.npz")
    path, refused, rng = tmp_path / "a.npz", 0, np.random.default_rng(8)
    whole = path.read_bytes()
    for _ in range(200):
        path.write_bytes(corrupted_binary(whole, rng))
        refused += assert_refused_or_sound(lambda: parse_npz(path), path)
    assert refused > 100


def test_two_hundred_corruptions_of_the_arrays_inside(tmp_path):
    """Damage behind the archive's checksums: wrong headers and wrong numbers."""
    write_npz(ring(CAMERAS["PINHOLE"], CAMERAS["OPENCV"]), tmp_path / "a.npz")
    path, refused, rng = tmp_path / "a.npz", 0, np.random.default_rng(9)
    with np.load(path) as loaded:
        arrays = dict(loaded)
    for _ in range(200):
        name = str(rng.choice(list(arrays)))
        stream = io.BytesIO()
        np.save(stream, arrays[name])
        members = {other: array for other, array in arrays.items() if other != name}
        np.savez(path, **members)
        add_member(path, f"{name}.npy", corrupted_binary(stream.getvalue(), rng))
        refused += assert_refused_or_sound(lambda: parse_npz(path), path)
    assert refused > 100


def add_member(path: Path, name: str, data: bytes) -> None:
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(name, data)


@pytest.mark.parametrize("shape", [(10**12, 3), (-1, 3), (2**62, 2**62), (0, 2**40)])
def test_an_announced_size_is_not_believed(shape):
    stream = io.BytesIO()
    np.save(stream, np.zeros((5, 3)))
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    data = stream.getvalue()[:10] + text.encode() + stream.getvalue()[128:]
    with pytest.raises(ValueError, match="announces"):
        array_from_npy(data)
