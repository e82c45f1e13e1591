"""The arithmetic of the page's shader in float32 NumPy, from the numbers in the page: an oracle without a GPU."""

import base64
import json
import re
import zlib
from typing import Any, NamedTuple

import numpy as np

F = np.float32
PRIMES = (np.uint32(2654435761), np.uint32(805459861))


class Traced(NamedTuple):
    """Rendered values of rays; distances are in the training frame, NaN where undefined."""

    rgb: np.ndarray
    opacity: np.ndarray
    mean: np.ndarray
    spread: np.ndarray
    median: np.ndarray


class PageField:
    """The field of a page, read from its text as a browser does."""

    def __init__(self, page: str):
        self.scene: dict[str, Any] = json.loads(element(page, "scene"))
        self.field, self.march = self.scene["field"], self.scene["march"]
        self.table = array(page, "table", "<i2").reshape(-1, 4)
        self.cuts = array(page, "cuts", "<f4")
        side = self.march["side"]
        bits = np.unpackbits(array(page, "occupied", "u1"), bitorder="little")
        self.occupied = bits[: side**3].reshape(side, side, side).astype(bool)
        self.sky = array(page, "sky", "<i2") if self.field["sky"] else None
        self.layers = self._layers(array(page, "networks", "<f4")) if self.field["kind"] == "hash" else []

    def _layers(self, numbers: np.ndarray) -> list[np.ndarray]:
        """Return the matrices of the networks, stored in the page as transposed 4 x 4 blocks."""
        hidden, encoded = self.field["width"], 4 * len(self.field["resolutions"])
        layers, at = [], 0
        for outputs, inputs in ((hidden, encoded), (16, hidden), (hidden, 32), (hidden, hidden), (4, hidden)):
            blocks = numbers[at : at + outputs * inputs].reshape(outputs // 4, inputs // 4, 4, 4)
            layers.append(blocks.transpose(0, 3, 1, 2).reshape(outputs, inputs))
            at += outputs * inputs
        assert at == len(numbers)
        return layers

    def cube(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return coordinates in the unit cube, and the factor by which widths shrink there."""
        if self.field["contraction"] == 0:
            return points * F(0.5) + F(0.5), np.full(len(points), F(0.5))
        norm = np.sqrt(np.maximum((points * points).sum(-1), F(1)))
        scale = (F(2) - F(1) / norm) / norm * F(0.25)
        return points * scale[:, None] + F(0.5), scale

    def encode(self, p: np.ndarray, widths: np.ndarray) -> np.ndarray:
        columns = []
        for level, side in enumerate(self.field["resolutions"]):
            s = np.clip(p, 0, 1).astype(F) * F(side)
            cell = np.minimum(s.astype(np.int32), side - 1)
            t, u = s - cell.astype(F), cell.astype(np.uint32)
            total = np.zeros((len(p), 4), F)
            for k in range(8):
                d = np.array([k & 1, k >> 1 & 1, k >> 2], np.uint32)
                q = u + d
                if side <= self.field["largestDense"]:
                    row = (q[:, 2] * np.uint32(side + 1) + q[:, 1]) * np.uint32(side + 1) + q[:, 0]
                else:
                    row = (q[:, 0] ^ (q[:, 1] * PRIMES[0]) ^ (q[:, 2] * PRIMES[1])) & np.uint32(self.field["rowMask"])
                weight = np.where(d == 1, t, F(1) - t).prod(-1, dtype=F)
                total += weight[:, None] * self.table[self.field["firstRows"][level] + row.astype(np.int64)].astype(F)
            if self.field["antialias"]:
                total /= np.maximum(F(1), F(side) * widths)[:, None]
            columns.append(total * F(self.field["scales"][level]))
        return np.concatenate(columns, -1)

    def radiance(self, code: np.ndarray, harmonics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.field["kind"] == "voxels":
            count = self.field["harmonics"]
            channels = code[:, 1 : 1 + 3 * count].reshape(-1, count, 3)
            colour = (harmonics[:, :count, None] * channels).sum(1)
            return np.exp(np.clip(code[:, 0], -15, 15)), sigmoid(colour)
        w1, w2, c1, c2, c3 = self.layers
        geometry = np.maximum(code @ w1.T, 0) @ w2.T
        hidden = np.maximum(np.concatenate([geometry, harmonics], -1) @ c1.T, 0)
        return np.exp(np.clip(geometry[:, 0], -15, 15)), sigmoid((np.maximum(hidden @ c2.T, 0) @ c3.T)[:, :3])

    def behind(self, directions: np.ndarray) -> np.ndarray:
        if self.sky is None:
            return np.broadcast_to(np.array(self.field["background"], F), directions.shape)
        side, scale = self.field["sky"]["side"], F(self.field["sky"]["scale"])
        grid = self.sky.reshape(3, side, side, side)
        s = np.clip((directions * F(0.5) + F(0.5)) * F(side - 1), 0, side - 1)
        cell = np.minimum(s.astype(np.int32), max(side - 2, 0))
        t, total = s - cell, np.zeros_like(directions)
        for k in range(8):
            d = np.array([k & 1, k >> 1 & 1, k >> 2])
            x, y, z = np.minimum(cell + d, side - 1).T
            total += np.where(d == 1, t, F(1) - t).prod(-1)[:, None] * grid[:, z, y, x].T
        return sigmoid(total * scale)

    def trace(self, view: dict[str, Any], tolerance: float = 1 / 1020) -> Traced:
        """Render a view of the page; pixels are in row order."""
        to_training, lens = self.scene["training_from_scene"], view["lens"]
        turn = np.array(to_training["rotation"]) @ np.array(view["turn"])
        origin = to_training["scale"] * np.array(to_training["rotation"]) @ view["place"] + to_training["translation"]
        x, y = np.meshgrid(np.arange(view["width"]) + 0.5, np.arange(view["height"]) + 0.5)
        local = np.stack([(x - lens[2]) / lens[0], (y - lens[3]) / lens[1], np.ones_like(x)], -1).reshape(-1, 3)
        directions = local @ turn.T
        directions = (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(F)
        seen = [self._ray(origin.astype(F), d, F(2 / (lens[0] + lens[1])), tolerance) for d in directions]
        columns = [np.array(column) for column in zip(*seen, strict=True)]
        rgb = columns[0] + (F(1) - columns[1])[:, None] * self.behind(directions)
        return Traced(np.clip(rgb, 0, 1), *columns[1:])

    def _ray(self, origin: np.ndarray, direction: np.ndarray, cone: np.float32, tolerance: float) -> tuple[Any, ...]:
        starts, ends = self.cuts[:-1], self.cuts[1:]
        middles = (starts + ends) * F(0.5)
        points = origin + direction * middles[:, None]
        p, stretch = self.cube(points)
        side = self.march["side"]
        inside = ((p >= 0) & (p <= 1)).all(-1)
        x, y, z = np.minimum((np.clip(p, 0, 1) * side).astype(np.int32), side - 1).T
        kept = inside & self.occupied[z, y, x]
        nothing = (np.zeros(3, F), F(0), np.nan, np.nan, np.nan)
        if not kept.any():
            return nothing
        starts, lengths = starts[kept], (ends - starts)[kept]
        code = self.encode(p[kept], (cone * middles * stretch)[kept])
        density, rgb = self.radiance(code, np.tile(harmonics_of(direction), (len(code), 1)))
        depth = density.astype(np.float64) * lengths
        before = np.cumsum(depth) - depth
        seen = before < -np.log(0.1 * tolerance)
        depth, before, starts, lengths = depth[seen], before[seen], starts[seen], lengths[seen]
        weights = np.exp(-before) * -np.expm1(-depth)
        fraction = np.where(depth < 1e-3, 0.5, 1 / np.maximum(depth, 1e-9) - 1 / np.expm1(np.clip(depth, 1e-9, 80)))
        places, total = starts + lengths * fraction, weights.sum()
        mean = (weights * places).sum() / total
        narrow = np.exp(-np.clip(depth, 1e-2, 80))
        variance = np.where(depth < 1e-2, 1 / 12, 1 / np.maximum(depth, 1e-9) ** 2 - narrow / (1 - narrow) ** 2)
        apart = (weights * ((places - mean) ** 2 + lengths**2 * variance)).sum() / total
        crossed = np.flatnonzero(before + depth >= np.log(2))
        median = np.nan
        if len(crossed):
            i = crossed[0]
            median = starts[i] + lengths[i] * min((np.log(2) - before[i]) / depth[i], 1)
        opacity = -np.expm1(-depth.sum())
        return (weights[:, None] * rgb[seen]).sum(0), opacity, mean, np.sqrt(max(apart, 0)), median


def element(page: str, name: str) -> str:
    """Return the text of a script element of the page."""
    found = re.search(rf'<script type="[^"]*" id="{name}"[^>]*>(.*?)</script>', page, re.S)
    assert found, name
    return found[1]


def array(page: str, name: str, dtype: str) -> np.ndarray:
    planes = np.frombuffer(zlib.decompress(base64.b64decode(element(page, name))), np.uint8)
    return np.ascontiguousarray(planes.reshape(np.dtype(dtype).itemsize, -1).T).view(dtype).reshape(-1)


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def harmonics_of(direction: np.ndarray) -> np.ndarray:
    """Return the spherical harmonics of a direction, with the shader's constants."""
    x, y, z = direction
    xx, yy, zz = x * x, y * y, z * z
    return np.array(
        [
            *(0.28209479, 0.48860251 * y, 0.48860251 * z, 0.48860251 * x, 1.09254843 * x * y, 1.09254843 * y * z),
            *(0.31539157 * (3 * zz - 1), 1.09254843 * x * z, 0.54627422 * (xx - yy)),
            *(0.59004359 * y * (3 * xx - yy), 2.89061144 * x * y * z, 0.45704580 * y * (5 * zz - 1)),
            *(0.37317633 * z * (5 * zz - 3), 0.45704580 * x * (5 * zz - 1), 1.44530572 * z * (xx - yy)),
            0.59004359 * x * (xx - 3 * yy),
        ],
        F,
    )
