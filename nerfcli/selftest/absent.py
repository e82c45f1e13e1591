"""The hard cases that cannot occur in this program, and why not."""

from collections.abc import Iterator

from nerfcli.selftest.measure import Row

# Number, what is hard elsewhere, why it does not happen here.
_ABSENT = (
    (10, "Adam's state in half precision", "the moments are float32, always; see the row above for their smallest"),
    (
        19,
        "floaters in front of cameras",
        "no matter of rounding: steps begin at 0.02, gradients are scaled near cameras",
    ),
    (22, "colours divided by an alpha of 0", "alpha stays straight: over_background multiplies and divides nothing"),
)


def rows() -> Iterator[Row]:
    """A row for each, with the reason."""
    for number, case, reason in _ABSENT:
        yield Row((number,), case, "-", "-", None, None, reason)
