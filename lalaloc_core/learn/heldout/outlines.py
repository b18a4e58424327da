"""Outlines of single rooms: L, T and U shapes, bays, chamfers, slanted walls, hexagons, rotundas, bent corridors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry.base import BaseGeometry

RoomKind = Literal["living", "bedroom", "kitchen", "bathroom", "corridor", "closet", "study"]
# Floor areas (m²) of each kind.
AREAS_M2: Mapping[RoomKind, tuple[float, float]] = {
    "living": (18.0, 58.0),
    "bedroom": (9.0, 21.0),
    "kitchen": (7.0, 17.0),
    "bathroom": (3.6, 9.0),
    "corridor": (4.0, 14.0),
    "closet": (2.0, 4.2),
    "study": (6.0, 13.0),
}
# Minimum edge length (m), and radius (m) of a disc that must fit into a room.
_MIN_EDGE_M = 0.18
_INNER_RADIUS_M = 0.42


def _rectangle(rng: np.random.Generator) -> BaseGeometry:
    return shapely.box(0, 0, rng.uniform(1.0, 1.7), 1)


def _l_shape(rng: np.random.Generator) -> BaseGeometry:
    width, cut = rng.uniform(1.0, 1.6), rng.uniform(0.3, 0.6, 2)
    return shapely.box(0, 0, width, 1) - shapely.box(width * (1 - cut[0]), 1 - cut[1], width + 1, 2)


def _t_shape(rng: np.random.Generator) -> BaseGeometry:
    width, stem = rng.uniform(1.2, 1.8), rng.uniform(0.45, 0.8)
    left = rng.uniform(0.1, width - stem - 0.1)
    return shapely.box(0, 0, width, rng.uniform(0.45, 0.7)) | shapely.box(left, 0, left + stem, rng.uniform(0.95, 1.3))


def _u_shape(rng: np.random.Generator) -> BaseGeometry:
    width, depth = rng.uniform(1.5, 2.0), rng.uniform(0.25, 0.5)
    left, right = rng.uniform(0.4, 0.6), width - rng.uniform(0.4, 0.6)
    return shapely.box(0, 0, width, 1) - shapely.box(left, 1 - depth, right, 2)


def _bay(rng: np.random.Generator) -> BaseGeometry:
    width, out = rng.uniform(1.0, 1.5), rng.uniform(0.15, 0.3)
    left, right = width * rng.uniform(0.12, 0.28), width * rng.uniform(0.72, 0.88)
    slant = min(out / math.tan(math.radians(rng.uniform(35, 65))), 0.35 * (right - left))
    bay = shapely.Polygon(
        [(left, 0.9), (right, 0.9), (right, 1), (right - slant, 1 + out), (left + slant, 1 + out), (left, 1)]
    )
    return shapely.box(0, 0, width, 1) | bay


def _chamfered(rng: np.random.Generator) -> BaseGeometry:
    width = rng.uniform(1.0, 1.5)
    shape = shapely.box(0, 0, width, 1)
    for x, y in rng.permutation([(0, 0), (0, 1), (width, 0), (width, 1)])[: rng.integers(1, 3)]:
        a = rng.uniform(0.2, 0.42)
        b = a * math.tan(math.radians(rng.uniform(30, 60)))
        shape = shape - shapely.Polygon([(x, y), (x + (a if x == 0 else -a), y), (x, y + (b if y == 0 else -b))])
    return shape


def _trapezoid(rng: np.random.Generator) -> BaseGeometry:
    width = rng.uniform(1.0, 1.5)
    left, right = (math.tan(math.radians(a)) for a in rng.uniform(0, 32, 2) * rng.permutation([1.0, 0.4]))
    scale = min(1.0, 0.6 * width / max(left + right, 1e-6))
    return shapely.Polygon([(0, 0), (width, 0), (width - right * scale, 1), (left * scale, 1)])


def _hexagon(rng: np.random.Generator) -> BaseGeometry:
    angle = np.radians(np.arange(6) * 60 + rng.uniform(-9, 9, 6))
    return shapely.Polygon(np.stack([rng.uniform(1.0, 1.3) * np.cos(angle), np.sin(angle)], axis=1))


def _rotunda(rng: np.random.Generator) -> BaseGeometry:
    angle = np.radians(np.arange(12) * 30 + 15)
    disc = shapely.Polygon(np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return disc if rng.random() < 0.5 else disc | shapely.box(0, -0.9659258, rng.uniform(1.2, 1.7), 0.9659258)


def _alcoved(rng: np.random.Generator) -> BaseGeometry:
    """Return a rectangle with niches and pillars in its walls."""
    width = rng.uniform(1.1, 1.7)
    shape: BaseGeometry = shapely.box(0, 0, width, 1)
    for y in rng.permutation([0.0, 1.0])[: rng.integers(1, 3)]:
        left, wide, deep = rng.uniform(0.1, width - 0.6), rng.uniform(0.2, 0.5), rng.uniform(0.06, 0.2)
        block = shapely.box(left, y - deep, left + wide, y + deep)
        shape = shape | block if rng.random() < 0.6 else shape - affinity.scale(block, 0.5, 0.8)
    return shape


def _open_plan(rng: np.random.Generator) -> BaseGeometry:
    """Return connected spaces, one of them turned."""
    first, second = (
        shapely.box(0, 0, rng.uniform(1.0, 1.4), 1),
        shapely.box(0, 0, rng.uniform(0.7, 1.1), rng.uniform(0.6, 0.9)),
    )
    turn = rng.choice([0.0, 0.0, 15.0, 30.0, 45.0])
    second = affinity.translate(
        affinity.rotate(second, turn, origin=(0, 0)), rng.uniform(0.45, 0.8), rng.uniform(0.3, 0.7)
    )
    shape = first | second
    if rng.random() < 0.5:
        niche_m = rng.uniform(0.1, 0.6)
        shape = shape | shapely.box(niche_m, -0.18, niche_m + rng.uniform(0.3, 0.6), 0.1)
    return shape


def _bent(rng: np.random.Generator) -> BaseGeometry:
    """Return a corridor around one to three bends."""
    points, direction = [np.zeros(2)], 0.0
    for _ in range(rng.integers(2, 5)):
        step = rng.uniform(1.5, 3.4)
        points.append(points[-1] + step * np.array([math.cos(direction), math.sin(direction)]))
        direction += math.radians(rng.choice([20, 30, 45, 60, 90, 90]) * rng.choice([-1, 1]))
    return shapely.LineString(points).buffer(rng.uniform(0.5, 0.8), cap_style="flat", join_style="mitre")


_Maker = Callable[[np.random.Generator], BaseGeometry]
_MAKERS: Mapping[RoomKind, tuple[_Maker, ...]] = {
    "living": (_open_plan, _open_plan, _l_shape, _u_shape, _bay, _alcoved, _t_shape),
    "bedroom": (_chamfered, _trapezoid, _bay, _l_shape, _alcoved, _rectangle),
    "kitchen": (_alcoved, _t_shape, _chamfered, _trapezoid, _u_shape, _rectangle),
    "bathroom": (_chamfered, _trapezoid, _alcoved, _hexagon, _rectangle),
    "corridor": (_bent, _bent, _t_shape),
    "closet": (_trapezoid, _rectangle, _chamfered),
    "study": (_hexagon, _rotunda, _trapezoid, _bay),
}


def sample_outline(kind: RoomKind, rng: np.random.Generator) -> shapely.Polygon:
    """Draw a counter-clockwise room outline (m) without short walls or tight corners."""
    while True:
        maker = _MAKERS[kind][rng.integers(len(_MAKERS[kind]))]
        shape = maker(rng)
        area = rng.uniform(*AREAS_M2[kind])
        if maker is not _bent:
            factor = math.sqrt(area / shape.area)
            shape = affinity.scale(shape, factor, factor, origin=(0, 0))
        shape = shape.simplify(1e-6)
        if isinstance(shape, shapely.Polygon) and _is_sound(shape, AREAS_M2[kind]):
            return shapely.Polygon(shapely.geometry.polygon.orient(shape).exterior.coords[:-1])


def _is_sound(shape: shapely.Polygon, area_m2: tuple[float, float]) -> bool:
    if not shape.is_valid or len(shape.interiors) or not area_m2[0] - 1e-9 <= shape.area <= area_m2[1] + 1e-9:
        return False
    corners = np.array(shape.exterior.coords)
    shortest = np.linalg.norm(np.diff(corners, axis=0), axis=1).min()
    core = shape.buffer(-_INNER_RADIUS_M)
    return bool(shortest >= _MIN_EDGE_M) and isinstance(core, shapely.Polygon) and not core.is_empty
