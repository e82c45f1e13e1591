"""Where on Earth the origin of a scene is."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_SEPARATOR = "; origin "
# Three-dimensional geographic systems and their two-dimensional counterparts: WGS 84, ETRS89.
_WITHOUT_HEIGHT = {4979: 4326, 4937: 4258}


def without_origin(unit_source: str | None) -> str | None:
    """Remove the origin that `Origin.in_source` appended."""
    return None if unit_source is None else unit_source.partition(_SEPARATOR)[0]


@dataclass(frozen=True)
class Origin:
    """Origin of a georeferenced world: metres, x east, y north and z up.

    Args:
        system: the coordinate system, such as EPSG:32611.
        coordinates: of the origin in it: x, y, height in metres, or latitude, longitude in degrees, height in metres.
        in_degrees: True for latitude and longitude. Otherwise, world coordinates + `coordinates` are coordinates in the
            system.
    """

    system: str
    coordinates: tuple[float, float, float]
    in_degrees: bool

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> "Origin":
        """Read what `dataclasses.asdict` gave.

        Raises:
            KeyError, TypeError, ValueError: the content is invalid.
        """
        a, b, height = (float(value) for value in content["coordinates"])
        return Origin(str(content["system"]), (a, b, height), bool(content["in_degrees"]))

    @property
    def epsg(self) -> int | None:
        """EPSG code of the horizontal coordinate system; None if `system` neither contains nor implies one."""
        compact = re.sub(r"\s", "", self.system).upper()
        if code := re.fullmatch(r"EPSG:(\d{4,5})", compact):
            return _WITHOUT_HEIGHT.get(int(code[1]), int(code[1]))
        if self.in_degrees:
            return 4326
        if zone := re.fullmatch(r"WGS84UTM(\d{1,2})([NS])", compact):
            return (32700 if zone[2] == "S" else 32600) + int(zone[1])
        zone = re.search(r"\+PROJ=UTM.*\+ZONE=(\d{1,2})(?!\d)", compact)
        if zone and ("DATUM=WGS84" in compact or "ELLPS=WGS84" in compact):
            return (32700 if "+SOUTH" in compact else 32600) + int(zone[1])
        return None

    def in_source(self, unit_source: str) -> str:
        """Append this origin to the source of a unit, see `Scene.unit_source`."""
        return f"{unit_source}{_SEPARATOR}{self}"

    def __str__(self) -> str:
        a, b, height = self.coordinates
        if self.in_degrees:
            return f"at latitude {a:.8f}, longitude {b:.8f}, height {height:.3f} m"
        return f"at {a:.0f}, {b:.0f}, {height:.0f} in {self.system}"
