"""Kinds of hostile plan files, and the shapes that files of all formats have; see `hostile_plans.py`."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lalaloc_core.importers import ImportOptions

LARGEST_NUMBER = 1e308
NONE = ImportOptions()
Point = tuple[float, float]


@dataclass(frozen=True)
class HostilePlan:
    """Kind of hostile files.

    Attributes:
        format: format of the file.
        title: what the file has, for the table.
        make: returns a file of about a size in bytes.
        options: options of the import.
    """

    format: str
    title: str
    make: Callable[[int], bytes]
    options: ImportOptions


def plan(format: str, title: str, make: Callable[[int], bytes], options: ImportOptions = NONE) -> HostilePlan:
    """Return a kind of hostile files."""
    return HostilePlan(format, title, make, options)


def star(points: int, size: float = 20.0) -> list[Point]:
    """Return a ring whose edges all cross one another."""
    step = 2.0 * math.pi * ((points - 1) // 2) / points
    return [(size * math.cos(k * step), size * math.sin(k * step)) for k in range(points)]


def chords(count: int, size: float = 20.0) -> list[tuple[Point, Point]]:
    """Return lines across a square, a quarter of whose pairs cross."""
    rng = random.Random(count)
    return [((0.0, size * rng.random()), (size, size * rng.random())) for _ in range(count)]


def lattice(count: int, size: float = 20.0) -> list[tuple[Point, Point]]:
    """Return upright and level lines, half of whose pairs cross."""
    places = [size * k / count for k in range(count // 2)]
    return [((x, 0.0), (x, 0.5 * size)) for x in places] + [((0.0, x), (0.5 * size, x)) for x in places]


def boxes(count: int, apart: float = 1e-3, size: float = 5.0) -> list[list[Point]]:
    """Return squares that nearly coincide."""
    corners = ((0.0, 0.0), (size, 0.0), (size, size), (0.0, size))
    return [[(x + apart * k, y + apart * k) for x, y in corners] for k in range(count)]


def rounded(points: Sequence[Point], digits: int = 3) -> list[list[float]]:
    """Return points as lists of rounded coordinates."""
    return [[round(x, digits), round(y, digits)] for x, y in points]


def stars(size: int, points: int, bytes_each: int) -> list[list[Point]]:
    """Return stars beside one another."""
    count = max(size // (bytes_each * points), 1)
    shape = star(points, 2.0)
    return [[(x + 5.0 * (k % 30), y + 5.0 * (k // 30)) for x, y in shape] for k in range(count)]
