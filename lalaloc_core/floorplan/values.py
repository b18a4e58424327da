"""Readers for single values of a plan's document; errors name the value in JSON terms."""

from __future__ import annotations

import sys
import unicodedata
from collections.abc import Collection, Mapping
from typing import Any, TypeGuard

import numpy as np
from jaxtyping import Float

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.limits import PlanLimits

# Unicode categories that files and drawings cannot hold: control characters and lone surrogates.
_NOT_TEXT = {"Cc", "Cs"}
# Longest part of a wrong value in a message.
_SHOWN = 50
# Shorter than any opening or stub of wall, longer than the rounding of a drawing.
_MIN_SEGMENT_M = 0.01


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
