"""HTML page of a bench: recommendations, two plots with pictures of each point, all numbers and how they were made."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from nerfcli.bench.convergence import FINER
from nerfcli.bench.summary import SAME_QUADRATURE
from nerfcli.bench.tables import (
    RENDERING_COLUMNS,
    TRAINING_COLUMNS,
    command_of,
    numbers_of,
    rendering_rows,
    sentences,
    training_rows,
)
from nerfcli.evaluate.sampled import SAMPLED_PIXELS
from nerfcli.pages import page
from nerfcli.pages.tables import table


def bench_page(content: Mapping[str, Any], pictures: Mapping[str, str], folder: Path) -> str:
    """Return the page's text.

    Args:
        content: the output of `summary.summarised`.
        pictures: pictures of the points as data URIs, by name.
    """
    machine = content["machine"]
    here = Path(__file__)
    body = _BODY.substitute(
        title=escape(content["source"]),
        device=escape(machine["processor"] if machine["device"] == "cpu" else machine["device"]),
        threads=f"{machine['threads']} {'thread' if machine['threads'] == 1 else 'threads'}",
        minutes=f"{content['spent_seconds'] / 60:.1f}",
        state="complete" if content["complete"] else "interrupted: results so far",
        verdict="good" if content["complete"] else "look",
        warning=_warning(content),
        advice="".join(map(_advice, content["recommendations"])),
        parts="".join(_PARTS[part](content[part]) for part in ("rendering", "training") if content[part]),
        notes="".join(f"<li>{escape(note)}</li>" for note in _notes(content)),
        data=page.data_element("bench", {**content, "pictures": dict(pictures)}),
    )
    return page.page_html(
        title=content["source"],
        mark=page.Mark("bench", folder),
        style=page.asset("plots.css") + here.with_suffix(".css").read_text(encoding="utf-8"),
        body=body,
        script=page.asset("plots.js") + here.with_suffix(".js").read_text(encoding="utf-8"),
    )


def _warning(content: Mapping[str, Any]) -> str:
    if not content["busy"]:
        return ""
    loads = ", ".join(f"{load:.1f}" for load in content["load_average"] if load is not None)
    return (
        f'<p class="warning">Other programs used the processors at the start (load average {loads}): times are too '
        "long and vary. Measure again on an idle machine before relying on them.</p>"
    )


def _advice(advice: Mapping[str, Any]) -> str:
    head = f"<p>{escape(advice['part'].capitalize())}, {escape(advice['question'])}</p>"
    if advice["point"] is None:
        return f"<div>{head}<b>none of the measured settings</b></div>"
    what = f"<b>{escape(advice['point'])}</b><p>{escape(numbers_of(advice))}</p>"
    return f"<div>{head}{what}<code>{escape(command_of(advice))}</code></div>"


def _rendering(part: Mapping[str, Any]) -> str:
    text = (
        "One trained field, rendered with many settings. Filled points are in the Pareto set: nothing is faster and "
        f"closer to the converged rendering by {SAME_QUADRATURE:.0%} or more. Bars are quartiles of the times. Click "
        "a point to see its pictures."
    )
    rows = table(RENDERING_COLUMNS, rendering_rows(part), numbers=range(1, 7))
    return _part("rendering", "Rendering this field", text, rows)


def _training(part: Mapping[str, Any]) -> str:
    text = (
        f"Trainings of {part['unit_seconds']:.0f} s with one setting changed, and trainings of other lengths. Filled "
        "points are in the Pareto set of time and PSNR; differences within the spread of seeds are not counted. "
        "Click a point to see its picture."
    )
    rows = table(TRAINING_COLUMNS, training_rows(part), numbers=range(1, 8))
    failed = "".join(f"<li>{escape(entry['name'])}: {escape(entry['reason'])}</li>" for entry in part["failed"])
    return _part("training", "Training a field", text, rows + (f"<ul>{failed}</ul>" if failed else ""))


def _part(name: str, title: str, text: str, rows: str) -> str:
    return (
        f'<h2>{title}</h2><section class="chart"><p>{text}</p><div class="choice" id="{name}-choice"></div>'
        f'<div id="{name}-plot"></div><div class="behind" id="{name}-point"></div></section>'
        f'<h3 class="all">All points</h3>{rows}'
    )


_PARTS = {"rendering": _rendering, "training": _training}


def _notes(content: Mapping[str, Any]) -> list[str]:
    machine = content["machine"]
    remarks = [
        f"{machine['processor']}, {machine['processors']} processors, {machine['threads']} used; {machine['system']}; "
        f"Python {machine['python']}, torch {machine['torch']}, nerfcli {content['nerfcli']}.",
        *sentences(content),
    ]
    if rendering := content["rendering"]:
        size = f" at 1/{rendering['factor']:.2g} of their size, to save time" if rendering["factor"] > 1.0 else ""
        remarks += [
            f"Rendering: whole held-out photos ({', '.join(rendering['photos'])}){size}, a first round for pictures "
            f"and warm-up, then {rendering['rounds']} rounds through all settings in changing order, all in one "
            "process; the time per picture is the median of the rounds.",
            "Quadrature error is the root mean square difference, in levels of 255, from the same field rendered "
            f"with {FINER} times finer steps and hardly any early stopping. PSNR on photos includes the error of the "
            f"field: the converged rendering reaches {rendering['converged_psnr']:.2f} dB.",
        ]
        if rendering["float64_levels"] is not None:
            remarks.append(
                f"The converged rendering differs by {rendering['float64_levels']:.2g} levels from one in float64 "
                "with half the step, on a sample of pixels."
            )
    if content["training"]:
        remarks.append(
            f"Training: one process per point, to measure its peak memory; PSNR on the same {SAMPLED_PIXELS} random "
            "pixels of all held-out photos (mean over photos, 8 bit). All settings train for the same time, not the "
            "same number of steps; longer trainings may favour larger fields."
        )
    return remarks


_BODY = Template("""\
<div class="top"><div><h1>$title</h1><p>nerfcli bench: speed against error on $device, $threads; measured for $minutes
min</p></div><span class="pill $verdict">$state</span></div>
$warning
<div class="advice">$advice</div>
$parts
<h2>How this was measured</h2><ul class="notes">$notes</ul>
$data""")
