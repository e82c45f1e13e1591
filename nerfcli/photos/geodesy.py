"""Conversion of GPS positions to metres."""

from collections.abc import Sequence

import numpy as np

# Latitude and longitude in degrees, altitude in metres or None.
Position = tuple[float, float, float | None]

# WGS 84: semi-major axis in metres and flattening. Source: NIMA TR8350.2, table 3.1.
_SEMI_MAJOR = 6378137.0
_FLATTENING = 1 / 298.257223563


def ecef(latitude_deg: np.ndarray, longitude_deg: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return earth-centred coordinates (N, 3), in metres, of WGS 84 positions (N,) with heights above the ellipsoid.

    x = (n + h) cos(lat) cos(lon), y = (n + h) cos(lat) sin(lon), z = ((1 - e^2) n + h) sin(lat),
    n = a / sqrt(1 - e^2 sin^2(lat)), e^2 = f (2 - f).  Source: NIMA TR8350.2, eq. 4-14.
    """
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    squared = _FLATTENING * (2 - _FLATTENING)
    n = _SEMI_MAJOR / np.sqrt(1 - squared * np.sin(latitude) ** 2)
    out = (n + height) * np.cos(latitude)
    return np.stack(
        [out * np.cos(longitude), out * np.sin(longitude), ((1 - squared) * n + height) * np.sin(latitude)], axis=-1
    )


def east_north_up(positions: Sequence[Position]) -> np.ndarray:
    """Return positions in metres east, north and up of the first one, (N, 3).

    EXIF altitudes are above sea level, not above the ellipsoid; ignoring the difference moves all positions alike. A
    photo without altitude is placed at the median altitude of the others.
    """
    latitude, longitude = (np.array([position[i] for position in positions], dtype=np.float64) for i in (0, 1))
    heights = [position[2] for position in positions if position[2] is not None]
    middle = float(np.median(heights)) if heights else 0.0
    height = np.array([middle if position[2] is None else position[2] for position in positions])
    earth = ecef(latitude, longitude, height)
    lat, lon = np.radians(latitude[0]), np.radians(longitude[0])
    enu_from_ecef = np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )
    return (earth - earth[0]) @ enu_from_ecef.T
