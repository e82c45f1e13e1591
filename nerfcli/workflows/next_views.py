"""Examine a run: how much of the surface its photos see, and where further photos would see most of the rest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerfcli.cameras.frame import Frame
from nerfcli.evaluate.metrics import to_8_bit
from nerfcli.pages.page import write_page
from nerfcli.render.model import Model
from nerfcli.render.pictures import render_picture
from nerfcli.render.visibility import DepthMap, coverage_and_parallax, depth_maps, sees, small_frame
from nerfcli.report.next_views import NextView, next_views_html
from nerfcli.report.views import coverage_map
from nerfcli.runs.run import Run
from nerfcli.surface.extent import Grid, scene_box
from nerfcli.surface.next_views import candidate_frames, in_free_space, next_views, surface_points
from nerfcli.workflows.machine import thread_count
from nerfcli.workflows.notices import Notify, Progress, no_progress, part_of, silent
from nerfcli.workflows.photo_depths import photo_depths
from nerfcli.workflows.views import refuse_frames, write_frames

# Longer side of the candidates' depth maps in pixels, and voxels along the longest side of the box.
CANDIDATE_PX, CELLS = 96, 128
# The page, and the longer side of its pictures in pixels.
PAGE, PICTURE_PX = "next_views.html", 480
# Parts of the surface by coverage: the smallest number of photos that see each part.
STRATA = {"none": 0, "one": 1, "two or three": 2, "four or more": 4}


@dataclass(frozen=True)
class RunCoverage:
    """Coverage of the surface by the photos of a run.

    Args:
        photos: number of training photos.
        box: x0, y0, z0, x1, y1, z1 in the scene's frame; only the surface inside it counts.
        fractions: of the surface, by the number of photos that see it, with the keys of `STRATA`.
        views: where to take further photos, best first.
        gains: for each view, the fraction of the surface that it would be the first or second to see.
        seen_twice: fraction of the surface that at least two photos see, without and with the suggested views.
    """

    photos: int
    box: tuple[float, ...]
    fractions: dict[str, float]
    views: tuple[Frame, ...]
    gains: tuple[float, ...]
    seen_twice: tuple[float, float]

    def to_json(self) -> dict[str, Any]:
        """Return plain values; views are given by name, gain and pose."""
        views = [
            {"name": view.name, "gain": gain, "world_from_cam": view.world_from_cam.tolist()}
            for view, gain in zip(self.views, self.gains, strict=True)
        ]
        return {
            "photos": self.photos,
            "box": list(self.box),
            "shares": self.fractions,
            "seen_twice": list(self.seen_twice),
            "next_views": views,
        }


def examine_run(
    run: Path,
    target: Path,
    *,
    count: int,
    threads: int = 0,
    overwrite: bool = False,
    notify: Notify = silent,
    progress: Progress = no_progress,
) -> RunCoverage:
    """Measure the coverage of a run's surface, and write the suggested views as a page and as a camera path.

    Args:
        target: the folder to write: next_views.html, cameras.json and camera_path.json; only the page if there is no
            view to suggest.
        count: maximum number of views to suggest.
        threads: number of CPU threads; 0 for all.

    Raises:
        UserError: the run does not exist, its cameras see no surface, or the files exist.
    """
    refuse_frames(target, overwrite=overwrite)
    trained = Run(run)
    torch.set_num_threads(thread_count(threads))
    model, frames = trained.model(), trained.cameras.train
    photos = photo_depths(trained, model, on_progress=part_of(progress, 0.0, 0.4, "photos"), notify=notify)
    box = scene_box(model, frames)
    low, high = np.array(box[:3]), np.array(box[3:])
    grid = Grid.over(box, float((high - low).max()) / CELLS)
    candidates = candidate_frames(frames, depth_hint=1.0 / model.training_from_scene.scale)
    rendered = depth_maps(
        model,
        candidates,
        max_size=CANDIDATE_PX,
        on_progress=part_of(progress, 0.4, 0.9, "candidates"),
    )
    views = in_free_space(rendered, photos)
    points = surface_points([*photos, *views], grid)
    coverage, _ = coverage_and_parallax(photos, points)
    progress(0.95, "choosing")
    seen = np.stack([sees(view, points) for view in views], axis=1)
    chosen = next_views(seen, coverage, count=count)
    after = coverage + seen[:, [index for index, _ in chosen]].sum(axis=1)
    by_name = {frame.name: frame for frame in candidates}
    found = [
        replace(by_name[views[index].frame.name], name=f"next_{place:02d}")
        for place, (index, _) in enumerate(chosen, start=1)
    ]
    bounds = [*STRATA.values(), np.inf]
    examined = RunCoverage(
        photos=len(frames),
        box=box,
        fractions={
            name: float(((coverage >= low) & (coverage < high)).mean())
            for name, low, high in zip(STRATA, bounds[:-1], bounds[1:], strict=True)
        },
        views=tuple(found),
        gains=tuple(gain / len(points) for _, gain in chosen),
        seen_twice=(float((coverage >= 2).mean()), float((after >= 2).mean())),
    )
    if found:
        write_frames(found, target, fps=1.0, overwrite=overwrite)
    _write_page(examined, target / PAGE, trained, model, photos)
    return examined


def _write_page(found: RunCoverage, path: Path, run: Run, model: Model, photos: Sequence[DepthMap]) -> None:
    """Write the page about the coverage of a run, with a rendering and a coverage map of each suggested view."""
    views = []
    for frame, gain in zip(found.views, found.gains, strict=True):
        picture = render_picture(model, small_frame(frame, PICTURE_PX), background=model.background)
        views.append(NextView(frame, gain, to_8_bit(picture.rgb), coverage_map(model, frame, photos)))
    text = next_views_html(
        run.path, photos=run.cameras.train, fractions=found.fractions, seen_twice=found.seen_twice, views=views
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_page(text, path)
