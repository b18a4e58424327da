"""Definition of a piece of furniture: textured boxes and cylinders in a local frame.

Local frame: x along the width, y from the back (negative, at the wall) to the front, z up; the origin is on the floor
in the middle of the footprint. A part is a `box` or a `cylinder`: centre, half extents and z-range.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

Finish = Literal["wood", "fabric", "paint", "white", "metal", "dark", "leaf", "accent", "ceramic", "stone", "glow"]

Label = Literal["", "counter"]


class Part(NamedTuple):
    """A vertical box, or an elliptic cylinder if `is_round`; metres. Made by `box` and `cylinder`."""

    x: float
    y: float
    half_x: float
    half_y: float
    z0: float
    z1: float
    finish: Finish
    is_round: bool


def box(*, at: tuple[float, float], half: tuple[float, float], z: tuple[float, float], finish: Finish) -> Part:
    """Return a box with its centre `at` (x, y), half extents along x and y, and lower and upper end `z`; metres."""
    return Part(*at, *half, *z, finish, is_round=False)


def cylinder(*, at: tuple[float, float], half: tuple[float, float], z: tuple[float, float], finish: Finish) -> Part:
    """Return an elliptic cylinder that fills the footprint of the `box` with these arguments."""
    return Part(*at, *half, *z, finish, is_round=True)


@dataclass(frozen=True)
class Piece:
    """A piece of furniture with its footprint (width, depth) in metres; `label` is its name in reports of a shot."""

    width_m: float
    depth_m: float
    parts: tuple[Part, ...]
    against_wall: bool = True
    label: Label = ""

    @property
    def height_m(self) -> float:
        """Height of its highest part."""
        return max(part.z1 for part in self.parts)


Maker = Callable[[np.random.Generator], Piece]


def square_legs(hx: float, hy: float, thickness: float, height: float, finish: Finish) -> list[Part]:
    """Return four square legs under a rectangle of half extents (hx, hy)."""
    half = 0.5 * thickness
    return [
        box(at=(sx * (hx - half), sy * (hy - half)), half=(half, half), z=(0.0, height), finish=finish)
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
