"""Arrays in .npy and .npz files that may be damaged: no pickle, and no size is believed before its bytes are there."""

import io
import lzma
import math
import struct
import tokenize
import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np
from numpy.lib import format as npy_format

from nerfcli.captures.formats.fields import malformed

DAMAGED = "the file is truncated or of another kind; copy it again from the source"

_HEADERS = {(1, 0): npy_format.read_array_header_1_0, (2, 0): npy_format.read_array_header_2_0}


def members_of_npz(path: Path) -> dict[str, bytes]:
    """Return the .npy file of each array in an .npz file, by the array's name.

    Raises:
        UserError: the file is missing or damaged.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return {name.removesuffix(".npy"): archive.read(name) for name in archive.namelist()}
    except (
        *(OSError, EOFError, ValueError, KeyError, IndexError, OverflowError, NotImplementedError, RuntimeError),
        *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error),
    ) as error:
        raise malformed(str(path), f"is not a readable .npz file ({type(error).__name__}: {error})", DAMAGED) from error


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
