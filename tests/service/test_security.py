"""Tests of access control: scopes of every route with keys, local requests only without keys."""

from __future__ import annotations

import asyncio
import io
import json
import logging
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from time import sleep
from typing import Any

import httpx
import pytest
import sqlalchemy
import yaml
from fastapi.routing import iter_route_contexts
from starlette.types import Receive, Scope, Send

from lalaloc_core.errors import ConfigError
from service.app import create_app
from service.errors import StoreBusyError, StoreUnavailableError, TooManyRefusedKeysError
from service.security import access_control
from service.security.access_control import RateLimits, check_address, is_local
from service.security.keys import KeyCache, PresentedKey, hash_of, key_text, new_secret, parse_authorization
from service.security.permissions import NEEDED, OPEN_PATHS, PAGES, Permission
from service.settings import Settings
from service.storage.records import ApiKey
from service.storage.store import Store
from service.telemetry import LOGGER_NAME
from service.telemetry.logs import JsonFormatter
from tests.service.conftest import (
    FLAT,
    DatabaseOf,
    StartApp,
    assert_problem,
    connection_to,
    encode_picture,
    localise,
    serve,
    upload,
    wait_for,
)
from tests.service.postgres import PostgresServer
from tests.strategies import present

ROOT = Path(__file__).parents[2]
EVERYTHING = tuple(Permission)
PLAN, VENUE = "floorplan_id", "venue_id"
_HTTP_METHODS = {"get", "put", "post", "delete", "patch", "options", "head", "trace"}


def _documented() -> list[tuple[str, str]]:
    """Return method and path of every operation in the API description except health checks."""
    # It is up to date (test_http.py); making it takes seconds.
    paths = yaml.load((ROOT / "openapi.yaml").read_bytes(), yaml.CSafeLoader)["paths"]
    return [
        (method.upper(), path)
        for path, operations in paths.items()
        for method in operations
        if method in _HTTP_METHODS and path not in OPEN_PATHS
    ]


def _served() -> set[tuple[str, str]]:
    """Return method and path of every route of the app, documented or not."""
    free = OPEN_PATHS | PAGES
    routes = [context for context in iter_route_contexts(create_app().routes) if context.path not in free]
    assert all(route.methods for route in routes), "mounted apps have no scopes"
    return {(method, str(route.path)) for route in routes for method in route.methods or ()}


OPERATIONS = _documented()
ABOUT_A_PLAN = [operation for operation in OPERATIONS if PLAN in operation[1] or operation[1] == "/localise"]


def make_key(
    store: Store, *, tenant: str = "ours", scopes: tuple[str, ...] = EVERYTHING, rate_per_minute: int | None = None
) -> str:
    """Store a key as the command line does and return its text."""
    secret = new_secret()
    key = store.keys.create(tenant, "test", hash_of(secret), scopes, rate_per_minute=rate_per_minute)
    return key_text(key.id, secret)


