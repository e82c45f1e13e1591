"""All rows of the selftest, in all precisions of a machine."""

from collections.abc import Callable, Iterator

import torch

from nerfcli import kernels
from nerfcli.selftest.measure import Precision, Row
from nerfcli.selftest.table import OF_GPU, checks, row_of


def precisions(device: str) -> tuple[Precision, ...]:
    """List the precisions to test on a device, with the compiled CPU kernels if they work on this machine."""
    plain = tuple(
        Precision(name, dtype, device) for name, dtype in (("float32", torch.float32), ("bfloat16", torch.bfloat16))
    )
    compiled = (Precision("compiled", torch.float32, "cpu", compiled=True),) if kernels.has_compiled() else ()
    has_gpu_kernels = kernels.triton_unavailable_reason(torch.device(device)) is None
    of_gpu = (Precision(OF_GPU, torch.float32, device, for_gpu=True),) if has_gpu_kernels else ()
    return plain + of_gpu + compiled


def rows(device: str, notify: Callable[[str], None]) -> Iterator[Row]:
    """Measure and yield the rows one by one."""
    kernels.prepare(notify)
    if device != "cpu":
        kernels.prepare(notify, device)
    for check in checks():
        for precision in precisions(device):
            if check.is_for(precision):
                yield row_of(check, precision)
