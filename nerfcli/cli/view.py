"""nerfcli view: serve the interactive page of a run on this machine."""

from pathlib import Path
from typing import Annotated

import typer

from nerfcli.cli.console import Console, command
from nerfcli.cli.options import Threads
from nerfcli.machine import Resources


@command
def view(
    run: Annotated[Path, typer.Argument(help="Run folder that train wrote or is writing.")],
    host: Annotated[
        str, typer.Option(help="Address to listen on; others than the default let other machines in.")
    ] = "127.0.0.1",
    port: Annotated[
        int | None, typer.Option(help="Port to listen on.  [default: the first free one from 8123]", min=1, max=65535)
    ] = None,
    browser: Annotated[
        bool,
        typer.Option("--browser/--no-browser", help="Open the page in this machine's browser, if it has a screen."),
    ] = True,
    threads: Threads = 0,
) -> None:
    """Show a run in a browser, during its training and after.

    The page is that of `nerfcli export --to page`. While the run is being trained in another terminal, it shows the
    newest checkpoint, one every 30 s. Where the browser has no graphics card, and for fields of type mlp, the CPU of
    this machine renders: coarse during a motion, then in full.

    Only this machine can open the page, at the address printed, which contains a secret. On another machine, run the
    printed ssh command first and open the same address there. Ctrl-C ends the server (exit code 130).

    \b
    Examples:
      nerfcli view photos-scene-run
      nerfcli view photos-scene-run --port 9000 --no-browser
    """
    from nerfcli.workflows.view import open_browser, view_run

    console = Console(quiet=False, json_lines=False)

    def on_ready(url: str, from_elsewhere: str) -> None:
        console.address(url)
        if from_elsewhere:
            console.note(f"from another machine: {from_elsewhere}, then the same address there")
        console.note("Ctrl-C ends the server")
        if browser:
            open_browser(url)

    view_run(run, host=host, port=port, resources=Resources(threads), on_ready=on_ready)
