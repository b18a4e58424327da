"""OpenTelemetry spans of requests and their stages; the extra `otel` is imported only when used.

Instrumentation libraries do not fit: spans of stages are created afterwards from measured times, some of them from
other processes, and request and trace ids also exist without the extra.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter, time_ns
from typing import TYPE_CHECKING

from lalaloc_core.errors import ConfigError, install_command
from service.telemetry.logs import RequestLogFields, TraceContext

if TYPE_CHECKING:
    from opentelemetry.sdk.trace.export import SpanExporter
    from opentelemetry.trace import Span

_EXPORT_TIMEOUT_S = 5.0
# Attributes of `RequestLogFields` in spans.
_ATTRIBUTES = ("request_id", "plan", "venue", "revision", "stage", "rejection", "tenant")


def otlp_exporter(endpoint: str) -> SpanExporter:
    """Return an OTLP/HTTP exporter to the URL of a collector, such as `http://collector:4318/v1/traces`."""
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
    except ImportError as error:
        raise ConfigError(
            f"LALALOC_OTLP_ENDPOINT is '{endpoint}', but '{error.name}' is missing: run {install_command('otel')}"
        ) from error
    return OTLPSpanExporter(endpoint=endpoint, timeout=_EXPORT_TIMEOUT_S)


@dataclass(frozen=True)
class OpenSpan:
    """Open span, with its start on the clock of the stages (`perf_counter`, in seconds)."""

    span: Span
    began_ns: int
    began_s: float

    def at_ns(self, moment_s: float) -> int:
        """Convert a time on that clock to nanoseconds of Unix time."""
        return self.began_ns + round((moment_s - self.began_s) * 1e9)


class Tracing:
    """Spans, exported by a background thread that drops what it cannot send in time."""

    def __init__(self, exporter: SpanExporter, version: str) -> None:
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor

        resource = Resource.create({"service.name": "lalaloc", "service.version": version})
        # Default sampling: the caller decides for its traces; new traces are recorded.
        self._provider = TracerProvider(resource=resource, shutdown_on_exit=False)
        self._provider.add_span_processor(BatchSpanProcessor(exporter))
        self._tracer = self._provider.get_tracer("lalaloc", version)

    def begin(self, parent: TraceContext | None) -> tuple[TraceContext, OpenSpan]:
        """Open a request's span, in the caller's trace if there is one."""
        from opentelemetry import trace

        context = trace.set_span_in_context(trace.INVALID_SPAN)
        if parent is not None:
            caller = trace.SpanContext(
                trace_id=int(parent.trace_id, 16),
                span_id=int(parent.span_id, 16),
                is_remote=True,
                trace_flags=trace.TraceFlags(trace.TraceFlags.SAMPLED if parent.sampled else 0),
            )
            context = trace.set_span_in_context(trace.NonRecordingSpan(caller))
        began_ns, began_s = time_ns(), perf_counter()
        span = self._tracer.start_span("request", context, kind=trace.SpanKind.SERVER, start_time=began_ns)
        created = span.get_span_context()
        ids = TraceContext(f"{created.trace_id:032x}", f"{created.span_id:016x}", created.trace_flags.sampled)
        return ids, OpenSpan(span, began_ns, began_s)

    def end(self, opened: OpenSpan, log_fields: RequestLogFields, *, method: str, route: str, status: int) -> None:
        """Close a request's span, and add a child span per stage."""
        from opentelemetry import trace

        span = opened.span
        span.update_name(f"{method} {route}")
        attributes = {f"lalaloc.{name}": getattr(log_fields, name) for name in _ATTRIBUTES}
        attributes |= {"http.request.method": method, "http.route": route, "http.response.status_code": status}
        span.set_attributes({name: value for name, value in attributes.items() if value is not None})
        if status >= 500:
            span.set_status(trace.StatusCode.ERROR)
        inside = trace.set_span_in_context(span)
        for name, (begun_s, duration_s) in (log_fields.clock.spans() if log_fields.clock else {}).items():
            stage = self._tracer.start_span(name, inside, start_time=opened.at_ns(begun_s))
            stage.end(opened.at_ns(begun_s + duration_s))
        span.end()

    def close(self) -> None:
        """Send the remaining spans, with a timeout."""
        self._provider.shutdown()
