"""Features and matches: what pycolmap writes into its database, and what that says about each photo."""

import sqlite3
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pycolmap

from nerfcli.poses.job import CameraGroup, Job, Report

# A photo with this share of the features that were asked for is rich enough; measured poses are no better with more.
_RICH_SHARE = 0.5
# Matches are written, and so progress is seen, after each block.
_PAIRS_PER_BLOCK = 128


def extract(job: Job, report: Report) -> None:
    """SIFT features of every photo, one camera per group.

    Seeking them in the enlarged picture too (SIFT's octave -1, pycolmap's default) takes three times as long. Rich
    pictures gain nothing, for pycolmap keeps the coarsest features; so only the poor ones get it, in a second pass.
    """
    _extract_octaves(job, range(len(job.files)), first_octave=0, report=report)
    poor = [number for number, photo in enumerate(evidence(job)) if photo["features"] < _RICH_SHARE * job.max_features]
    if poor:
        _forget_features(job, poor)
        _extract_octaves(job, poor, first_octave=-1, report=report)


def match(job: Job, pairs: Sequence[tuple[int, int]], report: Report) -> None:
    """Descriptor matches of the pairs, verified by two-view geometry."""
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = job.threads
    options.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job.seed
    pair_list = Path(job.folder) / "pairs.txt"
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(pair_list)
    pairing.block_size = _PAIRS_PER_BLOCK
    with pycolmap.Database.open(str(job.database)) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        # A photo that pycolmap could not read after all is not in its database.
        named = [(job.files[i], job.files[j]) for i, j in pairs if job.files[i] in ids and job.files[j] in ids]
        pair_list.write_text("\n".join(f"{one} {other}" for one, other in named), encoding="utf-8")
        pending = {(ids[one], ids[other]) for one, other in named}

        def done() -> int:
            pending.difference_update([pair for pair in pending if database.exists_matches(*pair)])
            return len(pairs) - len(pending)

        with _watched("match", done, len(pairs), report):
            pycolmap.match_image_pairs(
                str(job.database),
                matching_options=options,
                pairing_options=pairing,
                verification_options=verification,
                device=pycolmap.Device.cpu,
            )


def evidence(job: Job) -> list[dict[str, Any]]:
    """Per photo: features found, and the photo that it shares most verified matches with."""
    with pycolmap.Database.open(str(job.database)) as database:
        numbers = {image.image_id: job.files.index(image.name) for image in database.read_all_images()}
        features = dict.fromkeys(range(len(job.files)), 0)
        for image_id, number in numbers.items():
            features[number] = database.num_keypoints_for_image(image_id)
        pair_ids, inliers = database.read_two_view_geometry_num_inliers()
    best: dict[int, tuple[int, str | None]] = dict.fromkeys(features, (0, None))
    for pair_id, count in zip(pair_ids, inliers, strict=True):
        i, j = (numbers[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair_id))
        for one, other in ((i, j), (j, i)):
            if count > best[one][0]:
                best[one] = (count, job.names[other])
    return [
        {"features": features[number], "best_matches": best[number][0], "best_partner": best[number][1]}
        for number in sorted(features)
    ]


def _extract_octaves(job: Job, numbers: Sequence[int], *, first_octave: int, report: Report) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = job.max_image_size
    options.num_threads = job.threads
    options.use_gpu = False
    options.sift.max_num_features = job.max_features
    options.sift.first_octave = first_octave
    wanted = set(numbers)
    with pycolmap.Database.open(str(job.database)) as database:
        pending = {job.files[number] for number in numbers}

        def done() -> int:
            for name in tuple(pending):
                image = database.read_image_with_name(name)
                if image is not None and database.exists_keypoints(image.image_id):
                    pending.discard(name)
            return len(job.files) - len(pending)

        with _watched("extract", done, len(job.files), report):
            for group in job.groups:
                members = [job.files[number] for number in group.photos if number in wanted]
                if not members:
                    continue
                pycolmap.extract_features(
                    str(job.database),
                    str(job.photos),
                    image_names=members,
                    camera_mode=pycolmap.CameraMode.SINGLE,
                    reader_options=_reader_options(group, job),
                    extraction_options=options,
                    device=pycolmap.Device.cpu,
                )


def _forget_features(job: Job, numbers: Sequence[int]) -> None:
    """Delete the features of some photos, so that pycolmap extracts them again. Its own API deletes only all of them.

    Only while pycolmap has the database closed: see `_watched` on two SQLite libraries in one process.
    """
    with closing(sqlite3.connect(job.database)) as database, database:
        for number in numbers:
            for table in ("keypoints", "descriptors"):
                database.execute(
                    f"DELETE FROM {table} WHERE image_id IN (SELECT image_id FROM images WHERE name = ?)",
                    (job.files[number],),
                )


def _reader_options(group: CameraGroup, job: Job) -> pycolmap.ImageReaderOptions:
    """Camera model of a group, and its focal length if EXIF tells it.

    It is read from the original: an upright copy has no EXIF. Lying or upright, the focal length in pixels is the same.
    """
    options = pycolmap.ImageReaderOptions()
    options.camera_model = group.model
    original = Path(job.originals) / job.names[group.photos[0]]
    try:
        inferred = pycolmap.infer_camera_from_image(str(original))
    except (RuntimeError, ValueError):  # a file format that only our own reader knows
        return options
    if inferred.has_prior_focal_length:
        focal_px = inferred.focal_length
        camera = pycolmap.Camera.create_from_model_name(1, group.model, focal_px, group.width, group.height)
        options.camera_params = camera.params_to_string()
    return options


@contextmanager
def _watched(stage: str, done: Callable[[], int], total: int, report: Report) -> Iterator[None]:
    """Report `done()` once a second while pycolmap works.

    pycolmap has no callbacks for these stages, so the database is asked. It must be asked from this process and
    through pycolmap: a second SQLite library in the same process, closing the file, would drop the locks of the first.
    """
    finished = threading.Event()

    def watch() -> None:
        while not finished.wait(1.0):
            report(stage, done(), total)

    report(stage, 0, total)
    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield
    finally:
        finished.set()
        watcher.join()
    report(stage, total, total)
