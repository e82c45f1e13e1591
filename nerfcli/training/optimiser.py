"""Optimisers: Adam for the field and other parts; for cameras, Newton steps, whitened Adam, and the gauge.

Results of a step on a GPU are read one step later, see `Delayed`.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.adam import adam as adam_step

from nerfcli.cameras.rigid import Similarity, rotation_from_vector, vector_from_rotation
from nerfcli.field.interface import Field
from nerfcli.kernels import AdamStep

BETAS = (0.9, 0.99)
EPS = 1e-15
_MOMENTS = ("exp_avg", "exp_avg_sq")


class Adam:
    """Adam and its moments for some tensors; a step leaves those without a gradient unchanged.

    Source: Kingma and Ba 2015, arXiv:1412.6980, algorithm 1.
    """

    def __init__(self, parameters: Iterable[Tensor]):
        self._parameters = list(parameters)
        # On a GPU, the one kernel that steps all parameters reads the number of steps; else the host does.
        self._state = [
            {
                "step": torch.zeros((), device=parameter.device if parameter.is_cuda else "cpu"),
                "exp_avg": torch.zeros_like(parameter, requires_grad=False),
                "exp_avg_sq": torch.zeros_like(parameter, requires_grad=False),
            }
            for parameter in self._parameters
        ]

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for parameter in self._parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Take one step at a learning rate."""
        learned = [
            (parameter, parameter.grad, state)
            for parameter, state in zip(self._parameters, self._state, strict=True)
            if parameter.grad is not None
        ]
        if not learned:
            return
        first, second = ([state[name] for _, _, state in learned] for name in _MOMENTS)
        adam_step(
            [parameter for parameter, _, _ in learned],
            [gradient for _, gradient, _ in learned],
            first,
            second,
            [],
            [state["step"] for _, _, state in learned],
            amsgrad=False,
            beta1=BETAS[0],
            beta2=BETAS[1],
            lr=rate,
            weight_decay=0.0,
            eps=EPS,
            maximize=False,
            fused=True if learned[0][0].is_cuda else None,
        )

    def state(self, prefix: str) -> dict[str, Tensor]:
        """Return the state for `restore`, with names that begin with `prefix`."""
        return {f"{prefix}.{i}.{name}": value for i, entry in enumerate(self._state) for name, value in entry.items()}

    def restore(self, tensors: dict[str, Tensor], prefix: str) -> None:
        """Restore the state from `state`; ignore other tensors, and reset parameters that have no stored state."""
        for index, entry in enumerate(self._state):
            for name, value in entry.items():
                stored = tensors.get(f"{prefix}.{index}.{name}")
                entry[name] = torch.zeros_like(value) if stored is None else stored.to(value.device)


