"""Replace non-finite numbers, which JSON cannot hold."""

import math
from typing import Any


def finite(content: Any) -> tuple[Any, dict[str, str]]:
    """Copy plain content, with None in place of every non-finite number.

    Args:
        content: dictionaries, lists, tuples and plain values. Tuples come back as lists.

    Returns:
        The copy, and the replaced numbers by their path: `{"lenses.0.gain": "inf"}`.

    Example:
        >>> finite({"gain": [1.0, float("inf")]})
        ({'gain': [1.0, None]}, {'gain.1': 'inf'})
    """
    replaced: dict[str, str] = {}

    def copy(value: Any, place: str) -> Any:
        if isinstance(value, dict):
            return {key: copy(item, f"{place}.{key}" if place else str(key)) for key, item in value.items()}
        if isinstance(value, (list, tuple)):
            return [copy(item, f"{place}.{index}" if place else str(index)) for index, item in enumerate(value)]
        if isinstance(value, float) and not math.isfinite(value):
            replaced[place] = str(float(value))
            return None
        return value

    return copy(content, ""), replaced
