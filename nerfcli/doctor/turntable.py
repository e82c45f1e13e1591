"""Whether an object turns, or is moved, before a background that keeps its place in the picture: from pairs."""

from collections.abc import Sequence
from dataclasses import replace

from nerfcli.doctor.findings import LOOK, Finding
from nerfcli.doctor.matching import Pair
from nerfcli.multiview.stationary import LEAST_SHARE, together


def turning_object(pairs: Sequence[Pair]) -> Finding | None:
    """Return what to say of a capture in which an object turns before a still background; None for all others.

    Then nothing else that pairs say of movement holds, since the camera stood still.
    """
    said = together([(pair.first, pair.second, pair.motions) for pair in pairs if pair.motions is not None])
    others = sum(pair.linked and pair.motions is None for pair in pairs)
    said = replace(said, moved=said.moved + others)
    if not said.found:
        return None
    return Finding(
        "turning object",
        LOOK,
        "an object turns, or is moved, before a background that keeps its place in the picture, as on a turntable: "
        f"{said.two} of {said.two + said.still + said.moved} pairs show both motions",
        said.share,
        f"look where {LEAST_SHARE:g} of the pairs with anything that moves also show a background that does not",
        "poses looks for masks of the object and solves its motion alone; if it finds none, give it --masks that are "
        "white where the object is, or cover the background with plain cloth",
    )
