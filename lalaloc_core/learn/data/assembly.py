"""Validated plans and poses from the content of a data set; shared by all readers."""

from __future__ import annotations

import dataclasses
import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M, ROOM_TYPES
from lalaloc_core.errors import DatasetError, InvalidFloorPlanError
from lalaloc_core.floorplan import DEFAULT_CAMERA_HEIGHT_M, DEFAULT_LIMITS, FloorPlan
from lalaloc_core.learn.data.drawn_rooms import DrawnOpening, opening_entries

# Minimum area share of the largest simple part of an outline that crosses itself.
_MIN_SIMPLE_SHARE = 0.9


@dataclass(frozen=True, eq=False, kw_only=True)
class RoomOutline:
    """Room as drawn by a data set; its name is unique within the scene.

    `holes_m` are rings of inner walls, which are no floor; they may repeat their first vertex and touch the outline.
    """

    name: str
    polygon_m: Float[np.ndarray, "n 2"]
    ceiling_height_m: float
    holes_m: tuple[Float[np.ndarray, "_ 2"], ...] = ()
    warnings: tuple[str, ...] = ()
    type: str = ROOM_TYPES[0]


def assemble_plan(
    scene: str,
    outlines: Sequence[RoomOutline],
    *,
    path: Path,
    units: str,
    openings: Sequence[DrawnOpening] = (),
    opening_kinds: Sequence[str] = (),
) -> FloorPlan:
    """Build a validated plan of a scene's rooms.

    Rooms below the minimum area and stray parts of outlines are left out with a warning in the plan, because large data
    sets contain some and they hold no camera. Impossible openings are left out with a warning too. `path` and `units`
    ("coordinates are read as millimetres") are for error messages; `opening_kinds` are those that the data set draws
    completely.
    """
    if not outlines:
        raise DatasetError("the scene has no room", scene=scene, path=path)
    rooms, warnings = _room_entries(scene, outlines, path=path, units=units)
    # Cameras have heights of their own; the plan's height is only a valid default.
    lowest_ceiling_m = min(room["ceiling_height_m"] for room in rooms)
    camera_height_m = min(DEFAULT_CAMERA_HEIGHT_M, 0.6 * lowest_ceiling_m)
    document = {"name": scene, "rooms": rooms, "camera_height_m": camera_height_m}
    try:
        plan = FloorPlan.from_dict(document)
    except InvalidFloorPlanError as error:
        raise DatasetError(f"{error.reason} ({units})", scene=scene, room=error.room, path=path) from error
    entries, faults = opening_entries(openings, {room["name"]: room["id"] for room in rooms})
    try:
        plan = FloorPlan.from_dict(document | {"openings": entries, "opening_kinds": list(opening_kinds)})
    except InvalidFloorPlanError as error:
        # The rooms alone are a valid plan.
        faults.append(f"all openings are left out: {error}")
    return dataclasses.replace(plan, warnings=(*warnings, *faults, *plan.warnings))


def _room_entries(
    scene: str, outlines: Sequence[RoomOutline], *, path: Path, units: str
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the entries of a plan's `rooms` and the warnings; see `assemble_plan`."""
    warnings = [warning for outline in outlines for warning in outline.warnings]
    rooms: list[dict[str, Any]] = []
    areas = []
    for outline in outlines:
        polygon_m, share = largest_simple_part(outline.polygon_m)
        if share < _MIN_SIMPLE_SHARE:
            raise DatasetError(
                f"the outline crosses itself, and its largest simple part has {share:.0%} of the floor; "
                f"the minimum is {_MIN_SIMPLE_SHARE:.0%}",
                scene=scene,
                room=outline.name,
                path=path,
            )
        if share < 1.0:
            warnings.append(f"room '{outline.name}': the outline crosses itself; {1.0 - share:.1%} of it is left out")
        floor, left_out = floor_without(polygon_m, outline.holes_m)
        if left_out:
            warnings.append(
                f"room '{outline.name}': {left_out} of {len(outline.holes_m)} rings of inner walls are left out; "
                "they enclose no area inside the room, or divide it"
            )
        areas.append(float(floor.area))
        if areas[-1] < DEFAULT_LIMITS.min_room_area_m2:
            warnings.append(
                f"room '{outline.name}' is left out: it has {areas[-1]:.3g} m²; "
                f"the minimum is {DEFAULT_LIMITS.min_room_area_m2:g} m²"
            )
            continue
        rooms.append(
            {
                "id": f"{len(rooms)}",
                "name": outline.name,
                "type": outline.type,
                "polygon": _vertices(floor.exterior),
                "holes": [_vertices(ring) for ring in floor.interiors],
                "ceiling_height_m": outline.ceiling_height_m,
            }
        )
    if not rooms:
        raise DatasetError(
            f"every room is smaller than {DEFAULT_LIMITS.min_room_area_m2:g} m²; the largest has {max(areas):.3g} m² "
            f"({units})",
            scene=scene,
            room=outlines[int(np.argmax(areas))].name,
            path=path,
        )
    return rooms, warnings


def _vertices(ring: shapely.LinearRing) -> list[list[float]]:
    return shapely.get_coordinates(ring)[:-1].tolist()


def pose_fault(
    plan: FloorPlan, room_index: int, position_m: Float[np.ndarray, "2"], camera_height_m: float
) -> str | None:
    """Return the reason why a camera pose in a room is impossible; None if it is possible."""
    room = plan.rooms[room_index]
    camera = f"the camera at ({position_m[0]:.3f}, {position_m[1]:.3f}) m"
    point = shapely.Point(position_m)
    if not room.shape.contains(point):
        away_m = float(room.shape.distance(point))
        actual = int(plan.room_index_at(position_m[None])[0])
        where = f", in '{plan.rooms[actual].name}'" if actual >= 0 else ""
        return f"{camera} is outside its room '{room.name}', {away_m:.3g} m away{where}"
    if not camera_height_m >= MIN_CAMERA_HEIGHT_M:
        return f"{camera} is {camera_height_m:.3g} m above the floor; the minimum is {MIN_CAMERA_HEIGHT_M:g} m"
    if not camera_height_m < room.ceiling_height_m:
        return (
            f"{camera} is {camera_height_m:.3g} m above the floor; "
            f"it must be below the ceiling ({room.ceiling_height_m:.3g} m)"
        )
    return None


def read_json(path: Path, *, scene: str | None = None) -> dict[str, Any]:
    """Read a JSON file that holds an object."""
    try:
        document = json.loads(path.read_bytes())
    except OSError as error:
        raise DatasetError(f"cannot be read: {error.strerror}", scene=scene, path=path) from error
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"not valid JSON: {error}", scene=scene, path=path) from error
    if not isinstance(document, dict):
        raise DatasetError(f"must hold an object, not {type(document).__name__}", scene=scene, path=path)
    return document


