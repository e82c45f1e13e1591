"""All hard cases, in every precision that a machine supports."""

from collections.abc import Callable, Iterator

import torch

from hard_cases import depths, learning, light, lookup, space, views, volumes
from nerfcli import kernels
from nerfcli.kernels.selftest.measure import Precision, Row


def precisions(device: str) -> tuple[Precision, ...]:
    """Return the precisions to test on a device, and the compiled CPU kernels where they work."""
    plain = tuple(
        Precision(name, dtype, device)
        for name, dtype in (("float64", torch.float64), ("float32", torch.float32), ("bfloat16", torch.bfloat16))
    )
    compiled = (Precision("compiled", torch.float32, "cpu", compiled=True),) if kernels.has_compiled() else ()
    return plain + compiled


def rows(device: str, notify: Callable[[str], None]) -> Iterator[Row]:
    """Yield every row as soon as it is measured."""
    kernels.prepare(notify)
    tried = precisions(device)
    yield from light.rows(tried)
    yield from depths.rows(tried)
    yield from lookup.rows(tried)
    yield from learning.rows(tried)
    yield from space.rows(tried)
    yield from views.rows()
    yield from volumes.rows(tried)
