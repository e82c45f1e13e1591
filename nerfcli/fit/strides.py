"""How long the steps along rays are at each moment of a training."""

# Until this share of the budget, rays take steps this many times as long: the fog of the start has no detail.
# Short trainings do not come to details, and learn more from more rays: their shares are those of so many steps.
STRIDES = ((0.05, 8), (0.15, 4), (0.4, 2), (1.0, 1))
DETAILED_STEPS = 2500


def stride_at(share: float, step: int) -> int:
    """Return how many of the shortest steps along rays are taken as one, at a share of the budget and after `step`."""
    share = min(share, step / DETAILED_STEPS)
    return next(stride for until, stride in STRIDES if share <= until)
