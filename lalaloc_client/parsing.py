"""Dataclasses from the JSON of answers: strict about what they know, blind to what they do not.

By hand, as httpx is all that the client depends on. Of unions it knows those of a type and None, which are all that
answers have.
"""

from __future__ import annotations

import types
from dataclasses import MISSING, fields, is_dataclass
from datetime import datetime
from functools import cache
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from lalaloc_client.errors import MalformedAnswerError

T = TypeVar("T")


def parse(wanted: type[T], data: object, where: str = "answer") -> T:
    """JSON values as a dataclass of this module.

    Raises:
        MalformedAnswerError: names the field that is missing or of another type.
    """
    return _value(wanted, data, where)


@cache
def _types_of(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def _value(wanted: Any, data: object, where: str) -> Any:
    if wanted is Any:
        return data
    origin, arguments = get_origin(wanted), get_args(wanted)
    if origin in (Union, types.UnionType):
        if data is None:
            return None
        (other,) = (one for one in arguments if one is not type(None))
        return _value(other, data, where)
    if is_dataclass(wanted):
        return _record(wanted, data, where)
    if origin is tuple:
        return _sequence(arguments, data, where)
    if wanted is datetime:
        return _moment(data, where)
    if origin is not None:
        # Mappings are the only other kind of container here.
        return {str(key): _value(arguments[1], one, f"{where}.{key}") for key, one in _object(data, where).items()}
    if wanted is float and type(data) is int:
        return float(data)
    # By type and not isinstance: true is no number.
    if type(data) is not wanted:
        raise MalformedAnswerError(f"{where} is {data!r:.100}, not of type {wanted.__name__}")
    return data


def _record(cls: Any, data: object, where: str) -> Any:
    given, hints = _object(data, where), _types_of(cls)
    values = {}
    for one in fields(cls):
        if one.name in given:
            values[one.name] = _value(hints[one.name], given[one.name], f"{where}.{one.name}")
        elif one.default is MISSING:
            raise MalformedAnswerError(f"{where}.{one.name} is missing")
    return cls(**values)


def _sequence(arguments: tuple[Any, ...], data: object, where: str) -> tuple[Any, ...]:
    if not isinstance(data, list):
        raise MalformedAnswerError(f"{where} is {data!r:.100}, not a list")
    if arguments[-1] is Ellipsis:
        arguments = (arguments[0],) * len(data)
    if len(arguments) != len(data):
        raise MalformedAnswerError(f"{where} has {len(data)} items, not {len(arguments)}")
    return tuple(
        _value(one, item, f"{where}[{index}]") for index, (one, item) in enumerate(zip(arguments, data, strict=True))
    )


def _moment(data: object, where: str) -> datetime:
    try:
        return datetime.fromisoformat(str(data))
    except ValueError as error:
        raise MalformedAnswerError(f"{where} is {data!r:.100}, not a time") from error


def _object(data: object, where: str) -> dict[str, Any]:
    if not isinstance(data, dict):
        raise MalformedAnswerError(f"{where} is {data!r:.100}, not an object")
    return data
