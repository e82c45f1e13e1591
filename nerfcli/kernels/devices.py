"""Description of a machine: its GPUs, its versions, and the backend that runs on each device."""

import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import torch

from nerfcli import kernels
from nerfcli.version import __version__


def describe_machine(processors: int) -> dict[str, Any]:
    """Return the GPUs, the versions and the backend that runs on each device, as plain values.

    Args:
        processors: number of processors that this process may use.
    """
    described: dict[str, Any] = {
        "nerfcli": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "triton": _version("triton"),
        "system": f"{platform.system()} {platform.machine()}",
        "processors": processors,
        "backend on cpu": kernels.backend_for(torch.device("cpu"), torch.float32).name,
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
        why_not = kernels.triton_unavailable_reason(device)
        described[f"backend on {device}"] = (
            f"triton_cuda, launched by {kernels.gpu_launcher(device)}"
            if why_not is None
            else f"reference, because {why_not}"
        )
    return {**described, "cuda of torch": torch.version.cuda, "cuda of the driver": kernels.driver_version()}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
