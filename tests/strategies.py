"""Random rooms, plans and poses for property tests, and builders and comparisons shared by all tests."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from hypothesis import strategies as st

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.render.sampling import PoseSet, random_poses

Polygon = list[list[float]]
T = TypeVar("T")

# Random rooms are wider than this almost everywhere, so that a pose with the margin below exists.
POSE_MARGIN_M = 0.15


def present(value: T | None) -> T:
    """Return a value that must not be None."""
    assert value is not None
    return value


def rectangle(width_m: float, depth_m: float, corner: tuple[float, float] = (0.0, 0.0)) -> Polygon:
    """Return a rectangle with its lower left corner at `corner`."""
    x, y = corner
    return [[x, y], [x + width_m, y], [x + width_m, y + depth_m], [x, y + depth_m]]


def l_shape(width_m: float, depth_m: float, cut_width_m: float, cut_depth_m: float) -> Polygon:
    """Return a rectangle at the origin without its upper right corner."""
    x, y = width_m - cut_width_m, depth_m - cut_depth_m
    return [[0.0, 0.0], [width_m, 0.0], [width_m, y], [x, y], [x, depth_m], [0.0, depth_m]]


def spiral(corners: int) -> Polygon:
    """Return a spiral room, in which the largest inscribed circle is hard to find."""
    turns, half = corners // 40, corners // 2

    def arm(offset_m: float) -> list[list[float]]:
        angles = [0.6 + k * (2.0 * math.pi * turns - 0.6) / (half - 1) for k in range(half)]
        radii = [angle / (2.0 * math.pi) + offset_m for angle in angles]
        return [[r * math.cos(a), r * math.sin(a)] for r, a in zip(radii, angles, strict=True)]

    return [*arm(0.3), *reversed(arm(0.0))]


def same_ring(first: np.ndarray, second: np.ndarray, tolerance_m: float) -> bool:
    """Return True if two rings (n, 2) have the same vertices in the same cyclic order."""
    if first.shape != second.shape:
        return False
    shifts = (np.roll(first, shift, axis=0) for shift in range(len(first)))
    return any(np.abs(shifted - second).max() <= tolerance_m for shifted in shifts)


def plan_document(*polygons: Any, ceiling_m: float = 2.5, **extra: Any) -> dict[str, Any]:
    """Return a plan in the native format with rooms "room 1", "room 2" and so on; `extra` replaces or adds keys."""
    rooms = [{"name": f"room {index + 1}", "polygon": polygon} for index, polygon in enumerate(polygons)]
    return {"name": "test plan", "ceiling_height_m": ceiling_m, "rooms": rooms, **extra}


def plan_of(*polygons: Any, ceiling_m: float = 2.5, **extra: Any) -> FloorPlan:
    """Return a validated plan of these polygons."""
    return FloorPlan.from_dict(plan_document(*polygons, ceiling_m=ceiling_m, **extra))


def crooked_flat() -> FloorPlan:
    """Return three rooms without symmetry, so that every pose and heading looks different."""
    return plan_of(
        [[0.0, 0.0], [4.0, 0.0], [4.0, 2.2], [2.6, 2.2], [2.6, 3.4], [0.0, 3.0]],
        [[4.2, 0.0], [6.3, 0.0], [6.0, 3.1], [4.2, 2.5]],
        [[0.0, 3.6], [5.0, 3.6], [5.6, 4.4], [5.0, 6.0], [0.0, 6.0]],
    )


@dataclass(frozen=True, eq=False)
class Scene:
    """Poses in a plan with one heading each, ready for `wall_profile`."""

    plan: FloorPlan
    poses: PoseSet
    heading: np.ndarray

    @property
    def walls_m(self) -> np.ndarray:
        """Walls of each pose's room."""
        return self.plan.walls_m[self.poses.room_index]

    @property
    def ceiling_height_m(self) -> np.ndarray:
        """Ceiling of each pose's room."""
        return self.plan.ceiling_heights_m[self.poses.room_index]


