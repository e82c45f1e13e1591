"""Memory that a process keeps for its next arrays: counted by the system, as page faults."""

import ctypes
import subprocess
import sys

import pytest

from nerfcli.machine import keep_freed_memory, return_freed_memory

_MEGABYTE = 2**20
# Arrays of 40 MB are allocated and freed: the system provides cleared pages for each, or none if memory is kept.
_PROGRAM = """
import os, resource
from nerfcli.machine import keep_freed_memory, resident_bytes, return_freed_memory
{keep}
def work():
    for _ in range(10):
        bytearray(40 * 2**20)
work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
work()
faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
resident = resident_bytes(os.getpid())
return_freed_memory()
print(faults, resident, resident_bytes(os.getpid()))
"""


def _measured(keep: str) -> list[int]:
    program = _PROGRAM.format(keep=keep)
    out = subprocess.run([sys.executable, "-c", program], check=True, stdout=subprocess.PIPE, text=True).stdout
    return [int(number) for number in out.split()]


def test_freed_memory_is_used_again_without_page_faults_until_it_is_returned():
    if not hasattr(ctypes.CDLL(None), "mallopt"):
        pytest.skip("the C library is not glibc")
    faults, kept, returned = _measured("assert keep_freed_memory()")
    assert faults < 100
    assert returned < kept - 30 * _MEGABYTE
    assert _measured("")[0] > 1000  # without it


def _no_library(name: None) -> object:
    raise TypeError("LoadLibrary() argument 1 must be str, not None")


@pytest.mark.parametrize("load", [lambda name: object(), _no_library], ids=["musl", "windows"])
def test_another_c_library_is_left_alone(load, monkeypatch):
    monkeypatch.setattr("ctypes.CDLL", load)
    assert not keep_freed_memory()
    return_freed_memory()
