"""Find the photos of a folder or a scene, and run the complete examination."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.captures.calibration import Calibration, calibrated
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.registry import recognised, refuse_archive
from nerfcli.captures.loading import load_scene
from nerfcli.captures.orientation import Picture
from nerfcli.doctor import camera_layout, geometry, inventory, quality
from nerfcli.doctor.compared_pairs import Pair, choose_pairs, compare, pair_count
from nerfcli.doctor.photo_facts import MOST_FEATURES, PhotoFacts, Source, read_all
from nerfcli.doctor.pose_agreement import misplaced_groups, nearest_pairs, pair_errors, poses_by_matches
from nerfcli.errors import UserError, in_shell
from nerfcli.pages.findings import Finding, as_json, worst
from nerfcli.photos.focal_evidence import focal_evidence, usual_focal_px
from nerfcli.photos.images import list_photos, name_in, where_photos_may_be
from nerfcli.poses.input.photos import refuse_odd_names
from nerfcli.poses.judge.checks import Checks


@dataclass(frozen=True)
class ExaminedCapture:
    """A capture to examine: its path as the user gave it, and the scene with the poses, None for a folder of photos.

    skipped: how many files of the folder are no photos, by suffix, as text for people.
    """

    path: Path
    sources: tuple[Source, ...]
    scene: Capture | None
    skipped: str = ""

    @property
    def kind(self) -> str:
        """Kind of capture, "photos" or "scene"."""
        return "photos" if self.scene is None else "scene"


@dataclass(frozen=True)
class Diagnosis:
    """Result of an examination: the findings, in order, and (name, reason) of the checks that were not made.

    Args:
        missing_detail: (photos,) log2 of the detail that each photo lacks relative to the others; NaN without texture.
        exposure_stops: (photos,) stops by which each shows the same points brighter than the median photo; NaN where
            unknown.
    """

    subject: ExaminedCapture
    findings: tuple[Finding, ...]
    not_checked: tuple[tuple[str, str], ...]
    photos: tuple[PhotoFacts, ...]
    missing_detail: np.ndarray
    exposure_stops: np.ndarray
    pairs: tuple[Pair, ...]

    @property
    def verdict(self) -> str:
        """The worst verdict of the findings."""
        return worst(finding.verdict for finding in self.findings)


def find_subject(path: Path, *, subfolders: bool = False) -> ExaminedCapture:
    """Find the photos in a folder, with those in its subfolders on request, or the photos of a scene.

    A folder with photos and the files of a scene counts as a scene.

    Raises:
        UserError: the path does not exist, is a video, has no photos or odd names of photos, or is a scene with
            malformed files, or one with `subfolders`.
    """
    if not path.exists():
        raise UserError(f"{path} does not exist", "give a folder of photos, or a scene folder")
    refuse_archive(path)
    if recognised(path) is not None:
        if subfolders:
            raise UserError(f"{path}: --subfolders is for photos, and this is a scene", "leave --subfolders out")
        scene = load_scene(path)
        sources = tuple(Source(f.name, f.image, f.mask) for f in scene.frames if f.image is not None)
        return ExaminedCapture(path, sources, scene)
    if path.is_file():
        raise UserError(
            f"{path} is a file, neither a folder of photos nor a scene",
            f"if it is a video, nerfcli poses {in_shell(path)} writes its frames to a folder that can be given here",
        )
    listed = list_photos(path, subfolders=subfolders)
    photos = [*listed.pictures, *listed.unreadable]
    if not photos:
        raise UserError(f"no photos and no scene in {path}", where_photos_may_be(path))
    refuse_odd_names(path, photos)
    sources = tuple(Source(name_in(path, photo), photo) for photo in photos)
    return ExaminedCapture(path, sources, None, listed.skipped)


def estimated_seconds(count: int, threads: int) -> float:
    """Estimate how many seconds the examination of `count` photos takes."""
    return sum(_cpu_seconds(count)) / threads


def _cpu_seconds(count: int) -> tuple[float, float]:
    """Estimate the time to read the photos and to compare them."""
    return 0.45 * count, 0.03 * pair_count(count)


def examine(
    subject: ExaminedCapture,
    *,
    threads: int,
    progress: Callable[[float, str], None],
    calibration: Calibration | None = None,
) -> Diagnosis:
    """Examine a capture: read every photo once, compare pairs, and run all checks, with the given intrinsics if any.

    Deterministic: the same photos give the same findings.

    Raises:
        UserError: the intrinsics do not fit a photo.
    """
    count = len(subject.sources)
    reading, comparing = _cpu_seconds(count)
    fraction = reading / (reading + comparing)

    def on_photo(done: int) -> None:
        progress(fraction * done / count, f"photo {done} of {count}")

    facts, unreadable = read_all(subject.sources, threads=threads, progress=on_photo)
    if not facts:
        findings = [inventory.readable(unreadable, (), subject.skipped), inventory.enough(0)]
        nothing = np.zeros(0)
        return Diagnosis(subject, tuple(findings), (("all else", "no readable photo"),), (), nothing, nothing, ())
    places = choose_pairs(facts)
    if subject.scene is not None:
        places = sorted({*places, *nearest_pairs(_frames(subject.scene, facts))})

    def on_pair(done: int) -> None:
        progress(fraction + (1 - fraction) * done / max(len(places), 1), f"pair {done} of {len(places)}")

    focals = _focals_px(subject, facts, calibration)
    pairs = compare_all(facts, places, focals, threads=threads, progress=on_pair)
    pairs = _second_look(facts, pairs, focals)
    return judged(subject, facts, pairs, unreadable=unreadable)


def compare_all(
    photos: Sequence[PhotoFacts],
    places: Sequence[tuple[int, int]],
    focals_px: Sequence[float],
    *,
    threads: int,
    progress: Callable[[int], None],
) -> list[Pair]:
    """Compare the photos of each pair (i, j), in order; `progress` receives the number of pairs done."""

    def work(place: tuple[int, int]) -> Pair:
        i, j = place
        return compare((photos[i], photos[j]), place, (focals_px[i], focals_px[j]))

    pairs = []
    with ThreadPoolExecutor(threads) as workers:
        for pair in workers.map(work, places):
            pairs.append(pair)
            progress(len(pairs))
    return pairs


def _second_look(photos: Sequence[PhotoFacts], pairs: list[Pair], focals_px: Sequence[float]) -> list[Pair]:
    """Return the pairs after comparing a few disconnected photos with the rest again, using all features."""
    apart = geometry.apart(len(photos), pairs)
    if not 0 < len(apart) <= max(3, len(photos) // 10):
        return pairs
    again = []
    for pair in pairs:
        i, j = pair.first, pair.second
        if (i in apart) != (j in apart):
            both = (photos[i], photos[j])
            pair = compare(both, (i, j), (focals_px[i], focals_px[j]), most_features=MOST_FEATURES)
        again.append(pair)
    return again


def judged(
    subject: ExaminedCapture, photos: list[PhotoFacts], pairs: list[Pair], *, unreadable: dict[str, str]
) -> Diagnosis:
    """Run all checks on the photos and pairs; `unreadable` maps names of unreadable photos to the reasons.

    A check that raises is listed as not made; the other checks still run.
    """
    checks, scene = Checks(), subject.scene
    unknown = np.full(len(photos), np.nan)
    missing = checks.run("lacking detail", lambda: quality.lacking_detail(photos, pairs), otherwise=unknown)
    brighter, redder = checks.run("stops", lambda: quality.stops(photos, pairs), otherwise=(unknown, unknown))
    planned: list[tuple[str, Callable[[], Finding | None]]] = [
        ("readable photos", lambda: inventory.readable(unreadable, photos, subject.skipped)),
        ("number of photos", lambda: inventory.enough(len(photos))),
        ("size", lambda: inventory.size(photos)),
        ("cameras", lambda: inventory.cameras(photos)),
        ("focal length", lambda: camera_layout.focal_lengths(scene) if scene else inventory.focal_length(photos)),
        ("orientation", lambda: inventory.orientation(photos)),
        ("duplicates", lambda: inventory.duplicates(photos, pairs)),
        ("sharpness", lambda: quality.sharpness(photos, missing)),
        ("texture", lambda: quality.texture(photos)),
        ("exposure", lambda: quality.exposure(photos, brighter)),
        ("white balance", lambda: quality.white_balance(photos, redder)),
        ("clipping", lambda: quality.clipping(photos)),
    ]
    not_checked: list[tuple[str, str]] = []
    turning = None

    def found_or_noted(name: str, finding: Finding | None) -> Finding | None:
        if finding is None:
            not_checked.append((name, "too few pairs have enough matches"))
        return finding

    if len(photos) > 1:
        turning = checks.run("turning object", lambda: geometry.turning_object(pairs), otherwise=None)
        planned.append(("connectivity", lambda: geometry.connectivity(photos, pairs)))
        if all(photo.is_panorama for photo in photos):
            reason = "not supported for panoramas; nerfcli poses checks that the camera moved"
            not_checked.append(("moving content, movement, depth relief", reason))
        elif turning is None:
            planned += [
                ("moving content", lambda: geometry.moving_content(photos, pairs)),
                ("movement", lambda: found_or_noted("movement", geometry.movement(photos, pairs))),
                ("depth relief", lambda: found_or_noted("depth relief", geometry.flatness(pairs))),
            ]
        else:
            planned.append(("turning object", lambda: turning))
            reason = "the camera stood still while an object turned in front of it"
            not_checked.append(("moving content, movement, depth relief", reason))
    else:
        not_checked.append(("connectivity, movement, moving content", "a single photo is not enough"))
    planned.append(("GPS", lambda: camera_layout.gps(photos)))
    found = [checks.run(name, compute, otherwise=None) for name, compute in planned]
    if scene is None:
        not_checked.append(("directions", "needs poses: run nerfcli poses, then nerfcli doctor on the scene"))
    else:
        frames = _frames(scene, photos)
        # The background does not turn with the object, so its matches say nothing about the poses.
        compared = pairs if turning is None else []
        errors = checks.run("epipolar errors", lambda: pair_errors(frames, photos, compared), otherwise=[])
        planned = [
            ("spread of cameras", lambda: camera_layout.spread(scene)),
            ("directions", lambda: camera_layout.directions(scene)),
            ("points", lambda: camera_layout.points(scene)),
            ("intrinsics", lambda: camera_layout.intrinsics(scene)),
            ("poses", lambda: found_or_noted("poses", poses_by_matches(photos, errors))),
            ("places", lambda: misplaced_groups(frames, photos, errors, pairs)),
        ]
        found += [checks.run(name, compute, otherwise=None) for name, compute in planned]
        found += checks.run("files of the scene", lambda: camera_layout.check_scene_files(scene), otherwise=[])
    not_checked += [(name, f"could not be computed: {why}") for name, why in checks.not_computed.items()]
    findings = tuple(finding for finding in found if finding is not None)
    return Diagnosis(subject, findings, tuple(not_checked), tuple(photos), missing, brighter, tuple(pairs))


def _frames(scene: Capture, photos: Sequence[PhotoFacts]) -> list[Frame]:
    """Return the frames of the readable photos, in their order."""
    by_name = {frame.name: frame for frame in scene.frames}
    return [by_name[photo.name] for photo in photos]


def _focals_px(subject: ExaminedCapture, photos: Sequence[PhotoFacts], calibration: Calibration | None) -> list[float]:
    """Return focal lengths at the feature-detection size: of given cameras or the scene's, from EXIF, or typical."""
    if calibration is not None:
        paths = {source.name: source.path for source in subject.sources}
        pictures = [Picture(paths[p.name], p.exif.width, p.exif.height, p.exif.orientation) for p in photos]
        cameras = [found.camera for found in calibrated(calibration, pictures)]
    elif subject.scene is not None:
        cameras = [frame.camera for frame in _frames(subject.scene, photos)]
    else:
        known = [(photo.features.size, photo.exif, focal_evidence(photo.exif).focal_px) for photo in photos]
        return [
            usual_focal_px(*size) if px is None else max(size) * (px / max(exif.width, exif.height))
            for size, exif, px in known
        ]
    return [
        camera.focal_px * max(photo.features.size) / max(camera.width, camera.height)
        for photo, camera in zip(photos, cameras, strict=True)
    ]


