"""The members of a run, RUN/members/1, 2, ...: further fields of the same scene, trained to see how much they vary."""

from nerfcli.errors import UserError
from nerfcli.runs.files import CONFIG, MEMBERS
from nerfcli.runs.run import Run
from nerfcli.runs.settings import TrainSettings

# Fewest members that have a standard deviation.
FEWEST = 2
# Settings in which the members of a run may differ, besides their seeds.
_VARIED_SETTINGS = ("photo_fraction", "random_start", "field")


def members_of(run: Run) -> list[Run]:
    """Return the members of a run, at least `FEWEST`.

    Raises:
        UserError: there are too few members, or one is incomplete or does not belong to the training of the run.
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
    """Return the members whose training has begun, by number."""
    folders = [path for path in (run.path / MEMBERS).glob("*") if path.name.isdigit() and (path / CONFIG).exists()]
    return [Run(path) for path in sorted(folders, key=lambda path: int(path.name))]


def members_in_words(run: Run) -> list[str]:
    """Describe each member whose training has begun in a line: seed, other varied settings, complete or not."""
    lines, first = [], run.config.settings.to_json()
    for member in begun_members(run):
        settings = member.config.settings
        own = settings.to_json()
        varied = [f"{name} {own[name]}" for name in _VARIED_SETTINGS if own[name] != first[name]]
        state = "complete" if member.is_complete(settings) else "interrupted"
        lines.append(", ".join([f"{member.path.name}: seed {settings.seed}", *varied, state]))
    return lines


def _difference(one: TrainSettings, other: TrainSettings) -> str | None:
    """Describe the first difference between settings that members must have in common; None without any."""
    there, wanted = one.to_json(), other.to_json()
    may_differ = ("seed", *_VARIED_SETTINGS, "device", "threads")
    names = [name for name in wanted if name not in may_differ and there[name] != wanted[name]]
    return f"{names[0]} {there[names[0]]}, not {wanted[names[0]]}" if names else None
