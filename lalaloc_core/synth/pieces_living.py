"""Furniture to sit, lie, eat and work at, and to keep things in; see `pieces` for the frame."""

from __future__ import annotations

from typing import cast

import numpy as np

from lalaloc_core.synth.pieces import Finish, Part, Piece, square_legs


def bed(rng: np.random.Generator) -> Piece:
    """Frame, mattress, duvet, pillows and usually a headboard."""
    width, depth, height = rng.uniform(0.9, 1.9), rng.uniform(1.95, 2.15), rng.uniform(0.35, 0.6)
    hx, hy = 0.5 * width, 0.5 * depth
    linen: Finish = "white" if rng.random() < 0.6 else "fabric"
    parts = [
        Part(0, 0, hx, hy, 0.08, 0.6 * height, "wood"),
        Part(0, 0.02, hx - 0.03, hy - 0.03, 0.6 * height, height, "white"),
        Part(0, 0.2 * depth, hx, 0.3 * depth, 0.5 * height, height + 0.05, linen),
    ]
    pillows = 2 if width > 1.3 else 1
    for k in range(pillows):
        x = (k - 0.5 * (pillows - 1)) * width / pillows
        parts.append(Part(x, -hy + 0.3, 0.3, 0.2, height, height + 0.12, "white"))
    if rng.random() < 0.7:
        parts.append(Part(0, -hy + 0.03, hx, 0.03, 0.0, rng.uniform(0.8, 1.3), "wood"))
    return Piece(width, depth, tuple(parts))


def sofa(rng: np.random.Generator) -> Piece:
    """Seat, back, arms and cushions; an armchair when narrow."""
    width, depth = rng.uniform(0.75, 2.6), rng.uniform(0.8, 1.0)
    hx, hy, seat, back = 0.5 * width, 0.5 * depth, rng.uniform(0.38, 0.46), rng.uniform(0.7, 0.95)
    parts = [
        Part(0, 0.08, hx, hy - 0.08, 0.06, seat, "fabric"),
        Part(0, -hy + 0.12, hx, 0.12, 0.06, back, "fabric"),
        Part(-hx + 0.09, 0, 0.09, hy, 0.06, seat + 0.18, "fabric"),
        Part(hx - 0.09, 0, 0.09, hy, 0.06, seat + 0.18, "fabric"),
    ]
    for x in np.arange(-hx + 0.4, hx - 0.3, 0.7):
        if rng.random() < 0.5:
            parts.append(Part(float(x), -0.1, 0.22, 0.08, seat, seat + 0.35, "accent"))
    return Piece(width, depth, tuple(parts), against_wall=bool(rng.random() < 0.8))


def _chair_parts(x: float, y: float, facing: int, finish: Finish) -> list[Part]:
    """A chair at (x, y) whose back stands on the side of `facing` (+1 or -1 along y)."""
    legs = [part._replace(x=part.x + x, y=part.y + y) for part in square_legs(0.21, 0.21, 0.04, 0.44, "wood")]
    seat = Part(x, y, 0.22, 0.22, 0.43, 0.48, finish)
    back = Part(x, y + facing * 0.2, 0.21, 0.02, 0.48, 0.92, finish)
    return [*legs, seat, back]


def dining_table(rng: np.random.Generator) -> Piece:
    """A table with chairs on its two long sides."""
    width, depth, height = rng.uniform(0.8, 2.2), rng.uniform(0.75, 1.0), rng.uniform(0.72, 0.78)
    hx, hy = 0.5 * width, 0.5 * depth
    if rng.random() < 0.25:
        parts = [
            Part(0, 0, hx, hy, height - 0.04, height, "wood", True),
            Part(0, 0, 0.06, 0.06, 0.0, height - 0.04, "metal", True),
        ]
    else:
        parts = [Part(0, 0, hx, hy, height - 0.04, height, "wood"), *square_legs(hx, hy, 0.07, height - 0.04, "wood")]
    reach = rng.uniform(0.0, 0.3)
    finish: Finish = "wood" if rng.random() < 0.5 else "accent"
    for x in np.arange(-hx + 0.35, hx - 0.2, 0.65):
        for side in (-1, 1):
            if rng.random() < 0.85:
                parts += _chair_parts(float(x), side * (hy + reach - 0.1), side, finish)
    if rng.random() < 0.5:
        parts.append(
            Part(rng.uniform(-0.3, 0.3), 0.0, 0.08, 0.08, height, height + rng.uniform(0.1, 0.35), "accent", True)
        )
    return Piece(width + 0.1, depth + 2 * reach + 0.3, tuple(parts), against_wall=False)


