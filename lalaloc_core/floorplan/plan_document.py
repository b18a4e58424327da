"""Reading of a plan's document: rooms, openings, fixtures, north and place, and the camera height."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float, Int

from lalaloc_core.conventions import (
    FIXTURE_KINDS,
    OPENING_CLASSES,
    ROOM_TYPES,
    heading_from_degrees,
    heading_to_degrees,
)
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import read_anchor
from lalaloc_core.floorplan.json_values import (
    PlanLimits,
    check_keys,
    json_kind,
    read_choice,
    read_list,
    read_name,
    read_number,
    read_number_between,
    read_optional,
    read_points,
    read_segment,
)
from lalaloc_core.floorplan.openings import DEFAULT_OPENING_TOLERANCE_M, Opening, label, place_openings
from lalaloc_core.floorplan.room_types import room_types_from_name, types_by_fixtures
from lalaloc_core.floorplan.rooms import Room, check_size, frozen, overlap_warnings

DEFAULT_CAMERA_HEIGHT_M, DEFAULT_CEILING_HEIGHT_M = 1.5, 2.5
MAX_CAMERA_HEIGHT_STD_M = 2.0
_PLAN_KEYS = {
    "name", "rooms", "ceiling_height_m", "camera_height_m", "camera_height_std_m", "north_deg", "anchor", "openings",
    "opening_kinds", "opening_trust", "opening_tolerance_m", "fixtures",
}  # fmt: skip
_ROOM_KEYS = {"id", "name", "type", "types", "polygon", "holes", "walls", "ceiling_height_m"}
# Free-standing walls can reach this far outside the floor: drawings let a stub begin on the axis of another wall.
_WALL_OVERSHOOT_M = 0.01
_KINDS = OPENING_CLASSES[1:]
_PLACE = re.compile(r"\[(\S+) (\S+)\]")
_OPENING_KEYS = {"kind", "line", "sill_m", "head_m", "name", "rooms"}
# Distances of openings from their walls, from the rounding of drawings to the thickest walls.
TOLERANCES_M = (0.01, 1.5)
_KEYS = {"kind", "outline"}


def read_plan(document: Any, limits: PlanLimits, warnings: Sequence[str] | None) -> dict[str, Any]:
    """Read and check the fields of a `FloorPlan`; `warnings` are those of its first check, None to compute them."""
    if not isinstance(document, Mapping):
        raise InvalidFloorPlanError(f"a plan must be an object, not {json_kind(document)}")
    check_keys(document, _PLAN_KEYS)
    name = read_name(document.get("name", "floor plan"), limits, label="the plan's name")
    ceiling = document.get("ceiling_height_m")
    default_ceiling_m = None if ceiling is None else read_ceiling(ceiling, None, limits)
    rooms = read_rooms(document.get("rooms"), default_ceiling_m, limits)
    check_size(rooms, limits)
    openings = read_openings(document.get("openings"), rooms, limits)
    opening_trust = read_opening_trust(document, openings)
    tolerance_m = read_optional(document.get("opening_tolerance_m"), "opening_tolerance_m", *TOLERANCES_M, " m")
    tolerance_m = DEFAULT_OPENING_TOLERANCE_M if tolerance_m is None else tolerance_m
    faces, unplaced = place_openings(openings, rooms, tolerance_m, limits)
    if openings and not faces:
        raise InvalidFloorPlanError(
            f"all openings are more than {tolerance_m:g} m from every wall (opening_tolerance_m); check that "
            "openings and rooms are in the same units"
        )
    stated_deg = read_optional(document.get("north_deg"), "north_deg", -360.0, 360.0, "")
    north = None if stated_deg is None else heading_from_degrees(stated_deg)
    # Rounding restores degrees that were converted to radians.
    north_deg = None if north is None else round(heading_to_degrees(north), 9)
    anchor = read_anchor(document.get("anchor"), north_deg, rooms)
    if anchor is not None:
        north = heading_from_degrees(anchor.north_deg)
    fixtures = read_fixtures(document.get("fixtures"), limits)
    if warnings is None:
        off_wall = [f"{label(openings[k], k)} is not on a wall" for k in unplaced]
        ceilings = ceiling_warnings(rooms, default_ceiling_m)
        warnings = (*ceilings, *overlap_warnings(rooms, limits), *off_wall, *trust_warnings(document))
    return {
        "name": name,
        "rooms": with_types_of_fixtures(rooms, fixtures, document["rooms"]),
        "camera_height_m": read_camera_height(document.get("camera_height_m"), rooms, limits),
        "warnings": tuple(warnings),
        "north": north,
        "openings": openings,
        "opening_trust": opening_trust,
        "opening_tolerance_m": tolerance_m,
        "opening_faces": faces,
        "camera_height_std_m": read_optional(
            document.get("camera_height_std_m"), "camera_height_std_m", 0.0, MAX_CAMERA_HEIGHT_STD_M, " m"
        ),
        "states_camera_height": document.get("camera_height_m") is not None,
        "anchor": anchor,
        "fixtures": fixtures,
        "ceiling_height_m": default_ceiling_m,
    }


def read_rooms(raw_rooms: Any, default_ceiling_m: float | None, limits: PlanLimits) -> tuple[Room, ...]:
    """Read all rooms of a plan and give ids to rooms without one."""
    if not isinstance(raw_rooms, list) or not raw_rooms:
        raise InvalidFloorPlanError("'rooms' must be a list of at least one room")
    if len(raw_rooms) > limits.max_rooms:
        raise InvalidFloorPlanError(f"the plan has {len(raw_rooms)} rooms; the limit is {limits.max_rooms} (max_rooms)")
    vertices = sum(_count_vertices(raw) for raw in raw_rooms if isinstance(raw, Mapping))
    if vertices > limits.max_plan_vertices:
        raise InvalidFloorPlanError(
            f"the plan has {vertices} vertices; the limit is {limits.max_plan_vertices} (max_plan_vertices)"
        )
    rooms = [_read_room(raw, f"room {i + 1}", default_ceiling_m, limits) for i, raw in enumerate(raw_rooms)]
    return tuple(replace(room, id=key) for room, key in zip(rooms, _unique_ids(rooms), strict=True))


def read_ceiling(value: Any, room: str | None, limits: PlanLimits) -> float:
    """Read a ceiling height (m)."""
    low, high = limits.min_ceiling_height_m, limits.max_ceiling_height_m
    return read_number_between(value, "ceiling_height_m", low, high, " m", room)


def ceiling_warnings(rooms: Sequence[Room], default_ceiling_m: float | None) -> list[str]:
    """Return a warning if the ceiling height of some rooms is assumed."""
    assumed = sum(not room.states_ceiling for room in rooms) if default_ceiling_m is None else 0
    if assumed == 0:
        return []
    some = "" if assumed == len(rooms) else f" for {assumed} of {len(rooms)} rooms"
    return [f"no ceiling height is given{some}; {DEFAULT_CEILING_HEIGHT_M:g} m is assumed (set ceiling_height_m)"]


def _count_vertices(raw: Mapping[str, Any]) -> int:
    """Count the vertices of outline and holes, and one for each free-standing wall, before reading them."""
    holes = raw.get("holes")
    rings = [raw.get("polygon"), raw.get("walls"), *(holes if isinstance(holes, list | tuple) else ())]
    return sum(len(ring) for ring in rings if isinstance(ring, list | tuple))


def _read_room(raw: Any, fallback_name: str, default_ceiling_m: float | None, limits: PlanLimits) -> Room:
    if not isinstance(raw, Mapping):
        raise InvalidFloorPlanError(f"a room must be an object, not {json_kind(raw)}", room=fallback_name)
    name = read_name(raw.get("name", fallback_name), limits, label=f"the name of {fallback_name}")
    check_keys(raw, _ROOM_KEYS, room=name)
    key = read_name(raw["id"], limits, "the id", room=name) if raw.get("id") is not None else ""
    types = _read_types(raw, name)
    ceiling = raw.get("ceiling_height_m")
    usual_m = DEFAULT_CEILING_HEIGHT_M if default_ceiling_m is None else default_ceiling_m
    height_m = usual_m if ceiling is None else read_ceiling(ceiling, name, limits)
    if (vertices := _count_vertices(raw)) > limits.max_vertices_per_room:
        raise InvalidFloorPlanError(
            f"{vertices} vertices; the limit is {limits.max_vertices_per_room} (max_vertices); simplify its outline",
            room=name,
        )
    outline_m = _read_ring(raw.get("polygon"), "polygon", name, limits)
    holes_m = _read_holes(raw.get("holes"), outline_m, name, limits)
    shape = shapely.Polygon(outline_m, holes_m)
    if shape.area < limits.min_room_area_m2:
        raise InvalidFloorPlanError(
            f"the area is {shape.area:.3g} m²; the minimum is {limits.min_room_area_m2:g} m² "
            "(PlanLimits.min_room_area_m2); check that the coordinates are in metres",
            room=name,
        )
    return Room(
        name=name,
        polygon_m=outline_m,
        ceiling_height_m=height_m,
        id=key,
        types=types,
        holes_m=holes_m,
        inner_walls_m=_read_walls(raw.get("walls"), shape, name, limits),
        states_ceiling=ceiling is not None,
    )


def _read_types(raw: Mapping[str, Any], room: str) -> tuple[str, ...]:
    """Read the types of a room; the name gives them if neither `type` nor `types` does."""
    first = read_choice(raw.get("type", ROOM_TYPES[0]), ROOM_TYPES, "the type", room=room)
    if raw.get("types") is None:
        return room_types_from_name(room) if first == ROOM_TYPES[0] else (first,)
    entries = read_list(raw["types"], "types", len(ROOM_TYPES) - 1, "one of each", room)
    types = tuple(dict.fromkeys(read_choice(kind, ROOM_TYPES[1:], "an entry of types", room=room) for kind in entries))
    if first == ROOM_TYPES[0]:
        return types
    if first not in types:
        raise InvalidFloorPlanError(f"the type is '{first}', which types does not list; remove one of them", room=room)
    return tuple(dict.fromkeys((first, *types)))


def _read_ring(raw: Any, field: str, room: str, limits: PlanLimits, *, is_hole: bool = False) -> np.ndarray:
    """Read a simple polygon: counter-clockwise, or clockwise for a hole; read-only."""
    if not isinstance(raw, list | tuple) or len(raw) < 3:
        raise InvalidFloorPlanError(f"'{field}' must be a list of at least three [x, y] vertices", room=room)
    ring = read_points(raw, limits, room, "vertex" if field == "polygon" else f"{field}: vertex")
    # Repeated vertices, such as the closing one of a closed ring, would be walls of length zero.
    ring = ring[np.any(ring != np.roll(ring, -1, axis=0), axis=1)]
    subject = "the polygon" if field == "polygon" else field
    if len(ring) < 3:
        raise InvalidFloorPlanError(f"{subject} has fewer than three distinct vertices", room=room)
    if _is_collinear(ring):
        raise InvalidFloorPlanError(f"all vertices of {subject} lie on one line", room=room)
    shape = shapely.Polygon(ring)
    if not shape.is_valid:
        raise InvalidFloorPlanError(f"{subject} crosses itself{_place_of_fault(shape)}", room=room)
    return frozen(ring if shape.exterior.is_ccw != is_hole else ring[::-1].copy())


def _place_of_fault(shape: shapely.Polygon) -> str:
    """Return the place where an invalid outline meets itself, in words; the library states it in brackets."""
    found = _PLACE.search(shapely.is_valid_reason(shape))
    return "" if found is None else f" at ({float(found[1]):.6g}, {float(found[2]):.6g})"


def _is_collinear(ring: Float[np.ndarray, "n 2"]) -> bool:
    # Relative to the first vertex: surveyed coordinates are large.
    away = ring - ring[0]
    length = np.hypot(*away.T)
    direction = away[np.argmax(length)] / length.max()
    aside = away[:, 0] * direction[1] - away[:, 1] * direction[0]
    return bool(np.abs(aside).max() <= 1e-9 * length.max())


def _read_holes(
    raw: Any, outline_m: Float[np.ndarray, "n 2"], room: str, limits: PlanLimits
) -> tuple[Float[np.ndarray, "_ 2"], ...]:
    holes = read_list([] if raw is None else raw, "holes", limits.max_vertices_per_room, "max_vertices", room)
    rings = tuple(_read_ring(hole, f"hole {i}", room, limits, is_hole=True) for i, hole in enumerate(holes))
    outline = shapely.Polygon(outline_m)
    shapely.prepare(outline)
    inside = shapely.covers(outline, [shapely.Polygon(ring) for ring in rings])
    if not inside.all():
        raise InvalidFloorPlanError(f"hole {np.argmin(inside)} does not lie inside the polygon", room=room)
    if rings and not (floor := shapely.Polygon(outline_m, rings)).is_valid:
        raise InvalidFloorPlanError(f"the holes cross or cut off parts of the floor{_place_of_fault(floor)}", room=room)
    return rings


def _read_walls(raw: Any, shape: shapely.Polygon, room: str, limits: PlanLimits) -> Float[np.ndarray, "k 4"]:
    walls = read_list([] if raw is None else raw, "walls", limits.max_vertices_per_room, "max_vertices", room)
    if not walls:
        return frozen(np.empty((0, 4)))
    points = np.stack([read_segment(wall, f"wall {index}", limits, room) for index, wall in enumerate(walls)])
    floor = shape.buffer(_WALL_OVERSHOOT_M, join_style="mitre")
    shapely.prepare(floor)
    inside = shapely.covers(floor, shapely.linestrings(points))
    if not inside.all():
        raise InvalidFloorPlanError(
            f"wall {np.argmin(inside)} leaves the room's floor; it can reach {_WALL_OVERSHOOT_M:g} m beyond it",
            room=room,
        )
    return frozen(points.reshape(-1, 4))


def _unique_ids(rooms: Sequence[Room]) -> list[str]:
    """Return the ids of the document, and for rooms without one an id made from the name: `bedroom`, `bedroom-2`."""
    given = Counter(room.id for room in rooms if room.id)
    for key, count in given.items():
        if count > 1:
            raise InvalidFloorPlanError(f"{count} rooms have the id '{key}'; ids must be unique")
    taken, tried, ids = set(given), Counter[str](), []
    for room in rooms:
        key = room.id
        if not key:
            stem = re.sub(r"[\W_]+", "-", room.name.casefold()).strip("-") or "room"
            # Counted per name: a name that repeats hundreds of times would otherwise be searched from 1 each time.
            while not key or key in taken:
                tried[stem] += 1
                key = stem if tried[stem] == 1 else f"{stem}-{tried[stem]}"
            taken.add(key)
        ids.append(key)
    return ids


def read_openings(raw: Any, rooms: Sequence[Room], limits: PlanLimits) -> tuple[Opening, ...]:
    """Read the openings of a plan with these rooms."""
    entries = read_list([] if raw is None else raw, "openings", limits.max_openings, "max_openings")
    ids = {room.id for room in rooms}
    return tuple(_read_opening(entry, f"opening {index}", ids, limits) for index, entry in enumerate(entries))


def read_opening_trust(document: Mapping[str, Any], openings: Sequence[Opening]) -> dict[str, float]:
    """Read the positive trusts in a plan's kinds of openings.

    `opening_kinds` lists kinds with a trust of 1, by default those that occur and are not in `opening_trust`.
    """
    raw = document.get("opening_trust")
    if raw is not None and not isinstance(raw, Mapping):
        raise InvalidFloorPlanError(f"opening_trust must be an object, not {json_kind(raw)}")
    check_keys(raw or {}, set(_KINDS), where="opening_trust: ")
    stated = {
        kind: read_number_between(value, f"opening_trust: {kind}", 0.0, 1.0, "") for kind, value in (raw or {}).items()
    }
    if document.get("opening_kinds") is None:
        complete = {opening.kind for opening in openings} - stated.keys()
    else:
        kinds = read_list(document["opening_kinds"], "opening_kinds", len(_KINDS), "one of each kind")
        complete = {read_choice(kind, _KINDS, "an entry of opening_kinds") for kind in kinds}
    return {kind: trust for kind, trust in (stated | dict.fromkeys(complete, 1.0)).items() if trust > 0.0}


def trust_warnings(document: Mapping[str, Any]) -> list[str]:
    """Return a warning for each kind with another trust in `opening_trust` than in `opening_kinds`."""
    stated, complete = document.get("opening_trust") or {}, document.get("opening_kinds") or ()
    return [
        f"opening_trust of '{kind}' is {value:g}, but opening_kinds lists it: 1 is used; remove it from one of them"
        for kind, value in stated.items()
        if kind in complete and value != 1
    ]


def _read_opening(raw: Any, where: str, room_ids: set[str], limits: PlanLimits) -> Opening:
    if not isinstance(raw, Mapping):
        raise InvalidFloorPlanError(f"{where} must be an object, not {json_kind(raw)}")
    check_keys(raw, _OPENING_KEYS, where=f"{where}: ")
    kind = read_choice(raw.get("kind"), _KINDS, f"{where}: the kind")
    line_m = read_segment(raw.get("line"), f"{where}: the line", limits, None)
    name = None if raw.get("name") is None else read_name(raw["name"], limits, f"{where}: the name")
    sill_m, head_m = (
        read_optional(raw.get(key), f"{where}: {key}", 0.0, limits.max_ceiling_height_m, " m")
        for key in ("sill_m", "head_m")
    )
    if sill_m is not None and head_m is not None and sill_m >= head_m:
        raise InvalidFloorPlanError(f"{where}: sill_m is {sill_m:g} m; it must be below head_m ({head_m:g} m)")
    rooms = None
    if raw.get("rooms") is not None:
        rooms = tuple(read_list(raw["rooms"], f"{where}: rooms", len(room_ids), "one entry for each room"))
        unknown = [room for room in rooms if not isinstance(room, str) or room not in room_ids]
        if unknown:
            shown = f"'{unknown[0][:50]}'" if isinstance(unknown[0], str) else json_kind(unknown[0])
            raise InvalidFloorPlanError(f"{where}: rooms has {shown}, which is not the id of a room")
    return Opening(kind, frozen(line_m), sill_m, head_m, name, rooms)


def read_camera_height(value: Any, rooms: Sequence[Room], limits: PlanLimits) -> float:
    """Read the camera height (m), which must be below every ceiling."""
    lowest = min(rooms, key=lambda room: room.ceiling_height_m)
    height_m = read_number(DEFAULT_CAMERA_HEIGHT_M if value is None else value, "camera_height_m", above=0.0)
    if height_m < limits.min_camera_height_m:
        raise InvalidFloorPlanError(
            f"camera_height_m is {height_m:g} m; it must be at least {limits.min_camera_height_m:g} m"
        )
    if height_m >= lowest.ceiling_height_m:
        source = " (the default)" if value is None else ""
        raise InvalidFloorPlanError(
            f"camera_height_m is {height_m:g} m{source}; it must be below the lowest ceiling, "
            f"{lowest.ceiling_height_m:g} m of room '{lowest.name}'; correct its ceiling_height_m, remove the room, or "
            "set camera_height_m"
        )
    return height_m


@dataclass(frozen=True, eq=False)
class Fixture:
    """A fixture of the plan.

    Attributes:
        kind: one of `conventions.FIXTURE_KINDS`.
        outline_m: (n, 2) outline seen from above, not closed.
    """

    kind: str
    outline_m: Float[np.ndarray, "n 2"]


@dataclass(frozen=True, eq=False)
class FixturePlaces:
    """Places of f fixtures: centre and width (m), and the number of the room, -1 outside all."""

    centre_m: Float[np.ndarray, "f 2"]
    width_m: Float[np.ndarray, "f"]
    room_index: Int[np.ndarray, "f"]

    def __len__(self) -> int:
        return len(self.width_m)


def read_fixtures(raw: Any, limits: PlanLimits) -> tuple[Fixture, ...]:
    """Read the fixtures of a plan."""
    entries = read_list([] if raw is None else raw, "fixtures", limits.max_openings, "max_openings")
    vertices = 0
    fixtures = []
    for index, entry in enumerate(entries):
        fixtures.append(_read_fixture(entry, f"fixture {index}", limits))
        vertices += len(fixtures[-1].outline_m)
        if vertices > limits.max_plan_vertices:
            raise InvalidFloorPlanError(
                f"the fixtures have more than {limits.max_plan_vertices} vertices (max_plan_vertices); "
                "simplify their outlines"
            )
    return tuple(fixtures)


def with_types_of_fixtures(
    rooms: Sequence[Room], fixtures: Sequence[Fixture], raw_rooms: Sequence[Mapping[str, Any]]
) -> tuple[Room, ...]:
    """Return the rooms with the types that their fixtures add, unless the document lists a room's `types`."""
    if not fixtures:
        return tuple(rooms)
    shapes = [shapely.Polygon(fixture.outline_m) for fixture in fixtures]
    tree = shapely.STRtree([room.shape for room in rooms])
    inside: dict[int, list[tuple[str, float]]] = {}
    for number, room in tree.query(shapely.centroid(shapes), predicate="within").T.tolist():
        inside.setdefault(room, []).append((fixtures[number].kind, shapes[number].area))
    typed = list(rooms)
    for number, sizes in inside.items():
        if raw_rooms[number].get("types") is not None:
            continue
        types = types_by_fixtures(rooms[number].types, sizes, rooms[number].area_m2)
        typed[number] = replace(rooms[number], types=types)
    return tuple(typed)


