"""Dataclasses from plain data, strictly: configurations, manifests and results travel as JSON and in checkpoints.

Read by pydantic, which checks every value against the dataclass's own annotations: no key may be unknown, no type is
converted but whole numbers where a float is wanted, numbers are finite, tuples have their length, and every arm of a
union is tried.
"""

from __future__ import annotations

import json
from functools import cache
from typing import Any, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from lalaloc_core.errors import ConfigError

_Kind = TypeVar("_Kind")


def build_config(kind: type[_Kind], raw: Any, *, path: str = "config") -> _Kind:
    """Build a dataclass from plain data: what JSON knows, and tuples.

    Args:
        path: what errors call `raw`.

    Raises:
        ConfigError: names the path of the offending key, its value and what it must be.
    """
    try:
        # As JSON, because that has one kind of sequence: checkpoints keep tuples, files have lists.
        return _adapter(kind).validate_json(json.dumps([raw]), strict=True, extra="forbid")[0]
    except ValidationError as error:
        raise _explained(error.errors()[0], path) from error
    except TypeError as error:
        raise ConfigError(f"{path} is no plain data: {error}") from error


@cache
def _adapter(kind: type[Any]) -> Any:
    # In a tuple, because that may have settings, which hold for the dataclasses inside; a dataclass itself may not.
    return TypeAdapter(tuple[kind], config=ConfigDict(allow_inf_nan=False))


def _explained(problem: ErrorDetails, path: str) -> ConfigError:
    """The error in this project's words."""
    cause = problem.get("ctx", {}).get("error")
    if isinstance(cause, ConfigError):
        # Raised by the dataclass itself, about values that do not go together.
        return cause
    where, kind = [path, *problem["loc"][1:]], problem["type"]
    if kind == "unexpected_keyword_argument":
        return ConfigError(f"{_joined(where[:-1])} has no key '{where[-1]}'")
    if kind == "missing" and isinstance(where[-1], int):
        return ConfigError(f"{_joined(where[:-1])} is {problem['input']!r}: it has too few items")
    if kind == "missing":
        return ConfigError(f"{_joined(where[:-1])} lacks the key '{where[-1]}'")
    if kind.startswith("dataclass"):
        return ConfigError(f"{_joined(where)} must be a mapping, not {type(problem['input']).__name__}")
    return ConfigError(f"{_joined(where)} is {problem['input']!r}: {problem['msg'].removeprefix('Value error, ')}")


def _joined(where: list[str | int]) -> str:
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in where).removeprefix(".")