def low_table(rng: np.random.Generator) -> Piece:
    """A coffee table, round or on four legs, sometimes with something on it."""
    width, depth, height = rng.uniform(0.5, 1.3), rng.uniform(0.45, 0.7), rng.uniform(0.32, 0.5)
    hx, hy, is_round = 0.5 * width, 0.5 * depth, bool(rng.random() < 0.3)
    top = Part(0, 0, hx, hy, height - 0.04, height, "wood", is_round)
    legs = (
        [Part(0, 0, 0.15, 0.15, 0, height - 0.04, "metal", True)]
        if is_round
        else square_legs(hx, hy, 0.05, height, "wood")
    )
    thing = Part(rng.uniform(-0.15, 0.15), 0, 0.12, 0.08, height, height + rng.uniform(0.02, 0.2), "accent")
    return Piece(width, depth, (top, *legs, thing), against_wall=False)


def desk(rng: np.random.Generator) -> Piece:
    """A desk with a screen, and a chair before it."""
    width, depth, height = rng.uniform(0.9, 1.8), rng.uniform(0.55, 0.8), rng.uniform(0.7, 0.78)
    hx, hy = 0.5 * width, 0.5 * depth
    back = 0.25
    parts = [
        Part(0, -back, hx, hy, height - 0.03, height, "wood"),
        *(leg._replace(y=leg.y - back) for leg in square_legs(hx, hy, 0.05, height, "metal")),
        Part(0, -hy - back + 0.2, 0.28, 0.015, height + 0.1, height + 0.45, "dark"),
        Part(0, -hy - back + 0.2, 0.04, 0.04, height, height + 0.12, "dark"),
        *_chair_parts(rng.uniform(-0.2, 0.2), hy - back + 0.1, 1, "dark"),
    ]
    if rng.random() < 0.5:
        parts.append(Part(hx - 0.22, -back, 0.2, hy - 0.05, 0.0, height - 0.03, "wood"))
    return Piece(width, depth + 2 * back, tuple(parts))


def wardrobe(rng: np.random.Generator) -> Piece:
    """A tall box with doors and handles, as high as the ceiling at times."""
    width = int(rng.integers(1, 6)) * rng.uniform(0.45, 0.62)
    return wardrobe_run(rng, width, rng.uniform(1.7, 2.6))


def wardrobe_run(rng: np.random.Generator, width: float, height: float) -> Piece:
    """A wardrobe as wide and high (m) as asked for; its doors have handles unless they are sliding ones."""
    doors = max(1, round(width / rng.uniform(0.45, 0.62)))
    depth, body = rng.uniform(0.35, 0.65), cast(Finish, "white" if rng.random() < 0.5 else "wood")
    has_handles, front = rng.random() < 0.75, 0.5 * depth
    parts = [Part(0, -0.01, 0.5 * width, front - 0.01, 0.0, height, body)]
    pitch = width / doors
    for k in range(doors):
        x = -0.5 * width + (k + 0.5) * pitch
        parts.append(Part(x, front - 0.01, 0.5 * pitch - 0.008, 0.01, 0.06, height - 0.03, body))
        side = 1 if k % 2 == 0 else -1
        if has_handles:
            parts.append(Part(x + side * (0.5 * pitch - 0.06), front + 0.015, 0.01, 0.012, 0.95, 1.15, "metal"))
    return Piece(width, depth, tuple(parts))


def bookcase(rng: np.random.Generator) -> Piece:
    """Uprights, boards and books."""
    width, depth, height = rng.uniform(0.6, 1.8), rng.uniform(0.25, 0.4), rng.uniform(0.8, 2.3)
    hx, hy = 0.5 * width, 0.5 * depth
    parts = [Part(0, -hy + 0.01, hx, 0.01, 0.0, height, "wood")]
    parts += [Part(sign * (hx - 0.015), 0, 0.015, hy, 0.0, height, "wood") for sign in (-1, 1)]
    levels = max(2, round(height / 0.38))
    for k in range(levels + 1):
        z = 0.05 + k * (height - 0.08) / levels
        parts.append(Part(0, 0, hx - 0.02, hy, z, z + 0.025, "wood"))
        if k < levels and rng.random() < 0.8:
            span = rng.uniform(0.3, 0.95) * (hx - 0.04)
            x = rng.uniform(-1, 1) * (hx - 0.04 - span)
            top = z + 0.025 + rng.uniform(0.4, 0.8) * (height / levels - 0.03)
            parts.append(Part(x, -0.03, span, hy - 0.05, z + 0.025, top, ("accent", "dark", "fabric", "paint")[k % 4]))
    return Piece(width, depth, tuple(parts))


