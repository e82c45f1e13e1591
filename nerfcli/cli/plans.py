"""Print the plans of render --dry-run and evaluate --dry-run."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from nerfcli.cli.console import Console

if TYPE_CHECKING:
    from nerfcli.workflows.render_plan import RenderingPlan


def print_plan(run: Path, plan: "RenderingPlan", console: Console) -> None:
    """Print a plan as a sentence, or as an object with --json."""
    if console.json_lines:
        console.result(run, plan.to_json())
    else:
        typer.echo(f"{run}: {plan.describe()}")
