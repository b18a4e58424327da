"""Request ids, metrics, and one log line and span per request."""

from __future__ import annotations

import logging
import re
import uuid
from collections.abc import Sequence
from time import perf_counter
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.telemetry.logs import (
    LOGGER_NAME,
    RequestLogFields,
    attach_log_fields,
    child_of,
    current_log_fields,
    parse_traceparent,
)
from service.telemetry.metrics import Telemetry
from service.telemetry.tracing import OpenSpan

_METHODS = {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"}
_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
_PLAN_ID = re.compile(r"[0-9a-f]{32}")
# Polled every few seconds, so logged at debug level only.
_PROBES = frozenset({"/healthz", "/readyz", "/metrics"})
# nginx's status for a client that disconnected before the answer.
_CLIENT_CLOSED = 499
# Attributes of `RequestLogFields` in the log line.
_LOGGED = ("bytes_in", "plan", "venue", "revision", "stage", "gave_up", "rejection", "key", "tenant")


class TelemetryMiddleware:
    """Outermost middleware, which also sees the answers to unexpected errors.

    A valid `X-Request-ID` or `traceparent` of the client is kept; both are returned. The routes name requests that are
    refused before routing.
    """

    def __init__(self, app: ASGIApp, telemetry: Telemetry, routes: Sequence[Route]) -> None:
        self._app, self._telemetry = app, telemetry
        self._routes = tuple(routes)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        log_fields, opened = self._begin(Headers(scope=scope))
        attach_log_fields(scope, log_fields)
        token = current_log_fields.set(log_fields)
        exchange = _Exchange(log_fields, receive, send)
        begin = perf_counter()
        try:
            await self._app(scope, exchange.receive, exchange.send)
        except Exception:
            logging.getLogger(LOGGER_NAME).exception("unexpected error")
            # Re-raising after a complete answer would only log the trace again, without ids.
            if not exchange.complete:
                raise
        finally:
            self._end(scope, log_fields, opened, exchange.status, perf_counter() - begin)
            current_log_fields.reset(token)

    def _begin(self, headers: Headers) -> tuple[RequestLogFields, OpenSpan | None]:
        sent = headers.get("x-request-id", "")
        request_id = sent if _REQUEST_ID.fullmatch(sent) else uuid.uuid4().hex
        parent = parse_traceparent(headers.getlist("traceparent"))
        tracing, opened = self._telemetry.tracing, None
        if tracing is None:
            trace = child_of(parent)
        else:
            trace, opened = tracing.begin(parent)
        return RequestLogFields(request_id, trace), opened

    def _end(
        self, scope: Scope, log_fields: RequestLogFields, opened: OpenSpan | None, status: int, duration_s: float
    ) -> None:
        route = self._template(scope)
        method = scope["method"] if scope["method"] in _METHODS else "OTHER"
        if log_fields.plan is None:
            log_fields.plan = _plan_in_path(scope)
        telemetry = self._telemetry
        telemetry.requests.labels(method, route, str(status)).inc()
        telemetry.request_seconds.labels(route).observe(duration_s)
        if log_fields.rejection is not None:
            telemetry.rejections.labels(log_fields.rejection).inc()
        if log_fields.gave_up:
            telemetry.disconnects.labels(route).inc()
        if opened is not None and telemetry.tracing is not None:
            telemetry.tracing.end(opened, log_fields, method=method, route=route, status=status)
        spans = log_fields.clock.spans() if log_fields.clock is not None else {}
        fields: dict[str, Any] = {
            "method": method,
            "route": route,
            "status": status,
            "ms": round(duration_s * 1e3, 1),
            **{name: getattr(log_fields, name) for name in _LOGGED},
            "stages_ms": {name: round(spent_s * 1e3, 1) for name, (_, spent_s) in spans.items()},
            "span_id": log_fields.trace.span_id,
        }
        level = logging.DEBUG if route in _PROBES else logging.INFO
        logging.getLogger(LOGGER_NAME).log(level, "request", extra={"fields": fields})

    def _template(self, scope: Scope) -> str:
        """Return the route's template; real paths would create a time series per floor plan."""
        if "route" in scope:
            return getattr(scope["route"], "path", "unmatched")
        found = (route.path for route in self._routes if route.path_regex.match(scope["path"]))
        return next(found, "unmatched")


class _Exchange:
    """Observer of the bytes received and sent for one request."""

    def __init__(self, log_fields: RequestLogFields, receive: Receive, send: Send) -> None:
        self._log_fields, self._receive, self._send = log_fields, receive, send
        self._status: int | None = None
        self.complete = False

    @property
    def status(self) -> int:
        """Status of the answer; 499 or 500 if there was none."""
        if self._status is not None:
            return self._status
        return _CLIENT_CLOSED if self._log_fields.gave_up else 500

    async def receive(self) -> Message:
        message = await self._receive()
        if message["type"] == "http.request":
            self._log_fields.bytes_in += len(message.get("body", b""))
        elif message["type"] == "http.disconnect" and not self.complete:
            self._log_fields.gave_up = True
        return message

    async def send(self, message: Message) -> None:
        """Send a part of the answer; its head gets the request's ids."""
        if message["type"] == "http.response.start":
            self._status = message["status"]
            headers = MutableHeaders(scope=message)
            headers["X-Request-ID"] = self._log_fields.request_id
            headers["traceparent"] = self._log_fields.trace.header
        elif message["type"] == "http.response.body" and not message.get("more_body", False):
            self.complete = True
        await self._send(message)


def _plan_in_path(scope: Scope) -> str | None:
    """Return the floor plan id in the path, if it is well-formed."""
    plan_id = scope.get("path_params", {}).get("floorplan_id", "")
    return plan_id if _PLAN_ID.fullmatch(plan_id) else None
