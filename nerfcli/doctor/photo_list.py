"""The subject of an examination: a folder of photos, or a scene."""

from dataclasses import dataclass
from pathlib import Path

from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.registry import recognised
from nerfcli.captures.loading import load_scene
from nerfcli.doctor.photo_facts import Source
from nerfcli.errors import UserError, in_shell
from nerfcli.photos.images import list_photos, list_unreadable, name_in, where_photos_may_be


@dataclass(frozen=True)
class ExaminedCapture:
    """A capture to examine: its path as the user gave it, and the scene with the poses, None for a folder of photos."""

    path: Path
    sources: tuple[Source, ...]
    scene: Capture | None

    @property
    def kind(self) -> str:
        """Kind of capture, "photos" or "scene"."""
        return "photos" if self.scene is None else "scene"


def find_subject(path: Path, *, subfolders: bool = False) -> ExaminedCapture:
    """Find the photos in a folder, with those in its subfolders on request, or the photos of a scene.

    A folder with photos and the files of a scene counts as a scene.

    Raises:
        UserError: the path does not exist, is a video, has no photos, or is a scene with malformed files, or one with
            `subfolders`.
    """
    if not path.exists():
        raise UserError(f"{path} does not exist", "give a folder of photos, or a scene folder")
    if recognised(path) is not None:
        if subfolders:
            raise UserError(f"{path}: --subfolders is for photos, and this is a scene", "leave --subfolders out")
        scene = load_scene(path)
        sources = tuple(Source(f.name, f.image, f.mask) for f in scene.frames if f.image is not None)
        return ExaminedCapture(path, sources, scene)
    if path.is_file():
        raise UserError(
            f"{path} is a file, neither a folder of photos nor a scene",
            f"if it is a video, nerfcli poses {in_shell(path)} writes its frames to a folder that can be given here",
        )
    photos = [*list_photos(path, subfolders=subfolders), *list_unreadable(path, subfolders=subfolders)]
    if not photos:
        raise UserError(f"no photos and no scene in {path}", where_photos_may_be(path))
    return ExaminedCapture(path, tuple(Source(name_in(path, photo), photo) for photo in photos), None)
