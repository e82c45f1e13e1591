"""Options that were removed say so, and what to use instead; runs of earlier versions are read where they can be."""

import json
import re
from typing import Any

import pytest
import typer
from commands import error_of, nerfcli

from nerfcli import cli
from nerfcli.cli import removed as table
from nerfcli.cli.removed import REMOVED, Removed, refuse_removed

COMMANDS: dict[str, Any] = getattr(typer.main.get_command(cli.app), "commands")  # noqa: B009 - of a group


def options_of(command: str) -> set[str]:
    """Return the options that a command has."""
    return {option for parameter in COMMANDS[command].params for option in parameter.opts}


@pytest.mark.parametrize("removed", REMOVED, ids=lambda removed: f"{removed.command} {removed.name}")
def test_a_removed_option_is_refused_in_two_lines(removed):
    option, _, value = removed.name.partition(" ")
    result = nerfcli(removed.command, "nowhere", option, value or "2")
    error, hint = error_of(result)
    assert result.exit_code == 2
    assert error == f"Error: {removed.name} was removed on {removed.since}"
    assert hint == f"Hint:  {removed.instead}"


@pytest.mark.parametrize("removed", REMOVED, ids=lambda removed: f"{removed.command} {removed.name}")
def test_the_table_and_the_commands_agree(removed):
    """What was removed is gone, only values of an option that stays are removed, and hints name options that exist."""
    option, _, value = removed.name.partition(" ")
    assert (option in options_of(removed.command)) == bool(value)
    every = set().union(*map(options_of, COMMANDS))
    assert set(re.findall(r"--[a-z][a-z0-9-]+", removed.instead)) <= every


@pytest.mark.parametrize(
    "arguments",
    [["--with", "haze"], ["--with=haze"], ["--with", "view=2,haze=0.1"], ["--without", "view", "--with", "view,haze"]],
)
def test_a_removed_value_is_found_however_it_is_written(monkeypatch, arguments):
    monkeypatch.setattr(table, "REMOVED", (Removed("train", "--with haze", "2020-01-01", "use fog"),))
    with pytest.raises(table.UserError, match="--with haze was removed on 2020-01-01"):
        refuse_removed("train", ["scene", *arguments])
    for other in (["--with", "hazel"], ["haze"], ["--without", "haze"]):
        refuse_removed("train", ["scene", *other])
    refuse_removed("render", ["scene", *arguments])


@pytest.mark.parametrize(
    ("name", "usual", "other"),
    [
        *(("photo_fraction", 1.0, 0.8), ("random_start", 0.0, 0.1), ("blocks", 0, 4), ("width", 32, 64)),
        *(("overlap", False, True), ("entropy", 0.0, 0.01), ("pixels", "anywhere", "error"), ("movers", False, True)),
    ],
)
def test_a_run_that_was_trained_with_what_was_removed_is_refused_and_any_other_is_read(finished, name, usual, other):
    config = finished / "config.json"
    content = json.loads(config.read_text())
    content.pop("sha256", None)
    is_component = name in ("overlap", "entropy", "pixels", "movers")
    for value in (usual, other):
        (content["settings"]["components"] if is_component else content["settings"])[name] = value
        config.write_text(json.dumps(content))
        result = nerfcli("info", finished)
        assert result.exit_code == (0 if value == usual else 3), result.stderr
    error, hint = error_of(result)
    assert f"its training had {name}={str(other).lower()}" in error
    assert "train again" in hint
