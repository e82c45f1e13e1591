"""Formats of phone apps, other programs and data sets: their documented conventions, by hand and in closed form."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from captures import refused
from clips import encode
from every_format import OPENGL, WITH_PHOTOS, Views, change_json, numbers, parse, replace_in, text

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.format import UserInputs
from nerfcli.captures.formats.registry import recognise
from nerfcli.captures.formats.trajectories import poses_at
from nerfcli.errors import UserError

NAMES = (
    *("realityscan-xmp", "openmvg", "kapture", "stray-scanner", "3d-scanner-app", "euroc", "tum-rgbd", "nerfies"),
    "scannetpp",
)
FOCAL, CENTRE, SIZE = 70.0, (30.25, 25.5), (64, 48)
CAMERA = Camera("PINHOLE", *SIZE, (FOCAL, FOCAL, *CENTRE))
# Two cameras 5 units from the origin, which they look at, with the world's z axis up in their pictures.
PLACES = np.array([[3.0, -4.0, 0.0], [0.0, 4.0, 3.0]])
POSES = np.stack([rigid.look_at(place, np.zeros(3), np.array([0.0, 0.0, 1.0])) for place in PLACES])
VIEWS = Views(CAMERA, POSES)


def pixels(capture: Capture, points: np.ndarray) -> np.ndarray:
    """Return where the first frame sees points of the world, (N, 2)."""
    frame = capture.frames[0]
    return frame.camera.project(frame.in_camera(points))[0]


@pytest.mark.parametrize("name", NAMES)
def test_files_of_windows_with_a_byte_order_mark_are_read(tmp_path, name):
    WITH_PHOTOS[name](VIEWS, tmp_path)
    for path in tmp_path.rglob("*"):
        if path.suffix in (".json", ".txt", ".csv", ".yaml", ".xmp"):
            path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\r\n", b"\n").replace(b"\n", b"\r\n"))
    centres = sorted(frame.centre.tolist() for frame in parse(tmp_path).frames)
    np.testing.assert_allclose(centres, sorted(PLACES.tolist()))


def brown(k: tuple[float, float, float], p: tuple[float, float], x: float, y: float) -> tuple[float, float]:
    """OpenCV's polynomial of a point (x, y, 1), in units of the focal length."""
    r2 = x * x + y * y
    radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))
    return (
        x * radial + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x),
        y * radial + 2 * p[1] * x * y + p[0] * (r2 + 2 * y * y),
    )


POINT = (0.3, -0.2)
K, P = (-0.05, 0.02, 0.03), (0.001, -0.002)
R = math.hypot(*POINT)
THETA = math.atan(R)
FISHEYE = THETA * (1 - 0.05 * THETA**2 + 0.02 * THETA**4 + 0.03 * THETA**6 - 0.01 * THETA**8) / R


