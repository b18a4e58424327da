"""Floor plans: validated, immutable rooms as closed polygons.

A `FloorPlan` is the only map this project needs. Its rooms are simple polygons in the plan frame (metres), each
extruded from the floor to its own ceiling; doors count as wall.
"""

from __future__ import annotations

import json
import re
import sys
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float, Int

from lalaloc_core.conventions import heading_from_degrees, heading_to_degrees
from lalaloc_core.errors import InvalidFloorPlanError


@dataclass(frozen=True, kw_only=True)
class PlanLimits:
    """What a floor plan may be; anything outside is refused with the value, the limit and the limit's name.

    `max_plan_vertices` are those of all rooms; `max_depth` is of objects and lists within each other.
    """

    max_rooms: int = 500
    max_vertices_per_room: int = 500
    max_plan_vertices: int = 100_000
    max_extent_m: float = 1000.0
    max_area_m2: float = 200_000.0
    max_depth: int = 8
    max_name_length: int = 200
    min_room_area_m2: float = 0.2
    min_ceiling_height_m: float = 1.0
    max_ceiling_height_m: float = 20.0
    # Two rooms that share more floor than this overlap; less is rounding of the drawing.
    overlap_tolerance_m2: float = 0.01


DEFAULT_LIMITS = PlanLimits()
DEFAULT_CAMERA_HEIGHT_M = 1.5
# Unicode categories that neither files nor drawings can hold: control characters and lone surrogates.
_NOT_TEXT = {"Cc", "Cs"}
_OPENING, _CLOSING = np.frombuffer(b"[{", np.uint8), np.frombuffer(b"]}", np.uint8)
_JSON_STRING = re.compile(r'"(?:[^"\\]|\\.)*"', re.DOTALL)
# Looking for overlaps ends after so many found, or so many pairs looked at: their number grows with the square.
_MOST_OVERLAPS, _MOST_PAIRS = 20, 5000


