"""Pieces of furniture, and those of each kind of room; see `pieces` for the frame."""

from __future__ import annotations

from typing import cast

import numpy as np

from lalaloc_core.learn.synth.furniture.pieces import Finish, Maker, Part, Piece, box, cylinder, square_legs

COUNTER_DEPTH_M = 0.62
_UNIT_M = 0.6


def bed(rng: np.random.Generator) -> Piece:
    """Return a bed: frame, mattress, duvet, pillows and usually a headboard."""
    width, depth, height = rng.uniform(0.9, 1.9), rng.uniform(1.95, 2.15), rng.uniform(0.35, 0.6)
    hx, hy = 0.5 * width, 0.5 * depth
    linen: Finish = "white" if rng.random() < 0.6 else "fabric"
    parts = [
        box(at=(0.0, 0.0), half=(hx, hy), z=(0.08, 0.6 * height), finish="wood"),
        box(at=(0.0, 0.02), half=(hx - 0.03, hy - 0.03), z=(0.6 * height, height), finish="white"),
        box(at=(0.0, 0.2 * depth), half=(hx, 0.3 * depth), z=(0.5 * height, height + 0.05), finish=linen),
    ]
    pillows = 2 if width > 1.3 else 1
    for k in range(pillows):
        x = (k - 0.5 * (pillows - 1)) * width / pillows
        parts.append(box(at=(x, -hy + 0.3), half=(0.3, 0.2), z=(height, height + 0.12), finish="white"))
    if rng.random() < 0.7:
        parts.append(box(at=(0.0, -hy + 0.03), half=(hx, 0.03), z=(0.0, rng.uniform(0.8, 1.3)), finish="wood"))
    return Piece(width, depth, tuple(parts))


def sofa(rng: np.random.Generator) -> Piece:
    """Return a sofa with seat, back, arms and cushions; an armchair when narrow."""
    width, depth = rng.uniform(0.75, 2.6), rng.uniform(0.8, 1.0)
    hx, hy, seat, back = 0.5 * width, 0.5 * depth, rng.uniform(0.38, 0.46), rng.uniform(0.7, 0.95)
    parts = [
        box(at=(0.0, 0.08), half=(hx, hy - 0.08), z=(0.06, seat), finish="fabric"),
        box(at=(0.0, -hy + 0.12), half=(hx, 0.12), z=(0.06, back), finish="fabric"),
        box(at=(-hx + 0.09, 0.0), half=(0.09, hy), z=(0.06, seat + 0.18), finish="fabric"),
        box(at=(hx - 0.09, 0.0), half=(0.09, hy), z=(0.06, seat + 0.18), finish="fabric"),
    ]
    for x in np.arange(-hx + 0.4, hx - 0.3, 0.7):
        if rng.random() < 0.5:
            parts.append(box(at=(float(x), -0.1), half=(0.22, 0.08), z=(seat, seat + 0.35), finish="accent"))
    return Piece(width, depth, tuple(parts), against_wall=bool(rng.random() < 0.8))


def _chair_parts(x: float, y: float, facing: int, finish: Finish) -> list[Part]:
    legs = [part._replace(x=part.x + x, y=part.y + y) for part in square_legs(0.21, 0.21, 0.04, 0.44, "wood")]
    seat = box(at=(x, y), half=(0.22, 0.22), z=(0.43, 0.48), finish=finish)
    back = box(at=(x, y + facing * 0.2), half=(0.21, 0.02), z=(0.48, 0.92), finish=finish)
    return [*legs, seat, back]