def with_lens(name: str, kind: str, folder: Path) -> None:
    """Give the lens of a capture these terms, as its program writes them."""
    k1, k2, k3 = K
    if name == "realityscan-xmp":
        terms = f"{k1} {k2} {k3} 0 {P[1]} {P[0]}"  # t1 is OpenCV's p2
        for path in folder.glob("*.xmp"):
            replace_in(path, "0 0 0 0 0 0", terms)
            replace_in(path, '"brown3"', '"brown3t2"')
    elif name == "openmvg":
        path = folder / "sfm_data.json"
        content = json.loads(path.read_text())
        key, terms, kind = {
            "brown": ("disto_t2", [*K, *P], "pinhole_brown_t2"),
            "radial": ("disto_k3", list(K), "pinhole_radial_k3"),
            "fisheye": ("fisheye", [*K, -0.01], "fisheye"),
        }[kind]
        value = content["intrinsics"][0]["value"]
        value["polymorphic_name"] = kind
        data = value["ptr_wrapper"]["data"]
        value["ptr_wrapper"]["data"] = {"value0": data, key: terms}  # as cereal writes a parent's fields
        path.write_text(json.dumps(content))
    elif name == "kapture":
        model = {
            "brown": f"FULL_OPENCV, 64, 48, {FOCAL}, {FOCAL}, 30.25, 25.5, {k1}, {k2}, {P[0]}, {P[1]}, {k3}, 0, 0, 0",
            "fisheye": f"opencv_fisheye, 64, 48, {FOCAL}, {FOCAL}, 30.25, 25.5, {k1}, {k2}, {k3}, -0.01",
        }[kind]
        text(folder / "sensors/sensors.txt", f"cam0,,camera,{model}\n")
    elif name == "euroc":
        path = folder / "mav0/cam0/sensor.yaml"
        terms = f"{k1}, {k2}, {P[0]}, {P[1]}, {k3}" if kind == "brown" else f"{k1}, {k2}, {k3}, -0.01"
        replace_in(path, "[0.0, 0.0, 0.0, 0.0]", f"[{terms}]")
        replace_in(path, "radial-tangential", "radial-tangential" if kind == "brown" else "equidistant")
    elif name == "tum-rgbd":
        text(folder / "calibration.txt", f"{FOCAL} {FOCAL} 30.25 25.5 {k1} {k2} {P[0]} {P[1]} {k3}")
    elif name == "nerfies":
        for path in (folder / "camera").glob("*.json"):
            change_json(path, radial_distortion=list(K), tangential=list(P), tangential_distortion=None)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *((name, "brown") for name in ("realityscan-xmp", "openmvg", "kapture", "euroc", "tum-rgbd", "nerfies")),
        ("openmvg", "radial"),
        *((name, "fisheye") for name in ("openmvg", "kapture", "euroc")),
    ],
)
def test_lenses_are_those_of_the_programs(tmp_path, name, kind):
    WITH_PHOTOS[name](VIEWS, tmp_path)
    with_lens(name, kind, tmp_path)
    x, y = POINT
    in_plane = {"brown": brown(K, P, x, y), "radial": brown(K, (0, 0), x, y), "fisheye": (FISHEYE * x, FISHEYE * y)}
    expected = np.array(CENTRE) + FOCAL * np.array(in_plane[kind])
    found, valid = parse(tmp_path).frames[0].camera.project(np.array([[x, y, 1.0]]))
    assert valid.all()
    np.testing.assert_allclose(found, [expected], rtol=0, atol=1e-9)


class TestPosesInTime:
    def test_a_camera_on_a_circle_is_interpolated(self):
        """At constant speed about one axis, rotations are exact, and positions off by r (1 - cos(step / 2)) at most."""
        seconds = np.arange(0, 1.0, 0.05)
        wanted = np.linspace(0.01, 0.94, 61)

        def on_circle(times: np.ndarray) -> np.ndarray:
            turn = rigid.rotation_from_vector(np.outer(times, [0, 0, 1.0]))
            return rigid.from_parts(turn, 2 * turn[:, :, 0])

        found, is_known = poses_at(seconds[::-1], on_circle(seconds)[::-1], wanted)
        assert is_known.all()
        np.testing.assert_allclose(found[:, :3, :3], on_circle(wanted)[:, :3, :3], rtol=0, atol=1e-12)
        sagitta = 2 * (1 - math.cos(0.025))
        assert np.linalg.norm(found[:, :3, 3] - on_circle(wanted)[:, :3, 3], axis=1).max() <= 1.0001 * sagitta

    def test_measured_times_are_kept_and_gaps_are_not_bridged(self):
        poses = np.tile(np.eye(4), (4, 1, 1))
        poses[:, 0, 3] = [0, 1, 2, 3]
        wanted = np.array([-1, -0.01, 0.1, 0.3, 0.515, 0.615, 2])
        found, is_known = poses_at(np.array([0, 0.1, 0.5, 0.6]), poses, wanted)
        assert is_known.tolist() == [False, True, True, False, True, True, False]
        np.testing.assert_allclose(found[is_known, 0, 3], [0, 1, 2.15, 3], rtol=0, atol=1e-12)


