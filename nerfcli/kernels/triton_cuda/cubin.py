"""Machine code of kernels: compiled by Triton with the ptxas in its package, and cached on disk.

The cache is in the user's cache folder, or in NERFCLI_KERNEL_CACHE. A file is named by two digests: of the sources of
all kernels and the versions of Triton and Python; and of the variant and the architecture. So nothing outdated is ever
loaded. Beyond `MOST_BYTES`, the least recently used files are removed. Several processes may use the cache at once:
files appear whole, and a file that another process has removed is compiled again.
"""

import functools
import hashlib
import json
import os
import platform
import re
import sys
import tempfile
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import triton

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError


class Variant(NamedTuple):
    """A kernel with the argument types and constants for which it is compiled.

    Args:
        kernel: the function under `triton.jit`.
        types: of the non-constant arguments, in order.
        aligned: indices of the pointers that are multiples of `launch.ALIGNMENT`, among these arguments.
        constants: names and values.
        warps, stages: of Triton's options.
    """

    kernel: Any
    types: tuple[str, ...]
    aligned: tuple[int, ...]
    constants: tuple[tuple[str, Any], ...]
    warps: int
    stages: int


@dataclass(frozen=True)
class Cubin:
    """A compiled kernel.

    Args:
        name: of the entry in the machine code.
        code: machine code for the driver.
        ptx: the PTX from which the code was assembled.
        formats: letters of `struct` for the parameters, including those that Triton appends, whose values are 0.
        warps: per program.
        shared_bytes: dynamic shared memory per program.
    """

    name: str
    code: bytes
    ptx: str
    formats: str
    warps: int
    shared_bytes: int


class UnexpectedCodeError(Exception):
    """A kernel compiled by Triton cannot be launched by `driver`."""


# Letters of `struct` for the parameter types of PTX, and for those of Triton's signatures.
_FORMATS = {"u64": "Q", "b64": "Q", "u32": "I", "b32": "I", "f32": "f"}
_OF_TYPES = {"i32": "i", "i64": "q", "fp32": "f"}
# Room for several versions of the kernels; one version takes about 5 MB.
MOST_BYTES = 2**26
# Maximum number of parameters that Triton appends: unused pointers to scratch memory.
_MOST_EXTRA = 3


def compiled(variant: Variant, capability: int) -> Cubin:
    """Return the machine code of a variant for a compute capability such as 90, from the disk if it is there.

    Raises:
        UnexpectedCodeError: as compiled by this version of Triton, it needs something that is not passed.
    """
    path = folder() / f"{_environment()}-{_digest(variant, capability)}.cubin"
    try:
        head, ptx, code = path.read_bytes().split(b"\0\0\0\0", 2)
        built = Cubin(code=code, ptx=ptx.decode(), **json.loads(head))
        with suppress(OSError):  # the folder may belong to another user
            path.touch()
        return built
    except (OSError, ValueError):  # not there, or damaged
        built = compile_now(variant, capability)
    described = {name: value for name, value in asdict(built).items() if name not in ("code", "ptx")}
    try:
        with atomic_path(path) as partial:
            partial.write_bytes(b"\0\0\0\0".join([json.dumps(described).encode(), built.ptx.encode(), built.code]))
    except UserError:  # the disk is full: it is compiled again next time
        pass
    _prune(path.parent)
    return built


def is_compiled() -> bool:
    """Return whether machine code of the current kernels is on the disk."""
    return any(folder().glob(f"{_environment()}-*.cubin"))


def compile_now(variant: Variant, capability: int) -> Cubin:
    """Compile a variant as `compiled` does, without the cache on disk."""
    from triton import knobs
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    constants = dict(variant.constants)
    names = [name for name in variant.kernel.arg_names if name not in constants]
    source = ASTSource(
        fn=variant.kernel,
        signature={
            name: "constexpr" if name in constants else variant.types[names.index(name)]
            for name in variant.kernel.arg_names
        },
        constexprs=constants,
        attrs={
            (variant.kernel.arg_names.index(names[number]),): [["tt.divisibility", 16]] for number in variant.aligned
        },
    )
    options = {"num_warps": variant.warps, "num_stages": variant.stages, "enable_fp_fusion": True}
    with knobs.cache.scope(), tempfile.TemporaryDirectory() as scratch:
        knobs.cache.dir = scratch  # Triton would keep every intermediate form, for ever
        binary = triton.compile(source, target=GPUTarget("cuda", capability, 32), options=options)
    if binary.metadata.global_scratch_size or binary.metadata.profile_scratch_size:
        raise UnexpectedCodeError("it needs scratch memory")
    return Cubin(
        name=binary.metadata.name,
        code=binary.asm["cubin"],
        ptx=binary.asm["ptx"],
        formats=_formats(binary.asm["ptx"], variant.types),
        warps=binary.metadata.num_warps,
        shared_bytes=binary.metadata.shared,
    )


def folder() -> Path:
    """Return the folder of the cache."""
    chosen = os.environ.get("NERFCLI_KERNEL_CACHE")
    return Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nerfcli"


def _formats(ptx: str, types: tuple[str, ...]) -> str:
    """Return the parameters of the only entry: the arguments, then at most `_MOST_EXTRA` pointers."""
    entry = re.search(r"\.entry\s+\w+\s*\((.*?)\)", ptx, re.DOTALL)
    found = re.findall(r"\.param\s+\.(\w+)", entry[1]) if entry else []
    wanted = ["Q" if name.startswith("*") else _OF_TYPES[name] for name in types]
    sizes = {"i": "I", "q": "Q"}
    given = [_FORMATS.get(name, "?") for name in found]
    own = [sizes.get(letter, letter) for letter in wanted]
    extra = given[len(own) :]
    # A float is declared as .f32 or .b32.
    fits = all(a == b or (a, b) == ("I", "f") for a, b in zip(given, own, strict=False))
    if not fits or len(given) < len(own) or len(extra) > _MOST_EXTRA or any(letter != "Q" for letter in extra):
        raise UnexpectedCodeError(f"its parameters are {', '.join(found)}")
    return "".join(wanted) + "Q" * len(extra)


def _prune(place: Path) -> None:
    """Remove the least recently used files beyond `MOST_BYTES`."""
    found = []
    for path in place.glob("[!.]*.cubin"):  # another process is writing those with a dot
        with suppress(OSError):  # another process has removed it
            found.append((path.stat().st_mtime, path.stat().st_size, path))
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= MOST_BYTES:
            return
        with suppress(OSError):
            path.unlink()
        total -= size


def _digest(variant: Variant, capability: int) -> str:
    described = (variant.kernel.__module__, variant.kernel.__name__, *variant[1:], capability)
    return hashlib.blake2b(str(described).encode(), digest_size=20).hexdigest()


@functools.cache
def _environment() -> str:
    """Return a digest of the sources of the kernels and the versions of Triton and Python."""
    versions = f"{triton.__version__} {sys.version_info[:2]} {platform.machine()}"
    content = hashlib.blake2b(versions.encode(), digest_size=8)
    for path in sorted(Path(__file__).parent.parent.rglob("*.py")):  # kernels have constants of the reference
        content.update(path.name.encode() + b"\0" + path.read_bytes())
    return content.hexdigest()
