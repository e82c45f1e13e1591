"""Guard a training against numbers that are not finite: find them, name them, keep them for replay, and recover.

Every step checks its loss and the gradients of its weights, which costs microseconds; on a GPU, those of the previous
step, so that the host does not wait. Every few hundred steps, the whole state is checked and copied. If something is
not finite, the training goes back to the copy and repeats its steps, now checking every number of every tensor. With a
deterministic backend the steps are the same bit for bit, so this finds the first bad tensor, with its step and its
pixels. The state before that step is saved to a file, and the training continues from the copy with half the learning
rate. If sums are added up in varying order, a repeated step may stay finite: then the cause is unknown, smaller steps
would not help, and the training simply continues.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfcli import distributed
from nerfcli.cameras.camera import Camera
from nerfcli.cameras.rigid import Similarity
from nerfcli.errors import NON_FINITE, UserError
from nerfcli.field.checkpoint import load_tensors, save_tensors
from nerfcli.field.kinds import settings_from_json
from nerfcli.machine import use_threads
from nerfcli.render.trained_field import Marching
from nerfcli.training.extent import Extent
from nerfcli.training.fitting import Fitting, StepResult, TrainingInputs
from nerfcli.training.pool import PixelBatch, PixelPool
from nerfcli.training.runs.files import STATE
from nerfcli.training.runs.settings import TrainSettings
from nerfcli.training.step import NonFiniteError, Watch

FAILURE_FORMAT = "nerfcli failure 1"
FAILURES = "failure-*.safetensors"
SNAPSHOT_EVERY = 256
MOST_ROLLBACKS = 3


@dataclass(frozen=True)
class BadTensor:
    """A tensor that is not finite.

    Args:
        name: what it is: "density of samples", "gradient of weights.0".
        count, total: how many of its numbers are not finite, and how many it has.
        rays: numbers of the rays of the batch that the bad numbers belong to; empty where they belong to no ray.
    """

    name: str
    count: int
    total: int
    rays: tuple[int, ...]


class FirstBad(Watch):
    """Looks at every number of every tensor, and remembers the first tensor that is not finite."""

    def __init__(self) -> None:
        self.found: BadTensor | None = None

    def state(self, give: Callable[[], tuple[dict[str, Tensor], Any]]) -> None:
        for name, tensor in that_must_be_finite(give()[0]).items():
            self.values(name.removeprefix("field."), tensor)

    def values(self, name: str, tensor: Tensor, rays: Tensor | None = None) -> None:
        """Look at a tensor; `rays` (N,) are the rays that its rows belong to."""
        if self.found is not None or is_finite(tensor):
            return
        bad = ~tensor.detach().isfinite()
        which: Tensor = torch.empty(0)
        if rays is not None:
            which = rays[bad.reshape(len(bad), -1).any(1)].unique()
        self.found = BadTensor(name, int(bad.sum()), bad.numel(), tuple(which.long().tolist()))

    def rows(self, name: str, tensor: Tensor, rays: Tensor) -> None:
        self.values(name, tensor, rays)
        if tensor.requires_grad:
            tensor.register_hook(lambda gradient: self.values(f"gradient of {name}", gradient, rays))


def that_must_be_finite(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors of a state that must be finite; cells that no step has evaluated yet have infinite density."""
    return {name: tensor for name, tensor in state.items() if name not in ("optical_depth", "fine_depth")}


def is_finite(tensor: Tensor) -> bool:
    """Return whether all values of a tensor are finite, without a temporary of its size."""
    if tensor.numel() == 0 or not tensor.is_floating_point():
        return True
    smallest, largest = tensor.detach().aminmax()
    return bool((smallest.isfinite() & largest.isfinite()).item())


