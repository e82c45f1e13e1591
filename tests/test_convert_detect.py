"""Which convention a capture follows, found out from captures whose convention was broken on purpose."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from commands import completed, nerfcli, refusal
from PIL import Image
from views import BROWN, PINHOLE, capture_of

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures import evidence
from nerfcli.captures.axes import Convention, for_picture, opencv_from_axes, poses_of, reinterpreted
from nerfcli.captures.capture import Capture, Observations
from nerfcli.captures.detect import Detection, HypothesisScore, Question, detect
from nerfcli.captures.evidence import LEAST_MOVE, MatchEvidence, match_neighbours
from nerfcli.captures.formats.colmap import write_colmap_text
from nerfcli.captures.formats.transforms import write_transforms
from nerfcli.errors import UserError
from nerfcli.matching.features import Features, Matches, find_features


def silent(fraction: float, detail: str) -> None:
    """Ignore progress."""


def with_poses(capture: Capture, poses: np.ndarray) -> Capture:
    frames = zip(capture.frames, poses, strict=True)
    return replace(capture, frames=tuple(replace(frame, world_from_cam=pose) for frame, pose in frames))


def misread(capture: Capture, meant: Convention, parsed_axes: str) -> Capture:
    """Return the capture that a reader parses from a file in the convention `meant` if it assumes the format's own.

    Independent of `expressed`: it computes the matrices of the file, then removes the axes of the format.
    """
    in_file = poses_of(capture) @ opencv_from_axes(meant.axes)
    if meant.inverted:
        in_file = np.linalg.inv(in_file)
    wrong = with_poses(capture, in_file @ np.linalg.inv(opencv_from_axes(parsed_axes)))
    frames = []
    for frame in wrong.frames:
        camera, k, shift = frame.camera, meant.intrinsics_scale, meant.pixel_centre - 0.5
        params = [value * k for value in camera.params[:4]] + list(camera.params[4:])
        params[2:4] = [value + shift for value in params[2:4]]
        frames.append(replace(frame, camera=Camera(camera.model, camera.width, camera.height, tuple(params))))
    return replace(wrong, frames=tuple(frames))


def test_a_hypothesis_that_is_behind_the_cameras_has_no_number_in_json(monkeypatch, tmp_path):
    """Regression: --json printed Infinity, which is no JSON, and the table "inf times better"."""
    scores = [
        HypothesisScore(Convention("rdf"), True, 0.4, 0.9),
        HypothesisScore(Convention("rub"), False, np.inf, 0.0),
    ]
    question = Question("axes and direction", tuple(scores), "holds", np.inf, "")
    found = Detection("3 points", (question,), Convention("rdf"), Convention("rdf"))
    read = (SimpleNamespace(name="colmap"), found)
    monkeypatch.setattr("nerfcli.workflows.convert.detect_convention", lambda *given, **more: read)
    result = nerfcli("convert", tmp_path, "--detect", "--json")
    record = json.loads(result.stdout, parse_constant=lambda name: pytest.fail(name))
    assert record["questions"][0]["ratio"] is None
    convention = {"axes": "rub", "inverted": False, "pixel_centre": 0.5, "intrinsics_scale": 1.0}
    scored = {"as_format_says": False, "median_px": None, "inlier_share": 0.0}
    assert record["questions"][0]["hypotheses"][1] == convention | scored
    assert "fits; the next puts most of the evidence behind" in nerfcli("convert", tmp_path, "--detect").stdout


def verdicts(found: Detection) -> dict[str, str]:
    return {question.name: question.verdict for question in found.questions}


CONVENTIONS = [
    Convention("opengl"),
    Convention("opencv"),
    Convention("opencv", inverted=True),
    Convention("opengl", inverted=True),
    Convention("llff"),
    Convention("ros"),
    Convention("drb", inverted=True),
    Convention("opengl", pixel_centre=0.0),
    Convention("opencv", inverted=True, intrinsics_scale=2.0),
    Convention("opencv", inverted=True, intrinsics_scale=0.5, pixel_centre=0.0),
]


@pytest.mark.parametrize("meant", CONVENTIONS, ids=str)
@pytest.mark.parametrize("parsed_axes", ["opengl", "opencv"])
def test_exact_observations_identify_every_convention(meant, parsed_axes):
    if meant.axes == "drb":
        meant = replace(meant, axes="llff")
    capture = misread(capture_of([PINHOLE, BROWN]), meant, parsed_axes)
    found = detect(capture, axes=parsed_axes, progress=silent)
    assert found.convention == meant
    assert set(verdicts(found).values()) == {"holds"}
    assert all(question.ratio > 10 for question in found.questions)  # the first two still have a half pixel's error
    assert found.questions[-1].ratio > 100
    assert found.as_format_says == (meant == Convention(parsed_axes))
    # convert then restores the original capture.
    mended = reinterpreted(capture, found.convention, parsed_axes=parsed_axes)
    np.testing.assert_allclose(poses_of(mended), poses_of(capture_of([PINHOLE, BROWN])), rtol=0, atol=1e-12)
    assert mended.frames[1].camera.params == pytest.approx(BROWN.params, rel=1e-14)


def test_a_half_pixel_below_the_noise_is_not_decided():
    """20 px of noise in 360 observations: their median error is known to about 1 px, not to 0.5 px."""
    capture = capture_of([PINHOLE])
    assert capture.observations is not None
    rng = np.random.default_rng(1)
    noisy = capture.observations.pixels + rng.normal(0, 20, capture.observations.pixels.shape)
    capture = replace(capture, observations=replace(capture.observations, pixels=noisy))
    capture = replace(capture, frames=tuple(capture.frames))
    found = detect(misread(capture, Convention("opengl"), "opencv"), axes="opencv", progress=silent)
    question = found.questions[-1]
    assert question.name == "pixel centre"
    assert question.verdict != "holds"
    assert found.convention.pixel_centre == 0.5


def test_poses_that_fit_in_no_convention_are_reported():
    capture = capture_of([PINHOLE], count=8)
    rng = np.random.default_rng(2)
    shuffled = poses_of(capture)[rng.permutation(8)]
    found = detect(with_poses(capture, shuffled), axes="opencv", progress=silent)
    assert verdicts(found)["axes and direction"] == "none holds"
    assert not found.as_format_says
    assert found.convention == Convention("opencv")


def matched_pairs(capture: Capture) -> list[Matches]:
    """Return the matches of a perfect matcher: the points that both neighbours see."""
    seen = capture.observations
    assert isinstance(seen, Observations)
    where: list[dict[int, int]] = []
    for i in range(len(capture.frames)):
        rows = np.flatnonzero(seen.frame_index == i)
        where.append(dict(zip(seen.point_index[rows].tolist(), rows.tolist(), strict=True)))
    pairs = []
    for first in range(len(capture.frames) - 1):
        both = sorted(set(where[first]) & set(where[first + 1]))
        rows = [[where[first + step][point] for point in both] for step in (0, 1)]
        pairs.append(Matches((first, first + 1), (seen.pixels[rows[0]], seen.pixels[rows[1]])))
    return pairs


@pytest.mark.parametrize("meant", CONVENTIONS[:7], ids=str)
def test_epipolar_errors_vanish_in_the_right_convention_alone(meant):
    capture = capture_of([PINHOLE, BROWN], count=8)
    spoiled = misread(capture, meant, "opengl")
    evidence = MatchEvidence(matched_pairs(capture), dict(enumerate(f.camera for f in spoiled.frames)), 8)
    directions = evidence.directions(Convention("opengl"))
    right = evidence.errors_px(directions, poses_of(reinterpreted(spoiled, meant, parsed_axes="opengl")))
    assert right.max() < 1e-8
    for other in CONVENTIONS[:7]:
        same_axes = np.array_equal(opencv_from_axes(other.axes), opencv_from_axes(meant.axes))
        if not same_axes or other.inverted != meant.inverted:
            wrong = evidence.errors_px(directions, poses_of(reinterpreted(spoiled, other, parsed_axes="opengl")))
            assert np.median(wrong) > 5


def test_the_epipolar_error_is_the_distance_in_pixels():
    """A camera moved sideways sees every point in the same row. With one photo shifted by 3 rows, the Sampson distance
    to the epipolar geometry is 3 / sqrt(2) px near the optical axis."""
    camera = Camera.pinhole(2000, 2000, 10_000.0)
    second = np.eye(4)
    second[0, 3] = 1.0
    points = np.random.default_rng(0).uniform((-0.4, -0.4, 30), (0.4, 0.4, 50), (50, 3))
    first_pixels, _ = camera.project(points)
    second_pixels, _ = camera.project(points - second[:3, 3])
    second_pixels[:, 1] += 3.0
    pair = Matches((0, 1), (first_pixels, second_pixels))
    evidence = MatchEvidence([pair], {0: camera, 1: camera}, 2)
    errors = evidence.errors_px(evidence.directions(Convention("opencv")), np.stack([np.eye(4), second]))
    np.testing.assert_allclose(errors, 3 / np.sqrt(2), rtol=2e-3)


def test_photos_from_one_place_are_judged_by_their_rays():
    """Without a baseline there is no epipolar plane, but turning the axes turns the rays of a match apart."""
    turns = np.random.default_rng(3).normal(scale=0.15, size=(4, 3))
    poses = np.stack([rigid.from_parts(rigid.rotation_from_vector(turn), np.array([5.0, 1.0, 2.0])) for turn in turns])
    points = np.random.default_rng(0).uniform((-9, -9, 30), (9, 9, 50), (50, 3)) + poses[0, :3, 3]
    seen = [PINHOLE.project(rigid.apply(rigid.inverse(pose), points))[0] for pose in poses]
    pairs = [Matches((first, first + 1), (seen[first], seen[first + 1])) for first in range(3)]
    evidence = MatchEvidence(pairs, dict.fromkeys(range(4), PINHOLE), 4)
    directions = evidence.directions(Convention("opencv"))
    assert evidence.errors_px(directions, poses).max() < 1e-8
    for wrong in (poses @ opencv_from_axes("opengl"), rigid.inverse(poses)):
        assert np.median(evidence.errors_px(directions, wrong)) > 5


def test_points_alone_identify_axes(tmp_path):
    capture = replace(misread(capture_of([PINHOLE]), Convention("opencv"), "opengl"), observations=None)
    found = detect(capture, axes="opengl", progress=silent)
    assert "the visibility of" in found.evidence
    assert [question.name for question in found.questions] == ["axes and direction"]
    best = found.questions[0].answers[0]
    assert best.inlier_fraction == 1


# Photos


CARDS = ((-1.2, -0.9, 2.4, 1.8, 1.0), (-0.5, -0.4, 1.0, 0.8, 0.3))


def photograph(
    folder: Path, *, times: Sequence[float], camera: Camera, shake: float = 0.15, name: str = "{:02d}.png"
) -> Capture:
    """Make photos of a textured card in front of a larger one (x, y, width, height, z of each) by homographies.

    The camera moves along a path of about its distance from the cards, in a time of 1, and looks at their middle, or
    past it by `shake`.
    """
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    textures = []
    for _ in CARDS:
        layers = [
            cv2.resize(rng.uniform(0, 255, (n, n)), (512, 512), interpolation=cv2.INTER_CUBIC) for n in (12, 40, 120)
        ]
        textures.append(np.clip(np.mean(layers, axis=0), 0, 255).astype(np.float32))
    fx, fy, cx, cy = camera.params
    matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])  # OpenCV's pixel centres are whole numbers
    frames = []
    for index, time in enumerate(times):
        centre = np.array([np.sin(1.5 * time), 0.6 * np.cos(2.0 * time), -2.6 + 0.2 * np.cos(time)]) * (0.8, 0.8, 1)
        pose = rigid.look_at(centre, rng.normal(0, 1, 3) * shake, np.array([0.2 * np.sin(time), -1.0, 0.0]))
        cam_from_world = rigid.inverse(pose)
        picture = np.zeros((camera.height, camera.width), np.float32)
        for texture, (x, y, width, height, z) in zip(textures, CARDS, strict=True):
            # world = (x + u width, y + v height, z) for texture pixels (512 u, 512 v) - 1/2
            card = np.array(
                [[width / 512, 0, x + width / 1024], [0, height / 512, y + height / 1024], [0, 0, z], [0, 0, 1]]
            )
            homography = matrix @ cam_from_world[:3] @ card
            size = (camera.width, camera.height)
            seen = cv2.warpPerspective(texture, homography, size, flags=cv2.INTER_LINEAR, borderValue=-1.0)
            picture = np.where(seen >= 0, seen, picture)
        image = folder / name.format(index)
        Image.fromarray(np.clip(picture, 0, 255).astype(np.uint8)).save(image)
        frames.append(Frame(image.name, camera, pose, image=image))
    return Capture(tuple(frames), np.zeros((0, 3)), (), None, "transforms")


@pytest.fixture(scope="module", autouse=True)
def _features_found_once() -> Iterator[None]:
    """Keep the features of each photo, which take most of the time: the tests look at the same photos again."""
    kept: dict[bytes, Features] = {}

    def found(grey: np.ndarray, *, longer_side_px: int, most: int) -> Features:
        key = grey.tobytes()
        if key not in kept:
            kept[key] = find_features(grey, longer_side_px=longer_side_px, most=most)
        return kept[key]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(evidence, "find_features", found)
        yield


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return photograph(
        tmp_path_factory.mktemp("cards") / "images", times=range(6), camera=Camera.pinhole(480, 360, 420.0)
    )


def test_matches_lie_where_both_photos_show_the_same_place(photographed):
    """Positions off by half a pixel, or by OpenCV's bias of a quarter, would raise the median error to 0.05 px."""
    pairs, cameras = match_neighbours(photographed.frames, progress=silent)
    assert len(pairs) >= 3
    evidence = MatchEvidence(pairs, cameras, 6)
    errors = evidence.errors_px(evidence.directions(Convention("opencv")), poses_of(photographed))
    assert np.median(errors) < 0.035