def dining_table(rng: np.random.Generator) -> Piece:
    """Return a table with chairs on its two long sides."""
    width, depth, height = rng.uniform(0.8, 2.2), rng.uniform(0.75, 1.0), rng.uniform(0.72, 0.78)
    hx, hy = 0.5 * width, 0.5 * depth
    if rng.random() < 0.25:
        parts = [
            cylinder(at=(0.0, 0.0), half=(hx, hy), z=(height - 0.04, height), finish="wood"),
            cylinder(at=(0.0, 0.0), half=(0.06, 0.06), z=(0.0, height - 0.04), finish="metal"),
        ]
    else:
        parts = [
            box(at=(0.0, 0.0), half=(hx, hy), z=(height - 0.04, height), finish="wood"),
            *square_legs(hx, hy, 0.07, height - 0.04, "wood"),
        ]
    reach = rng.uniform(0.0, 0.3)
    finish: Finish = "wood" if rng.random() < 0.5 else "accent"
    for x in np.arange(-hx + 0.35, hx - 0.2, 0.65):
        for side in (-1, 1):
            if rng.random() < 0.85:
                parts += _chair_parts(float(x), side * (hy + reach - 0.1), side, finish)
    if rng.random() < 0.5:
        x, top = rng.uniform(-0.3, 0.3), height + rng.uniform(0.1, 0.35)
        parts.append(cylinder(at=(x, 0.0), half=(0.08, 0.08), z=(height, top), finish="accent"))
    return Piece(width + 0.1, depth + 2 * reach + 0.3, tuple(parts), against_wall=False)


def low_table(rng: np.random.Generator) -> Piece:
    """Return a coffee table, round or on four legs, sometimes with an object on it."""
    width, depth, height = rng.uniform(0.5, 1.3), rng.uniform(0.45, 0.7), rng.uniform(0.32, 0.5)
    hx, hy, is_round = 0.5 * width, 0.5 * depth, bool(rng.random() < 0.3)
    top = (cylinder if is_round else box)(at=(0.0, 0.0), half=(hx, hy), z=(height - 0.04, height), finish="wood")
    legs = (
        [cylinder(at=(0.0, 0.0), half=(0.15, 0.15), z=(0.0, height - 0.04), finish="metal")]
        if is_round
        else square_legs(hx, hy, 0.05, height, "wood")
    )
    x, thing_top = rng.uniform(-0.15, 0.15), height + rng.uniform(0.02, 0.2)
    thing = box(at=(x, 0.0), half=(0.12, 0.08), z=(height, thing_top), finish="accent")
    return Piece(width, depth, (top, *legs, thing), against_wall=False)


def desk(rng: np.random.Generator) -> Piece:
    """Return a desk with a screen and a chair."""
    width, depth, height = rng.uniform(0.9, 1.8), rng.uniform(0.55, 0.8), rng.uniform(0.7, 0.78)
    hx, hy = 0.5 * width, 0.5 * depth
    back = 0.25
    parts = [
        box(at=(0.0, -back), half=(hx, hy), z=(height - 0.03, height), finish="wood"),
        *(leg._replace(y=leg.y - back) for leg in square_legs(hx, hy, 0.05, height, "metal")),
        box(at=(0.0, -hy - back + 0.2), half=(0.28, 0.015), z=(height + 0.1, height + 0.45), finish="dark"),
        box(at=(0.0, -hy - back + 0.2), half=(0.04, 0.04), z=(height, height + 0.12), finish="dark"),
        *_chair_parts(rng.uniform(-0.2, 0.2), hy - back + 0.1, 1, "dark"),
    ]
    if rng.random() < 0.5:
        parts.append(box(at=(hx - 0.22, -back), half=(0.2, hy - 0.05), z=(0.0, height - 0.03), finish="wood"))
    return Piece(width, depth + 2 * back, tuple(parts))


def wardrobe(rng: np.random.Generator) -> Piece:
    """Return a tall box with doors and handles, sometimes up to the ceiling."""
    width = int(rng.integers(1, 6)) * rng.uniform(0.45, 0.62)
    return wardrobe_run(rng, width, rng.uniform(1.7, 2.6))