class Sentinel:
    """Takes the steps of a training, and handles non-finite numbers."""

    def __init__(self, fitting: Fitting, *, run: Path, notify: Callable[[str], None]):
        self._fitting = fitting
        self._run = run
        self._notify = notify
        self._progress: list[float] = []  # progress of the steps since the copy
        self._tensors, self._description = _copied(*fitting.state())

    def advance(self, progress: float) -> StepResult:
        """Take one step, see `Fitting.advance`; after a failure, it may be the repetition of an earlier one.

        Raises:
            UserError: numbers become non-finite despite smaller steps, exit code 5.
        """
        self._progress.append(progress)
        try:
            if len(self._progress) > SNAPSHOT_EVERY:
                self._take_snapshot(progress)
            return self._fitting.advance(progress)
        except NonFiniteError:
            return self._recover()

    def settle(self) -> None:
        """Make sure that the last step was finite, too, which on a GPU `advance` does not know yet; raises as that."""
        try:
            self._fitting.settle()
        except NonFiniteError:
            self._recover()

    def _take_snapshot(self, progress: float) -> None:
        self._fitting.settle()
        tensors, description = self._fitting.state()
        if not all(map(is_finite, that_must_be_finite(tensors).values())):
            raise NonFiniteError
        # Given equal sums, two kinds of processors may take steps that differ in the last bit.
        distributed.copy_from_first(*tensors.values())
        for name, tensor in tensors.items():
            self._tensors[name].copy_(tensor)
        self._description = description
        self._progress = [progress]

    def _go_back(self) -> None:
        self._fitting.restore(*_copied(self._tensors, self._description))

    def _recover(self) -> StepResult:
        """Find the failure by repeating the steps since the copy; then continue from the copy with smaller steps."""
        fitting = self._fitting
        self._go_back()
        deterministic = fitting.field.backend.deterministic
        before = self._tensors, self._description
        done, bad, result = 0, None, None
        while bad is None and done < len(self._progress):
            if not deterministic:  # this state cannot be reproduced
                before = _copied(*fitting.state())
            result, bad = _watched_step(fitting, self._progress[done])
            bad = _first_of_all(bad)
            done += 1
        if bad is None:
            assert result is not None
            reason = (
                "if this happens again, suspect faulty memory or an overclocked processor"
                if deterministic
                else "this device does not repeat results exactly"
            )
            self._notify(
                f"numbers were not finite at step {fitting.step}, but are finite when the step is repeated; training "
                f"continues ({reason})"
            )
            return result
        fitting.restore(*_copied(*before))
        if deterministic:
            for progress in self._progress[: done - 1]:
                fitting.advance(progress)
        path, text = self._keep(self._progress[done - 1], bad)
        self._go_back()
        if fitting.rollbacks == MOST_ROLLBACKS:
            kept = "the last checkpoint is kept; " if (self._run / STATE).exists() else ""
            raise UserError(
                f"{text}, despite {MOST_ROLLBACKS} retries with smaller steps",
                f"{kept}{path} has the state before the failure (nerfcli info repeats the step); try another --seed",
                NON_FINITE,
            )
        fitting.smaller_steps()
        self._notify(
            f"{text}; continuing from step {fitting.step} with {fitting.rate_factor:g} of the learning rate ("
            f"{fitting.rollbacks} of {MOST_ROLLBACKS} retries); {path} has the state before the failure"
        )
        self._description = fitting.state()[1]  # a later failure keeps these smaller steps
        first, self._progress = self._progress[0], []
        return self.advance(first)

    def _keep(self, progress: float, bad: BadTensor) -> tuple[Path, str]:
        """Save the state before a step with its batch; return the path and a description of the failure to come."""
        fitting = self._fitting
        tensors, description = fitting.state()
        before = {name: tensor.clone() for name, tensor in tensors.items()}
        drawn = fitting.draw(fitting.schedule.at(progress, step=fitting.step, furthest=fitting.furthest))
        batch = {
            **drawn._asdict(),
            "first_pixel": fitting.pool.first_pixel,
            "cones": fitting.pool.cones,
            "poses": fitting.pool.poses,
            "after_draw": fitting.generator.get_state(),
        }
        pixels = [fitting.pool.place(int(drawn.numbers[ray])) for ray in bad.rays[:8]]
        text = f"{bad.name} is not finite at step {fitting.step + 1}: {bad.count} of {bad.total} numbers"
        if pixels:
            name, x, y = pixels[0]
            more = f" and {len(bad.rays) - 1} more pixels" if len(bad.rays) > 1 else ""
            text += f", in {name} at pixel ({x}, {y}){more}"
        path = self._run / f"failure-{fitting.step + 1}.safetensors"
        content = {
            "format": FAILURE_FORMAT,
            "message": text,
            "tensor": bad.name,
            "share": progress,
            "pixels": [list(pixel) for pixel in pixels],
            "settings": fitting.settings.to_json(),
            "marching": vars(fitting.extent.marching),
            "parallax": fitting.extent.parallax,
            "cameras": [camera.to_json() for camera in fitting.pool.cameras],
            "state": description,
        }
        save_tensors(path, {**before, **{f"batch.{name}": value for name, value in batch.items()}}, content)
        return path, text


