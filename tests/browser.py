"""A headless Chromium that a test drives through its debugging pipe: no port, no driver, no dependency."""

import base64
import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
# Software rendering on a busy machine compiles a shader in seconds.
SECONDS = 180.0


def find_browser() -> str | None:
    """Return the path of the browser's program, or None if there is none."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


needs_browser = pytest.mark.skipif(find_browser() is None, reason="there is no Chromium here to open the page with")


class Browser:
    """One page in its own browser process.

    Args:
        folder: for its profile.
        width, height: of the window.
        flags: additional command-line options of the browser.
    """

    def __init__(self, folder: Path, *, width: int = 480, height: int = 360, flags: tuple[str, ...] = ()):
        program = find_browser()
        assert program is not None
        to_browser, self._write = os.pipe()
        self._read, from_browser = os.pipe()
        options = (
            *("--headless", "--no-sandbox", "--disable-dev-shm-usage", "--remote-debugging-pipe", "--mute-audio"),
            *(f"--user-data-dir={folder}", f"--window-size={width},{height}", "--enable-unsafe-swiftshader", *flags),
        )

        def descriptors() -> None:
            # Duplicated first, as the pipes themselves may already be descriptors 3 and 4.
            reads, writes = os.dup(to_browser), os.dup(from_browser)
            os.dup2(reads, 3)
            os.dup2(writes, 4)

        self._process = subprocess.Popen(
            [program, *options, "about:blank"],
            preexec_fn=descriptors,
            close_fds=False,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser)
        os.close(from_browser)
        self._number, self._rest, self._session = 0, b"", None
        self.errors: list[str] = []
        targets = self.send("Target.getTargets")["targetInfos"]
        page = next(target for target in targets if target["type"] == "page")
        attached = self.send("Target.attachToTarget", targetId=page["targetId"], flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime"):
            self.send(f"{domain}.enable")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._process.terminate()
        self._process.wait()
        os.close(self._write)
        os.close(self._read)

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command of the DevTools protocol and return its answer."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("method") == "Runtime.exceptionThrown":
                details = answer["params"]["exceptionDetails"]
                self.errors.append(details.get("exception", {}).get("description", details["text"]))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            got = os.read(self._read, 2**20)
            assert got, "the browser has ended"
            self._rest += got
        message, self._rest = self._rest.split(b"\0", 1)
        return json.loads(message)

    def open(self, page: Path, fragment: str = "") -> None:
        """Load a page from disk and wait until it has started or reported why it cannot."""
        self.visit(page.resolve().as_uri() + fragment)

    def visit(self, url: str) -> None:
        """Load a page by its URL and wait, like `open`."""
        self.send("Page.navigate", url="about:blank")
        self.send("Page.navigate", url=url)
        self.wait("document.body && document.body.dataset.state")

    def run(self, script: str) -> Any:
        """Return the value of an expression in the page."""
        answer = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait(self, script: str, *, seconds: float = SECONDS) -> Any:
        """Wait until an expression is truthy and return its value."""
        end = time.monotonic() + seconds
        while not (value := self.run(script)):
            assert time.monotonic() < end, f"waited {seconds:g} s for {script}; {self.errors}"
            time.sleep(0.05)
        return value

    def key(self, key: str, *, seconds: float = 0.0) -> None:
        """Press a key, and hold it for `seconds`."""
        text = {"text": key} if len(key) == 1 else {}
        self.send("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        time.sleep(seconds)
        self.send("Input.dispatchKeyEvent", type="keyUp", key=key)

    def click(self, x: float, y: float) -> None:
        """Click with the left button."""
        for kind in ("mousePressed", "mouseReleased"):
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drag with the left button."""
        mouse = "Input.dispatchMouseEvent"
        self.send(mouse, type="mousePressed", x=start[0], y=start[1], button="left", clickCount=1)
        for fraction in (0.5, 1.0):
            x, y = (a + fraction * (b - a) for a, b in zip(start, end, strict=True))
            self.send(mouse, type="mouseMoved", x=x, y=y, button="left", buttons=1)
        self.send(mouse, type="mouseReleased", x=end[0], y=end[1], button="left", clickCount=1)

    def screenshot(self, path: Path) -> None:
        """Write a PNG of the window."""
        path.write_bytes(base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"]))
