"""Held-out photos beside their renderings: picture, error, depth, and number of photos that see the surface."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nerfcli.cameras.frame import Frame
from nerfcli.evaluate.metrics import Metrics, compare
from nerfcli.evaluate.photos import HeldOutPhoto, background_of, paired
from nerfcli.evaluate.report.run_facts import RunFacts
from nerfcli.photos.colours import levels_of, to_8_bit
from nerfcli.render.coverage import DepthMap, small_frame, with_coverage
from nerfcli.render.depth import DepthRequest
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture
from nerfcli.render.presentation import ColourRange

# Mean absolute difference of the channels at the last colour of error maps, sRGB in [0, 1].
ERROR_RANGE = 0.2
ERROR_COLOURS = "viridis"
# Longer side of coverage maps in pixels, and the number of photos at their last colour.
COVERAGE_PX, COVERAGE_RANGE = 320, 8
COVERAGE_COLOURS = "viridis"
_COVERAGE = DepthRequest("median", "ray")


@dataclass(frozen=True)
class HeldOutRenderings:
    """Renderings of a held-out photo by a run, and their PSNR and SSIM, as in `evaluate`.

    Args:
        photo, picture, error: (H, W, 3) uint8 sRGB; RGBA photos on white.
        depth: (H, W) in the unit of the scene, NaN where there is none.
        coverage: (h, w) number of training photos that see the surface, in a smaller picture; NaN where there is none.
    """

    name: str
    photo: np.ndarray
    picture: np.ndarray
    error: np.ndarray
    depth: np.ndarray
    coverage: np.ndarray
    metrics: Metrics

    @property
    def with_depth(self) -> float:
        """Fraction of the pixels with a depth."""
        return float(np.isfinite(self.depth).mean())


def common_names(runs: Sequence[RunFacts], count: int) -> list[str]:
    """Choose up to `count` photos that all runs hold out: `spread_evenly` by PSNR of the first evaluated run."""
    names = [frame.name for frame in runs[0].frames.test]
    for run in runs[1:]:
        held_out = {frame.name for frame in run.frames.test}
        names = [name for name in names if name in held_out]
    measured = next((run.metrics.images for run in runs if run.metrics is not None), ())
    quality = {image.name: image.metrics.psnr for image in measured}
    return spread_evenly(names, count, quality=quality)


def look_at(
    model: Model,
    held_out: Sequence[HeldOutPhoto],
    *,
    depth: DepthRequest,
    photo_depths: Sequence[DepthMap],
    on_progress: Callable[[float], None],
) -> list[HeldOutRenderings]:
    """Render held-out photos, whose masks leave pixels to compare; `photo_depths` are those of all training photos."""
    views = []
    for photo in held_out:
        picture = render_picture(model, photo.frame, background=background_of(model, photo), depth=depth)
        assert picture.depth is not None
        pair = paired(photo, picture)
        metrics = compare(pair.rendered, pair.photo, used=pair.used)
        rendered = to_8_bit(pair.rendered)
        views.append(
            HeldOutRenderings(
                name=photo.frame.name,
                photo=pair.photo,
                picture=rendered,
                error=error_map(rendered, pair.photo, used=pair.used),
                depth=picture.depth,
                coverage=_coverage_map(model, photo.frame, photo_depths),
                metrics=metrics,
            )
        )
        on_progress(len(views) / len(held_out))
    return views


def _coverage_map(model: Model, frame: Frame, photo_depths: Sequence[DepthMap]) -> np.ndarray:
    """Count the training photos that see the surface in each pixel of a small picture (h, w)."""
    small = small_frame(frame, COVERAGE_PX)
    picture = render_picture(model, small, background=model.background, depth=_COVERAGE)
    seen = with_coverage(picture, small, axis=_COVERAGE.axis, photo_depths=photo_depths)
    assert seen.coverage is not None
    return seen.coverage


def depth_range(views: Sequence[HeldOutRenderings]) -> ColourRange:
    """Return the colours of depths, from the 1st to the 99th percentile; 0 to 1 if there are none."""
    valid = np.concatenate([np.empty(0), *(view.depth[np.isfinite(view.depth)] for view in views)])
    return ColourRange.of_depths(*np.percentile(valid, (1, 50, 99)).tolist()) if len(valid) else ColourRange(0.0, 1.0)


def error_map(picture: np.ndarray, photo: np.ndarray, *, used: np.ndarray) -> np.ndarray:
    """Colour the mean absolute difference of pictures (H, W, 3) uint8, up to `ERROR_RANGE`; grey where not `used`."""
    difference = np.abs(picture.astype(np.float64) - photo).mean(-1) / 255.0
    colours = levels_of(ERROR_COLOURS)[to_8_bit(difference / ERROR_RANGE)]
    colours[~used] = 128
    return colours


def spread_evenly(names: Sequence[str], count: int, *, quality: dict[str, float]) -> list[str]:
    """Choose up to `count` names, in their order: the worst, the best, and evenly between by rank of quality.

    `quality` is PSNR by name; if it is not known for all, the names are spread by their order.
    """
    if len(names) <= count:
        return list(names)
    ranked = sorted(names, key=lambda name: quality[name]) if all(name in quality for name in names) else list(names)
    ranks = np.rint(np.linspace(0, len(ranked) - 1, count)).astype(int)
    chosen = {ranked[rank] for rank in ranks}
    return [name for name in names if name in chosen]
