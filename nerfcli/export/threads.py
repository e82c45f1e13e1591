"""Distribute frames over threads of this process, one frame at a time each: kernels run without Python's lock."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed

import torch

from nerfcli.export.one_frame import render_frame
from nerfcli.export.order import Order
from nerfcli.export.unfinished import Unfinished
from nerfcli.render.model import Model


def render_in_threads(
    model: Model,
    order: Order,
    indices: Sequence[int],
    *,
    unfinished: Unfinished,
    at_a_time: int,
    threads: int,
    on_rays: Callable[[int], None],
) -> None:
    """Render frames of an order, several at a time; see `render_frame`.

    The first exception ends the others after their current tile; frames that are complete are kept.

    Args:
        model: the trained model, on the CPU.
        order: what is to be rendered.
        indices: of the frames.
        unfinished: where the frames of the order gather.
        at_a_time: number of frames in progress.
        threads: of all frames together; each has one at least.
        on_rays: called with the number of rays of each tile, by one thread at a time.
    """
    stopped, lock, before = threading.Event(), threading.Lock(), torch.get_num_threads()

    def count(rays: int) -> None:
        if stopped.is_set():
            raise CancelledError
        with lock:
            on_rays(rays)

    def render(index: int) -> None:
        render_frame(model, order, index, unfinished=unfinished, on_rays=count)

    each = max(1, threads // at_a_time)
    with ThreadPoolExecutor(at_a_time, initializer=torch.set_num_threads, initargs=(each,)) as pool:
        try:
            for future in as_completed([pool.submit(render, index) for index in indices]):
                future.result()
        except BaseException:
            stopped.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        finally:
            torch.set_num_threads(before)
