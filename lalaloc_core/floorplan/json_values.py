"""Readers for JSON and for single values of a plan's document, within limits; errors name the value in JSON terms.

JSON is parsed strictly, in time linear in the length of the text.
"""

from __future__ import annotations

import json
import math
import re
import sys
import unicodedata
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, TypeGuard

import numpy as np
from jaxtyping import Float

from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M
from lalaloc_core.errors import InvalidFloorPlanError

# Unicode categories that files and drawings cannot hold: control characters and lone surrogates.
_NOT_TEXT = {"Cc", "Cs"}
# Longest part of a wrong value in a message.
_SHOWN = 50
# Shorter than any opening or stub of wall, longer than the rounding of a drawing.
_MIN_SEGMENT_M = 0.01
_OPENING, _CLOSING = np.frombuffer(b"[{", np.uint8), np.frombuffer(b"]}", np.uint8)
# An unterminated string matches up to the end of the text: a match that begins never fails, so the time is linear. If
# the closing quote were required, every quote of such a string would be tried again.
_JSON_STRING = re.compile(r'"[^"\\]*+(?:\\.[^"\\]*+)*+(?:"|\\?\Z)', re.DOTALL)
# No floating-point number has more. Python parses thousands, in time quadratic in their number.
_MAX_DIGITS = 300
_DIGITS = re.compile(rf"(?<![0-9])[0-9]{{{_MAX_DIGITS + 1},}}")


def read_json(text: str | bytes, max_depth: int, max_values: int | None = None) -> Any:
    """Parse a JSON text with at most `max_values` lists, objects and further items (commas).

    Raises:
        InvalidFloorPlanError: not JSON, nested too deep, too many values, a repeated key in one object, or a number of
            too many digits.
    """
    try:
        if isinstance(text, bytes):
            text = text.decode(json.detect_encoding(text), "surrogatepass")
        structure = _JSON_STRING.sub("", text)
        _check_size(structure, max_depth, max_values)
        return json.loads(text, object_pairs_hook=_object)
    except InvalidFloorPlanError:
        raise
    except UnicodeDecodeError as error:
        raise InvalidFloorPlanError(
            f"not valid JSON: byte {error.start} of the text is not {error.encoding.upper()}; save it as UTF-8"
        ) from error
    except RecursionError as error:
        raise InvalidFloorPlanError(f"not valid JSON: nested too deep; the limit is {max_depth} levels") from error
    except ValueError as error:
        raise InvalidFloorPlanError(f"not valid JSON: {error}") from error


def _check_size(structure: str, max_depth: int, max_values: int | None) -> None:
    """Refuse deep nesting, many values and long numbers before they are parsed, in the text without its strings."""
    characters = np.frombuffer(structure.encode("utf-8", "surrogatepass"), np.uint8)
    steps = np.isin(characters, _OPENING).astype(np.int8) - np.isin(characters, _CLOSING)
    depth = int(np.cumsum(steps, dtype=np.int32).max(initial=0))
    if depth > max_depth:
        raise InvalidFloorPlanError(f"the JSON is nested {depth} levels deep; the limit is {max_depth}")
    values = sum(structure.count(mark) for mark in "[{,")
    if max_values is not None and values > max_values:
        raise InvalidFloorPlanError(
            f"the JSON has {values} lists, objects and further items; the limit is {max_values}: simplify it"
        )
    if (found := _DIGITS.search(structure)) is not None:
        raise InvalidFloorPlanError(f"a number has {len(found[0])} digits; the limit is {_MAX_DIGITS}")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise InvalidFloorPlanError(f"the key '{key[:50]}' occurs twice in one object; remove one of them")
        found[key] = value
    return found


@dataclass(frozen=True, kw_only=True)
class PlanLimits:
    """Limits of a floor plan; a plan outside them is refused with an error that names value and limit.

    Errors name the service's setting (`max_rooms`) if there is one; in Python, pass a `PlanLimits` instead.
    A room's vertices are those of its outline and holes, plus one per free-standing wall; `max_plan_vertices` counts
    all rooms. `max_depth` limits the nesting of objects and lists.
    """

    max_rooms: int = 10_000
    max_vertices_per_room: int = 500
    max_plan_vertices: int = 100_000
    max_openings: int = 20_000
    # Opening faces on the walls of one room, and walls that one opening can lie on.
    max_openings_per_room: int = 100
    max_walls_per_opening: int = 32
    # Opening faces on all walls, and comparisons of an opening with a wall near it.
    max_opening_faces: int = 200_000
    max_opening_pairs: int = 3_000_000
    max_extent_m: float = 1000.0
    max_area_m2: float = 200_000.0
    # Sum of the bounding boxes of the rooms, which the pose grid is computed over.
    max_bounds_area_m2: float = 500_000.0
    # Up to here a double resolves nanometres; a hundred times farther out areas and distances begin to lose metres.
    max_coordinate_m: float = 1e7
    max_depth: int = 8
    max_name_length: int = 200
    min_room_area_m2: float = 0.2
    min_ceiling_height_m: float = 1.0
    min_camera_height_m: float = MIN_CAMERA_HEIGHT_M
    max_ceiling_height_m: float = 20.0
    # Rooms that share more floor than this overlap; less is rounding of the drawing.
    overlap_tolerance_m2: float = 0.01


