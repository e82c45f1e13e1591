"""Cameras of every model with random parameters: mild, as of real lenses, or so strong that the lens turns back."""

import numpy as np

from nerfcli.cameras.camera import Camera, parameter_names
from nerfcli.cameras.lens import DISTORTIONS

MODELS = tuple(DISTORTIONS)
WIDTH, HEIGHT = 1200, 900


def random_camera(model: str, rng: np.random.Generator, *, strength: float = 1.0) -> Camera:
    """Return a camera of 1200 x 900 pixels. Strength 1 distorts like real lenses; at 5 most lenses turn back."""
    if model == "EQUIRECTANGULAR":
        return Camera(model, WIDTH, HEIGHT, (WIDTH, HEIGHT))
    fisheye = model.endswith("FISHEYE") or model == "EUCM"
    focal = rng.uniform(200, 500) if fisheye else rng.uniform(400, 1500)
    values = {"f": focal, "fx": focal, "fy": focal * rng.uniform(0.97, 1.03)}
    values["cx"], values["cy"] = WIDTH / 2 + rng.uniform(-40, 40), HEIGHT / 2 + rng.uniform(-40, 40)
    radial = 0.03 if fisheye else 0.2
    for index, name in enumerate(("k", "k0", "k1", "k2", "k3", "k4", "k5", "k6")):
        values[name] = strength * rng.normal() * radial / (1 + index**2)
    for name in ("p0", "p1", "p2", "sx1", "sy1", "s0", "s1", "s2", "s3"):
        values[name] = strength * rng.normal() * 1e-3
    values["omega"] = rng.choice([1e-4, 0.01, 0.04, rng.uniform(0.02, 1.5)])
    values["alpha"], values["beta"] = rng.uniform(0, 1), rng.uniform(0.5, 2)
    return Camera(model, WIDTH, HEIGHT, tuple(float(values[name]) for name in parameter_names(model)))


def random_directions(rng: np.random.Generator, count: int = 400) -> np.ndarray:
    """Return (count, 3) unit vectors, half within 60 degrees of the axis, a few very close to it, half anywhere."""
    angle = np.concatenate([rng.uniform(0, np.pi / 3, count // 2), np.arccos(rng.uniform(-1, 1, count - count // 2))])
    angle[:10] = 10.0 ** -np.arange(10)
    azimuth = rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], axis=-1)


def random_pixels(rng: np.random.Generator, count: int = 400, *, margin: float = 1.0) -> np.ndarray:
    """Return (count, 2) pixels, uniform over the picture and `margin` times its size beyond each edge."""
    return rng.uniform(-margin, 1 + margin, (count, 2)) * (WIDTH, HEIGHT)
