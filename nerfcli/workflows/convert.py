"""Convert a capture, or detect its convention."""

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from nerfcli.captures import detect
from nerfcli.captures.archives import unpacked
from nerfcli.captures.axes import Convention
from nerfcli.captures.capture import Capture
from nerfcli.captures.conversion import (
    TOLERANCE_PX,
    Conversion,
    TargetOptions,
    accepted_losses,
    convert,
    load,
    recognise_given,
    target_path,
)
from nerfcli.captures.formats.format import Format, UserInputs
from nerfcli.captures.formats.registry import refuse_missing_masks
from nerfcli.captures.loading import doubts
from nerfcli.captures.orientation import STORED, describe_rescaling, in_pixels, other_sizes
from nerfcli.captures.world import WorldFrame, in_world_frame
from nerfcli.errors import UserError, listed, several
from nerfcli.notices import Reporter
from nerfcli.output import Output
from nerfcli.photos.images import UNUSUAL_SUFFIXES
from nerfcli.poses.input.video_frames import extract_frames, frames_folder


def convert_capture(
    source: Path,
    target: Path,
    wanted: TargetOptions,
    *,
    given: UserInputs = UserInputs(),
    convention: Convention = Convention(),
    world: WorldFrame = WorldFrame(),
    reporter: Reporter = Reporter(),
) -> tuple[Conversion, dict[str, Any]]:
    """Convert one capture; return the conversion, and its record as plain values.

    Args:
        source: a file or folder in a known format.
        given: photos, masks and cameras that the source does not name.
        convention: that of the numbers in the source.

    Raises:
        UserError: the capture cannot be read or written, the format cannot hold it, or what was written differs.
    """
    to = wanted.form.name
    target_path(target, wanted)  # refused before files are unpacked and frames replaced
    if given.masks is not None:
        refuse_missing_masks(given.masks)
    source = unpacked(source, Output(target, wanted.overwrite), reporter=reporter)
    given = _with_frames(source, target, wanted, given=given, world=world, reporter=reporter)
    form, found, capture = load(source, given, convention)
    reporter.note(f"{found}: {form.name}, {contents(capture)}")
    for text in capture.notes:
        reporter.warn(text)
    if "cameras" not in wanted.form.lacks and ("cameras" not in form.lacks or given.images is not None):
        _report_missing(capture, reporter)
    for text in describe_rescaling({} if "cameras" in wanted.form.lacks else other_sizes(capture)):
        reporter.note(f"{text.removesuffix(': rescaled')}; written to {to} unchanged")
    for text in doubts(capture.frames):
        reporter.warn(text)
    moved = in_world_frame(capture, world)
    scale = moved.scale
    if scale is not None:
        error = "" if scale.standard_error is None else f" ± {scale.standard_error:.2g}"
        unit = "%" if scale.residual_unit == "percent" else "m"
        reporter.note(
            f"one scene unit is {scale.metres_per_unit:.6g}{error} metres, from {scale.source}; residual "
            f"{scale.rms_residual:.2g} {unit}" + (f"; {scale.details}" if scale.details else "")
        )
    frame = {"new_from_old": moved.new_from_old.to_json()} | ({} if scale is None else {"scale": scale.to_json()})
    capture = replace(moved.capture, provenance={"source": str(found), **frame})
    done = convert(capture, target, wanted)
    for text in done.notes:
        reporter.note(text)
    suffixes = {frame.image.suffix.lower() for frame in done.capture.frames if frame.image is not None}
    if to != "nerfcli" and (unusual := sorted(suffixes & UNUSUAL_SUFFIXES)):
        reporter.note(f"the photos are {', '.join(unusual)} files, which many other programs cannot read")
    for loss in done.losses:
        reporter.warn(f"{to} cannot hold {loss}")
    if done.loss_px > TOLERANCE_PX:
        reporter.warn(f"dropping lens parameters shifts pixels by up to {done.loss_px:.3g} px")
    return done, {"from": form.name, "to": to} | _record(done) | frame


