"""Strict JSON parsing in time linear in the length of the text."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np

from lalaloc_core.errors import InvalidFloorPlanError

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
        _check_digits(structure)
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
    """Refuse deep nesting and many values before they are parsed; `structure` is the text without its strings."""
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


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise InvalidFloorPlanError(f"the key '{key[:50]}' occurs twice in one object; remove one of them")
        found[key] = value
    return found


def _check_digits(structure: str) -> None:
    found = _DIGITS.search(structure)
    if found is not None:
        raise InvalidFloorPlanError(f"a number has {len(found[0])} digits; the limit is {_MAX_DIGITS}")
