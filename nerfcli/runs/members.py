"""The members of a run, RUN/members/1, 2, ...: further fields of the same scene whose differences show what varies."""

from nerfcli.errors import UserError
from nerfcli.runs.files import CONFIG, MEMBERS
from nerfcli.runs.run import Run
from nerfcli.runs.settings import TrainSettings

# Fewer have no standard deviation.
FEWEST = 2
# Of members that belong to one run, besides their seeds.
_VARIED_SETTINGS = ("photo_fraction", "random_start", "field")


def members_of(run: Run) -> list[Run]:
    """Return the members of a run, at least `FEWEST`.

    Raises:
        UserError: there are too few complete ones, or they belong to another training than the run's.
    """
    members = begun_members(run)
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


def begun_members(run: Run) -> list[Run]:
    """Return the members whose training has begun, in their order."""
    folders = [path for path in (run.path / MEMBERS).glob("*") if path.name.isdigit() and (path / CONFIG).exists()]
    return [Run(path) for path in sorted(folders, key=lambda path: int(path.name))]


def members_in_words(run: Run) -> list[str]:
    """Describe the members that have begun, a line each: seed, what else varies, and whether it is complete."""
    lines, first = [], run.config.settings.to_json()
    for member in begun_members(run):
        settings = member.config.settings
        own = settings.to_json()
        varied = [f"{name} {own[name]}" for name in _VARIED_SETTINGS if own[name] != first[name]]
        state = "complete" if member.is_complete(settings) else "interrupted"
        lines.append(", ".join([f"{member.path.name}: seed {settings.seed}", *varied, state]))
    return lines


def _difference(one: TrainSettings, other: TrainSettings) -> str | None:
    """Return the first setting in which two trainings differ, of those that do not vary between members."""
    there, wanted = one.to_json(), other.to_json()
    may_differ = ("seed", *_VARIED_SETTINGS, "device", "threads")
    names = [name for name in wanted if name not in may_differ and there[name] != wanted[name]]
    return f"{names[0]} {there[names[0]]}, not {wanted[names[0]]}" if names else None
