"""Plans of rendering and evaluation compared with what these write, and through the commands."""

import json
from pathlib import Path

import pytest
from commands import error_of, listing, nerfcli

from nerfcli.errors import BAD_INPUT
from nerfcli.runs.run import Run
from nerfcli.workflows import render_plan
from nerfcli.workflows.render import render_run
from nerfcli.workflows.render_plan import plan_evaluation, plan_rendering
from nerfcli.workflows.views import Views


@pytest.fixture
def measured_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure pictures of 32 x 24 pixels: their number and proportions do not depend on it."""
    monkeypatch.setattr(render_plan, "_LONGER_SIDE", 32)


def test_pictures_and_disk_space_are_those_of_the_rendering(spheres_run: Path, tmp_path: Path) -> None:
    """Pictures of 96 x 72 pixels are measured at full size: the measured ones are the three that are rendered."""
    views = Views("test")
    planned = plan_rendering(spheres_run, views=views, threads=1)
    assert (planned.pictures, planned.pixels) == (3, 3 * 96 * 72)
    render_run(spheres_run, tmp_path / "renders", views=views, threads=1)
    written = sum(file.stat().st_size for file in (tmp_path / "renders").rglob("*") if file.is_file())
    assert planned.disk_bytes == pytest.approx(written, rel=0.1)
    assert planned.seconds > 0


@pytest.mark.usefixtures("measured_small")
def test_a_plan_of_some_views_is_in_proportion_to_all(spheres_run: Path) -> None:
    orbit = Views("orbit", count=12)
    some, everything = (plan_rendering(spheres_run, views=orbit, threads=1, part=p) for p in (slice(0, 12, 4), None))
    assert (some.pictures, everything.pictures, everything.pixels) == (3, 12, 4 * some.pixels)
    assert everything.disk_bytes == pytest.approx(4 * some.disk_bytes, rel=0.2)


@pytest.mark.usefixtures("measured_small")
def test_a_plan_of_an_evaluation_counts_held_out_pixels_and_saved_pictures(spheres_run: Path) -> None:
    plain, saving, unrounded = (
        plan_evaluation(spheres_run, threads=1, predictions=kind) for kind in (None, "png", "float")
    )
    assert (plain.pictures, plain.pixels) == (3, 3 * 96 * 72)
    assert saving.disk_bytes - plain.disk_bytes == 6 * plain.pixels
    assert unrounded.disk_bytes - saving.disk_bytes == 3 * 4 * plain.pixels  # one float32 picture


@pytest.mark.usefixtures("measured_small")
def test_dry_runs_print_the_plan_and_write_nothing(spheres_run: Path) -> None:
    before = listing(spheres_run)
    for command in ("render", "evaluate"):
        result = nerfcli(command, spheres_run, "--dry-run", "--json", "--threads", "1")
        assert result.exit_code == 0, result.stderr
        printed = json.loads(result.stdout)
        assert (printed["path"], printed["pictures"]) == (str(spheres_run), len(Run(spheres_run).cameras.test))
        said = nerfcli(command, spheres_run, "--dry-run", "--threads", "1").stdout
        assert said.startswith(f"{spheres_run}: 3 pictures, 0.0 million pixels: about ")
    assert listing(spheres_run) == before


def test_outputs_that_need_depths_of_photos_first_are_refused_in_two_lines(spheres_run: Path) -> None:
    result = nerfcli("render", spheres_run, "--outputs", "coverage", "--dry-run")
    assert result.exit_code == BAD_INPUT
    assert error_of(result)[0].startswith("Error: --dry-run does not cover coverage")
