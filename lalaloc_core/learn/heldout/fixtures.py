"""Furniture for storage, cooking and washing, plants, lamps and hangings. The local frame is that of `seats`."""

from __future__ import annotations

import numpy as np
import shapely
from shapely import affinity

from lalaloc_core.learn.heldout.geometry import (
    Part,
    blob,
    crumpled,
    disc,
    folded_sheet,
    lathe,
    rounded,
    section,
    slab,
    tube,
)
from lalaloc_core.learn.heldout.seats import Piece, chair_parts, vase


def _wood(rng: np.random.Generator) -> str:
    return str(rng.choice(["wood a", "wood b", "white"]))


def bookcase(rng: np.random.Generator) -> Piece:
    """Return shelves with books of many heights, some leaning, and a few vases."""
    width, height, depth, wood = rng.uniform(0.6, 1.8), rng.uniform(0.9, 2.2), rng.uniform(0.24, 0.36), _wood(rng)
    parts = [
        slab(wood, shapely.box(x - 0.012, 0, x + 0.012, depth), 0, height)
        for x in (-width / 2 + 0.012, width / 2 - 0.012)
    ]
    if rng.random() < 0.6:
        parts.append(slab(wood, shapely.box(-width / 2, 0, width / 2, 0.01), 0, height))
    levels = np.linspace(0.05, height - 0.02, max(2, round(height / rng.uniform(0.3, 0.42))))
    for k, z in enumerate(levels):
        parts.append(slab(wood, shapely.box(-width / 2, 0, width / 2, depth), z, z + 0.02))
        if k + 1 < len(levels):
            parts += _books(width, depth, z + 0.02, levels[k + 1] - z - 0.05, rng)
    return Piece(tuple(parts), shapely.box(-width / 2, 0, width / 2, depth))


def _books(width: float, depth: float, low: float, room: float, rng: np.random.Generator) -> list[Part]:
    if rng.random() < 0.2:
        return [vase(rng).scaled(0.8, 0.8, min(1.0, room / 0.42)).moved(rng.uniform(-0.3, 0.3) * width, depth / 2, low)]
    x, end, books = -width / 2 + 0.03, width / 2 * rng.uniform(0.2, 0.95), []
    while x < end - 0.06:
        thick, high = rng.uniform(0.02, 0.06), room * rng.uniform(0.6, 0.98)
        cover = str(rng.choice(["fabric a", "fabric b", "fabric c", "accent", "white", "dark"]))
        book = slab(cover, shapely.box(0, 0.02, thick, depth * rng.uniform(0.65, 0.9)), 0, high)
        lean = rng.uniform(0.05, 0.12) if rng.random() < 0.08 else 0.0
        books.append(book.turned(lean, 1).moved(x, 0, low))
        x += thick + 0.12 * (lean > 0) + 0.004
    return books


def wardrobe(rng: np.random.Generator) -> Piece:
    """Return a tall cupboard with a bowed front and door gaps."""
    width, depth, height, wood = rng.uniform(0.8, 2.4), rng.uniform(0.5, 0.64), rng.uniform(1.8, 2.3), _wood(rng)
    body = rounded(width, depth, rng.choice([0.02, 0.1, 0.2]), 4)
    doors = max(2, round(width / 0.5))
    parts = [slab(wood, body, 0.06, height), slab("dark", body.buffer(-0.04), 0.0, 0.06)]
    for k in range(1, doors):
        x = -width / 2 + k * width / doors
        parts.append(slab("dark", shapely.box(x - 0.004, depth - 0.01, x + 0.004, depth + 0.002), 0.08, height - 0.02))
        parts.append(tube("metal", (x - 0.05, depth + 0.02, 0.95), (x - 0.05, depth + 0.02, 1.15), 0.008, 6))
    return Piece(tuple(parts), shapely.box(-width / 2, 0, width / 2, depth + 0.03))


def sideboard(rng: np.random.Generator) -> Piece:
    """Return a low cupboard on slanted legs with objects on it, sometimes a screen."""
    width, depth, wood = rng.uniform(0.9, 2.0), rng.uniform(0.35, 0.45), _wood(rng)
    low, top = rng.uniform(0.12, 0.2), rng.uniform(0.45, 0.8)
    parts = [slab(wood, rounded(width, depth, 0.05), low, top)]
    parts += [
        tube(wood, (x, y, low), (1.06 * x, y, 0), 0.02, 6)
        for x in (-width / 2 + 0.12, width / 2 - 0.12)
        for y in (0.08, depth - 0.08)
    ]
    if rng.random() < 0.5:
        screen = rounded(rng.uniform(0.9, 1.4), 0.05, 0.02)
        parts += [
            slab("dark", affinity.translate(screen, 0, 0.1), top + 0.06, top + 0.75),
            slab("dark", shapely.box(-0.2, 0.06, 0.2, 0.2), top, top + 0.08),
        ]
    else:
        parts += [vase(rng).moved(x, depth / 2, top) for x in rng.uniform(-width / 2 + 0.15, width / 2 - 0.15, 2)]
    return Piece(tuple(parts), shapely.box(-width / 2, 0, width / 2, depth))


