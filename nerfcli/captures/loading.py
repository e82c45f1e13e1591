"""Load a capture of any format, with the photos that are on disk and their split.

The world frame is that of its files: it is never rotated, moved or scaled here.
"""

import hashlib
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats import run_cameras
from nerfcli.captures.formats.format import Format
from nerfcli.captures.formats.registry import recognise
from nerfcli.captures.formats.scene_folder import SCENE_FILE
from nerfcli.captures.holdout import HELD_OUT_EVERY, default_split, names_held_out
from nerfcli.captures.orientation import UPRIGHT, rescaled_sizes, upright
from nerfcli.errors import UserError, in_shell, several
from nerfcli.photos.images import list_images
from nerfcli.photos.masks import masks_inside

# Formats that leave out photos without a pose, which lie beside the others.
_BESIDE_OTHERS = ("colmap", "colmap-text", "reality-capture", "realityscan-xmp")
# The edge of a picture, as a fraction of its side.
_EDGE = 0.01


def load_scene(path: str | Path, *, holdout: str | None = None) -> Capture:
    """Load the scene in a file or folder of any format of captures, with the photos that are on disk.

    Example:
        >>> import nerfcli
        >>> scene = nerfcli.load_scene("photos-scene")
        >>> [frame.name for frame in scene.test_frames]

    Args:
        path: the folder, or the file of cameras.
        holdout: rule for the held-out photos, see `holdout`, instead of the split of the capture.

    Raises:
        UserError: there is no capture, its files are malformed or do not fit the photos, none is on disk, or the rule
            does not fit.
    """
    path = Path(path)
    form, found = recognise(path)
    if form is run_cameras.FORMAT and path.is_dir():
        raise UserError(
            f"{path} is a run, not a scene",
            f"give the scene it was trained on, or {in_shell(found)} for its refined cameras; to continue it: nerfcli "
            f"train SCENE -o {in_shell(path)} --resume",
        )
    scene = with_photos_on_disk(path, form, found, form.parse(found))
    if holdout is None:
        return scene
    names = names_held_out(holdout, (frame.name for frame in scene.frames), others=scene.missing)
    return replace(scene, test_names=names, holdout=holdout)


def fingerprint(scene: Capture) -> str:
    """Compute a SHA-256 of names, cameras, poses and split: the same on every machine that reads the same capture.

    Numbers enter with nine digits after the point (positions after division by the power of ten that bounds them), so
    that differences between linear algebra libraries in the last bits do not matter.
    """
    reach = max((float(np.abs(frame.centre).max()) for frame in scene.frames), default=0.0)
    size = 10.0 ** math.ceil(math.log10(reach)) if reach > 0 else 1.0
    digest = hashlib.sha256()
    for frame in sorted(scene.frames, key=lambda frame: frame.name):
        pose = np.concatenate([frame.world_from_cam[:3, :3].ravel(), frame.centre / size])
        camera = frame.camera
        line = [
            *(frame.name, "test" if frame.name in scene.test_names else "train"),
            *(camera.model, str(camera.width), str(camera.height), f"{size:.0e}"),
            *(f"{value:.9e}" for value in camera.params),
            *(f"{value:.9f}" for value in np.round(pose, 9) + 0.0),  # + 0.0 turns -0 into 0
        ]
        digest.update(("\t".join(line) + "\n").encode())
    return digest.hexdigest()


def with_photos_on_disk(path: Path, form: Format, found: Path, capture: Capture) -> Capture:
    """Return a capture with the photos that are on disk, upright, and the split of its files if they have one.

    Raises:
        UserError: no photo is on disk, or one does not fit its camera.
    """
    frames = capture.frames
    order = list(range(len(frames)))
    if form.is_unordered:
        order.sort(key=lambda index: frames[index].name)
    order = [index for index in order if frames[index].split not in form.unused_splits]
    if frames and not order:
        raise UserError(
            f"{found}: {form.name} ({form.of}), all {len(frames)} photos are of a split that is not used "
            f"({', '.join(sorted(form.unused_splits))})",
            "give the file that lists the training photos, too",
        )
    fitted = {index: _upright(capture, frames[index]) for index in order if frames[index].has_photo}
    if not fitted:
        first, video = frames[order[0] if order else 0], form.video(found)
        line = f"nerfcli convert {in_shell(path)} SCENE --to nerfcli"
        raise UserError(
            f"{found}: {form.name} ({form.of}), none of its {len(order)} photos is on disk, such as "
            f"{first.image or first.name}",
            f"put the photos where the capture lists them, or give their folder: {line} --images FOLDER"
            if video is None
            else f"they are frames of {video.name}; {line} writes them",
        )
    splits = {frames[index].split for index in (order if form.has_split else fitted)}
    if form.has_split or {"test", "val"} & splits:
        held_out = "test" if "test" in splits else "val"
        # Views of other splits are used neither for training nor for evaluation.
        kept = [index for index in fitted if frames[index].split in ("train", held_out)]
        test_names = frozenset(frames[index].name for index in kept if frames[index].split == held_out)
    else:
        kept = list(fitted)
        test_names = default_split(frames[index].name for index in kept)
    return replace(
        capture,
        root=path.parent if path.is_file() else path,
        kind=form.name,
        frames=tuple(fitted[index] for index in kept),
        test_names=test_names,
        missing=(*(frames[index].name for index in order if index not in fitted), *capture.missing),
        depth_bounds=None if capture.depth_bounds is None else capture.depth_bounds[kept],
        observations=None,
        pixels=UPRIGHT,
        rescaled=rescaled_sizes((frames[index].camera, frame.camera) for index, frame in fitted.items()),
        provenance=capture.provenance or {"from": form.name},
        notes=(*capture.notes, *doubts([fitted[index] for index in kept])),
    )


