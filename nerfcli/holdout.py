"""Held-out split: every n-th photo by name, a block of neighbours, or a list in a file.

every:8       index 0, 8, 16, ... of the sorted names: each has training neighbours on both sides
block:0.15    the middle 15 % of the sorted names: a gap in the capture without training neighbours inside
FILE          the names in a text file, one per line
"""

import re
from collections.abc import Iterable
from pathlib import Path

from nerfcli.errors import UserError

DEFAULT_HOLDOUT = "every:8"
_NAMES_SHOWN = 3


def check_holdout(text: str) -> str:
    """Return the rule, with the path of a file made absolute.

    Raises:
        ValueError: the text is not a valid rule; the message says what was expected.
    """
    kind, _, value = text.partition(":")
    if kind == "every" and re.fullmatch(r"\d+", value) and int(value) >= 2:
        return text
    if kind == "block" and re.fullmatch(r"0?\.\d+", value) and float(value) > 0:
        return text
    if Path(text).is_file():
        return str(Path(text).absolute())
    raise ValueError(
        f"{text!r} is not a valid split: expected every:N with N >= 2, block:FRACTION between 0 and 1, or an existing "
        "file"
    )


def names_held_out(rule: str, names: Iterable[str], *, others: Iterable[str] = ()) -> frozenset[str]:
    """Return the names that a rule of `check_holdout` holds out.

    Args:
        rule: see the module.
        names: names of the photos that can be held out.
        others: further names that a file may list, which are ignored.

    Raises:
        UserError: a file lists an unknown name, or no photos are left for training or for evaluation.
    """
    present = sorted(names)
    kind, _, value = rule.partition(":")
    if kind == "every":
        held_out = frozenset(present[:: int(value)])
    elif kind == "block":
        count = max(1, round(float(value) * len(present)))
        first = (len(present) - count) // 2
        held_out = frozenset(sorted(present, key=_in_order)[first : first + count])
    else:
        held_out = _listed(Path(rule), frozenset(present), frozenset(others))
    if not held_out or len(held_out) == len(present):
        raise UserError(
            f"the split {rule} holds out {len(held_out)} of {len(present)} photos",
            "some photos are needed for training and some for evaluation",
        )
    return held_out


def _in_order(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that compares numbers by value: frame_9 before frame_10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.findall(r"\d+|\D+", name)]


def _listed(path: Path, present: frozenset[str], others: frozenset[str]) -> frozenset[str]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read: {error}", "give a text file with one name per line") from error
    listed = frozenset(line.strip() for line in lines if line.strip())
    unknown = sorted(listed - present - others)
    if unknown:
        shown = ", ".join(unknown[:_NAMES_SHOWN])
        raise UserError(
            f"{path} lists {len(unknown)} names that match no photo: {shown}",
            f"write names as in the capture, such as {min(present, default='a.jpg')}",
        )
    return listed & present
