"""Problem documents of RFC 9457."""

from __future__ import annotations

from pydantic import BaseModel, Field

from service.schemas.fields import ResponseModel


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
