"""Settings of structure from motion."""

from dataclasses import astuple, dataclass
from pathlib import Path

from nerfcli.captures.holdout import DEFAULT_HOLDOUT
from nerfcli.errors import UserError
from nerfcli.machine import thread_count
from nerfcli.poses.input.pairs import PAIRINGS

# Choices of `camera_model`.
CAMERA_MODELS = (
    *("auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "EQUIRECTANGULAR"),
)

# Longer side of the largest pictures that are searched; SIFT enlarges them, so smaller features would be noise.
LARGEST_PX = 3200
USUAL_FEATURES, MOST_FEATURES = 4096, 8192
# (max_image_size, max_features). Measured poses hardly change from the first to the last; the later ones place photos
# that are hard to match more often.
QUALITIES: dict[str, tuple[int, int | None]] = {
    "fast": (1000, 2048),
    "default": (1600, None),
    "best": (LARGEST_PX, MOST_FEATURES),
}

# From this many photos on, half of the features gave the same poses in about half of the time or less: see "Hundreds of
# photos" in docs/research/poses.md.
_MANY_PHOTOS = 100
# Fewer photos than this are searched for twice as many: each point is seen by few of them, and training needs points.
_FEW_PHOTOS = 30


@dataclass(frozen=True)
class PoseSettings:
    """Settings that the result depends on.

    max_image_size: longer side of the pictures that are searched for features, pixels. max_features: per photo; None
    for a number that depends on how many photos there are, see `search_for`. Both are doubled for panoramas, see
    `for_panoramas`. threads: -1 for all; with 1 thread the same seed gives the same poses. camera_model: one of
    `CAMERA_MODELS`. min_registered: the fraction of photos that must be placed, 0...1. pairing: one of `PAIRINGS`; with
    pairs_file, a text file with two names per line, only these pairs are matched. masks: a folder of masks, see
    `photos.masks`. holdout: the rule by which photos are held out, see `captures.holdout`. strict: whether held-out
    photos are placed afterwards, with the result of the other photos fixed, see `held_out_photos`. accept_refused:
    whether a model that the checks refuse becomes the scene anyway. subfolders: whether photos in subfolders are used,
    those of each as of a camera of their own.
    """

    max_image_size: int = QUALITIES["default"][0]
    max_features: int | None = None
    seed: int = 0
    threads: int = -1
    camera_model: str = "auto"
    min_registered: float = 0.5
    pairing: str = "auto"
    pairs_file: str | None = None
    masks: str | None = None
    holdout: str = DEFAULT_HOLDOUT
    strict: bool = False
    accept_refused: bool = False
    subfolders: bool = False

    @property
    def cores(self) -> int:
        """The number of threads to use."""
        return thread_count(max(self.threads, 0))


@dataclass(frozen=True)
class Search:
    """The search for features: the longer side of its pictures, pixels, and how many it is for in each photo.

    halved_from: twice `max_features` if it is only half because there are many photos, else 0.
    """

    max_image_size: int
    max_features: int
    halved_from: int = 0


def search_for(settings: PoseSettings, count: int) -> Search:
    """Return the first search of this many photos.

    By default it is for 8,192 features in each of up to 29 photos, 4,096 of up to 99, and 2,048 of more.
    """
    if settings.max_features is not None:
        return Search(settings.max_image_size, settings.max_features)
    if count >= _MANY_PHOTOS:
        return Search(settings.max_image_size, USUAL_FEATURES // 2, halved_from=USUAL_FEATURES)
    return Search(settings.max_image_size, MOST_FEATURES if count < _FEW_PHOTOS else USUAL_FEATURES)


def for_panoramas(search: Search) -> Search:
    """Return the search of panoramas, which show about six times as much as a photo, at a smaller scale."""
    return Search(*(2 * value for value in astuple(search)))


def check_settings(settings: PoseSettings) -> None:
    """Refuse values that would crash pycolmap, and a folder of masks or a file of pairs that does not exist.

    Raises:
        ValueError: a setting is out of its range.
        UserError: there is no such folder or file.
    """
    if settings.max_image_size < 1 or (settings.max_features is not None and settings.max_features < 1):
        got = f"{settings.max_image_size} and {settings.max_features}"
        raise ValueError(f"image size and features must be positive, got {got}")
    if settings.camera_model not in CAMERA_MODELS:
        raise ValueError(f"camera_model must be one of {', '.join(CAMERA_MODELS)}, got {settings.camera_model}")
    if not 0 <= settings.min_registered <= 1:
        raise ValueError(f"min_registered must be within 0...1, got {settings.min_registered}")
    if settings.pairing not in PAIRINGS:
        raise ValueError(f"pairing must be one of {', '.join(PAIRINGS)}, got {settings.pairing}")
    if settings.masks is not None and not Path(settings.masks).is_dir():
        hint = "give a folder with a mask for each photo"
        raise UserError(f"the mask folder {settings.masks} does not exist", hint)
    if settings.pairs_file is not None and not Path(settings.pairs_file).exists():
        hint = "give a text file with two names per line"
        raise UserError(f"cannot read the pairs in {settings.pairs_file}: No such file", hint)
