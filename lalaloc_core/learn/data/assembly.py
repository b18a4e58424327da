"""From what a data set says to a validated plan and poses; shared by all readers."""

from __future__ import annotations

import dataclasses
import json
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
from lalaloc_core.learn.data.drawn_openings import DrawnOpening, opening_entries
from lalaloc_core.learn.data.polygon_rings import uncrossed

# An outline that crosses itself is a slip of the drawing when one simple part of it has nearly all of its floor.
_MIN_SHARE_UNCROSSED = 0.9


@dataclass(frozen=True, eq=False, kw_only=True)
class RoomOutline:
    """A room as a data set draws it; `warnings` say what was odd about it."""

    name: str
    polygon_m: Float[np.ndarray, "n 2"]
    ceiling_height_m: float
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
    """A validated plan of a scene's rooms.

    A room below the smallest area, and an outline's stray part, are left out with a warning in the plan: neither holds
    a camera, and large data sets have some.

    Args:
        outlines: with different names.
        path: the file they are from, for errors.
        units: how its numbers were read, for errors about sizes: "coordinates are read as millimetres".
        openings: what cannot be in a plan of them is left out with a warning.
        opening_kinds: the kinds that the data set draws completely.

    Raises:
        DatasetError: the rooms cannot be a plan.
    """
    if not outlines:
        raise DatasetError("there is no room", scene=scene, path=path)
    rooms, warnings = _room_entries(scene, outlines, path=path, units=units)
    # Every camera of a data set brings its own height; the plan's is only a default that has to fit in.
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
        # The rooms alone are a plan, as they were before data sets' openings were read.
        faults.append(f"all openings are left out: {error}")
    return dataclasses.replace(plan, warnings=(*warnings, *faults, *plan.warnings))


def _room_entries(
    scene: str, outlines: Sequence[RoomOutline], *, path: Path, units: str
) -> tuple[list[dict[str, Any]], list[str]]:
    """Entries of a plan's `rooms`, and what was odd about the outlines; see `assemble_plan`."""
    warnings = [warning for outline in outlines for warning in outline.warnings]
    rooms: list[dict[str, Any]] = []
    areas = []
    for outline in outlines:
        polygon_m, share = uncrossed(outline.polygon_m)
        if share < _MIN_SHARE_UNCROSSED:
            raise DatasetError(
                f"the outline crosses itself, and its largest simple part has {share:.0%} of its floor, "
                f"at least {_MIN_SHARE_UNCROSSED:.0%} is needed",
                scene=scene,
                room=outline.name,
                path=path,
            )
        if share < 1.0:
            warnings.append(f"room '{outline.name}': the outline crossed itself, {1.0 - share:.1%} of it is left out")
        areas.append(float(shapely.Polygon(polygon_m).area))
        if areas[-1] < DEFAULT_LIMITS.min_room_area_m2:
            warnings.append(
                f"room '{outline.name}' is left out: it has {areas[-1]:.3g} m², "
                f"at least {DEFAULT_LIMITS.min_room_area_m2:g} m² is needed"
            )
            continue
        rooms.append(
            {
                "id": f"{len(rooms)}",
                "name": outline.name,
                "type": outline.type,
                "polygon": polygon_m.tolist(),
                "ceiling_height_m": outline.ceiling_height_m,
            }
        )
    if not rooms:
        raise DatasetError(
            f"every room is smaller than {DEFAULT_LIMITS.min_room_area_m2:g} m², the largest has {max(areas):.3g} m²; "
            f"{units}, is that right?",
            scene=scene,
            room=outlines[int(np.argmax(areas))].name,
            path=path,
        )
    return rooms, warnings


def pose_fault(
    plan: FloorPlan, room_index: int, position_m: Float[np.ndarray, "2"], camera_height_m: float
) -> str | None:
    """Why no camera can stand like this in a room; None when it can.

    Args:
        room_index: the room it is said to stand in.
    """
    room = plan.rooms[room_index]
    at = f"({position_m[0]:.3f}, {position_m[1]:.3f}) m"
    point = shapely.Point(position_m)
    if not room.shape.contains(point):
        away_m = float(room.shape.distance(point))
        found = int(plan.room_index_at(position_m[None])[0])
        where = f", in '{plan.rooms[found].name}'" if found >= 0 else ""
        return f"the camera at {at} stands outside its room '{room.name}', {away_m:.3g} m away{where}"
    if not camera_height_m >= MIN_CAMERA_HEIGHT_M:
        return (
            f"the camera at {at} is {camera_height_m:.3g} m over the floor, "
            f"at least {MIN_CAMERA_HEIGHT_M:g} m is needed"
        )
    if not camera_height_m < room.ceiling_height_m:
        return (
            f"the camera at {at} is {camera_height_m:.3g} m over the floor, "
            f"it must be below the ceiling ({room.ceiling_height_m:.3g} m)"
        )
    return None


def read_json(path: Path, *, scene: str | None = None) -> dict[str, Any]:
    """A JSON file that holds an object.

    Raises:
        DatasetError: it cannot be read, is not JSON, or holds something else.
    """
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
    """Whether a value of a file is a finite number; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e15


def inside(folder: Path, relative: str) -> Path | None:
    """The file that a data set names by its path below `folder`; None where the path leads out of it."""
    path = folder / relative
    parts = Path(relative).parts
    return None if not parts or ".." in parts or Path(relative).is_absolute() or "\0" in relative else path
