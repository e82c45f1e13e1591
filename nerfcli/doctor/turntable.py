"""Check from pairs whether an object turns in front of a static background."""

from collections.abc import Sequence
from dataclasses import replace

from nerfcli.doctor.compared_pairs import Pair
from nerfcli.findings import LOOK, Finding
from nerfcli.multiview.stationary import LEAST_FRACTION, together


def turning_object(pairs: Sequence[Pair]) -> Finding | None:
    """Return a finding if an object turns in front of a static background, else None.

    In such a capture the camera stood still, so the other checks of movement between pairs do not apply.
    """
    motions = together([(pair.first, pair.second, pair.motions) for pair in pairs if pair.motions is not None])
    others = sum(pair.linked and pair.motions is None for pair in pairs)
    motions = replace(motions, moved=motions.moved + others)
    if not motions.found:
        return None
    return Finding(
        "turning object",
        LOOK,
        f"an object moves in front of a static background, as on a turntable: {motions.two} of "
        f"{motions.two + motions.still + motions.moved} pairs show both motions",
        motions.fraction,
        f"look if {100 * LEAST_FRACTION:g} % of the pairs with a moving object also show a static background",
        "nerfcli poses creates masks of the object and uses only its motion; if it finds none, give --masks that are "
        "white on the object, or use a plain cloth as background",
    )