def desk(rng: np.random.Generator) -> Piece:
    """Return a desk on trestles with a screen and a chair."""
    width, depth, wood = rng.uniform(1.0, 1.6), rng.uniform(0.55, 0.75), _wood(rng)
    parts = [slab(wood, rounded(width, depth, 0.04), 0.71, 0.74)]
    for x in (-width / 2 + 0.15, width / 2 - 0.15):
        parts += [tube("metal", (x, depth / 2, 0.71), (x, y, 0.0), 0.018, 6) for y in (0.06, depth - 0.06)]
    parts += [
        slab("dark", shapely.box(-0.3, 0.14, 0.3, 0.17), 0.82, 1.18),
        tube("dark", (0, 0.16, 0.74), (0, 0.16, 0.9), 0.02, 6),
    ]
    parts += [
        part.turned(np.pi + rng.uniform(-0.5, 0.5)).moved(rng.uniform(-0.2, 0.2), depth + 0.15)
        for part in chair_parts(rng, wood)
    ]
    return Piece(tuple(parts), shapely.box(-width / 2, 0, width / 2, depth + 0.45))


def kitchen_run(rng: np.random.Generator, width: float | None = None) -> Piece:
    """Return a counter with a recessed plinth, tap, hob, wall units and a hood."""
    width = float(width or rng.uniform(1.6, 3.2))
    front, depth = str(rng.choice(["white", "wood a", "accent", "fabric c"])), 0.62
    base = shapely.Polygon(
        [(0, 0), (depth - 0.07, 0), (depth - 0.07, 0.1), (depth - 0.02, 0.1), (depth - 0.02, 0.87), (0, 0.87)]
    )
    worktop = shapely.box(0, 0.87, depth, 0.91).buffer(-0.008).buffer(0.008)
    parts = [
        section(front, base, -width / 2, width / 2),
        section("stone", worktop, -width / 2 - 0.01, width / 2 + 0.01),
    ]
    for x in np.arange(-width / 2 + 0.6, width / 2 - 0.1, 0.6):
        parts.append(slab("dark", shapely.box(x - 0.003, depth - 0.03, x + 0.003, depth - 0.017), 0.12, 0.85))
    hob, tap = rng.permutation([-width / 4, width / 4])
    parts += [slab("dark", shapely.box(hob - 0.28, 0.08, hob + 0.28, 0.56), 0.9, 0.916)]
    parts += [
        tube("metal", (tap, 0.1, 0.9), (tap, 0.1, 1.2), 0.014, 6),
        tube("metal", (tap, 0.1, 1.2), (tap, 0.28, 1.15), 0.012, 6),
    ]
    if rng.random() < 0.75:
        top = rng.uniform(2.0, 2.3)
        for x0, x1 in ((-width / 2, hob - 0.32), (hob + 0.32, width / 2)):
            if x1 - x0 > 0.3:
                parts.append(section(front, shapely.box(0, 1.42, 0.34, top), x0, x1))
        parts.append(
            lathe("metal", [(0.3, 1.6), (0.29, 1.66), (0.12, 1.85), (0.11, top)], 4).turned(np.pi / 4).moved(hob, 0.25)
        )
    return Piece(tuple(parts), shapely.box(-width / 2, 0, width / 2, depth))


def fridge(rng: np.random.Generator) -> Piece:
    """Return a refrigerator with round shoulders."""
    height = rng.uniform(1.4, 2.0)
    front = shapely.box(-0.3, 0.02, 0.3, height).buffer(-0.08).buffer(0.08)
    body = slab(str(rng.choice(["white", "metal", "accent"])), front, 0.0, 0.62).mapped(lambda v: v[:, [0, 2, 1]])
    grip = tube("metal", (0.22, 0.65, 0.8), (0.22, 0.65, 1.2), 0.012, 6)
    return Piece((body, grip), shapely.box(-0.3, 0, 0.3, 0.68))


