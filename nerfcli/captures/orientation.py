"""Cameras of photos that carry an EXIF orientation, and of photos that were resized.

COLMAP, nerfstudio, instant-ngp and OpenSfM read pixels as they are stored and ignore the EXIF orientation (so does
pycolmap 4.2.1). nerfcli shows photos upright, and the cameras of its own scenes refer to upright photos. So a camera
that refers to the stored pixels is turned together with its picture, about its optical axis.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nerfcli.cameras.camera import Camera
from nerfcli.cameras.frame import Frame, Size
from nerfcli.captures.capture import Capture, Observations
from nerfcli.errors import UserError, several
from nerfcli.photos.exif import read_exif
from nerfcli.photos.images import image_size

# Rotations upright_from_stored of the picture, in (x right, y down): EXIF 3 is half a turn, 6 a quarter clockwise,
# 8 a quarter counter-clockwise. Source: Exif 2.32, tag 0x0112.
_TURNS = {
    1: np.array([[1.0, 0.0], [0.0, 1.0]]),
    3: np.array([[-1.0, 0.0], [0.0, -1.0]]),
    6: np.array([[0.0, -1.0], [1.0, 0.0]]),
    8: np.array([[0.0, 1.0], [-1.0, 0.0]]),
}

# Pairs of parameters that are the x and y parts of a vector in the picture and turn with it: the principal point is
# handled apart, tangential distortion is p2 in x and p1 in y (OpenCV's order), thin prisms are one vector per power.
_VECTORS = {
    "OPENCV": (("p2", "p1"),),
    "FULL_OPENCV": (("p2", "p1"),),
    "THIN_PRISM_FISHEYE": (("p2", "p1"), ("sx1", "sy1")),
    "RAD_TAN_THIN_PRISM_FISHEYE": (("p0", "p1"), ("s0", "s2"), ("s1", "s3")),
}


@dataclass(frozen=True)
class Picture:
    """A photo on disk: its file, its size as it is shown upright, and its EXIF orientation, 1 if it has none."""

    path: Path
    width: int
    height: int
    orientation: int

    @property
    def size(self) -> Size:
        """Width and height upright."""
        return self.width, self.height

    @property
    def stored_size(self) -> Size:
        """Width and height before the orientation is applied."""
        return (self.height, self.width) if self.orientation >= 5 else self.size


def measure(path: Path) -> Picture:
    """Read the size of a photo and its EXIF orientation."""
    exif = read_exif(path)
    return Picture(path, exif.width, exif.height, exif.orientation)


def stored_size(path: Path) -> Size:
    """Return the width and height of an image file before its EXIF orientation is applied."""
    return measure(path).stored_size


def fit_to_picture(camera: Camera, world_from_cam: np.ndarray, picture: Picture) -> tuple[Camera, np.ndarray]:
    """Return the camera and pose for the upright picture on disk.

    The calibration is taken to be for the stored pixels, or for the upright ones if its aspect ratio fits those better,
    and may be for another size of the same picture.

    Raises:
        UserError: neither aspect ratio fits (both sizes are named), or see `turn_to_upright`.
    """
    orientation, size = turn_to_upright(camera, picture)
    return turned(resized_for(camera, size, picture.path), world_from_cam, orientation=orientation)


def resized_for(camera: Camera, size: Size, path: Path) -> Camera:
    """Return `Camera.resized` to the size of a photo; its error names the photo."""
    try:
        return camera.resized(*size)
    except UserError as error:
        raise UserError(f"{path}: {error.message}", error.hint) from error


def turn_to_upright(camera: Camera, picture: Picture) -> tuple[int, Size]:
    """Return the EXIF orientation that turns a camera's picture upright, and the size of the picture on disk.

    The orientation is 1 if the camera is for the upright picture already. The size is of the picture as the camera
    sees it, before turning, and may differ from the camera's size if the picture was resized.

    Raises:
        UserError: the EXIF orientation mirrors the picture, or turns one of the whole sphere.
    """
    orientation, stored, upright = picture.orientation, picture.stored_size, picture.size
    if orientation not in _TURNS:
        what = f"{picture.path}: EXIF orientation {orientation} mirrors the photo, which is not supported"
        raise UserError(what, "save the photo upright without the tag and estimate the poses again")
    if stored != upright and _shape_error(camera, stored) > _shape_error(camera, upright):
        return 1, upright
    _refuse_sphere(camera, picture)
    return orientation, stored


def turned(camera: Camera, world_from_cam: np.ndarray, *, orientation: int) -> tuple[Camera, np.ndarray]:
    """Return the camera and pose of the upright picture, given those of the stored one.

    Args:
        camera: of a perspective or fisheye lens, unless the orientation is 1.
        orientation: EXIF: 1, 3, 6 or 8.
    """
    if orientation == 1:
        return camera, world_from_cam
    turn = _TURNS[orientation]
    values, middle = camera.values, np.array(camera.size) / 2
    width, height = camera.size[::-1] if orientation in (6, 8) else camera.size
    values["cx"], values["cy"] = (
        turn @ (np.array([values["cx"], values["cy"]]) - middle) + np.array([width, height]) / 2
    )
    if "fx" in values and orientation in (6, 8):
        values["fx"], values["fy"] = values["fy"], values["fx"]
    for x_name, y_name in _VECTORS.get(camera.model, ()):
        values[x_name], values[y_name] = turn @ (values[x_name], values[y_name])
    upright = Camera(camera.model, width, height, tuple(float(value) for value in values.values()))
    stored_from_upright = np.eye(4)
    stored_from_upright[:2, :2] = turn.T
    return upright, world_from_cam @ stored_from_upright


def rescaled_sizes(fits: Iterable[tuple[Camera, Camera]]) -> dict[tuple[Size, Size], int]:
    """Count the cameras that were fitted to a picture of another size, by both sizes, upright; see `Capture.rescaled`.

    Args:
        fits: calibrated and fitted cameras.
    """
    counts = Counter[tuple[Size, Size]]()
    for (of_width, of_height), size in ((calibrated.size, fitted.size) for calibrated, fitted in fits):
        if size not in ((of_width, of_height), (of_height, of_width)):
            lying = (of_width < of_height) != (size[0] < size[1])
            counts[(of_height, of_width) if lying else (of_width, of_height), size] += 1
    return dict(counts)


def describe_rescaling(rescaled: Mapping[tuple[Size, Size], int]) -> list[str]:
    """Describe `Capture.rescaled`, one sentence per pair of sizes."""
    return [
        f"{count} photo{'s are' if count > 1 else ' is'} {width}x{height}, but the intrinsics are for {of_width}x"
        f"{of_height}: rescaled"
        for ((of_width, of_height), (width, height)), count in rescaled.items()
    ]


def _shape_error(camera: Camera, size: tuple[int, int]) -> float:
    """Return by how many pixels a size's height is off the camera's aspect ratio."""
    return abs(camera.height * size[0] / camera.width - size[1])


STORED, UPRIGHT = "stored", "upright"

# Most photos that are measured for a note: reading 10,000 headers takes longer than a conversion.
_MOST_MEASURED = 200


@dataclass(frozen=True)
class ReorientedCapture:
    """Capture whose cameras refer to the requested pixels.

    Args:
        masks_left_out: number of masks that were dropped, as their orientation differs from the turned camera's.
        notes: how many cameras were turned, and how many photos are not on disk, for people.
    """

    capture: Capture
    masks_left_out: int = 0
    notes: tuple[str, ...] = ()


def _measured(path: Path, pixels: str) -> Picture:
    """Measure a photo for a camera that refers to these pixels: for one of upright photos, nothing is left to turn."""
    return Picture(path, *image_size(path), 1) if pixels == UPRIGHT else measure(path)


def in_pixels(capture: Capture, pixels: str) -> ReorientedCapture:
    """Return the capture with cameras, poses and observations for stored or upright pixels, at the cameras' own size.

    Frames without a photo on disk are left as they are, and noted.
    """
    if capture.pixels == pixels:
        return ReorientedCapture(capture)
    frames, masks_left_out, unknown, notes = list(capture.frames), 0, 0, []
    turns = np.ones(len(frames), dtype=np.int64)
    for index, frame in enumerate(capture.frames):
        if not frame.has_photo:
            unknown += 1
            continue
        orientation = _turn(frame, pixels)
        if orientation == 1:
            continue
        turns[index] = orientation
        camera, pose = turned(frame.camera, frame.world_from_cam, orientation=orientation)
        mask = frame.mask
        if mask is not None and not _fits(mask, camera, frame.camera, pixels):
            masks_left_out += 1
            mask = None
        frames[index] = replace(frame, camera=camera, world_from_cam=pose, mask=mask)
    turned_capture = replace(
        capture, frames=tuple(frames), observations=_turned_observations(capture, turns), pixels=pixels
    )
    if count := int((turns != 1).sum()):
        stored = "as stored, as most programs expect" if pixels == STORED else "upright"
        turning = several(count, "photo has", "photos have")
        notes.append(f"{turning} an EXIF orientation: the cameras refer to pixels {stored}")
    if unknown:
        missing = several(unknown, "photo is", "photos are")
        notes.append(f"{missing} missing: cameras of turned ones will be wrong")
    return ReorientedCapture(turned_capture, masks_left_out, tuple(notes))


def upright(frame: Frame, pixels: str) -> Frame:
    """Return a frame fitted to its upright photo on disk, whose camera refers to stored or upright pixels."""
    assert frame.image is not None
    camera, pose = fit_to_picture(frame.camera, frame.world_from_cam, _measured(frame.image, pixels))
    return replace(frame, camera=camera, world_from_cam=pose)


def other_sizes(capture: Capture) -> dict[tuple[Size, Size], int]:
    """Count the photos on disk whose intrinsics are for another size, as in `Capture.rescaled`.

    At most 200 photos, spread over the capture, are measured; those that cannot be read or turned are skipped.

    Raises:
        UserError: a photo has another shape than its camera.
    """
    chosen = np.unique(np.linspace(0, len(capture.frames) - 1, _MOST_MEASURED).round().astype(int))
    fits = []
    for frame in (capture.frames[index] for index in chosen):
        if not frame.has_photo:
            continue
        assert frame.image is not None
        try:
            picture = _measured(frame.image, capture.pixels)
            turn_to_upright(frame.camera, picture)
        except UserError:  # the commands that use the photos say what is wrong with them
            continue
        fits.append((frame.camera, fit_to_picture(frame.camera, frame.world_from_cam, picture)[0]))
    return rescaled_sizes(fits)


def _turned_observations(capture: Capture, turns: np.ndarray) -> Observations | None:
    """Return the observations of a capture after the pictures of its frames were turned by orientations (frames,)."""
    seen = capture.observations
    if seen is None:
        return None
    pixels = seen.pixels.copy()
    sizes = np.array([frame.camera.size for frame in capture.frames])
    for orientation in set(turns.tolist()) - {1}:
        rows = turns[seen.frame_index] == orientation
        middles = sizes[seen.frame_index[rows]] / 2
        upright_middles = middles[:, ::-1] if orientation in (6, 8) else middles
        pixels[rows] = (pixels[rows] - middles) @ _TURNS[orientation].T + upright_middles
    return replace(seen, pixels=pixels)


def _turn(frame: Frame, pixels: str) -> int:
    """Return the EXIF orientation that turns the pixels of a frame's camera into the requested ones."""
    assert frame.image is not None
    picture = measure(frame.image)
    orientation, size = turn_to_upright(frame.camera, picture)
    if pixels == STORED:
        orientation, size = {6: 8, 8: 6}.get(picture.orientation, picture.orientation), picture.size  # turned back
        _refuse_sphere(frame.camera, picture)
    resized_for(frame.camera, size, frame.image)
    return orientation


def _refuse_sphere(camera: Camera, picture: Picture) -> None:
    """Refuse to turn a picture of the whole sphere, whose camera cannot be turned about an optical axis."""
    if picture.orientation != 1 and camera.is_spherical:
        hint = "save the panorama upright without the tag"
        raise UserError(f"{picture.path}: a spherical picture with EXIF orientation {picture.orientation}", hint)


def _fits(mask: Path, camera: Camera, before: Camera, pixels: str) -> bool:
    """Return whether a mask can be used after a camera was turned.

    Its shape has to be that of the turned picture, or, for upright pixels, of the one before: nerfcli then turns the
    mask (`photos.masks.read_mask`).
    """
    return _closer_in_shape(mask, camera, before) or (pixels == UPRIGHT and _closer_in_shape(mask, before, camera))


def _closer_in_shape(mask: Path, camera: Camera, before: Camera) -> bool:
    """Return whether the shape of a mask is closer to the picture of `camera` than to that of `before`."""
    if not mask.is_file():
        return False
    width, height = image_size(mask)
    off, off_before = (abs(width * of.height - height * of.width) for of in (camera, before))
    return off < off_before
