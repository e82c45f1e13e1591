"""Serve the interactive page of a run: its newest checkpoint, and CPU renderings for browsers without a GPU."""

import getpass
import json
import os
import shlex
import socket
import struct
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.errors import UserError
from nerfcli.export.extent import scene_box
from nerfcli.machine import Resources
from nerfcli.photos.loading import pinhole_frame
from nerfcli.render.model import Model, load_model
from nerfcli.training.runs.files import CONFIG, FIELD
from nerfcli.training.runs.run import Run, no_run
from nerfcli.viewer.packing import pack_model
from nerfcli.viewer.page import live_page_html, scene_of
from nerfcli.viewer.painter import Painter, view_from_json
from nerfcli.viewer.pictures import fetched_photos, make_proof, photo_jpeg
from nerfcli.viewer.server import LOCAL, PageServer


def view_run(
    run: str | Path,
    *,
    host: str = LOCAL,
    port: int | None = None,
    resources: Resources = Resources(),
    on_ready: Callable[[str, str], None],
) -> None:
    """Serve the page of a run until interrupted.

    Args:
        run: the folder that `train_scene` wrote, or is writing.
        host, port: where to listen; see `PageServer`.
        resources: threads for pictures.
        on_ready: called with the page's address and the command that makes it work on another machine ("" for none).

    Raises:
        UserError: the run does not exist, or the port is taken.
        KeyboardInterrupt: Ctrl-C; the server has stopped.
    """
    path = Path(run)
    if not (path / CONFIG).exists():
        raise no_run(path)
    reached = {"0.0.0.0": LOCAL, "::": "::1"}.get(host, host)
    with PageServer(RunData(path, resources), host, port=port) as server:
        local = reached in (LOCAL, "::1", "localhost")
        on_ready(server.url(reached), _from_elsewhere(reached, server.port) if local else "")
        server.serve_forever()


def open_browser(url: str) -> None:
    """Open a page in a browser, if this machine has a screen and is not used over SSH."""
    has_screen = sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if has_screen and "SSH_CONNECTION" not in os.environ:
        webbrowser.open(url)


def _from_elsewhere(host: str, port: int) -> str:
    """Return the command that makes an address of this machine reachable from another one."""
    try:
        user = f"{getpass.getuser()}@"
    except (KeyError, OSError):  # a container's user may have no name
        user = ""
    forward = shlex.quote(f"{port}:{f'[{host}]' if ':' in host else host}:{port}")
    return f"ssh -L {forward} {user}{socket.gethostname()}"


class RunData:
    """Data of a run for the server, see `viewer.server.PageData`."""

    def __init__(self, path: Path, resources: Resources):
        self._path = path
        self._lock = threading.RLock()
        self._stamp, self._version = (0, 0), 0
        self._loaded: tuple[int, Model] | None = None
        self._encoded: tuple[int, bytes] | None = None
        self._painter = Painter(self.model, threads=resources.cores)

    def version(self) -> int:
        with self._lock:
            stamp = _stamp(self._path / FIELD)
            if stamp != self._stamp:
                self._stamp, self._version = stamp, self._version + 1
            return self._version

    def page(self) -> str:
        version, model = self.model()
        run, frames = Run(self._path), self._frames()
        photos = fetched_photos(run.cameras.exposures, run.cameras.train, run.cameras.test)
        scene = scene_of(
            model,
            run=self._path,
            frames=frames,
            photos=photos,
            box=_box(model, [*run.cameras.train, *run.cameras.test]),
        )
        return live_page_html(scene, version=version, refusal=self._refusal(), far=model.marching.far)

    def field(self) -> bytes:
        version, model = self.model()
        with self._lock:
            if self._encoded is None or self._encoded[0] != version:
                packed = pack_model(model)
                description = {"version": version, "field": packed.field, "march": packed.march}
                self._encoded = version, _bytes(description, packed.arrays)
            return self._encoded[1]

    def proof(self) -> bytes:
        version, model = self.model()
        proof = make_proof(model, self._frames())
        return _bytes({"version": version, "proof": proof.description}, {"expected": proof.expected})

    def photo(self, index: int, longest_px: int) -> bytes:
        cameras = Run(self._path).cameras
        return photo_jpeg(cameras.train, cameras.test, index, longest_px=min(max(longest_px, 16), 2000))

    def picture(self, client: str, view: Any) -> Iterator[bytes]:
        return self._painter.paint(client, view_from_json(view))

    def model(self) -> tuple[int, Model]:
        """Return the version number of the newest field, and its model.

        Raises:
            UserError: there is no field yet, or it cannot be read.
        """
        with self._lock:
            version = self.version()
            if self._loaded is None or self._loaded[0] != version:
                path = self._path / FIELD
                if not path.exists():
                    raise UserError(f"{self._path} has no field yet", "wait for the first checkpoint of its training")
                self._loaded = version, load_model(path, "cpu")
            return self._loaded

    def _refusal(self) -> str | None:
        """Return the reason why a page cannot draw the field by itself; None if it can."""
        try:
            self.field()
        except UserError as error:
            return error.message
        return None

    def _frames(self) -> list[Frame]:
        cameras = Run(self._path).cameras
        return [pinhole_frame(frame) for frame in (*cameras.train, *cameras.test)]


def _stamp(path: Path) -> tuple[int, int]:
    """Return a file's modification time and, as that is coarse, its inode number; zeros if the file does not exist."""
    try:
        status = path.stat()
    except OSError:
        return 0, 0
    return status.st_mtime_ns, status.st_ino


def _bytes(description: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return the JSON length as uint32, the JSON, and the arrays in the order of its list "arrays" of [name, bytes]."""
    listed = [[name, array.nbytes] for name, array in arrays.items()]
    head = json.dumps({**description, "arrays": listed}, allow_nan=False).encode()
    body = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays.values())
    return struct.pack("<I", len(head)) + head + body


def _box(model: Model, frames: Sequence[Frame]) -> tuple[float, ...]:
    """Return the box around the subject of the photos; without one, the cube around the training frame's ball."""
    try:
        return scene_box(model, frames)
    except UserError:  # the cameras see no surface; viewers may want to see that
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
        placed = model.training_from_scene.inverse().apply(corners)
        return (*placed.min(0).tolist(), *placed.max(0).tolist())