def island(rng: np.random.Generator) -> Piece:
    """Return a kitchen island with bar stools."""
    width, depth = rng.uniform(1.3, 2.2), rng.uniform(0.7, 0.9)
    parts = [
        slab("accent", rounded(width - 0.1, depth - 0.1, 0.1), 0.0, 0.88),
        slab("stone", rounded(width, depth, 0.15), 0.88, 0.92),
    ]
    for x in np.arange(-width / 2 + 0.35, width / 2 - 0.2, 0.6):
        parts.append(
            lathe(
                "wood b",
                [(0.2, 0), (0.18, 0.02), (0.03, 0.04), (0.03, 0.62), (0.19, 0.64), (0.17, 0.68), (0, 0.68)],
                12,
            ).moved(x, depth + 0.2)
        )
    return Piece(tuple(parts), shapely.box(-width / 2, 0, width / 2, depth + 0.42))


def bathtub(rng: np.random.Generator) -> Piece:
    """Return a hollow tub."""
    long, deep = rng.uniform(1.5, 1.8), rng.uniform(0.7, 0.82)
    outer = rounded(long, deep, rng.choice([0.08, 0.34]), 5)
    hollow = affinity.translate(rounded(long - 0.16, deep - 0.16, 0.28, 5), 0, 0.08)
    parts = [slab("ceramic", outer - hollow, 0.0, 0.56), slab("ceramic", hollow, 0.1, 0.16)]
    parts.append(tube("metal", (0.5 * long - 0.2, 0.05, 0.6), (0.5 * long - 0.2, 0.2, 0.72), 0.018, 6))
    return Piece(tuple(parts), shapely.box(-long / 2, 0, long / 2, deep))


def toilet(rng: np.random.Generator) -> Piece:
    """Return a turned bowl and its cistern."""
    bowl = lathe("ceramic", [(0.12, 0), (0.11, 0.1), (0.19, 0.36), (0.2, 0.41), (0.15, 0.41), (0.0, 0.3)], 16).scaled(
        0.95, 1.3, 1.0
    )
    tank = slab("ceramic", rounded(0.38, 0.17, 0.05), 0.4, 0.8)
    return Piece((bowl.moved(0, 0.42), tank), shapely.box(-0.2, 0, 0.2, 0.7))


def basin(rng: np.random.Generator) -> Piece:
    """Return a wash-basin on a pedestal under a mirror."""
    bowl = lathe(
        "ceramic", [(0.09, 0), (0.07, 0.3), (0.09, 0.68), (0.26, 0.82), (0.27, 0.86), (0.22, 0.86), (0.0, 0.76)], 16
    )
    mirror = slab(
        "mirror",
        disc(rng.uniform(0.25, 0.36), 8) if rng.random() < 0.5 else shapely.box(-0.3, -0.4, 0.3, 0.4),
        0.01,
        0.03,
    )
    upright = mirror.mapped(lambda v: v[:, [0, 2, 1]]).moved(z_m=1.5)
    tap = tube("metal", (0, 0.06, 0.86), (0, 0.16, 0.96), 0.015, 6)
    return Piece((bowl.moved(0, 0.27), tap, upright), shapely.box(-0.27, 0, 0.27, 0.54))


def washer(rng: np.random.Generator) -> Piece:
    """Return a washing machine."""
    door = (
        lathe("dark", [(0.17, 0), (0.17, 0.03), (0.1, 0.05), (0, 0.055)], 16).turned(-np.pi / 2, 0).moved(0, 0.6, 0.42)
    )
    ring = lathe("metal", [(0.21, 0), (0.21, 0.02), (0.17, 0.03)], 16).turned(-np.pi / 2, 0).moved(0, 0.6, 0.42)
    return Piece((slab("white", rounded(0.6, 0.6, 0.03), 0, 0.85), door, ring), shapely.box(-0.3, 0, 0.3, 0.66))