@dataclass(frozen=True, eq=False)
class Room:
    """One room: `polygon_m` is (n, 2), counter-clockwise, not closed (the last vertex joins the first)."""

    name: str
    polygon_m: Float[np.ndarray, "n 2"]
    ceiling_height_m: float

    @cached_property
    def shape(self) -> shapely.Polygon:
        """The polygon as a shapely geometry."""
        return shapely.Polygon(self.polygon_m)

    @property
    def area_m2(self) -> float:
        """Floor area."""
        return float(self.shape.area)

    @cached_property
    def walls_m(self) -> Float[np.ndarray, "n 4"]:
        """Wall segments (x0, y0, x1, y1), one per edge of the polygon."""
        return _frozen(np.concatenate([self.polygon_m, np.roll(self.polygon_m, -1, axis=0)], axis=1))


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """A validated floor plan; build one with `FloorPlan.from_dict` or `FloorPlan.from_json`.

    Attributes:
        name: what the user calls it.
        rooms: at least one.
        camera_height_m: height of the camera assumed for panoramas of this plan.
        north: azimuth of true north (radians), None when it is not known.
        warnings: what is odd but usable, such as overlapping rooms.
    """

    name: str
    rooms: tuple[Room, ...]
    camera_height_m: float = DEFAULT_CAMERA_HEIGHT_M
    warnings: tuple[str, ...] = field(default=())
    north: float | None = None

    @classmethod
    def from_json(cls, text: str | bytes, limits: PlanLimits = DEFAULT_LIMITS) -> FloorPlan:
        """Parse the native JSON format.

        Raises:
            InvalidFloorPlanError: not JSON, or not a valid plan.
        """
        try:
            if isinstance(text, bytes):
                text = text.decode(json.detect_encoding(text), "surrogatepass")
            _check_depth(text, limits)
            document = json.loads(text)
        except InvalidFloorPlanError:
            raise
        except (ValueError, RecursionError) as error:
            raise InvalidFloorPlanError(f"not valid JSON: {error}") from error
        return cls.from_dict(document, limits)

    @classmethod
    def from_dict(cls, document: Any, limits: PlanLimits = DEFAULT_LIMITS) -> FloorPlan:
        """Validate a plan in the native format.

        Keys: `name`, `rooms` (each `name`, `polygon`, optional `ceiling_height_m`), `ceiling_height_m` (default
        for rooms without their own), optional `camera_height_m` and `north_deg`. Unknown keys are refused.

        Raises:
            InvalidFloorPlanError: names the room and what is wrong.
        """
        if not isinstance(document, Mapping):
            raise InvalidFloorPlanError(f"a plan must be an object, not {type(document).__name__}")
        _known_keys(document, {"name", "rooms", "ceiling_height_m", "camera_height_m", "north_deg"}, room=None)
        name = _name(document.get("name", "floor plan"), limits, what="the plan's name")
        default_ceiling = document.get("ceiling_height_m")
        if default_ceiling is not None:
            default_ceiling = _ceiling_height(default_ceiling, None, limits)
        raw_rooms = document.get("rooms")
        if not isinstance(raw_rooms, list) or not raw_rooms:
            raise InvalidFloorPlanError("'rooms' must be a list of at least one room")
        if len(raw_rooms) > limits.max_rooms:
            raise InvalidFloorPlanError(f"{len(raw_rooms)} rooms, at most {limits.max_rooms} are allowed (max_rooms)")
        _check_vertices(raw_rooms, limits)
        rooms = tuple(
            _parse_room(raw, f"room {index + 1}", default_ceiling, limits) for index, raw in enumerate(raw_rooms)
        )
        _check_size(rooms, limits)
        lowest_ceiling = min(room.ceiling_height_m for room in rooms)
        camera_height = _number(
            document.get("camera_height_m", DEFAULT_CAMERA_HEIGHT_M), "camera_height_m", None, above=0.0
        )
        if camera_height >= lowest_ceiling:
            raise InvalidFloorPlanError(
                f"camera_height_m is {camera_height:g}, it must lie below the lowest ceiling ({lowest_ceiling:g} m)"
            )
        north = _north(document.get("north_deg"))
        return cls(name, rooms, camera_height, _overlap_warnings(rooms, limits), north)

    def to_dict(self) -> dict[str, Any]:
        """The plan in the native format; `from_dict` of it gives an equal plan."""
        # Rounded, so that degrees which went through radians are the same again.
        north = {} if self.north is None else {"north_deg": round(heading_to_degrees(self.north), 9) % 360.0}
        return {
            "name": self.name,
            "camera_height_m": self.camera_height_m,
            **north,
            "rooms": [
                {"name": room.name, "polygon": room.polygon_m.tolist(), "ceiling_height_m": room.ceiling_height_m}
                for room in self.rooms
            ],
        }

    @property
    def area_m2(self) -> float:
        """Sum of the rooms' floor areas."""
        return sum(room.area_m2 for room in self.rooms)

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """(x_min, y_min, x_max, y_max) over all rooms."""
        corners = np.concatenate([room.polygon_m for room in self.rooms])
        (x_min, y_min), (x_max, y_max) = corners.min(axis=0), corners.max(axis=0)
        return float(x_min), float(y_min), float(x_max), float(y_max)

    @cached_property
    def walls_m(self) -> Float[np.ndarray, "rooms n 4"]:
        """Wall segments of every room, padded to one length by repeating each room's first wall.

        Index with a pose's room to get what `render.profile` wants: `plan.walls_m[room_index]`.
        """
        longest = max(len(room.walls_m) for room in self.rooms)
        return _frozen(np.stack([pad_walls(room.walls_m, longest) for room in self.rooms]))

    @cached_property
    def ceiling_heights_m(self) -> Float[np.ndarray, "rooms"]:
        """Ceiling height of every room."""
        return _frozen(np.array([room.ceiling_height_m for room in self.rooms]))

    def room_index_at(self, position_m: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n"]:
        """Index of the room each position lies in, -1 outside; the first room wins where rooms overlap."""
        x, y = position_m[:, 0], position_m[:, 1]
        index = np.full(len(position_m), -1)
        for room_index in reversed(range(len(self.rooms))):
            index[shapely.contains_xy(self.rooms[room_index].shape, x, y)] = room_index
        return index


def pad_walls(walls_m: Float[np.ndarray, "n 4"], length: int) -> Float[np.ndarray, "length 4"]:
    """Pad wall segments to `length` rows by repeating the first, which no ray caster can tell from the original."""
    return np.concatenate([walls_m, np.repeat(walls_m[:1], length - len(walls_m), axis=0)])


def _frozen(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array


def _known_keys(document: Mapping[str, Any], known: set[str], room: str | None) -> None:
    unknown = sorted(str(key)[:50] for key in document if key not in known)
    if unknown:
        raise InvalidFloorPlanError(f"unknown key '{unknown[0]}', known are {', '.join(sorted(known))}", room=room)


def _name(value: Any, limits: PlanLimits, what: str) -> str:
    if not isinstance(value, str) or not value.strip():
        raise InvalidFloorPlanError(f"{what} must be a non-empty string")
    if len(value) > limits.max_name_length:
        raise InvalidFloorPlanError(
            f"{what} has {len(value)} characters, at most {limits.max_name_length} are allowed (max_name_length)"
        )
    if any(unicodedata.category(character) in _NOT_TEXT for character in value):
        raise InvalidFloorPlanError(f"{what} has control characters or lone surrogates")
    return value


def _is_finite(value: int | float) -> bool:
    """Whether a number of any size is finite as a float; JSON integers have no bounds."""
    return -sys.float_info.max <= value <= sys.float_info.max


def _number(value: Any, what: str, room: str | None, *, above: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InvalidFloorPlanError(f"{what} must be a number, not {type(value).__name__}", room=room)
    if not _is_finite(value) or value <= above:
        raise InvalidFloorPlanError(f"{what} is {str(value)[:50]}, it must be finite and above {above:g}", room=room)
    return float(value)


def _parse_room(raw: Any, fallback_name: str, default_ceiling: Any, limits: PlanLimits) -> Room:
    if not isinstance(raw, Mapping):
        raise InvalidFloorPlanError(f"a room must be an object, not {type(raw).__name__}", room=fallback_name)
    name = _name(raw.get("name", fallback_name), limits, what=f"the name of {fallback_name}")
    _known_keys(raw, {"name", "polygon", "ceiling_height_m"}, room=name)
    ceiling = raw.get("ceiling_height_m", default_ceiling)
    if ceiling is None:
        raise InvalidFloorPlanError("no ceiling_height_m, neither here nor for the plan", room=name)
    ceiling_height = _ceiling_height(ceiling, name, limits)
    return Room(name, _parse_polygon(raw.get("polygon"), name, limits), ceiling_height)


def _ceiling_height(value: Any, room: str | None, limits: PlanLimits) -> float:
    height = _number(value, "ceiling_height_m", room, above=0.0)
    if not limits.min_ceiling_height_m <= height <= limits.max_ceiling_height_m:
        raise InvalidFloorPlanError(
            f"ceiling_height_m is {height:g}, it must lie between {limits.min_ceiling_height_m:g} "
            f"and {limits.max_ceiling_height_m:g} m",
            room=room,
        )
    return height


def _parse_polygon(raw: Any, room: str, limits: PlanLimits) -> Float[np.ndarray, "n 2"]:
    if not isinstance(raw, list | tuple) or len(raw) < 3:
        raise InvalidFloorPlanError("'polygon' must be a list of at least three [x, y] vertices", room=room)
    if len(raw) > limits.max_vertices_per_room:
        raise InvalidFloorPlanError(
            f"{len(raw)} vertices, at most {limits.max_vertices_per_room} are allowed (max_vertices)", room=room
        )
    for index, vertex in enumerate(raw):
        if not (
            isinstance(vertex, list | tuple)
            and len(vertex) == 2
            and all(isinstance(value, int | float) and not isinstance(value, bool) for value in vertex)
        ):
            raise InvalidFloorPlanError(f"vertex {index} must be two numbers [x, y]", room=room)
        if not all(_is_finite(value) and abs(value) < 1e9 for value in vertex):
            shown = ", ".join(str(value)[:50] for value in vertex)
            raise InvalidFloorPlanError(f"vertex {index} is [{shown}], coordinates must be finite", room=room)
    polygon = np.array(raw, dtype=np.float64)
    # Drop repeated vertices, the closing one of a closed ring among them: they would be walls of no length.
    polygon = polygon[np.any(polygon != np.roll(polygon, -1, axis=0), axis=1)]
    if len(polygon) < 3:
        raise InvalidFloorPlanError("fewer than three distinct vertices", room=room)
    shape = shapely.Polygon(polygon)
    if not shape.is_valid:
        raise InvalidFloorPlanError(f"the polygon crosses itself ({shapely.is_valid_reason(shape)})", room=room)
    if shape.area < limits.min_room_area_m2:
        raise InvalidFloorPlanError(
            f"the area is {shape.area:.3g} m², at least {limits.min_room_area_m2:g} m² is needed", room=room
        )
    return _frozen(polygon if shape.exterior.is_ccw else polygon[::-1].copy())


def _north(degrees: Any) -> float | None:
    if degrees is None:
        return None
    value = _number(degrees, "north_deg", None, above=-sys.float_info.max)
    if not -360.0 <= value <= 360.0:
        raise InvalidFloorPlanError(f"north_deg is {value:g}, it must lie between -360 and 360")
    return heading_from_degrees(value)


def _check_depth(text: str, limits: PlanLimits) -> None:
    """Refuse deep nesting before it is parsed."""
    characters = np.frombuffer(_JSON_STRING.sub("", text).encode("utf-8", "surrogatepass"), np.uint8)
    steps = np.isin(characters, _OPENING).astype(np.int64) - np.isin(characters, _CLOSING)
    depth = int(np.cumsum(steps).max(initial=0))
    if depth > limits.max_depth:
        raise InvalidFloorPlanError(
            f"the JSON is nested {depth} deep, at most {limits.max_depth} is allowed (max_depth)"
        )


def _check_vertices(raw_rooms: list[Any], limits: PlanLimits) -> None:
    """Refuse too many vertices before any is looked at."""
    polygons = [raw.get("polygon") for raw in raw_rooms if isinstance(raw, Mapping)]
    vertices = sum(len(polygon) for polygon in polygons if isinstance(polygon, list | tuple))
    if vertices > limits.max_plan_vertices:
        raise InvalidFloorPlanError(
            f"{vertices} vertices, at most {limits.max_plan_vertices} are allowed (max_plan_vertices)"
        )


def _check_size(rooms: tuple[Room, ...], limits: PlanLimits) -> None:
    corners = np.concatenate([room.polygon_m for room in rooms])
    extent = float(np.ptp(corners, axis=0).max())
    if extent > limits.max_extent_m:
        raise InvalidFloorPlanError(
            f"the plan is {extent:.6g} m across, at most {limits.max_extent_m:g} m is allowed (max_extent_m); "
            "are the coordinates in metres?"
        )
    area_m2 = sum(room.area_m2 for room in rooms)
    if area_m2 > limits.max_area_m2:
        raise InvalidFloorPlanError(
            f"the floor area is {area_m2:.6g} m², at most {limits.max_area_m2:g} m² is allowed (max_area_m2); "
            "are the coordinates in metres?"
        )


def _overlap_warnings(rooms: tuple[Room, ...], limits: PlanLimits) -> tuple[str, ...]:
    shapes = [room.shape for room in rooms]
    # Whose boxes meet; whether the rooms themselves do is asked of each pair, and of not too many.
    first, second = shapely.STRtree(shapes).query(shapes)
    pairs = sorted((int(i), int(j)) for i, j in zip(first, second, strict=True) if i < j)
    warnings: list[str] = []
    for looked_at, (i, j) in enumerate(pairs):
        if len(warnings) == _MOST_OVERLAPS or looked_at == _MOST_PAIRS:
            warnings.append("more rooms may overlap, the rest was not looked at")
            break
        shared = float(shapely.intersection(shapes[i], shapes[j]).area)
        if shared > limits.overlap_tolerance_m2:
            warnings.append(f"rooms '{rooms[i].name}' and '{rooms[j].name}' overlap by {shared:.2f} m²")
    return tuple(warnings)