class TestRealityScanXmp:
    def test_files_without_a_pose_or_of_other_programs_are_left_out_and_named(self, tmp_path):
        WITH_PHOTOS["realityscan-xmp"](VIEWS, tmp_path)
        sidecar = (tmp_path / "0.xmp").read_text()
        text(tmp_path / "2.xmp", re.sub("<xcr:Rotation>.*</xcr:Rotation>", "", sidecar))
        text(tmp_path / "3.xmp", sidecar.replace('"absolute"', '"relative" xcr:ComponentId="{7}"'))
        text(tmp_path / "lightroom.xmp", '<x:xmpmeta xmlns:x="adobe:ns:meta/"/>')
        capture = parse(tmp_path)
        assert [frame.name for frame in capture.frames] == ["0.jpg", "1.jpg"]
        assert capture.notes == ("2 XMP files without a pose in the scene left out: 2.xmp, 3.xmp",)

    def test_an_export_as_exact_has_poses_in_its_component(self, tmp_path):
        """Hornacek, On the Coordinate Systems ... by RealityScan: without a component, coordinates are absolute."""
        WITH_PHOTOS["realityscan-xmp"](VIEWS, tmp_path)
        for old, new in (('"absolute"', '"relative" xcr:ComponentId="{7}"'), (' xcr:ComponentId="{7}"', "")):
            for path in tmp_path.glob("*.xmp"):
                replace_in(path, old, new)
            capture = parse(tmp_path)
            np.testing.assert_array_equal([frame.world_from_cam for frame in capture.frames], POSES)
            assert capture.notes == ()

    def test_the_sample_of_the_help_has_all_values_in_attributes(self, tmp_path):
        """RealityScan's help: the rotation -1 0 0 0 0 -1 0 -1 0 looks along -y, with z up and -x to the right."""
        VIEWS.put(0, tmp_path / "IMG_1.JPG")
        text(
            tmp_path / "IMG_1.XMP",
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            '<rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3" '
            'xcr:Rotation="-1 0 0 0 0 -1 0 -1 0" xcr:DistortionModel="division" xcr:FocalLength35mm="18">'
            "<xcr:Position>1 2 3</xcr:Position></rdf:Description></rdf:RDF></x:xmpmeta>",
        )
        capture = parse(tmp_path)
        (frame,) = capture.frames
        assert frame.camera == Camera("PINHOLE", 64, 48, (32, 32, 32, 24))
        np.testing.assert_array_equal(pixels(capture, np.array([[1.0, 1, 3], [0.5, 1, 3.5]])), [[32, 24], [48, 8]])

    @pytest.mark.parametrize("tag", ['xcr:DistortionModel="none"', 'xcr:DistortionModel="perspective"', ""])
    def test_coefficients_count_for_nothing_without_a_model(self, tmp_path, tag):
        WITH_PHOTOS["realityscan-xmp"](VIEWS, tmp_path)
        for path in tmp_path.glob("*.xmp"):
            replace_in(path, "0 0 0 0 0 0", "0.1 0 0 0 0 0")
            replace_in(path, 'xcr:DistortionModel="brown3"', tag)
        assert parse(tmp_path).frames[0].camera.model == "PINHOLE"

    @pytest.mark.parametrize(
        ("old", "new", "what"),
        [
            ('DistortionModel="brown3"', 'DistortionModel="division"', "DistortionModel is 'division'"),
            ('DistortionModel="brown3"', 'DistortionModel="rationalP2D1"', "DistortionModel is 'rationalp2d1'"),
            ("0.1 0 0 0 0 0", "0.1 0 0", "DistortionCoeficients: has 3 numbers"),
            ("xcr:FocalLength35mm=", "xcr:Focal=", "FocalLength35mm: has 0 numbers"),
            ("xcr:Version", 'xcr:Skew="0.05" xcr:Version', "skew is 3.2, which no supported lens has"),
            ("</xcr:Position>", " 4</xcr:Position>", "Position: has 4 numbers"),
            ("<x:xmpmeta", "<!DOCTYPE a><x:xmpmeta", "declares a document type"),
        ],
    )
    def test_what_cannot_be_read_is_refused_with_its_name(self, tmp_path, old, new, what):
        WITH_PHOTOS["realityscan-xmp"](VIEWS, tmp_path)
        replace_in(tmp_path / "1.xmp", "0 0 0 0 0 0", "0.1 0 0 0 0 0")
        replace_in(tmp_path / "1.xmp", old, new)
        with refused(f"1.xmp: .*{what}|1.xmp: {what}", tmp_path):
            parse(tmp_path)


