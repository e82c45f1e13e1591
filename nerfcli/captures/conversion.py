"""Convert a capture: parse, apply corrections, refuse or accept losses, write, read back and compare, keep."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from nerfcli.cameras import rigid
from nerfcli.cameras.camera import Camera
from nerfcli.captures.axes import Convention, expressed, opencv_from_axes, poses_of, reinterpreted
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.format import Format, UserInputs
from nerfcli.captures.formats.registry import FORMATS, recognise, with_masks
from nerfcli.captures.orientation import STORED, UPRIGHT, in_pixels
from nerfcli.errors import GATE_NOT_MET, UserError, several

TOLERANCE_PX = 1e-6
# Coordinates are rounded to 2^-53 of their size, several times, by the writer and by the parser.
_ROUNDINGS = 64 * 2.0**-53


@dataclass(frozen=True)
class Check:
    """Differences between a written file and its capture.

    Args:
        rays: number of rays compared.
        max_px: the largest distance between the pixels in which the two show a point on a ray.
        tolerance_px: the largest max_px that passes: 1e-6, or what the rounding of far coordinates may cause.
    """

    rays: int
    max_px: float
    tolerance_px: float


def check(capture: Capture, again: Capture, form: Format, *, own_lenses: bool) -> Check:
    """Compare a capture with what was read back from the file that it was written to.

    Args:
        own_lenses: compare poses only, with the lenses of the capture for both.
    """
    if "points" not in form.lacks and not np.array_equal(again.points, capture.points):
        raise differs(f"{len(again.points)} points instead of {len(capture.points)}, or other positions")
    if "poses" in form.lacks:
        return Check(0, 0.0, TOLERANCE_PX)
    frames = sorted(capture.frames, key=form.listed_by)
    if len(again.frames) != len(frames):
        raise differs(f"{len(again.frames)} views instead of {len(frames)}")
    centres = poses_of(capture)[:, :3, 3]
    distance = float(np.linalg.norm(np.ptp(centres, axis=0))) or 1.0

    @cache
    def points_on_rays(camera: Camera) -> np.ndarray:
        steps = (np.arange(6) + 0.5) / 6  # columns and rows of pixels
        directions, valid = camera.bearings(np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * camera.size)
        return directions[valid] * distance

    rays, max_px = 0, 0.0
    for frame, other in zip(frames, again.frames, strict=True):
        camera = frame.camera if own_lenses else other.camera.resized(*frame.camera.size)
        points = points_on_rays(frame.camera)
        moved = rigid.apply(rigid.inverse(other.world_from_cam) @ frame.world_from_cam, points)
        off = np.linalg.norm(camera.project(moved)[0] - frame.camera.project(points)[0], axis=1)
        rays, max_px = rays + len(off), max(max_px, float(off.max(initial=0.0)))
    focal_px = max(frame.camera.focal_px for frame in frames)
    return Check(rays, max_px, max(TOLERANCE_PX, _ROUNDINGS * focal_px * float(np.abs(centres).max()) / distance))


def differs(what: str) -> UserError:
    """Return the error for a file that does not hold what was written."""
    hint = "nothing was kept; this is a bug in nerfcli, please report it"
    return UserError(f"the file that was written differs from the capture: {what}", hint, exit_code=GATE_NOT_MET)


@dataclass(frozen=True)
class TargetOptions:
    """Format and conventions of the written file.

    Args:
        axes: its camera axes; "" for those of the format.
        pixel_centre: the coordinate of the top-left pixel's centre, see `axes.Convention`.
        allow_loss: whether content that the format cannot hold may be dropped; observations always may.
        pixels: which pixels of EXIF-turned photos the cameras refer to; None for those that programs of the format use.
    """

    form: Format
    axes: str = ""
    pixel_centre: float = 0.5
    allow_loss: bool = False
    overwrite: bool = False
    pixels: str | None = None


@dataclass(frozen=True)
class Conversion:
    """Result of a conversion.

    Args:
        capture: the capture before losses.
        losses: its contents that the format cannot hold, which were dropped.
        loss_px: the largest shift of a pixel by the dropped lens terms.
        check: the comparison of the written file with the capture.
    """

    path: Path
    capture: Capture
    losses: tuple[str, ...]
    loss_px: float
    check: Check
    notes: tuple[str, ...] = ()


def recognise_given(source: Path, given: UserInputs) -> tuple[Format, Path]:
    """Return the format of the capture in a file or folder, and the file or folder in it to parse.

    Raises:
        UserError: there is no capture, or a camera is given that its format does not take.
    """
    form, found = recognise(source)
    if given.camera is not None and not form.takes_camera:
        names = ", ".join(form.name for form in FORMATS if form.takes_camera)
        hint = f"remove --intrinsics, which is for {names}"
        raise UserError(f"{found}: {form.name} captures have their own cameras", hint, exit_code=2)
    return form, found


def load(source: Path, given: UserInputs, convention: Convention) -> tuple[Format, Path, Capture]:
    """Read the capture in a file or folder, whose numbers are in a convention.

    Returns:
        The format, the file or folder that was parsed, the capture.
    """
    form, found = recognise_given(source, given)
    capture = form.parse(found, given)
    if given.masks is not None:
        capture = with_masks(capture, given.masks)
    true_convention = replace(convention, axes=convention.axes or form.axes)
    if true_convention != Convention(form.axes):
        capture = reinterpreted(capture, true_convention, parsed_axes=form.axes)
    return form, found, capture


def convert(capture: Capture, target: Path, wanted: TargetOptions) -> Conversion:
    """Write a capture in another format, read it back, and compare.

    The file is kept only if cameras, poses and points agree, but for accepted losses; otherwise the previous files are
    restored.

    Args:
        target: the file; or the folder, for formats that fill one and for a file with the format's usual name.

    Raises:
        UserError: losses are not allowed, the result exists, or the target cannot be written; with exit code 7, the
            written file does not agree with the capture.
    """
    form = wanted.form
    path = target_path(target, wanted)
    convention = _convention(form, wanted)
    turned = in_pixels(capture, _pixels(form, wanted))
    capture = turned.capture
    off = turned.masks_left_out
    turned_masks = (f"{several(off, 'mask')} not turned like the photo (EXIF orientation)",) if off else ()
    losses = accepted_losses(capture, wanted, turned_masks)
    assert form.write is not None
    with _kept_on_success(path, _files(form, path)):
        form.write(expressed(capture, convention, written_axes=form.axes), path)
        checked, loss_px = _checked(capture, path, form, convention)
    return Conversion(path, capture, losses, loss_px, checked, turned.notes)


def target_path(target: Path, wanted: TargetOptions) -> Path:
    """Return the file or folder that is written: the target, or the format's usual file in it.

    Raises:
        UserError: the format is only read, or the result exists and may not be replaced.
    """
    form = wanted.form
    if form.write is None:
        raise UserError(f"{form.name} can be read, not written", "choose another format with --to", exit_code=2)
    is_target = not form.default_name or target.suffix == Path(form.default_name).suffix
    path = target if is_target else target / form.default_name
    there = [file for file in _files(form, path) if file.exists()]
    if there and not wanted.overwrite:
        raise UserError(f"{there[0]} exists", "add --overwrite to replace it, or choose another output path")
    return path


def accepted_losses(capture: Capture, wanted: TargetOptions, others: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Return the contents of a capture that the format cannot hold, after other losses, if they are allowed."""
    form = wanted.form
    assert form.losses is not None
    losses = (*others, *form.losses(capture))
    # 2D features are data of structure from motion, which nobody expects in other formats: losing them is no reason to
    # refuse.
    refused = (*others, *form.losses(replace(capture, observations=None)))
    if refused and not wanted.allow_loss:
        other = "" if form.name == "nerfcli" else ", or use another format, such as nerfcli, which holds the most"
        hint = f"add --allow-loss to drop that{other}"
        raise UserError(f"{form.name} cannot hold everything in this capture; it would lose: {'; '.join(losses)}", hint)
    return losses


