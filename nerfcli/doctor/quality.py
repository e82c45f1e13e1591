"""Check for blur and exposure, relative to the capture and to neighbouring photos."""

from collections.abc import Sequence

import numpy as np

from nerfcli.doctor.compared_pairs import FEWEST_PAIRS, Pair
from nerfcli.doctor.photo_facts import PhotoFacts
from nerfcli.errors import several
from nerfcli.matching.graph import potentials
from nerfcli.pages.findings import BAD, GOOD, LOOK, Finding, finding, verdict_above, verdict_below, worst

# log2 of the detail that a photo lacks relative to the others: a Gaussian blur of about 0.8 px takes 0.3 from a sharp
# photo of 1600 px, one of 1.5 px takes 0.7.
BLURRED, VERY_BLURRED = 0.3, 0.7
# A photo is smeared if its direction ratio exceeds this multiple of the capture's median and it lacks this much detail.
_SMEARED, _SMEARED_LACK = 1.25, 0.2
# For the whole capture: detail after a Gaussian blur of about 2 px and of 4 px at 1600 px.
SOFT, VERY_SOFT = -1.15, -1.75

# Range of brightness over the photos, in stops.
STOPS_LOOK, STOPS_BAD = 1.0, 2.5
# Range of red over blue, in stops.
_BALANCE_LOOK, _BALANCE_BAD = 0.5, 1.5
CLIPPED_LOOK, CLIPPED_BAD = 0.1, 0.5
_DARK, _VERY_DARK = 0.15, 0.05
# Differences between photos are off by about this much; larger residuals weigh less.
_TYPICAL_ERROR = 0.1


def lacking_detail(photos: Sequence[PhotoFacts], pairs: Sequence[Pair]) -> np.ndarray:
    """Return log2 of the detail that each photo lacks relative to the capture, (photos,); NaN without texture.

    With enough neighbours it is the mean of two estimates: from the photo's own detail, and from the detail at
    points that it shares with its neighbours.
    """
    own = np.array([photo.sharpness.detail for photo in photos])
    reference = np.nanmedian(own) if not np.isnan(own).all() else 0.0
    linked = [pair for pair in pairs if pair.linked]
    trust = np.array([pair.inliers for pair in linked], dtype=np.float64)
    matched, backing = _fitted(photos, linked, [pair.detail for pair in linked], trust)
    alone = reference - own
    both = (alone - matched) / 2
    # A photo without enough neighbours must lack more, since its content also plays a part.
    return np.where((backing >= FEWEST_PAIRS) & ~np.isnan(both), both, alone - _TYPICAL_ERROR)


def sharpness(photos: Sequence[PhotoFacts], missing: np.ndarray) -> Finding:
    """Check for photos that are blurred relative to the others, by their missing detail, and for softness of all."""
    own = np.array([photo.sharpness.detail for photo in photos])
    ratios = np.array([photo.sharpness.direction_ratio for photo in photos])
    usual = float(np.median(ratios))
    blank = np.isnan(own)
    smeared = (ratios > _SMEARED * usual) & (missing > _SMEARED_LACK)
    blurred = ~blank & ((missing > BLURRED) | smeared)
    very = ~blank & (missing > VERY_BLURRED)
    flagged = [
        (photos[i].name, f"{100 * 2 ** -missing[i]:.0f} % of the usual detail{', smeared' if smeared[i] else ''}")
        for i in np.argsort(-np.nan_to_num(missing, nan=-9))
        if blurred[i]
    ]
    middle = float(np.median(own[~blank])) if (~blank).any() else float("nan")
    whole = GOOD if np.isnan(middle) else verdict_below(middle, look=SOFT, bad=VERY_SOFT)
    fraction = float(blurred.mean())
    verdict = worst([whole, BAD if fraction >= 0.3 or very.mean() > 0.1 else LOOK if blurred.any() else GOOD])
    parts, advice = [], []
    if blurred.any():
        parts.append(f"{blurred.sum()} of {several(len(photos), 'photo')} blurred")
        advice.append("remove them if others show the same, or take them again with a shorter exposure time")
    if whole != GOOD:
        parts.append("all photos are soft, as if upscaled or out of focus")
        advice.append("train with --downscale 2 or use sharper originals")
    summary = "; ".join(parts) or "no photo is blurred compared with the others"
    threshold = f"detail: look below {100 * 2 ** (-BLURRED):.0f} % of the usual detail, bad from 30 % of the photos"
    return Finding("sharpness", verdict, summary, fraction, threshold, "; ".join(advice), tuple(flagged))


def texture(photos: Sequence[PhotoFacts]) -> Finding:
    """Check whether the photos have enough features to match."""
    threshold = "look from 1 photo with fewer than 150 features, bad from 30 % of the photos"
    poor = sorted((photo for photo in photos if len(photo.features.pixels) < 150), key=lambda p: len(p.features.pixels))
    summary = f"{several(len(poor), 'photo')} with very few features" if poor else "enough in every photo"
    remarks = (
        (p.name, f"{len(p.features.pixels)} features, texture on {100 * p.sharpness.textured:.0f} % of the image")
        for p in poor
    )
    fraction, advice = len(poor) / len(photos), "step back, or include textured objects"
    verdict = verdict_above(fraction, look=1e-9, bad=0.3)
    return finding("texture", verdict, summary, fraction, threshold, advice=advice, photos=remarks)