def bearer(key: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"}


def id_of(key: str) -> str:
    return key.split("_")[1]


def _settings(folder: Path, database_of: DatabaseOf, bundle: Path, **more: Any) -> Settings:
    url = database_of(folder)
    return Settings(data_dir=folder, database_url=url, bundle=bundle, workers=0, log_level="error", **more)


@dataclass(frozen=True)
class Guarded:
    """Running app with keys and a plan of the tenant "ours"."""

    client: httpx.Client
    store: Store
    plan_id: str
    key: str

    def send(self, method: str, path: str, key: str | None, plan_id: str | None = None) -> httpx.Response:
        """Send a request that is valid except for its key."""
        plan_id = plan_id or self.plan_id
        body: dict[str, Any] = {}
        path = path.replace("{file}", "manifest.json")
        if f"{{{VENUE}}}" in path:
            made = self.client.post("/venues", json={}, headers=bearer(self.key)).json()
            path = path.replace(f"{{{VENUE}}}", made["id"])
        picture = ("p.jpg", encode_picture(512, 256, "JPEG"), "image/jpeg")
        form = {"data": {PLAN: plan_id, "refine": "none"}, "files": {"photo": picture}}
        if "{answer_id}" in path:
            kept = self.client.post("/localise", headers=bearer(self.key), **form).json()
            path = path.replace("{answer_id}", kept["answer_id"])
        if "{session_id}" in path:
            made = self.client.post("/sessions", json={PLAN: plan_id}, headers=bearer(self.key)).json()
            path = path.replace("{session_id}", made["id"])
            body = {"files": {"photo": picture}} if method == "POST" else {}
        elif path == "/sessions":
            body = {"json": {PLAN: plan_id}}
        elif path.startswith("/admin"):
            new_key = {"tenant": "new", "name": "new", "scopes": ["read"]}
            if "{key_id}" in path:
                made = self.client.post("/admin/keys", json=new_key, headers=bearer(self.key)).json()
                path = path.replace("{key_id}", made["id"])
            path = path.replace("{tenant}", "new")
            content = {"/admin/keys": new_key, "/admin/tenants/new": {"cpu_share": 2.0}}.get(path, {})
            body = {"json": content} if method in ("POST", "PATCH") else {}
        elif path in ("/localise", "/localise/batch"):
            body = form
        elif path == "/localise/sequence":
            body = {"data": {PLAN: plan_id, "motion": "turn"}, "files": [("photo", picture)] * 2}
        elif path.startswith("/venues"):
            body = {"json": {"name": "12 Mill Lane"}}
        elif method in ("POST", "PUT"):
            body = {"json": FLAT}
        path = path.replace(f"{{{PLAN}}}", plan_id)
        return self.client.request(method, path, headers=bearer(key) if key is not None else {}, **body)


@pytest.fixture(scope="module")
def guarded(
    start_app: StartApp, database_of: DatabaseOf, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Guarded]:
    data_dir = tmp_path_factory.mktemp("data")
    rates = {"rate_per_minute": 0, "rate_burst": 0}
    with pytest.MonkeyPatch.context() as patch, ExitStack() as stack:
        patch.setattr(access_control, "REFUSED_KEYS_PER_MINUTE", 10**6)
        client = stack.enter_context(start_app(data_dir, api_keys=True, key_cache_s=0.1, keep_answers_s=600.0, **rates))
        store = Store(database_of(data_dir))
        key = make_key(store)
        client.headers.update(bearer(key))
        plan_id = upload(client)
        del client.headers["Authorization"]
        yield Guarded(client, store, plan_id, key)
        store.close()


def test_every_route_has_a_scope() -> None:
    served = {operation for operation in _served() if operation[0] != "HEAD"}
    assert served - set(NEEDED) == set(), "these routes are closed to everybody: give them a row in NEEDED"
    assert set(NEEDED) - served == set(), "these routes are gone"
    assert set(OPERATIONS) <= served
    # The framework redirects from a trailing slash, so paths are compared without it.
    assert all(path == "/" or not path.endswith("/") for _, path in NEEDED)


@pytest.mark.parametrize("scheme", [None, "malformed", "unknown", "revoked"])
def test_only_health_works_without_a_valid_key(guarded: Guarded, scheme: str | None) -> None:
    key = {None: None, "malformed": "lalaloc_x", "unknown": key_text("0" * 32, new_secret())}.get(scheme)
    if scheme == "revoked":
        key = make_key(guarded.store)
        assert guarded.store.keys.revoke(id_of(key))
    for method, path in sorted(_served() | set(OPERATIONS)):
        # The key is checked first: without this check, the request would be refused as incomplete.
        response = guarded.client.request(method, path, headers={} if key is None else bearer(key))
        assert response.status_code == 401, (method, path)
        assert response.headers["www-authenticate"] == "Bearer"
        if method != "HEAD":
            assert_problem(response, 401, "unauthenticated")


def test_key_without_the_scope_is_refused(guarded: Guarded) -> None:
    for needed in EVERYTHING:
        key = make_key(guarded.store, scopes=tuple(permission for permission in EVERYTHING if permission != needed))
        for method, path in (operation for operation in OPERATIONS if NEEDED[operation] == needed):
            response = guarded.client.request(method, path, headers=bearer(key))
            assert f"'{needed}'" in assert_problem(response, 403, "insufficient-scope")["detail"], (method, path)


@pytest.mark.parametrize(("method", "path"), OPERATIONS)
def test_key_with_only_the_scope_is_accepted(guarded: Guarded, method: str, path: str) -> None:
    plan_id = guarded.send("POST", "/floorplans", guarded.key).json()["id"]
    key = make_key(guarded.store, scopes=(NEEDED[method, path],))
    if path.startswith("/albums/") or (method, path) == ("POST", "/albums"):
        # The test's model gives no features, so that there is no album; test_albums.py reads and changes some.
        assert guarded.send(method, path, key, plan_id).status_code not in (401, 403)
    elif path.endswith("/events"):
        with guarded.client.stream(method, path.replace(f"{{{PLAN}}}", plan_id), headers=bearer(key)) as response:
            assert response.status_code == 200
    else:
        response = guarded.send(method, path, key, plan_id)
        # The errors of the test's model were not measured.
        assert response.is_success or (response.status_code == 501 and "localisability" in path)


@pytest.mark.parametrize(("method", "path"), ABOUT_A_PLAN)
def test_plan_of_another_tenant_does_not_exist(guarded: Guarded, method: str, path: str) -> None:
    theirs = make_key(guarded.store, tenant="theirs")
    never = "0123456789abcdef" * 2
    mine, unknown = guarded.send(method, path, theirs), guarded.send(method, path, theirs, never)
    problem = assert_problem(mine, 404, "unknown-floorplan")
    expected = assert_problem(unknown, 404, "unknown-floorplan")
    assert problem["detail"].replace(guarded.plan_id, never) == expected["detail"]
    # The owner still reads it.
    assert guarded.send("GET", f"/floorplans/{{{PLAN}}}", guarded.key).json()["name"] == FLAT["name"]


def test_lists_have_only_plans_of_the_tenant(guarded: Guarded) -> None:
    theirs = make_key(guarded.store, tenant="others")
    assert guarded.send("GET", "/floorplans", theirs).json()["floorplans"] == []
    own = guarded.send("POST", "/floorplans", theirs).json()["id"]
    assert [plan["id"] for plan in guarded.send("GET", "/floorplans", theirs).json()["floorplans"]] == [own]
    listed = guarded.send("GET", "/floorplans", guarded.key).json()["floorplans"]
    assert guarded.plan_id in [plan["id"] for plan in listed]
    assert own not in [plan["id"] for plan in listed]


@pytest.mark.parametrize("path", sorted(OPEN_PATHS))
@pytest.mark.parametrize("key", [None, "nonsense"])
def test_health_needs_no_key(guarded: Guarded, path: str, key: str | None) -> None:
    wait_for(lambda: guarded.send("GET", path, key).status_code == 200)


@pytest.mark.parametrize("path", ["/", "/docs", "/web/app.js", "/web/style.css", "/favicon.ico"])
def test_pages_need_no_key(guarded: Guarded, path: str) -> None:
    assert guarded.send("GET", path, None).status_code == 200
    assert guarded.client.head(path).status_code == 200
    assert guarded.send("GET", path, guarded.key).status_code == 200
    assert guarded.send("GET", path, "lalaloc_wrong").status_code == 401
    for method in ("POST", "PUT", "DELETE", "PATCH"):
        assert guarded.send(method, path, None).status_code == 401


@pytest.mark.parametrize("path", ["/web/", "/web/../app.py", "/web/%2e%2e/app.py", "/web/none.js", "/web/a/b.js"])
def test_other_files_need_a_key(guarded: Guarded, path: str) -> None:
    assert guarded.send("GET", path, None).status_code in (401, 404)


def test_unknown_paths_are_revealed_only_with_a_key(guarded: Guarded) -> None:
    assert_problem(guarded.send("GET", "/no/such/route", guarded.key), 404, "not-found")
    refused = guarded.send("PATCH", "/localise", guarded.key)
    assert_problem(refused, 405, "method-not-allowed")
    assert refused.headers["allow"] == "POST"
    for request in ("GET /no/such/route", "PATCH /localise", "GET /healthz/", "GET /healthz//"):
        method, path = request.split()
        assert guarded.send(method, path, None).status_code == 401
    # A trailing slash does not change the scope.
    writer = make_key(guarded.store, scopes=("write",))
    assert guarded.send("GET", "/floorplans/", writer).status_code == 403
    assert guarded.send("GET", "/floorplans/", guarded.key).headers["location"] == "/floorplans"


def test_redirect_names_no_host(client: httpx.Client) -> None:
    redirect = client.get("/floorplans/?name=x", headers={"host": "127.0.0.1:99"}, follow_redirects=False)
    assert redirect.status_code == 307
    assert redirect.headers["location"] == "/floorplans?name=x"


def test_route_without_a_scope_is_closed(tiny_bundle: Path, database_of: DatabaseOf, tmp_path: Path) -> None:
    app = create_app(_settings(tmp_path, database_of, tiny_bundle, api_keys=True))
    app.get("/later")(lambda: "forgotten")
    with serve(app) as base_url:
        store = Store(database_of(tmp_path))
        assert_problem(httpx.get(f"{base_url}/later", headers=bearer(make_key(store))), 404, "not-found")
        store.close()


def test_invalid_keys_get_the_same_message(guarded: Guarded) -> None:
    revoked = make_key(guarded.store)
    guarded.store.keys.revoke(id_of(revoked))
    keys = {
        "revoked": revoked,
        "unknown id": key_text("f" * 32, new_secret()),
        "wrong secret": key_text(id_of(guarded.key), new_secret()),
        "the secret of another": key_text("f" * 32, guarded.key.split("_", 2)[2]),
    }
    assert len({guarded.send("GET", "/limits", key).json()["detail"] for key in keys.values()}) == 1


def test_only_one_whole_authorization_header_counts() -> None:
    key_id, secret = "0123456789abcdef" * 2, new_secret()
    key = key_text(key_id, secret)
    for value in (f"Bearer {key}", f"bearer  {key}"):
        assert parse_authorization([value]) == PresentedKey(key_id, hash_of(secret)), value
    for value in (key, f"Basic {key}", f"Bearer {key}x", f"Bearer {key} {key}", "Bearer", ""):
        assert parse_authorization([value]) is None, value
    assert parse_authorization([]) is parse_authorization(2 * [f"Bearer {key}"]) is None


def test_secrets_are_random_256_bits() -> None:
    secrets = {new_secret() for _ in range(1000)}
    assert len(secrets) == 1000
    assert {len(secret) for secret in secrets} == {43}


def test_last_use_is_written_once_a_minute(guarded: Guarded) -> None:
    key = make_key(guarded.store)

    def last_used() -> object:
        return next(row.last_used_at for row in guarded.store.keys.list_keys() if row.id == id_of(key))

    assert last_used() is None
    assert guarded.send("GET", "/limits", key).status_code == 200
    wait_for(lambda: last_used() is not None)
    first = last_used()
    for _ in range(3):
        sleep(0.15)
        guarded.send("GET", "/limits", key)
    assert last_used() == first


def test_refused_request_is_answered_before_its_body(guarded: Guarded) -> None:
    head = "POST /floorplans HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 1000000\r\n\r\n"
    with connection_to(guarded.client) as raw:
        raw.sendall(head.encode())
        assert raw.recv(4096).startswith(b"HTTP/1.1 401 ")


def test_log_names_key_and_tenant_without_secret(start_app: StartApp, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'own.sqlite3'}"
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonFormatter())
    with start_app(tmp_path, api_keys=True, database_url=url, log_level="debug") as client:
        store = Store(url)
        key = make_key(store, tenant="acme", scopes=("read",))
        logging.getLogger(LOGGER_NAME).addHandler(handler)
        try:
            for method, path in (("GET", "/limits"), ("POST", "/floorplans"), ("GET", "/no/such/route")):
                client.request(method, path, headers=bearer(key))
            client.get("/limits", headers={"Authorization": key})
            wait_for(lambda: stream.getvalue().count('"message": "request"') == 4, 10.0)
        finally:
            logging.getLogger(LOGGER_NAME).removeHandler(handler)
            store.close()
    lines = stream.getvalue()
    assert lines.count(f'"key": "{id_of(key)}", "tenant": "acme"') == 3
    assert key.split("_", 2)[2] not in lines