def _pixels(form: Format, wanted: TargetOptions) -> str:
    """Return which pixels of photos (stored or upright) the cameras of the written file refer to."""
    if form.name == "nerfcli" and wanted.pixels == STORED:
        raise UserError("the nerfcli format always uses upright photos", "remove --pixels", exit_code=2)
    return wanted.pixels or (UPRIGHT if form.name == "nerfcli" else STORED)


def _convention(form: Format, wanted: TargetOptions) -> Convention:
    """Return the convention of the file to be written."""
    axes = wanted.axes or form.axes
    if not np.array_equal(opencv_from_axes(axes), opencv_from_axes(form.axes)) and not form.open_axes:
        hint = "remove --axes; programs that read this format expect its own axes"
        raise UserError(f"{form.name} prescribes the camera axes {form.axes}, not {axes}", hint)
    if wanted.pixel_centre != 0.5 and not form.open_centre:
        hint = "remove --pixel-center; programs that read this format expect its own convention"
        raise UserError(f"{form.name} prescribes the pixel convention: the top-left pixel's centre is (0.5, 0.5)", hint)
    return Convention(axes, pixel_centre=wanted.pixel_centre)


def _checked(capture: Capture, path: Path, form: Format, convention: Convention) -> tuple[Check, float]:
    """Compare the written file with the capture; return also the largest shift of a pixel by lost lens terms."""
    assert form.losses is not None
    ideal = {frame.camera: Camera.pinhole(*frame.camera.size, frame.camera.width) for frame in capture.frames}
    without_lenses = replace(capture, frames=tuple(replace(f, camera=ideal[f.camera]) for f in capture.frames))
    lenses_lost = bool(set(form.losses(capture)) - set(form.losses(without_lenses)))
    try:
        again = form.parse(path, UserInputs(camera=capture.frames[0].camera))
        if convention != Convention(form.axes):
            again = reinterpreted(again, convention, parsed_axes=form.axes)
        checked = check(capture, again, form, own_lenses=lenses_lost or "cameras" in form.lacks)
        lossy = check(capture, again, form, own_lenses="cameras" in form.lacks) if lenses_lost else None
    except UserError as error:
        message = f"{path} was not kept, as reading it back fails: {error.message}"
        raise UserError(message, error.hint, exit_code=GATE_NOT_MET) from error
    if checked.max_px > checked.tolerance_px:
        raise differs(f"a ray is off by {checked.max_px:.3g} px; tolerance {checked.tolerance_px:.3g} px")
    return checked, 0.0 if lossy is None else lossy.max_px


