"""What commands for photos say where they are given an X-ray scan: the command that is for it."""

from pathlib import Path

from nerfcli.ct.recognise import OWN, is_reconstruction, is_volume, recognise
from nerfcli.errors import UserError, in_shell

# Commands of `nerfcli ct` for a scan in another format, a scan folder and a run; the first is named by the others.
_OF_FORMATS, _OF_SCANS = ("convert", "doctor", "info"), ("train", "doctor", "info")
_OF_RUNS = ("render", "evaluate", "export", "info")


def refuse_scan(path: Path, command: str) -> None:
    """Refuse a scan, its reconstruction or its volume in a command for photos.

    Raises:
        UserError: the path is one; the hint is the command line for it.
    """
    if is_reconstruction(path):
        what, commands = "the reconstruction of an X-ray scan", _OF_RUNS
    elif command == "info" and is_volume(path):
        what, commands = "the volume of an X-ray scan", ("info",)
    elif (form := recognise(path)) is not None:
        what, commands = ("an X-ray scan", _OF_SCANS) if form == OWN else (f"an X-ray scan ({form})", _OF_FORMATS)
    else:
        return
    suited = command if command in commands else commands[0]
    line = f"nerfcli ct {suited} {in_shell(path)}{' SCAN' if suited == 'convert' else ''}"
    raise UserError(f"{path} is {what}, and {command} is for photos", f"use {line}")
