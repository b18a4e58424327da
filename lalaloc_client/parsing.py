"""Conversion of JSON answers to dataclasses: known fields are checked, unknown ones ignored."""

from __future__ import annotations

from functools import cache
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from lalaloc_client.errors import MalformedAnswerError

T = TypeVar("T")


def parse(kind: type[T], content: bytes | str, name: str = "answer") -> T:
    """Return JSON content as an instance of `kind`."""
    try:
        return _adapter(kind).validate_json(content, strict=True)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        field = ".".join([name, *map(str, fault["loc"])])
        raise MalformedAnswerError(f"{field}: {fault['msg']} (got {fault['input']!r:.100})") from error


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)
