"""Parsing of the command line: usage errors that explain the correct usage, and what ends the program meanwhile."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from nerfcli.cli.batch import example_of_many, refuse_scan
from nerfcli.cli.console import errors_explained

# The class of click, or of typer's own copy of click, depending on the version of typer.
_UsageError: Any = typer.BadParameter.__bases__[0]


# Descriptions of invalid values by the name of pydantic's error, which typer provides from 0.29 on.
_WRONG_VALUES = {
    "int_parsing": "is not a whole number",
    "int_parsing_size": "is too long for a whole number",
    "float_parsing": "is not a number",
    "greater_than_equal": "is too small; give at least {ge:.10g}",
    "less_than_equal": "is too large; give at most {le:.10g}",
}


class Program(TyperGroup):
    """The program; what interrupts it before a command begins, or its help, ends it as it ends a command.

    Otherwise typer ends it with the code of Ctrl-C after a SIGTERM, and with a traceback if stdout is full.
    """

    @errors_explained
    def make_context(self, *args: Any, **extra: Any) -> Any:
        """Parse the options before the command; see `TyperGroup.make_context`."""
        return super().make_context(*args, **extra)

    @errors_explained
    def invoke(self, ctx: Any) -> Any:
        """Parse and run the command; see `TyperGroup.invoke`."""
        return super().invoke(ctx)


class Command(TyperCommand):
    """A command with more helpful usage errors.

    They name the commands that have an unknown option, show how to give several inputs, describe a missing argument,
    and explain what is wrong with a number.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; see `TyperCommand.parse_args`."""
        name = " ".join(ctx.command_path.split()[1:]) or str(self.name)
        try:
            return super().parse_args(ctx, args)
        except _UsageError as error:
            if option := getattr(error, "option_name", None):
                owners = [owner for owner, each in _commands(ctx.find_root().command) if _has(each, option)]
                if owners:
                    error.message = f"No such option: {option}, which belongs to {', '.join(owners)}"
                    error.possibilities = None
            elif "unexpected extra argument" in error.message and self._reads_paths():
                error.message += f"; give one, or several on standard input: {example_of_many(name)}"
            elif text := _wrong_value(error):
                error.message = text
            elif not error.message and (help_text := getattr(error.param, "help", None)):  # missing argument
                error.message = help_text
            raise

    def _reads_paths(self) -> bool:
        return any("standard input" in (getattr(parameter, "help", None) or "") for parameter in self.params)


class PhotoCommand(Command):
    """A command for photos: given an X-ray scan, it names the command for it before anything is loaded."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command; see `TyperCommand.invoke`."""
        argument = next((str(each.name) for each in self.params if each.param_type_name == "argument"), "")
        given = ctx.params.get(argument) or ()
        for path in given if isinstance(given, list | tuple) else (given,):
            refuse_scan(Path(path), str(self.name))
        return super().invoke(ctx)


def _commands(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the name of each command, and of each command of a command, with the command."""
    for name, each in getattr(group, "commands", {}).items():
        yield prefix + name, each
        yield from _commands(each, f"{prefix}{name} ")


def _wrong_value(error: Any) -> str | None:
    """Return a message about an invalid number; None for other errors."""
    problems = getattr(error.__cause__, "errors", list)()
    if not problems or problems[0]["type"] not in _WRONG_VALUES:
        return None
    text = _WRONG_VALUES[problems[0]["type"]].format(**problems[0].get("ctx", {}))
    meaning = (getattr(error.param, "help", None) or "").partition("  [")[0]
    return f"{str(problems[0]['input'])!r} {text}. {meaning}".rstrip()


def _has(command: Any, option: str) -> bool:
    return any(option in parameter.opts for parameter in command.params)