def scene_of(plan: FloorPlan, count: int, seed: int, margin_m: float = POSE_MARGIN_M) -> Scene:
    """Return `count` random poses of a plan with random headings."""
    rng = np.random.default_rng(seed)
    return Scene(plan, random_poses(plan, count, rng, margin_m), rng.uniform(-math.pi, math.pi, count))


_lengths = st.floats(1.6, 8.0).map(lambda value: round(value, 2))
_shares = st.floats(0.25, 0.7)
_seeds = st.integers(0, 2**32 - 1)


@st.composite
def rectangles(draw: st.DrawFn) -> Polygon:
    """Draw rectangular rooms at the origin."""
    return rectangle(draw(_lengths), draw(_lengths))


@st.composite
def l_shapes(draw: st.DrawFn) -> Polygon:
    """Draw L-shaped rooms at the origin."""
    width, depth = draw(_lengths), draw(_lengths)
    return l_shape(width, depth, draw(_shares) * width, draw(_shares) * depth)


@st.composite
def notched(draw: st.DrawFn) -> Polygon:
    """Draw rectangles with a pillar or a recess in the upper wall."""
    width, depth = draw(_lengths), draw(_lengths)
    start = draw(st.floats(0.1, 0.4)) * width
    end = start + draw(st.floats(0.15, 0.4)) * width
    tip = depth * (1.0 + draw(st.sampled_from([-1.0, 1.0])) * draw(st.floats(0.1, 0.5)))
    notch = [[end, depth], [end, tip], [start, tip], [start, depth]]
    return [[0.0, 0.0], [width, 0.0], [width, depth], *notch, [0.0, depth]]


@st.composite
def slanted(draw: st.DrawFn) -> Polygon:
    """Draw rectangles with one corner cut off at an angle."""
    width, depth = draw(_lengths), draw(_lengths)
    side, top = depth * (1.0 - draw(_shares)), width * (1.0 - draw(_shares))
    return [[0.0, 0.0], [width, 0.0], [width, side], [top, depth], [0.0, depth]]


@st.composite
def star_shapes(draw: st.DrawFn) -> Polygon:
    """Draw star-shaped polygons around the origin, without right angles."""
    count = draw(st.integers(4, 9))
    radii = draw(st.lists(st.floats(1.2, 5.0), min_size=count, max_size=count))
    jitter = draw(st.lists(st.floats(-0.3, 0.3), min_size=count, max_size=count))
    angles = [2.0 * math.pi * (index + shift) / count for index, shift in enumerate(jitter)]
    return [[r * math.cos(a), r * math.sin(a)] for r, a in zip(radii, angles, strict=True)]


@st.composite
def convex_polygons(draw: st.DrawFn) -> Polygon:
    """Draw convex rooms: without occlusion the wall profile is continuous in the pose."""
    return _moved(draw(st.one_of(rectangles(), slanted())), draw(st.floats(0.0, 2.0 * math.pi)), (0.0, 0.0))


@st.composite
def room_polygons(draw: st.DrawFn, offset_m: float = 20.0) -> Polygon:
    """Draw simple polygons of every family, rotated by any angle and moved by up to `offset_m`."""
    polygon = draw(st.one_of(rectangles(), l_shapes(), notched(), slanted(), star_shapes()))
    angle = draw(st.one_of(st.just(0.0), st.floats(0.0, 2.0 * math.pi)))
    shift = (draw(st.floats(-offset_m, offset_m)), draw(st.floats(-offset_m, offset_m)))
    return _moved(polygon, angle, shift)


@st.composite
def plans(draw: st.DrawFn, max_rooms: int = 3) -> FloorPlan:
    """Draw plans of one to `max_rooms` rooms side by side, some with their own ceiling."""
    polygons = draw(st.lists(room_polygons(offset_m=0.0), min_size=1, max_size=max_rooms))
    placed = [_moved(polygon, 0.0, (30.0 * index, 0.0)) for index, polygon in enumerate(polygons)]
    document = plan_document(*placed, ceiling_m=draw(st.floats(2.1, 4.0)))
    for room in document["rooms"]:
        if draw(st.booleans()):
            room["ceiling_height_m"] = draw(st.floats(2.1, 4.0))
    return FloorPlan.from_dict(document)