DEFAULT_LIMITS = PlanLimits()
# For stored plans, which were valid under earlier limits: tighter ones must not make them unreadable.
NO_LIMITS = PlanLimits(
    max_rooms=10**9,
    max_vertices_per_room=10**9,
    max_plan_vertices=10**9,
    max_openings=10**9,
    max_openings_per_room=10**9,
    max_walls_per_opening=10**9,
    max_opening_faces=10**9,
    max_opening_pairs=10**12,
    max_extent_m=math.inf,
    max_area_m2=math.inf,
    max_bounds_area_m2=math.inf,
    max_coordinate_m=math.inf,
    min_camera_height_m=0.0,
)


def json_kind(value: Any) -> str:
    """Return the JSON type of a value, for messages."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return "a number"
    if isinstance(value, str):
        return "a string"
    return "an object" if isinstance(value, Mapping) else "a list"


def is_number(value: Any) -> TypeGuard[int | float]:
    """Return True for numbers, which booleans are not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def check_keys(document: Mapping[str, Any], known: Collection[str], room: str | None = None, where: str = "") -> None:
    """Refuse unknown keys."""
    unknown = sorted(str(key)[:_SHOWN] for key in document if key not in known)
    if unknown:
        raise InvalidFloorPlanError(
            f"{where}unknown key '{unknown[0]}'; known keys are {', '.join(sorted(known))}", room=room
        )


def read_name(value: Any, limits: PlanLimits, label: str, room: str | None = None) -> str:
    """Read a non-empty text for users."""
    if not isinstance(value, str) or not value.strip():
        raise InvalidFloorPlanError(f"{label} must be a non-empty string", room=room)
    if len(value) > limits.max_name_length:
        raise InvalidFloorPlanError(
            f"{label} has {len(value)} characters; the limit is {limits.max_name_length} (PlanLimits.max_name_length)",
            room=room,
        )
    if any(unicodedata.category(character) in _NOT_TEXT for character in value):
        raise InvalidFloorPlanError(f"{label} has control characters or lone surrogates; remove them", room=room)
    return value


def read_choice(value: Any, choices: Collection[str], label: str, room: str | None = None) -> str:
    """Read one of the words `choices`."""
    if not isinstance(value, str) or value not in choices:
        shown = f"'{value[:_SHOWN]}'" if isinstance(value, str) else json_kind(value)
        raise InvalidFloorPlanError(f"{label} is {shown}; it must be one of {', '.join(choices)}", room=room)
    return value


def read_number(value: Any, label: str, room: str | None = None, *, above: float) -> float:
    """Read a finite number above a bound."""
    if not is_number(value):
        raise InvalidFloorPlanError(f"{label} must be a number, not {json_kind(value)}", room=room)
    if not _is_finite(value) or value <= above:
        raise InvalidFloorPlanError(
            f"{label} is {str(value)[:_SHOWN]}; it must be finite and above {above:g}", room=room
        )
    return float(value)


def read_number_between(value: Any, label: str, low: float, high: float, unit: str, room: str | None = None) -> float:
    """Read a number in a closed range."""
    number = read_number(value, label, room, above=-sys.float_info.max)
    if not low <= number <= high:
        raise InvalidFloorPlanError(f"{label} is {number:g}; it must be between {low:g} and {high:g}{unit}", room=room)
    return number


def read_optional(value: Any, label: str, low: float, high: float, unit: str) -> float | None:
    """Read a number in a closed range; None if there is none."""
    return None if value is None else read_number_between(value, label, low, high, unit)


def read_list(value: Any, label: str, limit: int, limit_name: str, room: str | None = None) -> list[Any]:
    """Read a list of at most `limit` entries."""
    if not isinstance(value, list | tuple):
        raise InvalidFloorPlanError(f"{label} must be a list, not {json_kind(value)}", room=room)
    if len(value) > limit:
        raise InvalidFloorPlanError(f"{len(value)} {label}; the limit is {limit} ({limit_name})", room=room)
    return list(value)


def read_points(
    raw: list[Any] | tuple[Any, ...], limits: PlanLimits, room: str | None, where: str = "vertex"
) -> Float[np.ndarray, "n 2"]:
    """Read coordinates (m), which must be finite and not too far from the origin."""
    for index, point in enumerate(raw):
        if not (isinstance(point, list | tuple) and len(point) == 2 and all(is_number(value) for value in point)):
            raise InvalidFloorPlanError(f"{where} {index} must be two numbers [x, y]", room=room)
        if not all(_is_finite(value) and abs(value) <= limits.max_coordinate_m for value in point):
            shown = ", ".join(str(value)[:_SHOWN] for value in point)
            raise InvalidFloorPlanError(
                f"{where} {index} is [{shown}]; coordinates must be finite and at most "
                f"{limits.max_coordinate_m:.0f} m from the origin (PlanLimits.max_coordinate_m)",
                room=room,
            )
    return np.array(raw, dtype=np.float64).reshape(-1, 2)


def read_segment(raw: Any, label: str, limits: PlanLimits, room: str | None) -> Float[np.ndarray, "2 2"]:
    """Read two different points [[x, y], [x, y]]."""
    if not isinstance(raw, list | tuple) or len(raw) != 2:
        raise InvalidFloorPlanError(f"{label} must be two points [[x, y], [x, y]]", room=room)
    points = read_points(raw, limits, room, f"{label}: point")
    if float(np.hypot(*(points[1] - points[0]))) < _MIN_SEGMENT_M:
        raise InvalidFloorPlanError(f"{label} is shorter than {_MIN_SEGMENT_M:g} m, the minimum", room=room)
    return points


def _is_finite(value: int | float) -> bool:
    """Return True if a number is finite as a float; JSON integers have no bounds."""
    return -sys.float_info.max <= value <= sys.float_info.max
