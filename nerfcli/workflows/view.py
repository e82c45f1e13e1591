"""Serve the interactive page of a run: new fields during its training, and CPU renderings for browsers without a GPU.

No heavy module is imported before a page is opened: a server without a viewer costs a training next to nothing.
"""

import getpass
import os
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfcli.errors import UserError
from nerfcli.runs.files import CONFIG, FIELD
from nerfcli.runs.live import (
    TRAINING_SECONDS,
    Pulse,
    Request,
    Status,
    end_request,
    live_field,
    read_status,
    write_request,
)
from nerfcli.viewer.server import PageServer, serve

if TYPE_CHECKING:
    from nerfcli.render.model import Model

LOCAL = "127.0.0.1"
# Interval between the server's checks of the run; time for which it requests fields from a training after a page load.
TICK_SECONDS, LOADING_SECONDS = 0.5, 10.0


def view_run(
    run: str | Path,
    *,
    host: str = LOCAL,
    port: int | None = None,
    threads: int = 0,
    browser: bool = False,
    on_ready: Callable[[str, str], None],
) -> None:
    """Serve the page of a run until interrupted.

    Args:
        run: the folder that `train_scene` wrote, or is writing.
        host: address to listen on; the default can be reached only from this machine.
        port: to listen on; None for the first free one from 8123 on.
        threads: number of CPU threads for pictures; 0 for all.
        on_ready: called with the page's address and the command that makes it work on another machine ("" for none).

    Raises:
        UserError: the run does not exist, or the port is taken.
        KeyboardInterrupt: Ctrl-C; the server has stopped.
    """
    path = Path(run)
    show = RunData(path, threads=threads)
    show.check()
    server = PageServer(show, host=host, port=port)
    local = host in (LOCAL, "0.0.0.0", "::", "::1", "localhost")
    url = server.url(LOCAL if host in ("0.0.0.0", "::") else host)
    on_ready(url, _from_elsewhere(server.port) if local else "")
    if browser:
        open_browser(url)
    try:
        serve(server, tick=TICK_SECONDS, on_tick=lambda: show.tick(server))
    finally:
        show.close()


def open_browser(url: str) -> None:
    """Open a page in a browser, if this machine has a screen and is not used over SSH."""
    has_screen = sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if has_screen and "SSH_CONNECTION" not in os.environ:
        webbrowser.open(url)


def _from_elsewhere(port: int) -> str:
    return f"ssh -L {port}:{LOCAL}:{port} {getpass.getuser()}@{socket.gethostname()}"


