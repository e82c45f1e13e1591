"""Commands for X-ray scans: `nerfcli ct`, one file per command."""

import typer

from nerfcli.cli.ct import convert, doctor, evaluate, export, info, render, train
from nerfcli.cli.usage import Command

app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)
for _module in (convert, doctor, train, evaluate, render, export, info):
    _name = _module.__name__.rsplit(".", 1)[-1]
    app.command(_name, cls=Command)(getattr(_module, _name))


@app.callback()
def ct() -> None:
    """Reconstruct X-ray scans (computed tomography) instead of photos.

    \b
    Step by step:
      nerfcli ct convert tooth.h5 tooth           -> tooth/, a scan folder
      nerfcli ct doctor tooth                     -> tooth-doctor.html
      nerfcli ct train tooth --budget 2m          -> tooth-run/
      nerfcli ct evaluate tooth-run               -> tooth-run/metrics.json
      nerfcli ct render tooth-run --slices z=0    -> tooth-run/renders/
      nerfcli ct export tooth-run                 -> tooth-run-volume.nrrd
    """