class _SavedBatch(PixelPool):
    """A pool of pixels that holds a single batch."""

    def __init__(self, tensors: dict[str, Tensor], cameras: Sequence[dict[str, Any]]):
        self.colours, self.first_pixel = tensors["batch.colours"], tensors["batch.first_pixel"]
        self.cones = tensors["batch.cones"]
        self.poses = tensors["batch.poses"]
        self.cameras = tuple(Camera.from_json(camera) for camera in cameras)
        self._drawn = PixelBatch(**{name: tensors[f"batch.{name}"] for name in PixelBatch._fields})
        self._after_draw = tensors["batch.after_draw"]

    def draw(self, count: int, generator: torch.Generator) -> PixelBatch:
        """Return the batch, and bring the generator to where it was after drawing it."""
        if self._after_draw.shape == generator.get_state().shape:  # else the failure was on another type of device
            generator.set_state(self._after_draw)
        return self._drawn


def replay(path: Path) -> tuple[dict[str, Any], BadTensor | None]:
    """Repeat the step of a failure from its file alone.

    Returns:
        The file's description, and the tensor that is not finite this time; None if all are.

    Raises:
        UserError: the file cannot be read, or is not a saved failure.
    """
    tensors, description = load_tensors(path, "cpu")
    if description.get("format") != FAILURE_FORMAT:
        raise UserError(
            f"{path} is not a saved failure but {description.get('format')!r}",
            "give a failure-STEP.safetensors file of a run",
        )
    settings = replace(TrainSettings.from_json(description["settings"]), device="cpu")
    use_threads(settings.threads)
    size = settings_from_json(description["state"]["field"])
    marching = Marching(**description["marching"])
    extent = Extent(size.contraction, Similarity.identity(), marching, parallax=description["parallax"])
    fitting = Fitting(TrainingInputs(settings, extent, _SavedBatch(tensors, description["cameras"])), size=size)
    fitting.restore({name: t for name, t in tensors.items() if not name.startswith("batch.")}, description["state"])
    return description, _watched_step(fitting, description["share"])[1]


def _watched_step(fitting: Fitting, progress: float) -> tuple[StepResult | None, BadTensor | None]:
    """Take a step that checks every number; return its result and the first tensor that is not finite."""
    watch = FirstBad()
    try:
        result = fitting.advance(progress, watch)
    except NonFiniteError:
        # If no number is bad, the numbers are so large that their sum is.
        return None, watch.found or BadTensor("sum of the gradients", 1, 1, ())
    return result, watch.found


def _first_of_all(bad: BadTensor | None) -> BadTensor | None:
    """Return the bad tensor of the first process that has one, with its rays numbered among those of all processes."""
    if bad is not None:
        bad = replace(bad, rays=tuple(map(distributed.whole_row, bad.rays)))
    return next((found for found in distributed.gathered(bad) if found is not None), None)


def _copied(tensors: dict[str, Tensor], description: dict[str, Any]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    return {name: tensor.clone() for name, tensor in tensors.items()}, dict(description)
