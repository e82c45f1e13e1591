"""Extract features and match pairs with pycolmap, continuing from the existing content of its database."""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path

import pycolmap

from nerfcli.errors import duration
from nerfcli.poses.engine.database import (
    clear_matches,
    feature_counts,
    forget_features,
    keep_geometries,
    register_photos,
)
from nerfcli.poses.input.job import Job, Report, WorkMask, read_stage, repeatedly, stage_key, write_stage
from nerfcli.poses.input.plan import limit_seconds, matching_seconds

# Most RANSAC trials to verify a pair; pycolmap's 10,000 take twice as long and verify no further pair of 30 matches.
_MOST_TRIALS = 2000
# The time limit is checked after this many pairs.
_PAIRS_PER_CALL = 1024
# Change these whenever this module would find other features in the same photo, or other matches of the same features.
_FEATURES_VERSION = "octaves 0, then -1 below half, then 0 and -1 with a quarter of the contrast below an eighth"
_MATCHES_VERSION = "ratio 0.8, cross-checked"


# Contrast that a feature needs, of 1 between black and white.
_CONTRAST = pycolmap.SiftExtractionOptions().peak_threshold


@dataclass(frozen=True)
class _Search:
    """One search of photos for features.

    stage: its name in reports of progress. below: a photo is searched if its number of features so far is below this
    fraction of the requested ones. first_octave: of SIFT, 0 for the picture as it is, -1 for the enlarged one.
    contrast: that a feature needs.
    """

    stage: str
    below: float
    first_octave: int
    contrast: float


# Searching the enlarged picture, pycolmap's default, takes three times as long. Photos with many features gain nothing
# from it, since pycolmap keeps the coarsest, and measured poses are no better with more than half of those requested.
# Photos of dark, blurred or uniform surfaces have hardly any feature with the usual contrast, but match with a quarter.
_SEARCHES = (
    _Search("extract", below=math.inf, first_octave=0, contrast=_CONTRAST),
    _Search("enlarge", below=1 / 2, first_octave=-1, contrast=_CONTRAST),
    _Search("faint", below=1 / 8, first_octave=0, contrast=_CONTRAST / 4),
    _Search("faint-enlarged", below=1 / 8, first_octave=-1, contrast=_CONTRAST / 4),
)


def feature_keys(job: Job) -> dict[str, str]:
    """Return, per photo (by image id, as text for JSON), a hash of everything that its features depend on."""
    settings = (_FEATURES_VERSION, job.max_image_size, job.max_features, pycolmap.__version__)
    contents = [(key, mask.key) for key, mask in zip(job.keys, job.masks or repeat(WorkMask()), strict=False)]
    return {str(i): stage_key(*content, *settings) for i, content in zip(job.image_ids, contents, strict=True)}


