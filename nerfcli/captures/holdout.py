"""Held-out split: every n-th photo by name, a block of neighbours, or a list in a file.

every:8       index 0, 8, 16, ... in alphabetical order, as in published tables: photos with training neighbours
block:0.15    the middle 15 % in the order of the numbers in the names: a gap without training neighbours
FILE          the names in a text file, one per line

Photos with the same file name in different folders, such as left/0001.png and right/0001.png, were taken at the same
time by the cameras of a rig. The first two rules count them as one, so that no photo is held out whose neighbour on the
rig is used for training.
"""

import re
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from nerfcli.errors import UserError, several

# By default, one of this many photos in the order of their names is held out.
HELD_OUT_EVERY = 8
DEFAULT_HOLDOUT = f"every:{HELD_OUT_EVERY}"
_NAMES_SHOWN = 3
# Folders of Blender's captures, whose pictures of the same name have nothing in common.
_SPLIT_FOLDERS = frozenset({"train", "test", "val"})


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
        held_out = frozenset(name for moment in moments(present)[:: int(value)] for name in moment)
    elif kind == "block":
        in_order = sorted(moments(present), key=lambda moment: _in_order(moment[0]))
        count = max(1, round(float(value) * len(in_order)))
        first = (len(in_order) - count) // 2
        held_out = frozenset(name for moment in in_order[first : first + count] for name in moment)
    else:
        held_out = _listed(Path(rule), frozenset(present), frozenset(others))
    if not held_out or len(held_out) == len(present):
        hint = "choose another --holdout: some photos are needed for training and some for evaluation"
        raise UserError(f"the split {rule} holds out {len(held_out)} of {len(present)} photos", hint)
    return held_out


def default_split(names: Iterable[str]) -> frozenset[str]:
    """Return the held-out names: every 8th of the sorted names, including the first, as `holdout` counts them."""
    return frozenset(name for moment in moments(names)[::HELD_OUT_EVERY] for name in moment)


def moments(names: Iterable[str]) -> list[list[str]]:
    """Group the names of photos that were taken at the same time, see the module; in order of each group's first name.

    Where a moment has as many photos as there are moments, or more, they are views from all around rather than
    neighbours on a rig, and each photo stays on its own. So it does in folders that are named after splits.
    """
    present = sorted(names)
    taken: dict[str, list[str]] = {}
    for name in present:
        taken.setdefault(PurePosixPath(name).name, []).append(name)
    folders = {str(PurePosixPath(name).parent) for name in present}
    if folders <= _SPLIT_FOLDERS or max(map(len, taken.values()), default=0) >= len(taken):
        return [[name] for name in present]
    return list(taken.values())


def _in_order(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that compares numbers by value: frame_9 before frame_10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.findall(r"\d+|\D+", name)]


def _listed(path: Path, present: frozenset[str], others: frozenset[str]) -> frozenset[str]:
    from nerfcli.captures.formats.fields import decoded  # imports NumPy, which parsing a command line does not need

    try:
        lines = decoded(path.read_bytes()).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read: {error}", "give a text file with one name per line") from error
    listed = frozenset(line.strip() for line in lines if line.strip())
    unknown = sorted(listed - present - others)
    if unknown:
        shown = ", ".join(unknown[:_NAMES_SHOWN])
        what = f"{path} lists {several(len(unknown), 'name that matches', 'names that match')} no photo: {shown}"
        raise UserError(what, f"write names as in the capture, such as {min(present, default='a.jpg')}")
    return listed & present
