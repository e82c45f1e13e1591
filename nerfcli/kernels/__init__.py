"""The hot operations of the program behind one interface: `reference` defines them, faster backends agree with it.

A backend is chosen once per training or model, from the device, the precision and the size of its field.
"""

import functools
import importlib
import platform
import warnings
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from types import ModuleType
from typing import Any

import torch

from nerfcli import __version__
from nerfcli.interrupts import deferred_interrupts
from nerfcli.kernels.composition import Backend
from nerfcli.kernels.contraction import CONTRACTIONS, contract, grid_coordinates
from nerfcli.kernels.harmonics import spherical_harmonics
from nerfcli.kernels.interface import (
    AdamStep,
    BearingGrids,
    HashGrid,
    Intervals,
    March,
    Medium,
    PixelTable,
    Rays,
    RaysSeen,
    RaySums,
    RayTermination,
    Targets,
    TraceOptions,
)
from nerfcli.kernels.reference import distances_to_occupied, ray_indices, sum_along_rays


def backend_for(device: torch.device, dtype: torch.dtype) -> Backend:
    """Choose the fastest backend that supports a field, and warn once if the fast one of its device does not work."""
    # float64 fields are for comparison with the reference: no warning is due that they run on plain torch.
    if device.type == "cuda" and dtype != torch.float64:
        why_not = triton_unavailable_reason(device)
        if why_not is None and dtype == torch.float32:
            from nerfcli.kernels.triton_cuda.backend import TritonBackend

            return TritonBackend(device)
        if torch.cuda.is_available():
            _warn_of_slow_gpu(why_not or f"float32 is supported, not {str(dtype).removeprefix('torch.')}")
    if device.type == "cpu" and dtype == torch.float32 and _numba_cpu() is not None:
        from nerfcli.kernels.numba_cpu.backend import NumbaBackend

        return NumbaBackend(device)
    return Backend(device)


def triton_unavailable_reason(device: torch.device) -> str | None:
    """Return why the GPU kernels do not work on a CUDA device; None if they do."""
    if device.type != "cuda":
        return "they are for CUDA devices"
    if not torch.cuda.is_available():
        return "torch finds no CUDA device"
    return _why_not_triton(device.index if device.index is not None else torch.cuda.current_device())


def gpu_launcher(device: torch.device) -> str:
    """Return "CUDA driver" or "Triton": what launches the GPU kernels on a device where they work."""
    from nerfcli.kernels.triton_cuda.launch import launcher

    return launcher(device)


def driver_version() -> str:
    """Return the newest version of CUDA that the driver supports, or "unknown"."""
    try:
        from nerfcli.kernels.triton_cuda.driver import DriverError, version
    except ImportError:
        return "unknown"
    try:
        return version()
    except (OSError, DriverError):
        return "unknown"


def has_compiled() -> bool:
    """Return whether the compiled CPU kernels work on this machine."""
    return _numba_cpu() is not None


def thread_safe() -> bool:
    """Return whether several threads may call the CPU kernels at the same time; not every threading layer allows it."""
    numba_cpu = _numba_cpu()
    return numba_cpu is None or numba_cpu.thread_safe()


def prepare(notify: Callable[[str], None], device: str = "cpu") -> None:
    """Compile the kernels for a device, once per machine, before any time budget starts to run."""
    wanted = torch.device(device)
    if backend_for(wanted, torch.float32).name == "triton_cuda":
        from nerfcli.kernels.triton_cuda.cubin import is_compiled
        from nerfcli.kernels.triton_cuda.warm_up import warm_up

        if not is_compiled():
            notify("compiling the GPU kernels (once per machine, about a minute)")
        warm_up(wanted)
        return
    numba_cpu = _numba_cpu()
    if numba_cpu is not None:
        if not numba_cpu.is_compiled():
            notify("compiling the CPU kernels (once per machine, about a minute)")
        _warm_up_cpu()


@functools.cache
def _warm_up_cpu() -> None:
    """Compile or load the CPU kernels, once per process: each time takes 0.1 s."""
    numba_cpu = _numba_cpu()
    assert numba_cpu is not None
    numba_cpu.warm_up()


@functools.cache
def _why_not_triton(index: int) -> str | None:
    try:
        from nerfcli.kernels.triton_cuda import launch
    except ImportError as error:
        return f"Triton does not work on this machine ({error})"
    return launch.choose_launcher(torch.device("cuda", index))


@functools.cache
def _warn_of_slow_gpu(reason: str) -> None:
    warnings.warn(
        f"the GPU kernels cannot be used ({reason}); using plain torch, which is many times slower", stacklevel=3
    )


@functools.cache
def _numba_cpu() -> ModuleType | None:
    """Return the CPU kernels, or None with one warning where Numba does not work.

    Raises:
        KeyboardInterrupt: Ctrl-C or SIGTERM came meanwhile. Raised at once, C code of Numba might swallow it, or fail.
    """
    kernels, failure = None, None
    with deferred_interrupts() as interrupts:
        try:
            kernels = importlib.import_module("nerfcli.kernels.numba_cpu")
        except ImportError as error:
            failure = error
    interrupts.raise_if_pending()
    if failure is not None:
        warnings.warn(
            f"Numba does not work on this machine ({failure}); using plain torch instead, which is much slower",
            stacklevel=3,
        )
    return kernels


def describe_machine(processors: int) -> dict[str, Any]:
    """Return the GPUs, the versions and the backend that runs on each device, as plain values."""
    described: dict[str, Any] = {
        "nerfcli": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "triton": _version("triton"),
        "system": f"{platform.system()} {platform.machine()}",
        "processors": processors,
        "backend on cpu": backend_for(torch.device("cpu"), torch.float32).name,
    }
    if not torch.cuda.is_available():
        return {**described, "cuda": "torch finds no CUDA device"}
    for index in range(torch.cuda.device_count()):
        device = torch.device("cuda", index)
        properties = torch.cuda.get_device_properties(device)
        gigabytes = properties.total_memory / 1e9
        described[str(device)] = (
            f"{properties.name}, {gigabytes:.0f} GB, compute capability {properties.major}.{properties.minor}"
        )
        why_not = triton_unavailable_reason(device)
        described[f"backend on {device}"] = (
            f"triton_cuda, launched by {gpu_launcher(device)}" if why_not is None else f"reference, because {why_not}"
        )
    return {**described, "cuda of torch": torch.version.cuda, "cuda of the driver": driver_version()}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
