"""HTML page around the content of a command: head, common style, origin; and writing the page."""

import hashlib
import json
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError

# An earlier page of the same kind is recognised by a mark within this many bytes from its beginning.
_HEAD_BYTES = 4096


@dataclass(frozen=True)
class Mark:
    """Mark of a page's source, which does not reveal its path.

    Args:
        kind: the command that wrote it.
        source: the folder that it is about.
    """

    kind: str
    source: Path

    def html(self) -> str:
        """Return the HTML of the mark for the page's head."""
        identity = hashlib.sha256(str(self.source.resolve()).encode()).hexdigest()[:16]
        return f'<meta name="nerfcli-{self.kind}" content="{identity}">'


def page_html(
    *,
    title: str,
    mark: Mark,
    style: str,
    body: str,
    script: str = "",
    origin: str | None = None,
    connect: bool = False,
) -> str:
    """Return a complete page that loads nothing, enforced by a content security policy.

    Args:
        title: plain text.
        style: CSS that follows `page.css`.
        body: HTML, in which all outside text is escaped.
        script: JavaScript that runs once the body exists; for its data see `data_element`.
        origin: a digest of what the page was made from, for `is_made_from`.
        connect: True to let the page fetch from its own server, and no other.
    """
    server = " 'self'" if connect else ""
    return _PAGE.substitute(
        mark=mark.html() + ("" if origin is None else f"\n{_origin_html(origin)}"),
        title=escape(title),
        kind=mark.kind,
        policy=f"default-src 'none'; img-src data:{server}; style-src 'unsafe-inline'"
        + ("; script-src 'unsafe-inline'" if script else "")
        + ("; connect-src 'self'" if connect else ""),
        style=asset("page.css") + style,
        body=body,
        script=f"<script>{script}</script>\n" if script else "",
    )


def data_element(name: str, content: Any) -> str:
    """Return data for the page's script, which reads it by JSON.parse(document.getElementById(name).textContent).

    Raises:
        ValueError: NaN or infinity, which JSON cannot represent.
    """
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    # Only these characters can end a script element or begin another one inside it.
    safe = text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
    return f'<script type="application/json" id="{escape(name)}">{safe}</script>'


@cache
def asset(name: str) -> str:
    """Return the text of a style sheet or script next to this file."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def write_page(text: str, path: Path) -> None:
    """Write a page, atomically.

    Raises:
        UserError: it cannot be written.
    """
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8")


def is_made_from(path: Path, origin: str) -> bool:
    """Return whether the page at a path was made from content with this digest."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return _origin_html(origin).encode() in file.read(_HEAD_BYTES)


def _origin_html(origin: str) -> str:
    return f'<meta name="nerfcli-made-from" content="{origin}">'


def refuse_foreign(path: Path, mark: Mark, *, about: str) -> None:
    """Raise unless a page may be written at a path: it is free, or holds an earlier page with the same mark.

    Args:
        about: the subject of such a page, for the message: "capture".

    Raises:
        UserError: something else exists there.
    """
    if not path.exists():
        return
    if path.is_file():
        with path.open("rb") as file:
            if mark.html().encode() in file.read(_HEAD_BYTES):
                return
    raise UserError(
        f"{path} exists and is not a page of this {about}",
        "add --overwrite to replace it, or choose another file with -o",
    )


_PAGE = Template("""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
$mark
<meta http-equiv="Content-Security-Policy" content="$policy">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>$title: nerfcli $kind</title>
<style>
$style</style></head><body><main>
$body
</main>
$script</body></html>
""")
