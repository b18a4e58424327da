"""Logging as JSON on standard error, with the ids of the request, its log fields, and W3C Trace Context.

Source: W3C Recommendation "Trace Context", sections 3.2 (the header `traceparent`) and 4 (processing model).
"""

from __future__ import annotations

import json
import logging
import re
import secrets
from collections.abc import Mapping, MutableMapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from starlette.requests import HTTPConnection

if TYPE_CHECKING:
    from lalaloc_core.localise.search.pipeline import StageClock

_SAMPLED = 0x01
_FORBIDDEN_VERSION = "ff"
_PARENT = re.compile(r"([0-9a-f]{2})-([0-9a-f]{32})-([0-9a-f]{16})-([0-9a-f]{2})(-.*)?")


@dataclass(frozen=True)
class TraceContext:
    """Span of a trace: lower-case hexadecimal ids, and the caller's sampling flag."""

    trace_id: str
    span_id: str
    sampled: bool

    @property
    def header(self) -> str:
        """Value of `traceparent`; unknown flags are cleared, as the recommendation requires."""
        return f"00-{self.trace_id}-{self.span_id}-{_SAMPLED if self.sampled else 0:02x}"


def parse_traceparent(values: Sequence[str]) -> TraceContext | None:
    """Return the caller's span; None if the header is missing, repeated or invalid.

    In versions above 00, the known fields are read if a dash follows them.
    """
    match = _PARENT.fullmatch(values[0].strip(" \t")) if len(values) == 1 else None
    if match is None:
        return None
    version, trace_id, span_id, flags, more = match.groups()
    if version == _FORBIDDEN_VERSION or (version == "00" and more is not None):
        return None
    # All zeros is invalid.
    if not int(trace_id, 16) or not int(span_id, 16):
        return None
    return TraceContext(trace_id, span_id, bool(int(flags, 16) & _SAMPLED))


def child_of(parent: TraceContext | None) -> TraceContext:
    """Return a new span in the caller's trace, or in a new, unsampled trace."""
    span_id = secrets.token_hex(8)
    if parent is None:
        return TraceContext(secrets.token_hex(16), span_id, sampled=False)
    return TraceContext(parent.trace_id, span_id, parent.sampled)


_SCOPE_KEY = "lalaloc.log_fields"


@dataclass(slots=True)
class RequestLogFields:
    """Fields of one request; None if unknown.

    Attributes:
        request_id: id in answers and log lines.
        trace: this service's span of the caller's trace.
        revision: id of the revision of the plan, or of the venue where there is no plan.
        stage: last stage of the query.
        clock: durations of the stages, also of a request that failed.
        rejection: slug of the problem that the request was refused with.
        key: id of the API key, or subject of the token; never the key itself.
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


LOGGER_NAME = "lalaloc"
# The HTTP server's access log contains query strings and adds nothing to ours.
_SERVER, _SERVER_ACCESS = "uvicorn", "uvicorn.access"
# The warnings about client input are already in the answers and in the log line of the request.
_FORMS = "python_multipart"


class JsonFormatter(logging.Formatter):
    """Formatter with one JSON object per line: time (UTC), level, message, ids, and fields.

    Fields are given as `extra={"fields": ...}`; `request_id` and `trace_id` are null outside requests.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return the line in ASCII."""
        log_fields = current_log_fields.get()
        line: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "message": record.getMessage(),
            "request_id": log_fields and log_fields.request_id,
            "trace_id": log_fields and log_fields.trace.trace_id,
        }
        line.update(getattr(record, "fields", {}))
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def configure_logging(level: str) -> logging.Logger:
    """Log to standard error, libraries included; a second call only changes the level."""
    logger = logging.getLogger(LOGGER_NAME)
    logger.setLevel(level.upper())
    if not any(isinstance(handler.formatter, JsonFormatter) for handler in logger.handlers):
        handler = logging.StreamHandler()
        handler.setFormatter(JsonFormatter())
        logger.addHandler(handler)
        logger.propagate = False
        server = logging.getLogger(_SERVER)
        server.handlers, server.propagate = [handler], False
        # Library logs, unless the application has a handler of its own.
        if not logging.getLogger().handlers:
            logging.getLogger().addHandler(handler)
    access = logging.getLogger(_SERVER_ACCESS)
    access.handlers, access.propagate = [], False
    logging.getLogger(_FORMS).setLevel(logging.ERROR)
    return logger
