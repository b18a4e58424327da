"""Tests of log lines, trace context, metrics, spans and the dashboard."""

from __future__ import annotations

import io
import json
import logging
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.trace import SpanContext

from lalaloc_core.errors import ConfigError
from lalaloc_core.localise.search.pipeline import StageClock
from service.telemetry import LOGGER_NAME, RequestLogFields
from service.telemetry.logs import JsonFormatter, TraceContext, child_of, parse_traceparent
from service.telemetry.tracing import Tracing, otlp_exporter
from tests.local_servers import QuietHandler, http_server
from tests.service.conftest import FLAT, StartApp, assert_problem, connection_to, localise, metric, upload, wait_for

ROOT = Path(__file__).parents[2]
TRACE, SPAN = "4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7"
_HEX_16 = st.text("0123456789abcdef", min_size=16, max_size=16)
APP_SETTINGS = {"log_level": "debug"}


class Log:
    """Log lines of the service since the handler was attached."""

    def __init__(self) -> None:
        self._stream = io.StringIO()
        self.handler = logging.StreamHandler(self._stream)
        self.handler.setFormatter(JsonFormatter())

    @property
    def text(self) -> str:
        return self._stream.getvalue()

    def of_request(self, request_id: str) -> list[dict[str, Any]]:
        """Return the "request" lines of a request; waits, because they follow the answer."""
        wait_for(lambda: any(line["message"] == "request" for line in self._of(request_id)), 10.0)
        return [line for line in self._of(request_id) if line["message"] == "request"]

    def all_of(self, request_id: str) -> list[dict[str, Any]]:
        """Return all lines of a request, after its end."""
        self.of_request(request_id)
        return self._of(request_id)

    def _of(self, request_id: str) -> list[dict[str, Any]]:
        lines = [json.loads(line) for line in self.text.splitlines() if line.endswith("}")]
        return [line for line in lines if line["request_id"] == request_id]


@pytest.fixture
def log() -> Iterator[Log]:
    attached = Log()
    logger = logging.getLogger(LOGGER_NAME)
    # Another test's app can have set another level for this process.
    level = logger.level
    logger.setLevel(logging.DEBUG)
    logger.addHandler(attached.handler)
    yield attached
    logger.removeHandler(attached.handler)
    logger.setLevel(level)


def test_query_has_one_log_line(client: httpx.Client, log: Log, sphere: bytes) -> None:
    plan_id = upload(client)
    response = localise(client, plan_id, sphere, refine="vdr")
    (line,) = log.of_request(response.headers["x-request-id"])
    assert line.keys() >= {"time", "level", "request_id", "trace_id", "span_id", "revision"}
    assert line["level"] == "info"
    assert (line["method"], line["route"], line["status"]) == ("POST", "/localise", 200)
    assert (line["plan"], line["stage"], line["gave_up"], line["rejection"]) == (plan_id, "vdr", False, None)
    assert line["bytes_in"] > len(sphere)
    assert set(line["stages_ms"]) == {"upload", "decode", "encode", "grid", "retrieve", "vdr"}
    assert 0.0 < sum(line["stages_ms"].values()) <= line["ms"] + 1.0
    assert line["stages_ms"]["encode"] == pytest.approx(response.json()["timings_ms"]["encode"], abs=0.1)
    (line,) = log.of_request(client.get(f"/floorplans/{plan_id}").headers["x-request-id"])
    assert (line["route"], line["plan"]) == ("/floorplans/{floorplan_id}", plan_id)
    (line,) = log.of_request(client.get("/floorplans/not-an-id").headers["x-request-id"])
    assert (line["route"], line["plan"]) == ("/floorplans/{floorplan_id}", None)