class TestOpenMvg:
    def test_points_and_where_they_were_seen(self, tmp_path):
        path = WITH_PHOTOS["openmvg"](VIEWS, tmp_path)
        seen = [{"key": 1, "value": {"id_feat": 0, "x": [1.5, 2.5]}}, {"key": 9, "value": {"id_feat": 0, "x": [0, 0]}}]
        change_json(path, structure=[{"key": 0, "value": {"X": [1, 2, 3], "observations": seen}}])
        capture = parse(tmp_path)
        np.testing.assert_array_equal(capture.points, [[1, 2, 3]])
        assert capture.observations is not None
        assert capture.observations.frame_index.tolist() == [1]
        assert capture.observations.point_index.tolist() == [0]
        assert capture.observations.pixels.tolist() == [[1.5, 2.5]]

    def test_views_without_a_pose_are_named_and_types_are_remembered_by_number(self, tmp_path):
        path = WITH_PHOTOS["openmvg"](VIEWS, tmp_path)
        content = json.loads(path.read_text())
        content["extrinsics"].pop()
        lens = json.loads(json.dumps(content["intrinsics"][0]))
        lens["key"] = 8
        del lens["value"]["polymorphic_name"]
        lens["value"]["polymorphic_id"] = 1  # the first type of the file, without its name
        content["intrinsics"].append(lens)
        content["views"][0]["value"]["ptr_wrapper"]["data"]["id_intrinsic"] = 8
        path.write_text(json.dumps(content))
        capture = parse(tmp_path)
        assert [(frame.name, frame.camera) for frame in capture.frames] == [("0.jpg", CAMERA)]
        assert capture.notes == ("1 photo without a pose left out: 1.jpg",)

    def test_a_panorama(self, tmp_path):
        path = WITH_PHOTOS["openmvg"](Views(Camera.pinhole(64, 32, 70.0), POSES), tmp_path)
        sphere = {"polymorphic_name": "spherical", "ptr_wrapper": {"data": {"value0": {"width": 64, "height": 32}}}}
        change_json(path, intrinsics=[{"key": 7, "value": sphere}])
        # What the camera looks at is in the middle, what is to its right a quarter further.
        directions = [[0.0, 0, 0], PLACES[0] + [0.8, 0.6, 0]]
        np.testing.assert_allclose(pixels(parse(tmp_path), np.array(directions)), [[32, 16], [48, 16]], atol=1e-9)

    def test_a_file_without_poses_is_refused(self, tmp_path):
        change_json(WITH_PHOTOS["openmvg"](VIEWS, tmp_path), extrinsics=[])
        with pytest.raises(UserError, match="lists no images with a pose"):
            parse(tmp_path)