def test_broken_store_reveals_no_stack_trace(start_app: StartApp, tmp_path: Path) -> None:
    database = tmp_path / "own.sqlite3"
    with start_app(tmp_path, database_url=f"sqlite:///{database}", log_level="error") as client:
        plan_id = upload(client)
        engine = sqlalchemy.create_engine(f"sqlite:///{database}")
        with engine.begin() as connection:
            connection.exec_driver_sql("UPDATE floorplans SET created_at = 'very-secret-detail'")
        engine.dispose()
        for path in ("/floorplans", f"/floorplans/{plan_id}", f"/floorplans/{plan_id}/mesh.glb"):
            response = client.get(path)
            problem = assert_problem(response, 500, "internal")
            assert problem.keys() == {"type", "title", "status", "detail", "request_id"}
            assert not re.search(r"secret|sqlalchemy|\.py|line \d", response.text)


def test_api_description_states_scopes_and_refusals() -> None:
    document = create_app().openapi()
    (scheme,) = document["components"]["securitySchemes"]
    assert document["components"]["securitySchemes"][scheme]["scheme"] == "bearer"
    for method, path in OPERATIONS:
        operation = document["paths"][path][method.lower()]
        assert operation["security"] == [{scheme: [NEEDED[method, path]]}]
        assert {"401", "403", "429", "503"} <= operation["responses"].keys()
    for path in OPEN_PATHS:
        assert "security" not in document["paths"][path]["get"]


