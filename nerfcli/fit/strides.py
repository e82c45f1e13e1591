"""Length of the steps along rays in the course of a training."""

# Until this fraction of the budget, steps along rays are this many times as long: the initial fog has no detail.
# Short trainings do not reach the detail and learn more from more rays: their fractions are those of this many steps.
STRIDES = ((0.05, 8), (0.15, 4), (0.4, 2), (1.0, 1))
DETAILED_STEPS = 2500


def stride_at(fraction: float, step: int) -> int:
    """Return the number of shortest ray steps to combine into one, at a fraction of the budget and at step `step`."""
    fraction = min(fraction, step / DETAILED_STEPS)
    return next(stride for until, stride in STRIDES if fraction <= until)