def content(diagnosis: Diagnosis) -> dict[str, object]:
    """Return the diagnosis as plain values, for JSON."""
    measured = zip(diagnosis.photos, diagnosis.missing_detail.tolist(), diagnosis.exposure_stops.tolist(), strict=True)
    photos = [
        {
            "name": photo.name,
            "width": photo.exif.width,
            "height": photo.exif.height,
            "features": len(photo.features.pixels),
            "lacking_detail": _rounded(lacking, 3),
            "stops": _rounded(stops, 3),
            "mean": _rounded(photo.exposure.mean, 4),
            "white": round(photo.exposure.white, 4),
            "black": round(photo.exposure.black, 4),
        }
        for photo, lacking, stops in measured
    ]
    return {
        "kind": diagnosis.subject.kind,
        "verdict": diagnosis.verdict,
        "findings": [as_json(finding) for finding in diagnosis.findings],
        "not_checked": [{"check": check, "reason": reason} for check, reason in diagnosis.not_checked],
        "photos": photos,
        "pairs": [
            [diagnosis.photos[pair.first].name, diagnosis.photos[pair.second].name, pair.inliers]
            for pair in diagnosis.pairs
            if pair.linked
        ],
    }


def _rounded(value: float, digits: int) -> float | None:
    return None if np.isnan(value) else round(value, digits)
