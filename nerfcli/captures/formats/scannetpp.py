"""The photos of ScanNet++, read only: dslr/nerfstudio/transforms.json with the photos in dslr/resized_images.

The file is a transforms.json whose held-out photos are in test_frames; file_path and mask_path are names in
dslr/resized_images and dslr/resized_anon_masks, or, of transforms_undistorted.json, in undistorted_images and
undistorted_anon_masks. The poses are aligned with a laser scan, in metres, the world's z axis up. Photos marked is_bad
are blurred or show a shadow of the photographer. dslr/colmap is a COLMAP model, which is read as such.
Source: scannetpp/scannetpp common/utils/nerfstudio.py, common/scene_release.py; nerfstudio scannetpp_dataparser.py.
"""

from dataclasses import replace
from pathlib import Path

from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import malformed, read_json_object
from nerfcli.captures.formats.format import Format, UserInputs, has_keys
from nerfcli.captures.formats.photo_search import plain_name
from nerfcli.captures.formats.transforms import listed_frames, records_of
from nerfcli.errors import several

FILES = ("transforms.json", "transforms_undistorted.json")
_PLACES = ("dslr/nerfstudio", "nerfstudio", ".")
_HELD_OUT = "test_frames"
_SPLITS = {"frames": "train", _HELD_OUT: "test"}


def parse_scannetpp(path: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the photos of both lists that are not marked as bad, with their masks where these are on disk."""
    content = read_json_object(path)
    kind = "undistorted" if "undistorted" in path.stem else "resized"
    home = path.parent.parent if path.parent.name == "nerfstudio" else path.parent
    folders = (f"{kind}_images", f"{kind}_anon_masks")
    both = [
        (record, where, split)
        for key, split in _SPLITS.items()
        for record, where in (records_of(path, content, key) if content.get(key) != [] else [])
    ]
    good = [(record, where) for record, where, _ in both if record.get("is_bad") is not True]
    if not good:
        raise malformed(path, "marks all photos as bad", "copy the scene again")
    frames, missing, notes = listed_frames(path, content, good, images=given.images, home=home, folders=folders)
    split_of = {plain_name(str(record.get("file_path"))): split for record, _, split in both}
    if "test" in (splits := [split_of.get(frame.name) for frame in frames]):
        frames = [replace(frame, split=split) for frame, split in zip(frames, splits, strict=True)]
    if len(good) < len(both):
        notes += (f"{several(len(both) - len(good), 'photo')} marked as bad left out",)
    source, lost = "laser scan (ScanNet++)", tuple(missing)
    return Capture(tuple(frames), missing=lost, kind="scannetpp", unit="metre", unit_source=source, notes=notes)


def find_scannetpp(path: Path) -> Path | None:
    """Find a transforms.json with test_frames, given the scene, its folder dslr, that of the file, or the file."""
    if path.is_file():
        return path if path.suffix.lower() == ".json" and has_keys(path, _HELD_OUT, "frames") else None
    files = (path / place / name for place in _PLACES for name in FILES)
    return next((file for file in files if file.is_file() and find_scannetpp(file)), None)


FORMAT = Format("scannetpp", "ScanNet++", find_scannetpp, parse_scannetpp, axes="opengl")