def _with_frames(
    source: Path, target: Path, wanted: TargetOptions, *, given: UserInputs, world: WorldFrame, reporter: Reporter
) -> UserInputs:
    """Return the user's inputs, with the frames of a capture's video, written beside the target if it has no photos."""
    form, found = recognise_given(source, given)
    video = None if given.images is not None else form.video(found)
    if video is None:
        return given
    capture = form.parse(found, given)
    if any(frame.has_photo for frame in capture.frames):
        return given
    # A scene holds everything, but needs the photos; with another scale, the unit is not lost.
    if wanted.form.name != "nerfcli" and world.scale is None:
        accepted_losses(capture, wanted)
    is_file = wanted.form.default_name and target.suffix == Path(wanted.form.default_name).suffix
    folder = frames_folder(target.with_suffix("") if is_file else target)
    with reporter.stage(f"extract frames of {video.name}") as stage:
        extract_frames(video, folder, count=None, overwrite=wanted.overwrite, reporter=stage)
    return replace(given, images=folder)


def _report_missing(capture: Capture, reporter: Reporter) -> None:
    """Name the photos that are not on disk; refuse a capture of which none is."""
    missing = [*(frame.name for frame in capture.frames if not frame.has_photo), *capture.missing]
    count = len(capture.missing) + len(capture.frames)
    if len(missing) == count:
        hint = "give their folder with --images; poses without photos can be written with --to tum"
        raise UserError(f"none of the {several(count, 'photo')} of the capture is on disk, such as {missing[0]}", hint)
    if missing:
        reporter.warn(f"{len(missing)} of {several(count, 'photo')} missing: {listed(missing)}")


def detect_convention(
    source: Path,
    *,
    given: UserInputs = UserInputs(),
    convention: Convention = Convention(),
    reporter: Reporter = Reporter(),
) -> tuple[Format, detect.Detection]:
    """Detect the format of a capture, and the convention that its numbers follow."""
    form, found, capture = load(source, given, convention)
    reporter.note(f"{found}: {form.name}, {contents(capture)}")
    for text in capture.notes:
        reporter.warn(text)
    return form, detect.detect(in_pixels(capture, STORED).capture, axes=form.axes, progress=reporter.progress)


def options_of(found: detect.Detection) -> str:
    """Return the options that make `nerfcli convert` read the capture in the detected convention."""
    convention, declared = found.convention, found.declared
    options = [] if convention.axes == declared.axes else [f"--from-axes {convention.axes}"]
    options += ["--from-inverted"] if convention.inverted else []
    options += [f"--from-pixel-center {convention.pixel_centre:g}"] if convention.pixel_centre != 0.5 else []
    options += [f"--from-size {convention.intrinsics_scale:g}"] if convention.intrinsics_scale != 1 else []
    return " ".join(options)


def detection_record(found: detect.Detection, form: str) -> dict[str, Any]:
    """Return a detection as plain values."""
    return {
        "format": form,
        "evidence": found.evidence,
        "as_format_says": found.as_format_says,
        "options": options_of(found),
        "questions": [
            {
                "question": question.name,
                "verdict": question.verdict,
                "ratio": _finite(question.ratio),
                "reason": question.reason,
                "hypotheses": [
                    {
                        **asdict(answer.convention),
                        "as_format_says": answer.as_format_says,
                        "median_px": _finite(answer.median_px),
                        "inlier_share": answer.inlier_fraction,
                    }
                    for answer in question.answers
                ],
            }
            for question in found.questions
        ],
    }


def _finite(value: float) -> float | None:
    """Return a number that JSON has; None where most of the evidence is behind the cameras."""
    return value if math.isfinite(value) else None


def contents(capture: Capture) -> str:
    """Describe the content of a capture in a few words."""
    cameras = len({frame.camera for frame in capture.frames})
    masks = sum(frame.mask is not None for frame in capture.frames)
    counts = [(len(capture.frames), "image"), (cameras, "camera"), (len(capture.points), "point")]
    counts += [(masks, "mask")] if masks else []
    return ", ".join(several(number, noun) for number, noun in counts)


def _record(done: Conversion) -> dict[str, Any]:
    return {
        "images": len(done.capture.frames),
        "cameras": len({frame.camera for frame in done.capture.frames}),
        "points": len(done.capture.points),
        "losses": list(done.losses),
        "loss_px": done.loss_px,
        "read_back": asdict(done.check),
    }