# --- Rates ------------------------------------------------------------------------------------------------------------


@pytest.mark.one_replica
def test_rate_limit_states_when_to_retry(start_app: StartApp, app_store: Store, tmp_path: Path) -> None:
    with start_app(tmp_path, api_keys=True, rate_per_minute=5, rate_burst=0) as client:
        usual, unlimited = make_key(app_store), make_key(app_store, rate_per_minute=0)
        more = make_key(app_store, rate_per_minute=9)

        def accepted(key: str) -> int:
            answers = [client.get("/limits", headers=bearer(key)) for _ in range(20)]
            for refused in (answer for answer in answers if answer.status_code != 200):
                assert_problem(refused, 429, "rate-limited")
                assert 1 <= int(refused.headers["retry-after"]) <= 60
            return sum(answer.status_code == 200 for answer in answers)

        # A minute that ends during the test allows one request more.
        assert 5 <= accepted(usual) <= 6
        assert 9 <= accepted(more) <= 10
        assert accepted(unlimited) == 20
        metrics = client.get("/metrics", headers=bearer(unlimited)).text
        assert re.search(r'lalaloc_rejections_total\{reason="rate-limited"\} (2[4-6])\.0', metrics)


@pytest.mark.one_replica
def test_bytes_of_reads_count_as_requests(start_app: StartApp, app_store: Store, tmp_path: Path) -> None:
    with start_app(tmp_path, api_keys=True, rate_per_minute=40, rate_burst=0) as client:
        key = make_key(app_store)
        client.headers.update(bearer(key))
        content = json.dumps(FLAT).encode() + b" " * 5 * access_control.BYTES_PER_REQUEST
        headers = {"Content-Type": "application/json"}
        url = client.post("/floorplans", content=content, headers=headers).headers["location"]
        # Six requests each, after one upload. A minute that ends during the test allows some more.
        statuses = [client.get(f"{url}/original").status_code for _ in range(15)]
        assert 6 <= statuses.count(200) < 15
        assert set(statuses) == {200, 429}


