"""benchmarks/figures.py: docs/figures.md is what it writes from its measurements, and no cell is measured twice."""

import json
import subprocess
from pathlib import Path
from typing import Any

import figures
import pytest

ROOT = Path(__file__).parent.parent


def cell(**content: Any) -> figures.Cell:
    usual = {"capture": "fox", "budget_s": 60.0, "commit": "abc1234", "processor": "a processor", "threads": 2}
    return usual | {"date": "2026-11-30"} | content


def row(page: str, title: str, section: str) -> str:
    """The line of a table of a section that starts with a title."""
    return next(line for line in page.split(f"## {section}")[1].splitlines() if line.startswith(f"| {title}"))


def test_the_page_is_what_the_script_writes_and_is_short():
    written = (ROOT / "docs" / "figures.md").read_text(encoding="utf-8")
    assert written == figures.page(figures.read_cells(ROOT / "benchmarks" / "figures.json"))
    assert len(written.splitlines()) <= 80
    for capture in figures.CAPTURES.values():
        assert row(written, capture.title, "Quality")


def test_a_number_that_was_not_measured_is_a_dash_and_a_cell_from_elsewhere_says_so():
    cells = [cell(kind="quality", psnr=30.204, ssim=0.868), cell(kind="quality", budget_s=300.0, psnr=31.9)]
    cells.append(cell(kind="poses", commit="earlier", date="2026-11-02", registered=49, total=50))
    page = figures.page(cells)
    fox = "fox at 270x480, 50 photos"
    assert row(page, fox, "Quality") == f"| {fox} | 30.20, 0.868, – | 31.90, –, – | – | – | – |"
    assert row(page, "fern", "Quality") == "| fern at 1008x756, 20 photos | – | – | – | – | – |"
    assert row(page, "fox", "Poses").startswith("| fox † | 49 of 50 | – |")
    assert "Commit: abc1234. Processor: a processor" in page
    assert "Date: 30 November 2026. † measured at another time or place " in page
    assert "(commit, processor, date): earlier, a processor, 2 November 2026." in page


def test_a_cell_is_measured_once_for_a_commit_and_kept_at_once(monkeypatch, tmp_path):
    """The second capture fails the first time, as if interrupted; the second call measures only what is missing."""
    measured = []

    def poses(self: figures.Measurement, name: str, budget: float) -> figures.Cell:
        measured.append(name)
        if measured == ["fox", "fern"]:
            raise subprocess.CalledProcessError(1, "nerfcli poses")
        return {"total_s": 12.3456, "ate": float("nan")}

    monkeypatch.setattr(figures, "program_commit", lambda: "abc1234")
    monkeypatch.setattr(figures, "plan", lambda names, budgets: [("poses", name, 0.0) for name in names])
    monkeypatch.setattr(figures.Measurement, "poses", poses)
    path = tmp_path / "figures.json"
    for code, calls in ((1, ["fox", "fern"]), (0, ["fox", "fern", "fern"])):
        with pytest.raises(figures.typer.Exit) as ended:
            figures.main(tmp_path, names="fox,fern", output=path)
        assert (ended.value.exit_code, measured) == (code, calls)
    kept = json.loads(path.read_text(encoding="utf-8"))
    assert [(one["capture"], one["total_s"], "ate" in one) for one in kept] == [
        ("fox", 12.35, False),
        ("fern", 12.35, False),
    ]
    assert (tmp_path / "figures.md").read_text(encoding="utf-8") == figures.page(kept)


@pytest.mark.parametrize("pages", [0, 9])
def test_every_capture_has_its_cells_and_long_trainings_come_last(monkeypatch, pages):
    monkeypatch.setattr(figures, "has_browser", lambda: bool(pages))
    cells = list(figures.plan(figures.CAPTURES, figures.BUDGETS))
    assert [kind for kind, _, _ in cells[-9:]] == ["quality"] * 9
    assert {budget for _, _, budget in cells[-9:]} == {1800.0}
    assert ("splats", "desk", 300.0) in cells
    assert len(cells) == len(set(cells)) == 8 + 3 * 9 + 2 + 9 + pages
