"""Read numbers and texts from files that may be damaged.

Whatever is missing, or not as a function expects it, is one `UserError` that names file and field. `where` is always
the file and the place in it, such as "poses.txt: line 3", and begins the message; `expected` is the hint, but for JSON
that is cut off. If the value is what programs write where a number is not known, the error is a `NotFiniteError`.
"""

import codecs
import io
import json
import lzma
import math
import re
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TextIO
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from numpy.lib import format as npy_format

from nerfcli.captures.formats.limits import MOST_PIXELS, MOST_UNITS, NotFiniteError
from nerfcli.errors import UserError

_LONGEST_NAME = 1000
# What stands for a byte of a file's name that is not UTF-8, or for half a character in JSON.
_SURROGATE = re.compile("[\ud800-\udfff]")
# As Python, C and Microsoft's C print it.
_NOT_FINITE = re.compile(r"\s*[+-]?(nan|inf|1\.#)", re.IGNORECASE)


def malformed(where: str | Path, what: str, hint: str) -> UserError:
    """Create the error for a field: its location, the value found, and the value expected."""
    return UserError(f"{where}: {what}", hint)


def shown(value: Any) -> str:
    """Return a value as text for a message: on one line and at most 60 characters long."""
    text = repr(value) if not isinstance(value, dict | list) else f"a {type(value).__name__} of {len(value)}"
    return text if len(text) <= 60 else f"{text[:57]}..."


def decoded(data: bytes) -> str:
    """Decode text in UTF-8, or in UTF-16 with its byte order mark, as PowerShell's > writes it; lines end in a newline.

    Raises:
        UnicodeDecodeError: it is neither.
    """
    return data.decode(_encoding(data)).replace("\r\n", "\n").replace("\r", "\n")


def opened(path: Path) -> TextIO:
    """Open a file to look at its beginning as text, decoded as by `decoded`; what is no text is replaced."""
    with path.open("rb") as stream:
        encoding = _encoding(stream.read(2))
    return path.open(encoding=encoding, errors="replace")


def _encoding(data: bytes) -> str:
    return "utf-16" if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"


def read_text(path: Path, expected: str) -> str:
    """Read the text of a file in UTF-8, with or without a byte order mark, or in UTF-16 with one."""
    try:
        return decoded(_read_bytes(path, expected))
    except UnicodeDecodeError as error:
        raise malformed(path, f"not UTF-8 text (byte {error.start})", expected) from error


