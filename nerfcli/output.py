"""Where results go, and whether they replace what is there: the one policy of overwriting."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nerfcli.atomic import cannot_write, refuse_read_only
from nerfcli.errors import UserError


@dataclass(frozen=True)
class Output:
    """Where a result goes, and whether it replaces one that is there.

    Args:
        path: a file or a folder; None for the usual place, which the function that writes it names.
        overwrite: replace an earlier result. Nothing but results of nerfcli is ever replaced by a folder.
    """

    path: str | Path | None = None
    overwrite: bool = False

    def at(self, usual: Path) -> Path:
        """Return the path, or the usual one."""
        return usual if self.path is None else Path(self.path)

    def beside(self, source: Path, suffix: str) -> Path:
        """Return the path, or the one beside the source with `suffix` added to its name; see `beside`."""
        return beside(source, suffix) if self.path is None else Path(self.path)

    def keeps(self, path: Path, is_same: Callable[[], bool]) -> bool:
        """Return whether a result is there and stays: it may not be replaced, and is what would be made.

        Raises:
            UserError: another result is there, and may not be replaced.
        """
        if self.overwrite or not path.exists():
            return False
        if is_same():
            return True
        raise UserError(
            f"{path} exists, made from other files or with other settings",
            "add --overwrite to replace it, or choose another folder with -o",
        )

    def refuse_existing(self, *paths: Path) -> None:
        """Refuse files if one of them is there and may not be replaced.

        Raises:
            UserError: a file is there and may not be replaced.
        """
        there = [path for path in paths if path.exists()]
        if there and not self.overwrite:
            raise UserError(f"{there[0]} exists", "add --overwrite to replace it, or choose another path with -o")

    def claim_file(self, path: Path) -> None:
        """Refuse a file that cannot be written or is there and may not be replaced; create its folder.

        Raises:
            UserError: it cannot be written, or is there and may not be replaced.
        """
        if path.is_dir():
            raise UserError(f"{path} is a folder", "give a file name with -o")
        self.refuse_existing(path)
        try:
            path.resolve().parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(path, error) from error
        refuse_read_only(path)


def beside(source: Path, suffix: str) -> Path:
    """Return the path beside a source, with `suffix` added to its name.

    Raises:
        UserError: the source is the root of the file system, beside which nothing can be written.
    """
    if source.name in ("", ".."):  # "." and ".." have a name only once they are resolved
        source = source.resolve()
    if not source.name:
        raise UserError(f"cannot write a result next to {source}", "choose the output folder with -o")
    return source.with_name(source.name + suffix)
