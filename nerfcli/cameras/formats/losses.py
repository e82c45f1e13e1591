"""What of a capture a format has no place for, said in short clauses; the lens is each format's own matter."""

from collections.abc import Collection

from nerfcli.cameras.frame import Capture


def lost(capture: Capture, *, holds: Collection[str] = ()) -> list[str]:
    """A clause for each property of the capture beyond frames and cameras that a format cannot hold.

    Args:
        holds: which of "points", "colours" the format has a place for.

    Returns:
        Clauses such as "3 masks" or "1200 points", in a fixed order.
    """
    clauses = []
    if len(capture.points) and "points" not in holds:
        clauses.append(counted(len(capture.points), "point"))
    elif capture.colours is not None and "colours" not in holds:
        clauses.append(f"colours of {counted(len(capture.points), 'point')}")
    if capture.observations is not None and len(capture.observations.pixels):
        clauses.append(counted(len(capture.observations.pixels), "observation"))
    masks = sum(frame.mask is not None for frame in capture.frames)
    if masks:
        clauses.append(counted(masks, "mask"))
    if any(frame.split is not None for frame in capture.frames):
        clauses.append("held-out split")
    if capture.depth_bounds is not None:
        clauses.append(f"depth bounds of {counted(len(capture.depth_bounds), 'frame')}")
    if capture.unit != "arbitrary":
        clauses.append(f"unit of length ({capture.unit})")
    return clauses


def counted(count: int, what: str) -> str:
    """A number of things: "1 mask", "3 masks"."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
