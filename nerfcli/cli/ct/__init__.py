"""Commands for X-ray scans: `nerfcli ct`."""

import typer

from nerfcli.cli.ct import scans, volumes
from nerfcli.cli.usage import Command

app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)
for _command in (
    *(scans.convert, scans.doctor, scans.train),
    *(volumes.evaluate, volumes.render, volumes.export, scans.info),
):
    app.command(_command.__name__, cls=Command)(_command)


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