class RunData:
    """Data of a run for the server, see `viewer.server.PageData`.

    Args:
        threads: number of CPU threads for pictures; 0 for all.
    """

    def __init__(self, path: Path, *, threads: int):
        self._path, self._threads = path, threads
        self._pulse = Pulse(TRAINING_SECONDS)
        self._lock = threading.RLock()
        self._request = Request(0)
        self._loaded_until = 0.0
        self._status: Status | None = None
        self._seen_training = False
        self._files: tuple[Any, ...] = ()
        self._version = 0
        self._loaded: tuple[int, Model] | None = None
        self._encoded: tuple[int, bytes] | None = None
        self._painter: Any = None
        self._opened: Any = None

    def check(self) -> None:
        """Refuse a folder that is not a run.

        Raises:
            UserError: the folder is not a run.
        """
        if not (self._path / CONFIG).exists():
            from nerfcli.runs.config import no_run

            raise no_run(self._path)

    def tick(self, server: PageServer) -> None:
        """Check the run, and tell its training whether a page is open; called in the server's thread."""
        with self._lock:
            loading = time.monotonic() < self._loaded_until
            if server.clients > 0 or loading or self._request.paused or self._request.stop:
                self._ask()
            elif self._request.count:
                end_request(self._path)
            before = (self._status, self._version, self._training)
            status = read_status(self._path)
            lives = self._pulse.beats(None if status is None else status.count)
            self._status = status if lives else None
            self._seen_training = self._seen_training or lives
            files = _stamp(self._field_path())
            if files != self._files:
                self._files, self._version = files, self._version + 1
            changed = before != (self._status, self._version, self._training)
        if changed:
            server.announce()

    def close(self) -> None:
        """Withdraw the request to a training."""
        with self._lock:
            end_request(self._path)

    def page(self) -> str:
        from nerfcli.photos.undistorted import pinhole_frame
        from nerfcli.runs.run import Run
        from nerfcli.viewer.page import live_page_html
        from nerfcli.viewer.pictures import fetched_photos

        self._loaded_until = time.monotonic() + LOADING_SECONDS
        version, model = self.model()
        cameras = Run(self._path).cameras
        frames = [pinhole_frame(frame) for frame in (*cameras.train, *cameras.test)]
        return live_page_html(
            model,
            run=self._path,
            frames=frames,
            photos=fetched_photos(model, cameras.train, cameras.test),
            box=_box(model, frames, trained=not self._training),
            version=version,
            refusal=_refusal(model),
        )

    def field(self) -> bytes:
        from nerfcli.viewer.live_data import field_bytes
        from nerfcli.viewer.packing import pack_model

        version, model = self.model()
        with self._lock:
            if self._encoded is None or self._encoded[0] != version:
                self._encoded = version, field_bytes(pack_model(model), version)
            return self._encoded[1]

    def proof(self) -> bytes:
        from nerfcli.photos.undistorted import pinhole_frame
        from nerfcli.runs.run import Run
        from nerfcli.viewer.live_data import proof_bytes
        from nerfcli.viewer.proof import make_proof

        cameras = Run(self._path).cameras
        return proof_bytes(make_proof(self.model()[1], [pinhole_frame(f) for f in (*cameras.train, *cameras.test)]))

    def photo(self, index: int, longest_px: int) -> bytes:
        from nerfcli.runs.run import Run
        from nerfcli.viewer.pictures import photo_jpeg

        cameras = Run(self._path).cameras
        return photo_jpeg(cameras.train, cameras.test, index, longest_px=min(max(longest_px, 16), 2000))

    def picture(self, client: str, view: Any) -> Iterator[bytes]:
        from nerfcli.viewer.painter import Painter, view_from_json
        from nerfcli.workflows.machine import thread_count

        wanted = view_from_json(view)
        with self._lock:
            if self._painter is None:
                self._painter = Painter(self.model, threads=thread_count(self._threads))
        return self._painter.paint(client, wanted)

    def status(self) -> dict[str, Any]:
        with self._lock:
            status = self._status
            if status is None:
                return {"state": "ended" if self._seen_training else "none", "version": self._version}
            return {
                "state": "paused" if status.paused else "training",
                "version": self._version,
                "share": status.fraction,
                "step": status.step,
                "seconds": round(status.seconds, 1),
                "loss": status.loss,
                "stopping": self._request.stop,
            }

    def control(self, action: str) -> None:
        with self._lock:
            paused = action == "pause"
            self._request = Request(self._request.count, paused=paused, stop=action == "stop")
            self._ask()

    def model(self) -> "tuple[int, Model]":
        """Return the version number of the newest field, and its model.

        Raises:
            UserError: there is no field yet, or it cannot be read.
        """
        from nerfcli.render.model import load_model

        with self._lock:
            if self._loaded is None or self._loaded[0] != self._version:
                path = self._field_path()
                if not path.exists():
                    raise UserError(f"{self._path} has no field yet", "wait until its training has begun")
                self._loaded = self._version, load_model(path, "cpu")
            return self._loaded

    @property
    def _training(self) -> bool:
        return self._status is not None

    def _ask(self) -> None:
        self._request = Request(self._request.count + 1, paused=self._request.paused, stop=self._request.stop)
        write_request(self._path, self._request)

    def _field_path(self) -> Path:
        """Return the last checkpoint or the field that a training wrote for viewers, whichever is newer."""
        live, saved = live_field(self._path), self._path / FIELD
        return live if _stamp(live)[0] > _stamp(saved)[0] else saved


def _stamp(path: Path) -> tuple[int, int]:
    """Return a file's modification time and, as that is coarse, its inode number; zeros if the file does not exist."""
    try:
        status = path.stat()
    except OSError:
        return 0, 0
    return status.st_mtime_ns, status.st_ino


def _refusal(model: "Model") -> str | None:
    """Return the reason why a page cannot draw a field by itself; None if it can."""
    from nerfcli.viewer.packing import pack_model

    try:
        pack_model(model)
    except UserError as error:
        return error.message
    return None


def _box(model: "Model", frames: Any, *, trained: bool) -> tuple[float, ...]:
    """Return the box around the subject of the photos; during training, the cube around the training frame's ball."""
    import numpy as np

    from nerfcli.surface.extent import scene_box

    if trained:
        try:
            return scene_box(model, frames)
        except UserError:  # the cameras see no surface; viewers may want to see that
            pass
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    placed = model.training_from_scene.inverse().apply(corners)
    return (*placed.min(0).tolist(), *placed.max(0).tolist())
