"""Frozen dataclasses from plain data, strictly: configurations travel inside checkpoints and bundles."""

from __future__ import annotations

import dataclasses
import types
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from lalaloc_core.errors import ConfigError


def build_config(kind: type[Any], raw: Any, *, path: str = "config") -> Any:
    """Build a frozen dataclass from plain data, refusing unknown keys and wrong types.

    Raises:
        ConfigError: names the path of the offending key.
    """
    if not isinstance(raw, dict):
        raise ConfigError(f"{path} must be a mapping, not {type(raw).__name__}")
    hints = get_type_hints(kind)
    unknown = sorted(set(raw) - set(hints))
    if unknown:
        raise ConfigError(f"{path} has no key '{unknown[0]}', known are {', '.join(sorted(hints))}")
    try:
        return kind(**{name: _convert(hints[name], value, f"{path}.{name}") for name, value in raw.items()})
    except TypeError as error:
        raise ConfigError(f"{path}: {error}") from error


def _convert(hint: Any, value: Any, path: str) -> Any:
    if hint is Any:
        return value
    if dataclasses.is_dataclass(hint):
        return build_config(hint, value, path=path)  # type: ignore[arg-type]
    origin = get_origin(hint)
    if origin is Literal:
        if value in get_args(hint):
            return value
        raise ConfigError(f"{path} is {value!r}, it must be one of {', '.join(map(repr, get_args(hint)))}")
    if origin in (Union, types.UnionType):
        return None if value is None else _convert(next(a for a in get_args(hint) if a is not type(None)), value, path)
    if origin is tuple and isinstance(value, list | tuple):
        return tuple(_convert(get_args(hint)[0], item, path) for item in value)
    if origin is dict and isinstance(value, dict):
        return {key: _convert(get_args(hint)[1], item, f"{path}.{key}") for key, item in value.items()}
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(hint, type) and isinstance(value, hint) and not (hint is int and isinstance(value, bool)):
        return value
    raise ConfigError(f"{path} is {value!r}, it must be of type {getattr(hint, '__name__', hint)}")
