"""Checks of the views of a scan: whole object, all directions, enough of them."""

import numpy as np

from nerfcli.ct.checks.sample import Sample
from nerfcli.ct.circle import circle_of
from nerfcli.ct.geometry import ScanGeometry
from nerfcli.errors import several
from nerfcli.pages.findings import BAD, GOOD, LOOK, Finding, verdict_above, verdict_below

TRUNCATED_LOOK, TRUNCATED_BAD = 0.02, 0.2
WEDGE_BAD_DEG = 30.0
FEW_LOOK, FEW_BAD = 1.0, 0.05
# Views that differ by less than this fraction of the usual step count as views at the same angle.
_SAME = 0.05
# Largest deviation from a circle, in pixels, of a scan that is checked as a circular one.
_ROUND_PX = 1.0


def truncation(sample: Sample) -> Finding:
    """Measure the fraction of views in which the object reaches the border of the detector."""
    reached = np.asarray(sample.border > sample.air_level)
    fraction = float(reached.any(axis=(1, 2)).mean())
    sides = reached[..., 0].any(), reached[..., 1].any()
    which = {(True, False): " on the left", (False, True): " on the right", (True, True): " on both sides"}.get(
        (bool(sides[0]), bool(sides[1])), ""
    )
    verdict = verdict_above(fraction, look=TRUNCATED_LOOK, bad=TRUNCATED_BAD)
    return Finding(
        "truncation",
        verdict,
        f"the object reaches the border{which} in {100 * fraction:.3g} % of the views",
        fraction,
        f"look from {100 * TRUNCATED_LOOK:g} %, bad from {100 * TRUNCATED_BAD:g} %; line integrals above "
        f"{sample.air_level:.2g} count as object",
        ""
        if verdict == GOOD
        else "values inside hold up to a smooth offset only: use a wider detector, or rely on edges rather than values",
    )


def repeated_angles(sample: Sample) -> Finding | str:
    """Find views at the same angle, such as 0 and 360 degrees."""
    angles = _angles(sample.scan.geometry)
    if angles is None:
        return "the views are not on one circle"
    step = _step(angles)
    turned = np.mod(angles, 2 * np.pi)
    order = np.argsort(turned)
    gaps = np.diff(np.append(turned[order], turned[order][0] + 2 * np.pi))
    same = np.flatnonzero(gaps < _SAME * step)
    pairs = [(int(order[k]), int(order[(k + 1) % len(order)])) for k in same]
    held_out = set(sample.scan.held_out)
    leaks = [pair for pair in pairs if (pair[0] in held_out) != (pair[1] in held_out)]
    verdict = BAD if leaks else LOOK if pairs else GOOD
    example = ""
    if pairs:
        first, second = sorted(pairs[0])
        example = f": {np.degrees(angles[first]):.6g} and {np.degrees(angles[second]):.6g} degrees"
    advice = ""
    if leaks:
        advice = "one of them is held out and the other is not: hold out both, or leave one out (--holdout FILE)"
    elif pairs:
        advice = "such a view counts twice: leave one out"
    return Finding(
        "repeated angles",
        verdict,
        f"{several(len(pairs), 'pair')} of views at the same angle{example}",
        float(len(pairs)),
        "look from 1 pair, bad where one of them is held out",
        advice,
    )


def missing_wedge(sample: Sample) -> Finding | str:
    """Find the directions that no ray covers."""
    geometry = sample.scan.geometry
    angles = _angles(geometry)
    if angles is None:
        return "the views are not on one circle"
    step = _step(angles)
    ordered = np.sort(np.mod(angles, 2 * np.pi))
    gaps = np.diff(np.append(ordered, ordered[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    gap = float(gaps[widest])
    fan = _fan(geometry)
    # If the gap in the source's path is below half a turn minus the fan, each line is measured from its other end.
    span = 2 * np.pi - (gap if gap > 2 * step else 0.0)
    missing = np.pi - span - (step if geometry.beam == "parallel" else 0.0)
    missing = missing if missing > step / 2 else 0.0
    missing_deg, span_deg = float(np.degrees(missing)), float(np.degrees(span))
    once = span < np.pi + fan - step and missing == 0
    begin = float(np.degrees(ordered[widest]))
    verdict = BAD if missing_deg >= WEDGE_BAD_DEG else LOOK if missing_deg > 0 or once else GOOD
    if missing_deg > 0:
        at = np.mod([begin, begin + missing_deg], 180)
        summary = (
            f"views span {span_deg:.4g} degrees: a wedge of {missing_deg:.4g} degrees is missing, ray directions "
            f"{at[0]:.4g} to {at[1]:.4g}"
        )
        advice = "edges along the missing directions cannot be reconstructed; the volume is marked there"
    elif once:
        summary = f"views span {span_deg:.4g} degrees, less than 180 and the fan of {np.degrees(fan):.3g}"
        advice = (
            "some lines at the border of the object were not measured: scan a larger angle, or expect shading there"
        )
    else:
        summary, advice = f"views span {span_deg:.4g} degrees, no direction is missing", ""
    return Finding(
        "missing wedge",
        verdict,
        summary,
        missing_deg,
        f"look from a span below 180 degrees and the fan, bad from {WEDGE_BAD_DEG:g} missing degrees",
        advice,
    )


def few_views(sample: Sample) -> Finding:
    """Compare the number of views with the width of the detector."""
    geometry = sample.scan.geometry
    views = len(sample.scan.training_views)
    wanted = np.pi / 2 * geometry.columns
    number = views / wanted
    verdict = verdict_below(number, look=FEW_LOOK, bad=FEW_BAD)
    return Finding(
        "number of views",
        verdict,
        f"{views} views to reconstruct from, {100 * number:.3g} % of pi/2 x {geometry.columns} columns",
        number,
        f"look below {100 * FEW_LOOK:g} %, bad below {100 * FEW_BAD:g} %",
        ""
        if verdict == GOOD
        else "filtered back-projection will show streaks: fit with total variation, or use larger pixels",
    )


def _angles(geometry: ScanGeometry) -> np.ndarray | None:
    circle, apart = circle_of(geometry)
    return np.array(circle.angles) if apart < _ROUND_PX else None


def _step(angles: np.ndarray) -> float:
    """Return the median angle between neighbouring views."""
    turned = np.sort(np.mod(angles, 2 * np.pi))
    gaps = np.diff(turned)
    gaps = gaps[gaps > 1e-9]
    return float(np.median(gaps)) if len(gaps) else 2 * np.pi


def _fan(geometry: ScanGeometry) -> float:
    """Return the fan angle of the middle row; 0 for parallel beams."""
    if geometry.beam == "parallel":
        return 0.0
    _, directions = geometry.rays(np.array([0]))
    row = directions[0, geometry.rows // 2]
    return float(np.arccos(np.clip(row[0] @ row[-1], -1, 1)))