class FieldOptimiser:
    """Adam's moments for a field's rows and weights.

    The gradient of the rows is added up in `Field.table_grad`, which is allocated here, once, and zero again after each
    step. It stays None for a field without rows.
    """

    def __init__(self, field: Field):
        self._field = field
        rows = field.rows()
        self._weights = {name: parameter for name, parameter in field.named_parameters() if parameter is not rows}
        self._adam = Adam(self._weights.values())
        self._first = self._second = None
        if rows is not None:
            field.table_grad, self._first, self._second = (
                torch.zeros_like(rows, requires_grad=False) for _ in range(3)
            )

    def zero_grad(self) -> None:
        """Clear the gradients of the weights; the step that used those of the rows has cleared them already."""
        self._adam.zero_grad()

    def weights(self) -> list[Tensor]:
        """Return all parameters but the rows."""
        return list(self._weights.values())

    def gradients(self) -> dict[str, Tensor]:
        """Return by name the gradients that any non-finite number reaches: those of the weights, or of rows alone."""
        if not self._weights and self._field.table_grad is not None:
            return {"rows": self._field.table_grad}
        return {name: weight.grad for name, weight in self._weights.items() if weight.grad is not None}

    def step(self, number: int, rate: float, *, decay: float) -> None:
        """Take step `number`, counted from 1, at a learning rate and with a weight decay of rows."""
        rate = rate * self._field.rate_factor
        self._adam.step(rate)
        rows, gradient = self._field.rows(), self._field.table_grad
        if rows is not None and gradient is not None and self._first is not None and self._second is not None:
            step = AdamStep(number, rate, BETAS, EPS, decay)
            self._field.backend.adam_rows(rows, gradient, self._first, self._second, step=step)

    def state(self) -> dict[str, Tensor]:
        """Return the state for `restore`, without the field's own tensors."""
        tensors: dict[str, Tensor] = {}
        if self._first is not None and self._second is not None:
            tensors |= {"table_first": self._first, "table_second": self._second}
        return tensors | self._adam.state("adam")

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state from `state`; other tensors are ignored."""
        if self._first is not None:
            self._first, self._second = tensors["table_first"], tensors["table_second"]
        if self._field.table_grad is not None:
            self._field.table_grad.zero_()  # a step may have failed before using it
        self._adam.restore(tensors, "adam")


class PartsOptimiser:
    """Adam for groups of parameters learned besides the field, each with a multiple of the field's learning rate."""

    def __init__(self, groups: Sequence[tuple[Sequence[Tensor], float]]):
        self._groups = [(Adam(parameters), multiple) for parameters, multiple in groups]

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for adam, _ in self._groups:
            adam.zero_grad()

    def step(self, rate: float) -> None:
        """Take one step at multiples of a learning rate."""
        for adam, multiple in self._groups:
            adam.step(rate * multiple)

    def state(self) -> dict[str, Tensor]:
        """Return the state for `restore`, without the parts' own tensors."""
        tensors: dict[str, Tensor] = {}
        for number, (adam, _) in enumerate(self._groups):
            tensors |= adam.state(f"parts_adam.{number}")
        return tensors

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state from `state`; other tensors are ignored."""
        for number, (adam, _) in enumerate(self._groups):
            adam.restore(tensors, f"parts_adam.{number}")


# Fewer cameras leave too few residuals to weight rotations against translations.
LEAST_TOLD = 6


def mean_similarity(before: np.ndarray, after: np.ndarray) -> Similarity:
    """Return the mean similarity of the motions of cameras, (P, 4, 4) `world_from_cam`, to first order.

    With the rotation w_i of camera i and the translation t_i of its centre c_i, in the world, the rotation w, the
    translation u and the logarithm of the scale s about the mean centre c minimise

        sum_i d^2 |w_i - w|^2 + |t_i - u - w x (c_i - c) - s (c_i - c)|^2

    d is the root mean square distance of the cameras from c: a rotation counts as much as the translation that it
    causes at that distance. Parameters that the cameras do not determine are 0, such as the scale of a single place.

    With `LEAST_TOLD` cameras or more, rotations and translations are weighted by the inverse of their residuals: where
    rotations were wrong and centres right, the centres determine the similarity, and vice versa.
    """
    centres = before[:, :3, 3]
    middle = centres.mean(axis=0)
    arms = centres - middle
    reach = float(np.sqrt((arms**2).sum(axis=1).mean()))
    reach = reach if reach > 1e-9 else 1.0  # cameras in one place have only a rotation and a translation in common
    turns = reach * vector_from_rotation(after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], -1, -2))
    moves = after[:, :3, 3] - centres
    rows = np.zeros((len(before), 6, 7))
    rows[:, :3, :3] = reach * np.eye(3)
    rows[:, 3:, :3] = np.cross(arms[:, None], np.eye(3))  # (w x arm)_i = (arm x e_i) . w
    rows[:, 3:, 3:6] = np.eye(3)
    rows[:, 3:, 6] = arms
    wanted = np.concatenate([turns, moves], axis=1)
    weights = np.ones(6)
    found = _least_squares(rows, wanted, weights)
    for _ in range(10 if len(before) >= LEAST_TOLD else 0):
        left = ((wanted - rows @ found) ** 2).reshape(-1, 2, 3).mean(axis=(0, 2)) ** 0.5
        if not left.any():
            break
        weights = np.repeat(left.max() / np.maximum(left, left.max() / 100.0), 3)
        found = _least_squares(rows, wanted, weights)
    rotation, scale = rotation_from_vector(found[:3]), float(np.exp(found[6]))
    return Similarity(scale, rotation, middle + found[3:6] - scale * rotation @ middle)


def without_mean(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return `after` (P, 4, 4) without the mean similarity from `before`; relative poses change only in scale."""
    return mean_similarity(before, after).inverse().apply_pose(after)


