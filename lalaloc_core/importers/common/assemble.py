"""Conversion of a sketch to a plan in the native format."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import DEFAULT_LIMITS, FloorPlan, PlanLimits
from lalaloc_core.floorplan.earth import Anchor, anchor_document
from lalaloc_core.floorplan.opening_trust import estimate_trust
from lalaloc_core.floorplan.plan_document import DEFAULT_CAMERA_HEIGHT_M, DEFAULT_CEILING_HEIGHT_M
from lalaloc_core.floorplan.plan_words import is_roof
from lalaloc_core.floorplan.room_types import room_types_from_name, type_fields
from lalaloc_core.importers.common.fixtures_in_rooms import place_fixtures, type_rooms
from lalaloc_core.importers.common.geometry import check_network, check_overlaps, distinct, polygons_of
from lalaloc_core.importers.common.import_limits import Budget
from lalaloc_core.importers.common.import_options import ImportOptions
from lalaloc_core.importers.common.import_report import ImportReport, ReportBuilder
from lalaloc_core.importers.common.opening_placement import place_openings
from lalaloc_core.importers.common.plausibility import check_document
from lalaloc_core.importers.common.sketch import Level, Point, Sketch, SketchedOpening, SketchedRoom, T, choose_levels

# Rounding in drawings: vertices this near to a straight wall (m) and slivers this small (m²) are dropped.
_STRAIGHT_M, _SLIVER_M2 = 0.002, 0.01
# Tolerances (m) tried in turn for outlines with more vertices than allowed, such as curved walls.
_SIMPLER_M = (0.005, 0.01, 0.02)
_FAR_M = 10_000.0
# Up to this distance from an anchor, lengths and directions are accurate to a few centimetres.
_MAX_ANCHOR_SHIFT_M = 20_000.0
# Share of a room that lies in a larger one, and of the larger one that several such rooms cover, and a single one that
# is the same room by other faces of its walls.
_INSIDE, _COVERED, _SAME = 0.95, 0.5, 0.7
# Resolution of coordinates: a tenth of a millimetre.
_GRID_M, _DECIMALS = 1e-4, 4
_MAX_NAMED, _MAX_USES = 5, 12
# Trusts in openings below this are reported as guesses.
_CERTAIN = 0.9


class NoRoomError(InvalidFloorPlanError):
    """A level of a file has no room."""


@dataclass(frozen=True, eq=False)
class ImportedPlan:
    """Plan of one storey of a file.

    Attributes:
        report: use of the layers, and likely mistakes.
        anchor: place of the plan's origin on Earth, if the file gives it.
        checked: limits and plan of an earlier validation.
    """

    document: dict[str, Any]
    report: ImportReport
    level: Level | None = None
    anchor: Anchor | None = None
    checked: tuple[PlanLimits, FloorPlan] | None = field(default=None, repr=False)

    def plan(self, limits: PlanLimits = DEFAULT_LIMITS) -> FloorPlan:
        """Return the validated plan.

        Raises:
            InvalidFloorPlanError: the plan is invalid or exceeds the limits.
        """
        if self.checked is not None and self.checked[0] == limits:
            return self.checked[1]
        return FloorPlan.from_dict(self.document, limits)


def assemble(sketch: Sketch, builder: ReportBuilder, options: ImportOptions, limits: PlanLimits) -> ImportedPlan:
    """Make a plan from a sketch in metres, y up.

    Outlines with more vertices than `limits` allows are simplified within 2 cm.
    """
    columns = distinct(sketch.obstacles)
    check_network(columns)
    obstacles = shapely.STRtree(columns)
    rooms = [room for drawn in sketch.rooms for room in _clean(drawn, obstacles, limits, builder)]
    if not rooms:
        raise NoRoomError(
            f"no room was found in the {builder.format} file, which has {_contents(builder)}"
            + (f" (tried: {'; '.join(builder.notes[:_MAX_NAMED])})" if builder.notes else "")
            + "; "
            + "; ".join([*list(dict.fromkeys(builder.warnings))[:_MAX_NAMED], "check layers, level and the scale"])
        )
    # Coordinates on Earth have no unit that could be mistaken.
    is_certain, metres_per_unit = sketch.anchor is not None, builder.metres_per_unit
    sketch = _near_origin(replace(sketch, rooms=without_areas(rooms, builder)), builder)
    openings, off_wall, overlapping = place_openings(sketch.openings, [room.shape for room in sketch.rooms])
    if off_wall:
        places = ", ".join(f"({o.start[0]:.2f}, {o.start[1]:.2f})" for o in off_wall[:_MAX_NAMED])
        builder.warnings.append(f"{len(off_wall)} openings lie on no wall and were left out, for example at {places}")
    if overlapping:
        builder.notes.append(f"{overlapping} openings that overlap other openings were left out")
    name = options.name or clean_name(sketch.name)
    document: dict[str, Any] = {} if name is None else {"name": name}
    north_deg = sketch.north_deg if sketch.anchor is None else sketch.anchor.north_deg
    if north_deg is not None:
        document["north_deg"] = round(north_deg % 360.0, 6)
    if sketch.anchor is not None:
        document["anchor"] = anchor_document(sketch.anchor)
    fixtures = place_fixtures(sketch.fixtures, sketch.rooms, builder)
    rooms = type_rooms(sketch.rooms, fixtures, builder)
    ceiling_m = _usual_ceiling(rooms, options, builder)
    if ceiling_m is not None:
        document["ceiling_height_m"] = ceiling_m
    document["rooms"] = [_room(room, ceiling_m, sketch.inner_walls) for room in rooms]
    if openings:
        document["openings"] = [_opening(opening) for opening in openings]
    if fixtures:
        document["fixtures"] = [{"kind": item.kind, "outline": _ring(item.shape.exterior)} for _, item in fixtures]
    _add_trust(document, sketch, builder)
    builder.warnings += check_document(document, is_certain=is_certain, metres_per_unit=metres_per_unit)
    # Validate now, while the error can still refer to the file.
    plan = FloorPlan.from_dict(document, limits)
    builder.warnings += [f"{line}; draw each area once" for line in plan.warnings if " overlap" in line]
    return ImportedPlan(document, builder.build(), sketch.level, sketch.anchor, (limits, plan))


def _add_trust(document: dict[str, Any], sketch: Sketch, builder: ReportBuilder) -> None:
    """Set the trust in every kind of openings, and report it."""
    if sketch.opening_kinds is not None:
        document["opening_kinds"] = list(sketch.opening_kinds)
        return
    builder.opening_trust = estimate_trust(document, sketch.recall, sketch.kinds)
    document["opening_kinds"] = []
    document["opening_trust"] = {entry.kind: entry.trust for entry in builder.opening_trust if entry.trust > 0.0}
    builder.unsure += [
        f"{100.0 * entry.trust:.0f} % of {entry.kind}s are taken to be drawn, because {entry.reason}; correct it with "
        "opening_trust, or list the kind in opening_kinds if all are drawn"
        for entry in builder.opening_trust
        if entry.trust < _CERTAIN
    ]


def assemble_levels(
    levels: Mapping[str, tuple[Level, T]],
    options: ImportOptions,
    budget: Budget,
    make: Callable[[Level, T], ImportedPlan],
) -> tuple[ImportedPlan, ...]:
    """Return the plans of the chosen levels, lowest first; of several levels, those without a room are left out.

    `levels` are the levels of a file with their contents, and `make` makes the plan of one of them; the budget is told
    every level as it begins.
    """
    chosen = choose_levels(levels, options)
    if len(chosen) > (most := budget.limits.max_levels):
        raise InvalidFloorPlanError(f"the file has {len(chosen)} levels; the limit is {most} (max_levels); set level")
    plans: list[ImportedPlan] = []
    empty: dict[str, NoRoomError] = {}
    for done, (level, content) in enumerate(chosen):
        budget.begin(f"reading level '{level.name}'", done, len(chosen))
        try:
            plans.append(make(level, content))
        except NoRoomError as error:
            empty[level.name] = error
        except InvalidFloorPlanError as error:
            if len(chosen) == 1:
                raise
            raise InvalidFloorPlanError(f"level '{level.name}': {error}") from error
    if not plans:
        raise next(iter(empty.values()))
    reasons = [(name, str(error)) for name, error in empty.items()][:_MAX_NAMED]
    below = [plan for plan in plans if plan.level is None or not is_roof(plan.level.name)]
    if len(chosen) > 1 and below:
        roofs = [plan.level.name for plan in plans if plan.level is not None and plan not in below]
        reasons += [(name, "it is a roof (set level to read it)") for name in roofs[:_MAX_NAMED]]
        plans = below
    lost = [f"level '{name}' was left out: {reason}" for name, reason in reasons]
    return tuple(replace(plan, report=replace(plan.report, warnings=(*plan.report.warnings, *lost))) for plan in plans)


def clean_name(name: str | None) -> str | None:
    """Return a name without control characters, cut to the limit; None if nothing is left."""
    if name is None:
        return None
    spaced = "".join(" " if unicodedata.category(c) in {"Cc", "Cs", "Zl", "Zp"} else c for c in name)
    return " ".join(spaced.split())[: DEFAULT_LIMITS.max_name_length] or None


def _clean(room: SketchedRoom, tree: shapely.STRtree, limits: PlanLimits, builder: ReportBuilder) -> list[SketchedRoom]:
    label = _label(room)
    shape = room.shape
    near = tree.geometries[np.sort(tree.query(shape))]
    if inside := [obstacle for obstacle in near if obstacle.intersects(shape)]:
        shape = shapely.difference(shape, shapely.union_all(inside))
    floors = [simple for floor in polygons_of(shape) for simple in _simple(_simplify(floor, label, limits, builder))]
    floors = [floor for floor in floors if floor.area >= limits.min_room_area_m2]
    if not floors and room.shape.area >= _SLIVER_M2:
        builder.notes.append(
            f"{label} of {room.shape.area:.2g} m² was left out: the smallest room is {limits.min_room_area_m2:g} m²"
        )
    if len(floors) > 1:
        builder.warnings.append(f"{label} has {len(floors)} separate parts; each became a room")
    name = clean_name(room.name)
    named = replace(room, name=name, types=room.types or room_types_from_name(name))
    holes = [[ring for ring in floor.interiors if shapely.Polygon(ring).area >= _SLIVER_M2] for floor in floors]
    shapes = (shapely.Polygon(floor.exterior, rings) for floor, rings in zip(floors, holes, strict=True))
    return [replace(named, shape=shape) for shape in shapes]


def without_areas(rooms: list[SketchedRoom], builder: ReportBuilder) -> list[SketchedRoom]:
    """Leave out low rooms, the areas of several other rooms, such as a storey's, and rooms drawn twice, and say so."""
    rooms = _without_low_rooms(rooms, builder)
    check_overlaps([room.shape for room in rooms], what="rooms")
    tree, left_out = shapely.STRtree([room.shape for room in rooms]), set[int]()
    # Of equal areas the one without a type is left out, or else the later one.
    order = [(room.shape.area, not room.types, index) for index, room in enumerate(rooms)]
    for area_m2, _, index in sorted(order, reverse=True):
        room = rooms[index]
        inside = [
            rooms[k]
            for k in tree.query(room.shape, predicate="intersects").tolist()
            if order[k] < order[index] and room.shape.intersection(rooms[k].shape).area >= _INSIDE * rooms[k].shape.area
        ]
        share = shapely.union_all([part.shape for part in inside]).area / area_m2
        if share > (_COVERED if len(inside) > 1 else _SAME):
            builder.warnings.append(
                f"{_label(room)} ({area_m2:.1f} m²) covers {len(inside)} rooms, such as {_label(inside[0])}, and was "
                "left out as an area; remove these if it is one room"
            )
            left_out.add(index)
    return [room for index, room in enumerate(rooms) if index not in left_out]