def plant(rng: np.random.Generator) -> Piece:
    """Return a pot with a bush, a small tree, or long leaves."""
    r, h = rng.uniform(0.12, 0.22), rng.uniform(0.2, 0.4)
    parts = [lathe("ceramic", [(0, 0), (0.75 * r, 0), (r, h), (0.9 * r, h), (0.85 * r, 0.85 * h), (0, 0.85 * h)], 14)]
    tall = rng.uniform(0.3, 1.2)
    if rng.random() < 0.6:
        parts.append(tube("wood b", (0, 0, 0.8 * h), (0.03, 0.02, h + tall), 0.018, 6))
        for _ in range(rng.integers(4, 10)):
            leaf_m = rng.normal(0, 0.13, 3) + np.array([0, 0, h + tall * rng.uniform(0.7, 1.15)])
            parts.append(crumpled(blob("leaf", rng.uniform(0.08, 0.2, 3).tolist()), 0.14, rng).moved(*leaf_m))
    else:
        for _ in range(rng.integers(8, 16)):
            a, long = rng.uniform(0, 6.28), rng.uniform(0.4, 0.6 + tall / 2)
            leaf = blob("leaf", (0.04, 0.008, long / 2), 1).moved(z_m=long / 2).turned(rng.uniform(0.15, 0.8), 0)
            parts.append(leaf.turned(a).moved(z_m=0.8 * h))
    reach = r + 0.12
    return Piece(tuple(part.moved(y_m=reach) for part in parts), affinity.translate(disc(reach), 0, reach))


def floor_lamp(rng: np.random.Generator) -> Piece:
    """Return a standing lamp with a turned shade."""
    h = rng.uniform(1.35, 1.7)
    parts = [
        lathe("metal", [(0, 0), (0.14, 0), (0.13, 0.02), (0.012, 0.03), (0.012, h)], 12),
        lathe("shade", [(0.2, h - 0.05), (0.12, h + 0.2)], 16),
    ]
    return Piece(tuple(part.moved(y_m=0.22) for part in parts), affinity.translate(disc(0.2), 0, 0.22))


def rug(rng: np.random.Generator) -> Piece:
    """Return a flat carpet that furniture can stand on."""
    r = rng.uniform(0.7, 1.3)
    shape = disc(r, 8) if rng.random() < 0.5 else affinity.translate(rounded(2.2 * r, 1.5 * r, 0.2), 0, -0.75 * r)
    return Piece((slab("rug", shape, 0.0, 0.012),), None)


def radiator(rng: np.random.Generator) -> Piece:
    """Return a ribbed radiator."""
    width, high = rng.uniform(0.6, 1.3), 0.42
    parts = [
        tube("white", (x, 0.07, 0.12), (x, 0.07, 0.12 + high), 0.028, 6)
        for x in np.arange(-width / 2, width / 2, 0.075)
    ]
    return Piece(tuple(parts), shapely.box(-width / 2, 0, width / 2, 0.12))


def picture(rng: np.random.Generator) -> Piece:
    """Return a round, six-sided or square framed picture, or a mirror."""
    r = rng.uniform(0.18, 0.5)
    shape = disc(r, int(rng.choice([2, 6]))) if rng.random() < 0.5 else shapely.box(-r, -0.7 * r, r, 0.7 * r)
    inner = str(rng.choice(["rug", "accent", "mirror"], p=[0.5, 0.3, 0.2]))
    parts = [slab("dark", shape, 0.005, 0.03), slab(inner, shape.buffer(-0.04), 0.02, 0.033)]
    height = rng.uniform(1.4, 1.7)
    return Piece(tuple(p.mapped(lambda v: v[:, [0, 2, 1]] * [1, 1, 1]).moved(z_m=height) for p in parts), None)


def curtain(rng: np.random.Generator, width: float, top: float) -> Part:
    """Return one cloth of a pair of curtains, starting at x = 0."""
    low_m = rng.choice([0.03, 0.6], p=[0.8, 0.2])
    cloth = folded_sheet("curtain", width_m=width, low_m=low_m, high_m=top, folds=width / 0.13, depth_m=0.035)
    return cloth.moved(y_m=0.09)


def pendant(rng: np.random.Generator, ceiling_m: float, drop_m: float) -> tuple[Part, ...]:
    """Return a hanging lamp about the origin; with no drop a flush lamp."""
    low = ceiling_m - drop_m
    if drop_m < 0.2:
        return (
            lathe(
                "shade",
                [(0, ceiling_m - 0.09), (0.12, ceiling_m - 0.08), (0.18, ceiling_m - 0.03), (0.19, ceiling_m)],
                18,
            ),
        )
    r = rng.uniform(0.12, 0.25)
    shade = (
        blob("shade", (r, r, 0.8 * r)).moved(z_m=low + r)
        if rng.random() < 0.4
        else lathe("shade", [(r, low), (0.8 * r, low + 0.08), (0.25 * r, low + 0.18), (0.02, low + 0.22)], 18)
    )
    return (shade, tube("dark", (0, 0, low + 0.2), (0, 0, ceiling_m), 0.006, 5))
