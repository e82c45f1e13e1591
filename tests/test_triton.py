"""The GPU kernels without a GPU: their numbers in Triton's interpreter, their machine code, and how they are launched.

Triton reads TRITON_INTERPRET when it is imported, so interpreted kernels run in a separate process.
"""

import ctypes
import json
import os
import re
import struct
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from present import present

pytest.importorskip("triton", reason="Triton is for Linux")

import triton
from triton.backends import nvidia
from triton.runtime.jit import JITFunction

from nerfcli.kernels.triton_cuda import cubin, driver, launch
from nerfcli.kernels.triton_cuda.cubin import Cubin, UnexpectedCodeError, compiled
from nerfcli.kernels.triton_cuda.launch import Variant

HERE = Path(__file__).parent
# The first replaces parts of Triton's interpreter by faster ones, for both.
SUITE = (sys.executable, "-m", "pytest", "-p", "no:cacheprovider", HERE / "triton_kernels.py", HERE / "test_kernels.py")
CUOBJDUMP, NVDISASM = (Path(nvidia.__file__).parent / "bin" / name for name in ("cuobjdump", "nvdisasm"))
CPU = torch.device("cpu")
# Shared memory of an Ampere, Ada or Blackwell desktop card, in bytes per program.
MOST_SHARED = 99 * 1024


class Interpreted(NamedTuple):
    """The tests of the GPU kernels in the interpreter: exit code, output, and the variants that they launched."""

    code: int
    output: str
    variants: list[Variant]


def run_suite(*options: str, **variables: str) -> "subprocess.CompletedProcess[str]":
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    environment |= {"NERFCLI_KERNELS": "triton_cuda", **variables}
    command = [*map(str, SUITE), *options]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, cwd=HERE.parent)


@pytest.fixture(scope="module")
def interpreted(tmp_path_factory: pytest.TempPathFactory) -> Interpreted:
    path = tmp_path_factory.mktemp("triton") / "variants.json"
    done = run_suite("-x", TRITON_INTERPRET="1", NERFCLI_VARIANTS=str(path))
    listed = json.loads(path.read_text()) if path.is_file() else []
    variants = [
        Variant(
            getattr(import_module(module), name), tuple(types), tuple(aligned), tuple(map(tuple, constants)), *options
        )
        for module, name, types, aligned, constants, *options in listed
    ]
    return Interpreted(done.returncode, done.stdout + done.stderr, variants)


