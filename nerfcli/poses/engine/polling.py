"""Look after computations of pycolmap, which neither report progress nor end by themselves."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def every_second(look: Callable[[], object]) -> Iterator[None]:
    """Call `look` once a second from a thread of its own, until the block ends."""
    finished = threading.Event()

    def watch() -> None:
        while not finished.wait(1.0):
            look()

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield
    finally:
        finished.set()
        watcher.join()