def _without_low_rooms(rooms: list[SketchedRoom], builder: ReportBuilder) -> list[SketchedRoom]:
    """Leave out rooms that no camera stands in, such as a cupboard under stairs, and say so."""
    low = [room for room in rooms if (room.ceiling_height_m or math.inf) <= DEFAULT_CAMERA_HEIGHT_M]
    total_m2 = sum(room.shape.area for room in rooms)
    lines = [
        f"{_label(room)} ({room.shape.area:.1f} m², {100.0 * room.shape.area / total_m2:.0f} % of the floor) is "
        f"{room.ceiling_height_m:.2f} m high"
        for room in low
    ]
    if low and len(low) == len(rooms):
        raise NoRoomError(
            f"no room is higher than a camera, {DEFAULT_CAMERA_HEIGHT_M:g} m: {'; '.join(lines[:_MAX_NAMED])}; correct "
            "the heights in the file if the rooms are higher"
        )
    builder.warnings += [
        f"{line} and was left out: a camera stands at {DEFAULT_CAMERA_HEIGHT_M:g} m; correct the height in the file if "
        "the room is higher"
        for line in lines
    ]
    return [room for room in rooms if room not in low]


def _label(room: SketchedRoom) -> str:
    return f"room '{room.name}'" if room.name else "a room without a name"


