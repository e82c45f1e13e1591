"""Requirements on the metrics of a run: psnr>=25,registered>=0.9."""

import operator
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from nerfcli.evaluate.metrics import NAMES as MEASURED
from nerfcli.evaluate.protocol import RunMetrics
from nerfcli.training.runs.run import RunConfig

_COMPARISONS = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}
# Metrics that may be required: the means in metrics.json, the fraction of photos with a pose, and the run's times.
NAMES = (*MEASURED, "registered", "training_seconds", "seconds_per_image")
# Why a number may be absent, and what to do.
WHY_ABSENT = {
    "registered": "only scenes of nerfcli poses say how many photos were registered; leave this requirement out",
    "lpips": "LPIPS needs pip install 'nerfcli[lpips]'; then evaluate again with --overwrite",
}


@dataclass(frozen=True)
class Requirement:
    """A bound on a number: "psnr", ">=", 25.0."""

    name: str
    comparison: str
    bound: float

    def __str__(self) -> str:
        return f"{self.name}{self.comparison}{self.bound:g}"


def parse_requirements(text: str) -> tuple[Requirement, ...]:
    """Parse requirements separated by commas.

    Raises:
        ValueError: an unknown name, or no comparison with a number; the message says what was expected.
    """
    found = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\w+)\s*(>=|<=|>|<)\s*(\S+)\s*", part)
        if match is None or not re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", match[3]):
            raise ValueError(f"{part.strip()!r} is not a requirement; write psnr>=25,registered>=0.9")
        if match[1] not in NAMES:
            raise ValueError(f"unknown metric {match[1]!r}; choose {', '.join(NAMES)}")
        found.append(Requirement(match[1], match[2], float(match[3])))
    return tuple(found)


def known_numbers(metrics: RunMetrics, config: RunConfig) -> dict[str, float | None]:
    """Return the numbers of a run that requirements can refer to."""
    placed, photos = config.history.get("registered"), config.history.get("total")
    return {
        **asdict(metrics.mean),
        "registered": placed / photos if placed is not None and photos else None,
        "training_seconds": None if metrics.training is None else metrics.training.seconds,
        "seconds_per_image": metrics.seconds_per_image,
    }


def unmet(requirements: Sequence[Requirement], numbers: Mapping[str, float | None]) -> list[str]:
    """List the requirements that are not met, with the values found."""
    failures = []
    for requirement in requirements:
        value = numbers.get(requirement.name)
        if value is None or not _COMPARISONS[requirement.comparison](value, requirement.bound):
            found = "not known" if value is None else f"{value:.4g}"
            failures.append(f"{requirement} ({requirement.name} is {found})")
    return failures
