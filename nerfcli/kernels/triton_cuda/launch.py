"""Launch of Triton kernels: compiled by Triton, loaded and started by the CUDA driver; no C compiler is needed.

Triton's own launcher builds a C module once per machine, and is used where that works and the driver does not. In
Triton's interpreter (TRITON_INTERPRET=1, read when Triton is imported) the same kernels run on the CPU.
"""

import os
from collections.abc import Callable
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfcli.kernels.triton_cuda import cubin, driver
from nerfcli.kernels.triton_cuda.cubin import Variant

INTERPRETED = os.environ.get("TRITON_INTERPRET", "").lower() in ("1", "true", "on", "yes", "y")
# The oldest compute capability that Triton supports, and the oldest Triton that these kernels compile with.
LEAST_CAPABILITY, LEAST_TRITON = (8, 0), (3, 6)
# Names of types in Triton's signatures.
TYPES = {torch.float32: "fp32", torch.float16: "fp16", torch.int64: "i64", torch.int32: "i32", torch.uint8: "u8"}
# Pointers that are multiples of this allow vector loads.
ALIGNMENT = 16


class Size(int):
    """Items per program: on a GPU, or in the interpreter, where a program costs about the same however many it has."""

    compiled: int

    @classmethod
    def of(cls, compiled: int, *, interpreted: int) -> "Size":
        size = cls(interpreted if INTERPRETED else compiled)
        size.compiled = compiled
        return size


# `triton.jit` without its types, by which functions that only kernels may call never return.
jit: Callable[[Callable[..., Any]], Any] = triton.jit

# The variants of all launches in the interpreter so far, from which tests learn what to compile.
seen: dict[Variant, None] = {}
# Loaded kernels, by kernel, device, kinds of the arguments and constants.
_loaded: dict[tuple[Any, ...], driver.Function] = {}
# The devices on which Triton's own launcher is used.
_with_triton: set[int] = set()


def launch(
    kernel: Any, grid: tuple[int, ...], *arguments: Tensor | float, warps: int = 4, stages: int = 1, **constants: Any
) -> None:
    """Run a kernel on the device of its first tensor.

    A training step has about twenty launches, and on a large GPU the host takes longer to launch the kernels than the
    GPU to run them. So a kernel that is loaded already is launched with as little work as possible.

    Args:
        kernel: the function under `triton.jit`.
        grid: number of programs along up to three axes; nothing is done if one of them is 0.
        arguments: the non-constant ones: contiguous tensors, 32-bit integers and floats.
        warps, stages: of Triton's options.
        constants: the `tl.constexpr` arguments.
    """
    if 0 in grid:
        return
    if INTERPRETED:
        seen[variant_of(kernel, arguments, constants, warps=warps, stages=stages)] = None
        kernel[grid](*arguments, **constants)
        return
    device = next(value.get_device() for value in arguments if isinstance(value, Tensor))
    if device != torch.cuda.current_device():
        with torch.cuda.device(device):
            launch(kernel, grid, *arguments, warps=warps, stages=stages, **constants)
        return
    if device in _with_triton:
        kernel[grid](*arguments, **constants, num_warps=warps, num_stages=stages)
        return
    values, kinds = [], []
    for value in arguments:
        if isinstance(value, Tensor):
            assert value.is_contiguous()
            assert value.get_device() == device
            address = value.data_ptr()
            values.append(address)
            kinds.append((value.dtype, address % ALIGNMENT == 0))
        else:
            values.append(value)
            kinds.append(isinstance(value, int))
    key = (kernel.fn, device, *kinds, *constants.items(), warps, stages)
    function = _loaded.get(key)
    if function is None:
        variant = variant_of(kernel, arguments, constants, warps=warps, stages=stages)
        function = _loaded[key] = _load(variant, device)
    function.launch(grid, values, _stream(device))


def choose_launcher(device: torch.device) -> str | None:
    """Find out with a small test kernel how kernels can be launched on a device, and remember it for `launch`.

    Returns:
        None, or why they cannot be launched at all.
    """
    capability = torch.cuda.get_device_capability(device)
    if capability < LEAST_CAPABILITY:
        return f"it has compute capability {capability[0]}.{capability[1]}, and 8.0 or newer is needed"
    if tuple(int(part) for part in triton.__version__.split(".")[:2]) < LEAST_TRITON:
        return f"Triton {triton.__version__} is too old, 3.6 or newer is needed"
    failures = []
    for change in (_with_triton.discard, _with_triton.add):
        change(_number(device))
        try:
            if _counts(device):
                return None
            failures.append("wrong numbers")
        except Exception as error:  # any error: this launcher cannot be used
            failures.append(f"{type(error).__name__}: {error}".splitlines()[0])
    return f"kernels cannot be launched by the driver ({failures[0]}), nor by Triton ({failures[1]})"


def blocks(count: int, size: int) -> int:
    """Return the number of blocks of `size` items that hold `count` items."""
    return -(-count // size)


def launcher(device: torch.device) -> str:
    """Return what launches kernels on a device: "CUDA driver" or "Triton"."""
    return "Triton" if _number(device) in _with_triton else "CUDA driver"


def _number(device: torch.device) -> int:
    with torch.cuda.device(device):
        return torch.cuda.current_device()


def variant_of(
    kernel: Any, arguments: tuple[Tensor | float, ...], constants: dict[str, Any], *, warps: int, stages: int
) -> Variant:
    """Return the variant of a kernel that takes these arguments."""
    types, aligned = [], []
    for number, value in enumerate(arguments):
        if isinstance(value, Tensor):
            assert value.is_contiguous()
            types.append(f"*{TYPES[value.dtype]}")
            if value.data_ptr() % ALIGNMENT == 0:
                aligned.append(number)
        else:
            types.append("i32" if isinstance(value, int) else "fp32")
    fixed = tuple((name, value.compiled if isinstance(value, Size) else value) for name, value in constants.items())
    return Variant(kernel, tuple(types), tuple(aligned), fixed, warps, stages)


def _load(variant: Variant, device: int) -> driver.Function:
    major, minor = torch.cuda.get_device_capability(device)
    return driver.load(cubin.compiled(variant, 10 * major + minor), device)


def _stream(device: int) -> int:
    """Return the handle of torch's current stream; `torch.cuda.current_stream` makes an object first, in 10 us."""
    return torch._C._cuda_getCurrentRawStream(device)


@jit
def _count(out, first, step, count, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    tl.store(out + i, first + i * step, mask=i < count)


def _counts(device: torch.device) -> bool:
    """Return whether a small test kernel gives the right numbers on a device."""
    out = torch.zeros(100, device=device)
    launch(_count, (3,), out, 7, 0.5, 90, BLOCK=32)
    expected = torch.where(torch.arange(100) < 90, 7 + 0.5 * torch.arange(100), 0.0)
    return torch.equal(out.cpu(), expected)
