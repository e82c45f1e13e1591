"""The members of a run, RUN/members/1, 2, ...: further fields of the same scene whose differences show what varies."""

from dataclasses import replace

from nerfcli.errors import UserError
from nerfcli.field.kinds import KINDS as FIELDS
from nerfcli.runs.files import MEMBERS
from nerfcli.runs.run import Run
from nerfcli.runs.settings import TrainSettings
from nerfcli.workflows.notices import Notify, Progress, no_progress, silent, warn_python
from nerfcli.workflows.train import train_again

VARIED = ("seeds", "photos", "prior", "field")
# Fewer have no standard deviation.
FEWEST = 2
# Of the training photos, what each member uses. A bootstrap draws 63 %, which costs each field more.
PHOTO_FRACTION = 0.8
# See `TrainSettings.random_start`; it costs 0.2 dB on the spheres, 0.3 would cost 1 dB.
RANDOM_START = 0.1
_VARIED_SETTINGS = ("seed", "photo_fraction", "random_start", "field", "device", "threads")


def member_settings(first: TrainSettings, count: int, *, vary: str) -> list[TrainSettings]:
    """Return the settings of the members of a run.

    Args:
        first: of the run.
        count: of the members.
        vary: one of `VARIED`. "seeds": seeds alone, which follow the run's own; they vary in all other kinds, too.
            "photos": `PHOTO_FRACTION` of the training photos, drawn without replacement. "prior": a smooth random
            field to start from. "field": every kind of field in turn.
    """
    members = []
    for number in range(1, count + 1):
        settings = replace(first, seed=first.seed + number)
        match vary:
            case "photos":
                settings = replace(settings, photo_fraction=PHOTO_FRACTION * first.photo_fraction)
            case "prior":
                settings = replace(settings, random_start=RANDOM_START)
            case "field":
                settings = replace(settings, field=FIELDS[(number - 1) % len(FIELDS)])
        members.append(settings)
    return members


def train_members(
    run: Run,
    count: int,
    *,
    vary: str,
    device: str,
    threads: int,
    resume: bool = False,
    overwrite: bool = False,
    notify: Notify = silent,
    warn: Notify = warn_python,
    progress: Progress = no_progress,
) -> list[Run]:
    """Train the members of a run, each with the run's whole budget, and return them.

    Members that are there and complete are kept, interrupted ones are resumed.

    Args:
        run: a complete run.
        count: of the members.
        vary: one of `VARIED`, see `member_settings`.
        device, threads: as for `TrainSettings`.
        resume, overwrite, notify, warn: see `train_again`.
        progress: takes the share of all members that is done and a few words.

    Raises:
        UserError: see `train_again`; or a member of another kind stands there.
    """
    first = replace(run.config.settings, device=device, threads=threads)
    budgets = [f"{first.budget_seconds:g} s"] if first.budget_seconds else []
    budgets += [f"{first.steps} steps"] if first.steps else []
    notify(f"{count} members, varied by {vary}, {' or '.join(budgets)} each")
    members = []
    for number, settings in enumerate(member_settings(first, count, vary=vary), start=1):
        path = run.path / MEMBERS / str(number)

        def of_all(share: float, words: str, before: int = number - 1) -> None:
            progress((before + share) / count, f"member {before + 1} of {count}  {words}")

        train_again(
            run, {path: settings}, resume=resume, overwrite=overwrite, notify=notify, warn=warn, progress=of_all
        )
        members.append(Run(path))
    return members


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
    """The first setting in which two trainings differ, of those that do not vary between members."""
    there, wanted = one.to_json(), other.to_json()
    names = [name for name in wanted if name not in _VARIED_SETTINGS and there[name] != wanted[name]]
    return f"{names[0]} {there[names[0]]}, not {wanted[names[0]]}" if names else None
