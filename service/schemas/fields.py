"""Base class of all answers, validators of form fields, and problem documents."""

from __future__ import annotations

import json
from collections.abc import Callable

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo

Finite = Field(allow_inf_nan=False)


class ResponseModel(BaseModel):
    """Base of all answers."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class CoreAnswer(BaseModel, frozen=True, extra="forbid"):
    """Base of answers that have the fields of a frozen class of the core."""


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


class Fault(ResponseModel):
    """Fault in one field."""

    field: str
    message: str


class Problem(BaseModel):
    """Problem document of RFC 9457."""

    type: str = Field(description="Stable identifier of the kind of error.")
    title: str
    status: int
    detail: str = Field(description="Cause of the error, with value and limit.")
    request_id: str | None = Field(None, description="Id of the request in the service's log.")
    room: str | None = Field(None, description="Faulty room of an invalid floor plan.")
    levels: list[str] | None = Field(None, description="Levels to choose from, for a file with several.")
    errors: list[Fault] | None = Field(None, description="All faulty fields of an invalid request.")
