"""Partition of a footprint into gross cells, and of cells into inner outlines of rooms.

A gross cell extends to the middle of the walls around it. Shrinking each cell by half a wall thickness gives rooms
that never overlap and face each other across a wall of constant thickness. Later changes of an outline only remove
floor, so this stays true.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float

Rect = tuple[float, float, float, float]
Range = tuple[float, float]

_MIN_SIDE_M = 1.5
_MIN_CLEAR_WIDTH_M = 0.75
_WING_WALL_M: Range = (0.08, 0.25)
_WING_REACH_M: Range = (0.4, 1.8)
_TRIES = 4


@dataclass(frozen=True)
class Cell:
    """A gross cell: counter-clockwise outline (n, 2) in metres, and if it is a corridor."""

    outline_m: Float[np.ndarray, "n 2"]
    corridor: bool = False


def partition(rng: np.random.Generator, rooms: int, area_m2: float, corridor_width_m: Range) -> list[Cell]:
    """Cut a footprint of `area_m2` into about `rooms` cells, usually along a corridor."""
    aspect = rng.uniform(0.5, 1.0)
    width, height = np.sqrt(area_m2 / aspect), np.sqrt(area_m2 * aspect)
    footprint = (0.0, 0.0, float(width), float(height))
    if rooms >= 4 and rng.random() < 0.85 and height > 5.0:
        low, high = corridor_width_m
        # Narrow corridors are the usual ones.
        cells = _along_corridor(footprint, rooms, rng, low + (high - low) * rng.random() ** 1.7)
    else:
        cells = [Cell(_rectangle(rect)) for rect in _split(footprint, rooms, rng)]
    cells = _carve_corners(cells, max(rooms - len(cells), 0) + int(rng.integers(0, 4)), rng)
    if len(cells) > 4 and rng.random() < 0.25:
        # A patio or a terrace: the footprint is then no rectangle.
        candidates = [index for index, cell in enumerate(cells) if not cell.corridor and len(cell.outline_m) == 4]
        if candidates:
            del cells[int(rng.choice(candidates))]
    return cells


def inner_outline(outline_m: Float[np.ndarray, "n 2"], inset_m: float) -> Float[np.ndarray, "n 2"]:
    """Move every edge of a counter-clockwise polygon inwards by `inset_m` (mitred)."""
    ahead = np.roll(outline_m, -1, axis=0) - outline_m
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    normal = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    before = np.roll(normal, 1, axis=0)
    bisector = normal + before
    return outline_m + inset_m * bisector / (1.0 + (normal * before).sum(axis=1, keepdims=True))


def reshape_room(
    polygon_m: Float[np.ndarray, "n 2"], rng: np.random.Generator, changes: int
) -> Float[np.ndarray, "m 2"]:
    """Take floor away at random: corner columns, slanted corners and walls, pillars and recesses."""
    for _ in range(changes):
        kind = rng.choice(5, p=[0.3, 0.15, 0.15, 0.2, 0.2])
        edge = int(rng.integers(len(polygon_m)))
        changed = None
        if kind < len(_AT_CORNERS):
            if _is_convex_corner(polygon_m, edge):
                changed = _AT_CORNERS[kind](polygon_m, edge, rng)
        elif kind == 3:
            changed = _bump(polygon_m, edge, rng, width_m=(0.15, 0.6), depth_m=(0.1, 0.45))
        else:
            changed = _bump(polygon_m, edge, rng, width_m=(0.8, 3.0), depth_m=(0.1, 0.7))
        if changed is not None and _is_roomy(changed):
            polygon_m = changed
    return polygon_m


def with_wing_wall(polygon_m: Float[np.ndarray, "n 2"], rng: np.random.Generator) -> Float[np.ndarray, "m 2"]:
    """Add a thin wall that ends in the middle of the room; return the outline unchanged if there is no space."""
    for _ in range(_TRIES):
        edge = int(rng.integers(len(polygon_m)))
        changed = _bump(polygon_m, edge, rng, width_m=_WING_WALL_M, depth_m=_WING_REACH_M)
        if changed is not None and _is_roomy(changed):
            return changed
    return polygon_m


def _rectangle(rect: Rect) -> Float[np.ndarray, "4 2"]:
    x0, y0, x1, y1 = rect
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def _split(rect: Rect, parts: int, rng: np.random.Generator) -> list[Rect]:
    """Cut guillotine-wise across the longer side; stop early when a part would become too narrow."""
    if parts <= 1:
        return [rect]
    x0, y0, x1, y1 = rect
    first = int(rng.integers(1, parts))
    share = np.clip(first / parts + rng.uniform(-0.15, 0.15), 0.15, 0.85)
    along_x = (x1 - x0) * rng.uniform(0.75, 1.33) > (y1 - y0)
    length = (x1 - x0) if along_x else (y1 - y0)
    if min(share, 1.0 - share) * length < _MIN_SIDE_M:
        share = 0.5
        if 0.5 * length < _MIN_SIDE_M:
            return [rect]
    if along_x:
        cut = x0 + share * length
        halves: tuple[Rect, Rect] = (x0, y0, cut, y1), (cut, y0, x1, y1)
    else:
        cut = y0 + share * length
        halves = (x0, y0, x1, cut), (x0, cut, x1, y1)
    return _split(halves[0], first, rng) + _split(halves[1], parts - first, rng)


def _along_corridor(rect: Rect, rooms: int, rng: np.random.Generator, width_m: float) -> list[Cell]:
    """Return a corridor through the footprint with rooms on both sides, sometimes ending in a room or L-shaped."""
    x0, y0, x1, y1 = rect
    below = y0 + (y1 - y0 - width_m) * rng.uniform(0.35, 0.65)
    above = below + width_m
    rest = rooms - 1
    cells = []
    end = x1
    if rest >= 3 and rng.random() < 0.5:
        end = x1 - rng.uniform(2.0, max(2.1, 0.45 * (x1 - x0)))
        cells.append(Cell(_rectangle((end, y0, x1, y1))))
        rest -= 1
    lower = max(1, rest // 2 + int(rng.integers(0, 2)) * (rest > 2))
    cells += [Cell(_rectangle(part)) for part in _split_row((x0, y0, end, below), lower, rng)]
    upper = [_rectangle(part) for part in _split_row((x0, above, end, y1), max(1, rest - lower), rng)]
    corridor = _rectangle((x0, below, end, above))
    first = upper[0]
    if first[1, 0] - x0 > width_m + 2.0 and rng.random() < 0.35:
        # The corridor turns the corner beside the first room above it.
        turn = x0 + width_m
        corridor = np.array([(x0, below), (end, below), (end, above), (turn, above), (turn, y1), (x0, y1)])
        upper[0] = _rectangle((turn, above, float(first[1, 0]), y1))
    return [*cells, Cell(corridor, corridor=True), *(Cell(outline) for outline in upper)]


def _split_row(rect: Rect, parts: int, rng: np.random.Generator) -> list[Rect]:
    """Cut along x only, so that every part keeps a wall to the corridor."""
    x0, y0, x1, y1 = rect
    parts = max(1, min(parts, int((x1 - x0) / _MIN_SIDE_M)))
    shares = rng.uniform(0.6, 1.8, parts)
    cuts = np.concatenate([[x0], x0 + (x1 - x0) * np.cumsum(shares) / shares.sum()])
    return [(float(cuts[k]), y0, float(cuts[k + 1]), y1) for k in range(parts)]


def _carve_corners(cells: list[Cell], wanted: int, rng: np.random.Generator) -> list[Cell]:
    """Cut closets and baths out of the corners of large rectangular cells, which become L-shaped."""
    carved = list(cells)
    for index in rng.permutation(len(cells)):
        outline = cells[index].outline_m
        if wanted <= 0 or cells[index].corridor or len(outline) != 4:
            continue
        width, height = outline[2] - outline[0]
        if min(width, height) < 2.8 or rng.random() < 0.3:
            continue
        across = rng.uniform(1.1, min(2.4, 0.6 * width))
        along = rng.uniform(1.1, min(2.6, 0.6 * height))
        turn = int(rng.integers(4))
        rotated = np.roll(outline, -turn, axis=0)
        toward_next, toward_last = rotated[1] - rotated[0], rotated[3] - rotated[0]
        a, b = (across, along) if turn % 2 == 0 else (along, across)
        toward_next = toward_next / np.linalg.norm(toward_next) * a
        toward_last = toward_last / np.linalg.norm(toward_last) * b
        corner = rotated[0]
        closet = np.array([corner, corner + toward_next, corner + toward_next + toward_last, corner + toward_last])
        rest = np.array([corner + toward_next, rotated[1], rotated[2], rotated[3], corner + toward_last, closet[2]])
        carved[index] = Cell(rest)
        carved.append(Cell(closet))
        wanted -= 1
    return carved


def _edge(polygon_m: np.ndarray, index: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return (start vertex, unit direction, length) of an edge."""
    start = polygon_m[index]
    along = polygon_m[(index + 1) % len(polygon_m)] - start
    length = float(np.linalg.norm(along))
    return start, along / length, length