def state_types(documents: Sequence[dict[str, Any]], rooms: Sequence[Room], fixtures: Sequence[Fixture]) -> None:
    """Add `types` to the documents of rooms to which names or fixtures would give others when they are read."""
    named = [replace(room, types=_read_types(raw, room.name)) for raw, room in zip(documents, rooms, strict=True)]
    read = with_types_of_fixtures(named, fixtures, documents)
    for raw, room, again in zip(documents, rooms, read, strict=True):
        if again.types != room.types:
            raw["types"] = list(room.types)


def _read_fixture(raw: Any, where: str, limits: PlanLimits) -> Fixture:
    if not isinstance(raw, Mapping):
        raise InvalidFloorPlanError(f"{where} must be an object, not {json_kind(raw)}")
    check_keys(raw, _KEYS, where=f"{where}: ")
    kind = read_choice(raw.get("kind"), FIXTURE_KINDS, f"{where}: the kind")
    outline = read_list(raw.get("outline"), f"{where}: outline", limits.max_vertices_per_room, "max_vertices")
    if len(outline) < 3:
        raise InvalidFloorPlanError(f"{where}: outline has {len(outline)} vertices; it must have at least 3")
    outline_m = read_points(outline, limits, None, f"{where}: vertex")
    if not shapely.Polygon(outline_m).is_valid:
        raise InvalidFloorPlanError(f"{where}: outline crosses itself or has no area")
    return Fixture(kind, frozen(outline_m))
