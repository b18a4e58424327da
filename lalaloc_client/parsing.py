"""Conversion of JSON answers to dataclasses: known fields are checked, unknown ones ignored."""

from __future__ import annotations

from dataclasses import make_dataclass
from functools import cache
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from lalaloc_client.errors import MalformedAnswerError

T = TypeVar("T")
_adapter = cache(TypeAdapter)


def parse(kind: type[T], content: bytes | str, name: str = "answer") -> T:
    """Return JSON content as an instance of `kind`."""
    try:
        return _adapter(kind).validate_json(content, strict=True)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        field = ".".join([name, *map(str, fault["loc"])])
        raise MalformedAnswerError(f"{field}: {fault['msg']} (got {fault['input']!r:.100})") from error


@cache
def page_of(kind: type[Any], rows: str) -> Any:
    """Return the class of a page of a listing: its rows, and `next_cursor`, which is None on the last page."""
    return make_dataclass("Page", [(rows, tuple[kind, ...]), ("next_cursor", str | None, None)], frozen=True)
