"""What structure from motion is about to do and about how long it will take: said before it starts."""

from dataclasses import asdict, dataclass
from typing import Any

from nerfcli.poses.pairs import Pairing
from nerfcli.poses.photos import Photos
from nerfcli.poses.settings import PoseSettings

# CPU seconds, measured on one core of a 2-core server; within a factor of two on others.
_SECONDS_PER_MEGAPIXEL = 0.6
_SECONDS_PER_PAIR = 0.12
_FEATURES_PER_PAIR = 4096
_MAP_SECONDS_PER_PHOTO = 0.45


@dataclass(frozen=True)
class Plan:
    """photos: how many. rule and pairs: see `Pairing`; pairs is the most that may come of it. seconds: per stage."""

    photos: int
    max_image_size: int
    max_features: int
    rule: str
    pairs: int
    seconds: dict[str, float]

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    def describe(self) -> str:
        """One sentence."""
        times = ", ".join(f"{_WORDS[stage]} {duration(seconds)}" for stage, seconds in self.seconds.items())
        about = f"about {duration(sum(self.seconds.values()))}"
        return f"{self.photos} photos, {self.pairs} pairs to compare ({self.rule}), {about}: {times}"


_WORDS = {"extract": "features", "match": "matches", "map": "poses"}


def make_plan(photos: Photos, pairing: Pairing, settings: PoseSettings, *, threads: int) -> Plan:
    """The plan for these photos; threads is how many there really are."""
    count = len(photos.photos)
    pairs = min(len(pairing.pairs) + pairing.neighbours * count, count * (count - 1) // 2)
    megapixels = 0.0
    for photo in photos.photos:
        scale = min(1.0, settings.max_image_size / max(photo.width, photo.height))
        megapixels += photo.width * photo.height * scale**2 / 1e6
    seconds = {
        "extract": megapixels * _SECONDS_PER_MEGAPIXEL / threads,
        "match": pairs * _SECONDS_PER_PAIR * settings.max_features / _FEATURES_PER_PAIR / threads,
        "map": count * _MAP_SECONDS_PER_PHOTO,
    }
    return Plan(
        photos=count,
        max_image_size=settings.max_image_size,
        max_features=settings.max_features,
        rule=pairing.rule,
        pairs=pairs,
        seconds={stage: round(value, 1) for stage, value in seconds.items()},
    )


def duration(seconds: float) -> str:
    """8 s, 3 min, 1.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
