"""Look-up of frames by the names that people type."""

from collections.abc import Sequence
from difflib import get_close_matches

from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError


def frames_named(frames: Sequence[Frame], names: Sequence[str]) -> tuple[Frame, ...]:
    """Return the frames with the given names, in the order of the names; a frame may be repeated.

    A name is a frame's full name, or its last parts if they match only one frame: photo.jpg or photo for
    images/photo.jpg.

    Raises:
        UserError: no frame matches a name (the error lists similar names), or several do.
    """
    whole = {frame.name: frame for frame in frames}
    endings: dict[str, list[Frame]] = {}
    for frame in frames:
        parts = frame.name.split("/")
        stem = parts[-1].rpartition(".")[0]
        for start in range(len(parts)):
            endings.setdefault("/".join(parts[start:]), []).append(frame)
            if stem:
                endings.setdefault("/".join([*parts[start:-1], stem]), []).append(frame)
    return tuple(_named(name, whole, endings) for name in names)


def _named(name: str, whole: dict[str, Frame], endings: dict[str, list[Frame]]) -> Frame:
    if name in whole:
        return whole[name]
    found = endings.get(name, [])
    if len(found) == 1:
        return found[0]
    if found:
        several = ", ".join(frame.name for frame in found[:3])
        raise UserError(f"{len(found)} images match {name}: {several}", "give a longer part of the name")
    near = get_close_matches(name, whole, n=3, cutoff=0.5) or list(whole)[:3]
    raise UserError(f"no image is named {name!r}", f"there are {len(whole)}, such as {', '.join(near)}")