def wardrobe_run(rng: np.random.Generator, width: float, height: float) -> Piece:
    """Return a wardrobe of a width and height (m); its doors have handles unless they slide."""
    doors = max(1, round(width / rng.uniform(0.45, 0.62)))
    depth, body = rng.uniform(0.35, 0.65), cast(Finish, "white" if rng.random() < 0.5 else "wood")
    has_handles, front = rng.random() < 0.75, 0.5 * depth
    parts = [box(at=(0.0, -0.01), half=(0.5 * width, front - 0.01), z=(0.0, height), finish=body)]
    pitch = width / doors
    for k in range(doors):
        x = -0.5 * width + (k + 0.5) * pitch
        parts.append(box(at=(x, front - 0.01), half=(0.5 * pitch - 0.008, 0.01), z=(0.06, height - 0.03), finish=body))
        if has_handles:
            handle = x + (1 if k % 2 == 0 else -1) * (0.5 * pitch - 0.06), front + 0.015
            parts.append(box(at=handle, half=(0.01, 0.012), z=(0.95, 1.15), finish="metal"))
    return Piece(width, depth, tuple(parts))


def shelf_run(rng: np.random.Generator, width: float, depth: float, height: float) -> Piece:
    """Return open bays of a width, depth and height (m): boards with boxes, or a rail with clothes."""
    bays, hy = max(1, round(width / rng.uniform(0.6, 1.1))), 0.5 * depth
    body = cast(Finish, "white" if rng.random() < 0.7 else "wood")
    half = 0.5 * width / bays
    parts = [box(at=(0.0, 0.0), half=(0.5 * width, hy), z=(height - 0.025, height), finish=body)]
    for bay in range(bays):
        x = -0.5 * width + (2 * bay + 1) * half
        parts.append(box(at=(x - half + 0.01, 0.0), half=(0.01, hy), z=(0.0, height), finish=body))
        has_rail = rng.random() < 0.5
        levels = [rng.uniform(1.5, height - 0.15)] if has_rail else np.arange(0.1, height - 0.3, rng.uniform(0.3, 0.5))
        for level in levels:
            stuff = cast(Finish, ("fabric", "accent", "dark", "paint", "white")[int(rng.integers(5))])
            span = half * rng.uniform(0.3, 0.9)
            if has_rail:
                hem = rng.uniform(0.3, 1.0)
                parts.append(box(at=(x, 0.0), half=(span, 0.8 * hy), z=(hem, level), finish=stuff))
                continue
            parts.append(box(at=(x, 0.0), half=(half, hy), z=(level, level + 0.025), finish=body))
            if rng.random() < 0.7:
                top = level + rng.uniform(0.08, 0.28)
                parts.append(box(at=(x, 0.0), half=(span, 0.8 * hy), z=(level + 0.025, top), finish=stuff))
    return Piece(width, depth, tuple(parts))


def bookcase(rng: np.random.Generator) -> Piece:
    """Return uprights, boards and books."""
    width, depth, height = rng.uniform(0.6, 1.8), rng.uniform(0.25, 0.4), rng.uniform(0.8, 2.3)
    hx, hy = 0.5 * width, 0.5 * depth
    parts = [box(at=(0.0, -hy + 0.01), half=(hx, 0.01), z=(0.0, height), finish="wood")]
    parts += [box(at=(sign * (hx - 0.015), 0.0), half=(0.015, hy), z=(0.0, height), finish="wood") for sign in (-1, 1)]
    levels = max(2, round(height / 0.38))
    for k in range(levels + 1):
        z = 0.05 + k * (height - 0.08) / levels
        parts.append(box(at=(0.0, 0.0), half=(hx - 0.02, hy), z=(z, z + 0.025), finish="wood"))
        if k < levels and rng.random() < 0.8:
            span = rng.uniform(0.3, 0.95) * (hx - 0.04)
            x = rng.uniform(-1, 1) * (hx - 0.04 - span)
            top = z + 0.025 + rng.uniform(0.4, 0.8) * (height / levels - 0.03)
            books: Finish = ("accent", "dark", "fabric", "paint")[k % 4]
            parts.append(box(at=(x, -0.03), half=(span, hy - 0.05), z=(z + 0.025, top), finish=books))
    return Piece(width, depth, tuple(parts))


