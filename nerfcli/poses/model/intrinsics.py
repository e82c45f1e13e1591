"""Choose the lens model that a capture supports, and adjust with it.

Mapping starts from one distortion term. For a perspective camera, the observations then show which parameters are
determined (see `lens_observability`). Fisheyes and very wide lenses, for which several kinds of models compete, are
adjusted with one after the other, without a tenth of the observations: another model, or a principal point off the
centre, is kept if it predicts these better by more than chance.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pycolmap
from scipy.optimize import least_squares

from nerfcli.poses.input.job import Solver
from nerfcli.poses.model import held_out
from nerfcli.poses.model.lens_evidence import lenses_of, parameters_of
from nerfcli.poses.model.lens_observability import (
    DeterminedLens,
    determine_lens,
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

# A gain must be this many standard errors.
DEVIATIONS = 3.0
# The gain must be this fraction of the error; a smaller one changes no picture.
_GAIN_FRACTION = 0.001
# Each lens costs some adjustments; beyond this many lenses, and for those with fewer photos, the simplest model stays.
# The report has the uncertainty of as many, those with the most photos.
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


@dataclass(frozen=True)
class ModelLenses:
    """A model with the chosen lenses, and each lens's uncertainty by camera id, for the report."""

    model: pycolmap.Reconstruction
    uncertainty: dict[int, dict[str, Any]]


