"""Furniture to sit and lie on. Local frame: x along the wall, y away from it (back at 0), z up, metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from lalaloc_core.learn.heldout.geometry import Part, blob, crumpled, disc, lathe, rounded, section, slab, tube


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of furniture, and the floor it takes in the local frame; hanging things take none (None)."""

    parts: tuple[Part, ...]
    footprint: BaseGeometry | None


def _fabric(rng: np.random.Generator) -> str:
    return str(rng.choice(["fabric a", "fabric b", "fabric c"]))


def _wood(rng: np.random.Generator) -> str:
    return str(rng.choice(["wood a", "wood b"]))


def sofa(rng: np.random.Generator) -> Piece:
    """Return a sofa extruded from one slanted, rounded section, with armrests and cushions."""
    width, depth, cloth = rng.uniform(1.5, 2.5), rng.uniform(0.82, 1.0), _fabric(rng)
    seat, back, lean = rng.uniform(0.38, 0.46), rng.uniform(0.72, 0.95), rng.uniform(0.05, 0.18)
    outline = shapely.Polygon(
        [(0.05 + lean, 0.1), (depth, 0.1), (depth - 0.02, seat), (0.28 + lean, seat), (0.2, back), (0.05, back)]
    )
    parts = [section(cloth, outline.buffer(-0.04).buffer(0.04), -width / 2 + 0.1, width / 2 - 0.1)]
    for side in (-1, 1):
        arm = shapely.Polygon([(0.06, 0.08), (depth, 0.08), (depth, seat + 0.12), (0.06, seat + 0.26)])
        x = side * (width / 2 - 0.09)
        parts.append(section(cloth, arm.buffer(-0.06).buffer(0.06), x - 0.09, x + 0.09))
    for x in np.arange(-width / 2 + 0.4, width / 2 - 0.3, rng.uniform(0.45, 0.9)):
        cushion = crumpled(blob("accent" if rng.random() < 0.5 else _fabric(rng), (0.24, 0.09, 0.2)), 0.05, rng)
        parts.append(cushion.turned(-0.3, 0).moved(x, 0.38, seat + 0.18))
    parts += [
        tube("metal", (x, y, 0.1), (x, y, 0.0), 0.025, 6)
        for x in (-width / 2 + 0.15, width / 2 - 0.15)
        for y in (0.15, depth - 0.1)
    ]
    return Piece(tuple(parts), shapely.box(-width / 2, 0, width / 2, depth))


def curved_sofa(rng: np.random.Generator) -> Piece:
    """Return a sofa bent around its middle."""
    radius, cloth = rng.uniform(1.3, 1.9), _fabric(rng)
    span = np.radians(rng.uniform(40, 62))
    angle = np.linspace(np.pi / 2 - span, np.pi / 2 + span, 15)
    line = shapely.LineString(np.stack([radius * np.cos(angle), radius * (1 - np.sin(angle))], axis=1))
    seat_line = affinity.translate(line, 0, 0.5)
    back = line.buffer(0.16, cap_style="round", quad_segs=4)
    seat = seat_line.buffer(0.42, cap_style="round", quad_segs=4)
    whole = affinity.translate(back | seat, 0, 0.18)
    parts = [
        slab(cloth, affinity.translate(seat, 0, 0.18), 0.08, rng.uniform(0.38, 0.45)),
        slab(cloth, affinity.translate(back, 0, 0.18), 0.08, rng.uniform(0.68, 0.85)),
    ]
    return Piece(tuple(parts), whole.convex_hull if isinstance(whole, shapely.Polygon) else whole.envelope)


def armchair(rng: np.random.Generator) -> Piece:
    """Return a tub chair: a round seat inside a bent back."""
    radius, cloth = rng.uniform(0.36, 0.46), _fabric(rng)
    angle = np.linspace(np.radians(-20), np.radians(200), 12)
    rim = shapely.LineString(np.stack([radius * np.cos(angle), -radius * np.sin(angle)], axis=1)).buffer(
        0.09, quad_segs=4
    )
    parts = [
        slab(cloth, disc(radius), 0.14, 0.42),
        slab(cloth, rim, 0.14, rng.uniform(0.62, 0.8)),
        *(
            tube(_wood(rng), (x, y, 0.15), (1.3 * x, 1.3 * y, 0.0), 0.02, 6)
            for x in (-0.22, 0.22)
            for y in (-0.22, 0.22)
        ),
    ]
    reach = radius + 0.1
    return Piece(tuple(part.moved(y_m=reach) for part in parts), affinity.translate(disc(reach), 0, reach))


def chair_parts(rng: np.random.Generator, wood: str) -> list[Part]:
    """Return a chair about the origin that faces +y, with splayed legs and a slanted back."""
    seat = 0.45
    legs = [tube(wood, (x, y, seat), (1.25 * x, 1.25 * y, 0.0), 0.018, 6) for x in (-0.17, 0.17) for y in (-0.17, 0.17)]
    back = shapely.Polygon([(-0.2, seat), (-0.17, seat), (-0.27, 0.86), (-0.3, 0.86)])
    shell = section(wood if rng.random() < 0.5 else "white", back.buffer(0.01), -0.19, 0.19)
    return [*legs, slab(wood, affinity.translate(rounded(0.42, 0.42, 0.08), 0, -0.21), seat - 0.02, seat + 0.02), shell]