def extract(job: Job, report: Report) -> None:
    """Extract SIFT features of every photo that has none yet, with one camera per group.

    All photos are searched once, those with few features again as `_SEARCHES` says.
    """
    register_photos(job)
    keys, stage_path = feature_keys(job), job.stage_file("features")
    there = read_stage(stage_path, _FEATURES_VERSION) or {}
    forget_features(job, [int(image_id) for image_id, key in keys.items() if there.get(image_id) != key])
    # From here on, all features in the database are those of `keys`.
    write_stage(stage_path, _FEATURES_VERSION, keys)
    last_file = job.stage_file("searches")
    kept = read_stage(last_file, _FEATURES_VERSION) or {}
    # The index of the last search of each photo, by number.
    last = [kept[i][1] if kept.get(i, [""])[0] == keys[i] else 0 for i in map(str, job.image_ids)]
    for index, search in enumerate(_SEARCHES):
        if index > 0:
            counts = feature_counts(job)
            poor = [n for n in range(len(last)) if last[n] == index - 1 and counts[n] < search.below * job.max_features]
            # Features are removed before photos are listed for a search: a listed photo with features has had it.
            forget_features(job, [job.image_ids[number] for number in poor])
            for number in poor:
                last[number] = index
            searched = zip(map(str, job.image_ids), last, strict=True)
            write_stage(last_file, _FEATURES_VERSION, {i: [keys[i], number] for i, number in searched})
        due = [number for number, found in enumerate(last) if found == index]
        if due or index == 0:
            _extract(job, due, search, watched=due if index > 0 else range(len(last)), report=report)


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
    # Matches are written after each block, so that progress is visible and kept.
    pairing = pycolmap.ImportedPairingOptions(match_list_path=pair_list, block_size=_PAIRS_PER_CALL // 8)
    ids = job.image_ids
    with pycolmap.Database.open(job.database) as database:
        pending = {(ids[i], ids[j]) for i, j in pairs}

        def done() -> int:
            pending.difference_update([pair for pair in pending if database.exists_two_view_geometry(*pair)])
            return len(pairs) - len(pending)

        with _watched("match", done, len(pairs), report):
            for first in range(0, len(pairs), _PAIRS_PER_CALL):
                if time.perf_counter() - start > most:
                    break
                part = pairs[first : first + _PAIRS_PER_CALL]
                pair_list.write_text("\n".join(f"{job.files[i]} {job.files[j]}" for i, j in part), encoding="utf-8")
                pycolmap.match_image_pairs(
                    job.database,
                    matching_options=options,
                    pairing_options=pairing,
                    verification_options=verification,
                    device=pycolmap.Device.cpu,
                )
            else:
                return None
        left = len(pairs) - done()  # counted here, since the watching thread has ended
        return f"matching: {left} of {len(pairs)} pairs are not matched after {duration(most)}"


def _extract(job: Job, numbers: Iterable[int], search: _Search, *, watched: Sequence[int], report: Report) -> None:
    """Extract features of photos that have none, and report how many of the photos `watched` have some."""
    sift = {"first_octave": search.first_octave, "peak_threshold": search.contrast}
    options = pycolmap.FeatureExtractionOptions(
        max_image_size=job.max_image_size, num_threads=job.threads, use_gpu=False, sift=sift
    )
    reader = pycolmap.ImageReaderOptions(mask_path=job.mask_folder if job.masks else "")
    with pycolmap.Database.open(job.database) as database:
        pending = {job.image_ids[number] for number in watched}

        def done() -> int:
            pending.difference_update([image_id for image_id in pending if database.exists_descriptors(image_id)])
            return len(watched) - len(pending)

        with _watched(search.stage, done, len(watched), report):
            for limit, members in _by_limit(job, numbers).items():
                options.sift.max_num_features = limit
                pycolmap.extract_features(
                    job.database,
                    job.photos,
                    image_names=members,
                    reader_options=reader,
                    extraction_options=options,
                    device=pycolmap.Device.cpu,
                )


def _by_limit(job: Job, numbers: Iterable[int]) -> dict[int, list[str]]:
    """Group files by the feature limit of the whole picture that leaves enough features inside the mask.

    pycolmap chooses features before it applies the mask. The limit doubles each time the used fraction of the picture
    halves.
    """
    limits: dict[int, list[str]] = {}
    for number in numbers:
        fraction = job.masks[number].used_fraction if job.masks else 1.0
        # A larger factor would only add fine features at noise level.
        factor = min(8, 2 ** int(math.log2(1 / fraction))) if fraction > 0 else 1
        limits.setdefault(job.max_features * factor, []).append(job.files[number])
    return limits


@contextmanager
def _watched(stage: str, done: Callable[[], int], total: int, report: Report) -> Iterator[None]:
    """Report `done()` once a second while pycolmap works, at the beginning and at the end.

    pycolmap has no callbacks for these stages, so the database is polled, through pycolmap: see `database`.
    """
    report(stage, done(), total)
    with repeatedly(lambda: report(stage, done(), total)):
        yield
    report(stage, total, total)
