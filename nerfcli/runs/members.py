"""The members of a run, RUN/members/1, 2, ...: further fields of the same scene whose differences show what varies."""

from nerfcli.errors import UserError
from nerfcli.runs.files import MEMBERS
from nerfcli.runs.run import Run
from nerfcli.runs.settings import TrainSettings

# Fewer have no standard deviation.
FEWEST = 2
# Of members that belong to one run.
_VARIED_SETTINGS = ("seed", "photo_fraction", "random_start", "field", "device", "threads")


def members_of(run: Run) -> list[Run]:
    """Return the members of a run, at least `FEWEST`.

    Raises:
        UserError: there are too few complete ones, or they belong to another training than the run's.
    """
    folders = [path for path in (run.path / MEMBERS).glob("*") if path.name.isdigit()]
    members = [Run(path) for path in sorted(folders, key=lambda path: int(path.name))]
    hint = "train them: nerfcli train SCENE -o RUN --members 4, with the options of the run"
    if len(members) < FEWEST:
        raise UserError(f"{run.path} has {len(members)} members; {FEWEST} are needed at least", hint)
    for member in members:
        settings = member.config.settings
        if not member.is_complete(settings):
            raise UserError(f"the training of {member.path} was interrupted", hint)
        if difference := _difference(settings, run.config.settings):
            raise UserError(f"{member.path} belongs to another training than {run.path}: {difference}", hint)
        if member.config.split_sha256 != run.config.split_sha256:
            raise UserError(f"{member.path} has other held-out photos than {run.path}", hint)
    return members


def _difference(one: TrainSettings, other: TrainSettings) -> str | None:
    """Return the first setting in which two trainings differ, of those that do not vary between members."""
    there, wanted = one.to_json(), other.to_json()
    names = [name for name in wanted if name not in _VARIED_SETTINGS and there[name] != wanted[name]]
    return f"{names[0]} {there[names[0]]}, not {wanted[names[0]]}" if names else None
