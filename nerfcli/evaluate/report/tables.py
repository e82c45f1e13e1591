"""The tables of a report: a column for each run, or a row for each photo, stage, component or setting."""

from collections.abc import Callable, Sequence
from typing import Any, Literal

from nerfcli.errors import listed
from nerfcli.evaluate.protocol import Novelty, RunMetrics
from nerfcli.evaluate.report.run_facts import RunFacts, captures_of
from nerfcli.pages.page import Table

_MEGA = 1e6


def columns_table(runs: Sequence[RunFacts], rows: Sequence[tuple[str, Callable[[RunFacts], str]]]) -> Table:
    """Format rows, such as `NUMBERS`, with a column for each run; those that are empty for all runs are left out."""
    cells = [(name, *(read(run) for run in runs)) for name, read in rows]
    kept = [row for row in cells if any(row[1:])]
    return Table(("", *(run.label for run in runs)), kept, range(1, len(runs) + 1))


def measured(read: Callable[[RunMetrics], float | None], form: str) -> Callable[[RunFacts], str]:
    """Return a formatter of a number among the metrics; it gives "" if there is none."""

    def text(run: RunFacts) -> str:
        value = None if run.metrics is None else read(run.metrics)
        return "" if value is None else form.format(value)

    return text


def _of_poses(part: str, key: str, form: str) -> Callable[[RunFacts], str]:
    def read(run: RunFacts) -> str:
        content: dict[str, Any] = run.poses or {}
        value = ((content.get(part) or {}) if part else content).get(key)
        return form.format(value) if isinstance(value, int | float) else ""

    return read


def _of_kind(kind: str) -> Callable[[RunFacts], str]:
    def read(run: RunFacts) -> str:
        if run.metrics is None or kind not in run.metrics.kinds:
            return ""
        count, mean = run.metrics.kinds[kind]
        return f"{mean.psnr:.2f} dB ({count})"

    return read


def as_number(value: float | None, digits: int) -> str:
    """Format a number with `digits` decimals; "" for None."""
    return "" if value is None else f"{value:.{digits}f}"


def last_logged(
    key: Literal["seconds", "step", "peak_memory_bytes"], form: str, scale: float = 1.0
) -> Callable[[RunFacts], str]:
    """Return a formatter of the last logged value; it gives "" if there is none."""
    return lambda run: form.format(run.log[-1][key] / scale) if run.log and key in run.log[-1] else ""


def _size(run: RunFacts) -> str:
    cameras = {(frame.camera.width, frame.camera.height) for frame in (*run.frames.train, *run.frames.test)}
    return listed([f"{width} x {height}" for width, height in sorted(cameras)])


def _unit(run: RunFacts) -> str:
    source = run.config.unit_source
    return (run.config.unit or "") + (f" ({source})" if source else "")


def registered(run: RunFacts) -> str:
    """Format the number of photos with a pose; "" if the poses came from elsewhere."""
    return f"{run.poses['registered']} of {run.poses['total']}" if run.poses and "registered" in run.poses else ""


def _lenses(run: RunFacts) -> str:
    return ", ".join(f"{lens['model']} ({lens['images']} photos)" for lens in (run.poses or {}).get("cameras", []))


def _verdict(run: RunFacts) -> str:
    verdict = (run.poses or {}).get("verdict")
    return ("passed all checks" if verdict.get("accepted") else "not accepted") if verdict else ""


def photo_tables(runs: Sequence[RunFacts]) -> list[Table]:
    """Format PSNR and SSIM of every held-out photo by every run, in a table for each capture."""
    tables = (_photos([runs[index] for index in capture], of_many=len(runs) > 1) for capture in captures_of(runs))
    return [made for made in tables if made.rows]


def _photos(runs: Sequence[RunFacts], *, of_many: bool) -> Table:
    by_run = [{image.name: image for image in (run.metrics.images if run.metrics else ())} for run in runs]
    names = sorted({name for images in by_run for name in images})
    columns = ["photo"]
    for run in runs:
        of = f"{run.label}: " if of_many else ""
        columns += [f"{of}PSNR, dB", f"{of}SSIM"]
    rows = []
    for name in names:
        row = [name]
        for images in by_run:
            found = images[name].metrics if name in images else None
            row += ["", ""] if found is None else [as_number(found.psnr, 2), as_number(found.ssim, 4)]
        view = next((images[name].view for images in by_run if name in images and images[name].view), None)
        rows.append([*row, *_novelty(view)])
    columns += ["nearest training view", "distance / scene radius", "degrees between", "type of view"]
    return Table(columns, rows, range(1, len(columns)))


def _novelty(view: Novelty | None) -> list[str]:
    """Format how far a held-out view is from the nearest training view."""
    if view is None:
        return ["", "", "", ""]
    return [view.nearest, as_number(view.distance_relative, 3), as_number(view.angle_deg, 1), view.kind]


