"""HTML pages: templates, head, common style, origin, tables, pictures inside; and writing them."""

import base64
import hashlib
import json
import os
import zlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from markupsafe import Markup

from nerfcli.atomic import atomic_path, refuse_read_only
from nerfcli.errors import UserError
from nerfcli.output import Output

if TYPE_CHECKING:
    from jinja2 import Environment

# An earlier page of the same kind is recognised by a mark within this many bytes from its beginning.
_HEAD_BYTES = 4096
# Sources of content for `page_html`: the page itself, or also the server that sent it.
FROM_INSIDE = {"img-src": "data:"}
FROM_ITS_SERVER = {"img-src": "data: 'self'", "connect-src": "'self'"}


@dataclass(frozen=True)
class Mark:
    """Mark of a page of a kind, the command that wrote it, about a source folder, whose path it does not reveal."""

    kind: str
    source: Path

    def html(self) -> str:
        """Return the HTML of the mark for the page's head."""
        identity = hashlib.sha256(os.fsencode(self.source.resolve())).hexdigest()[:16]
        return f'<meta name="nerfcli-{self.kind}" content="{identity}">'


def page_html(
    *,
    title: str,
    mark: Mark,
    style: str,
    body: str,
    script: str = "",
    origin: str | None = None,
    sources: Mapping[str, str] = FROM_INSIDE,
) -> str:
    """Return a complete page that loads nothing from elsewhere, enforced by a content security policy.

    Args:
        style: CSS that follows `page.css`.
        body: HTML, in which all outside text is escaped.
        script: JavaScript that runs once the body exists; for its data see `data_element`.
        origin: a digest of what the page was made from, for `is_made_from`.
        sources: where its content comes from, by directive of that policy.
    """
    scripts = {"script-src": "'unsafe-inline'"} if script else {}
    policy = {"default-src": "'none'", "style-src": "'unsafe-inline'", **scripts, **sources}
    return rendered(
        "page.html",
        mark=Markup(mark.html()),
        origin=None if origin is None else Markup(_origin_html(origin)),
        title=title,
        kind=mark.kind,
        policy=Markup("; ".join(f"{directive} {source}" for directive, source in policy.items())),
        style=Markup(asset("page.css") + style),
        body=Markup(body),
        script=Markup(script),
    )


def rendered(template: str, **values: Any) -> Markup:
    """Fill in a template of the folder `templates`; what is not HTML from here is shown as text."""
    return Markup(_templates().get_template(template).render(**values))


@cache
def _templates() -> "Environment":
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters: dict[str, Any] = {
        "sentence": lambda text: text[:1].upper() + text[1:] + ".",
        "file_name": lambda name: name.replace("\\", "/").rpartition("/")[2],
    }
    environment.filters |= filters
    return environment


def data_element(name: str, content: Any) -> Markup:
    """Return data for the page's script, which reads it by JSON.parse(document.getElementById(name).textContent).

    Raises:
        ValueError: NaN or infinity, which JSON cannot represent.
    """
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    # Only these characters can end a script element or begin another one inside it.
    safe = text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
    return Markup(f'<script type="application/json" id="{escape(name)}">{safe}</script>')


def array_element(name: str, values: np.ndarray) -> Markup:
    """Return an element that holds an array, see `bytesOf` in arrays.js.

    Bytes of equal significance are grouped, which compresses better; then deflate and base64. Level 9 of deflate would
    take 20 times as long as level 6, for a table 1 % smaller.
    """
    significance = np.ascontiguousarray(values).view(np.uint8).reshape(-1, values.itemsize).T
    text = base64.b64encode(zlib.compress(significance.tobytes(), 6)).decode()
    return Markup(f'<script type="text/plain" id="{escape(name)}" data-itemsize="{values.itemsize}">{text}</script>')


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
        # Names of files that are not UTF-8 are shown with escapes.
        partial.write_text(text, encoding="utf-8", errors="backslashreplace")


def is_made_from(path: Path, origin: str) -> bool:
    """Return whether the page at a path was made from content with this digest."""
    return path.is_file() and _head_has(path, _origin_html(origin))


def _head_has(path: Path, html: str) -> bool:
    """Return whether the head of a page holds a mark or an origin."""
    with path.open("rb") as file:
        return html.encode() in file.read(_HEAD_BYTES)


def _origin_html(origin: str) -> str:
    return f'<meta name="nerfcli-made-from" content="{origin}">'


def claim_page(output: Output, path: Path, mark: Mark, *, about: str) -> None:
    """Raise an error if a page cannot be written to a path, or a file there must not be replaced.

    Pages with the same mark may always be replaced. `about` is their subject, for the message: "capture".

    Raises:
        UserError: the path is a folder, cannot be written, or holds something else.
    """
    if path.is_dir():
        raise UserError(f"{path} is a folder", "give a file name for the page with -o")
    if path.exists() and not output.overwrite and not _head_has(path, mark.html()):
        raise UserError(
            f"{path} exists and is not a page of this {about}",
            "add --overwrite to replace it, or choose another file with -o",
        )
    refuse_read_only(path)


@dataclass(frozen=True)
class Table:
    """A table of plain text, for the macro of `parts.html`; it scrolls sideways where the window is too narrow.

    numbers: indices of the columns that are aligned to the right.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: Collection[int] = ()


JPEG_QUALITY = 85


def data_uri(data: bytes, kind: str) -> str:
    """Return an encoded picture, of kind jpeg or png, as a data URI."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def jpeg_bytes(picture: np.ndarray, *, quality: int = JPEG_QUALITY) -> bytes:
    """Encode a picture (H, W, 3) uint8 sRGB as JPEG."""
    return _encoded(picture, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, quality])


def png_bytes(picture: np.ndarray) -> bytes:
    """Encode a drawing (H, W, 3) uint8 sRGB as PNG, without loss."""
    return _encoded(picture, ".png", [])


def picture_rule(name: str, uri: str) -> str:
    """Return a CSS rule that shows a picture in all elements of a class, so that it is stored only once."""
    return f".{name}{{background-image:url({uri})}}"


def _encoded(picture: np.ndarray, suffix: str, options: list[int]) -> bytes:
    encoded, data = cv2.imencode(suffix, picture[..., ::-1], options)
    assert encoded
    return data.tobytes()