def sideboard(rng: np.random.Generator) -> Piece:
    """Return a low cabinet or chest of drawers, often under a television."""
    width, depth, height = rng.uniform(0.5, 2.2), rng.uniform(0.35, 0.5), rng.uniform(0.35, 1.0)
    hy = 0.5 * depth
    finish: Finish = "white" if rng.random() < 0.4 else "wood"
    parts = [box(at=(0.0, -0.01), half=(0.5 * width, hy - 0.01), z=(0.0, height), finish=finish)]
    drawers = int(rng.integers(1, 4))
    for k in range(drawers):
        z0, z1 = 0.04 + k * (height - 0.06) / drawers, 0.02 + (k + 1) * (height - 0.06) / drawers
        parts.append(box(at=(0.0, hy - 0.01), half=(0.5 * width - 0.015, 0.01), z=(z0, z1), finish=finish))
        middle = 0.5 * (z0 + z1)
        parts.append(box(at=(0.0, hy + 0.01), half=(0.06, 0.01), z=(middle, middle + 0.02), finish="metal"))
    if height < 0.75 and rng.random() < 0.6:
        half, bottom = min(rng.uniform(0.35, 0.7), 0.5 * width + 0.05), height + 0.06
        parts.append(box(at=(0.0, -hy + 0.1), half=(half, 0.02), z=(bottom, bottom + 1.15 * half), finish="dark"))
    elif rng.random() < 0.7:
        x, top = rng.uniform(-0.3, 0.3) * width, height + rng.uniform(0.1, 0.45)
        parts.append(cylinder(at=(x, 0.0), half=(0.08, 0.08), z=(height, top), finish="accent"))
    return Piece(width, depth, tuple(parts))


def nightstand(rng: np.random.Generator) -> Piece:
    """Return a small chest with a lamp."""
    width, height = rng.uniform(0.35, 0.55), rng.uniform(0.4, 0.6)
    half = 0.5 * width
    parts = (
        box(at=(0.0, 0.0), half=(half, 0.2), z=(0.0, height), finish="wood"),
        box(at=(0.0, 0.2), half=(half - 0.02, 0.01), z=(0.1, height - 0.04), finish="wood"),
        cylinder(at=(0.0, 0.0), half=(0.03, 0.03), z=(height, height + 0.2), finish="metal"),
        cylinder(at=(0.0, 0.0), half=(0.13, 0.13), z=(height + 0.2, height + 0.42), finish="glow"),
    )
    return Piece(width, 0.42, parts)


def plant(rng: np.random.Generator) -> Piece:
    """Return a pot and a few leafy blobs."""
    pot, height = rng.uniform(0.1, 0.22), rng.uniform(0.5, 1.9)
    parts = [
        cylinder(at=(0.0, 0.0), half=(pot, pot), z=(0.0, 1.6 * pot), finish="accent"),
        cylinder(at=(0.0, 0.0), half=(0.02, 0.02), z=(1.6 * pot, height - 0.1), finish="wood"),
    ]
    for _ in range(int(rng.integers(3, 7))):
        x, y = rng.uniform(-0.8 * pot, 0.8 * pot, 2).tolist()
        z, radius = rng.uniform(0.35, 1.0) * height, rng.uniform(0.4, 1.0) * pot
        parts.append(cylinder(at=(x, y), half=(radius, 0.7 * radius), z=(z - 0.12, z + 0.06), finish="leaf"))
    return Piece(3.6 * pot, 3.2 * pot, tuple(parts))


def floor_lamp(rng: np.random.Generator) -> Piece:
    """Return a lamp with foot, pole and shade."""
    height, radius = rng.uniform(1.3, 1.8), rng.uniform(0.12, 0.25)
    parts = (
        cylinder(at=(0.0, 0.0), half=(0.14, 0.14), z=(0.0, 0.03), finish="dark"),
        cylinder(at=(0.0, 0.0), half=(0.012, 0.012), z=(0.03, height), finish="metal"),
        cylinder(at=(0.0, 0.0), half=(radius, radius), z=(height - 0.25, height), finish="glow"),
    )
    return Piece(2 * radius, 2 * radius, parts)


