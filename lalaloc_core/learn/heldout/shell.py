"""Meshes of the building: floors, walls with holes, reveals, door leaves, window frames."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.heldout.geometry import Part, slab, triangles_of, tube
from lalaloc_core.learn.heldout.wall_holes import Opening, Wall, span_behind, walls_of

_LEAF_M = 0.04
_ARCH_SEGMENTS = 10


def shell_parts(plan: FloorPlan, openings: list[Opening], rng: np.random.Generator) -> list[tuple[int, Part]]:
    """Return every part of the bare building with its room."""
    holes: dict[tuple[int, int], list[shapely.Polygon]] = {}
    parts: list[tuple[int, Part]] = []
    for opening in openings:
        holes.setdefault((opening.wall.room, opening.wall.edge), []).append(_outline(opening))
        if opening.behind is not None:
            outline = _outline(opening, span_behind(opening))
            holes.setdefault((opening.behind.room, opening.behind.edge), []).append(outline)
        parts += [(opening.wall.room, part) for part in _fill(opening, rng)]
    for index, room in enumerate(plan.rooms):
        vertices, faces = triangles_of(room.shape)
        for surface, height in (("floor", 0.0), ("ceiling", room.ceiling_height_m)):
            lifted = np.concatenate([vertices, np.full((len(vertices), 1), height)], axis=1)
            # Seen from inside, the ceiling faces down.
            parts.append((index, Part(surface, lifted, faces if height == 0.0 else faces[:, ::-1])))
        for wall in walls_of(room, index):
            face = shapely.box(0.0, 0.0, wall.length_m, room.ceiling_height_m)
            face = face.difference(shapely.union_all(holes.get((index, wall.edge), [])))
            parts += [(index, _on_wall("wall", wall, piece)) for piece in _polygons(face)]
    return parts


def _polygons(shape: shapely.Geometry) -> list[shapely.Polygon]:
    return [piece for piece in shapely.get_parts(shape) if isinstance(piece, shapely.Polygon)]


def _on_wall(surface: str, wall: Wall, shape: shapely.Polygon, out_m: float = 0.0) -> Part:
    """Return a flat shape (along the wall, height) on a wall's face, looking into the room."""
    vertices, faces = triangles_of(shape)
    return Part(surface, _in_room(wall, vertices, out_m), faces[:, ::-1])


def _in_room(wall: Wall, points: Float[np.ndarray, "n 2"], out_m: float) -> Float[np.ndarray, "n 3"]:
    flat = wall.start_m + points[:, :1] * wall.along + out_m * wall.outward
    return np.concatenate([flat, points[:, 1:]], axis=1)


def _outline(opening: Opening, span_m: tuple[float, float] | None = None) -> shapely.Polygon:
    """Return the hole in coordinates (along the wall, height)."""
    left, right = span_m or (opening.left_m, opening.right_m)
    if not opening.arched:
        return shapely.box(left, opening.sill_m, right, opening.top_m)
    rise = min((right - left) / 2, 0.55)
    angle = np.linspace(0.0, np.pi, _ARCH_SEGMENTS + 1)
    middle = (left + right) / 2
    arch = [(middle + (right - left) / 2 * np.cos(a), opening.top_m - rise + rise * np.sin(a)) for a in angle]
    return shapely.Polygon([(left, opening.sill_m), (right, opening.sill_m), *arch])


def _fill(opening: Opening, rng: np.random.Generator) -> list[Part]:
    """Return the reveal around the hole, and its leaf or frame."""
    wall, depth = opening.wall, opening.depth_m
    corners = np.array(_outline(opening).exterior.coords)
    parts = []
    for a, b in pairwise(corners):
        if np.linalg.norm(b - a) < 1e-6:
            continue
        quad = np.concatenate([_in_room(wall, np.array([a, b]), 0.0), _in_room(wall, np.array([b, a]), depth)])
        threshold = max(a[1], b[1]) < 1e-6
        parts.append(Part("floor" if threshold else "frame", quad, np.array([[0, 1, 2], [0, 2, 3]])))
    if opening.kind in ("open door", "shut door", "front door"):
        parts += _leaf(opening, rng)
    if opening.kind in ("open door", "shut door", "front door") or rng.random() < 0.5:
        parts += _casing(opening)
    if opening.kind == "window":
        parts += _glazing(opening, rng)
    return parts


