"""Strict construction of dataclasses from plain data: configurations, manifests and results from JSON and checkpoints.

Pydantic checks every value against the dataclass's annotations: unknown keys and infinite numbers are errors, and no
type is converted except integers where a float is expected.
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
    """Build a dataclass from plain data: the types of JSON, and tuples.

    `path` is the name of `raw` in error messages.

    Raises:
        ConfigError: names the path of the wrong key, its value and the expected value.
    """
    try:
        # Through JSON, which has one kind of sequence: checkpoints hold tuples, files hold lists.
        return _adapter(kind).validate_json(json.dumps([raw]), strict=True, extra="forbid")[0]
    except ValidationError as error:
        raise _explained(error.errors()[0], path) from error
    except TypeError as error:
        raise ConfigError(f"{path} is not plain data: {error}") from error


@cache
def _adapter(kind: type[Any]) -> Any:
    # Pydantic takes a configuration for a tuple of dataclasses, but not for a dataclass itself.
    return TypeAdapter(tuple[kind], config=ConfigDict(allow_inf_nan=False))


def _explained(problem: ErrorDetails, path: str) -> ConfigError:
    """Convert an error of pydantic to this project's terms."""
    cause = problem.get("ctx", {}).get("error")
    if isinstance(cause, ConfigError):
        # Raised by the dataclass itself, for values that contradict each other.
        return cause
    location, kind = [path, *problem["loc"][1:]], problem["type"]
    if kind == "unexpected_keyword_argument":
        return ConfigError(f"{_joined(location[:-1])} has no key '{location[-1]}'")
    if kind == "missing" and isinstance(location[-1], int):
        return ConfigError(f"{_joined(location[:-1])} is {problem['input']!r}: it has too few items")
    if kind == "missing":
        return ConfigError(f"{_joined(location[:-1])} lacks the key '{location[-1]}'")
    if kind.startswith("dataclass"):
        return ConfigError(f"{_joined(location)} must be a mapping, not {type(problem['input']).__name__}")
    return ConfigError(f"{_joined(location)} is {problem['input']!r}: {problem['msg'].removeprefix('Value error, ')}")


def _joined(location: list[str | int]) -> str:
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).removeprefix(".")
