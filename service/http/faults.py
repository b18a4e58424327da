"""What is wrong with the fields of a request, in words of this API and not of the libraries that check them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

_MAX_SHOWN = 100


def _number(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


# By the type that pydantic gives a fault; what is not here keeps pydantic's words.
_WORDS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "float_parsing": lambda _: "not a number",
    "float_type": lambda _: "not a number",
    "int_parsing": lambda _: "not a whole number",
    "int_type": lambda _: "not a whole number",
    "int_from_float": lambda _: "not a whole number",
    "int_parsing_size": lambda _: "too many digits",
    "bool_parsing": lambda _: "must be true or false",
    "finite_number": lambda _: "must be finite",
    "greater_than_equal": lambda told: f"must be at least {_number(told['ge'])}",
    "greater_than": lambda told: f"must be more than {_number(told['gt'])}",
    "less_than_equal": lambda told: f"must be at most {_number(told['le'])}",
    "less_than": lambda told: f"must be less than {_number(told['lt'])}",
    "literal_error": lambda told: f"must be {told['expected']}",
    "string_too_short": lambda told: f"must have at least {told['min_length']} characters",
    "string_too_long": lambda told: f"must have at most {told['max_length']} characters",
    "string_pattern_mismatch": lambda _: "has characters that are not allowed",
    "value_error": lambda told: str(told["error"]),
}


def describe_fault(fault: Mapping[str, Any]) -> tuple[str, str]:
    """(field, message) of one of pydantic's faults; the message states the value."""
    parts = [str(part) for part in fault.get("loc", ())]
    if parts and parts[0] in ("body", "query", "path"):
        parts = parts[1:]
    kind, told = fault.get("type", ""), fault.get("ctx", {})
    field = ".".join(parts) or "body"
    if kind == "missing":
        return field, "is missing"
    if kind in ("too_short", "too_long"):
        wanted = told.get("min_length", told.get("max_length"))
        return field, f"is given {told.get('actual_length')} times, {wanted} are needed"
    words = _WORDS[kind](told) if kind in _WORDS else str(fault.get("msg", "invalid"))
    value = fault.get("input")
    shown = f"is '{str(value)[:_MAX_SHOWN]}': " if isinstance(value, str | int | float) else ""
    return field, shown + words