def test_frames_of_a_video_are_compared_with_later_ones(tmp_path):
    """Neighbours move by 1 % of the picture, which says nothing about intrinsics. Then the camera becomes faster, and
    nothing matches the last photo, which is black.
    """
    times = [*(0.03 * index for index in range(11)), 0.9, 1.6]
    capture = photograph(tmp_path / "i", times=times, camera=Camera.pinhole(480, 360, 420.0), shake=0, name="{}.png")
    Image.new("L", (480, 360)).save(tmp_path / "i/12.png")
    in_order_of_text = tuple(sorted(capture.frames, key=lambda frame: frame.name))  # 0, 1, 10, 11, 12, 2, ...
    pairs, _ = match_neighbours(in_order_of_text, progress=silent)
    seen = [tuple(int(Path(in_order_of_text[index].name).stem) for index in pair.photos) for pair in pairs]
    assert [first for first, _ in seen] == list(range(11))
    moves = [np.median(np.linalg.norm(pair.pixels[1] - pair.pixels[0], axis=1)) / 480 for pair in pairs]
    assert min(moves[:4]) >= LEAST_MOVE  # later ones reach the black photo first
    assert seen[10][1] == 11
    found = detect(replace(capture, frames=in_order_of_text), axes="opencv", progress=silent)
    assert verdicts(found)["image size"] == "holds"
    assert found.convention == Convention("opencv")


