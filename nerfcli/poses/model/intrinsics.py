"""Choose the lens model that a capture supports, and adjust with it.

Mapping starts from one distortion term. For a perspective camera, the observations then show which parameters are
determined (see `lens_observability`). Fisheyes and very wide lenses are adjusted with richer models, each time without
a tenth of the observations: a richer model is kept if it predicts these better by more than chance, and if its added
parameters are larger than their uncertainty; the principal point is freed by the same criteria.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pycolmap
from scipy.optimize import least_squares

from nerfcli.poses.model import held_out
from nerfcli.poses.model.lens_evidence import UndeterminedError, lenses_of, parameters_of
from nerfcli.poses.model.lens_observability import (
    Candidate,
    DeterminedLens,
    determine,
    has_open_distortion,
    is_centred,
    uncertainty,
)
from nerfcli.poses.model.projection import Array, projected

# From simple to rich. A fisheye model is a candidate if the field of view is wide enough to distinguish it.
PERSPECTIVE = ("SIMPLE_RADIAL", "RADIAL", "OPENCV")
FISHEYE = ("SIMPLE_RADIAL_FISHEYE", "OPENCV_FISHEYE")
FISHEYE_FROM_DEG = 90.0
# Initial models for the mapper, for perspective and fisheye lenses.
START_MODEL = "SIMPLE_RADIAL"
START_FISHEYE = "OPENCV_FISHEYE"

# A gain, and an added parameter, must be this many standard deviations from zero.
DEVIATIONS = 3.0
# The gain must be this fraction of the error; a smaller one changes no picture.
_GAIN_FRACTION = 0.001
# Each lens costs some adjustments; beyond this many lenses, and for those with fewer photos, the simplest model stays.
# The report has the uncertainty of as many.
MOST_CAMERAS = 8
LEAST_PHOTOS = 3
# Relative changes of the cost at which adjustments end: smaller ones take two to four times as long and move cameras by
# less than 1e-4 of the radius of the capture.
_TOLERANCE, _ROBUST_TOLERANCE = 1e-6, 1e-4


@dataclass(frozen=True)
class _Trial:
    model: pycolmap.Reconstruction
    principal_point: bool
    errors: Array  # (held out,) clipped, of the camera's own observations
    deviations: Array  # of the camera's parameters, NaN where held


@dataclass(frozen=True)
class ModelLenses:
    """A model with the chosen lenses, the decisions, and each lens's uncertainty by camera id, for the report."""

    model: pycolmap.Reconstruction
    candidates: list[Candidate]
    uncertainty: dict[int, dict[str, Any]]


def choose_lenses(
    model: pycolmap.Reconstruction,
    *,
    seed: int,
    threads: int,
    fixed: Sequence[int] = (),
    named: Sequence[int] = (),
    exif_focal_px: Mapping[int, float] | None = None,
) -> ModelLenses:
    """Return the model with the lens models that its observations support, adjusted again.

    Args:
        model: a converged model; it is not changed.
        named: ids of cameras that keep their model; their principal points may still become free.
        exif_focal_px: by camera id, the focal length to keep if the observations do not determine it.
    """
    photos = Counter(lenses_of(model).values())
    cameras = sorted((c for c in photos if c not in fixed and photos[c] >= LEAST_PHOTOS), key=lambda c: -photos[c])
    candidates: list[Candidate] = []
    freed: list[int] = []
    held: dict[int, DeterminedLens] = {}
    result = pycolmap.Reconstruction(model)
    held_out.adjust(result, threads=threads, fixed=fixed, tolerance=_TOLERANCE)
    for camera_id in cameras[:MOST_CAMERAS]:
        camera = result.cameras[camera_id]
        exif = (exif_focal_px or {}).get(camera_id)
        wide = _field_by_exif_deg(camera, exif) > FISHEYE_FROM_DEG
        found = None
        if parameters_of(camera):
            try:
                found = determine(
                    result,
                    camera_id,
                    mapped=model,
                    seed=seed,
                    fixed=fixed,
                    named=camera_id in named,
                    exif_focal_px=exif,
                )
            except (UndeterminedError, np.linalg.LinAlgError):
                if not wide:
                    continue  # `uncertainty` reports the reason
        if found is not None and found.held:
            held[camera_id] = found
            continue
        if found is None or wide:
            training, left_out = held_out.split(result, seed=seed)
            choice = _Choice(left_out, camera_id, threads=threads, fixed=fixed)
            best = choice.make(training, named=camera_id in named)
            _set_lens(camera, best.model.cameras[camera_id])
            free = best.principal_point
            candidates.extend(choice.tried)
        else:
            free = found.principal_point
            candidates.extend(found.steps)
            _set_lens(camera, found.camera)
        freed += [camera_id] if free else []
    if held:
        return _with_held(
            model, held, seed=seed, threads=threads, fixed=fixed, named=named, exif_focal_px=exif_focal_px
        )
    # pycolmap frees the principal points of all cameras or of none; if only some are free, they are adjusted first.
    everywhere = bool(freed) and len(freed) == len(photos)
    if freed and not everywhere:
        held_out.adjust(result, threads=threads, principal_points=True, fixed=[c for c in photos if c not in freed])
    settle(result, threads=threads, principal_points=everywhere, fixed=fixed)
    strayed = [c for c in freed if not is_centred(result.cameras[c])]
    if strayed:
        for camera_id in strayed:
            camera = result.cameras[camera_id]
            camera.principal_point_x, camera.principal_point_y = camera.width / 2, camera.height / 2
        settle(result, threads=threads, fixed=fixed)
    certain = {
        camera_id: uncertainty(
            result, camera_id, principal_point=camera_id in freed and camera_id not in strayed, seed=seed, fixed=fixed
        )
        for camera_id in sorted(photos)[:MOST_CAMERAS]
    }
    return ModelLenses(result, candidates, certain)


