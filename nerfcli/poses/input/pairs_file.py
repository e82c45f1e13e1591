"""Pairs of photos that the user lists: two names per line."""

from collections.abc import Container, Iterator
from pathlib import Path

from nerfcli.errors import UserError
from nerfcli.poses.input.pairs import Pairing, in_blocks
from nerfcli.poses.input.photos import Photos


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
            i, j = numbers[one], numbers[other]
            pairs.add((min(i, j), max(i, j)))
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