def _least_squares(rows: np.ndarray, wanted: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return x (7,) that minimises the difference of rows (P, 6, 7) @ x and wanted (P, 6), weighted by (6,)."""
    return np.linalg.lstsq((weights[:, None] * rows).reshape(-1, 7), (weights * wanted).ravel(), rcond=1e-9)[0]


# Decay of the running mean of the curvature per step: a photo has few rays in one step.
MEMORY = 0.95
# Added to losses: smaller ones, those of about one level of 255, give no reliable curvature.
_LEAST_LOSS = 3e-5
# In square pixels. Photos are held no tighter when their mean motion is below this.
_LEAST_SPREAD = 0.05


class NewtonSteps(nn.Module):
    """Steps of P poses, each with 6 parameters: translation and rotation.

    A ray whose loss is k r^2 / 2 has the gradient g = k r J and the curvature k J J^T = g g^T / (2 loss), which needs
    no second derivative. Three channels with the same error count as one.

    Args:
        count: P.
        picture_px: (P, 6) mean squared motion of the picture, in square pixels, per squared unit of each parameter.
    """

    def __init__(self, count: int, picture_px: Tensor):
        super().__init__()
        self._picture_px = picture_px
        self.curvature = nn.Buffer(torch.zeros(count, 6, 6, dtype=torch.float64))
        self.weight = nn.Buffer(torch.zeros((), dtype=torch.float64))

    def learn(self, gradients: Tensor, losses: Tensor, photos: Tensor) -> Tensor:
        """Update the curvature from some rays, and return the sum (P, 6) of their gradients.

        Args:
            gradients, losses: (R, 6) and (R,) of each ray's own loss.
            photos: (R,) the photo index of each ray.
        """
        of_ray = gradients[:, :, None] * gradients[:, None, :] / (2.0 * losses + _LEAST_LOSS)[:, None, None]
        curvature = torch.zeros_like(self.curvature).index_add_(0, photos, of_ray)
        slope = torch.zeros_like(self._picture_px).index_add_(0, photos, gradients)
        self.curvature.lerp_(curvature, 1.0 - MEMORY)
        self.weight.lerp_(torch.ones_like(self.weight), 1.0 - MEMORY)
        return slope

    def change(self, slope: Tensor, so_far: Tensor, *, damping: float, holding: float) -> Tensor:
        """Return the parameter change (P, 6) that minimises the loss, assumed quadratic in them, for the current field.

            -(H + damping diag(H) + L)^-1 (slope + L so_far),  L = holding diag(mean H) / spread^2, in square pixels

        L holds back translations and rotations, each as one kind: the less all photos have moved in that way so far,
        the more. Errors of the cameras show in directions that the photos determine; the same kind of change is then
        preferred in directions that they do not. Centres that were right stay right, and so do whole cameras.

        Args:
            slope: (P, 6) the sum of the gradients of a step's rays.
            so_far: (P, 6) the current poses relative to the given ones.
            damping: of each parameter by itself; poorly determined ones move slowly.
            holding: strength with which changes of less than a pixel are held back.
        """
        floor = 1e-12
        curvature = self.curvature / self.weight.clamp_min(floor)
        diagonal = torch.diagonal(curvature, dim1=-2, dim2=-1)
        spread = (self._picture_px * so_far.square()).view(-1, 2, 3).sum(-1).mean(0)
        held = holding * diagonal.mean(0) / spread.clamp_min(_LEAST_SPREAD).square().repeat_interleave(3)
        matrix = curvature + torch.diag_embed(damping * diagonal + held + floor)
        return -torch.linalg.solve(matrix, slope + held * so_far)


def whitening(jacobian: np.ndarray) -> np.ndarray:
    """Return the symmetric (K, K) map from whitened to parameter steps: (S + 0.1 diag(S) + 1e-8)^(-1/2), S = J^T J.

    Args:
        jacobian: (M, K) derivatives of the image positions by the parameters.

    Source: Park et al. 2023, CamP: camera preconditioning for neural radiance fields, arXiv:2308.10902, eq. 8.
    """
    squares = jacobian.T @ jacobian
    squares = squares + np.diag(0.1 * np.diag(squares) + 1e-8)  # poorly determined parameters do not move far
    values, vectors = np.linalg.eigh(squares)
    return (vectors / np.sqrt(values)) @ vectors.T


class WhitenedAdam(nn.Module):
    """Adam on N sets of K parameters, each in its coordinates by `whitenings` (N, K, K), see `whitening`."""

    def __init__(self, whitenings: np.ndarray):
        super().__init__()
        self._whitenings = torch.from_numpy(whitenings)
        shape = whitenings.shape[:2]
        self.first = nn.Buffer(torch.zeros(shape, dtype=torch.float64))
        self.second = nn.Buffer(torch.zeros(shape, dtype=torch.float64))
        self.steps = nn.Buffer(torch.zeros((), dtype=torch.int64))

    def change(self, gradient: Tensor, rate: float) -> Tensor:
        """Return the change (N, K) of the parameters for their gradient (N, K)."""
        white = (self._whitenings @ gradient[..., None])[..., 0]  # symmetric: its own transpose
        self.steps.add_(1)
        self.first.lerp_(white, 1 - BETAS[0])
        self.second.lerp_(white.square(), 1 - BETAS[1])
        steps = int(self.steps)
        mean = self.first / (1 - BETAS[0] ** steps)
        spread = (self.second / (1 - BETAS[1] ** steps)).sqrt()
        return -rate * (self._whitenings @ (mean / (spread + EPS))[..., None])[..., 0]


class Delayed:
    """Copies of tensors for the host.

    On a GPU they are those of the previous call, which have arrived meanwhile; on the CPU nothing is copied or delayed.
    """

    def __init__(self) -> None:
        self._sent: tuple[tuple[Tensor, ...], torch.cuda.Event] | None = None

    def exchange(self, *tensors: Tensor) -> tuple[Tensor, ...] | None:
        """Send tensors from their device, and return those sent before; None if there are none."""
        device = tensors[0].device
        if device.type == "cpu":
            return tensors
        before, event = self.take(), torch.cuda.Event()
        copies = tuple(tensor.detach().to("cpu", non_blocking=True) for tensor in tensors)  # in pinned memory
        event.record(torch.cuda.current_stream(device))
        self._sent = copies, event
        return before

    def take(self) -> tuple[Tensor, ...] | None:
        """Wait for the tensors sent last and return them, once; None if there are none."""
        if self._sent is None:
            return None
        (copies, event), self._sent = self._sent, None
        event.synchronize()
        return copies

    def forget(self) -> None:
        """Drop the tensors sent last."""
        self._sent = None


def on_device_of(like: Tensor, values: np.ndarray) -> Tensor:
    """Return an array as a tensor with the type and on the device of another; the host does not wait for the copy."""
    tensor = torch.from_numpy(values).to(like.dtype)
    return tensor if like.device.type == "cpu" else tensor.pin_memory().to(like.device, non_blocking=True)
