"""The maps of a picture as one float32 OpenEXR file, under the channel names that compositing programs look for.

    R, G, B (, A)     colour in linear light, primaries of sRGB; with A premultiplied, as OpenEXR defines it
    Z                 the requested depth: Nuke's depth.Z, the Depth pass of Blender
    Y                 the depth again if there is no colour: OpenCV and imageio look only for Y, R, G, B, and silently
                      return zeros if a file has none of them
    opacity.V         1 - transmittance
    spread.V          standard deviation of the distance at which light is absorbed
    disagreement.V    |median - conditional|
    coverage.V        number of training photos that see the surface
    parallax.V        largest angle between the rays of two of them, degrees
    lower.V, upper.V  interval of depth

Pixels without a value are NaN. The header carries the description as JSON in the attribute "nerfcli", and a sentence
for people in "comments". Source: https://openexr.com/en/latest/TechnicalIntroduction.html, "Channel Names".
"""

import contextlib
import io
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import OpenEXR

from nerfcli import __version__
from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError
from nerfcli.photos.colours import linear_light
from nerfcli.render.files.depth_pictures import CONVENTION_OF, KEY, DepthMeta, check_map

CHANNELS = {"depth": "Z", **{name: f"{name}.V" for name in ("opacity", *CONVENTION_OF)}}


def write_exr(path: Path, maps: Mapping[str, np.ndarray], meta: DepthMeta) -> None:
    """Write the maps of a picture into one file, losslessly compressed; atomic.

    Args:
        maps: float32 arrays by name: those of `CHANNELS` (H, W), every bit of which is preserved, and rgb
            (H, W, 3 or 4), sRGB in [0, 1] with straight alpha.
        meta: the definition of the depth, or of another map if depth is not among them.

    Raises:
        UserError: the file cannot be written.
        ValueError: a map is not float32, or meta holds a number that is not finite.
    """
    channels: dict[str, np.ndarray] = {}
    for name, values in maps.items():
        check_map(values, channels=name == "rgb")
        if name == "rgb":
            channels |= _colour_channels(values)
        else:
            channels[CHANNELS[name]] = np.ascontiguousarray(values)
    if "Z" in channels and "R" not in channels:
        channels["Y"] = channels["Z"]
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "software": f"nerfcli {__version__}",
        "comments": meta.in_words(),
        KEY: meta.to_text(),
    }
    encoded = io.BytesIO()  # OpenEXR's own write errors do not say what is wrong with the disk
    OpenEXR.File(header, channels).write(encoded)
    with atomic_path(path) as partial:
        partial.write_bytes(encoded.getbuffer())


def read_exr(path: Path) -> dict[str, np.ndarray]:
    """Read every channel of the first part by its name, as stored.

    Raises:
        UserError: missing or damaged.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}", "give an OpenEXR file") from error
    with _captured_stderr() as message:
        try:
            file = OpenEXR.File(io.BytesIO(content), separate_channels=True)
            return {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        except (RuntimeError, ValueError, TypeError) as error:
            reason = message() or str(error)
            raise UserError(
                f"{path} is damaged or not an OpenEXR file: {reason}", "render the picture again"
            ) from error


@contextlib.contextmanager
def _captured_stderr() -> Iterator[Callable[[], str]]:
    """Capture OpenEXR's messages about a damaged file, better than its exceptions; yield what returns the last line."""
    sys.stderr.flush()
    terminal = os.dup(2)
    with tempfile.TemporaryFile() as log, contextlib.redirect_stdout(io.StringIO()):

        def last_line() -> str:
            log.seek(0)
            lines = log.read().decode("utf-8", errors="replace").strip().splitlines()
            return lines[-1].rpartition(") ")[2] if lines else ""

        os.dup2(log.fileno(), 2)
        try:
            yield last_line
        finally:
            os.dup2(terminal, 2)
            os.close(terminal)


def _colour_channels(srgb: np.ndarray) -> dict[str, np.ndarray]:
    """Return R, G, B in linear light and, if there is alpha, A, by which they are then multiplied."""
    linear = linear_light(srgb[..., :3])
    if srgb.shape[2] == 3:
        return {name: np.ascontiguousarray(linear[..., index]) for index, name in enumerate("RGB")}
    alpha = srgb[..., 3]
    colours = {name: linear[..., index] * alpha for index, name in enumerate("RGB")}
    return colours | {"A": np.ascontiguousarray(alpha)}
