"""A scene: the photos of a capture with their cameras, read from any supported format.

`load` detects the format; `save` writes nerfcli's own scene.json beside a COLMAP model. The world frame of a scene is
that of its files: it is never rotated, moved or scaled here.
"""

import hashlib
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerfcli.atomic import write_json
from nerfcli.cameras.formats.blender import read_blender
from nerfcli.cameras.formats.colmap import colmap_on_disk, is_model, read_colmap, read_model
from nerfcli.cameras.formats.colmap_model import ColmapModel
from nerfcli.cameras.formats.llff import IMAGE_FOLDERS, read_llff
from nerfcli.cameras.formats.run_cameras import CAMERAS
from nerfcli.cameras.formats.scene_json import SCENE_FILE, SCENE_VERSION, UNITS, UNUSED, read_description
from nerfcli.cameras.formats.transforms import read_transforms
from nerfcli.cameras.frame import Capture, Frame, Size
from nerfcli.errors import UserError, in_shell
from nerfcli.holdout import moments, names_held_out
from nerfcli.media.exif import read_exif
from nerfcli.media.images import image_size, list_images
from nerfcli.media.masks import find_mask, masks_inside

MODEL_FOLDER = "sparse/0"


# By default, one of this many photos in the order of their names is held out.
HELD_OUT_EVERY = 8

_MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", ".")
_FOREIGN_FILES = ("transforms.json", "transforms_train.json", "poses_bounds.npy")


@dataclass(frozen=True)
class Scene:
    """The photos of a capture with cameras and poses.

    Args:
        root: the folder that was loaded.
        kind: "nerfcli", "colmap", "transforms", "blender" or "llff".
        frames: all views whose photos are on disk.
        test_names: names of the held-out frames.
        points: (N, 3) surface points in the world frame, float64; N is 0 if the format has none.
        missing: names of listed images that are not on disk.
        unit: unit of length: "arbitrary" or "metre".
        depth_bounds: (frames, 2) nearest and farthest z per frame, in scene units, if the format has them.
        unit_source: source of the metric scale; None if the unit is arbitrary, or the source is unknown.
        rescaled: number of photos whose intrinsics were given for another size, see `Capture.rescaled`.
        history: origin of cameras and points: the provenance of `save`, or {"from": the format}.
        holdout: the rule that chose the held-out frames; None for the split of the capture, or the default split.
    """

    root: Path
    kind: str
    frames: tuple[Frame, ...]
    test_names: frozenset[str]
    points: np.ndarray
    missing: tuple[str, ...]
    unit: str = "arbitrary"
    depth_bounds: np.ndarray | None = None
    unit_source: str | None = None
    rescaled: Mapping[tuple[Size, Size], int] = field(default_factory=dict)
    history: Mapping[str, Any] = field(default_factory=dict)
    holdout: str | None = None

    @property
    def train_frames(self) -> tuple[Frame, ...]:
        """The training frames, in order."""
        return tuple(frame for frame in self.frames if frame.name not in self.test_names)

    @property
    def test_frames(self) -> tuple[Frame, ...]:
        """The held-out frames, in order."""
        return tuple(frame for frame in self.frames if frame.name in self.test_names)


def is_scene(path: Path) -> bool:
    """Return True if a folder contains the files of a scene, well-formed or not."""
    files = (SCENE_FILE, *_FOREIGN_FILES)
    return any((path / name).is_file() for name in files) or model_folder(path) is not None


def model_folder(path: Path) -> Path | None:
    """Return the folder of the COLMAP model in a scene's folder; None if there is none."""
    return next((path / name for name in _MODEL_FOLDERS if is_model(path / name)), None)


def load(path: str | Path, *, holdout: str | None = None) -> Scene:
    """Load the scene in a folder of any supported format; or from the path of a scene.json or transforms.json.

    Example:
        >>> import nerfcli
        >>> scene = nerfcli.load_scene("photos-scene")
        >>> [frame.name for frame in scene.test_frames]

    Args:
        path: the folder, or the file.
        holdout: rule for the held-out photos, see `holdout`, instead of the split of the capture.

    Raises:
        UserError: there is no scene, its files are malformed or do not fit the photos, or the rule does not fit.
    """
    scene = _load(Path(path))
    if holdout is None:
        return scene
    names = names_held_out(holdout, (frame.name for frame in scene.frames), others=scene.missing)
    return replace(scene, test_names=names, holdout=holdout)