def _with_held(
    model: pycolmap.Reconstruction,
    held: Mapping[int, DeterminedLens],
    *,
    seed: int,
    threads: int,
    fixed: Sequence[int],
    named: Sequence[int],
    exif_focal_px: Mapping[int, float] | None,
) -> ModelLenses:
    """Choose the lenses again, with the undetermined focal lengths held at their assumed values.

    Only the distortion of these cameras is adjusted, and then fixed; or removed, if it is undetermined too.
    """
    start = pycolmap.Reconstruction(model)
    for camera_id, found in held.items():
        _set_lens(start.cameras[camera_id], found.camera)
    held_out.adjust(start, threads=threads, focal_lengths=False, fixed=[c for c in start.cameras if c not in held])
    for camera_id in held:
        if has_open_distortion(start, camera_id, seed=seed, fixed=[*fixed, *(c for c in held if c != camera_id)]):
            camera = start.cameras[camera_id]
            kept = camera.params[:3].tolist()
            camera.model = pycolmap.CameraModelId.SIMPLE_PINHOLE
            camera.params = kept
    chosen = choose_lenses(
        start, seed=seed, threads=threads, fixed=[*fixed, *held], named=named, exif_focal_px=exif_focal_px
    )
    decided = [decision for found in held.values() for decision in found.steps]
    certain = {
        camera_id: uncertainty(chosen.model, camera_id, principal_point=False, seed=seed, fixed=fixed)
        for camera_id in held
        if camera_id in chosen.uncertainty
    }
    return ModelLenses(chosen.model, [*decided, *chosen.candidates], chosen.uncertainty | certain)


def _set_lens(camera: pycolmap.Camera, lens: pycolmap.Camera) -> None:
    camera.model = lens.model
    camera.params = lens.params.tolist()


def settle(
    model: pycolmap.Reconstruction, *, threads: int, principal_points: bool = False, fixed: Sequence[int] = ()
) -> None:
    """Adjust a whole model in place, drop the observations that no longer fit, and adjust once more.

    The last adjustment is robust: highlights and moving things are seldom far enough off to be dropped, and are wrong
    in the same way in many photos; with squared errors, they would bias the lens.
    """
    adjust = partial(held_out.adjust, model, threads=threads, principal_points=principal_points, fixed=fixed)
    adjust(tolerance=_TOLERANCE)
    held_out.drop_misfits(model)
    scale_px = held_out.loss_scale_px(held_out.observation_errors_px(model))
    adjust(robust_px=scale_px, tolerance=_ROBUST_TOLERANCE)
    held_out.drop_misfits(model)


def converted(camera: pycolmap.Camera, name: str) -> pycolmap.Camera:
    """Return a camera of another COLMAP model that projects rays to nearly the same pixels, same principal point."""
    start = pycolmap.Camera.create_from_model_name(
        camera.camera_id, name, camera.mean_focal_length(), camera.width, camera.height
    )
    start.principal_point_x, start.principal_point_y = camera.principal_point_x, camera.principal_point_y
    start.has_prior_focal_length = camera.has_prior_focal_length
    columns, rows = np.meshgrid(np.linspace(0, camera.width, 15), np.linspace(0, camera.height, 15))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    rays = np.asarray(camera.cam_ray_from_img(pixels), dtype=np.float64).reshape(-1, 3)
    good = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.05)
    free = [*start.focal_length_idxs(), *start.extra_params_idxs()]
    params = np.array(start.params, dtype=np.float64)

    def misses(values: Array) -> Array:
        params[free] = values
        start.params = params.tolist()
        found = projected(start, rays[good]) - pixels[good]
        return np.nan_to_num(found, nan=1e3).ravel()  # a ray that the trial cannot project counts as far off

    scale = np.array([camera.mean_focal_length() if i in start.focal_length_idxs() else 0.1 for i in free])
    fitted = least_squares(misses, params[free], x_scale=scale, loss="soft_l1")
    params[free] = fitted.x
    start.params = params.tolist()
    return start