def _is_convex_corner(polygon_m: np.ndarray, index: int) -> bool:
    _, before, _ = _edge(polygon_m, index - 1 if index else len(polygon_m) - 1)
    _, after, _ = _edge(polygon_m, index)
    return float(before[0] * after[1] - before[1] * after[0]) > 0.5


def _replace(polygon_m: np.ndarray, index: int, vertices: list[np.ndarray]) -> np.ndarray:
    """Return the polygon with vertex `index` replaced by others."""
    return np.concatenate([polygon_m[:index], np.array(vertices), polygon_m[index + 1 :]])


def _notch_corner(polygon_m: np.ndarray, index: int, rng: np.random.Generator) -> np.ndarray | None:
    corner, after, length_after = _edge(polygon_m, index)
    _, before, length_before = _edge(polygon_m, (index - 1) % len(polygon_m))
    a, b = rng.uniform(0.1, 0.7), rng.uniform(0.1, 0.7)
    if a > 0.3 * length_after or b > 0.3 * length_before:
        return None
    return _replace(polygon_m, index, [corner - before * b, corner - before * b + after * a, corner + after * a])


def _cut_corner(polygon_m: np.ndarray, index: int, rng: np.random.Generator) -> np.ndarray | None:
    corner, after, length_after = _edge(polygon_m, index)
    _, before, length_before = _edge(polygon_m, (index - 1) % len(polygon_m))
    a = rng.uniform(0.3, 1.5)
    b = a * rng.uniform(0.6, 1.6)
    if a > 0.4 * length_after or b > 0.4 * length_before:
        return None
    return _replace(polygon_m, index, [corner - before * b, corner + after * a])