@pytest.mark.one_replica
def test_refused_request_logs_its_reason(client: httpx.Client, log: Log) -> None:
    plan_id = upload(client)
    refusals = 'lalaloc_rejections_total{reason="invalid-photograph"}'
    before = metric(client, refusals)
    response = localise(client, plan_id, b"no picture")
    assert_problem(response, 422, "invalid-photograph")
    (line,) = log.of_request(response.headers["x-request-id"])
    assert (line["status"], line["rejection"], line["plan"]) == (422, "invalid-photograph", plan_id)
    assert set(line["stages_ms"]) == {"upload", "decode"}
    assert metric(client, refusals) == before + 1.0


def test_early_refusal_logs_its_route(start_app: StartApp, tmp_path: Path, log: Log) -> None:
    with start_app(tmp_path, api_keys=True, log_level="info") as client:
        response = client.get(f"/floorplans/{'0' * 32}", headers={"authorization": "Bearer very-secret"})
        (line,) = log.of_request(response.headers["x-request-id"])
    assert (response.status_code, line["route"]) == (401, "/floorplans/{floorplan_id}")
    assert line["rejection"]
    assert "very-secret" not in log.text


@pytest.mark.one_replica
def test_disconnect_is_counted_and_logged(client: httpx.Client, log: Log) -> None:
    gone = 'lalaloc_disconnects_total{route="/floorplans"}'
    before = metric(client, gone)
    with connection_to(client) as connection:
        head = (
            "POST /floorplans HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
            "Content-Length: 1000\r\nX-Request-ID: gone-1\r\n\r\n"
        )
        connection.sendall(head.encode() + b"{" * 10)
        wait_for(lambda: metric(client, "lalaloc_requests_in_flight") == 1.0)
    (line,) = log.of_request("gone-1")
    assert line["gave_up"] is True
    assert line["bytes_in"] == 10
    assert metric(client, gone) == before + 1.0


def test_log_has_no_keys_or_queries(client: httpx.Client, log: Log, sphere: bytes) -> None:
    plan_id = upload(client)
    headers = {"Authorization": "Bearer very-secret", "Cookie": "very-secret"}
    for method, path in [
        ("GET", "/floorplans?limit=3&name=very-secret"),
        ("GET", f"/floorplans/{plan_id}/preview.svg?x_m=very-secret"),
        ("GET", "/no/such/very-secret?very-secret"),
        ("GET", "/floorplans/very-secret"),
        ("PUT", "/localise?very-secret"),
        ("POST", "/floorplans?very-secret"),
    ]:
        response = client.request(method, path, headers=headers, content=b'{"very-secret": 1}')
        assert len(log.of_request(response.headers["x-request-id"])) == 1
    assert "very-secret" not in log.text


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/metrics"])
def test_probes_are_logged_at_debug_level(client: httpx.Client, log: Log, path: str) -> None:
    client.get(path, headers={"x-request-id": "probe"})
    client.get("/limits", headers={"x-request-id": "other"})
    assert {line["level"] for line in log.of_request("probe")} == {"debug"}
    assert {line["level"] for line in log.of_request("other")} == {"info"}


def test_valid_trace_is_continued(client: httpx.Client, log: Log) -> None:
    response = client.get("/limits", headers={"traceparent": f"00-{TRACE}-{SPAN}-01"})
    version, trace_id, span_id, flags = response.headers["traceparent"].split("-")
    assert (version, trace_id, flags) == ("00", TRACE, "01")
    assert span_id != SPAN
    (line,) = log.of_request(response.headers["x-request-id"])
    assert (line["trace_id"], line["span_id"]) == (TRACE, span_id)


@pytest.mark.parametrize(
    "header",
    [
        "",
        "no trace",
        f"ff-{TRACE}-{SPAN}-01",
        f"00-{'0' * 32}-{SPAN}-01",
        f"00-{TRACE}-{'0' * 16}-01",
        f"00-{TRACE.upper()}-{SPAN}-01",
        f"00-{TRACE}-{SPAN}-01-more",
        f"00-{TRACE}-{SPAN}-1",
        f"01-{TRACE}-{SPAN}-01.more",
        f"00-{TRACE[1:]}-{SPAN}-01",
    ],
)
def test_invalid_trace_is_replaced(client: httpx.Client, header: str) -> None:
    answered = client.get("/healthz", headers={"traceparent": header}).headers["traceparent"]
    fresh = parse_traceparent([answered])
    assert fresh is not None
    assert fresh.trace_id != TRACE
    assert fresh.sampled is False


