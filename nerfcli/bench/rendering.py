"""Measure rendering settings of one trained field: interleaved times, errors against photos and converged pictures.

Every setting renders the same whole photos. A first round renders the pictures from which errors are computed, and
warms up; its times do not count. Every later round times all settings in a different order, so that a machine that gets
slower in the middle does not make one setting look slow. A setting with the same arithmetic as another, such as one
with fewer threads, is measured like any other.
"""

import random
import time
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch

from nerfcli.atomic import atomic_path
from nerfcli.bench.convergence import FINER, distance_to_float64, smaller
from nerfcli.bench.machine import PeakMemory
from nerfcli.bench.sample_pictures import FOLDER, MOST_ERROR, MOST_QUADRATURE, slug, write_difference, write_picture
from nerfcli.bench.session import Session
from nerfcli.bench.sweep import STORED_IN, RenderSetting
from nerfcli.evaluate.metrics import psnr, to_8_bit
from nerfcli.evaluate.protocol import HeldOutPhoto, background_of, compare
from nerfcli.field.cost import field_bytes
from nerfcli.render.accuracy import TIGHT
from nerfcli.render.model import Model
from nerfcli.render.pictures import RAYS_PER_TILE, RenderedPicture, render_picture

MOST_PHOTOS = 3
LEAST_ROUNDS, MOST_ROUNDS = 3, 9
# Number of settings that are measured even if time is short: with fewer, there is nothing to compare.
_LEAST_SETTINGS = 7
# Time of a converged picture over that of a default one, measured on two captures: it has FINER times the samples.
_CONVERGED_COST = 0.7 * FINER
_FLOAT64_PIXELS = 64
WORK = "work"
_DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}


@dataclass(frozen=True)
class _Subject:
    """The field in every storage precision, and the photos with their converged renderings."""

    models: dict[str, Model]
    photos: tuple[HeldOutPhoto, ...]
    converged: tuple[np.ndarray, ...]


def measure_rendering(
    model: Model, photos: Sequence[HeldOutPhoto], settings: Sequence[RenderSetting], *, session: Session, seconds: float
) -> None:
    """Measure as many rendering settings as time allows, continuing an earlier call.

    Args:
        photos: the held-out photos, at least one.
        settings: rendering settings, the default first, then the most informative ones first.
        session: records the measurements: "rendering plan", "converged", "float64", "picture" and "time".
        seconds: time limit for all of this.
    """
    ends = session.spent + seconds
    plan = session.records.last("rendering plan")
    if plan is None:
        plan = _planned(model, photos, settings, session=session, seconds=seconds)
    by_name = {setting.name: setting for setting in settings}
    chosen = [by_name[name] for name in plan["settings"] if name in by_name]
    used = tuple(smaller(photo, plan["factor"]) for photo in photos if photo.frame.name in plan["photos"])
    models = {name: _stored_in(model, name) for name in STORED_IN}
    subject = _Subject(models, used, _converged(model, used, session=session))
    if session.records.last("float64") is None:
        session.say("checking against float64")
        error = distance_to_float64(model, used[0], count=_FLOAT64_PIXELS)
        session.record("float64", error=error, pixels=_FLOAT64_PIXELS)
    done = {entry["point"] for entry in session.records.of_kind("picture")}
    for number, setting in enumerate(chosen):
        if number >= _LEAST_SETTINGS and session.spent > ends - 0.3 * seconds:
            chosen = [setting for setting in chosen if setting.name in done]
            session.notify(f"skipping {len(plan['settings']) - len(chosen)} rendering settings for lack of time")
            break
        if setting.name not in done:
            session.say(f"rendering: {setting.name}")
            measured = _measure_picture(subject, setting, session)
            described = {"options": setting.options, "settings": asdict(setting)}
            session.record("picture", point=setting.name, **described, **measured)
            done.add(setting.name)
    _measure_times(subject, chosen, rounds=plan["rounds"], session=session, ends=ends)


def _planned(
    model: Model, photos: Sequence[HeldOutPhoto], settings: Sequence[RenderSetting], *, session: Session, seconds: float
) -> dict[str, Any]:
    """Plan the photos, their size, settings and rounds by the time of one default picture, and record the plan."""
    session.say("rendering a first picture")
    _render(model, photos[0], settings[0])
    began = time.perf_counter()
    _render(model, photos[0], settings[0])
    once = time.perf_counter() - began
    needed = once * (_CONVERGED_COST + sum(map(_cost, settings[:_LEAST_SETTINGS])) * (LEAST_ROUNDS + 1))
    factor = max(1.0, (needed / seconds) ** 0.5)
    once /= factor**2
    count = 1
    for more in range(2, min(MOST_PHOTOS, len(photos)) + 1):
        if more * once * (_CONVERGED_COST + sum(map(_cost, settings)) * (LEAST_ROUNDS + 2)) <= seconds:
            count = more
    for_settings = seconds / (count * once) - _CONVERGED_COST
    number = _LEAST_SETTINGS
    while number < len(settings) and sum(map(_cost, settings[: number + 1])) * (LEAST_ROUNDS + 1) <= for_settings:
        number += 1
    chosen = settings[:number]
    rounds = int(for_settings / sum(map(_cost, chosen))) - 1
    picked = np.unique(np.linspace(0, len(photos) - 1, count + 2).round().astype(int)[1:-1])
    plan: dict[str, Any] = {
        "settings": [setting.name for setting in chosen],
        "photos": [photos[index].frame.name for index in picked],
        "rounds": min(max(rounds, LEAST_ROUNDS), MOST_ROUNDS),
        "factor": factor,
        "first_seconds": once,
    }
    session.record("rendering plan", **plan)
    return plan


