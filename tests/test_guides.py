"""The tables of the guides list what the program has, neither less nor more, and the guides stay short."""

import re
from pathlib import Path

import pytest

import nerfcli
from nerfcli import errors
from nerfcli.captures.formats.registry import FORMATS
from nerfcli.render.depth import CONVENTIONS
from nerfcli.training.runs.components import CHOICES, Components

PROJECT = Path(__file__).parent.parent
DOCS = PROJECT / "docs"


def first_cells(guide: Path) -> list[str]:
    """Return the first cells of the rows of all tables in a guide."""
    return re.findall(r"^\| ([^|]+?) \|", guide.read_text(encoding="utf-8"), re.M)


def quoted(cells: list[str]) -> list[str]:
    return [name for cell in cells for name in re.findall(r"`([^`]+)`", cell)]


@pytest.mark.parametrize(
    ("guide", "lines"),
    [
        (PROJECT / "README.md", 150),
        (PROJECT / "CHANGELOG.md", 40),
        *((path, 120) for path in sorted(DOCS.glob("*.md"))),
    ],
    ids=lambda value: value.name if isinstance(value, Path) else "",
)
def test_a_guide_is_short(guide, lines):
    assert len(guide.read_text(encoding="utf-8").splitlines()) <= lines


def test_the_guide_to_formats_lists_every_format_and_which_are_written():
    rows = re.findall(r"^\| (`[^|]+) \| (yes|) ?\| ?(yes|) ?\|", (DOCS / "formats.md").read_text("utf-8"), re.M)
    aliases = {"nerfstudio", "instant-ngp"}
    assert {name for cells, _, _ in rows for name in quoted([cells])} - aliases == {form.name for form in FORMATS}
    written = {name for cells, _, is_written in rows if is_written for name in quoted([cells])} - aliases
    assert written == {form.name for form in FORMATS if form.write is not None}


def test_the_guide_to_models_lists_every_component_with_its_default_first():
    text = (DOCS / "choosing-a-model.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| `([^`]+)`", text, re.M)
    assert rows == [(name, str(getattr(Components(), name)).lower().removesuffix(".0")) for name in CHOICES]


def test_the_guide_to_depth_lists_every_definition():
    listed = [name for name in quoted(first_cells(DOCS / "depth.md")) if name in CONVENTIONS]
    assert set(listed) == set(CONVENTIONS)


@pytest.mark.parametrize("guide", [DOCS / "exit-codes.md", PROJECT / "CONTRIBUTING.md"], ids=lambda path: path.name)
def test_a_table_lists_every_exit_code(guide):
    codes = {value for name, value in vars(errors).items() if name.isupper() and isinstance(value, int)}
    assert {int(cell) for cell in first_cells(guide) if cell.isdigit()} == {0, 1, 2} | codes


def test_the_guide_to_python_lists_every_function():
    listed = [name.partition("(")[0] for name in quoted(first_cells(DOCS / "python-api.md"))]
    assert set(listed) == set(nerfcli.__all__)