def doubts(frames: Sequence[Frame]) -> tuple[str, ...]:
    """Return lines on cameras that are hardly those of the photos, for people; files have such numbers by mistake."""
    notes = []
    if len(frames) > 1 and len({frame.centre.tobytes() for frame in frames}) == 1:
        notes.append(f"all {len(frames)} cameras are at the same place, from which no depth can be learned")
    outside = [frame.name for frame in frames if not _is_plausible(frame.camera)]
    if outside:
        notes.append(
            f"the principal point of {several(len(outside), 'photo')}, such as {outside[0]}, is outside the picture or "
            "at its edge; if the intrinsics are for larger pictures, say so with nerfcli convert --from-size (--detect "
            "finds the factor)"
        )
    return tuple(notes)


def _is_plausible(camera: Camera) -> bool:
    """Return whether the principal point is in the picture, and not at its edge, as fractions of the size would be."""
    places = zip(camera.principal_point, camera.size, strict=True)
    return all(_EDGE * side <= place <= (1 - _EDGE) * side for place, side in places)


def _upright(capture: Capture, frame: Frame) -> Frame:
    """Return a frame fitted to its upright photo on disk."""
    if frame.mask is not None and not frame.mask.is_file():
        raise UserError(f"{frame.mask}, the mask of {frame.name}, does not exist", "restore it, or remove its entry")
    return upright(frame, capture.pixels)


def refuse_without_training_photos(scene: Capture) -> None:
    """Refuse a scene that holds out every photo."""
    if not scene.train_frames:
        hint = "its split lists none: choose another with --holdout, such as every:8"
        if len(scene.frames) < 2:
            hint = f"every {HELD_OUT_EVERY}th photo is held out, so at least 2 are needed"
        raise UserError(f"{scene.root} has no training photo", hint)


def refuse_without_held_out_photos(scene: Capture) -> None:
    """Refuse a scene whose split holds out no photo."""
    if not scene.test_frames:
        # Of all other formats, a split that lists none is no split.
        hint = (
            f'name some in {scene.root / SCENE_FILE}, such as every {HELD_OUT_EVERY}th: "split": {{"test": ["a.jpg"]}}'
        )
        raise UserError(f"{scene.root} has no held-out photos", hint)


def describe_unused_masks(scene: Capture) -> str | None:
    """Describe how to use a folder of masks in the scene's folder that none of its files mentions; None without one."""
    if any(frame.mask is not None for frame in scene.frames):
        return None
    masks = masks_inside(scene.root, [frame.name for frame in scene.frames])
    if masks is None:
        return None
    return f"{masks}; to use them: nerfcli convert {in_shell(scene.root)} SCENE --to nerfcli --masks {in_shell(masks)}"


def describe_source(path: Path, scene: Capture) -> str:
    """Describe which file or folder a scene at `path` was read from, in which format, and how many photos it has."""
    form, found = recognise(path)
    there = len(scene.frames)
    text = f"{found}: {form.name} ({form.of}), {there} of {there + len(scene.missing)} photos on disk"
    folder, without_pose = _without_pose(scene) if scene.kind in _BESIDE_OTHERS else (found, [])
    if not without_pose:
        return text
    subfolders = " --subfolders" if any(file.parent != folder for file in without_pose) else ""
    return (
        f"{text}; {several(len(without_pose), 'photo')} beside them, such as {without_pose[0].name}, without a pose: "
        f"for poses of all, run nerfcli poses {in_shell(folder)}{subfolders}"
    )


def _without_pose(scene: Capture) -> tuple[Path, list[Path]]:
    """Return the folder of a scene's photos, with the photos in it that the scene does not have."""
    images = {frame.image for frame in scene.frames if frame.image is not None}
    parents = sorted({image.parent for image in images})
    others = [file for parent in parents for file in list_images(parent) if file not in images]
    # Masks as COLMAP, OpenDroneMap and RealityScan name them are no photos: a.jpg.png, a_mask.png, a.jpg.mask.png.
    of_photos = {name for image in images for name in (image.name, f"{image.stem}_mask")}
    others = [file for file in others if of_photos.isdisjoint((file.stem, Path(file.stem).stem))]
    return Path(os.path.commonpath(parents)), others