def field_of_view_deg(camera: pycolmap.Camera) -> float:
    """Return the field of view from corner to corner of a picture; 180 if the lens model has no rays there."""
    corners = np.array([[0.0, 0.0], [camera.width, camera.height]])
    rays = np.asarray(camera.cam_ray_from_img(corners), dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(rays).all():
        return 180.0
    cosine = rays[0] @ rays[1] / np.linalg.norm(rays[0]) / np.linalg.norm(rays[1])
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _field_by_exif_deg(camera: pycolmap.Camera, exif_focal_px: float | None) -> float:
    """Return the field of view by EXIF's focal length; without one, by the estimated camera, which may have drifted."""
    if exif_focal_px is None:
        return field_of_view_deg(camera)
    return float(2 * np.degrees(np.arctan(np.hypot(camera.width, camera.height) / 2 / exif_focal_px)))


class _Choice:
    """The trials of one camera, from the simplest model on, each compared with the best one before it."""

    def __init__(
        self, held: held_out.HeldOutObservations, camera_id: int, *, threads: int, fixed: Sequence[int]
    ) -> None:
        self.held, self.camera_id, self.threads, self.fixed = held, camera_id, threads, fixed
        self.tried: list[Candidate] = []

    def make(self, training: pycolmap.Reconstruction, *, named: bool) -> _Trial:
        """Return the best trial.

        The principal point comes before the tangential terms: both shift the picture, but real cameras have sensors off
        the axis, and that rotates the poses.
        """
        camera = training.cameras[self.camera_id]
        wide = field_of_view_deg(camera) > FISHEYE_FROM_DEG
        if named:
            simple, richer, others = camera.model.name, (camera.model.name,), ()
        elif camera.is_perspective_fisheye():
            simple, richer, others = FISHEYE[0], FISHEYE[1:], PERSPECTIVE
        else:
            simple, richer, others = PERSPECTIVE[0], PERSPECTIVE[1:], FISHEYE if wide else ()
        best = self._trial(training, simple, principal_point=False)
        self._note(best, gain=None, significance=None, kept=True)
        for number, name in enumerate(richer):
            richer_one = best if named else self._better(best, name, principal_point=best.principal_point)
            changed, best = richer_one is not best, richer_one
            if not best.principal_point and (changed or number == 0):
                best = self._better(best, best.model.cameras[self.camera_id].model.name, principal_point=True)
        for name in others:
            best = self._better(best, name, principal_point=best.principal_point)
        return best

    def _better(self, best: _Trial, name: str, *, principal_point: bool) -> _Trial:
        trial = self._trial(best.model, name, principal_point=principal_point)
        gain, significance = held_out.gain(best.errors, trial.errors), _significance(best, trial, self.camera_id)
        pays = bool(
            gain > DEVIATIONS
            and trial.errors.mean() < (1 - _GAIN_FRACTION) * best.errors.mean()
            and significance > DEVIATIONS
            and is_centred(trial.model.cameras[self.camera_id])
        )
        self._note(trial, gain=gain, significance=significance, kept=pays)
        return trial if pays else best

    def _trial(self, training: pycolmap.Reconstruction, name: str, *, principal_point: bool) -> _Trial:
        model = pycolmap.Reconstruction(training)
        camera = model.cameras[self.camera_id]
        if camera.model.name != name:
            _set_lens(camera, converted(camera, name))
        others = [c for c in model.cameras if c != self.camera_id] if principal_point else self.fixed
        adjuster = held_out.adjust(model, threads=self.threads, principal_points=principal_point, fixed=others)
        mine = np.array([model.image(int(i)).camera_id == self.camera_id for i in self.held.images], dtype=bool)
        errors = np.minimum(held_out.errors_px(model, self.held)[mine], held_out.MOST_ERROR_PX)
        deviations = held_out.intrinsic_deviations(model, adjuster, self.camera_id, principal_points=principal_point)
        return _Trial(model, principal_point, errors, deviations)

    def _note(self, trial: _Trial, *, gain: float | None, significance: float | None, kept: bool) -> None:
        error = float(trial.errors.mean()) if len(trial.errors) else None
        name = trial.model.cameras[self.camera_id].model.name
        self.tried.append(Candidate(self.camera_id, name, trial.principal_point, error, gain, significance, kept))


def _significance(before: _Trial, after: _Trial, camera_id: int) -> float:
    """Return the largest ratio of value to standard deviation of the parameters that are free only in `after`."""
    old, new = before.model.cameras[camera_id], after.model.cameras[camera_id]
    if old.is_perspective_fisheye() != new.is_perspective_fisheye():
        return float("inf")  # another family, not added parameters
    added = [(index, new.params[index]) for index in new.extra_params_idxs()[len(old.extra_params_idxs()) :]]
    if after.principal_point and not before.principal_point:
        before_it = (old.principal_point_x, old.principal_point_y)  # the centre, or the given point
        indices = new.principal_point_idxs()
        added += [(index, new.params[index] - start) for index, start in zip(indices, before_it, strict=True)]
    ratios = [abs(value) / after.deviations[index] for index, value in added if after.deviations[index] > 0]
    return max(ratios, default=0.0)
