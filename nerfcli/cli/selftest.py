"""nerfcli selftest: check numerical accuracy on this machine."""

import time
from typing import TYPE_CHECKING

from nerfcli.cli.console import command
from nerfcli.cli.options import Device, Printing
from nerfcli.errors import GATE_NOT_MET, UserError
from nerfcli.machine import Resources

if TYPE_CHECKING:
    from nerfcli.kernels.selftest.measure import Row

_COLUMNS = ("case", "operation", "precision", "error", "of gradient", "bound", "verdict", "ms")
_STYLES = {"met": "green", "not met": "bold red"}


@command
def selftest(device: Device = "auto", *, printing: Printing) -> None:
    """Check the numerical accuracy of the kernels on hard cases.

    Compares the kernels in float32, in bfloat16, as compiled for the CPU and, with --device cuda, for the GPU, with
    their definitions in float64: thin fog and opaque walls, no samples and thousands, densities near overflow, points
    at infinity. Prints relative errors of values and gradients, their bounds, and time. The exit code is 7 if an
    error exceeds its bound.

    \b
    Examples:
      nerfcli selftest
      nerfcli selftest --device cuda
      nerfcli selftest --device cpu --json | jq 'select(.verdict == "not met")'
    """
    from nerfcli.kernels.selftest.measure import MET, NOT_MET
    from nerfcli.kernels.selftest.table import rows

    console = printing.console
    resources = Resources(0, device)
    resources.begin()
    begin, measured = time.perf_counter(), []
    for row in rows(resources.torch_device, console.note):
        measured.append(row)
        if printing.json:
            console.fact(row.to_json())
    if not printing.json:
        console.fact_table(_COLUMNS, [_cells(row) for row in measured], styles=_STYLES)
    met = sum(row.verdict == MET for row in measured)
    failed = [row for row in measured if row.verdict == NOT_MET]
    console.note(f"{met} of {met + len(failed)} rows within bounds; {time.perf_counter() - begin:.1f} s")
    if failed:
        row = failed[0]
        raise UserError(
            f"{len(failed)} of {len(measured)} rows exceed their bounds; first: {row.case} ({row.operation}, "
            f"{row.precision})",
            "results on this machine are not reliable; please report this with the output of nerfcli selftest --json",
            GATE_NOT_MET,
        )


def _cells(row: "Row") -> tuple[str, ...]:
    numbers = map(_number, (row.errors.value, row.errors.gradient, row.bounds.value))
    return (row.case, row.operation, row.precision, *numbers, row.verdict, f"{1e3 * row.seconds:.1f}")


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1e}" if value else "0"