def _cost(setting: RenderSetting) -> float:
    """Estimate the time of a setting relative to the default."""
    steps = 0.4 + 0.6 / setting.step
    return steps * (1.8 if setting.name.endswith(("thread", "threads")) else 1.0)


def _converged(model: Model, photos: Sequence[HeldOutPhoto], *, session: Session) -> tuple[np.ndarray, ...]:
    """Return converged renderings of the photos' views: steps `FINER` times as fine, next to nothing left out."""
    pictures, measured = [], {entry["photo"] for entry in session.records.of_kind("converged")}
    for photo in photos:
        path = session.folder / WORK / f"{slug(photo.frame.name)}.npy"
        if not path.exists() or photo.frame.name not in measured:
            session.say("rendering the converged pictures")
            background = background_of(model, photo)
            fine = render_picture(model.stretched(1 / FINER), photo.frame, background=background, tolerance=TIGHT)
            with atomic_path(path) as partial:
                np.save(partial, fine.rgb)
            compared = compare(photo, fine)
            write_picture(session.folder / FOLDER / f"{slug(photo.frame.name)}-truth.jpg", compared.photo)
            decibels = psnr(to_8_bit(compared.rendered), compared.photo, used=compared.used)
            session.record("converged", photo=photo.frame.name, psnr=decibels)
        pictures.append(np.load(path))
    return tuple(pictures)


def _measure_picture(subject: _Subject, setting: RenderSetting, session: Session) -> dict[str, Any]:
    """Return the errors of a setting's pictures; write the first picture to disk."""
    model, decibels, squares, bound = subject.models[setting.stored_in], [], [], 0.0
    for index, (photo, fine) in enumerate(zip(subject.photos, subject.converged, strict=True)):
        picture = _render(model, photo, setting)
        compared = compare(photo, picture)
        rounded = to_8_bit(compared.rendered)
        decibels.append(psnr(rounded, compared.photo, used=compared.used))
        squares.append(float(np.square(picture.rgb - fine, dtype=np.float64)[compared.used].mean()))
        bound = max(bound, float(picture.truncation_error.max(initial=0.0)))
        if index == 0:
            place, name = session.folder / FOLDER, slug(setting.name)
            write_picture(place / f"{name}-render.jpg", rounded)
            write_difference(place / f"{name}-error.jpg", compared.rendered, compared.photo / 255.0, most=MOST_ERROR)
            write_difference(place / f"{name}-quadrature.jpg", picture.rgb, fine, most=MOST_QUADRATURE)
    return {
        "psnr": float(np.mean(decibels)),
        "quadrature": float(np.sqrt(np.mean(squares))),
        "truncation_bound": bound,
        "field_bytes": field_bytes(model.field) // (1 if setting.stored_in == "float32" else 2),
    }


def _measure_times(
    subject: _Subject, settings: Sequence[RenderSetting], *, rounds: int, session: Session, ends: float
) -> None:
    """Time all settings in rounds: `LEAST_ROUNDS` in any case, then more while there is time."""
    memory = PeakMemory(str(subject.models["float32"].device))
    measured = {(entry["round"], entry["point"]) for entry in session.records.of_kind("time")}
    for number in range(1, rounds + 1):
        if number > LEAST_ROUNDS and session.spent > ends:
            return
        order = list(settings)
        random.Random(number).shuffle(order)
        for setting in order:
            if (number, setting.name) in measured:
                continue
            session.say(f"timing, round {number} of {rounds}: {setting.name}")
            memory.begin()
            began = time.perf_counter()
            for photo in subject.photos:
                _render(subject.models[setting.stored_in], photo, setting)
            seconds = (time.perf_counter() - began) / len(subject.photos)
            session.record("time", point=setting.name, round=number, seconds=seconds, peak_memory_bytes=memory.read())


def _render(model: Model, photo: HeldOutPhoto, setting: RenderSetting) -> RenderedPicture:
    torch.set_num_threads(setting.threads)
    return render_picture(
        model.stretched(setting.step),
        photo.frame,
        background=background_of(model, photo),
        tolerance=setting.tolerance,
        rays_per_tile=None if setting.rays_per_tile == RAYS_PER_TILE else setting.rays_per_tile,
    )


def _stored_in(model: Model, precision: str) -> Model:
    """Return the model with its field rounded to a storage precision."""
    field = deepcopy(model.field)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.copy_(parameter.to(_DTYPES[precision]))
    return replace(model, field=field)