@pytest.fixture
def kernel_cache(pytestconfig: pytest.Config, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Keep machine code from one run of the tests to the next."""
    kept = pytestconfig.cache.mkdir("kernels") if hasattr(pytestconfig, "cache") and pytestconfig.cache else tmp_path
    monkeypatch.setenv("NERFCLI_KERNEL_CACHE", str(kept))
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path / "triton"))  # Triton's own cache keeps every intermediate form


def test_kernels_agree_with_the_reference_in_the_interpreter(interpreted):
    assert interpreted.code == 0, interpreted.output


def spilled_bytes(path: Path) -> int:
    """Return how many bytes of a thread's registers are spilled to memory."""
    text = subprocess.run([CUOBJDUMP, "-res-usage", path], capture_output=True, text=True, check=True).stdout
    found = re.search(r"STACK:(\d+)", text)
    assert found, text[:500]
    return int(found[1])


def instructions_of(paths: list[Path]) -> list[str]:
    """Return the instructions of each kernel, of one generation. The disassembler starts in 0.4 s: once for all."""
    extracted: list[tuple[int, bytes]] = []
    architectures = set()
    for number, path in enumerate(paths):
        folder = path.with_name(f"{path.stem}-instructions")
        folder.mkdir()
        subprocess.run([CUOBJDUMP, "-xtext", "all", path], capture_output=True, check=True, cwd=folder)
        for part in folder.iterdir():
            extracted.append((number, part.read_bytes()))
            architectures.add(part.name.rsplit(".", 3)[1].replace("sm_", "SM"))
    (architecture,) = architectures
    together = paths[0].with_name("instructions")
    together.write_bytes(b"".join(content for _, content in extracted))
    command = [NVDISASM, "--binary", architecture, together]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    of_address = {int(found[1], 16): line for line in lines if (found := re.match(r"\s*/\*([0-9a-f]+)\*/", line))}
    texts, start = [""] * len(paths), 0
    for number, content in extracted:
        own = [line for address, line in of_address.items() if start <= address < start + len(content)]
        assert len(own) * 16 == len(content)  # all are read: an instruction has 128 bits
        texts[number] += "\n".join(own)
        start += len(content)
    assert all(texts)
    return texts


@pytest.mark.gpu
def test_kernels_agree_with_the_reference_on_a_gpu():
    """Run twice, as a race between two programs may give the right result by chance."""
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    for _ in range(2):
        done = run_suite()
        assert done.returncode == 0, done.stdout + done.stderr


ALL, EACH, HOTTEST = "all", "each", "hottest"


@pytest.mark.parametrize(
    ("capability", "which"),
    [
        *((90, EACH), (80, HOTTEST)),
        *(pytest.param(capability, ALL, marks=pytest.mark.slow) for capability in (80, 90, 120)),
    ],
)
def test_kernels_compile_within_the_limits_of_each_generation(interpreted, kernel_cache, capability, which, tmp_path):
    """Check what the interpreter cannot: types, shared memory, spilled registers, vector instructions, tensor cores."""
    assert len(interpreted.variants) > 40, interpreted.output
    disassembled: list[tuple[Variant, Path]] = []
    sizes = set()
    chosen = {ALL: list, EACH: each, HOTTEST: hottest}[which](interpreted.variants)
    for number, variant in enumerate(chosen):
        built = compiled(variant, capability)
        name, path = variant.kernel.fn.__name__, tmp_path / f"{number}.cubin"
        assert built.shared_bytes <= MOST_SHARED, name
        path.write_bytes(built.code)
        if built.formats not in sizes:
            # The driver refuses a launch whose buffer has another size than the parameters.
            assert parameter_bytes(path) == struct.calcsize(f"@{built.formats}"), name
            sizes.add(built.formats)
        if is_network_s_backward(variant) or name in ("_encode", "_encode_backward", "_points_backward"):
            disassembled.append((variant, path))
    texts = instructions_of([path for _, path in disassembled])
    for (variant, path), text in zip(disassembled, texts, strict=True):
        name, spilled = variant.kernel.fn.__name__, spilled_bytes(path)
        if is_network_s_backward(variant):  # all sums of the weights' gradients are in registers
            assert spilled <= (160 if dict(variant.constants)["H"] == 32 else 700)
            assert len(re.findall(r"HGMMA|HMMA", text)) > 30
        else:
            assert spilled == 0, name
        if name == "_encode_backward" and capability >= 90:
            assert len(re.findall(r"REDG?\.E\.ADD\.F32x4", text)) == 8  # one for each corner
        if name == "_encode":
            width = 64 if "*fp16" in variant.types[2] else 128
            assert len(re.findall(rf"LDG\.E\.{width}", text)) >= 8, name


def is_network_s_backward(variant: Variant) -> bool:
    return variant.kernel.fn.__name__ == "_backward" and "H" in dict(variant.constants)


def each(variants: list[Variant]) -> list[Variant]:
    """Return one variant of every kernel, another one for colours without directions, and all of the hottest ones."""
    first = {(variant.kernel, dict(variant.constants).get("DEGREE") == 0): variant for variant in reversed(variants)}
    return [*first.values(), *(variant for variant in hottest(variants) if variant not in first.values())]


def hottest(variants: list[Variant]) -> list[Variant]:
    """Return the kernels that take most of a step, one variant each, for networks of the default width."""
    chosen: dict[tuple[str, str], Variant] = {}
    for variant in variants:
        module, name = variant.kernel.fn.__module__.rpartition(".")[2], variant.kernel.fn.__name__
        half = name != "_encode" or "*fp16" in variant.types
        if module in ("hash_grid", "networks") and dict(variant.constants).get("H", 32) == 32 and half:
            chosen.setdefault((module, name), variant)
    return list(chosen.values())


def parameter_bytes(path: Path) -> int:
    """Return the size of the parameters that the machine code states."""
    text = subprocess.run([CUOBJDUMP, "-elf", path], capture_output=True, text=True, check=True).stdout
    found = re.search(r"EIATTR_CBANK_PARAM_SIZE\s+Format:\s+EIFMT_HVAL\s+Value:\s+(0x[0-9a-f]+)", text)
    assert found, text[:500]
    return int(found[1], 16)


class FakeDriver:
    """A fake driver library, which records its calls and fails on request."""

    def __init__(self, failing: str = "", error: int = 0):
        self.calls: list[str] = []
        self.launches: list[dict[str, Any]] = []
        self.failing, self.error = failing, error
        self.formats = ""

    def __getattr__(self, name: str):
        def function(*arguments: Any) -> int:
            self.calls.append(name)
            if name == self.failing:
                return self.error
            if name == "cuLaunchKernel":
                self.note_launch(*arguments)
            return 0

        return function

    def note_launch(self, handle, x, y, z, threads, ty, tz, shared, stream, params, extra) -> None:
        assert params is None
        assert (extra[0], extra[2], extra[4]) == (1, 2, None)
        size = ctypes.c_size_t.from_address(extra[3]).value
        seen = {"grid": (x, y, z), "threads": (threads, ty, tz), "shared": shared, "stream": stream.value}
        self.launches.append({**seen, "buffer": ctypes.string_at(extra[1], size)})


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Callable[..., FakeDriver]:
    """Make torch report a GPU and replace the driver by a fake; tensors are on the CPU."""

    def install(failing: str = "", error: int = 0, *, capability: tuple[int, int] = (9, 0)) -> FakeDriver:
        fake = FakeDriver(failing, error)
        monkeypatch.setattr(driver, "library", lambda: fake)
        monkeypatch.setattr(driver, "_of_thread", threading.local())
        monkeypatch.setattr(launch, "_loaded", {})
        monkeypatch.setattr(launch, "_with_triton", set())
        monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
        monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device=None: capability)
        monkeypatch.setattr(torch.Tensor, "get_device", lambda tensor: 1)
        monkeypatch.setattr(launch, "_stream", lambda device: 4711)
        return fake

    return install