def test_matches_are_found_where_opencvs_best_estimator_gives_up(photographed, monkeypatch):
    """OpenCV's MAGSAC fails an assertion on some coplanar matches; plain RANSAC is used instead."""
    find = cv2.findFundamentalMat

    def asserting(x, y, method, *options):
        if method == cv2.USAC_MAGSAC:
            raise cv2.error("Assertion failed (!model.empty())")
        return find(x, y, method, *options)

    monkeypatch.setattr(cv2, "findFundamentalMat", asserting)
    pairs, cameras = match_neighbours(photographed.frames[:3], progress=silent)
    evidence = MatchEvidence(pairs, cameras, 3)
    assert np.median(evidence.errors_px(evidence.directions(Convention("opencv")), poses_of(photographed)[:3])) < 0.05


@pytest.mark.parametrize("meant", [Convention("opengl"), Convention("opencv", inverted=True)], ids=str)
def test_photos_identify_the_convention_and_how_to_read_it(meant, photographed, tmp_path):
    spoiled = misread(photographed, meant, "opengl")
    write_transforms(spoiled, tmp_path / "transforms.json")
    report = json.loads(nerfcli("convert", tmp_path, "--detect", "--json").stdout)
    axes, size, centre = report["questions"]
    assert (axes["verdict"], size["verdict"]) == ("holds", "holds")
    assert axes["ratio"] > 10
    # These photos are sharp and without noise, so their matches reveal even half a pixel.
    assert (centre["verdict"], centre["hypotheses"][0]["pixel_centre"]) == ("holds", 0.5)
    assert report["as_format_says"] == (meant == Convention("opengl"))
    if meant.inverted:
        assert report["options"] == "--from-axes opencv --from-inverted"
        result = completed("convert", tmp_path, "--detect")
        assert "SIFT matches" in result.stdout
        assert "fits" in result.stdout
        assert report["options"] in result.stdout
        completed("convert", tmp_path, tmp_path / "out", "--to", "colmap", *report["options"].split())
    assert not (tmp_path / "cache").exists()