def carton(rng: np.random.Generator) -> Piece:
    """Return clutter: boxes, bags and appliances."""
    width, depth, height = rng.uniform(0.2, 0.8, 3)
    finish: Finish = ("wood", "accent", "fabric", "dark", "white", "metal")[int(rng.integers(6))]
    shape = cylinder if rng.random() < 0.2 else box
    parts = [shape(at=(0.0, 0.0), half=(0.5 * width, 0.5 * depth), z=(0.0, height), finish=finish)]
    if rng.random() < 0.4:
        top = height + rng.uniform(0.1, 0.4)
        parts.append(box(at=(0.0, 0.0), half=(0.3 * width, 0.35 * depth), z=(height, top), finish="accent"))
    return Piece(width, depth, tuple(parts), against_wall=bool(rng.random() < 0.7))


def bench(rng: np.random.Generator) -> Piece:
    """Return a bench or a shoe rack under a row of hooks."""
    width = rng.uniform(0.6, 1.4)
    hx = 0.5 * width
    parts = (
        box(at=(0.0, 0.0), half=(hx, 0.17), z=(0.4, 0.45), finish="wood"),
        *square_legs(hx, 0.17, 0.05, 0.4, "wood"),
        box(at=(0.0, -0.16), half=(hx, 0.01), z=(1.6, 1.7), finish="wood"),
        box(at=(rng.uniform(-0.5, 0.5) * hx, -0.1), half=(0.2, 0.07), z=(0.9, 1.65), finish="fabric"),
    )
    return Piece(width, 0.36, parts)


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


# Pieces of each kind of room, most characteristic first, with their probabilities.
ROOM_PIECES: dict[str, tuple[tuple[Maker, float], ...]] = {
    "living": (
        *((sofa, 0.95), (sideboard, 0.8), (low_table, 0.8), (dining_table, 0.5), (bookcase, 0.6), (sofa, 0.5)),
        *((island, 0.25), (counter, 0.25), (floor_lamp, 0.5), (plant, 0.6), (sofa, 0.3), (plant, 0.3), (desk, 0.2)),
        *((wardrobe, 0.15), (carton, 0.4), (carton, 0.3), (sideboard, 0.3)),
    ),
    "bedroom": (
        *((bed, 0.95), (wardrobe, 0.85), (nightstand, 0.7), (nightstand, 0.4), (sideboard, 0.5), (desk, 0.35)),
        *((wardrobe, 0.25), (bookcase, 0.3), (plant, 0.3), (floor_lamp, 0.25), (carton, 0.4)),
        *((sofa, 0.15), (carton, 0.3)),
    ),
    "kitchen": (
        *((counter, 1.0), (counter, 0.75), (fridge, 0.8), (island, 0.45), (dining_table, 0.6), (counter, 0.3)),
        *((sideboard, 0.2), (carton, 0.5), (plant, 0.2), (carton, 0.3)),
    ),
    "dining": (
        *((dining_table, 1.0), (sideboard, 0.8), (bookcase, 0.3), (plant, 0.5), (floor_lamp, 0.3)),
        *((sofa, 0.2), (carton, 0.3)),
    ),
    "study": (
        *((desk, 0.95), (bookcase, 0.8), (bookcase, 0.5), (wardrobe, 0.3), (sofa, 0.4), (sideboard, 0.3)),
        *((plant, 0.3), (floor_lamp, 0.3), (carton, 0.5), (carton, 0.4)),
    ),
    "bathroom": (
        *((washbasin, 0.95), (toilet, 0.9), (bathtub, 0.5), (shower, 0.6), (wardrobe, 0.2)),
        *((carton, 0.5), (sideboard, 0.2)),
    ),
    "corridor": ((bench, 0.4), (sideboard, 0.4), (wardrobe, 0.35), (plant, 0.3), (bookcase, 0.2), (carton, 0.5)),
    "closet": ((wardrobe, 0.6), (bookcase, 0.7), (carton, 0.7), (carton, 0.6), (carton, 0.5), (carton, 0.4)),
}
ROOM_PIECES["storage"] = ROOM_PIECES["closet"]
