"""Procedural materials: planks, tiles, brick, stripes, marble, wood and cloth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass

import numpy as np
from jaxtyping import Float, Int

_TABLE = 32


@dataclass(frozen=True, eq=False)
class Surface:
    """A material.

    Attributes:
        pattern: name of its pattern, a key of `PATTERNS`.
        colour, second: linear RGB of the ground and of joints, veins or stripes.
        size_m: of one repeat.
        turn: of the pattern in the plane, radians.
        gloss: share of light reflected as by a mirror, straight on.
        skirting: colour below 8 cm (None: none).
    """

    pattern: str
    colour: Float[np.ndarray, "3"]
    second: Float[np.ndarray, "3"]
    _: KW_ONLY
    size_m: float = 0.5
    turn: float = 0.0
    gloss: float = 0.0
    glow: float = 0.0
    skirting: Float[np.ndarray, "3"] | None = None


class Noise:
    """Smooth value noise in space, from a table of random numbers."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._table = rng.random((_TABLE, _TABLE, _TABLE), dtype=np.float32).ravel()

    def __call__(self, point: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return values in 0 to 1; features are about one unit wide."""
        cell = np.floor(point).astype(np.int32)
        t = (point - cell).astype(np.float32)
        t = t * t * (3 - 2 * t)
        low, high = cell & (_TABLE - 1), (cell + 1) & (_TABLE - 1)
        x = (low[:, 0] * _TABLE * _TABLE, high[:, 0] * _TABLE * _TABLE)
        y, z = (low[:, 1] * _TABLE, high[:, 1] * _TABLE), (low[:, 2], high[:, 2])
        table = self._table
        rows = []
        for i in (0, 1):
            for j in (0, 1):
                base = x[i] + y[j]
                near = table[base + z[0]]
                rows.append(near + (table[base + z[1]] - near) * t[:, 2])
        front = rows[0] + (rows[1] - rows[0]) * t[:, 1]
        back = rows[2] + (rows[3] - rows[2]) * t[:, 1]
        return front + (back - front) * t[:, 0]

    def of_cell(self, i: Int[np.ndarray, "n"], j: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return a random number in 0 to 1 for each cell of a pattern."""
        return self._table[(i * 7919 + j * 104729) % len(self._table)]


# A pattern mixes ground (0) and second colour (1) and brightens, from coordinates in repeats and in space.
_Mix = tuple[np.ndarray, np.ndarray]
_Pattern = Callable[[np.ndarray, np.ndarray, np.ndarray, Noise], _Mix]


def _plain(u: np.ndarray, v: np.ndarray, p: np.ndarray, noise: Noise) -> _Mix:
    return np.zeros(len(u), np.float32), 0.96 + 0.08 * noise(p * 1.3)


def _plaster(u: np.ndarray, v: np.ndarray, p: np.ndarray, noise: Noise) -> _Mix:
    return 0.35 * noise(p * 0.9), 0.9 + 0.12 * noise(p * 6.0) + 0.08 * noise(p * 31.0)


def _planks(u: np.ndarray, v: np.ndarray, p: np.ndarray, noise: Noise) -> _Mix:
    row = np.floor(v * 6).astype(np.int64)
    along = u * 0.8 + noise.of_cell(row, row * 0 + 3) * 5
    board = np.floor(along).astype(np.int64)
    edge = np.minimum(0.5 - np.abs((v * 6) % 1 - 0.5), 8 * (0.5 - np.abs(along % 1 - 0.5)))
    grain = noise(np.stack([u * 3, v * 60, row * 0.37], axis=1))
    return np.where(edge < 0.03, 0.9, 0.3 * grain), 0.75 + 0.4 * noise.of_cell(row, board) + 0.12 * grain


def _checker(u: np.ndarray, v: np.ndarray, p: np.ndarray, noise: Noise) -> _Mix:
    i, j = np.floor(u * 2).astype(np.int64), np.floor(v * 2).astype(np.int64)
    return ((i + j) % 2).astype(np.float32), 0.9 + 0.15 * noise.of_cell(i, j)


def _tiles(u: np.ndarray, v: np.ndarray, p: np.ndarray, noise: Noise) -> _Mix:
    edge = np.minimum(0.5 - np.abs(u % 1 - 0.5), 0.5 - np.abs(v % 1 - 0.5))
    cell = noise.of_cell(np.floor(u).astype(np.int64), np.floor(v).astype(np.int64))
    return (edge < 0.014).astype(np.float32), 0.92 + 0.1 * cell + 0.06 * noise(p * 5)


def _hexagons(u: np.ndarray, v: np.ndarray, p: np.ndarray, noise: Noise) -> _Mix:
    x, y = u * 3, v * 3 / np.sqrt(3.0)
    a = np.stack([x - np.round(x), (y - np.round(y)) * np.sqrt(3.0)])
    b = np.stack([x - np.floor(x) - 0.5, (y - np.floor(y) - 0.5) * np.sqrt(3.0)])
    first = (a**2).sum(0) < (b**2).sum(0)
    q = np.abs(np.where(first, a, b))
    edge = 0.5 - np.maximum(q[0], q[0] * 0.5 + q[1] * np.sqrt(0.75))
    i = np.where(first, np.round(x), np.floor(x) + 977).astype(np.int64)
    j = np.where(first, np.round(y), np.floor(y) + 977).astype(np.int64)
    return np.where(edge < 0.03, 1.0, 0.0), 0.85 + 0.25 * noise.of_cell(i, j)


def _stripes(u: np.ndarray, v: np.ndarray, p: np.ndarray, noise: Noise) -> _Mix:
    return ((u * 2) % 1 > 0.55).astype(np.float32), 0.97 + 0.05 * noise(p * 9)


def _dots(u: np.ndarray, v: np.ndarray, p: np.ndarray, noise: Noise) -> _Mix:
    row = np.floor(v * 2)
    x, y = (u * 2 + 0.5 * (row % 2)) % 1 - 0.5, (v * 2) % 1 - 0.5
    return ((x * x + y * y) < 0.06).astype(np.float32), 0.97 + 0.05 * noise(p * 9)


def _brick(u: np.ndarray, v: np.ndarray, p: np.ndarray, noise: Noise) -> _Mix:
    row = np.floor(v * 7).astype(np.int64)
    x = u * 2 + 0.5 * (row % 2)
    edge = np.minimum(0.5 - np.abs((v * 7) % 1 - 0.5), 3.0 * (0.5 - np.abs(x % 1 - 0.5)))
    return (edge < 0.08).astype(np.float32), 0.7 + 0.5 * noise.of_cell(row, np.floor(x).astype(np.int64)) + 0.1 * noise(
        p * 25
    )


def _marble(u: np.ndarray, v: np.ndarray, p: np.ndarray, noise: Noise) -> _Mix:
    bent = p @ np.array([1.9, 1.3, 2.2]) + 5.0 * noise(p * 1.1) + 2.0 * noise(p * 3.7)
    return np.clip(1 - 4 * np.abs(np.sin(bent)), 0, 1) * 0.8, 0.94 + 0.1 * noise(p * 2)


def _wood(u: np.ndarray, v: np.ndarray, p: np.ndarray, noise: Noise) -> _Mix:
    axis = np.hypot(p[:, 0] + 0.6, p[:, 2] - 0.3) * 14 + 2.5 * noise(p * np.array([2.0, 0.7, 2.0]))
    return 0.6 * (axis % 1) ** 2, 0.85 + 0.25 * noise(p * np.array([30.0, 3.0, 30.0]))


def _cloth(u: np.ndarray, v: np.ndarray, p: np.ndarray, noise: Noise) -> _Mix:
    return 0.25 * noise(p * 4), 0.85 + 0.25 * noise(p * 55)


def _leaf(u: np.ndarray, v: np.ndarray, p: np.ndarray, noise: Noise) -> _Mix:
    return noise(p * 17), 0.5 + 0.9 * noise(p * 45)


def _blotches(u: np.ndarray, v: np.ndarray, p: np.ndarray, noise: Noise) -> _Mix:
    field = noise(p * 3.3) + 0.4 * noise(p * 8.0)
    return np.clip((np.sin(field * 14) + 0.3) * 2, 0, 1), 0.8 + 0.3 * noise(p * 40)


PATTERNS: Mapping[str, _Pattern] = {
    "plain": _plain,
    "plaster": _plaster,
    "planks": _planks,
    "checker": _checker,
    "tiles": _tiles,
    "hexagons": _hexagons,
    "stripes": _stripes,
    "dots": _dots,
    "brick": _brick,
    "marble": _marble,
    "wood": _wood,
    "cloth": _cloth,
    "leaf": _leaf,
    "blotches": _blotches,
}


class Materials:
    """Surfaces of a home, by number."""

    def __init__(self, surfaces: list[Surface], noise: Noise) -> None:
        self._surfaces, self._noise = surfaces, noise
        self.gloss = np.array([surface.gloss for surface in surfaces], np.float32)
        self.glow = np.array([surface.glow for surface in surfaces], np.float32)
        self._means = np.stack([0.8 * surface.colour + 0.2 * surface.second for surface in surfaces]).astype(np.float32)

    def mean(self, number: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """Return the mean colour of each surface."""
        return self._means[number]

    def colour(
        self, number: Int[np.ndarray, "n"], point_m: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Return the albedo (linear RGB) at each point."""
        out = np.zeros((len(number), 3), np.float32)
        order = np.argsort(number, kind="stable")
        bounds = np.searchsorted(number[order], np.arange(len(self._surfaces) + 1))
        for k, surface in enumerate(self._surfaces):
            chosen = order[bounds[k] : bounds[k + 1]]
            if len(chosen):
                out[chosen] = self._one(surface, point_m[chosen], normal[chosen])
        return out

    def _one(self, surface: Surface, p: np.ndarray, n: np.ndarray) -> np.ndarray:
        level = np.abs(n[:, 2]) > 0.7
        # On the level the pattern lies in x and y; upright it runs along the wall and up.
        u = np.where(level, p[:, 0], n[:, 0] * p[:, 1] - n[:, 1] * p[:, 0])
        v = np.where(level, p[:, 1], p[:, 2])
        c, s = np.cos(surface.turn), np.sin(surface.turn)
        u, v = (c * u - s * v) / surface.size_m, (s * u + c * v) / surface.size_m
        share, bright = PATTERNS[surface.pattern](u, v, p, self._noise)
        colour = (surface.colour + (surface.second - surface.colour) * share[:, None]) * bright[:, None]
        if surface.skirting is not None:
            colour = np.where((p[:, 2] < 0.08)[:, None], surface.skirting, colour)
        return np.clip(colour, 0.0, 0.95).astype(np.float32)