def save(
    scene_dir: Path,
    *,
    image_folder: Path,
    provenance: dict[str, Any],
    unit: str = "arbitrary",
    unit_source: str | None = None,
    masks: Path | Mapping[str, Path] | None = None,
    split: Mapping[str, str | None] | None = None,
    depth_bounds: Mapping[str, tuple[float, float]] | None = None,
) -> None:
    """Write scene.json beside the COLMAP model in scene_dir/sparse/0, and fix the held-out split.

    Args:
        scene_dir: contains sparse/0, whose cameras refer to upright photos (EXIF orientation applied).
        image_folder: the photos; stored relative to the scene folder, so that both can be moved together.
        provenance: plain values: versions, command, settings.
        unit: "arbitrary" or "metre".
        unit_source: source of the metric scale.
        masks: a folder of masks, named as in `media.masks.find_mask`; or masks by the name of the photo.
        split: "train", "test", "val" or None (unused) by the name of the photo; by default every 8th is held out.
        depth_bounds: nearest and farthest z by name, in scene units, if they are known without points.

    Raises:
        UserError: the model cannot be read, or scene.json cannot be written.
    """
    if unit not in UNITS:
        raise ValueError(f"unit must be one of {UNITS}, got {unit!r}")
    model = read_model(scene_dir / MODEL_FOLDER)
    points = model.points
    if split is None:
        parts = {"test": sorted(default_split([image.name for image in model.images]))}
    else:
        listed = {part: sorted(name for name, of in split.items() if of == part) for part in ("test", "val")}
        unused = sorted(name for name, of in split.items() if of is None)
        parts = {"test": listed["test"], **{k: v for k, v in (("val", listed["val"]), (UNUSED, unused)) if v}}
    if isinstance(masks, Path):
        mask_entry: Any = _relative(masks, scene_dir)
    else:
        mask_entry = {name: _relative(mask, scene_dir) for name, mask in (masks or {}).items()} or None
    content = {
        "version": SCENE_VERSION,
        "image_folder": _relative(image_folder, scene_dir),
        "model": MODEL_FOLDER,
        "split": parts,
        "masks": mask_entry,
        "unit": unit,
        "unit_source": unit_source,
        "frame_from_world": None,
        "bounds": {
            "points_min": points.min(axis=0).tolist() if len(points) else None,
            "points_max": points.max(axis=0).tolist() if len(points) else None,
        },
        **({"depth_bounds": {name: list(pair) for name, pair in depth_bounds.items()}} if depth_bounds else {}),
        "provenance": provenance,
    }
    write_json(scene_dir / SCENE_FILE, content)


def default_split(names: Iterable[str]) -> frozenset[str]:
    """Return the held-out names: every 8th of the sorted names, including the first, as `holdout` counts them."""
    return frozenset(name for moment in moments(names)[::HELD_OUT_EVERY] for name in moment)


def fingerprint(scene: Scene) -> str:
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


def _load(path: Path) -> Scene:
    if not path.exists():
        raise UserError(f"{path} does not exist", "give a scene folder, such as one written by nerfcli poses")
    if path.is_file():
        if path.suffix.lower() != ".json":
            advice = "give a scene folder, or its transforms.json; nerfcli poses makes a scene from photos or a video"
            raise UserError(f"{path} is a file, not a scene", advice)
        if path.name != SCENE_FILE:
            return _scene(path.parent, read_transforms(path, _measure))
        path = path.parent
    if (path / SCENE_FILE).is_file():
        return _load_own(path)
    model_dir = model_folder(path)
    if model_dir is not None:
        model = read_model(model_dir)
        return _scene(path, colmap_on_disk(model, _image_folder(path, model_dir, model), _measure, model_dir))
    if (path / "transforms.json").is_file():
        return _scene(path, read_transforms(path / "transforms.json", _measure))
    if (path / "transforms_train.json").is_file():
        return _scene(path, read_blender(path, _measure))
    if (path / "poses_bounds.npy").is_file():
        return _scene(path, read_llff(path, _measure, list_images))
    raise _no_scene(path)


def _scene(root: Path, capture: Capture) -> Scene:
    """Return the scene of a capture in a foreign format, with the capture's split if it has one."""
    splits = {frame.split for frame in capture.frames}
    frames = capture.frames
    if "test" in splits or "val" in splits:
        held_out = "test" if "test" in splits else "val"
        test_names = frozenset(frame.name for frame in frames if frame.split == held_out)
        # Views of other splits are used neither for training nor for evaluation.
        kept = [index for index, frame in enumerate(frames) if frame.split in ("train", held_out)]
    else:
        test_names = default_split(frame.name for frame in frames)
        kept = list(range(len(frames)))
    bounds = None if capture.depth_bounds is None else capture.depth_bounds[kept]
    return Scene(
        root=root,
        kind=capture.kind,
        frames=tuple(frames[index] for index in kept),
        test_names=test_names,
        points=capture.points,
        missing=capture.missing,
        unit=capture.unit,
        depth_bounds=bounds,
        unit_source=capture.unit_source,
        rescaled=capture.rescaled,
        history={"from": capture.kind},
    )


