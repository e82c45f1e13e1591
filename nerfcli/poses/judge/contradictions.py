"""Find the verified pairs of photos that contradict a model, and leave out the photos on the weaker side."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from nerfcli.matching.graph import bottlenecks, connected_groups, spanning_tree
from nerfcli.poses.model.two_views import LEAST_ANGLE_DEG, PairAgreement, VerifiedPair, agreements

# A pair with fewer may be wrong even if no other pair joins its photos.
_CERTAIN_MATCHES = 100
# A pair this strong, relative to the best chain that contradicts it, is a serious rival and not a mistake; up to the
# inverse, the chain is equally credible.
_RIVAL_STRENGTH = 0.5
# Largest fraction of the photos that may be left out because they contradict the others.
_MOST_LEFT_OUT = 0.2
# Cameras farther from the median position than this many times the median distance are misplaced.
FARTHEST = 10.0


@dataclass(frozen=True)
class Contradiction:
    """Two photos whose matches contradict the model, and the strongest chain of pairs that agrees with it."""

    one: str
    other: str
    matches: int
    agreeing_chain: float

    @property
    def outweighs(self) -> bool:
        """True if the pair is stronger than the chain that supports the model; a pair with few matches, by half."""
        return self.matches > (1.0 if self.matches >= _CERTAIN_MATCHES else 1.5) * self.agreeing_chain

    @property
    def is_rival(self) -> bool:
        """True if pair and chain are about equally strong, so that either may be wrong."""
        return self.matches <= self.agreeing_chain / _RIVAL_STRENGTH


def leave_out_contradicting(
    model: pycolmap.Reconstruction, pairs: Sequence[VerifiedPair], names: Mapping[int, str]
) -> tuple[pycolmap.Reconstruction, dict[int, str]]:
    """Return the model without the photos that the strongest evidence contradicts, and the reasons by image id.

    Photos are connected by their pairs. If the strongest chain of pairs contains one that contradicts the model, the
    smaller side may be anywhere. If all such sides together have few photos, these are left out; if they have many, the
    model is not repaired but returned unchanged, to be refused. `names` are those of the photos, by image id.
    """
    found = agreements(model, pairs)
    placed = sorted(model.reg_image_ids())
    contradicting = [c for c in strong_contradictions(model, found, names) if c.outweighs]
    far = {photo: reason for photo, reason in _far_away(model).items() if not _is_held(photo, found)}
    if not contradicting and not far:
        return model, {}
    agreeing = {(a.one, a.other) for a in found if not a.contradicts}
    tree = [join[:2] for join, *_ in spanning_tree(placed, [(a.one, a.other, a.matches) for a in found])]
    _, *sides = connected_groups(placed, [pair for pair in tree if pair in agreeing]) if contradicting else [placed]
    reasons = dict(far)
    for photo in (photo for side in sides for photo in side if photo not in far):
        pair = next((c for c in contradicting if names[photo] in (c.one, c.other)), None)
        if pair is None:
            reasons[photo] = "connected to the rest only through a photo that contradicts it"
        else:
            other = pair.other if pair.one == names[photo] else pair.one
            its = f"its {pair.matches} matches with {other}"
            reasons[photo] = f"contradicts the rest: {its} are inconsistent with the poses"
    if len(reasons) > _MOST_LEFT_OUT * len(placed):
        return model, {}
    return without_photos(model, reasons), reasons


def without_photos(model: pycolmap.Reconstruction, photos: Iterable[int] = ()) -> pycolmap.Reconstruction:
    """Copy a model without some photos and those that have no pose: pycolmap's covariance raises on them."""
    rest = pycolmap.Reconstruction(model)
    for photo in photos:
        rest.deregister_frame(rest.image(photo).frame_id)
    rest.tear_down()
    return rest


def strong_contradictions(
    model: pycolmap.Reconstruction, found: Sequence[PairAgreement], names: Mapping[int, str]
) -> list[Contradiction]:
    """Return pairs that contradict a model, more than half as strong as the chain that supports it, strongest first."""
    chain_between = bottlenecks(
        sorted(model.reg_image_ids()), [(a.one, a.other, a.matches * a.fraction) for a in found if not a.contradicts]
    )
    pairs = []
    for a in sorted((a for a in found if a.contradicts), key=lambda a: -a.matches):
        chain = chain_between(a.one, a.other)
        if a.matches > _RIVAL_STRENGTH * chain:
            pairs.append(Contradiction(names[a.one], names[a.other], a.matches, chain))
    return pairs


def _is_held(photo: int, found: Sequence[PairAgreement]) -> bool:
    """Return whether more matches of a photo determine its position than contradict it."""
    own = [a for a in found if photo in (a.one, a.other)]
    supporting = sum(a.matches for a in own if not a.contradicts and a.angle_deg > LEAST_ANGLE_DEG)
    return supporting > sum(a.matches for a in own if a.contradicts)


def _far_away(model: pycolmap.Reconstruction) -> dict[int, str]:
    """Return photos much farther from the centre of all cameras than the others, with reasons."""
    photos = sorted(model.reg_image_ids())
    centres = np.array([model.image(photo).projection_center() for photo in photos])
    distances = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    radius = np.median(distances)
    return {
        photo: f"contradicts the rest: {distance / radius:.0f} times as far away as the other cameras"
        for photo, distance in zip(photos, distances, strict=True)
        if radius > 0 and distance > FARTHEST * radius
    }
