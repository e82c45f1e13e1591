"""The ffmpeg program: the one that comes with imageio-ffmpeg, or the one that IMAGEIO_FFMPEG_EXE names."""

import shutil

import imageio_ffmpeg

from nerfcli.errors import UserError

ANOTHER_FFMPEG = "install ffmpeg, and set the environment variable IMAGEIO_FFMPEG_EXE to its path"


def ffmpeg_program(purpose: str, *, instead: str = "") -> str:
    """Return the path of ffmpeg.

    Args:
        purpose: what fails without it, such as "cannot write videos".
        instead: what else the user can do, for the end of the hint.

    Raises:
        UserError: ffmpeg is not found, or IMAGEIO_FFMPEG_EXE names no program.
    """
    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise UserError(f"{purpose}: ffmpeg not found", ANOTHER_FFMPEG + instead) from error
    if shutil.which(program) is None:
        raise UserError(f"{purpose}: {program} is not a program", ANOTHER_FFMPEG + instead)
    return program
