"""Choose which pairs of photos to match, since the time to match all is quadratic; or read them from a file."""

import re
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

from nerfcli.errors import UserError
from nerfcli.photos.geodesy import east_north_up
from nerfcli.poses.input.photos import Photo, Photos

# Choices. "auto" selects one of the others, by the number of photos and their metadata.
PAIRINGS = ("auto", "exhaustive", "sequential", "retrieval", "spatial")

# Up to this many photos, every pair that looks alike is matched, whatever the photos' names.
ALL_ALIKE_UP_TO = 60
# In an ordered capture, each photo is compared with this many that follow it; with GPS, with this many nearest ones...
FOLLOWERS = 10
_NEAREST = 20
# ...and in both with this many look-alikes that are not near it, which closes loops.
_LOOP_NEIGHBOURS = 8
# In an unordered capture, with this many look-alikes.
_NEIGHBOURS = 25
# A phone's GPS cannot tell apart neighbours that are all nearer than this.
_GPS_ERROR_METRES = 10.0
# GPS is used if this fraction of the photos has positions: the first ones of a phone may have none yet. The others are
# compared with look-alikes alone.
_LEAST_LOCATED = 0.9
# Largest median time from one photo to the next for which the order in time is an order in space.
_WALKING_PACE_SECONDS = 30.0


@dataclass(frozen=True)
class Pairing:
    """Pairs of photos to match.

    rule: one of `PAIRINGS` except "auto", or "file". pairs: (i, j), i < j, of photo numbers. neighbours: how many
    look-alikes of each photo to add, once features are known, when pairs of photos that are not alike are left out too;
    0 to match `pairs` as they are.
    """

    rule: str
    pairs: tuple[tuple[int, int], ...]
    neighbours: int


def choose_pairs(photos: Sequence[Photo], *, rule: str = "auto") -> Pairing:
    """Choose the pairs of photos to match by one of the rules below.

    "auto" compares up to 60 photos by similarity, and more as they allow: by position, if their GPS can tell neighbours
    apart; in the order in which they were taken, if there is one; else by similarity.

    Raises:
        ValueError: no such rule.
        UserError: "spatial" is requested, and too many photos have no GPS position.
    """
    if rule == "auto":
        rule = _best_rule(photos)
    if rule == "exhaustive":
        return Pairing("exhaustive", all_pairs(len(photos)), 0)
    if rule == "sequential":
        return Pairing("sequential", sequential_pairs(order_of_capture(photos) or range(len(photos))), _LOOP_NEIGHBOURS)
    if rule == "retrieval":
        return Pairing("retrieval", all_pairs(len(photos)) if len(photos) <= ALL_ALIKE_UP_TO else (), _NEIGHBOURS)
    if rule == "spatial":
        located = _located(photos)
        if not located:
            without = [photo.name for photo in photos if photo.exif.gps is None]
            raise UserError(
                f"--pairing spatial: {len(without)} of {len(photos)} photos have no GPS position ({without[0]})",
                "choose --pairing retrieval or auto",
            )
        near = pairs_of_nearest(_distances(photos, located), _NEAREST)
        return Pairing("spatial", in_blocks((located[i], located[j]) for i, j in near), _LOOP_NEIGHBOURS)
    raise ValueError(f"pairing must be one of {', '.join(PAIRINGS)}, got {rule}")


def _best_rule(photos: Sequence[Photo]) -> str:
    if len(photos) <= ALL_ALIKE_UP_TO:
        return "retrieval"
    if located := _located(photos):
        radii = np.sort(_distances(photos, located), axis=1)[:, _NEAREST - 1]
        if np.median(radii) > _GPS_ERROR_METRES:
            return "spatial"
    return "retrieval" if order_of_capture(photos) is None else "sequential"


def sequential_pairs(order: Sequence[int]) -> tuple[tuple[int, int], ...]:
    """Pair each photo with the next 10 in the order, and with those 16, 32, 64... places after it."""
    count = len(order)
    steps = [*range(1, FOLLOWERS + 1), *(2**k for k in range(4, count.bit_length()))]
    near = {(i, i + step) for step in steps for i in range(count - step)}
    return in_blocks({_rising(order[i], order[j]) for i, j in near})


def pairs_of_nearest(distances: np.ndarray, count: int) -> set[tuple[int, int]]:
    """Pair each photo with the `count` nearest ones, by distances (N, N), infinite for pairs that are not wanted."""
    nearest = np.argsort(distances, axis=1, kind="stable")[:, :count].tolist()
    return {_rising(i, j) for i, row in enumerate(nearest) for j in row if np.isfinite(distances[i, j])}


def all_pairs(count: int) -> tuple[tuple[int, int], ...]:
    """Return every (i, j) with i < j < count, block by block."""
    return in_blocks(combinations(range(count), 2))


def retrieval_feature_count(photos: int) -> int:
    """Return how many features of each photo are compared to find look-alikes.

    The time grows with their square; with a quarter of them, a few per cent fewer of the matching pairs are found.
    """
    return 256 if photos <= 500 else 128 if photos <= 2000 else 64


