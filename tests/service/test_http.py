"""Common properties of answers: problem documents, request ids, metrics, documentation, pages."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from time import monotonic

import httpx
import pytest
import yaml

from lalaloc_core.errors import ConfigError
from service.app import create_app
from service.http.http_protocol import MAX_HEAD_BYTES
from service.openapi import openapi_text
from service.runtime import Runtime, get_runtime
from service.settings import Settings
from tests.service.conftest import FLAT, StartApp, assert_problem, connection_to, localise, serve, upload, wait_for
from tests.service.postgres import PostgresServer

ROOT = Path(__file__).parents[2]
# Paths whose requests need no slot.
PROBES = {"/healthz", "/readyz", "/metrics"}


@pytest.mark.parametrize(
    ("method", "path", "faults"),
    [
        ("GET", "/floorplans?offset=2&page=1", {"offset": "known: cursor, limit, name", "page": "unknown"}),
        ("GET", "/floorplans?limit=1&limit=2", {"limit": "given more than once"}),
        pytest.param("GET", f"/floorplans?limit={'9' * 5000}", {"limit": "too many digits"}, id="digits"),
        ("POST", "/floorplans?name=x", {"name": "unknown query parameter; this route has none"}),
        ("POST", "/localise?heading_deg=100", {"heading_deg": "unknown query parameter"}),
        ("DELETE", "/floorplans/PLAN?force=1", {"force": "unknown"}),
        ("GET", "/floorplans/PLAN/preview.svg?heading_deg=20", {"heading_deg": "needs x_m and y_m"}),
        (
            "GET",
            "/floorplans/PLAN/preview.svg?covariance_m2=1&covariance_m2=0&covariance_m2=1",
            {"covariance_m2": "x_m"},
        ),
        ("GET", "/floorplans/PLAN/mesh.glb?x_m=1", {"x_m": "unknown"}),
        ("GET", "/limits?verbose=1", {"verbose": "unknown"}),
        ("GET", "/healthz?verbose=1", {"verbose": "unknown"}),
    ],
)
def test_unknown_query_parameter_is_refused(
    client: httpx.Client, method: str, path: str, faults: dict[str, str]
) -> None:
    url = path.replace("PLAN", upload(client)) if "PLAN" in path else path
    problem = assert_problem(client.request(method, url), 422, "invalid-request")
    messages = {fault["field"]: fault["message"] for fault in problem["errors"]}
    assert messages.keys() == faults.keys()
    assert all(faults[name] in messages[name] for name in faults)


def test_every_get_answers_head(client: httpx.Client) -> None:
    plan_id = upload(client)
    paths = [path for path, operations in client.get("/openapi.json").json()["paths"].items() if "get" in operations]
    assert len(paths) >= 10
    venue_id = client.post("/venues", json={"name": "12 Mill Lane"}).json()["id"]
    changing = {"x-request-id", "date", "traceparent", "content-length", "etag"}
    wait_for(lambda: client.get("/readyz").status_code == 200)
    for path in [*paths, "/", "/docs", "/web/style.css", "/openapi.json"]:
        names = {"file": "manifest.json", "answer_id": "a", "session_id": "s", "key_id": "k", "album_id": "a"}
        names["photograph_id"] = "p"
        url = path.format(floorplan_id=plan_id, venue_id=venue_id, **names)
        head = client.head(url)
        # This service keeps no answers, has no session or album of this name, and its model's errors were not measured.
        missing = any(f"{{{name}}}" in path for name in ("answer_id", "session_id", "album_id"))
        status = 404 if missing else 501 if "localisability" in path else 200
        if path.startswith("/admin"):
            # Without keys there is no administrator.
            status = 403
        assert (head.status_code, head.content) == (status, b""), url
        if not path.endswith("/events"):
            get = client.get(url)
            assert {name: head.headers[name] for name in head.headers if name not in changing} == {
                name: get.headers[name] for name in get.headers if name not in changing
            }
    assert client.head("/floorplans/none").status_code == 404
    assert client.head("/no/such/route").status_code == 404
    refused = client.head("/localise")
    assert (refused.status_code, refused.headers["allow"], refused.content) == (405, "POST", b"")
    assert client.delete("/floorplans").headers["allow"].split(", ") == ["GET", "POST", "HEAD"]


def test_head_of_events_holds_no_stream(client: httpx.Client) -> None:
    hall = {"ceiling_height_m": 3.0, "rooms": [{"polygon": [[0, 0], [60, 0], [60, 60], [0, 60]]}]}
    plan_id = upload(client, hall, wait=False)
    head = client.head(f"/floorplans/{plan_id}/events")
    assert head.headers["content-type"].startswith("text/event-stream")
    wait_for(lambda: "lalaloc_streams 0.0" in client.get("/metrics").text, 5.0)
    assert client.delete(f"/floorplans/{plan_id}").status_code == 204


PAGE = {"Origin": "https://plans.example"}
PREFLIGHT = {"Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "authorization,idempotency-key"}


def test_cors_allows_only_configured_origins(client: httpx.Client, start_app: StartApp, tmp_path: Path) -> None:
    assert "access-control-allow-origin" not in client.get("/floorplans", headers=PAGE).headers
    assert client.options("/localise", headers=PAGE | PREFLIGHT).status_code == 405
    with start_app(tmp_path, cors_origins="https://plans.example, http://localhost:3000") as named:
        for answer in (named.get("/floorplans", headers=PAGE), named.get("/floorplans/none", headers=PAGE)):
            assert answer.headers["access-control-allow-origin"] == "https://plans.example"
            assert "Origin" in answer.headers["vary"]
            assert "access-control-allow-credentials" not in answer.headers
        assert named.post("/floorplans", json=FLAT, headers=PAGE).status_code == 201
        preflight = named.options("/localise", headers=PAGE | PREFLIGHT)
        assert preflight.status_code == 200
        allowed = set(preflight.headers["access-control-allow-methods"].split(", "))
        paths = named.get("/openapi.json").json()["paths"].values()
        assert {method.upper() for operations in paths for method in operations} <= allowed
        assert "access-control-allow-credentials" not in preflight.headers
        other = {"Origin": "https://evil.example"}
        assert "access-control-allow-origin" not in named.get("/floorplans", headers=other).headers
        assert named.post("/floorplans", json=FLAT, headers=other).status_code == 403
        assert named.options("/localise", headers=other | PREFLIGHT).status_code == 400


@pytest.mark.parametrize("origins", ["plans.example", "https://plans.example/", "https://*.example", "null", "* "])
def test_useless_or_unsafe_origins_are_refused(origins: str) -> None:
    with pytest.raises(ConfigError, match=r"neither an origin such as|needs LALALOC_API_KEYS=on"):
        Settings(cors_origins=origins)
    Settings(cors_origins="*", api_keys=True)


def test_unexpected_error_reveals_only_the_request_id() -> None:
    app = create_app()

    def broken() -> Runtime:
        raise RuntimeError("secret detail")

    # The app is never started, so every route fails as after a programming error.
    app.dependency_overrides[get_runtime] = broken
    app.router.lifespan_context = lambda _app: nullcontext()
    with serve(app) as base_url:
        response = httpx.get(f"{base_url}/floorplans", headers={"x-request-id": "r-1"})
    assert response.status_code == 500
    assert response.headers["content-type"] == "application/problem+json"
    assert response.json()["request_id"] == response.headers["x-request-id"] == "r-1"
    assert response.headers["x-content-type-options"] == "nosniff"
    assert "secret" not in response.text
    assert "Traceback" not in response.text


def test_uvicorn_itself_bounds_connections(client: httpx.Client) -> None:
    # The fixture's server knows nothing of the bounds; the app sets them as it starts.
    response = client.get("/healthz", headers={"x-large": "x" * MAX_HEAD_BYTES})
    assert response.status_code == 431
    assert str(MAX_HEAD_BYTES) in response.text


@pytest.mark.parametrize(("given", "kept"), [("abc-123", True), ("a b", False), ("x" * 65, False)])
def test_valid_request_id_is_kept(client: httpx.Client, given: str, kept: bool) -> None:
    answered = client.get("/healthz", headers={"x-request-id": given}).headers["x-request-id"]
    assert (answered == given) == kept
    assert re.fullmatch(r"[A-Za-z0-9._-]{1,64}", answered)


def test_service_without_workers_is_ready_at_once(client: httpx.Client) -> None:
    assert client.get("/healthz").json() == {"status": "ok"}
    wait_for(lambda: client.get("/readyz").status_code == 200)
    response = client.get("/readyz")
    assert response.json()["ready"] is True
    assert response.json()["lpo_pool"]["workers"] == 0
    assert response.json()["decode_pool"]["workers"] == 1


@pytest.mark.slow
def test_waiting_reads_do_not_block_health(start_app: StartApp, postgres: PostgresServer, tmp_path: Path) -> None:
    url = postgres.new_database()
    with (
        # More than the framework has threads.
        start_app(tmp_path, database_url=url, max_reads=60, database_wait_s=5.0) as client,
        ThreadPoolExecutor(60) as readers,
        postgres.locked(url, "floorplans"),
    ):
        wait_for(lambda: client.get("/readyz").status_code == 200)
        for _ in range(60):
            readers.submit(client.get, "/floorplans")
        end = monotonic() + 3.0
        while monotonic() < end:
            begin = monotonic()
            assert httpx.get(f"{client.base_url}/readyz").status_code == 200
            assert monotonic() - begin < 1.5


@pytest.mark.one_replica
def test_metrics_count_requests_and_queries(client: httpx.Client, sphere: bytes) -> None:
    plan_id = upload(client)
    localise(client, plan_id, sphere, refine="vdr")
    client.get("/no/such/route")
    text = client.get("/metrics").text
    assert 'lalaloc_http_requests_total{method="GET",route="/floorplans/{floorplan_id}",status="200"}' in text
    assert 'route="unmatched",status="404"' in text
    assert 'lalaloc_localise_answers_total{stage="vdr"}' in text
    for stage in ("decode", "encode", "retrieve", "vdr", "total"):
        assert f'lalaloc_stage_seconds_count{{stage="{stage}"}}' in text
    assert plan_id not in text


def test_openapi_yaml_is_up_to_date() -> None:
    written = (ROOT / "openapi.yaml").read_bytes()
    assert yaml.load(written, yaml.CSafeLoader) == yaml.load(openapi_text(), yaml.CSafeLoader), (
        "openapi.yaml is stale: run `python -m service.openapi openapi.yaml`"
    )


def test_api_description_has_all_schemas_and_temporary_refusals(client: httpx.Client) -> None:
    response = client.get("/openapi.json")
    document, references = response.json(), set(re.findall(r'"#/components/schemas/([^"]+)"', response.text))
    assert {"FloorPlanDocument", "Problem", "LocaliseAnswer"} <= references
    assert references <= set(document["components"]["schemas"])
    for path, operations in document["paths"].items():
        for operation in operations.values():
            descriptions = {status: response["description"] for status, response in operation["responses"].items()}
            assert all(f"problem:{slug}" in descriptions.get("503", "") for slug in ("overloaded", "stopping")) == (
                path not in PROBES
            )
            assert ("504" in descriptions) == (path not in PROBES)
    assert "HTTPValidationError" not in document["components"]["schemas"]


@pytest.mark.parametrize("path", ["/", "/docs", "/web/app.js", "/web/docs.js", "/favicon.ico"])
def test_pages_load_nothing_external(client: httpx.Client, path: str) -> None:
    response = client.get(path)
    assert response.status_code == 200
    assert "default-src 'none'" in response.headers["content-security-policy"]
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg\b)|//cdn", response.text)


_EVERYWHERE = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
}


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/healthz", 200),
        ("GET", "/metrics", 200),
        ("GET", "/openapi.json", 200),
        ("GET", "/floorplans", 200),
        ("POST", "/floorplans", 415),
        ("GET", "/floorplans/none", 404),
        ("GET", "/no/such/route", 404),
        ("PUT", "/localise", 405),
        ("OPTIONS", "/readyz", 405),
    ],
)
def test_answers_have_security_headers(client: httpx.Client, method: str, path: str, status: int) -> None:
    response = client.request(method, path)
    assert response.status_code == status
    assert response.headers.items() >= _EVERYWHERE.items()
    assert response.headers["content-security-policy"] == "default-src 'none'; frame-ancestors 'none'"
    assert response.headers["cache-control"] == "no-store"
    assert "strict-transport-security" not in response.headers


@pytest.mark.parametrize("path", ["/", "/docs", "/pin?fbclid=from_a_messenger"])
def test_pages_load_own_files_and_cannot_be_framed(client: httpx.Client, path: str) -> None:
    response = client.get(path)
    assert response.headers.items() >= _EVERYWHERE.items()
    policy = dict(part.strip().split(" ", 1) for part in response.headers["content-security-policy"].split(";"))
    assert policy["frame-ancestors"] == policy["default-src"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == "'self'"
    # `blob:` is a picture that was chosen on the page itself.
    assert policy["connect-src"] == "'self' blob:"
    # Nothing is inline, so nothing inline has to be allowed.
    assert not re.search(r"<style|<script>|<script (?!src)|\son\w+=|style=", response.text)
    for link in re.findall(r'(?:src|href)="(/[^"]*)"', response.text):
        assert client.get(link).status_code == 200
    assert response.headers["cache-control"] == "no-cache"


@pytest.mark.parametrize("path", ["/floorplans", "/healthz", "/no/such"])
def test_request_with_two_lengths_is_refused_and_closed(client: httpx.Client, path: str) -> None:
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    smuggled = "GET /limits HTTP/1.1\r\nHost: localhost\r\n\r\n"
    lengths = "Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n"
    with connection_to(client) as connection:
        connection.sendall(f"{head}{lengths}{smuggled}".encode())
        answer = b"".join(iter(lambda: connection.recv(65536), b"")).decode()
    assert answer.startswith("HTTP/1.1 400 ")
    assert answer.count("HTTP/1.1 ") == 1
    assert "both Content-Length and Transfer-Encoding" in answer


@pytest.mark.parametrize(("scheme", "expected"), [("https", "max-age=31536000"), ("http", None)])
def test_https_answers_have_hsts(client: httpx.Client, scheme: str, expected: str | None) -> None:
    response = client.get("/healthz", headers={"x-forwarded-proto": scheme})
    assert response.headers.get("strict-transport-security") == expected
