"""Errors, as of RFC 9457."""

from __future__ import annotations

from pydantic import BaseModel, Field

from service.schemas.fields import ResponseModel


class Fault(ResponseModel):
    """One field at fault."""

    field: str
    message: str


class Problem(BaseModel):
    """An error as of RFC 9457."""

    type: str = Field(description="Stable identifier of the kind of error.")
    title: str
    status: int
    detail: str = Field(description="What is wrong with this request, with value and limit.")
    request_id: str | None = Field(None, description="Names this request in the service's log.")
    room: str | None = Field(None, description="The room at fault, for an invalid floor plan.")
    levels: list[str] | None = Field(None, description="The levels of a file with several, to choose one of.")
    errors: list[Fault] | None = Field(None, description="Every field at fault, for an invalid request.")
