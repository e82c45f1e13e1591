"""Transfers between host and device without waiting: the results of a step are read one step later."""

import numpy as np
import torch
from torch import Tensor


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
