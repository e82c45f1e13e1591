"""Find features of photos, and match pairs with pycolmap, continuing from the existing content of its database."""

import math
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import repeat
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from nerfcli.errors import duration
from nerfcli.machine import use_threads
from nerfcli.matching.features import Features, find_features
from nerfcli.photos.images import read_image
from nerfcli.poses.engine.database import clear_matches, forget_features, keep_geometries, register_photos
from nerfcli.poses.input.job import Job, Report, WorkMask, read_stage, stage_key, write_stage
from nerfcli.poses.input.plan import ENLARGEMENT, limit_seconds, matching_seconds, searched_at_a_time
from nerfcli.poses.input.settings import USUAL_FEATURES

# Most RANSAC trials to verify a pair; pycolmap's 10,000 take twice as long and verify no further pair of 30 matches.
_MOST_TRIALS = 2000
# Matches are written, and the time limit is checked, after this many pairs.
_PAIRS_PER_CALL = 128
# Change these whenever this module would find other features in the same photo, or other matches of the same features.
_FEATURES_VERSION = (
    "OpenCV, the strongest, enlarged below three quarters, with a quarter of the contrast below an eighth"
)
_MATCHES_VERSION = "exact, ratio 0.8, cross-checked"
# Descriptors match if they are at most this far apart, and nearer than this times the second nearest: pycolmap's
# defaults, 0.7 radians between vectors of length 512.
_FURTHEST, _RATIO = 1024 * math.sin(0.7 / 2), 0.8
# Contrast that a feature needs, see `find_features`. Half of OpenCV's default, as pycolmap asks for.
_CONTRAST = 0.02
# A photo with fewer than this fraction of the requested features is searched again, enlarged.
_ENLARGED_BELOW = 3 / 4
# Photos of dark, blurred or uniform surfaces have hardly any feature with that contrast, but match with a quarter. That
# is enough where fewer than this fraction of the requested features are found.
_FAINT_BELOW = 1 / 8
_SIFT = pycolmap.FeatureExtractorType.SIFT


def feature_keys(job: Job) -> dict[str, str]:
    """Return, per photo (by image id, as text for JSON), a hash of everything that its features depend on."""
    settings = (_FEATURES_VERSION, job.max_image_size, job.max_features, cv2.__version__)
    contents = [(key, mask.key) for key, mask in zip(job.keys, job.masks or repeat(WorkMask()), strict=False)]
    return {str(i): stage_key(*content, *settings) for i, content in zip(job.image_ids, contents, strict=True)}


