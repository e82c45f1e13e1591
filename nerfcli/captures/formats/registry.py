"""The formats of captures in one table: how each is recognised, parsed, written, and what it cannot hold.

All commands that read captures go through it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Capture, Frame
from nerfcli.captures.formats import (
    alicevision,
    blender,
    bundler,
    camera_path,
    colmap,
    finding,
    llff,
    metashape,
    mvsnet,
    neus,
    opensfm,
    ply,
    polycam,
    pose_files,
    reality_capture,
    record3d,
    run_cameras,
    trajectories,
    transforms,
)
from nerfcli.captures.formats.photo_names import IMAGE_FOLDERS
from nerfcli.captures.formats.scene_folder import SCENE_FILE, SCENE_FILES, losses_scene, parse_scene, write_scene
from nerfcli.captures.stored_pixels import measure
from nerfcli.errors import UserError, in_shell, several
from nerfcli.photos.images import list_images
from nerfcli.photos.masks import mask_of


@dataclass(frozen=True)
class UserInputs:
    """Additional input of the user besides the capture's own files.

    Args:
        images: the folder of the photos, to which names are relative.
        camera: the camera of all frames, for formats without cameras.
        masks: a folder of masks named after the photos, see `photos.masks.mask_of`.
    """

    images: Path | None = None
    camera: Camera | None = None
    masks: Path | None = None


@dataclass(frozen=True)
class Format:
    """A format of captures.

    Args:
        of: what it is, or which programs write it.
        looked_for: what it is recognised by, in a few words for people; "" for formats that are only written.
        find: returns where such a capture is in a file or folder; None if there is none.
        parse: reads what `find` found, or what `write` wrote.
        axes: the camera axes of its poses, as three letters or a name.
        open_axes: whether poses with other axes are found in such files, so that --axes makes sense.
        open_centre: whether principal points with other pixel centres are found in such files.
        default_name: the name of its file if the target is a folder; "" for formats that fill a folder.
        files: the names of all files that it may write, where "*" stands for that file's name without its suffix.
        lacks: which of "cameras", "poses" and "points" it has no place for.
        listed_by: the order of frames in its files, as a key to sort by; by default, that of the capture.
        write, losses: None for formats that are only read.
    """

    name: str
    of: str
    looked_for: str
    find: Callable[[Path], Path | None]
    parse: Callable[[Path, UserInputs], Capture]
    axes: str = "opencv"
    open_axes: bool = False
    open_centre: bool = False
    default_name: str = ""
    files: tuple[str, ...] = ()
    lacks: tuple[str, ...] = ()
    listed_by: Callable[[Frame], Any] = lambda frame: 0
    write: Callable[[Capture, Path], None] | None = None
    losses: Callable[[Capture], tuple[str, ...]] | None = None


def recognised(path: Path) -> tuple[Format, Path] | None:
    """Return the format of the capture in a file or folder, and the file or folder in it to parse; None without one."""
    return next(((form, found) for form in FORMATS if (found := form.find(path)) is not None), None)


def recognise(path: Path) -> tuple[Format, Path]:
    """Return what `recognised` returns.

    Raises:
        UserError: there is nothing, or nothing in a known format; the message lists what was looked for.
    """
    if not path.exists():
        raise UserError(f"{path} does not exist", "give a capture: a file or folder of cameras, or a scene folder")
    if (found := recognised(path)) is not None:
        return found
    if photos := photo_folder(path):
        raise UserError(
            f"{photos} has {several(len(list_images(photos)), 'photo')} but no cameras",
            f"estimate them with: nerfcli poses {in_shell(photos)}",
        )
    looked_for = ", ".join(dict.fromkeys(form.looked_for for form in FORMATS if form.looked_for))
    raise UserError(f"{path} contains no capture in a supported format", f"looked for {looked_for}")


def photo_folder(path: Path) -> Path | None:
    """Return the folder that contains photos: `path` or its subfolder `images`; None if neither does."""
    return next((folder for folder in (path, path / "images") if folder.is_dir() and list_images(folder)), None)


def format_named(name: str) -> Format:
    """Return the format with this name.

    Raises:
        UserError: there is none.
    """
    for form in FORMATS:
        if form.name == name:
            return form
    raise UserError(
        f"unknown format {name!r}", f"choose one of {', '.join(form.name for form in FORMATS)}", exit_code=2
    )


def recording(form: Format, provenance: Mapping[str, Any]) -> Format:
    """Return the format with `provenance` recorded in the files that it writes, if they have a place for it."""
    if form.write is not write_scene:
        return form
    return replace(form, write=lambda capture, folder: write_scene(capture, folder, provenance=provenance))


def with_photos(capture: Capture, *folders: Path) -> Capture:
    """Return the capture with its photos looked up in folders, by their names, file names alone, or without suffix."""
    stems = [{photo.stem: photo for photo in reversed(list_images(folder))} for folder in folders if folder.is_dir()]
    frames = []
    for frame in capture.frames:
        name = Path(frame.name).name
        paths = [*(folder / frame.name for folder in folders), *(folder / name for folder in folders)]
        named = next((path for path in paths if path.is_file()), None)
        image = named or next((photos[name] for photos in stems if name in photos), frame.image)
        frames.append(replace(frame, image=image))
    return replace(capture, frames=tuple(frames))


def with_masks(capture: Capture, folder: Path) -> Capture:
    """Return the capture with masks from a folder, by the names of the photos or by their file names alone.

    Photos without a mask there keep the one that they have.

    Raises:
        UserError: there is no such folder, it has no mask for any photo, or it contains the photos.
    """
    if not folder.is_dir():
        raise UserError(f"the mask folder {folder} does not exist", "give a folder with a mask for each photo")
    found = [mask_of(frame.name, folder) for frame in capture.frames]
    if not any(found):
        raise UserError(
            f"{folder} contains no mask for any of the {len(found)} photos",
            "masks are named after the photos: IMG_1.jpg.png, IMG_1.png or IMG_1_mask.png for IMG_1.jpg",
        )
    for frame, mask in zip(capture.frames, found, strict=True):
        if mask is not None and frame.image is not None and mask.resolve() == frame.image.resolve():
            raise UserError(f"{folder} contains photos, such as {frame.name}", "give a folder that has only masks")
    frames = (f if mask is None else replace(f, mask=mask) for f, mask in zip(capture.frames, found, strict=True))
    return replace(capture, frames=tuple(frames))


# The first format that is found in a folder counts, so those that hold more come first.
FORMATS = (
    Format(
        "nerfcli",
        "a scene folder",
        SCENE_FILE,
        finding.folder_of(SCENE_FILE),
        lambda path, given: parse_scene(path, images=given.images),
        files=SCENE_FILES,
        write=write_scene,
        losses=losses_scene,
    ),
    Format(
        "colmap",
        "a COLMAP model",
        "sparse/0/cameras.bin or .txt",
        finding.find_model,
        lambda path, given: colmap.parse_model(path, images=given.images),
        files=colmap.MODEL_FILES,
        write=colmap.write_colmap_binary,
        losses=colmap.losses_colmap,
    ),
    Format(
        "colmap-text",
        "a COLMAP model as text",
        "sparse/0/cameras.bin or .txt",
        finding.find_model,
        lambda path, given: colmap.parse_model(path, images=given.images),
        files=colmap.MODEL_FILES,
        write=colmap.write_colmap_text,
        losses=colmap.losses_colmap_text,
    ),
    Format(
        "transforms",
        "nerfstudio, instant-ngp",
        "transforms.json",
        finding.find_transforms,
        lambda path, given: transforms.parse_transforms(path, measure),
        axes="opengl",
        open_axes=True,
        open_centre=True,
        default_name="transforms.json",
        files=("*.json", "*_points.ply"),
        write=transforms.write_transforms,
        losses=transforms.losses_transforms,
    ),
    Format(
        "blender",
        "NeRF's synthetic scenes",
        "transforms_train.json",
        finding.find_blender,
        lambda path, given: blender.parse_blender(path, measure, images=given.images, camera=given.camera),
        axes="opengl",
        open_axes=True,
        files=("transforms_train.json", "transforms_val.json", "transforms_test.json"),
        lacks=("points",),
        listed_by=lambda frame: transforms.SPLITS.index(frame.split or "train"),
        write=blender.write_blender,
        losses=blender.losses_blender,
    ),
    Format(
        "llff",
        "poses_bounds.npy",
        "poses_bounds.npy",
        finding.folder_of(llff.FILE),
        lambda path, given: llff.parse_llff(path, list_images),
        axes="llff",
        open_axes=True,
        files=("poses_bounds.npy",),
        lacks=("points",),
        listed_by=lambda frame: Path(frame.name).name,
        write=llff.write_llff,
        losses=llff.losses_llff,
    ),
    Format(
        "opensfm",
        "OpenSfM, OpenDroneMap",
        "reconstruction.json",
        lambda path: finding.find_json(path, opening="[", name="reconstruction.json"),
        lambda path, given: opensfm.parse_opensfm(path),
        default_name="reconstruction.json",
        files=("*.json",),
        write=opensfm.write_opensfm,
        losses=opensfm.losses_opensfm,
    ),
    Format(
        "metashape",
        "Agisoft Metashape",
        ".xml",
        finding.by_suffix(".xml", "cameras.xml"),
        lambda path, given: with_photos(
            metashape.parse_metashape(path), *(path.parent / name for name in IMAGE_FOLDERS), path.parent
        ),
    ),
    Format(
        "reality-capture",
        "RealityScan, RealityCapture",
        ".csv",
        finding.find_reality_capture,
        lambda path, given: reality_capture.parse_reality_capture(path, measure, images=given.images),
    ),
    Format(
        "bundler",
        "Bundler",
        "bundle.out",
        finding.find_bundler,
        lambda path, given: bundler.parse_bundler(path, measure, images=given.images),
        axes="opengl",
    ),
    Format(
        "polycam",
        "raw data of Polycam",
        "keyframes/",
        finding.find_polycam,
        lambda path, given: polycam.parse_polycam(path, list_images, images=given.images),
        axes="opengl",
    ),
    Format(
        "record3d",
        "Record3D",
        "metadata.json",
        finding.find_record3d,
        lambda path, given: record3d.parse_record3d(path, list_images, images=given.images),
        axes="opengl",
    ),
    Format(
        "mvsnet",
        "cams/ of MVSNet, BlendedMVS",
        "cams/",
        finding.find_mvsnet,
        lambda path, given: mvsnet.parse_mvsnet(path, measure, list_images, images=given.images),
    ),
    Format(
        "neus",
        "projections of IDR, NeuS",
        ".npz",
        finding.find_neus,
        lambda path, given: neus.parse_neus(path, measure, list_images, images=given.images),
    ),
    Format(
        "pose-files",
        "a matrix per photo, as in ScanNet, 7-Scenes, NSVF",
        "pose/*.txt",
        finding.find_pose_files,
        lambda path, given: pose_files.parse_pose_files(
            path, measure, list_images, camera=given.camera, images=given.images
        ),
    ),
    Format(
        "alicevision",
        "AliceVision, Meshroom",
        ".sfm",
        finding.find_alicevision,
        lambda path, given: alicevision.parse_alicevision(path, images=given.images),
    ),
    Format(
        "run",
        "cameras refined by training",
        "cameras.json of a run",
        run_cameras.find_run,
        lambda path, given: run_cameras.parse_run(path),
    ),
    Format(
        "camera-path",
        "a camera path of nerfstudio's viewer",
        "camera_path.json",
        finding.find_camera_path,
        lambda path, given: camera_path.parse_camera_path(path),
        axes="opengl",
        open_axes=True,
        lacks=("cameras", "points"),
    ),
    Format(
        "tum",
        "a trajectory of the TUM RGB-D benchmark",
        ".txt with 8 or 12 numbers a line",
        lambda path: finding.find_lines(path, columns=8),
        lambda path, given: trajectories.parse_tum(path, given.camera),
        open_axes=True,
        default_name="trajectory.txt",
        files=("*.txt",),
        lacks=("cameras", "points"),
        write=trajectories.write_tum,
        losses=trajectories.losses_tum,
    ),
    Format(
        "kitti",
        "a trajectory of the KITTI odometry benchmark",
        ".txt with 8 or 12 numbers a line",
        lambda path: finding.find_lines(path, columns=12),
        lambda path, given: trajectories.parse_kitti(path, given.camera),
        open_axes=True,
        default_name="poses.txt",
        files=("*.txt",),
        lacks=("cameras", "points"),
        write=trajectories.write_kitti,
        losses=trajectories.losses_kitti,
    ),
    Format(
        "ply",
        "the points only",
        "",
        lambda path: None,
        lambda path, given: Capture((), ply.read_ply_points(path)[0], (), None, "ply"),
        default_name="points.ply",
        files=("*.ply",),
        lacks=("cameras", "poses"),
        write=ply.write_ply,
        losses=ply.losses_ply,
    ),
)