def is_number(value: Any) -> TypeGuard[int | float]:
    """Return whether a value is a finite number; booleans are not."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e15


def path_below(folder: Path, relative: str) -> Path | None:
    """Return the path of a file named relative to `folder`; None if it is not below the folder."""
    path = folder / relative
    parts = Path(relative).parts
    return None if not parts or ".." in parts or Path(relative).is_absolute() or "\0" in relative else path


# Minimum share of the floor beside a hole that stays connected.
_MIN_CONNECTED = 0.9


class OpenRingError(ValueError):
    """Lines that do not form closed rings; the message names the junction."""


def chain_rings(lines: Sequence[tuple[int, int]]) -> list[list[int]]:
    """Chain lines, pairs of junctions in any order and direction, into closed rings without repeated ends.

    Raises:
        OpenRingError: a junction does not join exactly two lines, or a ring has fewer than three junctions.
    """
    at_junction: dict[int, list[int]] = defaultdict(list)
    for number, ends in enumerate(lines):
        for junction in ends:
            at_junction[junction].append(number)
    for junction, joined in at_junction.items():
        if len(joined) != 2:
            raise OpenRingError(
                f"the ring does not close: junction {junction} joins {len(joined)} of its lines, not two"
            )
    rings, used = [], [False] * len(lines)
    for first, (start, junction) in enumerate(lines):
        if used[first]:
            continue
        ring, line = [start], first
        used[first] = True
        while junction != start:
            ring.append(junction)
            first_line, second_line = at_junction[junction]
            line = second_line if line == first_line else first_line
            used[line] = True
            near, far = lines[line]
            junction = far if near == junction else near
        if len(ring) < 3:
            raise OpenRingError(f"a ring has {len(ring)} junctions {sorted(ring)}; the minimum is three")
        rings.append(ring)
    return rings


def largest_simple_part(polygon: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "m 2"], float]:
    """Return the largest simple polygon within a ring that may cross itself, and its share of the enclosed area."""
    shape = shapely.Polygon(polygon)
    if shape.is_valid:
        return polygon, 1.0
    # A collection may hold multi-polygons, so it is split twice.
    parts = shapely.get_parts(shapely.get_parts(shapely.make_valid(shape)))
    areas = [part.area for part in parts]
    if not sum(areas) > 0.0:
        return polygon, 0.0
    largest = parts[int(np.argmax(areas))]
    return np.array(largest.exterior.coords)[:-1], float(largest.area / sum(areas))


def floor_without(
    polygon: Float[np.ndarray, "n 2"], holes: Sequence[Float[np.ndarray, "_ 2"]]
) -> tuple[shapely.Polygon, int]:
    """Return the area inside a simple ring and outside some holes, and the number of holes that are left out.

    Holes may touch or cross the ring. One that encloses nothing inside it, or that cuts off more than a tenth of the
    floor, is left out.
    """
    floor, left_out = shapely.Polygon(polygon), 0
    for hole in holes:
        shape = shapely.make_valid(shapely.Polygon(hole)) if len(hole) > 2 else shapely.Point()
        parts = [part for part in shapely.get_parts(floor.difference(shape)) if isinstance(part, shapely.Polygon)]
        rest = max(parts, key=lambda part: part.area, default=floor)
        if rest.area < _MIN_CONNECTED * sum(part.area for part in parts) or not rest.area < floor.area:
            left_out += 1
        else:
            floor = rest
    return floor, left_out