def test_sharp_photos_reveal_a_half_pixel(photographed):
    spoiled = misread(photographed, Convention("opencv", pixel_centre=0.0), "opencv")
    found = detect(spoiled, axes="opencv", progress=silent)
    assert found.convention == Convention("opencv", pixel_centre=0.0)


def test_nothing_to_judge_by(tmp_path):
    capture = replace(capture_of([PINHOLE]), points=np.zeros((0, 3)), colours=None, observations=None)
    write_colmap_text(capture, tmp_path / "in")
    error, hint = refusal("convert", tmp_path / "in", "--detect")
    assert "the convention cannot be detected" in error
    assert "--images" in hint


def test_a_photo_of_another_shape_is_reported(photographed):
    other = replace(photographed.frames[0], camera=Camera.pinhole(500, 300, 420.0))
    with pytest.raises(UserError, match="480x360 pixels does not match a camera of 500x300"):
        match_neighbours((other, *photographed.frames[1:]), progress=silent)


def test_photos_in_formats_that_opencv_does_not_read_are_matched(photographed, tmp_path):
    frames = []
    for frame in photographed.frames[:3]:
        assert frame.image is not None
        path = tmp_path / f"{frame.image.stem}.tga"
        Image.open(frame.image).save(path)
        frames.append(replace(frame, image=path))
    pairs, _ = match_neighbours(tuple(frames), progress=silent)
    expected, _ = match_neighbours(photographed.frames[:3], progress=silent)
    assert [pair.photos for pair in pairs] == [pair.photos for pair in expected]


def test_a_principal_point_in_the_middle_was_not_given():
    assert for_picture(Camera.pinhole(640, 480, 500.0), 2.0) == Camera.pinhole(640, 480, 250.0)
