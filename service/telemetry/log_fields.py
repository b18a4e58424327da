"""Fields of a request's log line, filled in while the request is handled."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from starlette.requests import HTTPConnection

from service.telemetry.trace_context import TraceContext

if TYPE_CHECKING:
    from lalaloc_core.localise.search.pipeline import StageClock

_SCOPE_KEY = "lalaloc.log_fields"


@dataclass(slots=True)
class RequestLogFields:
    """Fields of one request; None if unknown.

    Attributes:
        request_id: id in answers and log lines.
        trace: this service's span of the caller's trace.
        plan: id of the floor plan.
        venue: id of the venue.
        revision: id of the revision of the plan, or of the venue where there is no plan.
        stage: last stage of the query.
        clock: durations of the stages, also of a request that failed.
        rejection: slug of the problem that the request was refused with.
        key: id of the API key, or subject of the token; never the key itself.
        tenant: tenant of the key or token.
        bytes_in: received bytes of the body.
        gave_up: the client disconnected before the end of the answer.
    """

    request_id: str
    trace: TraceContext
    plan: str | None = None
    venue: str | None = None
    revision: str | None = None
    stage: str | None = None
    clock: StageClock | None = None
    rejection: str | None = None
    key: str | None = None
    tenant: str | None = None
    bytes_in: int = 0
    gave_up: bool = False


# Fields of the current request, for the ids in log lines.
current_log_fields: ContextVar[RequestLogFields | None] = ContextVar("lalaloc_request", default=None)


def attach_log_fields(scope: MutableMapping[str, Any], log_fields: RequestLogFields) -> None:
    """Attach the fields to a request."""
    scope[_SCOPE_KEY] = log_fields


def add_log_fields(request: HTTPConnection, **fields: str | StageClock | None) -> None:
    """Set attributes of a request's `RequestLogFields`; those that are None keep their value. Never pass secrets."""
    log_fields = log_fields_of(request.scope)
    for name, value in fields.items() if log_fields is not None else ():
        if value is not None:
            setattr(log_fields, name, value)


def request_id_of(scope: Mapping[str, Any]) -> str | None:
    """Return the id of the request with this scope."""
    log_fields = log_fields_of(scope)
    return None if log_fields is None else log_fields.request_id


def log_fields_of(scope: Mapping[str, Any]) -> RequestLogFields | None:
    """Return the fields of the request with this scope; None outside of the service's middleware."""
    return scope.get(_SCOPE_KEY)