def _simplify(floor: shapely.Polygon, label: str, limits: PlanLimits, builder: ReportBuilder) -> BaseGeometry:
    """Return a floor without vertices on straight walls, and within the limit of vertices if 2 cm suffice for that."""
    shape = floor.simplify(_STRAIGHT_M)
    drawn, limit = _vertices(shape), limits.max_vertices_per_room
    for tolerance_m in _SIMPLER_M:
        if _vertices(shape) <= limit:
            break
        shape = floor.simplify(tolerance_m)
    if drawn > limit:
        builder.notes.append(
            f"{label} has {drawn} vertices; the limit is {limit} (max_vertices), so its outline was simplified "
            f"within {100.0 * _SIMPLER_M[-1]:g} cm to {_vertices(shape)}"
        )
    return shape


def _vertices(shape: BaseGeometry) -> int:
    # Rings repeat their first vertex.
    return int(shapely.count_coordinates(shape)) - len(shapely.get_rings(shapely.get_parts(shape)))


def _simple(floor: BaseGeometry) -> list[shapely.Polygon]:
    """Return polygons with rounded coordinates whose outlines do not touch themselves."""
    found = []
    for part in polygons_of(shapely.transform(floor, lambda points: points.round(_DECIMALS))):
        if shapely.Polygon(part.exterior).is_valid:
            found.append(part)
        else:
            apart = part.buffer(-10.0 * _GRID_M).buffer(10.0 * _GRID_M, join_style="mitre")
            found += polygons_of(shapely.set_precision(apart, _GRID_M))
    return found