def extract(job: Job, report: Report) -> None:
    """Extract SIFT features of every photo that has none yet."""
    register_photos(job)
    keys, stage_path = feature_keys(job), job.stage_file("features")
    there = read_stage(stage_path, _FEATURES_VERSION) or {}
    forget_features(job, [int(image_id) for image_id, key in keys.items() if there.get(image_id) != key])
    # From here on, all features in the database are those of `keys`.
    write_stage(stage_path, _FEATURES_VERSION, keys)
    total = len(job.files)
    at_a_time, _ = searched_at_a_time(job.sizes.values(), max_image_size=job.max_image_size, threads=job.threads)
    own_threads = cv2.getNumThreads()
    cv2.setNumThreads(job.threads // at_a_time)
    try:
        with pycolmap.Database.open(job.database) as database, ThreadPoolExecutor(at_a_time) as pool:
            missing = [n for n, image_id in enumerate(job.image_ids) if not database.exists_descriptors(image_id)]
            report("extract", total - len(missing), total)
            found = pool.map(partial(_search, job), missing)
            for done, (number, features) in enumerate(zip(missing, found, strict=True), start=total - len(missing) + 1):
                _write(database, job.image_ids[number], features)
                report("extract", done, total)
    finally:
        cv2.setNumThreads(own_threads)


def _search(job: Job, number: int) -> Features:
    """Find the features of one photo."""
    # Colours are not kept during the search: 150 MB of a photo of 50 megapixels.
    grey = cv2.cvtColor(np.ascontiguousarray(read_image(job.photos / job.files[number])[..., :3]), cv2.COLOR_RGB2GRAY)
    used = _used_pixels(job, number)
    search = partial(find_features, grey, longer_side_px=job.max_image_size, most=job.max_features, used=used)
    features = search(contrast=_CONTRAST)
    enlargement = min(ENLARGEMENT, job.max_image_size / max(grey.shape))
    usual = min(job.max_features, USUAL_FEATURES)
    if len(features.pixels) < _ENLARGED_BELOW * usual and enlargement > 1:
        search = partial(search, enlargement=enlargement)
        features = search(contrast=_CONTRAST)
    faint = len(features.pixels) < _FAINT_BELOW * usual
    return search(contrast=_CONTRAST / 4) if faint else features


def _used_pixels(job: Job, number: int) -> np.ndarray | None:
    if not job.masks or not job.masks[number].key:
        return None
    return read_image(job.mask_folder / f"{job.files[number]}.png")[..., 0] > 0


def _write(database: pycolmap.Database, image_id: int, features: Features) -> None:
    """Write features with descriptors normalised as pycolmap's matcher expects them: RootSIFT, Arandjelovic 2012."""
    sums = features.descriptors.sum(axis=1, keepdims=True)
    root = np.sqrt(features.descriptors / np.maximum(sums, 1))
    descriptors = pycolmap.FeatureDescriptors(_SIFT, np.round(512 * root).clip(0, 255).astype(np.uint8))
    rows = np.column_stack([features.pixels, features.sizes / 2, features.angles]).astype(np.float32)
    with pycolmap.DatabaseTransaction(database):
        database.write_keypoints(image_id, rows)
        database.write_descriptors(image_id, descriptors)


def start_matching(job: Job, pairs: Sequence[tuple[int, int]]) -> None:
    """Remove the matches of other settings, and the verified matches of other pairs, which the mapper would use."""
    matched, verified = job.stage_file("matches"), job.stage_file("geometries")
    matches_key = stage_key(_MATCHES_VERSION, pycolmap.__version__)
    verified_key = stage_key(matches_key, job.seed, _MOST_TRIALS)
    if read_stage(matched, matches_key) is None:
        clear_matches(job, "matches", "two_view_geometries")
        write_stage(matched, matches_key, {})
    if read_stage(verified, verified_key) is None:
        clear_matches(job, "two_view_geometries")
        write_stage(verified, verified_key, {})
    keep_geometries(job, pairs)


def match(job: Job, pairs: Sequence[tuple[int, int]], report: Report) -> str | None:
    """Match the descriptors of the pairs that have no matches yet, and verify them by two-view geometry.

    Each pair's random numbers start from the seed, so its result does not depend on earlier work. Returns a note if
    matching was cut short after ten times the planned time, so that the last pairs have no matches.
    """
    planned = matching_seconds(len(pairs), max_features=job.max_features) / job.threads
    most, start = limit_seconds(planned), time.perf_counter()
    options = pycolmap.FeatureMatchingOptions(num_threads=job.threads, use_gpu=False)
    ransac = {"random_seed": job.seed, "max_num_trials": _MOST_TRIALS}
    verification = pycolmap.TwoViewGeometryOptions(ransac=ransac)
    pair_list = Path(job.folder) / "pairs.txt"
    with (
        pycolmap.Database.open(job.database) as database,
        ThreadPoolExecutor(job.threads, initializer=use_threads, initargs=(1,)) as pool,
    ):
        ids = job.image_ids
        left = [(i, j) for i, j in pairs if not database.exists_two_view_geometry(ids[i], ids[j])]
        for first in range(0, len(left), _PAIRS_PER_CALL):
            report("match", len(pairs) - len(left) + first, len(pairs))
            if time.perf_counter() - start > most:
                return f"matching: {len(left) - first} of {len(pairs)} pairs are not matched after {duration(most)}"
            part = left[first : first + _PAIRS_PER_CALL]
            _write_matches(database, [(ids[i], ids[j]) for i, j in part], pool)
            pair_list.write_text("\n".join(f"{job.files[i]} {job.files[j]}" for i, j in part), encoding="utf-8")
            pycolmap.match_image_pairs(
                job.database,
                matching_options=options,
                pairing_options=pycolmap.ImportedPairingOptions(match_list_path=pair_list),
                verification_options=verification,
                device=pycolmap.Device.cpu,
            )
    report("match", len(pairs), len(pairs))
    return None


def _write_matches(database: pycolmap.Database, pairs: Iterable[tuple[int, int]], pool: ThreadPoolExecutor) -> None:
    """Match the descriptors of pairs (image ids) that have no matches; where Numba fails, pycolmap does it later."""
    try:
        from nerfcli.kernels.nearest import mutual_nearest, prepare
    except (ImportError, RuntimeError):  # no Numba, or no folder to cache its machine code in
        return
    left = [pair for pair in pairs if not database.exists_matches(*pair)]
    ids = {image_id for pair in left for image_id in pair}
    photos = {image_id: prepare(database.read_descriptors(image_id).data) for image_id in ids}
    search = partial(mutual_nearest, ratio=_RATIO, furthest=_FURTHEST)
    found = pool.map(lambda pair: search(photos[pair[0]], photos[pair[1]]), left)
    with pycolmap.DatabaseTransaction(database):
        for pair, matches in zip(left, found, strict=True):
            database.write_matches(*pair, matches.astype(np.uint32))
