"""The server of the interactive page: an address with a token, the newest field, rendered pictures."""

import hmac
import json
import secrets
import socket
import sys
from collections.abc import Iterator
from errno import EACCES, EADDRINUSE
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Protocol
from urllib.parse import parse_qs, urlsplit

from nerfcli.errors import UserError

# The first port to try, and the number of ports to try.
FIRST_PORT, PORTS_TRIED = 8123, 50
MOST_REQUEST_BYTES = 65536
_HEADERS = {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"}


class PageData(Protocol):
    """Data source of the page, called from several threads. A UserError becomes a message on the page."""

    def page(self) -> str:
        """Return the HTML of the page; browsers retry after a UserError, as when there is no field yet."""

    def field(self) -> bytes:
        """Return the parameters of the newest field, with a description."""

    def proof(self) -> bytes:
        """Return reference pictures of the newest field."""

    def photo(self, index: int, longest_px: int) -> bytes:
        """Return the JPEG of a photo; raise LookupError if there is none."""

    def picture(self, client: str, view: Any) -> Iterator[bytes]:
        """Yield the parts of a picture, see `Painter.paint`; raise ValueError for an invalid view."""

    def version(self) -> int:
        """Return the version number of the newest field, 0 if there is none yet."""


# Only this machine can reach it.
LOCAL = "127.0.0.1"


class PageServer(ThreadingHTTPServer):
    """Serves a show; by default only to this machine, at the first free port from `FIRST_PORT`.

    Raises:
        UserError: the port is taken, or the address does not exist.
    """

    daemon_threads = True
    # On Windows this option would let a second server take the port of the first.
    allow_reuse_address = sys.platform != "win32"

    def __init__(self, show: PageData, host: str = LOCAL, *, port: int | None = None):
        self.show = show
        self.token = secrets.token_urlsafe(16)
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        ports = [port] if port is not None else [*range(FIRST_PORT, FIRST_PORT + PORTS_TRIED), 0]
        for candidate in ports:
            try:
                super().__init__((host, candidate), _Handler)
                break
            except OSError as error:
                # Windows answers EACCES for some ports that are in use.
                if candidate == ports[-1] or error.errno not in (EADDRINUSE, EACCES):
                    raise _cannot_listen(host, candidate, error) from error

    @property
    def port(self) -> int:
        return self.server_address[1]

    def url(self, host: str) -> str:
        """Return the address of the page for a browser that reaches this machine as `host`."""
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/{self.token}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore lost connections; report all other errors."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    timeout = 60.0  # seconds, for a client that sends nothing

    @property
    def _of(self) -> PageServer:
        assert isinstance(self.server, PageServer)
        return self.server

    def do_GET(self) -> None:
        show, binary = self._of.show, "application/octet-stream"
        self._answer(
            {
                "": lambda: self._send(HTTPStatus.OK, "text/html; charset=utf-8", show.page()),
                "photo": self._photo,
                "version": lambda: self._send(HTTPStatus.OK, "application/json", json.dumps(show.version())),
                "field": lambda: self._send(HTTPStatus.OK, binary, show.field()),
                "proof": lambda: self._send(HTTPStatus.OK, binary, show.proof()),
            }
        )

    def do_POST(self) -> None:
        self._answer({"picture": self._picture})

    def _answer(self, places: dict[str, Any]) -> None:
        address = urlsplit(self.path)
        _, token, place = (address.path + "//").split("/", 3)[:3]
        if not hmac.compare_digest(token.encode(), self._of.token.encode()):
            self._send(
                HTTPStatus.FORBIDDEN, "text/plain", "wrong token: open the complete address that nerfcli wrote\n"
            )
            return
        self._query = {name: values[-1] for name, values in parse_qs(address.query).items()}
        try:
            places[place]()
        except UserError as error:  # a browser asks again: a field may be written soon; scripts ignore it
            text = f"{error.message}: {error.hint}\n"
            self._send(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain; charset=utf-8", text, {"Refresh": "2"})
        except ValueError as error:
            self._send(HTTPStatus.BAD_REQUEST, "text/plain", str(error))
        except LookupError:
            self._send(HTTPStatus.NOT_FOUND, "text/plain", "there is nothing here\n")

    def _photo(self) -> None:
        content = self._of.show.photo(int(self._query.get("n", "")), int(self._query.get("px", "800")))
        self._send(HTTPStatus.OK, "image/jpeg", content, {"Cache-Control": "private, max-age=3600"})

    def _picture(self) -> None:
        content = self._body()
        parts = self._of.show.picture(str(content.get("client")), content.get("view"))
        first = next(parts, None)  # errors of the view or the field appear here, before the response begins
        self._begin("application/octet-stream")
        try:
            if first is not None:
                self.wfile.write(first)
            for part in parts:
                self.wfile.write(part)
        finally:
            parts.close()  # type: ignore[attr-defined]

    def _body(self) -> dict[str, Any]:
        length = int(self.headers.get("Content-Length", ""))
        if not 0 <= length <= MOST_REQUEST_BYTES:
            raise ValueError(f"a request of {length} bytes")
        content = json.loads(self.rfile.read(length))
        if not isinstance(content, dict):
            raise ValueError("the request is no object")
        return content

    def _begin(self, kind: str, status: HTTPStatus = HTTPStatus.OK, more: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for name, value in {"Content-Type": kind, **_HEADERS, **(more or {})}.items():
            self.send_header(name, value)
        self.end_headers()

    def _send(self, status: HTTPStatus, kind: str, content: str | bytes, more: dict[str, str] | None = None) -> None:
        if isinstance(content, str):
            content = content.encode(errors="backslashreplace")  # names of files may be no UTF-8
        self._begin(kind, status, {"Content-Length": str(len(content)), **(more or {})})
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing for each request."""


def _cannot_listen(host: str, port: int, error: OSError) -> UserError:
    if error.errno in (EADDRINUSE, EACCES):
        problem = "is in use" if error.errno == EADDRINUSE else "is denied by the system, as ports below 1024 often are"
        hint = "choose another one, or omit --port to use the next free one"
        return UserError(f"port {port} of {host} {problem}", hint)
    return UserError(
        f"cannot listen on {host}: {error.strerror or error}", "give an address of this machine with --host"
    )