def _near_origin(sketch: Sketch, builder: ReportBuilder) -> Sketch:
    """Move a sketch in coordinates of a national grid to the origin; it keeps an anchor that stays accurate."""
    x0, y0, x1, y1 = shapely.total_bounds([room.shape for room in sketch.rooms])
    if max(abs(x0), abs(y0), abs(x1), abs(y1)) <= _FAR_M:
        return sketch
    dx, dy = float(-math.floor(x0)), float(-math.floor(y0))
    builder.notes.append(f"the plan was moved by ({dx:.0f}, {dy:.0f}) m to lie near its origin")
    anchor, distance_m = sketch.anchor, math.hypot(dx, dy)
    if anchor is not None and distance_m > _MAX_ANCHOR_SHIFT_M:
        builder.warnings.append(
            f"the anchor was left out: the file's origin is {distance_m / 1000.0:.0f} km from the plan; the limit is "
            f"{_MAX_ANCHOR_SHIFT_M / 1000.0:g} km"
        )
        anchor = None

    def moved(point: Point) -> Point:
        return point[0] + dx, point[1] + dy

    return replace(
        sketch,
        rooms=[replace(room, shape=affinity.translate(room.shape, dx, dy)) for room in sketch.rooms],
        openings=[replace(part, start=moved(part.start), end=moved(part.end)) for part in sketch.openings],
        inner_walls=[affinity.translate(wall, dx, dy) for wall in sketch.inner_walls],
        fixtures=[replace(fixture, shape=affinity.translate(fixture.shape, dx, dy)) for fixture in sketch.fixtures],
        anchor=None if anchor is None else anchor.moved((-dx, -dy)),
    )