def sideboard(rng: np.random.Generator) -> Piece:
    """A low cabinet or chest of drawers, often under a television."""
    width, depth, height = rng.uniform(0.5, 2.2), rng.uniform(0.35, 0.5), rng.uniform(0.35, 1.0)
    hy = 0.5 * depth
    finish: Finish = "white" if rng.random() < 0.4 else "wood"
    parts = [Part(0, -0.01, 0.5 * width, hy - 0.01, 0.0, height, finish)]
    drawers = int(rng.integers(1, 4))
    for k in range(drawers):
        z0, z1 = 0.04 + k * (height - 0.06) / drawers, 0.02 + (k + 1) * (height - 0.06) / drawers
        parts.append(Part(0, hy - 0.01, 0.5 * width - 0.015, 0.01, z0, z1, finish))
        parts.append(Part(0, hy + 0.01, 0.06, 0.01, 0.5 * (z0 + z1), 0.5 * (z0 + z1) + 0.02, "metal"))
    if height < 0.75 and rng.random() < 0.6:
        half = min(rng.uniform(0.35, 0.7), 0.5 * width + 0.05)
        parts.append(Part(0, -hy + 0.1, half, 0.02, height + 0.06, height + 0.06 + 1.15 * half, "dark"))
    elif rng.random() < 0.7:
        x = rng.uniform(-0.3, 0.3) * width
        parts.append(Part(x, 0, 0.08, 0.08, height, height + rng.uniform(0.1, 0.45), "accent", True))
    return Piece(width, depth, tuple(parts))


def nightstand(rng: np.random.Generator) -> Piece:
    """A small chest with a lamp."""
    width, height = rng.uniform(0.35, 0.55), rng.uniform(0.4, 0.6)
    half = 0.5 * width
    parts = (
        Part(0, 0, half, 0.2, 0.0, height, "wood"),
        Part(0, 0.2, half - 0.02, 0.01, 0.1, height - 0.04, "wood"),
        Part(0, 0, 0.03, 0.03, height, height + 0.2, "metal", True),
        Part(0, 0, 0.13, 0.13, height + 0.2, height + 0.42, "glow", True),
    )
    return Piece(width, 0.42, parts)


def plant(rng: np.random.Generator) -> Piece:
    """A pot and a few leafy blobs."""
    pot, height = rng.uniform(0.1, 0.22), rng.uniform(0.5, 1.9)
    parts = [
        Part(0, 0, pot, pot, 0.0, 1.6 * pot, "accent", True),
        Part(0, 0, 0.02, 0.02, 1.6 * pot, height - 0.1, "wood", True),
    ]
    for _ in range(int(rng.integers(3, 7))):
        x, y = rng.uniform(-0.8 * pot, 0.8 * pot, 2)
        z, radius = rng.uniform(0.35, 1.0) * height, rng.uniform(0.4, 1.0) * pot
        parts.append(Part(float(x), float(y), radius, 0.7 * radius, z - 0.12, z + 0.06, "leaf", True))
    return Piece(3.6 * pot, 3.2 * pot, tuple(parts))


def floor_lamp(rng: np.random.Generator) -> Piece:
    """Foot, pole and shade."""
    height, radius = rng.uniform(1.3, 1.8), rng.uniform(0.12, 0.25)
    parts = (
        Part(0, 0, 0.14, 0.14, 0.0, 0.03, "dark", True),
        Part(0, 0, 0.012, 0.012, 0.03, height, "metal", True),
        Part(0, 0, radius, radius, height - 0.25, height, "glow", True),
    )
    return Piece(2 * radius, 2 * radius, parts)


def carton(rng: np.random.Generator) -> Piece:
    """Boxes, bags and appliances: clutter without a name."""
    width, depth, height = rng.uniform(0.2, 0.8, 3)
    finish: Finish = ("wood", "accent", "fabric", "dark", "white", "metal")[int(rng.integers(6))]
    parts = [Part(0, 0, 0.5 * width, 0.5 * depth, 0.0, height, finish, bool(rng.random() < 0.2))]
    if rng.random() < 0.4:
        parts.append(Part(0, 0, 0.3 * width, 0.35 * depth, height, height + rng.uniform(0.1, 0.4), "accent"))
    return Piece(width, depth, tuple(parts), against_wall=bool(rng.random() < 0.7))


def bench(rng: np.random.Generator) -> Piece:
    """A bench or a shoe rack under a row of hooks."""
    width = rng.uniform(0.6, 1.4)
    hx = 0.5 * width
    parts = (
        Part(0, 0, hx, 0.17, 0.4, 0.45, "wood"),
        *square_legs(hx, 0.17, 0.05, 0.4, "wood"),
        Part(0, -0.16, hx, 0.01, 1.6, 1.7, "wood"),
        Part(rng.uniform(-0.5, 0.5) * hx, -0.1, 0.2, 0.07, 0.9, 1.65, "fabric"),
    )
    return Piece(width, 0.36, parts)
