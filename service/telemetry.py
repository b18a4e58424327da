"""Metrics in a registry of their own, and log lines as JSON with the id of the request they belong to."""

from __future__ import annotations

import json
import logging
import re
import uuid
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager
from contextvars import ContextVar
from time import perf_counter
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, generate_latest
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOGGER_NAME = "lalaloc"
request_id_var: ContextVar[str | None] = ContextVar("lalaloc_request_id", default=None)

_METHODS = {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"}
_SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
_GRID_SECONDS = (0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0, 1800.0)


class Telemetry:
    """The service's Prometheus metrics; one instance, hence one registry, per app."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._gauges: dict[str, Gauge] = {}
        ProcessCollector(registry=self.registry)
        self.requests = Counter(
            "lalaloc_http_requests", "Requests answered.", ["method", "route", "status"], registry=self.registry
        )
        self.request_seconds = Histogram(
            "lalaloc_http_request_seconds",
            "Time to answer, upload included.",
            ["route"],
            buckets=_SECONDS,
            registry=self.registry,
        )
        self.stage_seconds = Histogram(
            "lalaloc_stage_seconds", "Time per stage of a query.", ["stage"], buckets=_SECONDS, registry=self.registry
        )
        self.answers = Counter(
            "lalaloc_localise_answers",
            "Queries answered, by the stage that answered.",
            ["stage"],
            registry=self.registry,
        )
        self.lpo_restarts = Counter(
            "lalaloc_lpo_restarts", "LPO workers that had to be replaced.", registry=self.registry
        )
        self.lpo_missed = Counter(
            "lalaloc_lpo_missed", "LPO jobs without an answer in time, by reason.", ["reason"], registry=self.registry
        )
        self.grid_seconds = Histogram(
            "lalaloc_grid_seconds", "Time to compute a latent grid.", buckets=_GRID_SECONDS, registry=self.registry
        )

    def gauge(self, name: str, meaning: str, read: Callable[[], float]) -> None:
        """Add a gauge that is read when metrics are asked for; an app that is started again replaces its gauges."""
        if name not in self._gauges:
            self._gauges[name] = Gauge(name, meaning, registry=self.registry)
        self._gauges[name].set_function(read)

    @contextmanager
    def timed(self, histogram: Histogram) -> Iterator[None]:
        """Observe the duration of the block."""
        begin = perf_counter()
        try:
            yield
        finally:
            histogram.observe(perf_counter() - begin)

    def render(self) -> bytes:
        """All metrics in Prometheus' text format."""
        return generate_latest(self.registry)


class _JsonFormatter(logging.Formatter):
    """One JSON object per line: time, level, message, request id, and the fields given as `extra={"fields": ...}`."""

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, object] = {
            "time": self.formatTime(record, "%Y-%m-%dT%H:%M:%S%z"),
            "level": record.levelname.lower(),
            "message": record.getMessage(),
        }
        request_id = request_id_var.get()
        if request_id is not None:
            line["request_id"] = request_id
        line.update(getattr(record, "fields", {}))
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def configure_logging(level: str) -> logging.Logger:
    """Send the service's log to standard error as JSON lines; calling it again only changes the level."""
    logger = logging.getLogger(LOGGER_NAME)
    logger.setLevel(level.upper())
    if not any(isinstance(handler.formatter, _JsonFormatter) for handler in logger.handlers):
        handler = logging.StreamHandler()
        handler.setFormatter(_JsonFormatter())
        logger.addHandler(handler)
        logger.propagate = False
    return logger


_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
_REQUEST_ID_KEY = "lalaloc.request_id"


def request_id_of(scope: MutableMapping[str, Any]) -> str | None:
    """The id of the request with this scope."""
    return scope.get(_REQUEST_ID_KEY)


class TelemetryMiddleware:
    """Gives every request an id (the caller's `X-Request-ID` if it is a sane one), and counts, times and logs it."""

    def __init__(self, app: ASGIApp, telemetry: Telemetry) -> None:
        self._app = app
        self._telemetry = telemetry

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        given = dict(scope["headers"]).get(b"x-request-id", b"").decode("latin-1")
        request_id = given if _REQUEST_ID.fullmatch(given) else uuid.uuid4().hex
        scope[_REQUEST_ID_KEY] = request_id
        token = request_id_var.set(request_id)
        begin, status = perf_counter(), 500

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                message = {**message, "headers": [*message["headers"], (b"x-request-id", request_id.encode())]}
            await send(message)

        try:
            await self._app(scope, receive, send_with_id)
        except Exception:
            logging.getLogger(LOGGER_NAME).exception("unexpected error")
            raise
        finally:
            self._observe(scope, status, perf_counter() - begin)
            request_id_var.reset(token)

    def _observe(self, scope: Scope, status: int, duration_s: float) -> None:
        # The route's template: real paths would make a new time series per floor plan.
        route = getattr(scope.get("route"), "path", "unmatched")
        method = scope["method"] if scope["method"] in _METHODS else "OTHER"
        self._telemetry.requests.labels(method, route, str(status)).inc()
        self._telemetry.request_seconds.labels(route).observe(duration_s)
        fields = {"method": method, "path": scope["path"][:200], "status": status, "ms": round(duration_s * 1e3, 1)}
        logging.getLogger(LOGGER_NAME).info("request", extra={"fields": fields})