def test_burst_is_limited(start_app: StartApp, app_store: Store, tmp_path: Path) -> None:
    with start_app(tmp_path, api_keys=True, rate_per_minute=0, rate_burst=2) as client:
        key = make_key(app_store)
        answers = [client.get("/limits", headers=bearer(key)) for _ in range(15)]
        refused = [answer for answer in answers if answer.status_code == 429]
        assert refused
        assert {answer.headers["retry-after"] for answer in refused} == {"1"}
        wait_for(lambda: client.get("/limits", headers=bearer(key)).status_code == 200, 5.0)


@pytest.mark.one_replica
@pytest.mark.parametrize("kind", ["unknown", "malformed"])
def test_many_invalid_keys_do_not_block_valid_ones(
    start_app: StartApp, app_store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr(access_control, "REFUSED_KEYS_PER_MINUTE", 5)
    with start_app(tmp_path, api_keys=True, key_cache_s=0.0) as client:
        key = make_key(app_store)
        assert client.get("/limits", headers=bearer(key)).status_code == 200
        statuses = []
        for _ in range(12):
            invalid = key_text("a" * 32, new_secret()) if kind == "unknown" else "nonsense"
            response = client.get("/limits", headers=bearer(invalid))
            statuses.append(response.status_code)
        assert statuses == sorted(statuses)
        assert 5 <= statuses.count(401) <= 6
        assert_problem(response, 429, "too-many-refused-keys")
        assert 1 <= int(response.headers["retry-after"]) <= 60
        assert client.get("/limits", headers=bearer(key)).status_code == 200
        # Nor one that the service has not seen before.
        assert client.get("/limits", headers=bearer(make_key(app_store))).status_code == 200


def test_address_counters_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access_control, "REFUSED_KEYS_PER_MINUTE", 1)

    async def count() -> int:
        rates = RateLimits(Settings())
        await rates.count_refused("2001:db8:1:2::1")
        with pytest.raises(TooManyRefusedKeysError):
            await rates.count_refused("2001:db8:1:2:ffff::2")
        for number in range(5000):
            try:
                await rates.count_refused(f"10.0.{number // 256}.{number % 256}")
            except TooManyRefusedKeysError:
                continue
        return len(rates._limiter.storage.storage)  # pyright: ignore[reportAttributeAccessIssue]

    # Two windows per counter: the current minute and the one before.
    assert asyncio.run(count()) <= 2 * 1024


