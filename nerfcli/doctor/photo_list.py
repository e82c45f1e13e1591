"""The subject of an examination: a folder of photos, or a scene."""

from dataclasses import dataclass
from pathlib import Path

from nerfcli import scene as scenes
from nerfcli.doctor.photo_facts import Source
from nerfcli.errors import UserError
from nerfcli.media.images import IMAGE_SUFFIXES, list_images
from nerfcli.media.unsupported_photos import unsupported_photos


@dataclass(frozen=True)
class ExaminedCapture:
    """A capture to examine.

    Args:
        path: as given by the user.
        sources: its photos.
        scene: the scene with their poses; None for a folder of photos.
    """

    path: Path
    sources: tuple[Source, ...]
    scene: scenes.Scene | None

    @property
    def kind(self) -> str:
        """Kind of capture, "photos" or "scene"."""
        return "photos" if self.scene is None else "scene"


def find_subject(path: Path) -> ExaminedCapture:
    """Find the photos in a folder, or those of a scene.

    A folder with photos and the files of a scene counts as a scene.

    Raises:
        UserError: the path does not exist, has no photos, or is a scene with malformed files.
    """
    if not path.exists():
        raise UserError(f"{path} does not exist", "give a folder of photos, or a scene folder")
    if path.is_file() or scenes.is_scene(path):
        return _of_scene(path)
    photos = [*list_images(path), *unsupported_photos(path)]
    if not photos:
        below = next((child for child in sorted(path.iterdir()) if child.is_dir() and list_images(child)), None)
        where = f"there are photos in {below}; give that folder" if below else ""
        hint = where or f"expected a scene, or files ending in {', '.join(sorted(IMAGE_SUFFIXES))}"
        raise UserError(f"no photos and no scene in {path}", hint)
    return ExaminedCapture(path, tuple(Source(photo.name, photo) for photo in photos), None)


def _of_scene(path: Path) -> ExaminedCapture:
    scene = scenes.load(path)
    sources = tuple(Source(f.name, f.image, f.mask) for f in scene.frames if f.image is not None)
    return ExaminedCapture(path, sources, scene)
