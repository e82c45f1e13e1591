"""The CUDA driver library: loads machine code and starts it.

The few functions used here have had this interface for many years.
Source: CUDA Driver API, sections Primary Context, Context, Module and Execution Control.
"""

import ctypes
import functools
import struct
import threading
from collections.abc import Sequence
from typing import Any

from nerfcli.kernels.triton_cuda.cubin import Cubin

LIBRARY = "libcuda.so.1"
Extras = ctypes.c_void_p * 5

_of_thread = threading.local()


class DriverError(Exception):
    """A function of the driver failed."""


class Function:
    """A kernel on a device."""

    def __init__(self, handle: ctypes.c_void_p, cubin: Cubin, device: int):
        self._handle, self._device = handle, device
        self._parameters = struct.Struct(f"@{cubin.formats}")
        self._count = len(cubin.formats)
        self._buffer = ctypes.c_char * self._parameters.size
        self._size = ctypes.c_size_t(self._parameters.size)
        self._threads, self._shared_bytes = 32 * cubin.warps, cubin.shared_bytes

    def launch(self, grid: tuple[int, ...], values: Sequence[float], stream: int) -> None:
        """Enqueue the kernel on a stream.

        Args:
            grid: programs along up to three axes.
            values: addresses and numbers, in the order of the parameters; parameters that Triton appends are set to 0.
            stream: handle of a stream of the device.
        """
        _bind(self._device)
        x, y, z = (*grid, 1, 1)[:3]
        # One buffer with the layout of a C struct: the driver refuses it if it is not as large as the parameters.
        packed = self._buffer.from_buffer_copy(
            self._parameters.pack(*values, *(0,) * (self._count - len(values)))
        )  # fmt: skip
        buffer, buffer_size, end = 1, 2, 0  # the keys of this list
        extra = Extras(buffer, ctypes.addressof(packed), buffer_size, ctypes.addressof(self._size), end)
        shape = (x, y, z, self._threads, 1, 1, self._shared_bytes)
        call("cuLaunchKernel", self._handle, *shape, ctypes.c_void_p(stream), None, extra)


def load(cubin: Cubin, device: int) -> Function:
    """Load a kernel onto a device, for the lifetime of the process.

    Raises:
        DriverError: the driver cannot load it.
    """
    _bind(device)
    module, handle = ctypes.c_void_p(), ctypes.c_void_p()
    call("cuModuleLoadData", ctypes.byref(module), cubin.code)
    call("cuModuleGetFunction", ctypes.byref(handle), module, cubin.name.encode())
    if cubin.shared_bytes > 48 * 1024:  # more has to be requested
        max_dynamic_shared_size_bytes = 8
        call("cuFuncSetAttribute", handle, max_dynamic_shared_size_bytes, cubin.shared_bytes)
    return Function(handle, cubin, device)


def version() -> str:
    """Return the newest version of CUDA that the driver supports."""
    number = ctypes.c_int()
    call("cuDriverGetVersion", ctypes.byref(number))
    return f"{number.value // 1000}.{number.value % 1000 // 10}"


def call(name: str, *arguments: Any) -> None:
    """Call a function of the driver.

    Raises:
        DriverError: it returned an error.
        OSError: there is no driver.
    """
    result = getattr(library(), name)(*arguments)
    if result != 0:
        raise DriverError(f"{name} returned error {result}")


@functools.cache
def library() -> ctypes.CDLL:
    """Return the driver library."""
    return ctypes.CDLL(LIBRARY)


def _bind(device: int) -> None:
    """Make torch's context of a device current in this thread: threads of autograd may not have it yet."""
    bound: set[int] = _of_thread.__dict__.setdefault("bound", set())
    if device not in bound:
        number, context = ctypes.c_int(), ctypes.c_void_p()
        call("cuDeviceGet", ctypes.byref(number), device)
        call("cuDevicePrimaryCtxRetain", ctypes.byref(context), number)
        call("cuCtxSetCurrent", context)
        bound.add(device)
