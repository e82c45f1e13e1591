"""One HTML page that shows splats and opens from the disk, without a network: SuperSplat's published viewer inside it.

`supersplat_viewer.txt` states the viewer's version, origin and licence; each page repeats it in its head.
"""

import base64
import gzip
import json
import math
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from string import Template

import numpy as np

from nerfcli.pages.page import write_page
from nerfcli.ply import ply_bytes
from nerfcli.splats.gaussians import Gaussians
from nerfcli.splats.ply import splat_columns
from nerfcli.splats.spz import packed, unpacked


def write_splat_page(
    path: Path,
    gaussians: Gaussians,
    *,
    title: str,
    world_from_cam: np.ndarray,
    fov_deg: float,
    background: Sequence[float],
    notify: Callable[[str], None],
) -> None:
    """Write a page with the Gaussians in the precision of .spz (see `spz.packed`), atomically.

    Args:
        gaussians: in a frame whose y points down; the viewer's horizon is level in it.
        title: plain text.
        world_from_cam: (4, 4) camera of the first view, in that frame; its roll is not kept.
        fov_deg: vertical field of view of the first view, in degrees.
        background: sRGB in [0, 1].
        notify: called with a line about values that were clipped.

    Raises:
        UserError: the file cannot be written.
    """
    here = Path(__file__).parent
    centre, forward = world_from_cam[:3, 3], world_from_cam[:3, 2]
    target = centre + _distance(gaussians, world_from_cam, fov_deg) * forward
    turned = np.array([-1.0, -1.0, 1.0])  # the viewer turns every file half around z, for y to point up
    first = {"position": (turned * centre).tolist(), "target": (turned * target).tolist(), "fov": float(fov_deg)}
    level = ", ".join(str(round(255 * value)) for value in background)
    data, note = packed(gaussians)
    shown = ply_bytes(splat_columns(unpacked(data)))
    text = Template((here / "page.html").read_text(encoding="utf-8")).substitute(
        licence=(here / "supersplat_viewer.txt").read_text(encoding="utf-8"),
        title=escape(title),
        background=f"rgb({level})",
        style=(here / "supersplat_viewer.css").read_text(encoding="utf-8"),
        first=json.dumps(first, allow_nan=False),
        colour=json.dumps([float(value) for value in background], allow_nan=False),
        viewer=base64.b64encode((here / "supersplat_viewer.js.gz").read_bytes()).decode(),
        splats=base64.b64encode(gzip.compress(shown, 6, mtime=0)).decode(),
    )
    write_page(text, path)
    if note:
        notify(f"{path}: {note}")


def _distance(gaussians: Gaussians, world_from_cam: np.ndarray, fov_deg: float) -> float:
    """Return the distance around which the view turns: the median depth in the middle of the first view."""
    x, y, z = ((gaussians.means - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]).T
    reach = math.tan(math.radians(fov_deg) / 2) / 4
    seen = (z > 0) & (gaussians.logits > 0)
    middle = seen & (np.maximum(np.abs(x), np.abs(y)) < reach * z)
    return float(np.median(z[middle])) if middle.any() else float(np.median(z[seen])) if seen.any() else 1.0
