"""cameras_sphere.npz and cameras.npz of IDR, NeuS, VolSDF and their successors, read only.

    world_mat_0, world_mat_1, ...   (4, 4): the first three rows are the projection K cam_from_world, OpenCV axes
    scale_mat_0, scale_mat_1, ...   (4, 4): the unit sphere around the object, in the world; not used

The numbers belong to the photos of image/ in the order of their names, and to the masks of mask/.
Source: Totoro97/NeuS models/dataset.py, load_K_Rt_from_P; lioryariv/idr DATA_CONVENTION.md.
"""

import zipfile
from pathlib import Path

import numpy as np
from scipy.linalg import rq

from nerfcli.cameras import rigid
from nerfcli.cameras.frame import Frame
from nerfcli.captures.capture import Capture
from nerfcli.captures.formats.fields import DAMAGED, array_of_npy, malformed, members_of_npz
from nerfcli.captures.formats.format import Format, UserInputs, named
from nerfcli.captures.formats.lenses import Fits
from nerfcli.captures.formats.limits import plausible
from nerfcli.captures.formats.photo_names import GIVE_PHOTOS
from nerfcli.captures.orientation import stored_size
from nerfcli.errors import UserError
from nerfcli.photos.images import list_images

FILES = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz")
FIRST = "world_mat_0"
IMAGE_FOLDERS = ("image", "images", "rgb")
MASK_FOLDERS = ("mask", "masks")

# A projection with a singular value below this one, relative to the largest, is no camera but damage.
_SINGULAR = 1e-9
# Cameras that differ by less are one camera, whose numbers the file's float32 products have rounded.
_ROUNDING_PX = 0.01


def parse_neus(path: Path, given: UserInputs = UserInputs()) -> Capture:
    """Read the cameras of the file, in its world; the photos are those beside it, in order."""
    members = members_of_npz(path)
    photos = _pictures(path.parent, (given.images.absolute(),) if given.images else IMAGE_FOLDERS)
    masks = _pictures(path.parent, MASK_FOLDERS)
    count = 0
    while f"world_mat_{count}" in members:
        count += 1
    if count == 0 or len(photos) != count:
        raise UserError(
            f"{path} has {count} cameras, but there are {len(photos)} photos",
            "photos and cameras are paired by order: put the photos of all cameras, and no others, into image/ beside "
            f"the file; or {GIVE_PHOTOS}",
        )
    names = [f"world_mat_{index}" for index in range(count)]
    views = [_decomposed(_projection(members[name], f"{path}: {name}"), f"{path}: {name}") for name in names]
    matrices = _without_rounding(np.array([matrix for matrix, _ in views]))
    fits, frames = Fits(), []
    for index, (image, matrix) in enumerate(zip(photos, matrices, strict=True)):
        camera = fits.matrix(matrix, stored_size(image), f"{path}: {names[index]}")
        mask = masks[index] if len(masks) == count else None
        frames.append(Frame(image.name, camera, views[index][1], image=image, mask=mask))
    return Capture(tuple(frames), kind="neus", notes=fits.notes())


def _without_rounding(matrices: np.ndarray) -> np.ndarray:
    """Return the median of intrinsics (N, 3, 3) for all views if they differ by rounding only, else the intrinsics."""
    shared = np.median(matrices, axis=0)
    same = bool((np.abs(matrices - shared) <= _ROUNDING_PX).all())
    return np.broadcast_to(shared, matrices.shape) if same else matrices


def _pictures(folder: Path, names: tuple[str | Path, ...]) -> list[Path]:
    """Return the pictures in the first of these folders that there is."""
    place = next((folder / name for name in names if (folder / name).is_dir()), None)
    return [] if place is None else list_images(place)


def _projection(data: bytes, where: str) -> np.ndarray:
    """Return the projection (3, 4) in the bytes of an .npy file of a matrix (4, 4)."""
    try:
        array = array_of_npy(data)
    except ValueError as error:
        raise malformed(where, str(error), DAMAGED) from error
    if array.shape != (4, 4) or array.dtype.kind not in "iuf":
        raise malformed(where, f"{array.shape} values of type {array.dtype}", "expected 4 x 4 numbers")
    return array[:3].astype(np.float64)


def _decomposed(projection: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix of intrinsics (3, 3) and `world_from_cam` (4, 4) of a projection (3, 4), up to its scale.

    P = s K [R t]: K is upper triangular with a positive diagonal, and s has the sign with which R is a rotation.
    Source: Hartley and Zisserman, Multiple View Geometry, 2nd edition, section 6.2.4.
    """
    singular = np.linalg.svd(projection[:, :3], compute_uv=False) if plausible(projection).all() else np.zeros(3)
    if singular[2] <= _SINGULAR * singular[0] or singular[0] == 0:
        raise malformed(where, "is not the projection of a camera", "expected a 4x4 matrix K [R t]")
    signed = projection * np.sign(np.linalg.det(projection[:, :3]))
    upper, rotation = map(np.asarray, rq(signed[:, :3]))
    signs = np.sign(np.diag(upper))
    upper, rotation = upper * signs, signs[:, None] * rotation
    translation = np.linalg.solve(upper, signed[:, 3])
    return upper / upper[2, 2], rigid.inverse(rigid.from_parts(rotation, translation))


def find_neus(path: Path) -> Path | None:
    """Find a file .npz with the projections of IDR and NeuS, or a folder's file with one of their names."""
    found = named(*FILES)(path) if path.is_dir() else path
    if found is None or found.suffix.lower() != ".npz" or not zipfile.is_zipfile(found):
        return None
    try:
        with zipfile.ZipFile(found) as archive:
            return found if f"{FIRST}.npy" in archive.namelist() else None
    except zipfile.BadZipFile as error:
        raise UserError(f"{found} cannot be read: {error}", "it is damaged: copy it again") from error


FORMAT = Format("neus", "projections of IDR, NeuS", find_neus, parse_neus)
