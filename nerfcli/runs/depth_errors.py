"""RUN/depth_errors.json: errors of the field's depth, measured with the held-out photos."""

from pathlib import Path

from nerfcli.render.depth_errors import STRATA, DepthErrors
from nerfcli.runs.files import DEPTH_ERRORS
from nerfcli.sealed import read_sealed, write_sealed

FORMAT = "nerfcli depth errors 1"


def read_depth_errors(run: Path, *, expected: str) -> DepthErrors | None:
    """Return the stored errors; None if they are missing, damaged, or have another digest."""
    try:
        content = read_sealed(run / DEPTH_ERRORS)
        if (content["format"], content["digest"], content["strata"]) != (FORMAT, expected, list(STRATA)):
            return None
        return DepthErrors.from_json(content)
    except (OSError, ValueError, LookupError, TypeError):
        return None  # the caller measures them again


def write_depth_errors(run: Path, errors: DepthErrors, *, digest: str) -> None:
    """Write the errors, atomically.

    Raises:
        UserError: the file cannot be written.
    """
    write_sealed(run / DEPTH_ERRORS, {"format": FORMAT, "digest": digest, **errors.to_json()})