def in_blocks(pairs: Iterable[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Sort the pairs so that few photos are in use at a time, since the matcher caches the features it used last.

    Pairs of photos with near numbers come first, so that these are matched if there is not enough time for all.
    """
    block = 16
    return tuple(sorted(pairs, key=lambda pair: (abs(pair[1] // block - pair[0] // block), pair[0] // block, pair)))


def order_of_capture(photos: Sequence[Photo]) -> list[int] | None:
    """Return indices in capture order, by the numbers in the names or the clock of a single camera; else None."""
    by_name = capture_order([photo.name for photo in photos])
    if by_name is not None:
        return by_name
    times = [photo.exif.taken for photo in photos if photo.exif.taken is not None]
    if len(times) < len(photos) or len({(photo.exif.make, photo.exif.model) for photo in photos}) > 1:
        return None
    order = sorted(range(len(times)), key=times.__getitem__)
    gaps = sorted(times[j] - times[i] for i, j in pairwise(order))
    # Photos taken over a week are in order too, but not because the camera moved from one to the next.
    return order if gaps[len(gaps) // 2] <= _WALKING_PACE_SECONDS else None


def capture_order(names: Sequence[str]) -> list[int] | None:
    """Return the indices of names such as frame_9.png, frame_10.png by number; None if anything else differs."""
    parts = [re.fullmatch(r"(.*?)(\d+)(\D*(?:\.[^.]*)?)", name) for name in names]  # .jp2 is no number
    matches = [match for match in parts if match]
    if len(matches) < len(names) or len({(match[1], match[3].lower()) for match in matches}) > 1:
        return None
    numbers = [int(match[2]) for match in matches]
    if len(set(numbers)) < len(numbers):
        return None
    return sorted(range(len(numbers)), key=numbers.__getitem__)


def read_pairs(path: Path, photos: Photos) -> Pairing:
    """Read the pairs that a text file lists. Empty lines and lines that begin with # are skipped.

    Names may contain spaces: a line is split where both parts are names of photos. Quotes around a name, or a tab
    between the two, help if more than one split is possible. Pairs with a photo that cannot be read are left out.

    Raises:
        UserError: there is no such file, no pair in it, or a line, given by its number, that is not a pair of photos.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not text in UTF-8"
        raise UserError(
            f"cannot read the pairs in {path}: {why}", "give a text file with two names per line"
        ) from error
    numbers = {name: number for number, name in enumerate(photos.names)}
    photo_names = {*numbers, *photos.unreadable}
    pairs: set[tuple[int, int]] = set()
    for line_number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        one, other = _names(line.strip(), photo_names, f"{path}, line {line_number}", photos.folder)
        if one in numbers and other in numbers:
            pairs.add(_rising(numbers[one], numbers[other]))
    if not pairs:
        raise UserError(f"{path} lists no pairs of photos", "write two names per line")
    return Pairing("file", in_blocks(pairs), 0)


def _names(line: str, photo_names: Container[str], place: str, folder: Path) -> tuple[str, str]:
    """Return the two names of a line."""
    found = [(one, other) for one, other in _cuts(line) if one in photo_names and other in photo_names]
    if len(set(found)) > 1:
        raise UserError(f"{place}: {line!r} can be split into two names in more than one way", "put a tab between them")
    if not found:
        unknown = _unknown(line, photo_names)
        raise UserError(f"{place}: {unknown}", f"write two names of photos in {folder}, separated by a space")
    if found[0][0] == found[0][1]:
        raise UserError(f"{place}: {found[0][0]} is paired with itself", "write two different names")
    return found[0]


def _cuts(line: str) -> Iterator[tuple[str, str]]:
    """Yield all ways to split a line in two, at each tab if it has any, else at each space."""
    separator = "\t" if "\t" in line else " "
    for at, character in enumerate(line):
        if character == separator:
            yield _bare(line[:at]), _bare(line[at + 1 :])


def _bare(text: str) -> str:
    """Strip the surrounding space and one pair of quotes."""
    text = text.strip()
    quoted = len(text) >= 2 and text[0] == text[-1] and text[0] in "\"'"
    return text[1:-1] if quoted else text


def _unknown(line: str, photo_names: Container[str]) -> str:
    """Describe the error in a line that does not contain two names of photos."""
    cuts = list(_cuts(line))
    for one, other in cuts:
        if one in photo_names:
            return f"there is no photo {other!r}"
        if other in photo_names:
            return f"there is no photo {one!r}"
    return f"there is no photo {cuts[0][0]!r}" if len(cuts) == 1 else f"{line!r} does not contain two names of photos"


def _located(photos: Sequence[Photo]) -> list[int]:
    """Return the numbers of the photos that have a GPS position; none if too many have none."""
    located = [number for number, photo in enumerate(photos) if photo.exif.gps is not None]
    return located if len(located) >= _LEAST_LOCATED * len(photos) else []


def _distances(photos: Sequence[Photo], located: Sequence[int]) -> np.ndarray:
    """Return distances (N, N) on the ground in metres, since GPS measures heights worst; infinite on the diagonal."""
    gps = [photos[number].exif.gps for number in located]
    places = east_north_up([(*place[:2], None) for place in gps if place is not None])[:, :2]
    distances = np.linalg.norm(places[:, None] - places[None], axis=-1)
    np.fill_diagonal(distances, np.inf)
    return distances


def _rising(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i < j else (j, i)