def test_a_launch_gives_the_driver_what_the_kernel_expects(install, kernel_cache):
    fake = install()
    out = torch.zeros(100)
    for _ in range(2):
        launch.launch(launch._count, (3, 2), out, 7, 0.5, 90, BLOCK=32)
    assert fake.launches[0] == fake.launches[1]
    seen = fake.launches[0]
    assert (seen["grid"], seen["threads"], seen["stream"]) == ((3, 2, 1), (128, 1, 1), 4711)
    # Pointer, 7, 0.5, 90, and the two pointers that Triton adds.
    assert struct.unpack("@QifiQQ", seen["buffer"]) == (out.data_ptr(), 7, 0.5, 90, 0, 0)
    # Loaded once, in the context of torch, which this thread may not have had yet.
    once = ["cuDeviceGet", "cuDevicePrimaryCtxRetain", "cuCtxSetCurrent", "cuModuleLoadData", "cuModuleGetFunction"]
    assert fake.calls == [*once, "cuLaunchKernel", "cuLaunchKernel"]


def test_large_shared_memory_is_requested(install):
    fake = install()
    built = Cubin("kernel", b"code", "", "Q", 8, 60_000)
    driver.load(built, 0).launch((5,), [12], 0)
    assert "cuFuncSetAttribute" in fake.calls
    assert fake.launches[0]["shared"] == 60_000
    assert fake.launches[0]["threads"] == (256, 1, 1)


def test_nothing_is_launched_for_nothing(install):
    fake = install()
    launch.launch(launch._count, (0,), torch.zeros(0), 7, 0.5, 0, BLOCK=32)
    assert fake.calls == []


def test_what_is_not_aligned_is_compiled_for_that(install, monkeypatch):
    install()
    variants = []
    monkeypatch.setattr(launch, "_load", lambda variant, device: variants.append((variant.aligned, device)))
    for tensor in (torch.zeros(8), torch.zeros(9)[1:]):
        with pytest.raises(AttributeError):  # nothing was loaded
            launch.launch(launch._count, (1,), tensor, 7, 0.5, 8, BLOCK=32)
    assert variants == [((0,), 1), ((), 1)]


def test_an_error_of_the_driver_is_named(install, kernel_cache):
    install("cuLaunchKernel", 701)
    with pytest.raises(driver.DriverError, match="cuLaunchKernel returned error 701"):
        launch.launch(launch._count, (1,), torch.zeros(4), 7, 0.5, 4, BLOCK=32)


def test_old_devices_are_refused(install):
    install(capability=(7, 5))
    assert launch.choose_launcher(CPU) == "it has compute capability 7.5, and 8.0 or newer is needed"


def test_an_old_triton_is_refused(install, monkeypatch):
    install()
    monkeypatch.setattr(triton, "__version__", "3.5.1")
    assert launch.choose_launcher(CPU) == "Triton 3.5.1 is too old, 3.6 or newer is needed"


def test_each_device_has_its_own_launcher(install, kernel_cache, monkeypatch):
    """A device on which no launcher works does not affect the others."""
    install()
    monkeypatch.setattr(launch, "_counts", lambda device: torch.cuda.current_device() == 1)
    assert launch.choose_launcher(CPU) is None
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 2)
    assert launch.choose_launcher(CPU) is not None
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    assert launch.launcher(CPU) == "CUDA driver"