def _load_own(root: Path) -> Scene:
    """Load the scene that `save` described."""
    described = read_description(root)
    images = described.image_folder
    if not images.is_dir():
        raise UserError(
            f"{described.path}: the photo folder {images} does not exist",
            "put the photos back, or correct image_folder in that file",
        )
    capture = read_colmap(described.model_dir, images, _measure_upright)
    listed = described.listed
    held_out = listed["test"] or listed["val"]
    left_out = listed[UNUSED] | (listed["val"] if listed["test"] else frozenset())
    frames = tuple(frame for frame in described.described(capture.frames, find_mask) if frame.name not in left_out)
    return Scene(
        root=root,
        kind="nerfcli",
        frames=frames,
        test_names=held_out & {frame.name for frame in frames},
        points=capture.points,
        missing=capture.missing,
        unit=described.unit,
        depth_bounds=described.bounds_of(frames),
        unit_source=described.unit_source,
        rescaled=capture.rescaled,
        history=described.provenance,
    )


def _measure(path: Path) -> tuple[int, int, int]:
    exif = read_exif(path)
    return exif.width, exif.height, exif.orientation


def _measure_upright(path: Path) -> tuple[int, int, int]:
    """Measure photos for models whose cameras refer to upright photos, as those of nerfcli poses do: no rotation."""
    return (*image_size(path), 1)


def _image_folder(root: Path, model_dir: Path, model: ColmapModel) -> Path:
    """Return the folder of a COLMAP project's photos: the one that contains most of the names, among the image folders
    in `root`, the model's folder and its parents, and these folders themselves if names include the image folder."""
    homes = list(dict.fromkeys([root, model_dir, *model_dir.resolve().parents[:3]]))
    folders = [home / name for home in homes for name in IMAGE_FOLDERS if (home / name).is_dir()]
    if not folders:
        raise UserError(
            f"{root} has a COLMAP model but no photos: the folder images/ is missing",
            "put the photos of the model into images/ next to it",
        )
    names = [image.name for image in model.images]
    return max((*folders, *homes), key=lambda folder: sum((folder / name).is_file() for name in names))


def _relative(path: Path, start: Path) -> str:
    """Return a path relative to a folder, with forward slashes; absolute if that is impossible (another drive)."""
    try:
        return Path(os.path.relpath(path.resolve(), start.resolve())).as_posix()
    except ValueError:
        return path.resolve().as_posix()


def refuse_without_training_photos(scene: Scene) -> None:
    """Refuse a scene that holds out every photo.

    Raises:
        UserError: no training photo is left.
    """
    if not scene.train_frames:
        raise UserError(
            f"{scene.root} has no training photo",
            "every 8th photo is held out, so at least 2 are needed; check --holdout",
        )


def photo_folder(path: Path) -> Path | None:
    """Return the folder that contains photos: `path` or its subfolder `images`; None if neither does."""
    return next((folder for folder in (path, path / "images") if folder.is_dir() and list_images(folder)), None)


def _no_scene(path: Path) -> UserError:
    if (path / CAMERAS).is_file():
        hint = f"give the scene it was trained on; to continue it: nerfcli train SCENE -o {in_shell(path)} --resume"
        return UserError(f"{path} is a run, not a scene", hint)
    looked_for = (
        f"{SCENE_FILE}, {', '.join(name for name in _MODEL_FOLDERS[:-1])} (COLMAP), "
        "transforms.json, transforms_train.json, poses_bounds.npy"
    )
    if folder := photo_folder(path):
        return UserError(
            f"{folder} has {len(list_images(folder))} photos but no poses; looked for {looked_for}",
            f"estimate them with: nerfcli poses {in_shell(folder)}; or convert poses in another format with: nerfcli "
            f"convert {in_shell(path)} SCENE --to nerfcli",
        )
    return UserError(
        f"{path} is not a scene; looked for {looked_for}",
        "give a scene folder, or estimate poses first: nerfcli poses PHOTOS",
    )


def describe_unused_masks(scene: Scene) -> str | None:
    """Describe how to use a folder of masks in the scene's folder that none of its files mentions; None without one."""
    if any(frame.mask is not None for frame in scene.frames):
        return None
    masks = masks_inside(scene.root, [frame.name for frame in scene.frames])
    if masks is None:
        return None
    return f"{masks}; to use them: nerfcli convert {in_shell(scene.root)} SCENE --to nerfcli --masks {in_shell(masks)}"
