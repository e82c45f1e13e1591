"""Distribute frames over threads of this process, one frame per thread at a time: kernels release Python's lock."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed

import torch

from nerfcli.export.one_frame import render_frame
from nerfcli.export.order import Order
from nerfcli.export.unfinished import UnfinishedFrames
from nerfcli.render.model import Model


def render_in_threads(
    model: Model,
    order: Order,
    indices: Sequence[int],
    *,
    unfinished: UnfinishedFrames,
    at_a_time: int,
    threads: int,
    on_rays: Callable[[int], None],
) -> None:
    """Render frames of an order, several at a time; see `render_frame`.

    The first exception stops all threads after their current tile; complete frames are kept.

    Args:
        model: the trained model, on the CPU.
        at_a_time: number of frames in progress.
        threads: number of threads of all frames together; each frame has at least one.
        on_rays: called with the number of rays of each tile, by one thread at a time.
    """
    stopped, lock, before = threading.Event(), threading.Lock(), torch.get_num_threads()

    def count(rays: int) -> None:
        if stopped.is_set():
            raise CancelledError
        with lock:
            on_rays(rays)

    def render(index: int) -> None:
        if stopped.is_set():
            return
        try:
            render_frame(model, order, index, unfinished=unfinished, on_rays=count)
        except CancelledError:
            return  # because of another frame's exception, which is raised below
        except BaseException:
            stopped.set()  # here, since the main thread may hear of it only after the others have rendered more
            raise

    each = max(1, threads // at_a_time)
    with ThreadPoolExecutor(at_a_time, initializer=torch.set_num_threads, initargs=(each,)) as pool:
        try:
            for future in as_completed([pool.submit(render, index) for index in indices]):
                future.result()
        except BaseException:
            stopped.set()  # Ctrl-C arrives in this thread
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        finally:
            torch.set_num_threads(before)
