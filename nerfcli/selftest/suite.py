"""All rows of the selftest, in all precisions of a machine."""

from collections.abc import Callable, Iterator

import torch

from nerfcli import kernels
from nerfcli.selftest.cases import MEANINGLESS
from nerfcli.selftest.measure import Precision, Row
from nerfcli.selftest.table import checks, row_of


def precisions(device: str) -> tuple[Precision, ...]:
    """List the precisions to test on a device; compiled kernels run on the CPU wherever they work."""
    plain = tuple(
        Precision(name, dtype, device) for name, dtype in (("float32", torch.float32), ("bfloat16", torch.bfloat16))
    )
    compiled = (Precision("compiled", torch.float32, "cpu", compiled=True),) if kernels.has_compiled() else ()
    return plain + compiled


def rows(device: str, notify: Callable[[str], None]) -> Iterator[Row]:
    """Every row, one after the other as they are measured."""
    kernels.prepare(notify)
    for check in checks():
        for precision in precisions(device):
            if precision.name in check.precisions and check.bound(precision).value <= MEANINGLESS:
                yield row_of(check, precision)
