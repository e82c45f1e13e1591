"""A step of a training on a GPU waits for it once. There is no GPU: the device is torch's `meta`, which has no numbers.

Kernels are counted instead of launched. An operation that needs a number of the device on the host, or a blocking
copy, counts as a wait and gets a made-up number.
"""

import traceback
from collections.abc import Iterator
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

pytest.importorskip("triton", reason="Triton is for Linux")
from pools import pool_of_photos

from nerfcli.cameras.rigid import Similarity
from nerfcli.captures.capture import Capture
from nerfcli.kernels.triton_cuda import launch
from nerfcli.kernels.triton_cuda.backend import TritonBackend
from nerfcli.photos.loading import load_photos
from nerfcli.render.trained_field import Marching
from nerfcli.training import pool as pools
from nerfcli.training.extent import Extent
from nerfcli.training.fitting import Fitting, TrainingInputs
from nerfcli.training.pool import PointDepths, PointRays
from nerfcli.training.runs.components import Components
from nerfcli.training.runs.settings import TrainSettings

GPU = torch.device("meta")
# The number that any copy from the device returns.
ANY = 2
# Operations whose result has a size that only the device knows.
SIZED_BY_NUMBERS = ("nonzero", "masked_select", "repeat_interleave", "unique_dim", "_unique2", "unique_consecutive")


class Waits(TorchDispatchMode):
    """Counts the host's waits for the device, with the lines that cause them."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []
        self.launches = 0

    def note(self) -> None:
        own = [frame for frame in traceback.extract_stack() if "/nerfcli/" in frame.filename]
        self.lines.append(f"{own[-1].filename}:{own[-1].lineno} {own[-1].line}" if own else "not in nerfcli")

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, name = dict(kwargs or {}), func._schema.name.removeprefix("aten::")
        first = next((arg for arg in args if isinstance(arg, Tensor)), None)
        here = first is not None and first.device == GPU
        if "generator" in kwargs:
            kwargs["generator"] = None
        if name == "_local_scalar_dense" and here:
            self.note()
            return ANY
        if name == "lift_fresh" and here:  # torch.tensor(values, device=...)
            self.note()
        if name == "_to_copy" and (to := kwargs.get("device")) is not None and here != (to == GPU):
            if not kwargs.get("non_blocking"):
                self.note()
            if here:
                assert first is not None
                dtype = kwargs.get("dtype") or first.dtype
                if first.shape[-2:] == (4, 4):  # poses
                    return torch.eye(4, dtype=dtype).expand(first.shape)
                return torch.full(first.shape, ANY, dtype=dtype)
        if name == "copy_" and args[0].device != args[1].device and not (len(args) > 2 and args[2]):
            self.note()
        indices = args[1] or () if name in ("index", "index_put_", "index_put") else ()
        masks = [part for part in indices if part is not None]
        if here and (name in SIZED_BY_NUMBERS or any(mask.dtype in (torch.bool, torch.uint8) for mask in masks)):
            self.note()
            raise AssertionError(f"{name} makes the host wait: {self.lines[-1]}")
        return func(*args, **kwargs)


class OfCpu(torch.Generator):
    """A generator for any device; its numbers are never looked at."""

    def __new__(cls, device: object = None) -> "OfCpu":
        return super().__new__(cls)


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> Iterator[Waits]:
    """Make `meta` act as a GPU."""
    found = Waits()

    class Event:
        """Counts as a wait, unless the host has waited for the device since the event was recorded."""

        def record(self, stream: object) -> None:
            self._before = len(found.lines)

        def synchronize(self) -> None:
            if len(found.lines) == self._before:
                found.note()

    def count(grid: object, values: object, stream: int) -> None:
        found.launches += 1

    def load(variant: object, device: int) -> SimpleNamespace:
        return SimpleNamespace(launch=count)

    monkeypatch.setattr(torch, "Generator", OfCpu)
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda self: self)
    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device=None: SimpleNamespace(cuda_stream=0))
    monkeypatch.setattr(torch.Tensor, "get_device", lambda tensor: 0)
    monkeypatch.setattr(launch, "_stream", lambda device: 0)
    monkeypatch.setattr(launch, "_load", load)
    monkeypatch.setattr(launch, "_with_triton", set())
    monkeypatch.setattr(launch, "_loaded", {})
    monkeypatch.setattr(pools, "backend_for", lambda device, dtype: TritonBackend(device))
    with found:
        yield found


@pytest.mark.parametrize(
    ("components", "most"),
    [
        (Components(), 1),
        (Components(exposure="learned", background="sphere", antialias=True), 1),
        (Components(points=0.1), 1),
        (Components(cameras="poses"), 1),
        (Components(cameras="all"), 2),  # the host computes the directions of pixels through a lens that learns
    ],
    ids=lambda value: "-".join(f"{k}={v}" for k, v in vars(value).items() if v != getattr(Components(), k)) or "default"
    if isinstance(value, Components) else None,
)  # fmt: skip
def test_a_step_waits_once_for_the_device(components, most, waits, spheres: Capture):
    photos = load_photos(spheres.train_frames[:3], factor=4, threads=1)
    opaque = [photo.__class__(photo.frame, photo.pixels[..., :3].copy(), photo.used) for photo in photos]
    pool = pool_of_photos(opaque, device=GPU)
    few = {"budget_seconds": None, "steps": 40, "samples_per_step": 2**9, "log2_rows": 16}
    settings = TrainSettings(components=components, device="cuda", **few)
    depths = [PointDepths(*(torch.zeros(9, device=GPU).to(t) for t in (torch.int64, torch.float32, torch.float32)))]
    extent = Extent("l2", Similarity.identity(), Marching(0.1, 4.0, 0.05, 0.0))
    fitting = Fitting(TrainingInputs(settings, extent, pool, points=PointRays(depths, pool)))
    fitting.field.backend = TritonBackend(GPU)
    for step in range(20):
        before = len(waits.lines)
        fitting.advance(0.2 + step / 40)
        if step > 1:  # earlier steps learn the room for samples and have no loss to show
            assert len(waits.lines) - before <= most, waits.lines[before:]
    assert waits.launches > 20 * 10
