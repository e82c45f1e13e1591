"""Splats as Niantic's .spz, a fifth of the .ply: versions 2 and 3 are read, version 3 is written.

One gzip stream: a header of 16 bytes, then one array per parameter for all Gaussians: positions (24-bit fixed point),
opacities, colours and logarithmic scales (8 bits), quaternions (the smallest three, 10 bits each; in version 2 x y z
in 8 bits), harmonics (8 bits, written with 7 significant bits: the 5 and 4 of the reference lose 0.5 dB).
The axes are right, up, back: y and z have the opposite signs of a .ply.

Source: https://github.com/nianticlabs/spz, src/cc/load-spz.cc.
"""

import gzip
import math
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError, listed
from nerfcli.ply import comments_of, description_in
from nerfcli.splats.gaussians import Gaussians

_MAGIC, _HEADER = b"NGSP", struct.Struct("<4sIIBBBB")
_ANTIALIASED, _EXTENSIONS = 1, 2
# Flag of a gzip stream for a comment after its header of 10 bytes.
_COMMENT = 16
# An extension that states other axes, and what it says where they are the usual ones: right, up, back.
_OTHER_AXES, _USUAL = 0xADBE0003, 4
# Signs of means, quaternions and harmonics in those axes, relative to a .ply's right, down, front.
_SIGNS = np.array([1.0, -1, -1])
_QUATERNION_SIGNS = np.array([1.0, 1, -1, -1])
_HARMONIC_SIGNS = np.array([1.0, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
# Extensions are descriptions of a few bytes; more than this after the Gaussians is damage.
_MOST_EXTENSIONS = 2**20
# The highest ratio at which deflate can compress: 258 bytes in 2 bits.
_MOST_RATIO = 1032
# Of a colour in steps of 1 / 255, per unit of its harmonic: 0.5 + 0.282 f of 3DGS would leave no room beyond 0 and 1.
_COLOUR = 0.15
_HALF = np.sqrt(0.5)
# Harmonics above degree 0 are rounded to a multiple of this, in units of 1 / 128.
_STEP = 2
# At most 2^-24 units: readers compute 1 << bits in 32 bits, and log scales end at -10 anyway.
_MOST_BITS = 24
# Steps of positions in the middle one of the three standard deviations. All 24 bits make files 12 to 20 % larger.
_STEPS = 16
# Gaussians encoded at a time: temporary arrays of 50 MB.
_ROWS = 2**16


def write_spz(
    path: Path, gaussians: Gaussians, description: Mapping[str, Any] | None, *, notify: Callable[[str], None]
) -> None:
    """Write Gaussians as .spz version 3, atomically; `notify` is called with what is clipped, see `packed`."""
    data, note = packed(gaussians)
    with atomic_path(path) as partial:
        partial.write_bytes(_gzipped(data, description))
    if note:
        notify(f"{path}: {note}")


def read_spz(path: Path, notify: Callable[[str], None]) -> tuple[Gaussians, dict[str, Any]]:
    """Read Gaussians from a .spz of version 2 or 3, and nerfcli's description of them, empty without one.

    Nothing is inflated beyond what its header announces and a MB of extensions.

    Raises:
        UserError: it is no such file, damaged, or of another version or degree.
    """
    with path.open("rb") as file:
        if file.read(4) == _MAGIC:
            raise UserError(
                f"{path} is a .spz of version 4 or later; nerfcli reads versions 2 and 3",
                "convert it: npx @playcanvas/splat-transform in.spz out.ply",
            )
    try:
        with gzip.open(path) as file:
            head = file.read(_HEADER.size)
            count, size = _counted(head)
            if size > _MOST_RATIO * path.stat().st_size:
                raise ValueError(f"{count} splats cannot be in {path.stat().st_size} bytes")
            body = file.read(size)
            more = file.read(_MOST_EXTENSIONS)  # at its end, gzip verifies the checksum
            if len(more) == _MOST_EXTENSIONS:
                raise ValueError(f"{count} splats take {size} bytes, it has a MB more")
        gaussians = unpacked(head + body + more)
    except (EOFError, gzip.BadGzipFile, zlib.error, struct.error, ValueError) as error:
        raise UserError(
            f"{path} is damaged, or not a .spz of version 2 or 3 and degree 0 to 3: {error}", "copy or export it again"
        ) from error
    if head[14] & _ANTIALIASED:
        notify(f"{path} was made for antialiased rendering (Mip-Splatting); nerfcli shows its thin parts too thick")
    return gaussians, description_in([_comment(path)])


def _gzipped(data: bytes, description: Mapping[str, Any] | None) -> bytes:
    """Return a gzip stream with the description as its comment, which other readers skip (RFC 1952, 2.3.1)."""
    stream = gzip.compress(data, 6, mtime=0)  # 9 takes five times as long for 2 %
    if description is None:
        return stream
    comment = comments_of(description)[-1].encode("ascii") + b"\0"
    return stream[:3] + bytes([_COMMENT]) + stream[4:10] + comment + stream[10:]


def _comment(path: Path) -> str:
    """Return the comment of a gzip stream that starts with one, as those of `_gzipped` do; empty for others."""
    with path.open("rb") as file:
        head = file.read(2**16)
    return head[10 : head.find(b"\0", 10)].decode("latin-1") if head[3] == _COMMENT else ""


def packed(gaussians: Gaussians) -> tuple[bytes, str]:
    """Return what a .spz of version 3 holds before compression, and a line about what was clipped, or "".

    Errors: half of 2^-b in positions, where 2^-b is at most 1/16 of the size of 99 % of the splats, or the least with
    which the farthest fits in 24 bits; 1/32 in log scales; 1/510 in opacities; 0.0131 in the harmonic of degree 0,
    1/128 in the others; 0.002 in parts of unit quaternions. Clipped are harmonics of degree 0 beyond +-3.35 and others
    beyond -1 and 1, log scales beyond -10 and 5.9, and positions beyond 2^23.
    """
    bits, useful = _fractional_bits(gaussians)
    clipped: Counter[str] = Counter()
    blocks = (gaussians.taken(slice(at, at + _ROWS)) for at in range(0, len(gaussians), _ROWS))
    parts = zip(*(_encoded(block, bits, clipped=clipped) for block in blocks), strict=True)
    header = _HEADER.pack(_MAGIC, 3, len(gaussians), gaussians.degree, bits, 0, 0)
    data = header + b"".join(piece for part in parts for piece in part)
    counts = listed([f"{name} of {count}" for name, count in clipped.items() if count])
    note = f"clipped to the ranges of .spz: {counts} of {len(gaussians)} splats; a .ply keeps all" if counts else ""
    if not note and bits < useful - math.log2(_STEPS):
        note = f"positions are rounded to {2.0**-bits:g}, as one splat is far away; leave it out, or write a .ply"
    return data, note


def _encoded(gaussians: Gaussians, bits: int, *, clipped: Counter[str]) -> list[bytes]:
    """Return the arrays of a file for a few Gaussians, and add to the numbers of those clipped."""
    harmonics = gaussians.harmonics * _HARMONIC_SIGNS[: gaussians.harmonics.shape[1], None]

    def rounded(name: str, values: np.ndarray, low: int = 0, high: int = 255) -> np.ndarray:
        """Return whole numbers, rounded as the reference does: half away from 0."""
        off = (values < low - 0.5) | (values > high + 0.5)
        clipped[name] += int(off.reshape(len(values), -1).any(axis=1).sum())
        return np.clip(np.trunc(values + np.copysign(0.5, values)), low, high).astype("<i4")

    places = rounded("positions", gaussians.means * _SIGNS * 2.0**bits, -(2**23), 2**23 - 1)
    rest = (rounded("harmonics", 128 * harmonics[:, 1:] + 128) + _STEP // 2) // _STEP * _STEP
    numbers = [
        rounded("opacities", 255 * expit(gaussians.logits.astype(np.float64))),
        rounded("colours", 255 * (_COLOUR * harmonics[:, 0] + 0.5)),
        rounded("sizes", 16 * (gaussians.log_scales + 10)),
    ]
    return [
        places[..., None].view(np.uint8)[..., :3].tobytes(),
        *(values.astype(np.uint8).tobytes() for values in numbers),
        _smallest_three(gaussians.quaternions * _QUATERNION_SIGNS).tobytes(),
        np.minimum(rest, 255).astype(np.uint8).tobytes(),
    ]


def unpacked(data: bytes) -> Gaussians:
    """Return the Gaussians of a decompressed .spz of version 2 or 3.

    Raises:
        ValueError, struct.error: it is none, or damaged.
    """
    count, size = _counted(data)
    _, version, _, degree, bits, flags, _ = _HEADER.unpack_from(data)
    if len(data) < _HEADER.size + size:
        raise ValueError(f"{count} splats take {size} bytes, it has {len(data) - _HEADER.size}")
    ends = count * np.cumsum(_widths(version, degree))
    *arrays, more = np.split(np.frombuffer(data, np.uint8, offset=_HEADER.size), ends)
    if flags & _EXTENSIONS:
        _check_axes(more.tobytes())
    positions, opacities, colours, sizes, rotations, rest = (array.reshape(count, -1) for array in arrays)
    whole = np.zeros((len(positions), 3, 4), np.uint8)
    whole[..., 1:] = positions.reshape(-1, 3, 3)
    means = (whole.view("<i4")[..., 0] >> 8) * 2.0**-bits  # the shift keeps the sign
    # An opacity of exactly 0 or 1 has no logit: a quarter of a step inside.
    opacity = np.clip(opacities[:, 0], 0.25, 254.75) / 255
    flat, bent = (colours[:, None] / 255 - 0.5) / _COLOUR, (rest.reshape(len(rest), -1, 3) - np.float32(128)) / 128
    harmonics = np.concatenate([flat, bent], axis=1, dtype=np.float32, casting="same_kind")
    quaternions = _from_smallest_three(rotations) if rotations.shape[1] == 4 else _from_xyz(rotations)
    return Gaussians(
        means * _SIGNS,
        sizes / 16 - 10.0,
        quaternions * _QUATERNION_SIGNS,
        np.log(opacity / (1 - opacity)),
        harmonics * _HARMONIC_SIGNS[: harmonics.shape[1], None],
    )


def _counted(head: bytes) -> tuple[int, int]:
    """Return the number of Gaussians that a header states, and the number of bytes that they take after it."""
    if len(head) < _HEADER.size:
        raise ValueError(f"it ends after {len(head)} bytes, within its header")
    magic, version, count, degree, *_ = _HEADER.unpack_from(head)
    if magic != _MAGIC or version not in (2, 3) or degree > 3 or not count:
        raise ValueError(f"version {version}, {count} splats of degree {degree}")
    return count, count * sum(_widths(version, degree))


def _widths(version: int, degree: int) -> list[int]:
    """Return the bytes per Gaussian of positions, opacities, colours, scales, rotations and harmonics."""
    return [9, 1, 3, 3, 4 if version == 3 else 3, 3 * ((degree + 1) ** 2 - 1)]


def _check_axes(extensions: bytes) -> None:
    """Refuse extensions, each a type, a length and a payload, that state other axes than right, up, back."""
    at = 0
    while at + 12 <= len(extensions):
        kind, length, axes = struct.unpack_from("<III", extensions, at)
        if kind == _OTHER_AXES and axes != _USUAL:
            raise ValueError(f"its axes are those with the number {axes}, expected {_USUAL}: right, up, back")
        at += 8 + length


def _fractional_bits(gaussians: Gaussians) -> tuple[int, int]:
    """Return the number of bits behind the point with which all means fit in 24, and how many would be of use."""
    small = float(np.quantile(np.median(gaussians.log_scales, axis=1), 0.01))
    useful = min(max(math.ceil(math.log2(_STEPS) - small / math.log(2)), 0), _MOST_BITS)
    farthest = float(np.abs(gaussians.means).max())
    return next((bits for bits in range(useful, 0, -1) if farthest * 2.0**bits <= 2**23 - 1), 0), useful


def _smallest_three(quaternions: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4), w x y z, packed in uint32: 2 bits for the largest of x y z w, which is not stored, and
    for each other a sign and 9 bits of its magnitude, in units of sqrt(1/2) / 511."""
    xyzw = quaternions[:, [1, 2, 3, 0]].astype(np.float64)
    xyzw /= np.linalg.norm(xyzw, axis=1, keepdims=True)
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw *= np.where(xyzw[np.arange(len(xyzw)), largest] < 0, -1, 1)[:, None]
    fields = (511 * np.abs(xyzw) / _HALF + 0.5).astype(np.uint32) | (xyzw < 0).astype(np.uint32) << 9
    packed = largest.astype(np.uint32)
    for part in range(4):
        packed = np.where(largest == part, packed, packed << 10 | fields[:, part])
    return packed.astype("<u4")


def _from_smallest_three(rotations: np.ndarray) -> np.ndarray:
    """Return the quaternions (N, 4), w x y z, of `_smallest_three` in bytes (N, 4)."""
    packed = np.ascontiguousarray(rotations).view("<u4")[:, 0].copy()
    largest = packed >> 30
    xyzw = np.zeros((len(packed), 4))
    for part in (3, 2, 1, 0):
        stored = largest != part
        magnitude = (packed & 511) * (_HALF / 511)
        xyzw[stored, part] = np.where(packed & 512, -magnitude, magnitude)[stored]
        packed = np.where(stored, packed >> 10, packed)
    xyzw[np.arange(len(xyzw)), largest] = np.sqrt(np.maximum(0, 1 - (xyzw**2).sum(axis=1)))
    return xyzw[:, [3, 0, 1, 2]]


def _from_xyz(rotations: np.ndarray) -> np.ndarray:
    """Return the quaternions (N, 4), w x y z, of version 2: bytes (N, 3) of x, y, z, and w >= 0."""
    xyz = rotations / 127.5 - 1
    return np.concatenate([np.sqrt(np.maximum(0, 1 - (xyz**2).sum(axis=1, keepdims=True))), xyz], axis=1)
