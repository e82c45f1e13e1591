"""Options shared by several commands, alone and as records, and the parsers of their values.

Whatever cannot be parsed, is unknown, or contradicts another option is a `typer.BadParameter` that names the option.
"""

import math
import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from nerfcli.captures.holdout import check_holdout
from nerfcli.cli.batch import Given
from nerfcli.cli.console import Console
from nerfcli.machine import Resources
from nerfcli.output import Output as Destination

if TYPE_CHECKING:
    from nerfcli.training.runs.settings import TrainSettings

Word = TypeVar("Word", str, str | None)


def split_at_commas(texts: list[str] | None) -> list[str]:
    """Return the items of all comma-separated values of a repeatable option."""
    return [item.strip() for text in texts or () for item in text.split(",")]


Output = Annotated[
    Path | None,
    typer.Option(
        "--output", "-o", help="Output file or folder; with several inputs, the folder that will contain the results."
    ),
]
Device = Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:1.")]
Seed = Annotated[int, typer.Option(help="Seed of all random numbers.", min=0, max=2**32 - 1)]
Threads = Annotated[int, typer.Option(help="Number of CPU threads; 0 uses all.", min=0)]
Downscale = Annotated[str, typer.Option(help="Reduce photos by this factor: auto, 1, 2, 4 or 8.")]
Require = Annotated[
    str | None,
    typer.Option(
        help="Requirements such as psnr>=25,registered>=0.9; exit code 7 if one is not met.", show_default=False
    ),
]
Holdout = Annotated[
    str | None,
    typer.Option(
        help="Photos to hold out: every:8, block:0.15 (the middle of the capture), or a file with names.",
        show_default=False,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print results as JSON Lines on stdout instead of paths.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing result.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show only warnings and errors.")]


@dataclass(frozen=True)
class Writing:
    """Where the results of a command go; `command` makes options of the fields, as of those of the other records."""

    output: Output = None
    overwrite: Overwrite = False

    def beside(self, given: Given, suffix: str) -> Destination:
        """Return where the result of an input goes: by default beside it, with a suffix added to its name."""
        path = Destination(self.output if not given.one_of_many else None).beside(given.path, suffix)
        return self._one_of_many(given, path)

    def inside(self, given: Given, suffix: str) -> Destination:
        """Return the folder for the results of an input, one of its own for each of several; by default none."""
        return self.beside(given, suffix) if self.output is not None else Destination(None, self.overwrite)

    def named(self, given: Given, usual: Path) -> Destination:
        """Return where the result of an input goes: by default to `usual`, of several to a path of that name."""
        return self._one_of_many(given, usual if self.output is None or given.one_of_many else self.output)

    def _one_of_many(self, given: Given, path: Path) -> Destination:
        """Return where a result goes: of several inputs into the folder of results, if there is one."""
        if given.one_of_many and self.output is not None:
            # Folders that `nerfcli run -o` makes have the same name for every capture.
            before = f"{given.path.resolve().parent.name}-" if given.path.name in ("scene", "run") else ""
            path = self.output / f"{before}{path.name}"
        if given.one_of_many:
            given.refuse_taken(path)
        return Destination(path, self.overwrite)


@dataclass(frozen=True)
class Computing:
    """What a command uses of the machine."""

    device: Device = "auto"
    threads: Threads = 0

    @property
    def resources(self) -> Resources:
        """The threads and the device."""
        return Resources(self.threads, self.device)


@dataclass(frozen=True)
class Training(Computing):
    """How a command that trains does it."""

    downscale: Downscale = "auto"
    seed: Seed = 0

    def settings(self, budget: str | None, steps: int | None = None) -> "TrainSettings":
        """Return the settings of a training whose components are selected."""
        from nerfcli.training.runs.settings import TrainSettings

        one_of(self.downscale, ("auto", "1", "2", "4", "8"), "--downscale")
        return TrainSettings(
            budget_seconds=None if budget is None else seconds_from_text(budget),
            steps=steps,
            downscale=None if self.downscale == "auto" else int(self.downscale),
            seed=self.seed,
            device=self.resources.torch_device,
            threads=self.resources.cores,
            model="auto",
        )


@dataclass(frozen=True)
class Printing:
    """How a command prints its results and messages."""

    json: Json = False
    quiet: Quiet = False

    @property
    def console(self) -> Console:
        """Where everything is printed."""
        return Console(quiet=self.quiet, json_lines=self.json)


# A shorter time must have a unit.
FEWEST_PLAIN_SECONDS = 10.0
_SECONDS_PER_UNIT = {"s": 1.0, "m": 60.0, "h": 3600.0}


def one_of(value: Word, choices: Collection[str], option: str) -> Word:
    """Return an option's value if it is one of the choices; None if it is not given."""
    if value is not None and value not in choices:
        *others, last = choices
        listed = f"{', '.join(others)} or {last}" if others else last
        raise typer.BadParameter(f"{value!r}; choose {listed}", param_hint=option)
    return value


def some_of(text: str, choices: Collection[str], option: str) -> tuple[str, ...]:
    """Return the items of a comma-separated list, without duplicates."""
    chosen = tuple(dict.fromkeys(name.strip() for name in text.split(",")))
    if unknown := [name for name in chosen if name not in choices]:
        raise typer.BadParameter(f"{unknown[0]!r}; choose from {', '.join(choices)}", param_hint=option)
    return chosen


def finite(value: float | None, option: str) -> None:
    """Refuse NaN and infinity, which the bounds of an option do not exclude."""
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number", param_hint=option)


def refuse_unused(unused: dict[str, tuple[bool, str]], words: str) -> None:
    """Refuse options that nothing would use; by option, whether that is so, and with what it works."""
    for option, (is_unused, suited) in unused.items():
        if is_unused:
            raise typer.BadParameter(words.format(suited), param_hint=option)


def seconds_from_text(text: str) -> float:
    """Parse 90s, 5m, 1.5h or plain seconds, the value of --budget."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([smh]?)", text.strip())
    seconds = float(match[1]) * _SECONDS_PER_UNIT[match[2] or "s"] if match else 0.0
    if not seconds > 0:
        raise typer.BadParameter(f"{text!r} is not a time; write 90s, 5m or 1h", param_hint="--budget")
    if match and not match[2] and seconds < FEWEST_PLAIN_SECONDS:
        raise typer.BadParameter(f"{text!r} has no unit; write {match[1]}s or {match[1]}m", param_hint="--budget")
    return seconds


def bytes_from_text(text: str, option: str = "--memory") -> int:
    """Parse 4GB, 500MB or 1.5GiB, the value of an option; a plain number is bytes, which 4 alone can hardly mean."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(?:([kmgt])(i?)b?|b)?", text.strip().lower())
    size = int(float(match[1]) * (1024 if match[3] else 1000) ** " kmgt".index(match[2] or " ")) if match else 0
    if size < 1000:
        raise typer.BadParameter(f"{text!r} is not an amount of memory; write 4GB or 500MB", param_hint=option)
    return size


def holdout_rule(holdout: str | None) -> str | None:
    """Parse --holdout, with the path of a file made absolute; None if it is not given."""
    try:
        return None if holdout is None else check_holdout(holdout)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--holdout") from error