def test_repeated_and_later_traceparent_headers() -> None:
    header = f"00-{TRACE}-{SPAN}-01"
    assert parse_traceparent([header, header]) is None
    assert parse_traceparent([f"cc-{TRACE}-{SPAN}-ff-what-comes"]) == TraceContext(TRACE, SPAN, sampled=True)
    assert parse_traceparent([f"cc-{TRACE}-{SPAN}-fe"]) == TraceContext(TRACE, SPAN, sampled=False)


@given(_HEX_16, _HEX_16, _HEX_16, st.booleans())
def test_traceparent_round_trip(high: str, low: str, span: str, sampled: bool) -> None:
    written = TraceContext(high + low, span, sampled)
    zero = not int(high + low, 16) or not int(span, 16)
    assert parse_traceparent([written.header]) == (None if zero else written)
    child = child_of(written)
    assert (child.trace_id, child.sampled) == (written.trace_id, sampled)


@given(st.text(max_size=80))
def test_any_traceparent_text_is_parsed_safely(header: str) -> None:
    found = parse_traceparent([header])
    assert found is None or found.trace_id in header


def test_build_info_and_drawing_metrics(client: httpx.Client) -> None:
    model = client.get("/readyz").json()["model"]
    labels = f'model="{model["name"]}",model_version="{model["version"]}",sha256="{model["sha256"]}",version='
    text = client.get("/metrics").text
    assert re.search(rf"^lalaloc_build_info{{{labels}\"[^\"]+\"}} 1\.0$", text, re.MULTILINE)
    assert re.search(r"^process_resident_memory_bytes \d", text, re.MULTILINE)
    # Counters start at 0, so that the first event shows as an increase.
    assert 'lalaloc_rejections_total{reason="overloaded"} 0.0' in text
    assert 'lalaloc_lpo_missed_total{reason="died"} 0.0' in text


def test_metric_labels_are_bounded(client: httpx.Client) -> None:
    for attempt in range(5):
        client.get(f"/odd/{attempt}")
        client.request(f"ODD{attempt}", "/healthz")
        client.get(f"/floorplans/{attempt:032x}")
    text = client.get("/metrics").text
    assert 'method="OTHER"' in text
    assert not re.search(r"odd/|ODD\d|0{31}", text)


def test_dashboard_uses_existing_metrics(client: httpx.Client) -> None:
    dashboard = json.loads((ROOT / "docker" / "grafana" / "lalaloc.json").read_text(encoding="utf-8"))
    groups = yaml.safe_load((ROOT / "docker" / "grafana" / "alerts.yaml").read_text(encoding="utf-8"))["groups"]
    rules = [rule for group in groups for rule in group["rules"]]
    expressions = [target["expr"] for panel in dashboard["panels"] for target in panel.get("targets", [])]
    expressions += [rule["expr"] for rule in rules]
    recorded = {rule["record"] for rule in rules if "record" in rule}
    assert {name for text in expressions for name in re.findall(r"\blalaloc:[\w:]+", text)} <= recorded
    queried = {name for text in expressions for name in re.findall(r"\b(?:lalaloc|process)_\w+", text)}
    kinds = dict(re.findall(r"^# TYPE (\S+) (\S+)$", client.get("/metrics").text, re.MULTILINE))
    buckets = {f"{name}_bucket" for name, kind in kinds.items() if kind == "histogram"}
    assert {"lalaloc_stage_seconds_bucket", "lalaloc_grid_cache_bytes", "lalaloc_rejections_total"} <= queried
    assert sorted(queried - kinds.keys() - buckets) == []
    assert all(expression.count("{") == expression.count("}") for expression in expressions)