# --- Without the database ---------------------------------------------------------------------------------------------


@pytest.mark.one_replica
def test_known_keys_work_without_the_database(
    start_app: StartApp, postgres: PostgresServer, tmp_path: Path, sphere: bytes
) -> None:
    url = postgres.new_database()
    with start_app(tmp_path, api_keys=True, database_url=url, key_cache_s=0.1) as client:
        store = Store(url)
        key, new_key = make_key(store), make_key(store)
        client.headers.update(bearer(key))
        plan_id = upload(client)
        assert localise(client, plan_id, sphere, refine="none").status_code == 200
        store.close()
        postgres.stop()
        try:
            sleep(0.2)
            assert localise(client, plan_id, sphere, refine="none").status_code == 200
            assert client.get("/limits").status_code == 200
            for refused in (client.get(f"/floorplans/{plan_id}"), client.get("/limits", headers=bearer(new_key))):
                assert_problem(refused, 503, "store-unavailable")
                assert int(refused.headers["retry-after"]) > 0
        finally:
            postgres.start()
        wait_for(lambda: client.get("/limits", headers=bearer(new_key)).status_code == 200, 10.0)


@dataclass
class CachedKey:
    """Key in a cache, on a store with a single connection; `clock_s` is the clock of the cache."""

    store: Store
    key_id: str
    find: Callable[[], ApiKey | None]
    clock_s: float = 1000.0