@st.composite
def scenes(draw: st.DrawFn, count: int = 3) -> Scene:
    """Draw random poses with random headings in one random room, near the origin or far from it."""
    return scene_of(plan_of(draw(room_polygons()), ceiling_m=draw(st.floats(2.1, 4.0))), count, draw(_seeds))


@st.composite
def rows_of_rooms(draw: st.DrawFn) -> FloorPlan:
    """Draw rooms in a row, rotated by any angle, with openings, columns and free-standing walls."""
    thickness = draw(st.floats(0.0, 0.3))
    rooms, openings, x, previous = [], [], 0.0, None
    for index in range(draw(st.integers(1, 3))):
        width, depth, base = draw(st.floats(2.5, 6.0)), draw(st.floats(2.5, 6.0)), draw(st.floats(-0.8, 0.8))
        room = {"name": f"room {index}", "polygon": rectangle(width, depth, corner=(x, base))}
        if draw(st.booleans()):
            room["holes"] = [rectangle(0.4, 0.3, corner=(x + 0.6 * width, base + 0.4 * depth))]
        if draw(st.booleans()):
            stub = [[x + 0.3 * width, base + depth], [x + 0.3 * width, base + 0.6 * depth]]
            room["walls"] = [stub]
            if draw(st.booleans()):
                middle = [[stub[0][0], base + 0.9 * depth], [stub[0][0], base + 0.7 * depth]]
                openings.append({"kind": draw(st.sampled_from(["door", "passage", "window"])), "line": middle})
        if previous is not None and draw(st.integers(0, 3)):
            low, high = max(base, previous[0]), min(base + depth, previous[1])
            begin = low + draw(st.floats(0.05, 0.5)) * (high - low)
            end = begin + draw(st.floats(0.2, 0.5)) * (high - low)
            line_x = x - draw(st.floats(0.0, 1.0)) * thickness
            line = [[line_x, begin], [line_x, end]]
            openings.append({"kind": draw(st.sampled_from(["door", "passage"])), "line": line})
        if draw(st.booleans()):
            heights = {"sill_m": draw(st.sampled_from([0.9, 1.6])), "head_m": 2.1}
            line = [[x + 0.2 * width, base], [x + 0.5 * width, base]]
            openings.append({"kind": "window", "line": line, **heights})
        if draw(st.booleans()):
            openings.append({"kind": "door", "line": [[x + 0.6 * width, base], [x + 0.8 * width, base - 0.1]]})
        rooms.append(room)
        x, previous = x + width + thickness, (base, base + depth)
    document = {"ceiling_height_m": 2.6, "rooms": rooms, "openings": openings}
    return FloorPlan.from_dict(_turned(document, draw(st.floats(0.0, 2.0 * math.pi))))


def _turned(value: Any, angle: float) -> Any:
    """Rotate every point of a document about the origin."""
    if isinstance(value, dict):
        return {key: _turned(item, angle) for key, item in value.items()}
    if isinstance(value, list) and len(value) == 2 and all(isinstance(item, float) for item in value):
        c, s = math.cos(angle), math.sin(angle)
        return [c * value[0] - s * value[1], s * value[0] + c * value[1]]
    return [_turned(item, angle) for item in value] if isinstance(value, list) else value


def seeds() -> st.SearchStrategy[int]:
    """Draw seeds of numpy generators."""
    return _seeds


def _moved(polygon: Polygon, angle: float, shift_m: tuple[float, float]) -> Polygon:
    cosine, sine = math.cos(angle), math.sin(angle)
    return [[cosine * x - sine * y + shift_m[0], sine * x + cosine * y + shift_m[1]] for x, y in polygon]
