"""Door leaves and their arcs among the lines of a drawing, which would otherwise be taken for walls."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import shapely

from lalaloc_core.importers.common.geometry import point_xy, segments_of, side_lengths
from lalaloc_core.importers.drawing.vector_drawing import Area, Drawing, Stroke, Swing, fit_swing

# Width of door leaves; other arcs are furniture, such as the corner of a bathtub.
LEAF_M = (0.45, 1.6)
# Angles of the arc of a leaf that is drawn half open, and the smallest angle between a slanted leaf and the walls.
_ARC_DEG, _SLANTED_DEG = (8.0, 125.0), 8.0
# Thickest leaf that is drawn as a rectangle, and distance within which ends of lines touch.
_THICK_LEAF_M, _TOUCH_M = 0.08, 0.03
# Hinges within this distance are of one door.
_NEAR: dict[str, Any] = {"predicate": "dwithin", "distance": 5 * _TOUCH_M}


def take_leaves(
    strokes: Sequence[Stroke], swings: Sequence[Swing], areas: Sequence[Area] = ()
) -> tuple[list[Stroke], list[Swing]]:
    """Separate the lines that could be walls, in metres, from door leaves and their arcs; return both.

    A leaf is a line as long as a door is wide with one free end, whose other end is the hinge, at a line or a wall that
    is drawn as an area: it is slanted against most lines, or an arc turns about its hinge.
    """
    arcs = {index: arc for index, stroke in enumerate(strokes) if (arc := _arc(stroke)) is not None}
    others = [stroke for index, stroke in enumerate(strokes) if index not in arcs]
    turning = [*swings, *arcs.values()]
    walls = [area.shape for area in areas if area.is_dark or area.role == "wall"]
    tree = shapely.STRtree([*(stroke.line for stroke in others), *walls])
    axis = _axis([*(stroke.line for stroke in others), *(wall.exterior for wall in walls)])
    kept, leaves, hinges = [], list(arcs.values()), _hinges(turning)
    for index, stroke in enumerate(others):
        leaf = _leaf(stroke, index, tree, axis, turning, hinges)
        if leaf is None:
            kept.append(stroke)
        # The arc of a leaf shows its width and both positions.
        elif not len(hinges.query(shapely.Point(leaf.hinge), **_NEAR)):
            leaves.append(leaf)
    return kept, leaves


def with_swings(drawing: Drawing) -> Drawing:
    """Return a drawing in metres whose lines on layers of doors that are arcs of leaves are swings."""
    arcs = [_arc(stroke) if stroke.role == "door" else None for stroke in drawing.strokes]
    return replace(
        drawing,
        strokes=[stroke for stroke, arc in zip(drawing.strokes, arcs, strict=True) if arc is None],
        swings=[*drawing.swings, *filter(None, arcs)],
    )


def drawn_leaves(drawing: Drawing) -> list[Swing]:
    """Return the lines on layers of doors that are as long as leaves, once about each end: either can be the hinge."""
    lines = [shapely.get_coordinates(stroke.line) for stroke in drawing.strokes if stroke.role == "door"]
    ends = [(point_xy(points[0]), point_xy(points[-1])) for points in lines if len(points) == 2]
    leaves = [(a, b) for a, b in ends if LEAF_M[0] <= math.dist(a, b) <= LEAF_M[1]]
    return [Swing(hinge, tip, tip) for a, b in leaves for hinge, tip in ((a, b), (b, a))]


def without_leaves(areas: Sequence[Area], swings: Sequence[Swing]) -> list[Area]:
    """Return the areas that are no door leaves: thin rectangles at the hinge of an arc, as long as its radius."""
    hinges = _hinges(swings)
    near = [[swings[k] for k in hinges.query(area.shape, **_NEAR)] for area in areas]
    return [a for a, turning in zip(areas, near, strict=True) if not any(_is_leaf(a.shape, swing) for swing in turning)]


def _hinges(swings: Sequence[Swing]) -> shapely.STRtree:
    return shapely.STRtree([shapely.Point(swing.hinge) for swing in swings])


def _is_leaf(shape: shapely.Polygon, swing: Swing) -> bool:
    thin, long = side_lengths(shape)
    is_at_tip = shapely.dwithin(shape, shapely.points([swing.first, swing.last]), 5 * _TOUCH_M).any()
    return thin <= _THICK_LEAF_M and abs(long - swing.radius) <= 0.1 * swing.radius and bool(is_at_tip)


def _arc(stroke: Stroke) -> Swing | None:
    swing = fit_swing(shapely.get_coordinates(stroke.line), stroke.layer, _ARC_DEG)
    return swing if swing is not None and LEAF_M[0] <= swing.radius <= LEAF_M[1] else None


def _axis(lines: Sequence[shapely.LineString]) -> float:
    """Return the direction (radians, modulo a quarter turn) of most lines."""
    segments = segments_of(lines)
    steps = (segments[:, 2:] - segments[:, :2]) @ [1.0, 1j]
    return float(np.angle(np.sum(np.abs(steps) * np.exp(4j * np.angle(steps))))) / 4.0


def _leaf(
    stroke: Stroke, index: int, tree: shapely.STRtree, axis: float, turning: Sequence[Swing], hinges: shapely.STRtree
) -> Swing | None:
    points = shapely.get_coordinates(stroke.line)
    if len(points) != 2 or not LEAF_M[0] <= stroke.line.length <= LEAF_M[1]:
        return None
    end, other = tree.query(shapely.points(points), predicate="dwithin", distance=_TOUCH_M)
    held = np.unique(end[other != index])
    if len(held) != 1:
        return None
    hinge, tip = points[held[0]], points[1 - held[0]]
    x, y = tip - hinge
    off_axis = abs((math.atan2(y, x) - axis + 0.25 * math.pi) % (0.5 * math.pi) - 0.25 * math.pi)
    arcs = [turning[k] for k in hinges.query(shapely.Point(hinge), **_NEAR)]
    has_arc = any(abs(arc.radius - stroke.line.length) <= 0.1 * arc.radius for arc in arcs)
    if math.degrees(off_axis) < _SLANTED_DEG and not has_arc:
        return None
    return Swing(point_xy(hinge), point_xy(tip), point_xy(tip), stroke.layer)
