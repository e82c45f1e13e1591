"""Usage errors that say what would be right."""

from typing import Any

import typer
from typer.core import TyperCommand

# Of click, or of typer's own copy of it, by typer's version.
_UsageError: Any = typer.BadParameter.__bases__[0]


class Command(TyperCommand):
    """A command that also says who has an unknown option, how to give several inputs, and what a missing one is."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; see `TyperCommand.parse_args`."""
        try:
            return super().parse_args(ctx, args)
        except _UsageError as error:
            if option := getattr(error, "option_name", None):
                commands = ctx.parent.command.commands if ctx.parent else {}
                owners = [name for name, command in commands.items() if _has(command, option)]
                if owners:
                    error.message = f"No such option: {option}, which belongs to {', '.join(owners)}"
                    error.possibilities = None
            elif "unexpected extra argument" in error.message and self._reads_paths():
                error.message += f"; give one, or several on standard input: ls -d captures/*/ | nerfcli {self.name} -"
            elif not error.message and (help_text := getattr(error.param, "help", None)):  # a missing one
                error.message = help_text
            raise

    def _reads_paths(self) -> bool:
        return any("standard input" in (getattr(parameter, "help", None) or "") for parameter in self.params)


def _has(command: Any, option: str) -> bool:
    return any(option in parameter.opts for parameter in command.params)