def test_a_device_on_which_neither_way_works_is_refused_with_both_reasons(install, kernel_cache, monkeypatch):
    """Here the fake driver computes nothing, and Triton's launcher finds no driver."""
    install()
    reason = present(launch.choose_launcher(CPU))
    assert re.match(r"kernels cannot be launched by the driver \(wrong numbers\), nor by Triton \(.*", reason)
    install("cuModuleLoadData", 200)
    assert "DriverError: cuModuleLoadData returned error 200" in str(launch.choose_launcher(CPU))


def test_triton_launches_where_the_driver_cannot(install, kernel_cache, monkeypatch):
    install("cuLaunchKernel", 1)

    def counts(self, *arguments, grid, warmup, **named):
        out, first, step, count = arguments
        out[:count] = first + step * torch.arange(count)

    monkeypatch.setattr(JITFunction, "run", counts)
    assert launch.choose_launcher(CPU) is None
    assert launch.launcher(CPU) == "Triton"


def counting() -> Variant:
    return launch.variant_of(launch._count, (torch.zeros(4), 7, 0.5, 4), {"BLOCK": 32}, warps=4, stages=1)


def test_machine_code_is_kept_on_disk_and_damage_is_noticed(monkeypatch, tmp_path):
    monkeypatch.setenv("NERFCLI_KERNEL_CACHE", str(tmp_path))
    variant = counting()
    first = compiled(variant, 90)
    (path,) = tmp_path.glob("*.cubin")
    monkeypatch.setattr(cubin, "compile_now", None)
    assert compiled(variant, 90) == first
    with pytest.raises(TypeError):  # another architecture is another file
        compiled(variant, 80)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(TypeError):
        compiled(variant, 90)


def test_a_change_of_a_constant_of_the_reference_outdates_the_machine_code(monkeypatch, tmp_path):
    """Kernels have constants of other folders, such as `MOST_DEVIATION`."""
    monkeypatch.setenv("NERFCLI_KERNEL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(cubin, "__file__", str(tmp_path / "triton_cuda" / "cubin.py"))
    monkeypatch.setattr(cubin, "_environment", cubin._environment.__wrapped__)
    monkeypatch.setattr(cubin, "compile_now", lambda variant, capability: Cubin("kernel", b"c", "p", "Q", 4, 0))
    constants = tmp_path / "reference" / "compositing.py"
    constants.parent.mkdir()
    constants.write_text("MOST_DEVIATION = 0.25\n")
    compiled(counting(), 90)
    assert cubin.is_compiled()
    constants.write_text("MOST_DEVIATION = 0.5\n")
    assert not cubin.is_compiled()


def test_the_cache_is_bounded_and_what_was_used_least_recently_goes_first(monkeypatch, tmp_path):
    """Files of other versions, and those that another process writes or removes at the same time."""
    monkeypatch.setenv("NERFCLI_KERNEL_CACHE", str(tmp_path))
    built = Cubin("kernel", b"c" * 60, "p" * 20, "Q", 4, 0)
    monkeypatch.setattr(cubin, "compile_now", lambda variant, capability: built)
    monkeypatch.setattr(cubin, "MOST_BYTES", 1000)
    for age in range(8):
        path = tmp_path / f"old-{age}.cubin"
        path.write_bytes(b"x" * 200)
        os.utime(path, (1000 - age, 1000 - age))
    (tmp_path / ".new.partial-7.cubin").write_bytes(b"x" * 10_000)
    (tmp_path / "gone.cubin").symlink_to("nowhere")  # as if another process had removed it meanwhile
    variant = counting()
    assert not cubin.is_compiled()
    assert compiled(variant, 90) == compiled(variant, 90) == built
    assert cubin.is_compiled()
    assert {path.name for path in tmp_path.glob("old-*")} == {f"old-{age}.cubin" for age in range(4)}
    assert (tmp_path / ".new.partial-7.cubin").exists()
    os.utime(tmp_path / "old-3.cubin")
    compiled(variant, 80)
    assert {path.name for path in tmp_path.glob("old-*")} == {"old-0.cubin", "old-1.cubin", "old-3.cubin"}


@pytest.mark.parametrize(
    "parameters", [".param .u64 a", ".param .u64 a, .param .u64 b, .param .u32 c", ".param .u32 a"]
)
def test_unexpected_parameters_are_refused(parameters):
    """A later Triton might add parameters; then its own launcher is used."""
    with pytest.raises(UnexpectedCodeError, match="its parameters are"):
        cubin._formats(f".visible .entry kernel({parameters})", ("*fp32", "i64"))