def stops(photos: Sequence[PhotoFacts], pairs: Sequence[Pair]) -> tuple[np.ndarray, np.ndarray]:
    """Compute by how many stops each photo is brighter, and redder (red over blue), than the median photo.

    At the same points, (photos,) each; NaN for photos without usable matches.
    """
    linked = [pair for pair in pairs if pair.linked]
    # A uniform change in brightness comes from the camera; highlights and shadows come from the scene.
    trust = np.array([pair.inliers / (0.05 + np.nan_to_num(pair.stops_spread)) for pair in linked])
    brighter, _ = _fitted(photos, linked, [pair.stops for pair in linked], trust)
    redder, _ = _fitted(photos, linked, [pair.red_blue_stops for pair in linked], trust)
    return brighter, redder


def _fitted(
    photos: Sequence[PhotoFacts], pairs: Sequence[Pair], differences: Sequence[float], trust: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a number for each photo that fits the differences of pairs, and how many of these are known of it."""
    places = [(pair.first, pair.second) for pair in pairs]
    return potentials(len(photos), places, np.array(differences), trust=trust, usual_error=_TYPICAL_ERROR)


def exposure(photos: Sequence[PhotoFacts], brighter: np.ndarray) -> Finding:
    """Check whether the same points are about equally bright in all photos; reports the exposures in EXIF."""
    spread, verdict, off = _differences(brighter, look=STOPS_LOOK, bad=STOPS_BAD)
    settings = [
        float(np.log2(photo.exif.exposure_seconds * photo.exif.iso))
        for photo in photos
        if photo.exif.exposure_seconds and photo.exif.iso
    ]
    text = f"; EXIF: {np.ptp(settings):.1f} stops in time and ISO" if len(settings) > 1 else ""
    seen = f"brightness differs by up to {spread:.1f} stops at the same points"
    if np.isnan(spread):
        seen = "no matches to compare brightness"
    if np.isnan(spread) and len(settings) > 1:
        verdict = verdict_above(float(np.ptp(settings)), look=STOPS_LOOK, bad=STOPS_BAD)
    threshold = f"look from {STOPS_LOOK:g} stop, bad from {STOPS_BAD:g}"
    advice = (
        "fix the exposure in the camera and take all photos in one session; highlights and moving shadows have the "
        "same effect"
    )
    if len(settings) == len(photos) and np.ptp(settings) < 0.1:
        advice = (
            "the camera settings are constant, so the lighting changes or surfaces are shiny: avoid lamps and your "
            "shadow"
        )
    remarks = [(photos[i].name, f"{brighter[i]:+.1f} stops") for i in off]
    return finding("exposure", verdict, seen + text, spread, threshold, advice=advice, photos=remarks)


def white_balance(photos: Sequence[PhotoFacts], redder: np.ndarray) -> Finding:
    """Check whether the same points have the same colour in all photos."""
    spread, verdict, off = _differences(redder, look=_BALANCE_LOOK, bad=_BALANCE_BAD)
    summary = f"the red/blue ratio differs by up to {spread:.2f} stops at the same points"
    if np.isnan(spread):
        summary = "no matches to compare colours"
    threshold = f"look from {_BALANCE_LOOK:g} stops, bad from {_BALANCE_BAD:g}"
    advice = "fix the white balance in the camera; avoid coloured light"
    remarks = [(photos[i].name, f"{redder[i]:+.2f} stops redder") for i in off]
    return finding("white balance", verdict, summary, spread, threshold, advice=advice, photos=remarks)


def _differences(values: np.ndarray, *, look: float, bad: float) -> tuple[float, str, list[int]]:
    """Return the range of photos' values, NaN without any, its verdict, and the photos more than look / 2 from 0."""
    if np.isnan(values).all():
        return float("nan"), GOOD, []
    spread = float(np.nanmax(values) - np.nanmin(values))
    far = [int(i) for i in np.argsort(-np.abs(np.nan_to_num(values))) if abs(values[i]) > look / 2]
    return spread, verdict_above(spread, look=look, bad=bad), far


def clipping(photos: Sequence[PhotoFacts]) -> Finding:
    """Find photos with large pure white or black areas, or that are dark as a whole."""
    flagged: list[tuple[float, str, str]] = []
    verdicts = [GOOD]
    for photo in photos:
        light = photo.exposure
        clipped = max(light.white, light.black)
        verdict = verdict_above(clipped, look=CLIPPED_LOOK, bad=CLIPPED_BAD)
        if verdict != GOOD:
            kind = "white" if light.white >= light.black else "black"
            flagged.append((clipped, photo.name, f"{100 * clipped:.0f} % pure {kind}"))
        elif light.mean < _DARK:
            verdict = verdict_below(light.mean, look=_DARK, bad=_VERY_DARK)
            flagged.append((_DARK - light.mean, photo.name, f"dark: mean level {255 * light.mean:.0f} of 255"))
        verdicts.append(verdict)
    threshold = (
        f"per photo: look from {100 * CLIPPED_LOOK:g} % of its pixels, bad from {100 * CLIPPED_BAD:g} %; all: bad "
        "from 30 % of the photos"
    )
    verdict = BAD if verdicts.count(BAD) >= 0.3 * len(photos) else LOOK if flagged else GOOD
    large = f"{several(len(flagged), 'photo')} of {len(photos)} with large pure white or black areas, or dark"
    advice = "expose so that the subject is neither white nor black, which cannot be matched; a background may be"
    remarks = ((name, what) for _, name, what in sorted(flagged, key=lambda item: -item[0]))
    summary, fraction = large if flagged else "little", len(flagged) / len(photos)
    return finding("clipping", verdict, summary, fraction, threshold, advice=advice, photos=remarks)