def dining_set(rng: np.random.Generator) -> Piece:
    """Return a round or oval table with chairs around it."""
    long, short, wood = rng.uniform(0.5, 0.95), rng.uniform(0.45, 0.55), _wood(rng)
    top = affinity.scale(disc(1.0, 8), max(long, short), short)
    parts = [slab(wood, top, 0.72, 0.755)]
    if long < 0.65:
        parts.append(lathe(wood, [(0.0, 0.0), (0.3, 0.01), (0.28, 0.04), (0.06, 0.1), (0.05, 0.6), (0.2, 0.72)]))
    else:
        parts += [
            tube(wood, (x * long * 0.55, y * short * 0.6, 0.72), (x * long * 0.75, y * short * 0.75, 0.0), 0.03)
            for x in (-1, 1)
            for y in (-1, 1)
        ]
    chairs, chair_wood = int(rng.integers(3, 7)), _wood(rng)
    start = rng.uniform(0, 6.28)
    for k in range(chairs):
        a = start + 2 * np.pi * k / chairs + rng.uniform(-0.15, 0.15)
        x, y = (max(long, short) + 0.08) * np.cos(a), (short + 0.08) * np.sin(a)
        parts += [part.turned(a + np.pi / 2).moved(x, y) for part in chair_parts(rng, chair_wood)]
    parts.append(vase(rng).moved(z_m=0.755))
    foot = affinity.scale(disc(1.0, 6), max(long, short) + 0.42, short + 0.42)
    return Piece(tuple(part.moved(y_m=short + 0.42) for part in parts), affinity.translate(foot, 0, short + 0.42))


def vase(rng: np.random.Generator) -> Part:
    """Return a turned vase about the origin."""
    h, r = rng.uniform(0.15, 0.4), rng.uniform(0.05, 0.1)
    waist = rng.uniform(0.4, 1.0)
    return lathe(
        "ceramic", [(0, 0), (0.7 * r, 0), (r, 0.35 * h), (waist * r, 0.75 * h), (0.8 * r, h), (0.5 * r, 0.95 * h)], 12
    )


def bed(rng: np.random.Generator) -> Piece:
    """Return a rounded mattress on a frame, a sagging quilt, pillows, and a headboard."""
    width, long = rng.choice([0.9, 1.2, 1.4, 1.6, 1.8]), rng.uniform(1.95, 2.1)
    top, wood = rng.uniform(0.42, 0.6), _wood(rng)
    parts = [
        slab(wood, rounded(width + 0.08, long + 0.05, 0.1), 0.12, 0.28),
        slab("white", rounded(width, long, 0.12, 4), 0.28, top),
        slab(
            _fabric(rng),
            affinity.translate(rounded(width + 0.1, 0.68 * long, 0.15, 4), 0, 0.32 * long),
            0.2,
            top + 0.03,
        ),
    ]
    head = shapely.box(-width / 2 - 0.06, 0.0, width / 2 + 0.06, rng.uniform(0.85, 1.2))
    board = (
        head
        if rng.random() < 0.5
        else head | affinity.scale(shapely.Point(0, head.bounds[3]).buffer(1.0), width / 2, 0.3)
    )
    parts.append(
        slab(_fabric(rng) if rng.random() < 0.5 else wood, board, 0.0, 0.07).mapped(
            lambda v: v[:, [0, 2, 1]] * [1, 1, 1]
        )
    )
    for x in (0.0,) if width < 1.3 else (-width / 4, width / 4):
        parts.append(crumpled(blob("white", (min(0.36, width / 4.3), 0.22, 0.1)), 0.04, rng).moved(x, 0.32, top + 0.06))
    return Piece(tuple(parts), shapely.box(-width / 2 - 0.06, 0, width / 2 + 0.06, long + 0.05))


def bean_bag(rng: np.random.Generator) -> Piece:
    """Return a bean bag."""
    r = rng.uniform(0.36, 0.5)
    part = crumpled(blob(_fabric(rng), (r, r, 0.75 * r), 3), 0.07, rng)
    return Piece(
        (part.mapped(lambda v: np.maximum(v + np.array([0, r, 0.6 * r]), [-9, -9, 0])),),
        affinity.translate(disc(1.1 * r), 0, r),
    )


def ottoman(rng: np.random.Generator) -> Piece:
    """Return a round stool, or a coffee table turned from wood."""
    r, h = rng.uniform(0.25, 0.45), rng.uniform(0.32, 0.45)
    cover = _fabric(rng) if rng.random() < 0.5 else _wood(rng)
    part = lathe(cover, [(0, 0), (0.8 * r, 0), (0.95 * r, 0.3 * h), (r, 0.8 * h), (0.92 * r, h), (0, h)], 20)
    return Piece((part.moved(y_m=r),), affinity.translate(disc(r), 0, r))
