"""Spread of metrics over seeds: the size that a difference must exceed to be significant."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from nerfcli.errors import UserError


def spread(all_metrics: Sequence[Mapping[str, Any]], names: Sequence[str]) -> dict[str, Any]:
    """Return the mean and standard deviation over runs of every mean metric that all of them have.

    Args:
        all_metrics: the contents of metrics.json, at least two.
        names: names of the runs.

    Returns:
        {"runs": names, "psnr": {"mean", "standard_deviation", "lowest", "highest"}, ...}; the deviation estimates that
        of the population of seeds (divisor n - 1).

    Raises:
        UserError: the runs were measured by different protocols, on different photos, or at different sizes.
    """
    for name, metrics in zip(names[1:], all_metrics[1:], strict=True):
        if metrics["protocol"] != all_metrics[0]["protocol"]:
            raise UserError(
                f"{name} and {names[0]} cannot be compared: {_first_difference(metrics, all_metrics[0])}",
                "give runs of the same scene, split and resolution, evaluated with the same options (--overwrite)",
            )
    result: dict[str, Any] = {"runs": list(names)}
    for key in all_metrics[0]["mean"]:
        values = [metrics["mean"].get(key) for metrics in all_metrics]
        numbers = [value for value in values if value is not None]
        if len(numbers) == len(values):
            result[key] = {
                "mean": statistics.fmean(numbers),
                "standard_deviation": statistics.stdev(numbers),
                "lowest": min(numbers),
                "highest": max(numbers),
            }
    return result


def _first_difference(metrics: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Return the first part of two protocols in which they differ."""
    pairs = zip(metrics["protocol"].split(", "), other["protocol"].split(", "), strict=False)
    one, two = next(((a, b) for a, b in pairs if a != b), (metrics["protocol"], other["protocol"]))
    return f"{one!r} instead of {two!r}"