@pytest.fixture
def cached(tmp_path: Path) -> Iterator[CachedKey]:
    store = Store(f"sqlite:///{tmp_path / 'keys.sqlite3'}", connections=1, wait_s=0.05)
    cache = KeyCache(store.keys, fresh_s=5.0, clock=lambda: cached.clock_s)
    text = make_key(store)
    presented = present(parse_authorization([f"Bearer {text}"]))
    cached = CachedKey(store, id_of(text), lambda: asyncio.run(cache.find(presented)))
    try:
        assert cached.find() is not None
        wait_for(lambda: store.keys.list_keys()[0].last_used_at is not None)
        yield cached
    finally:
        cache.close()
        store.close()


def test_key_is_cached_ten_minutes_without_database(cached: CachedKey) -> None:
    # The only connection is in use.
    with cached.store.database.reading():
        for cached.clock_s in (1004.0, 1006.0, 1300.0, 1600.0):
            assert present(cached.find()).id == cached.key_id
        cached.clock_s = 1606.0
        with pytest.raises(StoreUnavailableError):
            cached.find()
    cached.clock_s = 1608.0
    cached.store.keys.revoke(cached.key_id)
    assert cached.find() is None


def test_busy_database_does_not_extend_the_key_cache(cached: CachedKey) -> None:
    with cached.store.database.reading():
        # Other queries succeed in the meantime.
        cached.store.database._answered_s = float("inf")
        cached.clock_s = 1006.0
        with pytest.raises(StoreBusyError):
            cached.find()
    # A busy database is queried again at the next request.
    assert present(cached.find()).id == cached.key_id


# --- Without keys -----------------------------------------------------------------------------------------------------


def test_loopback_and_unix_sockets_are_local() -> None:
    loopback = [(host, 8000) for host in ("127.0.0.1", "127.8.9.10", "::1", "::ffff:127.0.0.1")]
    for server in (*loopback, ("/run/lalaloc.sock", None), None):
        assert is_local(server), server
    for host in ("0.0.0.0", "::", "192.168.1.7", "fe80::1%eth0", "::ffff:10.0.0.1", "", "example.org"):
        assert not is_local((host, 8000)), host


@pytest.mark.parametrize(
    ("options", "status"),
    [
        ({}, 403),
        ({"published_on": "0.0.0.0:8000"}, 403),
        ({"published_on": "127.0.0.1:8000"}, 200),
        ({"allow_anonymous": True}, 200),
    ],
)
def test_remote_requests_without_keys_are_refused(
    tiny_bundle: Path, database_of: DatabaseOf, tmp_path: Path, options: dict[str, Any], status: int
) -> None:
    app = create_app(_settings(tmp_path, database_of, tiny_bundle, **options))

    async def from_network(scope: Scope, receive: Receive, send: Send) -> None:
        # Pretend that the connection came over the network.
        await app({**scope, "server": ("192.0.2.1", 8000)} if scope["type"] == "http" else scope, receive, send)

    with serve(from_network) as base_url, httpx.Client(base_url=base_url) as client:  # pyright: ignore[reportArgumentType]
        assert client.get("/healthz").status_code == 200
        wait_for(lambda: client.get("/readyz").status_code == 200)
        for path in ("/", "/docs", "/openapi.json", "/metrics", "/limits", "/floorplans"):
            response = client.get(path)
            assert response.status_code == status
            if status == 403:
                assert_problem(response, 403, "exposed-without-keys")
        assert client.post("/floorplans", json=FLAT).status_code == (201 if status == 200 else 403)


