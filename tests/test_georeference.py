"""Georeferenced worlds: control points and GPS, on scenes whose place on Earth is known."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import error_of, nerfcli
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation
from test_scale import photographed, random_similarity, with_gps

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.formats.colmap import write_colmap_binary
from nerfcli.cameras.frame import Capture, Frame
from nerfcli.cameras.rigid import Similarity
from nerfcli.cameras.world import Origin
from nerfcli.errors import UserError
from nerfcli.media.geodesy import ecef
from nerfcli.scale.control_points import read_control_points
from nerfcli.scale.georeference import Georeference, georeference_by_gps, georeference_by_points
from nerfcli.scene import load

few = examples(10)
seeds = st.integers(0, 2**32 - 1)
UTM = "EPSG:32611"
# Somewhere in zone 11: seven digits, of which float32 keeps metres only to a quarter.
CORNER = np.array([235263.0, 3811208.0, 12.0])
# Photos of a survey: 4 x 3 from 30 m above ground, looking down.
CAMERA = Camera("OPENCV", 800, 600, (700.0, 701.0, 400.0, 300.0, -0.1, 0.02, 0.001, -0.001))
PLACES = np.array([[2.0, 3, 0.5], [31, 4, -0.2], [28, 22, 1.1], [5, 24, 0.3], [16, 12, 2.0], [22, 7, 0.0]])
NAMES = [f"gcp{i:02d}" for i in range(len(PLACES))]


def survey() -> list[Frame]:
    """Return cameras in metres from `CORNER`."""
    down = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    grid = [(x, y) for y in (2.0, 13, 24) for x in (3.0, 13, 22, 31)]
    return [
        Frame(f"IMG_{i:04d}.JPG", CAMERA, rigid.from_parts(down, np.array([x, y, 30.0 + 0.3 * i])))
        for i, (x, y) in enumerate(grid)
    ]


def elsewhere(frames: list[Frame], world_from_metres: Similarity) -> list[Frame]:
    return [Frame(f.name, f.camera, world_from_metres.apply_pose(f.world_from_cam[None])[0]) for f in frames]


def control_file(
    path: Path,
    frames: list[Frame],
    *,
    header: str = UTM,
    places: np.ndarray = PLACES,
    written: np.ndarray | None = None,
) -> Path:
    """Write the pixels where the cameras of a survey show places, with `written` as their coordinates."""
    coordinates = places + CORNER if written is None else written
    lines = [header]
    for name, place, row in zip(NAMES, places, coordinates, strict=True):
        for frame in frames:
            pixels, valid = frame.camera.project(rigid.apply(rigid.inverse(frame.world_from_cam), place[None]))
            x, y = pixels[0].tolist()
            if valid[0] and 0 <= x <= 800 and 0 <= y <= 600:
                lines.append("\t".join([*(repr(float(value)) for value in row), repr(x), repr(y), frame.name, name]))
    path.write_text("\n".join(lines) + "\n")
    return path


def first_places(tmp_path: Path, frames: list[Frame], places: np.ndarray, written: np.ndarray) -> Path:
    """Write the file of the first places only."""
    full = np.concatenate([places, PLACES[len(places) :]])
    path = control_file(
        tmp_path / "few.txt", frames, places=full, written=np.concatenate([written, full[len(places) :]])
    )
    kept = [line for line in path.read_text().splitlines() if line == UTM or line.split()[-1] in NAMES[: len(places)]]
    path.write_text("\n".join(kept))
    return path


def solved(frames: list[Frame], path: Path) -> Georeference:
    return georeference_by_points(frames, read_control_points(path), path.name)


@given(seed=seeds)
@few
def test_control_points_give_back_the_survey(seed, tmp_path_factory):
    """Exact pixels: cameras return to their metres, whatever the frame they were estimated in."""
    rng = np.random.default_rng(seed)
    frames, hidden = survey(), random_similarity(rng)
    path = control_file(tmp_path_factory.mktemp("survey") / "gcp_list.txt", frames)
    found = solved(elsewhere(frames, hidden), path)
    offset = np.floor(PLACES.mean(axis=0))
    assert found.origin == Origin(UTM, tuple((CORNER + offset).tolist()), in_degrees=False)
    centres = found.metres_from_world.apply(np.stack([f.centre for f in elsewhere(frames, hidden)]))
    np.testing.assert_allclose(centres + offset, [f.centre for f in frames], rtol=0, atol=1e-7)
    assert found.estimate.metres_per_unit == pytest.approx(1 / hidden.scale, rel=1e-9)
    assert max(distance for _, distance in found.estimate.residuals) < 1e-7
    assert found.estimate.source == "6 control points (gcp_list.txt)"


def test_degrees_become_metres_east_north_and_up(tmp_path):
    """Longitude and latitude of places from lengths of small steps on the ellipsoid."""
    latitude, longitude = 34.408, -119.88
    step = 1e-6
    there = ecef(
        *(np.array(v) for v in ([latitude, latitude + step, latitude], [longitude] * 2 + [longitude + step], [0.0] * 3))
    )
    north, east = (np.linalg.norm(there[i] - there[0]) / step for i in (1, 2))
    degrees = np.column_stack([longitude + PLACES[:, 0] / east, latitude + PLACES[:, 1] / north, PLACES[:, 2]])
    frames = survey()
    path = control_file(tmp_path / "gcp.txt", frames, header="EPSG:4326", written=degrees)
    found = solved(frames, path)
    assert found.origin.in_degrees
    np.testing.assert_allclose(found.origin.coordinates, degrees[0][[1, 0, 2]], rtol=0, atol=1e-12)
    assert str(found.origin).startswith("at latitude 34.4080")
    moved = found.metres_from_world.apply(PLACES)
    np.testing.assert_allclose(moved, PLACES - PLACES[0], rtol=0, atol=5e-4)  # the Earth's curve over 30 m


def test_a_wrong_place_is_named_and_moves_nothing(tmp_path):
    frames = survey()
    written = PLACES + CORNER
    written[3] += [0.0, 4.0, 0.0]
    exact, wrong = (
        solved(frames, control_file(tmp_path / name, frames, written=coordinates))
        for name, coordinates in (("a.txt", None), ("b.txt", written))
    )
    np.testing.assert_allclose(
        wrong.metres_from_world.apply(PLACES) + wrong.origin.coordinates,
        exact.metres_from_world.apply(PLACES) + exact.origin.coordinates,
        rtol=0,
        atol=1e-6,
    )
    assert "outliers ignored: gcp03 (by 4 m)" in wrong.estimate.details
    assert wrong.estimate.source == "5 control points (b.txt)"
    assert dict(wrong.estimate.residuals)["gcp03"] == pytest.approx(4.0, abs=1e-6)


def test_errors_are_those_of_points_predicted_from_the_others(tmp_path):
    """A place that is 5 cm too high, in a fit of four: the others alone predict it 5 cm lower, and the fit less."""
    frames = survey()
    names = slice(0, 4)
    places, written = PLACES[names], PLACES[names] + CORNER
    written[2] += [0.0, 0.0, 0.05]
    found = solved(frames, first_places(tmp_path, frames, places, written))
    errors = dict(found.estimate.residuals)
    assert errors["gcp02"] == pytest.approx(0.05, rel=1e-6)
    assert "each predicted from the others, they miss by" in found.estimate.details
    assert found.estimate.standard_error is not None


def test_three_points_are_enough_but_nothing_checks_them(tmp_path):
    frames = survey()
    found = solved(frames, first_places(tmp_path, frames, PLACES[:3], PLACES[:3] + CORNER))
    assert found.estimate.standard_error is None
    assert "which nothing checks" in found.estimate.details
    np.testing.assert_allclose(found.metres_from_world.scale, 1, rtol=1e-9)


def test_the_stated_errors_are_those_of_other_places(tmp_path):
    """With 3 cm of noise in the survey, places that were not given are off by less than stated, and not by far less."""
    frames, other = survey(), np.array([[10.0, 18.0, 0.4], [25.0, 14.0, 0.9]])
    stated, true = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        written = PLACES + CORNER + 0.03 * rng.normal(size=PLACES.shape)
        found = solved(frames, control_file(tmp_path / "gcp.txt", frames, written=written))
        stated.append(found.estimate.rms_residual)
        there = found.metres_from_world.apply(other) + found.origin.coordinates - CORNER
        true.append(np.sqrt(np.mean(np.sum((there - other) ** 2, axis=1))))
    assert np.median(true) < np.median(stated) < 5 * np.median(true)


@pytest.mark.parametrize(
    ("change", "error", "hint"),
    [
        (lambda text: text.replace(UTM, "x y z"), "the first line is not a coordinate system: 'x y z'", "EPSG:32611"),
        (lambda text: text.replace(UTM, "EPSG:3857"), "metres of EPSG:3857 are not those of the ground", "UTM"),
        (lambda text: text.replace(UTM, "+proj=utm +zone=11 +units=us-ft"), "is not in metres", "to metres"),
        (lambda text: text.replace(UTM, "+proj=tmerc +to_meter=0.3048"), "is not in metres", "to metres"),
        (lambda text: text.replace(UTM, "+proj=utm +zone=11 +vunits=us-ft"), "is not in metres", "heights too"),
        (lambda text: text.replace(UTM, "EPSG:4326"), "not all coordinates are degrees", "longitude comes before"),
        (lambda text: UTM, "has no control points", "a first line with the coordinate system"),
        (lambda text: "\n# nothing\n", "is empty", "a first line with the coordinate system"),
        (lambda text: text + "1 2 3 4 5\n", "is not a control point: '1 2 3 4 5'", "x y height"),
        (lambda text: text + "1 2 high 4 5 a.jpg\n", "is not a control point", "x y height"),
        (lambda text: text + "1 2 nan 4 5 a.jpg\n", "not all numbers are finite", "height is unknown"),
        (lambda text: text + "1 2 3 4 5 IMG_0001.JPG gcp02\n", "gcp02 has other coordinates than before", "own name"),
        (
            lambda text: text.replace("IMG_", "DSC_"),
            "no photo with control points has a pose, such as DSC_",
            "IMG_0000",
        ),
    ],
)
def test_files_that_are_refused(change, error, hint, tmp_path):
    frames = survey()
    path = control_file(tmp_path / "gcp.txt", frames)
    path.write_text(change(path.read_text()))
    with pytest.raises(UserError) as raised:
        solved(frames, path)
    assert error in str(raised.value)
    assert hint in raised.value.hint


def test_points_that_do_not_determine_a_world(tmp_path):
    frames = survey()
    with pytest.raises(UserError, match="only 2 of 2 control points can be used"):
        solved(frames, first_places(tmp_path, frames, PLACES[:2], PLACES[:2] + CORNER))
    line = PLACES * [1, 0, 0] + [0, 12, 0]
    with pytest.raises(UserError, match="control points are on a line"):
        solved(frames, control_file(tmp_path / "line.txt", frames, places=line, written=line + CORNER))
    shuffled = PLACES[[3, 5, 0, 4, 1, 2]] + CORNER
    with pytest.raises(UserError, match="the control points contradict each other: they are spread over"):
        solved(frames, control_file(tmp_path / "wrong.txt", frames, written=shuffled))
    single = control_file(tmp_path / "single.txt", frames[:1])
    with pytest.raises(UserError, match=r"^none of \d control points can be used \(gcp0\d: visible in only one photo"):
        solved(frames, single)


def test_photos_are_found_by_the_end_of_their_name_in_any_case(tmp_path):
    frames = survey()
    path = control_file(tmp_path / "gcp.txt", frames)
    path.write_text(path.read_text().lower().replace(UTM.lower(), UTM))
    folders = [Frame(f"flight/{f.name}", f.camera, f.world_from_cam) for f in frames]
    assert solved(folders, path).estimate.metres_per_unit == pytest.approx(1, rel=1e-9)
    twice = [*folders, *(Frame(f"again/{f.name}", f.camera, f.world_from_cam) for f in frames)]
    with pytest.raises(UserError, match=r"2 photos are named img_0000\.jpg: flight/IMG_0000\.JPG, again/IMG_0000\.JPG"):
        solved(twice, path)


def test_points_without_a_name_are_identified_by_their_coordinates(tmp_path):
    frames = survey()
    path = control_file(tmp_path / "gcp.txt", frames, header="WGS84 UTM 11N")
    path.write_text("\n".join("\t".join(line.split("\t")[:6]) for line in path.read_text().splitlines()))
    assert solved(frames, path).estimate.source == "6 control points (gcp.txt)"


@given(seed=seeds)
@few
def test_gps_gives_a_world_with_z_up(seed):
    rng = np.random.default_rng(seed)
    frames, positions, truth = photographed(rng, count=60, size=300.0, noise=1.0)
    found = georeference_by_gps(frames, positions)
    up = found.metres_from_world.rotation @ truth.rotation.T[:, 2]
    assert np.degrees(np.arccos(up[2])) < 1.5
    assert found.origin.in_degrees
    assert found.origin.coordinates == positions["000.jpg"]


def test_gps_along_a_line_says_nothing_about_up():
    metres = np.column_stack([np.linspace(0, 400, 40), np.zeros(40), np.zeros(40)])
    frames, positions = with_gps(metres, np.random.default_rng(0).normal(size=metres.shape), Similarity.identity())
    with pytest.raises(UserError, match="along a line"):
        georeference_by_gps(frames, positions)


def test_the_command_writes_a_world_of_metres_and_says_where_it_is(tmp_path):
    frames, hidden = survey(), random_similarity(np.random.default_rng(3))
    path = control_file(tmp_path / "gcp_list.txt", frames)
    for frame in frames:
        Image.new("L", (800, 600)).save(tmp_path / frame.name)
    source, out = tmp_path / "in", tmp_path / "out"
    write_colmap_binary(Capture(tuple(elsewhere(frames, hidden)), hidden.apply(PLACES), (), None, "made"), source)
    result = nerfcli("convert", source, out, "--to", "nerfcli", "--georeference", path, "--json")
    assert result.exit_code == 0, result.stderr
    record = json.loads(result.stdout)
    assert record["origin"] == {"system": UTM, "coordinates": [235280.0, 3811220.0, 12.0], "in_degrees": False}
    assert "world: x east, y north, z up; origin at 235280, 3811220, 12 in EPSG:32611" in result.stderr
    written = load(out)
    assert written.unit == "metre"
    assert (written.unit_source or "").endswith("; origin at 235280, 3811220, 12 in EPSG:32611")
    np.testing.assert_allclose(written.points + record["origin"]["coordinates"], PLACES + CORNER, rtol=0, atol=1e-7)
    for options, kept in (((), True), (("--origin", "1,0,0"), False), (("--world-up", "-y"), False)):
        done = nerfcli("convert", out, tmp_path / f"{kept}", "--to", "nerfcli", "--overwrite", *options)
        assert done.exit_code == 0, done.stderr
        source_of_unit = load(tmp_path / f"{kept}").unit_source or ""
        assert source_of_unit.startswith("6 control points")
        assert ("origin" in source_of_unit) == kept
    refused = nerfcli("convert", source, tmp_path / "x", "--to", "nerfcli", "--georeference", path, "--world-up", "z")
    assert refused.exit_code == 2
    assert "--georeference and --world-up cannot be combined" in error_of(refused)[0]
    missing = nerfcli("convert", source, tmp_path / "x", "--to", "nerfcli", "--georeference", tmp_path / "no.txt")
    assert "no.txt does not exist" in error_of(missing)[0]


def test_a_scene_keeps_its_place_until_it_is_moved(tmp_path):
    frames = survey()
    path = control_file(tmp_path / "gcp_list.txt", frames)
    for frame in frames:
        Image.new("L", (800, 600)).save(tmp_path / frame.name)
    photos = tuple(replace(frame, image=tmp_path / frame.name) for frame in frames)
    write_colmap_binary(Capture(photos, PLACES, (), None, "made"), tmp_path / "in")
    place = ("--georeference", path)
    for source, target, options in (("in", "a", place), ("a", "b", ()), ("b", "c", ("--world-up", "y"))):
        done = nerfcli("convert", tmp_path / source, tmp_path / target, "--to", "nerfcli", *options)
        assert done.exit_code == 0, done.stderr
    a, b, c = (load(tmp_path / name).history.get("origin") for name in "abc")
    assert a == b == {"system": UTM, "coordinates": [235280.0, 3811220.0, 12.0], "in_degrees": False}
    assert c is None


def test_positions_in_exif_give_the_place(tmp_path):
    """Photos 11 m apart in a square at 48 degrees north, with positions to a hundredth of a second of arc."""
    frames = []
    for i, (east, north) in enumerate([(0, 0), (11, 0), (22, 0), (0, 11), (11, 11), (22, 11), (0, 22), (22, 22)]):
        exif = Image.Exif()
        seconds = (3600 * north / 111194.0, 3600 * east / 74629.0)  # metres per degree there
        exif[ExifTags.IFD.GPSInfo] = {
            1: "N",
            2: (48, 0, seconds[0]),
            3: "E",
            4: (11, 0, seconds[1]),
            5: b"\0",
            6: 500.0,
        }
        path = tmp_path / f"{i}.jpg"
        Image.new("RGB", (800, 600)).save(path, exif=exif)
        pose = rigid.from_parts(np.diag([1.0, -1, -1]), np.array([north, -east, 3.0]) / 10)
        frames.append(Frame(path.name, CAMERA, pose, image=path))
    write_colmap_binary(Capture(tuple(frames), PLACES, (), None, "made"), tmp_path / "in")
    options = ("--to", "nerfcli", "--georeference", "gps", "--json")
    done = nerfcli("convert", tmp_path / "in", tmp_path / "out", *options)
    assert done.exit_code == 0, done.stderr
    record = json.loads(done.stdout)
    assert record["origin"] == {"system": "WGS 84", "coordinates": [48.0, 11.0, 500.0], "in_degrees": True}
    centres = np.array([frame.centre for frame in load(tmp_path / "out").frames])
    np.testing.assert_allclose(centres[7], [22, 22, 0], rtol=0, atol=0.2)
