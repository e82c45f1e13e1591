"""All rows, in all precisions of a machine."""

from collections.abc import Callable, Iterator

import torch

from hard_cases import depths, learning, light, lookup, space, views, volumes
from nerfcli import kernels
from nerfcli.selftest.measure import Precision, Row


def precisions(device: str) -> tuple[Precision, ...]:
    """What can be tried on a device; the compiled kernels are the CPU's, and are tried wherever they work."""
    plain = tuple(
        Precision(name, dtype, device)
        for name, dtype in (("float64", torch.float64), ("float32", torch.float32), ("bfloat16", torch.bfloat16))
    )
    compiled = (Precision("compiled", torch.float32, "cpu", compiled=True),) if kernels.has_compiled() else ()
    return plain + compiled


def rows(device: str, notify: Callable[[str], None]) -> Iterator[Row]:
    """Every row, one after the other as they are measured."""
    kernels.prepare(notify)
    tried = precisions(device)
    yield from light.rows(tried)
    yield from depths.rows(tried)
    yield from lookup.rows(tried)
    yield from learning.rows(tried)
    yield from space.rows(tried)
    yield from views.rows()
    yield from volumes.rows(tried)