def _casing(opening: Opening) -> list[Part]:
    """Return trim around the hole, in front of the wall's face."""
    sides = [(opening.wall, None), *([] if opening.behind is None else [(opening.behind, span_behind(opening))])]
    parts = []
    for wall, span_m in sides:
        outline = _outline(opening, span_m)
        trim = outline.buffer(0.07, join_style="mitre").difference(outline).intersection(shapely.box(-99, 0, 99, 99))
        trim = trim.intersection(shapely.box(0.0, 0.0, wall.length_m, 99.0))
        parts += [_on_wall("frame", wall, piece, -0.015) for piece in _polygons(trim)]
    return parts


def _leaf(opening: Opening, rng: np.random.Generator) -> list[Part]:
    """Return a panelled door leaf with handles, hinged at the left end and opening into the room of `wall`."""
    wall, width = opening.wall, opening.right_m - opening.left_m - 0.02
    high = opening.top_m - 0.01
    parts = [slab("door", shapely.box(0.0, -_LEAF_M, width, 0.0), 0.008, high)]
    for low, top in ((0.15, 0.9), (1.1, high - 0.15)) if rng.random() < 0.6 else ():
        panel = shapely.box(0.12, -_LEAF_M - 0.008, width - 0.12, 0.008)
        parts.append(slab("door", panel, low, top))
    for side in (0.03, -_LEAF_M - 0.03):
        parts.append(tube("metal", (width - 0.17, side, 1.02), (width - 0.06, side, 1.02), 0.012, 6))
    # Leaf frame: x along the wall, y into the room.
    hinge = wall.point_m(opening.left_m + 0.01, 0.01 if opening.kind == "open door" else 0.05)
    swing = opening.swing if opening.kind == "open door" else 0.0
    bearing = np.arctan2(wall.along[1], wall.along[0]) + swing
    return [part.turned(bearing).moved(hinge[0], hinge[1]) for part in parts]


def _glazing(opening: Opening, rng: np.random.Generator) -> list[Part]:
    """Return frame and bars of a window; panes are fully transparent."""
    outline = _outline(opening)
    back = opening.depth_m * 0.6
    rim = outline.difference(outline.buffer(-0.05, join_style="mitre"))
    width = opening.right_m - opening.left_m
    bars = [
        shapely.box(x - 0.025, opening.sill_m, x + 0.025, opening.top_m)
        for x in np.linspace(opening.left_m, opening.right_m, 1 + max(1, round(width / rng.uniform(0.6, 1.1))))[1:-1]
    ]
    if rng.random() < 0.5:
        z = opening.sill_m + (opening.top_m - opening.sill_m) * rng.uniform(0.4, 0.75)
        bars.append(shapely.box(opening.left_m, z - 0.02, opening.right_m, z + 0.02))
    frame = shapely.union_all([rim, *bars])
    parts = [_on_wall("frame", opening.wall, piece, back) for piece in _polygons(frame)]
    if opening.sill_m > 0.3:
        ends = [
            opening.wall.point_m(along_m, out_m)
            for along_m, out_m in (
                (opening.left_m - 0.05, 0.0),
                (opening.right_m + 0.05, 0.0),
                (opening.right_m + 0.05, -0.1),
                (opening.left_m - 0.05, -0.1),
            )
        ]
        parts.append(slab("frame", shapely.Polygon(ends), opening.sill_m - 0.03, opening.sill_m))
    return parts
