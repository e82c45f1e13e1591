"""Random damage to files from a seeded generator, and checks of how a capture reader handles it.

A reader given a damaged file either refuses it (a `UserError` that names the file) or, if the damage did no harm,
returns a sound capture. It never raises anything else, hangs, or allocates much more than the file's size.
"""

import json
import re
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import psutil

from nerfcli.captures.capture import Capture
from nerfcli.errors import BAD_INPUT, UserError

MOST_SECONDS = 20
MOST_BYTES = 64 * 2**20

_WORDS = (
    *("nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "-1", "0", "", "word"),
    *("9" * 30, "9" * 5000, "1,5", "ü", "["),
)
_VALUES = (
    *(float("nan"), float("inf"), -1e308, 1e308, 0, -1, 0.5, True, None, "word", "", [], {}, [[1]], {"a": 1}),
    *(2**31, 2**63, 10**400, -(10**30), [None], ["1"], 1e-320),
)
_NUMBERS = tuple(
    np.array(number, dtype=kind).tobytes()
    for number, kind in (
        *((value, "<f8") for value in (np.nan, np.inf, -np.inf, 1e308, -1e308, 0.0, -1.0, 1e-320)),
        *((value, "<i8") for value in (-1, 0, 1, 2**31, 2**40, 2**62, -(2**63))),
        *((value, "<i4") for value in (-1, 0, 99, 2**31 - 1)),
    )
)


def corrupted_binary(data: bytes, rng: np.random.Generator) -> bytes:
    """Return damaged bytes: truncated, extended, with a number overwritten, a bit flipped, or a stretch removed."""
    at = int(rng.integers(0, len(data)))
    # Most files begin with counts, magic words and other structure, so half of the damage is done there.
    start = int(rng.integers(0, min(len(data), 128))) if rng.random() < 0.5 else at
    kind = int(rng.integers(0, 6))
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data + bytes(rng.integers(0, 256, size=int(rng.integers(1, 64)), dtype=np.uint8))
    if kind == 2:
        number = _NUMBERS[int(rng.integers(0, len(_NUMBERS)))]
        return data[:start] + number + data[start + len(number) :]
    if kind == 3:
        return data[:start] + bytes(rng.integers(0, 256, size=8, dtype=np.uint8)) + data[start + 8 :]
    if kind == 4:
        return data[:start] + bytes([data[start] ^ (1 << int(rng.integers(0, 8)))]) + data[start + 1 :]
    return data[:start] + data[start + int(rng.integers(1, 40)) :]


def corrupted_text(data: bytes, rng: np.random.Generator) -> bytes:
    """Return damaged text: truncated, words replaced, dropped or doubled, lines dropped or doubled, bytes damaged."""
    lines = data.decode("utf-8", "surrogateescape").split("\n")
    filled = [index for index, line in enumerate(lines) if line.strip() and not line.startswith("#")]
    kind = int(rng.integers(0, 7))
    if kind == 0 or not filled:
        return data[: int(rng.integers(0, len(data)))]
    index = filled[int(rng.integers(0, len(filled)))]
    words = re.split(r"([ ,=<>\"]+)", lines[index])  # at even indices, between what separates them
    at = 2 * int(rng.integers(0, (len(words) + 1) // 2))
    if kind in (1, 2):
        words[at] = _WORDS[int(rng.integers(0, len(_WORDS)))]
    elif kind == 3:
        words = words[:at] + words[at + 2 :]
    elif kind == 4:
        words = words[: at + 2] + words[at:]
    lines[index] = "".join(words)
    if kind == 5:
        lines = lines[:index] + lines[index + 1 :] if rng.random() < 0.5 else lines[: index + 1] + lines[index:]
    damaged = "\n".join(lines).encode("utf-8", "surrogateescape")
    return corrupted_binary(damaged, rng) if kind == 6 else damaged


def corrupted_json(data: bytes, rng: np.random.Generator) -> bytes:
    """Return damaged JSON: a value dropped or replaced (another type, NaN, a huge number), truncated, bytes damaged."""
    kind = int(rng.integers(0, 6))
    if kind == 0:
        return data[: int(rng.integers(0, len(data)))]
    if kind == 1:
        return corrupted_binary(data, rng)
    content = json.loads(data)
    places = list(_places(content))
    # 30 % of the damage is done at the top level, as most places are leaves.
    top = [place for place in places if place[0] is content]
    chosen = top if rng.random() < 0.3 else places
    holder, key = chosen[int(rng.integers(0, len(chosen)))]
    if kind == 2:
        del holder[key]
    else:
        holder[key] = _VALUES[int(rng.integers(0, len(_VALUES)))]
    return json.dumps(content).encode()


def assert_refused_or_sound(read: Callable[[], None], folder: Path) -> bool:
    """Assert that `read` refuses damaged files of a folder, or finds them sound; return whether it refused."""
    try:
        with _at_most(MOST_SECONDS), _with_room_for(MOST_BYTES):
            read()
        return False
    except UserError as error:
        refusal = error
    assert refusal.exit_code == BAD_INPUT
    assert str(folder) in refusal.message, refusal.message
    assert "\n" not in refusal.message + refusal.hint
    assert len(refusal.message) < 1000
    return True


def assert_sound(capture: Capture) -> None:
    """Assert that all numbers of a capture are finite, poses rigid, names unique, and indices and shapes valid."""
    assert len(capture.frames) > 0
    assert len({frame.name for frame in capture.frames}) == len(capture.frames)
    for frame in capture.frames:
        assert frame.name
        assert frame.camera.width >= 1
        assert frame.camera.height >= 1
        assert np.isfinite(frame.camera.params).all()
        pose = frame.world_from_cam
        assert pose.shape == (4, 4)
        assert np.isfinite(pose).all()
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), rtol=0, atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) > 0
        np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])
        assert frame.split in (None, "train", "val", "test")
    assert capture.points.shape == (len(capture.points), 3)
    assert np.isfinite(capture.points).all()
    if capture.colours is not None:
        assert capture.colours.dtype == np.uint8
        assert capture.colours.shape == (len(capture.points), 3)
    if capture.depth_bounds is not None:
        assert capture.depth_bounds.shape == (len(capture.frames), 2)
        assert np.isfinite(capture.depth_bounds).all()
    seen = capture.observations
    if seen is not None:
        assert seen.frame_index.shape == seen.point_index.shape == (len(seen.pixels),)
        assert seen.pixels.shape == (len(seen.pixels), 2)
        assert np.isfinite(seen.pixels).all()
        assert ((seen.frame_index >= 0) & (seen.frame_index < len(capture.frames))).all()
        assert ((seen.point_index >= -1) & (seen.point_index < len(capture.points))).all()
    assert capture.unit in ("arbitrary", "metre")


def _places(node: Any) -> Iterator[tuple[Any, Any]]:
    """Yield every value in a JSON tree as its list or dict and its index or key there."""
    keys = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
    for key in keys:
        yield node, key
        yield from _places(node[key])


@contextmanager
def _at_most(seconds: int) -> Iterator[None]:
    """Raise an error if the block takes longer, so that an endless loop fails the test rather than freezing it."""

    def fail(signum: int, frame: FrameType | None) -> None:
        raise AssertionError(f"not done after {seconds} seconds")

    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def _with_room_for(count: int) -> Iterator[None]:
    """Have larger allocations in the block raise a MemoryError; tracing all of them takes twice as long as reading."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (psutil.Process().memory_info().vms + count, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