def _read_bytes(path: Path, expected: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise malformed(path, error.strerror or str(error), expected) from error


def read_json(path: Path, expected: str) -> Any:
    """Read the value that a JSON file holds."""
    text = read_text(path, expected)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        what = f"not valid JSON: {error.msg} in line {error.lineno}, column {error.colno}"
        raise malformed(path, what, "the file is truncated or was edited by hand; write it again") from error
    except (ValueError, RecursionError) as error:  # a number with thousands of digits; too deep nesting
        raise malformed(path, f"not valid JSON: {error}", expected) from error


def read_json_object(path: Path) -> dict[str, Any]:
    """Read the JSON object in a file."""
    return record_of(read_json(path, "expected a JSON file"), str(path))


def read_xml(path: Path, expected: str) -> ElementTree.Element:
    """Read the root of an XML file; tags and attributes keep their prefixes.

    A file that declares a document type is refused, as it may have entities to expand.
    """

    def refuse(*_: object) -> NoReturn:
        raise malformed(path, "declares a document type (DOCTYPE)", expected)

    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(_read_bytes(path, expected), True)
    except (expat.ExpatError, ValueError, LookupError) as error:  # the latter two: an encoding that Python lacks
        raise malformed(path, f"not valid XML: {error}", expected) from error
    return builder.close()


def content_lines(text: str) -> list[tuple[int, str]]:
    """Return the lines that are neither empty nor comments (#), with their line numbers from 1."""
    lines = enumerate(text.splitlines(), start=1)
    return [(number, line) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]


class Row(NamedTuple):
    """The cells of a line of a table, and the line's place, to begin a message."""

    cells: list[str]
    where: str


def read_rows(path: Path, expected: str, *, separator: str | None = None) -> list[Row]:
    """Read a table: the lines that are neither empty nor comments, split at the separator, by default at spaces."""
    lines = content_lines(read_text(path, expected))
    return [Row([cell.strip() for cell in line.split(separator)], f"{path}: line {n}") for n, line in lines]


def numbers(words: Sequence[str], count: int, where: str) -> list[float]:
    """Return the numbers, of which there must be `count`, that the words of a line are."""
    if len(words) != count:
        found = "1 number" if len(words) == 1 else f"{len(words)} numbers"
        raise malformed(where, f"has {found}", f"expected {count}")
    try:
        values = list(map(float, words))
    except ValueError:
        values = []
    in_range = min(values, default=0) >= -MOST_UNITS and max(values, default=0) <= MOST_UNITS
    if len(values) == count and in_range and math.isfinite(sum(values)):  # NaN may escape the comparisons, not the sum
        return values
    _refuse_number(words, where)


def matrix_of(words: Sequence[str], rows: int, columns: int, where: str) -> np.ndarray:
    """Return the matrix (rows, columns) of numbers in a text, row by row."""
    return np.array(numbers(words, rows * columns, where)).reshape(rows, columns)


def record_of(value: Any, where: str) -> dict[str, Any]:
    """Return a value that must be a JSON object."""
    if not isinstance(value, dict):
        raise malformed(where, f"is {shown(value)}", "expected a JSON object {...}")
    return value


def number(record: dict[str, Any], key: str, where: str, *, default: float | None = None) -> float:
    """Return a number of a JSON object, or `default` where the key is absent."""
    value = _number_of(record.get(key, default))
    if value is None:
        raise _no_value(record, key, where, "expected a number")
    return value


def vector(record: dict[str, Any], key: str, count: int, where: str) -> np.ndarray:
    """Return a list of `count` numbers of a JSON object, as float64."""
    value = record.get(key)
    values = [_number_of(item) for item in value] if isinstance(value, list) else []
    if len(values) != count or None in values:
        hint = f"expected a list of {count} numbers"
        if isinstance(value, list) and any(map(_is_not_finite, value)):
            raise NotFiniteError(f"{where}: {key} contains a number that is not finite", hint)
        raise _no_value(record, key, where, hint)
    return np.array(values, dtype=np.float64)


def matrix(record: dict[str, Any], key: str, rows: tuple[int, ...], columns: int, where: str) -> np.ndarray:
    """Return a matrix of a JSON object, as float64: a list of rows, whose number is one of `rows`, or of all numbers.

    A matrix that is absent or empty is one that is not known.
    """
    value = record.get(key)
    if value is None or value == []:
        raise NotFiniteError(f"{where}: {key} is missing", f"expected {rows[-1]} rows of {columns} numbers")
    if isinstance(value, list) and len(value) in [count * columns for count in rows]:
        value = [value[start : start + columns] for start in range(0, len(value), columns)]
    if isinstance(value, list) and len(value) in rows and all(len(r) == columns for r in value if isinstance(r, list)):
        return np.stack([vector({key: row}, key, columns, where) for row in value])
    raise _no_value(record, key, where, f"expected {rows[-1]} rows of {columns} numbers")


def size_of(width: float, height: float, where: str) -> tuple[int, int]:
    """Return the width and height of a picture as integers, which they must be, from 1 to `MOST_PIXELS`."""
    if not all(1 <= side <= MOST_PIXELS and side == int(side) for side in (width, height)):
        what = f"width and height are {shown(width)} and {shown(height)}"
        raise malformed(where, what, "expected the picture's size in pixels, as integers")
    return int(width), int(height)


def name_of(value: Any, where: str) -> str:
    """Return the name of an image, a text that can be the name of a file, with forward slashes."""
    if not isinstance(value, str) or not value.strip() or len(value) > _LONGEST_NAME or not _is_plain(value):
        raise malformed(where, f"the image's name is {shown(value)}", "expected the image's path as text")
    return value.strip().replace("\\", "/")


def check_unique_names(names: Iterable[str], path: Path) -> None:
    """Check that there are frames, and no two with the same name, and that all names are text."""
    seen: set[str] = set()
    for name in names:
        if _SURROGATE.search(name):
            raise malformed(path, f"the name {shown(name)} is not in UTF-8", "rename it; old archives have such names")
        if name in seen:
            raise malformed(path, f"image {shown(name)} is listed twice", "remove one of its two entries")
        seen.add(name)
    if not seen:
        raise malformed(path, "lists no images with a pose", "the reconstruction is empty; run it again")


def _no_value(record: dict[str, Any], key: str, where: str, hint: str) -> UserError:
    """Return the error for a key that is absent or has another value than `hint` says."""
    kind = NotFiniteError if _is_not_finite(record.get(key, "")) else UserError
    what = f"{key} is {shown(record[key])}" if key in record else f"{key} is missing"
    return kind(f"{where}: {what}", hint)


def _number_of(value: Any) -> float | None:
    """Return the value of a number, or of a text that is one; None if it is neither, or out of range."""
    if isinstance(value, str):
        try:
            value = float(value)
        except ValueError:
            return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not -MOST_UNITS <= value <= MOST_UNITS:
        return None
    return float(value)


def _is_not_finite(value: Any) -> bool:
    """Return whether a value is what programs write where a number is not known: null, NaN or infinity."""
    if isinstance(value, str):
        return _NOT_FINITE.match(value) is not None
    return value is None or (isinstance(value, float) and not math.isfinite(value))


def _is_plain(text: str) -> bool:
    """Return whether a text has no control characters and no lone surrogates, which JSON may contain."""
    return not any(ord(char) < 32 or ord(char) == 127 or 0xD800 <= ord(char) <= 0xDFFF for char in text)


def _refuse_number(words: Iterable[str], where: str) -> NoReturn:
    hint = "the file was changed or truncated; write it again"
    for word in words:
        if _is_not_finite(word):
            raise NotFiniteError(f"{where}: {shown(word)} is not finite", hint)
        try:
            if -MOST_UNITS <= float(word) <= MOST_UNITS:
                continue
            what = f"{shown(word)} is too large"
        except ValueError:
            what = f"{shown(word)} is not a number"
        raise malformed(where, what, hint)
    raise AssertionError("called for valid numbers")


DAMAGED = "the file is truncated or of another kind; copy it again from the source"

_HEADERS = {(1, 0): npy_format.read_array_header_1_0, (2, 0): npy_format.read_array_header_2_0}


def members_of_npz(path: Path) -> dict[str, bytes]:
    """Return the .npy file of each array in an .npz file, by the array's name."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {name.removesuffix(".npy"): archive.read(name) for name in archive.namelist()}
    except (
        *(OSError, EOFError, ValueError, KeyError, IndexError, OverflowError, NotImplementedError, RuntimeError),
        *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error),
    ) as error:
        raise malformed(path, f"is not a readable .npz file ({type(error).__name__}: {error})", DAMAGED) from error


def array_of_npy(data: bytes) -> np.ndarray:
    """Return the array that the bytes of an .npy file hold; it shares their memory and is read-only.

    Raises:
        ValueError: not an .npy file, an array of Python objects, or more or fewer bytes than the header's shape needs.
    """
    stream = io.BytesIO(data)
    try:
        version = npy_format.read_magic(stream)
        if version not in _HEADERS:
            raise ValueError(f"version {version} of the format")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about headers that Python 2 wrote
            shape, by_columns, dtype = _HEADERS[version](stream)
    except (TypeError, KeyError, SyntaxError, OverflowError, RecursionError, MemoryError, tokenize.TokenError) as error:
        raise ValueError(f"its header is invalid ({type(error).__name__})") from error
    start = stream.tell()
    if dtype.hasobject or dtype.itemsize == 0:
        raise ValueError(f"it contains values of type {dtype}")
    if any(length < 0 for length in shape) or math.prod(shape) * dtype.itemsize != len(data) - start:
        raise ValueError(f"its header announces {shape} values of {dtype}, but {len(data) - start} bytes follow")
    if math.prod(shape) == 0:
        return np.zeros(shape, dtype)
    values = np.frombuffer(data, dtype=dtype, offset=start)
    return values.reshape(shape[::-1]).T if by_columns else values.reshape(shape)
