"""Distribute frames over threads or processes, one frame at a time for each.

Kernels release Python's lock, so that threads suffice for most fields. A crashed process is reported and its frame
rendered again.
"""

import atexit
import gc
import multiprocessing
import signal
import threading
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from typing import Any, Protocol

import torch

from nerfcli.errors import OUT_OF_MEMORY, UserError
from nerfcli.export.order import Order
from nerfcli.interrupts import deferred_interrupts

# A frame at which processes died this many times is not retried.
_MOST_DEATHS = 2
# The exception that ends a process may be lost: Python drops those raised in callbacks and while freeing objects. The
# process then ends after its frame, because the connection is closed; a process that hangs is killed.
_SECONDS_TO_LEAVE = 60


class RenderOne(Protocol):
    """`one_frame.render_frame` for a certain model, order and unfinished folder."""

    def __call__(self, index: int, *, on_rays: Callable[[int], None]) -> None:
        """Render the frame with this index."""
        ...


def render_in_threads(
    render_one: RenderOne, indices: Sequence[int], *, at_a_time: int, threads: int, on_rays: Callable[[int], None]
) -> None:
    """Render frames on the CPU, several at a time.

    The first exception stops all threads after their current tile; complete frames are kept.

    Args:
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
            render_one(index, on_rays=count)
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


@dataclass
class _Worker:
    process: SpawnProcess
    connection: Any  # a Connection; on Windows a PipeConnection
    index: int = -1


def render_in_processes(
    render_one: RenderOne,
    order: Order,
    indices: Sequence[int],
    *,
    jobs: int,
    threads: int,
    on_rays: Callable[[int], None],
    notify: Callable[[str], None],
) -> None:
    """Render frames of an order in several processes. None of them outlives the call.

    Args:
        threads: number of threads of all processes together; each process has at least one.
        on_rays: called with the number of rays of each finished frame.

    Raises:
        UserError: a file cannot be written, or processes keep dying at a frame.
        RuntimeError: another failure in a process, with its traceback.
    """
    context = multiprocessing.get_context("spawn")  # torch's and numba's threads do not survive a fork
    left, deaths, workers = deque(indices), Counter[int](), list[_Worker]()

    def start() -> None:
        ours, theirs = context.Pipe()
        fraction = max(1, threads // jobs)
        process = context.Process(target=_serve, args=(theirs, render_one, fraction), daemon=True)
        with _interrupts_kept():  # a deferred interrupt is raised at the end, when the process is in the list
            process.start()
            workers.append(_Worker(process, ours))
        theirs.close()
        give(workers[-1])

    def give(worker: _Worker) -> None:
        worker.index = left.popleft()
        with suppress(ConnectionError):  # it died meanwhile: `wait` will report that
            worker.connection.send(worker.index)

    try:
        for _ in range(jobs):
            start()
        while workers:
            ready = wait([worker.connection for worker in workers])
            for worker in [worker for worker in workers if worker.connection in ready]:
                try:
                    failure = worker.connection.recv()
                except (EOFError, ConnectionError):  # the latter if it never read its index
                    workers.remove(worker)
                    deaths[worker.index] += 1
                    _tell_death(worker, order, notify, last=deaths[worker.index] == _MOST_DEATHS)
                    left.appendleft(worker.index)
                    start()
                    continue
                if failure is not None:
                    raise failure.error()
                on_rays(order.rays(worker.index))
                if left:
                    give(worker)
                else:
                    workers.remove(worker)
                    worker.connection.close()
                    worker.process.join()
    finally:
        for worker in workers:
            worker.process.terminate()
            worker.connection.close()
        for worker in workers:
            worker.process.join(_SECONDS_TO_LEAVE)
            worker.process.kill()
            worker.process.join()


@dataclass(frozen=True)
class _Failure:
    """Failure that a process reports instead of None; exceptions themselves cannot be sent."""

    text: str
    hint: str | None = None
    exit_code: int = 0

    def error(self) -> Exception:
        if self.hint is None:
            return RuntimeError(f"a process of --jobs failed:\n{self.text}")
        return UserError(self.text, self.hint, self.exit_code)


def _serve(connection: Any, render_one: RenderOne, threads: int) -> None:
    """Render the frames whose indices are received, until the connection is closed."""
    atexit.register(gc.freeze)  # as in `nerfcli.__main__`
    torch.set_num_threads(threads)
    signal.signal(signal.SIGTERM, _leave)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    while True:
        try:
            index = connection.recv()
        except (EOFError, ConnectionError):
            return
        try:
            render_one(index, on_rays=lambda rays: None)
            report = None
        except UserError as error:
            report = _Failure(error.message, error.hint, error.exit_code)
        except Exception:
            report = _Failure(traceback.format_exc())
        try:
            connection.send(report)
        except ConnectionError:  # the other process is gone
            return


def _leave(number: int, _: object) -> None:
    """End the process by an exception, so that files in writing are removed first."""
    raise SystemExit(128 + number)


def _tell_death(worker: _Worker, order: Order, notify: Callable[[str], None], *, last: bool) -> None:
    worker.process.join()
    code, name = worker.process.exitcode or 0, order.names[worker.index]
    how = f"was ended by signal {-code} ({signal.Signals(-code).name})" if code < 0 else f"ended with status {code}"
    if not last:
        notify(f"a render process {how} while rendering {name}; retrying it in another process")
        return
    raise UserError(
        f"render processes keep failing on {name}: the last one {how}",
        "if memory ran out, use fewer --jobs or smaller pictures; completed frames are kept",
        OUT_OF_MEMORY,
    )


@contextmanager
def _interrupts_kept() -> Iterator[None]:
    """Start processes that ignore Ctrl-C, and SIGTERM until they are ready: this process ends them.

    Starting takes seconds, because the new process reads the model only after it is up. Interrupts of this process are
    deferred meanwhile: a new process that is abandoned while it reads the model prints errors.
    """
    with deferred_interrupts() as interrupts:
        if hasattr(signal, "pthread_sigmask"):
            resource_tracker.ensure_running()  # otherwise it starts with the first process, and unblocks signals
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
            try:
                yield
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
        else:  # Windows
            yield
    interrupts.raise_if_pending()
