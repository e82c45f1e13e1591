"""Reasons why a photo did not register, from the evidence in the feature database."""

from collections import Counter
from collections.abc import Iterable

# Below this a photo is blank for our purposes: pycolmap's mapper needs 100 common points to begin.
FEW_FEATURES = 100
# pycolmap's mapper places a photo only with this many of its points known (abs_pose_min_num_inliers).
FEW_MATCHES = 30
# pycolmap verifies a pair from this many matches (min_num_inliers); with fewer, agreement may be accidental.
MIN_MATCHES = 15
# A held-out photo is placed with the lens that the training photos of its camera gave.
NO_TRAINING_PHOTO = "its camera took no training photo"
# Not causes, so that `dominant` does not count them: the training photos have their reasons.
NO_MODEL = "held out, and no training photo registered"
NO_LENS = "held out, and no training photo of its camera registered"


def reason(
    features: int, best_matches: int, best_partner: str | None, *, other_model_size: int, size_px: tuple[int, int]
) -> str:
    """Return a phrase for the first condition that by itself explains why a photo was left out.

    best_matches: the most verified ones with any one photo, best_partner. other_model_size: number of photos in another
    model with this photo, 0 without one. size_px: width and height.
    """
    if other_model_size:
        return f"in another model of {other_model_size} photos"
    if features < FEW_FEATURES:
        return f"too few features ({features} in {size_px[0]}x{size_px[1]} pixels)"
    if best_matches < FEW_MATCHES:
        return f"matches no other photo well (best {best_matches} verified matches)"
    return f"rejected by the mapper ({best_matches} verified matches with {best_partner})"


_ADVICE = {
    "unreadable": "convert the files to JPEG or copy them again",
    "too few features": "use the original files if these were made smaller, or take sharper photos of a textured scene",
    "matches no other photo well": "take photos with more overlap, two thirds from one to the next",
    "in another model": "take photos that connect the parts of the scene",
    "contradicts the rest": "take photos with more overlap around this one, or remove it",
    "connected to the rest only through": "take photos with more overlap around that photo",
    "matches too few points": "hold out photos that overlap with training photos, see --holdout",
    NO_TRAINING_PHOTO: "hold out only photos of cameras that also took training photos, see --holdout",
    "rejected by the mapper": "take photos with more overlap and while moving sideways, or try --quality best",
}


def dominant(reasons: Iterable[str]) -> tuple[str, str]:
    """Return the most frequent kind of reason that explains something by itself, and advice.

    Raises:
        ValueError: no reason, or none that this module or `photos` gave.
    """
    kinds = Counter(kind for text in reasons for kind in _ADVICE if text.startswith(kind))
    if not kinds:
        raise ValueError("no reasons to choose from")
    kind = kinds.most_common(1)[0][0]
    return kind, _ADVICE[kind]
