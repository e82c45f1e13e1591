"""The formats of captures, one line each, and the recognition of a capture in a file or folder.

All commands that read captures go through it.
"""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from nerfcli.cameras.frame import SensorDepth
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats import (
    alicevision,
    blender,
    bundler,
    camera_path,
    colmap,
    euroc,
    kapture,
    llff,
    metashape,
    mvsnet,
    nerfies,
    neus,
    openmvg,
    opensfm,
    ply,
    polycam,
    pose_files,
    reality_capture,
    record3d,
    run_cameras,
    scanner_app,
    scannetpp,
    scene_folder,
    stray_scanner,
    trajectories,
    transforms,
    tum_rgbd,
)
from nerfcli.captures.formats.format import Format
from nerfcli.errors import UserError, in_shell, several
from nerfcli.photos.images import list_images
from nerfcli.photos.masks import mask_of

# The first format that is found in a folder counts, so those that hold more come first.
FORMATS = (
    nerfies.FORMAT,  # before that of scenes, as it has a scene.json of its own
    scene_folder.FORMAT,
    colmap.BINARY,
    colmap.TEXT,
    scannetpp.FORMAT,
    openmvg.FORMAT,
    scanner_app.FORMAT,
    transforms.FORMAT,
    blender.FORMAT,
    llff.FORMAT,
    opensfm.FORMAT,
    metashape.FORMAT,
    stray_scanner.FORMAT,
    euroc.FORMAT,
    reality_capture.TABLE,
    reality_capture.XMP,
    bundler.FORMAT,
    polycam.FORMAT,
    record3d.FORMAT,
    kapture.FORMAT,
    tum_rgbd.FORMAT,
    mvsnet.FORMAT,
    neus.FORMAT,
    pose_files.FORMAT,
    alicevision.FORMAT,
    run_cameras.FORMAT,
    camera_path.FORMAT,
    trajectories.TUM,
    trajectories.KITTI,
    ply.FORMAT,
)

# Suffixes of archives, which are unpacked before they are read; .r3d is Record3D's.
ARCHIVES = (".zip", ".r3d")


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
    refuse_archive(path)
    if inside := _captures_in(path):
        more = f" and in {several(len(inside) - 1, 'other folder')}" if len(inside) > 1 else ""
        raise UserError(f"{path} contains no capture", f"there is one in {in_shell(inside[0])}{more}: give that folder")
    if photos := photo_folder(path):
        above = path.parent if path.name else path.resolve().parent
        other = f"those of {in_shell(above)} are used if you give that folder, or " if recognised(above) else ""
        hint = f"{other}estimate them with: nerfcli poses {in_shell(photos)}"
        raise UserError(f"{photos} has {several(len(list_images(photos)), 'photo')} but no cameras", hint)
    if packed := [item for item in sorted(path.iterdir() if path.is_dir() else ()) if item.suffix.lower() in ARCHIVES]:
        hint = f"there is an archive in it: nerfcli convert {in_shell(packed[0])} SCENE --to nerfcli"
        raise UserError(f"{path} contains no capture", hint)
    raise UserError(
        f"{path} contains no capture in a supported format",
        "looked for scene.json, sparse/0/cameras.bin or .txt, transforms.json and the files of many more programs: "
        "nerfcli convert --help lists them",
    )


def _captures_in(path: Path) -> list[Path]:
    """Return the captures in a folder, or else those one level down, as far as they can be read; runs come last."""
    found = list[Path]()
    for pattern in ("*", "*/*"):
        for folder in sorted(path.glob(pattern)) if not found else ():
            with suppress(OSError):
                if folder.is_dir() and recognised(folder) is not None:
                    found.append(folder)
    return sorted(found, key=lambda folder: run_cameras.find_run(folder) is not None)


def refuse_archive(path: Path) -> None:
    """Refuse an archive where it cannot be unpacked, since no result is asked for."""
    if path.is_file() and path.suffix.lower() in ARCHIVES:
        raise UserError(f"{path} is an archive", f"unpack it: nerfcli convert {in_shell(path)} SCENE --to nerfcli")


def photo_folder(path: Path) -> Path | None:
    """Return the folder that contains photos: `path` or its subfolder `images`; None if neither does."""
    return next((folder for folder in (path, path / "images") if folder.is_dir() and list_images(folder)), None)


def format_named(name: str) -> Format:
    """Return the format with this name."""
    named = {form.name: form for form in FORMATS}
    if name not in named:
        raise UserError(f"unknown format {name!r}", f"choose one of {', '.join(named)}", exit_code=2)
    return named[name]


def depths_beside(photos: Path) -> dict[str, SensorDepth]:
    """Return the depth maps of a sensor by the names of the photos in a folder, which is part of a capture.

    A capture around it that is damaged or must not be read has none.
    """
    home = photos.resolve()
    try:
        around = recognised(home.parent)
        frames = () if around is None else around[0].parse(around[1]).frames
    except (UserError, OSError):
        return {}
    inside = [(frame.image.resolve(), frame.depth) for frame in frames if frame.image and frame.depth]
    return {image.relative_to(home).as_posix(): depth for image, depth in inside if image.is_relative_to(home)}


def refuse_missing_masks(folder: Path) -> None:
    """Refuse a folder of masks that is not there."""
    if not folder.is_dir():
        raise UserError(f"the mask folder {folder} does not exist", "give a folder with a mask for each photo")


def with_masks(capture: Capture, folder: Path) -> Capture:
    """Return the capture with masks from a folder, by the names of the photos, the ends of these, or those on disk.

    Photos without a mask there keep the one that they have.
    """
    refuse_missing_masks(folder)
    found = [
        mask_of(f.name, folder) or (mask_of(_end_on_disk(f.name, f.image), folder) if f.image else None)
        for f in capture.frames
    ]
    if not any(found):
        hint = "masks are named after the photos: IMG_1.jpg.png, IMG_1.png or IMG_1_mask.png for IMG_1.jpg"
        raise UserError(f"{folder} contains no mask for any of the {len(found)} photos", hint)
    for frame, mask in zip(capture.frames, found, strict=True):
        if mask is not None and frame.image is not None and mask.resolve() == frame.image.resolve():
            raise UserError(f"{folder} contains photos, such as {frame.name}", "give a folder that has only masks")
    frames = (f if mask is None else replace(f, mask=mask) for f, mask in zip(capture.frames, found, strict=True))
    return replace(capture, frames=tuple(frames))


def _end_on_disk(name: str, image: Path) -> str:
    """Return the end of a photo's path that has as many parts as its name in the capture."""
    parts = image.relative_to(image.anchor).parts
    return "/".join(parts[-len(name.split("/")) :])