def _usual_ceiling(rooms: list[SketchedRoom], options: ImportOptions, builder: ReportBuilder) -> float | None:
    """Return the ceiling height of rooms without their own; None if no height is known, so that plans assume one."""
    known = [room.ceiling_height_m for room in rooms if room.ceiling_height_m is not None]
    if options.ceiling_height_m is not None:
        return options.ceiling_height_m
    usual_m = round(float(np.median(known)), 4) if known else None
    if usual_m is None:
        assumed = f"no ceiling height is given; {DEFAULT_CEILING_HEIGHT_M:g} m"
    else:
        without = f"{len(rooms) - len(known)} of {len(rooms)}"
        assumed = f"{without} rooms give no ceiling height; {usual_m:g} m, the median of the others,"
    if len(known) < len(rooms):
        builder.unsure.append(f"{assumed} is assumed (set ceiling_height_m)")
    return usual_m


def _room(room: SketchedRoom, ceiling_m: float | None, walls: Sequence[shapely.LineString]) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": room.name} if room.name else {}
    entry |= {"polygon": _ring(room.shape.exterior)} | type_fields(room.types)
    if room.shape.interiors:
        entry["holes"] = [_ring(ring) for ring in room.shape.interiors]
    if inner_walls := [wall for wall in walls if room.shape.contains(wall)]:
        entry["walls"] = [[_xy(point) for point in wall.coords] for wall in inner_walls]
    if room.ceiling_height_m is not None and ceiling_m is not None and abs(room.ceiling_height_m - ceiling_m) > 1e-6:
        entry["ceiling_height_m"] = round(room.ceiling_height_m, 4)
    return entry


def _opening(opening: SketchedOpening) -> dict[str, Any]:
    entry: dict[str, Any] = {"kind": opening.kind, "line": [_xy(opening.start), _xy(opening.end)]}
    if name := clean_name(opening.name):
        entry["name"] = name
    # A sill needs a head above it.
    sill, head = opening.sill_m, opening.head_m
    if head is not None and head > max(sill or 0.0, 0.0):
        entry["head_m"] = round(head, 4)
        if sill is not None and sill >= 0.0:
            entry["sill_m"] = round(sill, 4)
    return entry


def _ring(ring: shapely.LinearRing) -> list[list[float]]:
    return [_xy(point) for point in ring.coords[:-1]]


def _xy(point: tuple[float, ...]) -> list[float]:
    return [round(float(point[0]), _DECIMALS) + 0.0, round(float(point[1]), _DECIMALS) + 0.0]


def _contents(builder: ReportBuilder) -> str:
    uses = [f"{count} {use} on '{layer}'" for (layer, use), count in builder.uses.most_common()]
    more = f" and {len(uses) - _MAX_USES} more" if len(uses) > _MAX_USES else ""
    return ", ".join(uses[:_MAX_USES]) + more or "nothing that could be a room"
