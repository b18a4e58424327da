"""Validators of form fields, which are texts."""

from __future__ import annotations

import json
from collections.abc import Callable

from pydantic import ValidationInfo


def reject_underscores(value: object) -> object:
    """Refuse texts such as `1_000`, which Python takes for numbers."""
    if isinstance(value, str) and "_" in value:
        raise ValueError("not a number")
    return value


def parse_json(what: str, kind: type = object) -> Callable[[object], object]:
    """Return a validator that parses a text as JSON of a kind; `what` stands in its error."""

    def parse(value: object) -> object:
        if not isinstance(value, str):
            return value
        try:
            found = json.loads(value)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"not {what}") from error
        if not isinstance(found, kind):
            raise ValueError(f"not {what}")
        return found

    return parse


def needs(field: str) -> Callable[[float, ValidationInfo], float]:
    """Return a validator that refuses a tolerance without the field that it is about."""

    def check(value: float, given: ValidationInfo) -> float:
        # Generated clients send defaults too.
        if value > 0.0 and given.data.get(field, 0.0) is None:
            raise ValueError(f"needs {field}")
        return value

    return check