def choose_lenses(
    model: pycolmap.Reconstruction,
    solver: Solver = Solver(),
    *,
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
    cameras = [c for c, count in photos.most_common() if c not in solver.fixed and count >= LEAST_PHOTOS]
    freed: list[int] = []
    held: dict[int, DeterminedLens] = {}
    result = pycolmap.Reconstruction(model)
    held_out.adjust(result, solver, tolerance=_TOLERANCE)
    for camera_id in cameras[:MOST_CAMERAS]:
        camera = result.cameras[camera_id]
        exif = (exif_focal_px or {}).get(camera_id)
        wide = _field_by_exif_deg(camera, exif) > FISHEYE_FROM_DEG
        found = None
        if parameters_of(camera):
            try:
                found = determine_lens(
                    result, camera_id, solver, mapped=model, named=camera_id in named, exif_focal_px=exif
                )
            except np.linalg.LinAlgError:
                if not wide:
                    continue  # `uncertainty` reports the reason
        if found is not None and found.held:
            held[camera_id] = found
            continue
        if found is None or wide:
            best = _choose_by_held_out(result, camera_id, solver, named=camera_id in named)
            lens, free = best.model.cameras[camera_id], best.principal_point
        else:
            lens, free = found.camera, found.principal_point
        _set_lens(camera, lens)
        freed += [camera_id] if free else []
    if held:
        again = partial(choose_lenses, named=named, exif_focal_px=exif_focal_px)
        return _with_held(model, held, solver, choose=again)
    # pycolmap frees the principal points of all cameras or of none; if only some are free, they are adjusted first.
    everywhere = bool(freed) and len(freed) == len(photos)
    if freed and not everywhere:
        others = replace(solver, fixed=tuple(c for c in photos if c not in freed))
        held_out.adjust(result, others, principal_points=True)
    refine_model(result, solver, principal_points=everywhere)
    strayed = [c for c in freed if not is_centred(result.cameras[c])]
    if strayed:
        for camera_id in strayed:
            camera = result.cameras[camera_id]
            camera.principal_point_x, camera.principal_point_y = camera.width / 2, camera.height / 2
        refine_model(result, solver)
    still_free = set(freed).difference(strayed)
    certain = {
        camera_id: uncertainty(result, camera_id, solver, principal_point=camera_id in still_free)
        for camera_id, _ in photos.most_common(MOST_CAMERAS)
    }
    return ModelLenses(result, certain)


def _with_held(
    model: pycolmap.Reconstruction,
    held: Mapping[int, DeterminedLens],
    solver: Solver,
    *,
    choose: Callable[[pycolmap.Reconstruction, Solver], ModelLenses],
) -> ModelLenses:
    """Choose the lenses again by `choose`, with the undetermined focal lengths held at their assumed values.

    Only the distortion of these cameras is adjusted, and then fixed; or removed, if it is undetermined too.
    """
    start = pycolmap.Reconstruction(model)
    for camera_id, found in held.items():
        _set_lens(start.cameras[camera_id], found.camera)
    others = replace(solver, fixed=tuple(c for c in start.cameras if c not in held))
    held_out.adjust(start, others, focal_lengths=False)
    for camera_id in held:
        rest = replace(solver, fixed=(*solver.fixed, *(c for c in held if c != camera_id)))
        if has_open_distortion(start, camera_id, rest):
            camera = start.cameras[camera_id]
            kept = camera.params[:3].tolist()
            camera.model = pycolmap.CameraModelId.SIMPLE_PINHOLE
            camera.params = kept
    chosen = choose(start, replace(solver, fixed=(*solver.fixed, *held)))
    certain = {
        camera_id: uncertainty(chosen.model, camera_id, solver, principal_point=False)
        for camera_id in held
        if camera_id in chosen.uncertainty
    }
    return ModelLenses(chosen.model, chosen.uncertainty | certain)


def _set_lens(camera: pycolmap.Camera, lens: pycolmap.Camera) -> None:
    camera.model = lens.model
    camera.params = lens.params.tolist()


def refine_model(model: pycolmap.Reconstruction, solver: Solver, *, principal_points: bool = False) -> None:
    """Adjust a whole model in place, drop the observations that no longer fit, and adjust once more.

    The last adjustment is robust: highlights and moving things are seldom far enough off to be dropped, and are wrong
    in the same way in many photos; with squared errors, they would bias the lens.
    """
    adjust = partial(held_out.adjust, model, solver, principal_points=principal_points)
    adjust(tolerance=_TOLERANCE)
    held_out.drop_misfits(model)
    scale_px = held_out.loss_scale_px(held_out.observation_errors_px(model))
    adjust(robust_px=scale_px, tolerance=_ROBUST_TOLERANCE)
    held_out.drop_misfits(model)


def convert_camera(camera: pycolmap.Camera, name: str) -> pycolmap.Camera:
    """Return a camera of another COLMAP model that projects rays to nearly the same pixels, same principal point."""
    focal_px = camera.mean_focal_length()
    start = pycolmap.Camera.create_from_model_name(camera.camera_id, name, focal_px, camera.width, camera.height)
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

    scale = np.array([focal_px if i in start.focal_length_idxs() else 0.1 for i in free])
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


def _choose_by_held_out(model: pycolmap.Reconstruction, camera_id: int, solver: Solver, *, named: bool) -> _Trial:
    """Adjust a model with one lens model of a camera after the other, each compared with the best one before it.

    The principal point comes before the tangential terms: both shift the picture, but real cameras have sensors off the
    axis, and that rotates the poses.
    """
    training, held = held_out.split(model, seed=solver.seed)
    mine = np.array([training.image(int(i)).camera_id == camera_id for i in held.images], dtype=bool)
    camera = training.cameras[camera_id]
    # None stands for the best one so far with its principal point free.
    names: tuple[str | None, ...] = (*PERSPECTIVE[:2], None, *PERSPECTIVE[2:], *FISHEYE)
    if camera.is_perspective_fisheye():
        names = (*FISHEYE, None, *PERSPECTIVE)
    if named:
        names = (camera.model.name, None)
    best: _Trial | None = None
    for name in names:
        trial = pycolmap.Reconstruction(training if best is None else best.model)
        camera = trial.cameras[camera_id]
        if name is not None and camera.model.name != name:
            _set_lens(camera, convert_camera(camera, name))
        free = name is None or (best is not None and best.principal_point)
        others = tuple(c for c in trial.cameras if c != camera_id) if free else solver.fixed
        held_out.adjust(trial, replace(solver, fixed=others), principal_points=free)
        errors = np.minimum(held_out.errors_px(trial, held)[mine], held_out.MOST_ERROR_PX)
        if best is None or (
            held_out.gain(best.errors, errors) > DEVIATIONS
            and errors.mean() < (1 - _GAIN_FRACTION) * best.errors.mean()
            and is_centred(camera)
        ):
            best = _Trial(trial, free, errors)
    assert best is not None
    return best