def _slant_wall(polygon_m: np.ndarray, index: int, rng: np.random.Generator) -> np.ndarray | None:
    corner, after, length = _edge(polygon_m, index)
    return _replace(polygon_m, index, [corner + after * length * rng.uniform(0.05, 0.25)])


_AT_CORNERS = (_notch_corner, _cut_corner, _slant_wall)


def _bump(
    polygon_m: np.ndarray, index: int, rng: np.random.Generator, width_m: Range, depth_m: Range
) -> np.ndarray | None:
    """Return a box standing out from the wall: a pillar, a chimney, or the wall beside a recess."""
    start, along, length = _edge(polygon_m, index)
    width, depth = rng.uniform(*width_m), rng.uniform(*depth_m)
    if width + 0.2 > length or width > 0.6 * length:
        return None
    inwards = np.array([-along[1], along[0]]) * depth
    near = start + along * rng.uniform(0.1, length - width - 0.1)
    far = near + along * width
    return _replace(polygon_m, index, [start, near, near + inwards, far + inwards, far])


def _is_roomy(polygon_m: np.ndarray) -> bool:
    """Return true if a person fits through every part of the room."""
    shape = shapely.Polygon(polygon_m)
    if not shape.is_valid or shape.area < 1.2:
        return False
    core = shape.buffer(-0.5 * _MIN_CLEAR_WIDTH_M, join_style="mitre")
    return core.geom_type == "Polygon" and not core.is_empty