def _files(form: Format, path: Path) -> list[Path]:
    """Return all files that a format may write at `path`."""
    folder = path.parent if form.default_name else path
    return [folder / name.replace("*", path.stem) for name in form.files]


@contextmanager
def _kept_on_success(path: Path, files: list[Path]) -> Iterator[None]:
    """Set existing files aside; on any exception remove written files and new folders, and put the old files back."""
    path = path.absolute()  # "." has no name
    there = [file for file in files if file.exists()]
    folders = {folder for file in files for folder in file.parents} | {path, *path.parents}
    missing = sorted((folder for folder in folders if not folder.exists()), key=lambda folder: -len(folder.parts))
    place = path.with_name(f".{path.name}.aside-{os.getpid()}")  # not the name that atomic_folder uses
    aside = {file: place / file.name for file in there}
    if there:
        place.mkdir()
    try:
        for file, other in aside.items():
            os.replace(file, other)
        yield
    except BaseException:
        for file in files:
            if file not in aside or aside[file].exists():
                with suppress(OSError):  # a file that could not be written cannot be removed either
                    file.unlink(missing_ok=True)
        for file, other in aside.items():
            if other.exists():
                file.parent.mkdir(parents=True, exist_ok=True)
                os.replace(other, file)
        for folder in missing:
            with suppress(OSError):  # a folder that is not empty has files of others
                folder.rmdir()
        raise
    finally:
        shutil.rmtree(place, ignore_errors=True)