def test_stage_spans_lie_inside_the_request_span() -> None:
    exporter = InMemorySpanExporter()
    tracing = Tracing(exporter, "0")
    parent = TraceContext(TRACE, SPAN, sampled=True)
    ids, opened = tracing.begin(parent)
    assert (ids.trace_id, ids.sampled) == (TRACE, True)
    clock = StageClock()
    with clock.stage("decode"):
        pass
    with pytest.raises(RuntimeError), clock.stage("encode"):
        raise RuntimeError("fails, and is timed all the same")
    facts = RequestLogFields("r-1", ids, plan="p", rejection="overloaded", clock=clock)
    tracing.end(opened, facts, method="POST", route="/localise", status=503)
    tracing.close()
    spans = {span.name: span for span in exporter.get_finished_spans()}
    assert set(spans) == {"POST /localise", "decode", "encode"}
    request = spans["POST /localise"]
    # Exported spans are complete; the types allow None for open spans.
    attributes: Any = request.attributes
    assert attributes["lalaloc.rejection"] == "overloaded"
    assert (_id_of(request.context), _id_of(request.parent)) == (ids.span_id, SPAN)
    for name in ("decode", "encode"):
        assert _id_of(spans[name].parent) == ids.span_id
        times: Any = [request.start_time, spans[name].start_time, spans[name].end_time, request.end_time]
        # Two clocks, which can differ slightly.
        assert all(later - earlier >= -1_000_000 for earlier, later in pairwise(times))


def _id_of(context: SpanContext | None) -> str | None:
    return None if context is None else f"{context.span_id:016x}"


def test_unsampled_trace_is_not_exported() -> None:
    exporter = InMemorySpanExporter()
    tracing = Tracing(exporter, "0")
    ids, opened = tracing.begin(TraceContext(TRACE, SPAN, sampled=False))
    tracing.end(opened, RequestLogFields("r-1", ids), method="GET", route="/healthz", status=200)
    tracing.close()
    assert (ids.trace_id, ids.sampled) == (TRACE, False)
    assert exporter.get_finished_spans() == ()


@pytest.mark.slow
def test_collector_receives_the_spans_of_a_query(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    with collector() as (endpoint, received), start_app(tmp_path, otlp_endpoint=endpoint) as client:
        plan_id = upload(client, FLAT)
        answered = localise(client, plan_id, sphere, refine="vdr").headers["traceparent"].split("-")
        # Spans are sent in batches; the test does not wait for the last batch.
        wait_for(lambda: any(span.name == "POST /localise" for span in received), 20.0)
    (request,) = [span for span in received if span.name == "POST /localise"]
    assert (request.trace_id.hex(), request.span_id.hex()) == (answered[1], answered[2])
    assert answered[3] == "01"
    children = {span.name for span in received if span.parent_span_id == request.span_id}
    assert children == {"upload", "decode", "encode", "grid", "retrieve", "vdr"}


@contextmanager
def collector() -> Iterator[tuple[str, list[Any]]]:
    """Run a collector that keeps the spans it receives."""
    received: list[Any] = []

    class Handler(QuietHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            message = ExportTraceServiceRequest.FromString(body)
            received.extend(
                span for resource in message.resource_spans for scope in resource.scope_spans for span in scope.spans
            )
            self.send_response(200)
            self.send_header("content-length", "0")
            self.end_headers()

    with http_server(Handler) as url:
        yield f"{url}/v1/traces", received


def test_endpoint_without_the_extra_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry.exporter.otlp.proto.http.trace_exporter", None)
    with pytest.raises(ConfigError, match=r"LALALOC_OTLP_ENDPOINT is 'http://c/v1/traces'.*'\.\[otel\]'"):
        otlp_exporter("http://c/v1/traces")


@pytest.mark.slow
def test_sdk_is_not_loaded_without_an_endpoint() -> None:
    program = "import sys, service.app; sys.exit(any(n.startswith('opentelemetry.sdk') for n in sys.modules))"
    assert subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=False).returncode == 0
