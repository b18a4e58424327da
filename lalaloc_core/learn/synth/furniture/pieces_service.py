"""Furniture of kitchens and bathrooms; see `pieces` for the frame."""

from __future__ import annotations

import numpy as np

from lalaloc_core.learn.synth.furniture.pieces import Finish, Part, Piece, box, cylinder

COUNTER_DEPTH_M = 0.62
_UNIT_M = 0.6


def counter(rng: np.random.Generator) -> Piece:
    """Return a run of kitchen units: base units, worktop, backsplash, hob, sink and wall units."""
    body: Finish = ("white", "wood", "paint")[int(rng.integers(3))]
    width = _UNIT_M * int(rng.integers(2, 7))
    return counter_run(rng, width, rng.uniform(0.85, 0.95), body, wall_units=bool(rng.random() < 0.75))


def counter_run(
    rng: np.random.Generator,
    width: float,
    height: float,
    body: Finish,
    *,
    wall_units: bool,
    ceiling_m: float | None = None,
) -> Piece:
    """Return a run of kitchen units; with the height of the ceiling, there are things on the worktop."""
    units = max(1, round(width / _UNIT_M))
    unit, depth = width / units, COUNTER_DEPTH_M
    hx, hy = 0.5 * width, 0.5 * depth
    parts = [
        box(at=(0.0, -0.03), half=(hx, hy - 0.06), z=(0.0, 0.1), finish="dark"),
        box(at=(0.0, -0.01), half=(hx, hy - 0.03), z=(0.1, height - 0.04), finish=body),
        box(at=(0.0, 0.0), half=(hx, hy), z=(height - 0.04, height), finish="stone"),
        box(at=(0.0, -hy + 0.01), half=(hx, 0.01), z=(height, height + rng.uniform(0.1, 0.35)), finish="ceramic"),
    ]
    if width > 3 * _UNIT_M:
        hob, tap = rng.uniform(-0.3, 0.0) * width, rng.uniform(0.1, 0.3) * width
        parts.append(box(at=(hob, 0.0), half=(0.25, 0.22), z=(height, height + 0.01), finish="dark"))
        parts.append(cylinder(at=(tap, -0.1), half=(0.02, 0.02), z=(height, height + 0.3), finish="metal"))
    for k in range(units):
        x = -hx + unit * (k + 0.5)
        front: Finish = "dark" if rng.random() < 0.15 else body
        parts.append(box(at=(x, hy - 0.03), half=(0.49 * unit, 0.01), z=(0.11, height - 0.06), finish=front))
        parts.append(box(at=(x, hy - 0.01), half=(0.25 * unit, 0.01), z=(height - 0.14, height - 0.12), finish="metal"))
    if wall_units:
        bottom, top = rng.uniform(1.35, 1.5), rng.uniform(1.95, 2.15)
        if ceiling_m is not None:
            top = min(top, ceiling_m - 0.01)
            if rng.random() < 0.3:
                top = ceiling_m - 0.01
            elif rng.random() < 0.4:
                # A box of plaster closes the gap to the ceiling.
                parts.append(box(at=(0.0, -hy + 0.18), half=(hx, 0.18), z=(top, ceiling_m - 0.01), finish="white"))
        for k in range(units):
            if rng.random() < 0.85:
                x = -hx + unit * (k + 0.5)
                parts.append(box(at=(x, -hy + 0.17), half=(0.495 * unit, 0.17), z=(bottom, top), finish=body))
    if ceiling_m is not None:
        parts += _on_worktop(rng, hx, height)
    return Piece(width, depth, tuple(parts), label="counter")


def _on_worktop(rng: np.random.Generator, half_width: float, height: float) -> list[Part]:
    parts = []
    for _ in range(int(rng.integers(1, 2 + round(3 * half_width)))):
        finish: Finish = ("metal", "white", "dark", "accent", "wood", "ceramic")[int(rng.integers(6))]
        shape, half = (box, rng.uniform(0.05, 0.25)) if rng.random() < 0.6 else (cylinder, rng.uniform(0.03, 0.09))
        x, y = rng.uniform(-1.0, 1.0) * max(half_width - half, 0.0), rng.uniform(-0.2, 0.05)
        top = height + rng.uniform(0.08, 0.38)
        parts.append(shape(at=(x, y), half=(half, min(half, 0.15)), z=(height, top), finish=finish))
    return parts


def island(rng: np.random.Generator) -> Piece:
    """Return a kitchen island with stools, or a half-height wall with a worktop."""
    width, depth, height = rng.uniform(1.0, 2.6), rng.uniform(0.5, 1.1), rng.uniform(0.88, 1.1)
    body: Finish = ("white", "wood", "paint")[int(rng.integers(3))]
    hx, hy = 0.5 * width, 0.5 * depth
    parts = [
        box(at=(0.0, 0.0), half=(hx - 0.03, hy - 0.05), z=(0.0, height - 0.04), finish=body),
        box(at=(0.0, 0.0), half=(hx, hy), z=(height - 0.04, height), finish="stone"),
    ]
    for x in np.arange(-hx + 0.3, hx - 0.2, 0.6):
        if rng.random() < 0.5:
            parts.append(cylinder(at=(float(x), hy + 0.25), half=(0.17, 0.17), z=(0.62, 0.67), finish="wood"))
            parts.append(cylinder(at=(float(x), hy + 0.25), half=(0.03, 0.03), z=(0.0, 0.62), finish="metal"))
    return Piece(width, depth + 0.9, tuple(parts), against_wall=False, label="counter")