@pytest.mark.parametrize(
    ("method", "headers", "status"),
    [
        ("GET", {}, 200),
        ("GET", {"Host": "localhost:8000"}, 200),
        ("GET", {"Host": "127.8.0.1"}, 200),
        ("GET", {"Host": "[::1]:8000"}, 200),
        ("GET", {"Host": "evil.example"}, 403),
        ("GET", {"Host": "localhost.evil.example:8000"}, 403),
        ("GET", {"Host": "192.168.1.7"}, 403),
        ("GET", {"Host": "[::1"}, 403),
        ("GET", {"Host": ""}, 403),
        ("GET", {"Origin": "https://evil.example"}, 200),
        ("POST", {"Origin": "http://localhost:3000"}, 201),
        ("POST", {"Origin": "https://evil.example"}, 403),
        ("POST", {"Origin": "null"}, 403),
        ("POST", {"Host": "evil.example"}, 403),
    ],
)
def test_foreign_pages_without_keys_are_refused(
    client: httpx.Client, method: str, headers: dict[str, str], status: int
) -> None:
    response = client.request(method, "/floorplans", headers=headers, json=FLAT if method == "POST" else None)
    assert response.status_code == status
    if status == 403:
        assert_problem(response, 403, "exposed-without-keys")


@pytest.mark.parametrize(
    ("settings", "status"),
    [
        ({"allowed_hosts": "other.example, Plans.Example"}, 201),
        ({"allowed_hosts": "*"}, 201),
        ({"allowed_hosts": "other.example"}, 403),
        # Addresses and host names are separate checks.
        ({"allow_anonymous": True}, 403),
    ],
)
def test_allowed_hosts_and_pages_are_accepted(
    start_app: StartApp, tmp_path: Path, settings: dict[str, Any], status: int
) -> None:
    with start_app(tmp_path, **settings) as client:
        headers = {"Host": "plans.example:8000", "Origin": "https://plans.example"}
        assert client.post("/floorplans", json=FLAT, headers=headers).status_code == status


@pytest.mark.parametrize("name", ["plans.example:8443", "https://plans.example", "*.example", "[2001:db8::1]", "a b"])
def test_impossible_allowed_host_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="neither a bare name or address nor"):
        Settings(allowed_hosts=f"localhost,{name}")
    Settings(allowed_hosts="plans.example, 192.0.2.7,2001:db8::1,*")


@pytest.mark.parametrize(
    ("host", "settings", "refused"),
    [
        ("127.0.0.1", {}, False),
        ("::1", {}, False),
        ("0.0.0.0", {}, True),
        ("::", {}, True),
        ("10.1.2.3", {}, True),
        ("0.0.0.0", {"api_keys": True}, False),
        ("0.0.0.0", {"allow_anonymous": True}, False),
        # A container listens on all of its addresses; the published address counts.
        ("0.0.0.0", {"published_on": "127.0.0.1:8000"}, False),
        ("0.0.0.0", {"published_on": "[::1]:8000"}, False),
        ("0.0.0.0", {"published_on": "0.0.0.0:8000"}, True),
        ("0.0.0.0", {"published_on": "8000"}, True),
        ("0.0.0.0", {"published_on": "192.0.2.1:80"}, True),
        ("0.0.0.0", {"published_on": "0.0.0.0:8000", "api_keys": True}, False),
        ("0.0.0.0", {"published_on": "0.0.0.0:8000", "allow_anonymous": True}, False),
    ],
)
def test_public_address_without_keys_is_refused(host: str, settings: dict[str, Any], refused: bool) -> None:
    if not refused:
        check_address(host, Settings(**settings))
        return
    with pytest.raises(ConfigError, match=r"without API keys.*LALALOC_API_KEYS.*LALALOC_ALLOW_ANONYMOUS"):
        check_address(host, Settings(**settings))


def test_service_does_not_start_publicly_without_keys(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "service", "--host", "0.0.0.0", "--port", "0"],
        env={"LALALOC_DATA_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode != 0
    assert done.stdout == ""
    assert "refusing to listen on 0.0.0.0 without API keys" in done.stderr
    assert "Traceback" not in done.stderr