def ledger_table(runs: Sequence[RunFacts]) -> Table:
    """Format a table of the stages that used the held-out photos."""
    words = {True: "yes", False: "no", None: "not known"}
    rows = [
        (run.label, entry.stage, words[entry.saw_held_out], entry.how)
        for run in runs
        for entry in (run.metrics.ledger if run.metrics else ())
    ]
    return Table(("run", "stage", "used held-out photos", "how"), rows)


def selection_table(runs: Sequence[RunFacts]) -> Table:
    """Format the automatic selection of components; without rows if there was none."""
    rows = [
        (
            run.label,
            f"{decision.component}={str(decision.value).lower()}",
            "" if decision.gain_db is None else f"{decision.gain_db:+.2f} ± {decision.error_db:.2f}",
            "" if decision.cost is None else f"{decision.cost:+.0%}",
            "yes" if decision.kept else "no",
            decision.reason,
        )
        for run in runs
        if run.config.selection is not None
        for decision in run.config.selection.decisions
    ]
    return Table(("run", "component", "gain, dB", "time", "kept", "why"), rows, (2, 3))


def settings_table(runs: Sequence[RunFacts]) -> Table:
    """Format the settings and versions that a run states; rows in which runs differ are marked and come first."""
    per_run = [_flat({"settings": run.config.settings.facts(), "versions": dict(run.config.versions)}) for run in runs]
    keys = list(dict.fromkeys(key for settings in per_run for key in settings))
    rows = [(key, *(settings.get(key, "-") for settings in per_run)) for key in keys]
    differing = [row for row in rows if len(set(row[1:])) > 1]
    same = [row for row in rows if len(set(row[1:])) == 1]
    marked = [(f"differs: {row[0]}", *row[1:]) for row in differing]
    return Table(("", *(run.label for run in runs)), [*marked, *same], range(1, len(runs) + 1))


def _flat(content: dict[str, Any], prefix: str = "") -> dict[str, str]:
    flat: dict[str, str] = {}
    for key, value in content.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            flat |= _flat(value, f"{name}.")
        elif value is not None:
            flat[name] = str(value)
    return flat


# Metrics of a run.
NUMBERS: tuple[tuple[str, Callable[[RunFacts], str]], ...] = (
    ("PSNR on held-out photos", measured(lambda found: found.mean.psnr, "{:.2f} dB")),
    ("SSIM", measured(lambda found: found.mean.ssim, "{:.4f}")),
    ("LPIPS", measured(lambda found: found.mean.lpips, "{:.4f}")),
    ("PSNR after colour alignment", measured(lambda found: found.mean.psnr_colour_aligned, "{:.2f} dB")),
    ("PSNR on views between training views (interpolation)", _of_kind("interpolation")),
    ("PSNR on views beyond training views (extrapolation)", _of_kind("extrapolation")),
    (
        "gain over billboards (a model without geometry)",
        measured(lambda found: None if found.shape is None else found.shape.gain_db, "{:+.2f} dB"),
    ),
    ("training", last_logged("seconds", "{:.1f} s")),
    ("steps", last_logged("step", "{:,.0f}")),
    (
        "samples per second",
        measured(lambda found: found.training.samples_per_second / _MEGA if found.training else None, "{:.2f} M"),
    ),
    ("peak memory", last_logged("peak_memory_bytes", "{:.0f} MB", _MEGA)),
    ("checkpoint", lambda run: f"{run.field_bytes / _MEGA:.1f} MB"),
    ("time per picture", measured(lambda found: found.seconds_per_image, "{:.2f} s")),
    ("measured on", lambda run: run.metrics.device if run.metrics else ""),
)

# A run's capture and its poses.
CAPTURE: tuple[tuple[str, Callable[[RunFacts], str]], ...] = (
    ("scene", lambda run: run.config.scene.name),
    ("format", lambda run: run.config.scene_kind or ""),
    ("training photos", lambda run: str(len(run.frames.train))),
    ("held-out photos", lambda run: str(len(run.frames.test))),
    ("size", _size),
    ("unit of length", _unit),
    ("poses found", registered),
    ("result", _verdict),
    ("lenses", _lenses),
    ("points", _of_poses("", "points", "{:,.0f}")),
    ("mean reprojection error", _of_poses("", "mean_reprojection_error_px", "{:.2f} px")),
    ("blur due to pose uncertainty, median", _of_poses("pose_blur_px", "median", "{:.2f} px")),
    ("blur due to pose uncertainty, maximum", _of_poses("pose_blur_px", "largest", "{:.2f} px")),
    ("time of structure from motion", _of_poses("seconds", "total", "{:.0f} s")),
)