def fridge(rng: np.random.Generator) -> Piece:
    """Return a tall box with two doors."""
    width, height, split = rng.uniform(0.55, 0.9), rng.uniform(1.5, 2.05), rng.uniform(0.5, 1.3)
    finish: Finish = "white" if rng.random() < 0.5 else "metal"
    parts = (
        box(at=(0.0, -0.02), half=(0.5 * width, 0.31), z=(0.02, height), finish=finish),
        box(at=(0.0, 0.3), half=(0.5 * width - 0.005, 0.02), z=(0.05, split), finish=finish),
        box(at=(0.0, 0.3), half=(0.5 * width - 0.005, 0.02), z=(split + 0.015, height), finish=finish),
        box(at=(0.5 * width - 0.05, 0.33), half=(0.012, 0.012), z=(split + 0.05, split + 0.4), finish="dark"),
    )
    return Piece(width, 0.7, parts)


def bathtub(rng: np.random.Generator) -> Piece:
    """Return a tub whose dark-rimmed hollow is visible from above."""
    width, depth, height = rng.uniform(1.4, 1.8), rng.uniform(0.7, 0.8), rng.uniform(0.5, 0.62)
    hx, hy, rim = 0.5 * width, 0.5 * depth, 0.06
    parts = [
        box(at=(0.0, 0.0), half=(hx - rim, hy - rim), z=(0.0, 0.2), finish="ceramic"),
        box(at=(0.0, -hy + 0.5 * rim), half=(hx, 0.5 * rim), z=(0.0, height), finish="ceramic"),
        box(at=(0.0, hy - 0.5 * rim), half=(hx, 0.5 * rim), z=(0.0, height), finish="ceramic"),
        box(at=(-hx + 0.5 * rim, 0.0), half=(0.5 * rim, hy), z=(0.0, height), finish="ceramic"),
        box(at=(hx - 0.5 * rim, 0.0), half=(0.5 * rim, hy), z=(0.0, height), finish="ceramic"),
    ]
    if rng.random() < 0.4:
        parts.append(box(at=(0.2 * width, hy - 0.02), half=(0.3 * width, 0.02), z=(0.3, 1.95), finish="fabric"))
    return Piece(width, depth, tuple(parts))


def toilet(rng: np.random.Generator) -> Piece:
    """Return bowl, seat and cistern."""
    cistern_z = 0.36 * rng.integers(0, 2), rng.uniform(0.7, 0.85)
    parts = (
        cylinder(at=(0.0, 0.1), half=(0.13, 0.2), z=(0.0, 0.36), finish="ceramic"),
        cylinder(at=(0.0, 0.08), half=(0.19, 0.25), z=(0.36, 0.41), finish="white"),
        box(at=(0.0, -0.24), half=(0.19, 0.09), z=cistern_z, finish="ceramic"),
    )
    return Piece(0.4, 0.66, parts)


def washbasin(rng: np.random.Generator) -> Piece:
    """Return a basin on a cabinet or a pedestal, with a mirror above."""
    width = rng.uniform(0.45, 1.3)
    hx = 0.5 * width
    below = (
        box(at=(0.0, 0.0), half=(hx, 0.22), z=(0.25 * rng.random(), 0.78), finish="wood")
        if rng.random() < 0.6
        else cylinder(at=(0.0, 0.0), half=(0.09, 0.09), z=(0.0, 0.78), finish="ceramic")
    )
    parts = (
        below,
        box(at=(0.0, 0.0), half=(hx, 0.24), z=(0.78, 0.86), finish="ceramic"),
        box(at=(0.0, -0.23), half=(0.9 * hx, 0.01), z=(1.15, rng.uniform(1.7, 2.0)), finish="metal"),
        cylinder(at=(0.0, -0.15), half=(0.02, 0.02), z=(0.86, 1.0), finish="metal"),
    )
    return Piece(width, 0.48, parts)


def shower(rng: np.random.Generator) -> Piece:
    """Return a tray with one or two screens."""
    side = rng.uniform(0.75, 1.1)
    half = 0.5 * side
    parts = [
        box(at=(0.0, 0.0), half=(half, half), z=(0.0, rng.uniform(0.02, 0.15)), finish="ceramic"),
        box(at=(half - 0.01, 0.0), half=(0.01, half), z=(0.1, 2.0), finish="metal"),
        cylinder(at=(-0.2, -half + 0.03), half=(0.015, 0.015), z=(0.9, 2.05), finish="metal"),
    ]
    return Piece(side, side, tuple(parts))