class TestKapture:
    def test_a_rig_of_two_cameras(self, tmp_path):
        """The second camera is 0.2 to the right of the first, so the world moves left in it."""
        home = WITH_PHOTOS["kapture"](VIEWS, tmp_path).parent
        rigs = "car, rig, 1, 0, 0, 0, 0, 0, 0\nrig, cam0, 2, 0, 0, 0, 0, 0, 0\nrig, cam1, 1,0,0,0,-0.2,0,0\n"
        text(home / "rigs.txt", rigs)
        replace_in(home / "trajectories.txt", " cam0,", " car,")
        text(home / "sensors.txt", (home / "sensors.txt").read_text() + "cam1,,camera,SIMPLE_PINHOLE,64,48,70,32,24\n")
        text(home / "records_camera.txt", "0000, cam0, walk/0.jpg\n0000, cam1, walk/1.jpg\n0007, cam1, walk/7.jpg\n")
        capture = parse(tmp_path)
        np.testing.assert_allclose(capture.frames[0].world_from_cam, POSES[0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(capture.frames[1].centre, PLACES[0] + [0.16, 0.12, 0], rtol=0, atol=1e-12)
        assert capture.frames[1].camera.model == "SIMPLE_PINHOLE"
        assert capture.notes == ("1 photo without a pose left out: walk/7.jpg",)

    def test_points_with_colours_and_a_camera_that_is_given(self, tmp_path):
        home = WITH_PHOTOS["kapture"](VIEWS, tmp_path).parent
        text(tmp_path / "reconstruction/points3d.txt", "# X, Y, Z, R, G, B\n1.0, 2.0, 3.0, 10, 20, 30\n")
        text(home / "sensors.txt", "cam0, , camera, UNKNOWN_CAMERA, 64, 48\n")
        with pytest.raises(UserError, match=r"sensors.txt: line 1: the camera is not calibrated") as caught:
            parse(tmp_path)
        assert "--intrinsics" in caught.value.hint
        capture = parse(tmp_path, UserInputs(camera=CAMERA.resized(128, 96)))
        assert {frame.camera for frame in capture.frames} == {CAMERA}
        np.testing.assert_array_equal(capture.points, [[1, 2, 3]])
        assert capture.colours is not None
        assert capture.colours.tolist() == [[10, 20, 30]]
        text(home / "sensors.txt", "cam0, , camera, SIMPLE_PINHOLE, 64, 48, 70, 32, 24\n")
        with pytest.raises(UserError, match=r"sensors.txt: its cameras are all calibrated"):
            parse(tmp_path, UserInputs(camera=CAMERA))

    def test_poses_of_which_a_part_is_not_known_are_none(self, tmp_path):
        home = WITH_PHOTOS["kapture"](VIEWS, tmp_path).parent
        rows = (home / "trajectories.txt").read_text().splitlines()
        text(home / "trajectories.txt", "\n".join([*rows[:2], f"{rows[2]},"]))
        assert parse(tmp_path).notes == ()
        text(home / "trajectories.txt", "\n".join([*rows[:2], "0001, cam0, , , , , 1, 2, 3"]))
        assert parse(tmp_path).notes == ("1 photo without a pose left out: walk/1.jpg",)

    def test_a_pose_with_a_decimal_comma_is_refused(self, tmp_path):
        path = WITH_PHOTOS["kapture"](VIEWS, tmp_path)
        text(path, "0000, cam0, 0,5, 0.5, 0.5, 0.5, 1, 2, 3\n0001, cam0, 0.5, 0.5, 0.5, 0.5, 1, 2, 3\n")
        with pytest.raises(UserError, match=r"trajectories.txt: line 1: has 8 numbers"):
            parse(tmp_path)


class TestStrayScanner:
    def test_the_frames_of_the_video_are_the_photos(self, tmp_path):
        """Without photos, the frames have the video's size; those that are on disk are used under their numbers."""
        WITH_PHOTOS["stray-scanner"](VIEWS, tmp_path)
        encode(tmp_path / "rgb.mp4", 2 * [np.zeros((48, 64, 3), np.uint8)])
        for photo in (tmp_path / "rgb").iterdir():
            photo.unlink()
        capture = parse(tmp_path)
        found = [(frame.name, frame.has_photo) for frame in capture.frames]
        assert found == [("frame_000000", False), ("frame_000001", False)]
        assert {frame.camera for frame in capture.frames} == {CAMERA}
        VIEWS.put(1, tmp_path / "rgb/000001.png")
        capture = parse(tmp_path)
        assert [frame.name for frame in capture.frames] == ["000001.png"]
        assert capture.notes == ("1 of the 2 frames with a pose have a photo",)
        np.testing.assert_allclose(capture.frames[0].centre, PLACES[1], rtol=0, atol=1e-12)

    def test_a_lens_in_each_row_comes_before_the_matrix_and_columns_in_any_order(self, tmp_path):
        path = WITH_PHOTOS["stray-scanner"](VIEWS, tmp_path)
        header, *rows = path.read_text().splitlines()
        shown = [f"{71 + index}, {71 + index}, 32, 24, {row}" for index, row in enumerate(rows)]
        text(path, "\n".join([f"fx, fy, cx, cy, {header}", *shown]))
        (tmp_path / "camera_matrix.csv").write_text("nothing")
        assert [frame.camera.focal_lengths for frame in parse(tmp_path).frames] == [(71, 71), (72, 72)]

    def test_damage_is_named(self, tmp_path):
        path = WITH_PHOTOS["stray-scanner"](VIEWS, tmp_path)
        replace_in(path, " qw", " w")
        with pytest.raises(UserError, match=r"odometry.csv: has no column qw"):
            parse(tmp_path)


class TestScannerApp:
    def test_frames_without_a_photo_are_counted(self, tmp_path):
        path = WITH_PHOTOS["3d-scanner-app"](VIEWS, tmp_path)
        text(tmp_path / "frame_00002.json", path.read_text())
        text(tmp_path / "info.json", "{}")
        capture = parse(tmp_path)
        assert [frame.name for frame in capture.frames] == ["frame_00000.jpg", "frame_00001.jpg"]
        assert capture.notes == ("2 of the 3 frames with a pose have a photo",)
        assert (capture.unit, capture.unit_source) == ("metre", "ARKit (3D Scanner App)")

    def test_rounding_in_the_last_row_of_a_pose_is_accepted(self, tmp_path):
        path = WITH_PHOTOS["3d-scanner-app"](VIEWS, tmp_path)
        exact = parse(tmp_path).frames[0].world_from_cam
        change_json(path, cameraPoseARFrame=[*json.loads(path.read_text())["cameraPoseARFrame"][:15], 0.9999999])
        np.testing.assert_array_equal(parse(tmp_path).frames[0].world_from_cam, exact)


class TestEuroc:
    def test_two_cameras_and_photos_before_the_first_pose(self, tmp_path):
        home = WITH_PHOTOS["euroc"](VIEWS, tmp_path).parent.parent
        replace_in(home / "cam0/data.csv", "#timestamp", "999000000000000000,999000000000000000.png\n#timestamp")
        for name in ("data.csv", "sensor.yaml"):
            text(home / "cam1" / name, (home / "cam0" / name).read_text())
        for photo in (home / "cam0/data").iterdir():
            VIEWS.put(0, home / "cam1/data" / photo.name)
        capture = parse(tmp_path)
        assert [frame.name.split("/")[0] for frame in capture.frames] == ["cam0", "cam0", "cam1", "cam1"]
        (note,) = capture.notes
        assert re.fullmatch(r"2 photos without a pose near in time left out: cam0/data/999\d+.png, .*", note)

    def test_a_model_that_is_not_supported_is_named(self, tmp_path):
        home = WITH_PHOTOS["euroc"](VIEWS, tmp_path).parent.parent
        replace_in(home / "cam0/sensor.yaml", "camera_model: pinhole", "camera_model: omni")
        with pytest.raises(UserError, match=r"sensor.yaml: camera_model is 'omni'"):
            parse(tmp_path)


class TestTumRgbd:
    def test_photos_between_two_poses(self, tmp_path):
        WITH_PHOTOS["tum-rgbd"](VIEWS, tmp_path)
        quarter = f"{numbers(PLACES[0])} 0 0 {math.sqrt(0.5)!r} {math.sqrt(0.5)!r}"
        head = "timestamp tx ty tz qx qy qz qw"  # as in copies that were prepared for pandas
        text(tmp_path / "groundtruth.txt", f"{head}\n10.00 {numbers(PLACES[0])} 0 0 0 1\n10.02 {quarter}\n")
        text(tmp_path / "rgb.txt", "10.01 rgb/0.png\n10.5 rgb/1.png\n")
        capture = parse(tmp_path)
        eighth = rigid.rotation_from_vector(np.array([0, 0, math.pi / 4]))
        (frame,) = capture.frames
        np.testing.assert_allclose(frame.world_from_cam, rigid.from_parts(eighth, PLACES[0]), rtol=0, atol=1e-9)
        assert capture.notes == ("1 photo without a pose near in time left out: rgb/1.png",)

    @pytest.mark.parametrize(("sequence", "focal", "lens"), [("1", 517.3, "FULL_OPENCV"), ("3", 535.4, "PINHOLE")])
    def test_the_cameras_of_the_benchmark(self, tmp_path, sequence, focal, lens):
        folder = tmp_path / f"rgbd_dataset_freiburg{sequence}_desk"
        WITH_PHOTOS["tum-rgbd"](Views(Camera.pinhole(640, 480, 500.0), POSES), folder)
        (folder / "calibration.txt").unlink()
        camera = parse(folder).frames[0].camera
        assert (camera.model, camera.size, camera.focal_lengths[0]) == (lens, (640, 480), focal)

    def test_another_sequence_without_a_camera_is_refused(self, tmp_path):
        WITH_PHOTOS["tum-rgbd"](VIEWS, tmp_path)
        (tmp_path / "calibration.txt").unlink()
        with pytest.raises(UserError, match=r"without calibration.txt, and not of freiburg1, 2 or 3") as caught:
            parse(tmp_path)
        assert "--intrinsics" in caught.value.hint
        given = UserInputs(camera=CAMERA.resized(128, 96))
        assert {frame.camera for frame in parse(tmp_path, given).frames} == {CAMERA}


class TestNerfies:
    def test_split_bounds_and_points(self, tmp_path):
        WITH_PHOTOS["nerfies"](VIEWS, tmp_path)
        text(tmp_path / "scene.json", json.dumps({"scale": 0.5, "center": [1, 2, 3], "near": 0.1, "far": 2.0}))
        np.save(tmp_path / "points.npy", np.array([[1, 2, 3]], np.float32))
        capture = parse(tmp_path)
        assert [frame.split for frame in capture.frames] == ["val", "train"]
        assert capture.depth_bounds is not None
        np.testing.assert_allclose(capture.depth_bounds, [[0.2, 4], [0.2, 4]], rtol=1e-12)
        np.testing.assert_array_equal(capture.points, [[1, 2, 3]])

    def test_reduced_photos_only_and_a_photo_without_a_camera(self, tmp_path):
        WITH_PHOTOS["nerfies"](VIEWS, tmp_path)
        (tmp_path / "rgb/1x").rename(tmp_path / "rgb/2x")
        change_json(tmp_path / "dataset.json", ids=["000000", "000001", "lost"])
        capture = parse(tmp_path)
        assert [frame.image for frame in capture.frames] == [tmp_path / f"rgb/2x/{index:06d}.png" for index in (0, 1)]
        assert capture.notes == ("1 photo without a camera left out: lost",)

    def test_without_dataset_json_all_cameras_are_read(self, tmp_path):
        WITH_PHOTOS["nerfies"](VIEWS, tmp_path)
        (tmp_path / "dataset.json").unlink()
        assert [frame.split for frame in parse(tmp_path).frames] == [None, None]


class TestScanNetPp:
    def test_masks_split_and_bad_photos(self, tmp_path):
        path = WITH_PHOTOS["scannetpp"](VIEWS, tmp_path)
        VIEWS.put(0, tmp_path / "dslr/resized_anon_masks/DSC00000.png")
        content = json.loads(path.read_text())
        content["frames"].append(content["frames"][0] | {"file_path": "DSC00009.jpg", "is_bad": True})
        for record in (*content["frames"], *content["test_frames"]):
            record["mask_path"] = record["file_path"].replace(".jpg", ".png")
        path.write_text(json.dumps(content))
        capture = parse(tmp_path / "dslr")
        assert {frame.name: (frame.split, frame.mask is not None) for frame in capture.frames} == {
            "DSC00001.jpg": ("train", False),
            "DSC00000.jpg": ("test", True),
        }
        lost = "1 mask named in transforms.json left out, not found: DSC00001.png"
        assert capture.notes == (lost, "1 photo marked as bad left out")

    def test_undistorted_photos_have_their_own_file(self, tmp_path):
        path = WITH_PHOTOS["scannetpp"](VIEWS, tmp_path)
        other = path.with_name("transforms_undistorted.json")
        path.rename(other)
        (tmp_path / "dslr/resized_images").rename(tmp_path / "dslr/undistorted_images")
        assert all(frame.has_photo for frame in parse(tmp_path).frames)

    def test_a_transforms_json_of_others_is_none(self, tmp_path):
        VIEWS.put(0, tmp_path / "a.jpg")
        frames = [{"file_path": "a.jpg", "transform_matrix": OPENGL.tolist()}]
        text(tmp_path / "transforms.json", json.dumps({"w": 64, "h": 48, "fl_x": 70, "frames": frames}))
        assert recognise(tmp_path)[0].name == "transforms"


@pytest.mark.parametrize(
    ("name", "depth", "confidence", "unit"),
    [
        ("stray-scanner", "depth/00000{}.png", "confidence/00000{}.png", 1e-3),
        ("3d-scanner-app", "depth_0000{}.png", "conf_0000{}.png", 1e-3),
        ("tum-rgbd", "depth/{}.png", None, 1 / 5000),
    ],
)
def test_depth_maps_of_sensors_are_found_with_their_unit_and_confidence(tmp_path, name, depth, confidence, unit):
    """One of the first two photos has a depth map; in TUM's lists by time, 10 ms away, where 20 ms count."""
    WITH_PHOTOS[name](VIEWS, tmp_path)
    if name == "tum-rgbd":
        text(tmp_path / "depth.txt", f"# depth maps\n{1305031100.26!r} depth/0.png\n{1305031100.29!r} depth/9.png\n")
    maps = [tmp_path / path.format(0) for path in (depth, confidence) if path]
    for path in maps:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    first, second = (frame.depth for frame in parse(tmp_path).frames)
    assert first is not None
    assert (first.path, first.unit, first.confidence) == (maps[0], unit, maps[1] if confidence else None)
    assert second is None
