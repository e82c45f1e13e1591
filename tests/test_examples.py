"""The Snakefile: its commands and options exist. It needs Snakemake to run, which is not a dependency."""

import re
from pathlib import Path

from typer.testing import CliRunner

from nerfcli.cli import app

SNAKEFILE = Path(__file__).parent.parent / "examples" / "Snakefile"


def test_the_snakefile_uses_options_that_exist() -> None:
    commands = re.findall(r"\{NERFCLI\} (\w+)((?:[^|\n]|\"\n +\")*)", SNAKEFILE.read_text(encoding="utf-8"))
    assert {name for name, _ in commands} == {"poses", "train", "evaluate", "report"}
    for name, arguments in commands:
        options = re.findall(r"(?<=\s)--?[a-z][\w-]*", arguments)
        assert options
        help_text = CliRunner().invoke(app, [name, "--help"]).stdout
        assert [option for option in options if not re.search(rf"{option}\b", help_text)] == []
