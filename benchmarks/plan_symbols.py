"""Symbols of fixtures and furniture, drawn in the ways of different programs.

A symbol is a list of lines in metres, with its back on the x axis and its front upwards.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry.base import BaseGeometry

Lines = list[Float[np.ndarray, "n 2"]]
# Kinds of fixtures; the other symbols are furniture.
FIXTURES = ("toilet", "bath", "bed", "stove", "stairs", "basin", "shower", "sink")
_GAP_M = 0.08


@dataclass(frozen=True, eq=False)
class Symbol:
    """Symbol placed in a room: its kind, its lines, and its outline, in metres."""

    kind: str
    lines: Lines
    outline: shapely.Polygon


def place_symbols(room: shapely.Polygon, taken: list[BaseGeometry], rng: np.random.Generator) -> list[Symbol]:
    """Return symbols along the walls of a room and in its middle, none over areas that are taken."""
    found = []
    kinds = [*rng.permutation(list(FIXTURES))[:4], *rng.permutation(list(_FURNITURE))[:3]]
    for kind in map(str, kinds):
        draw = _DRAWN.get(kind) or _FURNITURE[kind]
        width, depth, lines = draw(rng)
        if rng.random() < 0.5:
            lines = [line * (-1.0, 1.0) + (width, 0.0) for line in lines]
        for _ in range(12):
            placed = _placed(room, width, depth, rng, in_middle=kind in _IN_MIDDLE)
            if placed is None:
                continue
            origin, along, inward = placed
            frame = np.stack([along, inward])
            outline = shapely.Polygon(np.array([(0, 0), (width, 0), (width, depth), (0, depth)]) @ frame + origin)
            if room.buffer(0.005).contains(outline) and not any(outline.intersects(area) for area in taken):
                taken.append(outline.buffer(_GAP_M))
                found.append(Symbol(kind, [line @ frame + origin for line in lines], outline))
                break
    return found


def _placed(
    room: shapely.Polygon, width: float, depth: float, rng: np.random.Generator, *, in_middle: bool
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"], Float[np.ndarray, "2"]] | None:
    """Return the origin and the axes of a symbol at a wall of a room; `in_middle` moves it off the wall."""
    points = np.asarray(shapely.geometry.polygon.orient(room).exterior.coords)
    number = int(rng.integers(len(points) - 1))
    start, end = points[number : number + 2]
    length = math.dist(start, end)
    if length < width:
        return None
    along = (end - start) / length
    inward = np.array([-along[1], along[0]])
    off = float(rng.uniform(0.5, 1.5)) if in_middle else float(rng.choice([0.0, 0.02, 0.05]))
    # Many symbols stand in corners.
    place = float(rng.choice([0.0, length - width, rng.uniform(0.0, length - width)]))
    return start + along * place + inward * off, along, inward


def _box(x0: float, y0: float, x1: float, y1: float) -> Float[np.ndarray, "n 2"]:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)], float)


def _oval(x: float, y: float, a: float, b: float, first: float = 0.0, last: float = 360.0) -> Float[np.ndarray, "n 2"]:
    angles = np.radians(np.linspace(first, last, 49))
    return np.column_stack([x + a * np.cos(angles), y + b * np.sin(angles)])


def _round_box(x0: float, y0: float, x1: float, y1: float, radius: float) -> Float[np.ndarray, "n 2"]:
    shape = shapely.box(x0 + radius, y0 + radius, x1 - radius, y1 - radius).buffer(radius)
    return np.asarray(shape.exterior.coords)


Drawn = tuple[float, float, Lines]


def _toilet(rng: np.random.Generator) -> Drawn:
    width, tank = rng.uniform(0.36, 0.5), rng.uniform(0.14, 0.22)
    bowl, length = 0.5 * rng.uniform(0.32, 0.4), rng.uniform(0.4, 0.52)
    half, lines = 0.5 * width, [_box(0, 0, width, tank)]
    style = rng.integers(4)
    if style == 3:  # A bowl with a straight back.
        arc = _oval(half, tank + 0.5 * length, bowl, 0.5 * length, 0.0, 180.0)
        lines.append(np.concatenate([[(half + bowl, tank)], arc, [(half - bowl, tank), (half + bowl, tank)]]))
        return width, tank + length, lines
    gap = 0.0 if style else 0.03
    lines.append(_oval(half, tank + gap + 0.5 * length, bowl, 0.5 * length))
    if style == 2:
        lines.append(_oval(half, tank + gap + 0.5 * length, 0.7 * bowl, 0.36 * length))
    return width, tank + gap + length, lines


def _bath(rng: np.random.Generator) -> Drawn:
    length, width, rim = rng.uniform(1.5, 1.8), rng.uniform(0.7, 0.85), rng.uniform(0.05, 0.09)
    style = rng.integers(3)
    if style == 0:
        tub = _round_box(rim, rim, length - rim, width - rim, rng.uniform(0.1, 0.25))
    elif style == 1:  # Round at one end.
        end, half = length - rim - (0.5 * width - rim), 0.5 * width - rim
        arc = _oval(end, 0.5 * width, half, half, -90.0, 90.0)
        tub = np.concatenate([[(rim, rim)], arc, [(rim, width - rim), (rim, rim)]])
    else:
        tub = _oval(0.5 * length, 0.5 * width, 0.5 * length - rim, 0.5 * width - rim)
    lines = [_box(0, 0, length, width), tub]
    if rng.random() < 0.6:
        lines.append(_oval(rim + 0.2, 0.5 * width, 0.035, 0.035))
    return length, width, lines


def _bed(rng: np.random.Generator) -> Drawn:
    is_double = rng.random() < 0.6
    width, length = rng.uniform(1.4, 1.9) if is_double else rng.uniform(0.85, 1.05), rng.uniform(1.95, 2.15)
    lines, deep = [_box(0, 0, width, length)], rng.uniform(0.28, 0.42)
    for first, last in ((0.0, 0.5 * width), (0.5 * width, width)) if is_double else ((0.0, width),):
        side = rng.uniform(0.06, 0.1)
        corners = first + side, 0.08, last - side, 0.08 + deep
        lines.append(_box(*corners) if rng.random() < 0.5 else _round_box(*corners, 0.06))
    if rng.random() < 0.6:
        lines.append(np.array([(0.0, 0.65), (width, 0.65)]))
    if rng.random() < 0.3:
        lines.append(np.array([(0.0, 0.65), (0.4, 0.65), (0.0, 1.1)]))
    return width, length, lines


def _stove(rng: np.random.Generator) -> Drawn:
    width, depth = rng.uniform(0.55, 0.75), rng.uniform(0.5, 0.65)
    lines = [_box(0, 0, width, depth)]
    small, large = rng.uniform(0.06, 0.08), rng.uniform(0.08, 0.11)
    style = rng.integers(3)
    for number, (x, y) in enumerate(((0.28, 0.28), (0.72, 0.28), (0.28, 0.72), (0.72, 0.72))):
        radius = large if number in (0, 3) and style else small
        lines.append(_oval(x * width, y * depth, radius, radius))
        if style == 2:
            lines.append(_oval(x * width, y * depth, 0.5 * radius, 0.5 * radius))
    return width, depth, lines


def _stairs(rng: np.random.Generator) -> Drawn:
    width, tread, treads = rng.uniform(0.8, 1.1), rng.uniform(0.24, 0.3), int(rng.integers(8, 13))
    length = tread * treads
    lines = [_box(0, 0, length, width)]
    lines += [np.array([(tread * step, 0.0), (tread * step, width)]) for step in range(1, treads)]
    if rng.random() < 0.5:  # The direction, with its arrow.
        lines.append(np.array([(0.5 * tread, 0.5 * width), (length - 0.5 * tread, 0.5 * width)]))
    return length, width, lines


def _basin(rng: np.random.Generator) -> Drawn:
    width, depth = rng.uniform(0.5, 0.65), rng.uniform(0.4, 0.5)
    bowl = _oval(0.5 * width, 0.5 * depth, 0.38 * width, 0.34 * depth)
    return width, depth, [_box(0, 0, width, depth), bowl]


def _shower(rng: np.random.Generator) -> Drawn:
    side = rng.uniform(0.8, 1.0)
    lines = [_box(0, 0, side, side), _oval(0.5 * side, 0.5 * side, 0.05, 0.05)]
    if rng.random() < 0.5:
        lines += [np.array([(0.0, 0.0), (side, side)]), np.array([(0.0, side), (side, 0.0)])]
    return side, side, lines


def _sink(rng: np.random.Generator) -> Drawn:
    width, depth = rng.uniform(0.8, 1.1), rng.uniform(0.48, 0.6)
    lines = [_box(0, 0, width, depth), _round_box(0.06, 0.06, 0.48 * width, depth - 0.06, 0.05)]
    if rng.random() < 0.5:
        lines.append(_round_box(0.52 * width, 0.06, width - 0.06, depth - 0.06, 0.05))
    else:
        lines += [np.array([(x * width, 0.1), (x * width, depth - 0.1)]) for x in (0.6, 0.7, 0.8, 0.9)]
    return width, depth, lines


def _table(rng: np.random.Generator) -> Drawn:
    width, depth = rng.uniform(1.2, 2.0), rng.uniform(0.8, 1.0)
    lines = [_box(0, 0.4, width, 0.4 + depth)]
    for x in np.linspace(0.25, 0.75, 2 if width < 1.6 else 3) * width:
        for y in (0.0, depth + 0.42):
            chair = _box(x - 0.2, y, x + 0.2, y + 0.38) if rng.random() < 0.5 else _oval(x, y + 0.19, 0.19, 0.19)
            lines.append(chair)
    return width, depth + 0.8, lines


def _round_table(rng: np.random.Generator) -> Drawn:
    radius = rng.uniform(0.4, 0.6)
    size = 2.0 * radius + 0.9
    lines = [_oval(0.5 * size, 0.5 * size, radius, radius)]
    for angle in np.radians((45, 135, 225, 315)):
        x, y = 0.5 * size + (radius + 0.2) * np.array([np.cos(angle), np.sin(angle)])
        lines.append(_oval(x, y, 0.17, 0.17))
    return size, size, lines


def _sofa(rng: np.random.Generator) -> Drawn:
    width, depth, arm = rng.uniform(1.5, 2.2), rng.uniform(0.8, 0.95), rng.uniform(0.15, 0.22)
    lines, seats = [_box(0, 0, width, depth), _box(arm, 0.0, width - arm, 0.22)], int(rng.integers(1, 4))
    for number in range(seats):
        size = (width - 2.0 * arm) / seats
        corners = arm + number * size, 0.22, arm + (number + 1) * size, depth
        lines.append(_round_box(*corners, 0.07) if rng.random() < 0.6 else _box(*corners))
    return width, depth, lines


def _wardrobe(rng: np.random.Generator) -> Drawn:
    width, depth = rng.uniform(1.2, 2.4), rng.uniform(0.55, 0.65)
    lines = [_box(0, 0, width, depth)]
    if rng.random() < 0.4:
        lines += [np.array([(0.0, 0.0), (width, depth)]), np.array([(0.0, depth), (width, 0.0)])]
    else:
        lines.append(np.array([(0.0, 0.5 * depth), (width, 0.5 * depth)]))
        lines += [np.array([(x, 0.1), (x + 0.04, depth - 0.1)]) for x in np.arange(0.15, width - 0.1, 0.14)]
    return width, depth, lines


def _washer(rng: np.random.Generator) -> Drawn:
    side = rng.uniform(0.58, 0.62)
    return side, side, [_box(0, 0, side, side), _oval(0.5 * side, 0.5 * side, 0.2, 0.2)]


def _rug(rng: np.random.Generator) -> Drawn:
    width, depth = rng.uniform(1.4, 2.2), rng.uniform(0.8, 1.5)
    inner = _round_box if rng.random() < 0.3 else lambda *corners: _box(*corners[:4])
    return width, depth, [_box(0, 0, width, depth), inner(0.1, 0.1, width - 0.1, depth - 0.1, 0.1)]


def _desk(rng: np.random.Generator) -> Drawn:
    width, depth = rng.uniform(1.2, 1.8), rng.uniform(0.6, 0.8)
    screen = _box(0.3 * width, 0.1, 0.7 * width, 0.25)
    return width, depth + 0.4, [_box(0, 0, width, depth), screen, _oval(0.5 * width, depth + 0.15, 0.22, 0.22)]


def _plant(rng: np.random.Generator) -> Drawn:
    radius = rng.uniform(0.15, 0.3)
    spokes = [np.array([(0.0, 0.0), (np.cos(a), np.sin(a))]) * radius + radius for a in np.arange(0, 6.2, 0.8)]
    return 2 * radius, 2 * radius, [_oval(radius, radius, radius, radius), *spokes]


def _shelf(rng: np.random.Generator) -> Drawn:
    width, depth, parts = rng.uniform(1.0, 2.4), rng.uniform(0.28, 0.4), int(rng.integers(3, 7))
    lines = [_box(0, 0, width, depth)]
    lines += [np.array([(width * k / parts, 0.0), (width * k / parts, depth)]) for k in range(1, parts)]
    return width, depth, lines


def _piano(rng: np.random.Generator) -> Drawn:
    width, depth = rng.uniform(1.4, 1.55), rng.uniform(0.55, 0.7)
    keys = [np.array([(x, depth - 0.2), (x, depth)]) for x in np.arange(0.1, width, 0.08)]
    return width, depth, [_box(0, 0, width, depth), np.array([(0.0, depth - 0.2), (width, depth - 0.2)]), *keys]


_DRAWN: Mapping[str, Callable[[np.random.Generator], Drawn]] = {
    "toilet": _toilet, "bath": _bath, "bed": _bed, "stove": _stove, "stairs": _stairs, "basin": _basin,
    "shower": _shower, "sink": _sink,
}  # fmt: skip
_FURNITURE: Mapping[str, Callable[[np.random.Generator], Drawn]] = {
    "table": _table, "round table": _round_table, "sofa": _sofa, "wardrobe": _wardrobe, "washer": _washer, "rug": _rug,
    "desk": _desk, "plant": _plant, "shelf": _shelf, "piano": _piano,
}  # fmt: skip
_IN_MIDDLE = ("table", "round table", "rug")
