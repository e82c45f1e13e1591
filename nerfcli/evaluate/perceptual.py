"""LPIPS, if available: the distance of two pictures according to a network trained on human judgements.

The network's weights are not part of any package: torchvision downloads AlexNet's (230 MB) on first use. Without
torchmetrics, torchvision or the weights, LPIPS is left out, with one warning.
"""

import importlib
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch

# Returns the distance of (picture, photo), both (H, W, 3) float in [0, 1].
Perceptual = Callable[[np.ndarray, np.ndarray], float]

NAME = "LPIPS AlexNet v0.1"
INSTALL = "pip install 'nerfcli[lpips]'"
# AlexNet halves a picture so often that nothing is left of a smaller one.
SMALLEST = 32


def find_perceptual(notify: Callable[[str], None]) -> Perceptual | None:
    """Load the perceptual distance; None, with one line for the user, if it is not available.

    Source: Zhang et al. 2018, The unreasonable effectiveness of deep features as a perceptual metric,
    arXiv:1801.03924; computed by torchmetrics.
    """
    try:
        importlib.import_module("torchvision")
        metric = importlib.import_module("torchmetrics.image.lpip").LearnedPerceptualImagePatchSimilarity
    # A torchvision that was built for another torch fails with a RuntimeError or OSError.
    except (ImportError, RuntimeError, OSError) as error:
        notify(f"LPIPS is not available ({_first_line(error)}); install it with {INSTALL}")
        return None
    try:
        with _socket_timeout():
            network = metric(net_type="alex", normalize=True)
    except (RuntimeError, OSError) as error:  # no network (URLError is an OSError), or a truncated file
        notify(f"LPIPS is not available: its weights could not be loaded ({_first_line(error)})")
        return None

    def measure(picture: np.ndarray, photo: np.ndarray) -> float:
        pair = [torch.from_numpy(np.ascontiguousarray(p, dtype=np.float32)) for p in (picture, photo)]
        with torch.no_grad():
            return float(network(*(values.permute(2, 0, 1)[None] for values in pair)))

    return measure


@contextmanager
def _socket_timeout() -> Iterator[None]:
    """Limit the wait for servers that do not answer, for which torch waits forever."""
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(20.0)
    try:
        yield
    finally:
        socket.setdefaulttimeout(before)


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
