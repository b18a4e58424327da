"""Administration over HTTP, and the audit log: keys, limits of tenants, entries of changes and refusals."""

from __future__ import annotations

import asyncio
import json
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import AsyncMock, Mock

import httpx
import pytest
from sqlalchemy import update
from sqlalchemy.exc import DBAPIError

from service.cli.entry_point import main
from service.http.middleware import AuthorisationMiddleware
from service.security import AccessControl
from service.security.audit import VARIOUS, AuditTrail
from service.settings import Settings
from service.storage.records import ANONYMOUS, AuditEntry
from service.storage.store import Store
from service.storage.tables import API_KEYS, AUDIT_LOG
from tests.service.conftest import StartApp, assert_problem, document_of, pages, upload, wait_for
from tests.service.test_security import bearer, id_of, make_key

NEW_KEY = {"tenant": "acme", "name": "camera 7", "scopes": ["read", "localise"]}
DAY_S = 86400.0


@pytest.fixture
def store(configured_url: str) -> Iterator[Store]:
    with closing(Store(configured_url, audit_keep_s=DAY_S, max_audit_entries=20)) as opened:
        yield opened


@pytest.fixture
def admin(start_app: StartApp, app_store: Store, tmp_path: Path) -> Iterator[httpx.Client]:
    """Yield a client with a key that has all scopes."""
    with start_app(tmp_path, api_keys=True, key_cache_s=0.0, rate_burst=0) as client:
        client.headers.update(bearer(make_key(app_store, tenant="ours")))
        yield client


def _created(client: httpx.Client, **changes: Any) -> dict[str, Any]:
    answer = client.post("/admin/keys", json=NEW_KEY | changes)
    assert answer.headers["cache-control"] == "no-store"
    return document_of(answer, 201)


def _entries(client: httpx.Client, **query: str) -> list[dict[str, Any]]:
    return document_of(client.get("/admin/audit", params=query))["entries"]


def _entry(actor: str = "a", **values: Any) -> AuditEntry:
    entry: dict[str, Any] = {"actor": actor, "tenant": "t", "action": "GET /x", "resource": "/x"} | values
    return AuditEntry(**entry)


# --- Keys -------------------------------------------------------------------------------------------------------------


def test_key_is_created_listed_and_revoked(admin: httpx.Client) -> None:
    made = _created(admin, rate_per_minute=30)
    key = bearer(made.pop("key"))
    assert admin.get("/limits", headers=key).status_code == 200
    assert_problem(admin.get("/metrics", headers=key), 403, "insufficient-scope")
    assert_problem(admin.get("/admin/keys", headers=key), 403, "insufficient-scope")
    wait_for(lambda: admin.get(f"/admin/keys/{made['id']}").json()["last_used_at"] is not None)
    shown = admin.get(f"/admin/keys/{made['id']}").json()
    assert shown == made | {"last_used_at": shown["last_used_at"]}
    listed = admin.get("/admin/keys", params={"tenant": "acme"}).json()
    assert listed == {"keys": [shown], "next_cursor": None}
    assert admin.delete(f"/admin/keys/{made['id']}").status_code == 204
    assert_problem(admin.get("/limits", headers=key), 401, "unauthenticated")
    assert_problem(admin.delete(f"/admin/keys/{made['id']}"), 404, "unknown-key")


def test_pages_list_every_key_once(admin: httpx.Client) -> None:
    made = [_created(admin)["id"] for _ in range(5)]
    found = [key["id"] for page in pages(admin, "/admin/keys", limit=2, tenant="acme") for key in page["keys"]]
    assert found == made[::-1]


def test_both_keys_are_valid_during_the_overlap(admin: httpx.Client, app_store: Store, tmp_path: Path) -> None:
    old = _created(admin, expires_in_s=1000)
    new = document_of(admin.post(f"/admin/keys/{old['id']}/rotation", json={"overlap_s": 600}), 201)
    assert new["replaces"] == old["id"]
    assert {name: new[name] for name in NEW_KEY} == NEW_KEY | {"scopes": ["localise", "read"]}

    def lifetime_s(key: dict[str, Any]) -> float:
        shown = admin.get(f"/admin/keys/{key['id']}").json()
        end, begin = (datetime.fromisoformat(shown[name]) for name in ("expires_at", "created_at"))
        return (end - begin).total_seconds()

    assert lifetime_s(new) == 1000
    assert 600 <= lifetime_s(old) < 1000
    for key in (old, new):
        assert admin.get("/limits", headers=bearer(key["key"])).status_code == 200
    # The next successor has the lifetime again, not what was left of it, and the overlap does not extend an end.
    after = admin.post(f"/admin/keys/{old['id']}/rotation", json={"overlap_s": 90 * 86400}).json()
    assert lifetime_s(after) == 1000
    assert lifetime_s(old) < 1000
    with app_store.database.writing() as connection:
        past = datetime.now(UTC) - timedelta(seconds=1)
        connection.execute(update(API_KEYS).where(API_KEYS.c.id == old["id"]).values(expires_at=past))
    problem = assert_problem(admin.get("/limits", headers=bearer(old["key"])), 401, "unauthenticated")
    assert "expired at" in problem["detail"]
    # Another secret with the same id reveals nothing.
    guessed = f"lalaloc_{old['id']}_{'x' * 43}"
    assert "expired" not in admin.get("/limits", headers=bearer(guessed)).json()["detail"].replace("revoked", "")
    assert admin.get("/limits", headers=bearer(new["key"])).status_code == 200
    assert_problem(admin.post(f"/admin/keys/{old['id']}/rotation", json={}), 404, "unknown-key")


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"tenant": "../x"}, "tenant"),
        ({"tenant": "acme\n"}, "tenant"),
        ({"name": " "}, "name"),
        ({"scopes": []}, "scopes"),
        ({"scopes": ["root"]}, "scopes.0"),
        ({"rate_per_minute": -1}, "rate_per_minute"),
        ({"expires_in_s": 0}, "expires_in_s"),
        ({"expires_in_s": 10**12}, "expires_in_s"),
        ({"key": "mine"}, "key"),
    ],
)
def test_invalid_key_is_refused(admin: httpx.Client, changes: dict[str, Any], field: str) -> None:
    problem = assert_problem(admin.post("/admin/keys", json=NEW_KEY | changes), 422, "invalid-request")
    assert problem["errors"][0]["field"] == field


def test_keys_are_not_administered_while_keys_are_off(client: httpx.Client) -> None:
    for method, path in (("GET", "/admin/keys"), ("POST", "/admin/keys"), ("GET", "/admin/audit")):
        problem = assert_problem(client.request(method, path), 403, "insufficient-scope")
        assert "set LALALOC_API_KEYS=on" in problem["detail"]


def test_expired_key_on_the_command_line(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["keys", "create", "--tenant", "t", "--name", "n", "--scope", "admin", "--expires-in", "90d"]) == 0
    old = id_of(capsys.readouterr().out)
    assert main(["keys", "rotate", old, "--overlap", "12h"]) == 0
    new = id_of(capsys.readouterr().out.strip())
    ends = {key.id: (key.expires_at or key.created_at) - key.created_at for key in store.keys.list_keys()}
    assert ends[new] == timedelta(days=90)
    assert timedelta(hours=12) <= ends[old] < timedelta(hours=13)
    assert main(["keys", "revoke", new]) == 0
    assert main(["keys", "rotate", new]) == 1
    assert "no valid key" in capsys.readouterr().err
    assert main(["audit", "export", "--tenant", "t"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    changes = [(line["action"], line["resource"]) for line in lines]
    assert changes == [("keys create", old), ("keys rotate", old), ("keys revoke", new)]
    assert lines[1]["detail"]["successor"] == new
    assert all(line["actor"].startswith("cli:") for line in lines)


# --- Limits of tenants ------------------------------------------------------------------------------------------------


def test_limits_of_tenants_are_set(admin: httpx.Client) -> None:
    upload(admin)
    assert admin.patch("/admin/tenants/acme", json={"stored_bytes": 1000, "cpu_share": 0.5}).json() == {
        "tenant": "acme", "used_bytes": 0, "stored_bytes": 1000, "bytes_in_flight": None, "cpu_share": 0.5
    }  # fmt: skip
    reset = admin.patch("/admin/tenants/acme", json={"cpu_share": None}).json()
    assert (reset["stored_bytes"], reset["cpu_share"]) == (1000, None)
    first = admin.get("/admin/tenants", params={"limit": 1}).json()
    assert [tenant["tenant"] for tenant in first["tenants"]] == ["acme"]
    rest = admin.get("/admin/tenants", params={"cursor": first["next_cursor"]}).json()
    assert [(tenant["tenant"], tenant["used_bytes"] > 0) for tenant in rest["tenants"]] == [("ours", True)]
    assert rest["next_cursor"] is None
    for path, body in (("acme", {}), ("acme", {"cpu_share": 0}), ("a%20b", {"cpu_share": 1.0}), ("acme", [])):
        assert_problem(admin.patch(f"/admin/tenants/{path}", json=body), 422, "invalid-request")
    limits = [entry for entry in _entries(admin, tenant="acme") if entry["result"] == "done"]
    assert [entry["detail"] for entry in limits] == [{"cpu_share": None}, {"stored_bytes": 1000, "cpu_share": 0.5}]


# --- Audit log --------------------------------------------------------------------------------------------------------


@pytest.mark.one_replica
def test_changes_and_refusals_have_entries(admin: httpx.Client) -> None:
    plan_id = upload(admin)
    made = _created(admin)
    reader = bearer(made["key"])
    for _ in range(3):
        assert_problem(admin.delete(f"/floorplans/{plan_id}", headers=reader), 403, "insufficient-scope")
    assert_problem(admin.get("/limits", headers=bearer("lalaloc_wrong")), 401, "unauthenticated")
    assert admin.get("/limits", headers={"Authorization": ""}).status_code == 401
    assert admin.head(f"/floorplans/{plan_id}").status_code == 200
    assert admin.delete(f"/floorplans/{plan_id}", headers={"X-Request-ID": "mine"}).status_code == 204
    assert_problem(admin.delete(f"/floorplans/{plan_id}"), 404, "unknown-floorplan")
    own = id_of(admin.headers["Authorization"])
    plan = f"/floorplans/{plan_id}"
    entries = _entries(admin)
    found = [
        (entry["actor"], entry["tenant"], entry["action"], entry["resource"], entry["status"], entry["result"])
        for entry in entries
    ]
    # The entries outlive the plan. Those of changes are written at once, the counted ones keep their time.
    assert sorted(found) == sorted(
        [
            (own, "ours", "POST /floorplans", plan, 201, "done"),
            (own, "acme", "POST /admin/keys", f"/admin/keys/{made['id']}", 201, "done"),
            (made["id"], "acme", "DELETE /floorplans/{floorplan_id}", plan, 403, "insufficient-scope"),
            (ANONYMOUS, "", "GET /limits", "/limits", 401, "unauthenticated"),
            (own, "ours", "DELETE /floorplans/{floorplan_id}", plan, 204, "done"),
            (own, "ours", "DELETE /floorplans/{floorplan_id}", plan, 404, "unknown-floorplan"),
        ]
    )
    times = [entry["created_at"] for entry in entries]
    assert times == sorted(times, reverse=True)
    counts = {entry["result"]: entry["count"] for entry in entries}
    assert (counts["insufficient-scope"], counts["unauthenticated"], counts["done"]) == (3, 2, 1)
    assert {entry["address"] for entry in entries} == {"127.0.0.1"}
    assert "mine" in {entry["request_id"] for entry in entries}
    created = next(entry for entry in entries if entry["action"] == "POST /admin/keys")
    assert created["detail"]["scopes"] == ["localise", "read"]
    assert made["key"].split("_", 2)[2] not in json.dumps(entries)
    # Reading the log is in it, too.
    (read,) = (entry for entry in _entries(admin) if entry["action"] == "GET /admin/audit")
    assert (read["actor"], read["count"]) == (own, 1)


@pytest.mark.one_replica
def test_log_is_read_in_pages_and_filtered(admin: httpx.Client) -> None:
    for number in range(5):
        admin.patch(f"/admin/tenants/t{number}", json={"cpu_share": 1.0})
    own = id_of(admin.headers["Authorization"])
    begin = datetime.now(UTC)
    query = {"limit": "2", "actor": own, "until": begin.isoformat()}
    found = [entry["tenant"] for page in pages(admin, "/admin/audit", **query) for entry in page["entries"]]
    assert found == ["t4", "t3", "t2", "t1", "t0"]
    assert [entry["tenant"] for entry in _entries(admin, tenant="t3")] == ["t3"]
    assert _entries(admin, actor="nobody") == []
    assert {entry["action"] for entry in _entries(admin, since=begin.isoformat())} == {"GET /admin/audit"}
    for query in ({"since": "yesterday"}, {"since": "2026-01-01T00:00:00"}, {"until": "0001-01-01T00:00:00Z"}):
        assert_problem(admin.get("/admin/audit", params=query), 422, "invalid-request")
    for query in ({"actor": "a\n"}, {"limit": "501"}, {"cursor": "x"}, {"tenant": "a b"}):
        assert_problem(admin.get("/admin/audit", params=query), 422, "invalid-request")


@pytest.mark.one_replica
def test_every_refusal_says_what_to_do_and_has_an_entry(start_app: StartApp, app_store: Store, tmp_path: Path) -> None:
    with start_app(tmp_path, api_keys=True, key_cache_s=0.0, rate_burst=0, require_features=True) as client:
        client.headers["Authorization"] = bearer(make_key(app_store))["Authorization"]
        plan = {"floorplan_id": upload(client)}
        keys = {name: _created(client, **changes) for name, changes in (
            ("reader", {"scopes": ["read"]}), ("slow", {"rate_per_minute": 1}), ("revoked", {}),
        )}  # fmt: skip
        client.delete(f"/admin/keys/{keys['revoked']['id']}")
        held = {name: bearer(key["key"]) for name, key in keys.items()}
        client.get("/limits", headers=held["slow"])
        photo: dict[str, Any] = {"data": plan, "files": {"photo": b"\xff\xd8\xff"}}
        photos = {"data": plan | {"motion": "turn"}, "files": 2 * [("photo", b"\xff\xd8\xff")]}
        unknown = f"lalaloc_{'0' * 32}_{'x' * 43}"
        table: list[tuple[str, str, dict[str, str], dict[str, Any], int, str, list[str]]] = [
            ("GET", "/limits", {"Authorization": ""}, {}, 401, "unauthenticated", ["Bearer lalaloc_"]),
            ("GET", "/limits", bearer("x"), {}, 401, "unauthenticated", ["Bearer lalaloc_"]),
            ("GET", "/limits", bearer(unknown), {}, 401, "unauthenticated", ["ask the operator"]),
            ("GET", "/usage", held["revoked"], {}, 401, "unauthenticated", ["ask the operator"]),
            ("GET", "/metrics", held["reader"], {}, 403, "insufficient-scope", ["'metrics'", "it has: read"]),
            ("POST", "/localise", held["reader"], photo, 403, "insufficient-scope", ["'localise'", "it has: read"]),
            ("POST", "/admin/keys", held["reader"], {}, 403, "insufficient-scope", ["'admin'", "it has: read"]),
            ("GET", "/limits", held["slow"], {}, 429, "rate-limited", ["1 requests per minute", "Retry after"]),
            ("POST", "/localise", {}, photo, 403, "features-required", ["LALALOC_REQUIRE_FEATURES", "lalaloc encode"]),
            ("POST", "/localise/sequence", {}, photos, 403, "features-required", ["LALALOC_REQUIRE_FEATURES"]),
        ]
        for method, path, headers, body, status, slug, words in table:
            problem = assert_problem(client.request(method, path, headers=headers, **body), status, slug)
            assert [word for word in words if word not in problem["detail"]] == [], problem["detail"]
        found = Counter((entry["action"], entry["status"], entry["result"]) for entry in _entries(client))
        missing = [row for row in table if found[f"{row[0]} {row[1]}", row[4], row[5]] == 0]
        assert missing == []


def test_refusal_without_keys_names_host_and_origin(client: httpx.Client) -> None:
    for headers, value in (
        ({"Host": "evil.example"}, "evil.example"),
        ({"Origin": "http://evil.example"}, "http://evil"),
    ):
        problem = assert_problem(client.post("/floorplans", headers=headers), 403, "exposed-without-keys")
        assert f"not '{value}" in problem["detail"]
        assert "LALALOC_ALLOWED_HOSTS" in problem["detail"]


@pytest.mark.one_replica
def test_flood_of_refusals_has_few_entries(admin: httpx.Client) -> None:
    # A key that was used is not affected by invalid ones of the same address.
    assert admin.get("/limits").status_code == 200
    for number in range(150):
        admin.get(f"/no%00such/{number}", headers=bearer("wrong"))
    refused = _entries(admin, actor=ANONYMOUS)
    assert sum(entry["count"] for entry in refused) == 150
    assert {entry["result"] for entry in refused} == {"unauthenticated", "too-many-refused-keys"}
    assert len(refused) <= 22
    collapsed = [entry for entry in refused if entry["action"] == VARIOUS]
    assert {(entry["resource"], entry["address"]) for entry in collapsed} == {("", "")}


def test_entries_cannot_be_changed(store: Store) -> None:
    store.audit_log.add([_entry()])
    with pytest.raises(DBAPIError, match="append-only"), store.database.writing() as connection:
        connection.execute(update(AUDIT_LOG).values(actor="b"))
    assert [entry.actor for entry in store.audit_log.page(limit=9)] == ["a"]


def test_entries_are_deleted_by_age_and_number(store: Store) -> None:
    now = datetime.now(UTC)
    old = [_entry(created_at=now - timedelta(seconds=DAY_S + late_s)) for late_s in (60, -60)]
    store.audit_log.add(old)
    assert store.audit_log.purge() == 1
    # A flood of unknown callers displaces their own entries only.
    store.audit_log.add([_entry(ANONYMOUS, created_at=now + timedelta(seconds=n)) for n in range(700)])
    assert store.audit_log.purge() == 698
    store.audit_log.add([_entry("b", created_at=now + timedelta(seconds=n)) for n in range(19)])
    assert store.audit_log.purge() == 2
    assert Counter(entry.actor for entry in store.audit_log.export()) == {ANONYMOUS: 2, "b": 18}
    assert store.audit_log.purge() == 0


def test_export_has_every_entry_once_and_in_order(store: Store) -> None:
    now = datetime.now(UTC)
    store.audit_log.add([_entry(resource=str(n), created_at=now + timedelta(seconds=n // 2)) for n in range(1201)])
    exported = [entry.resource for entry in store.audit_log.export()]
    assert sorted(exported, key=int) == [str(n) for n in range(1201)]
    assert [int(resource) // 2 for resource in exported] == [n // 2 for n in range(1201)]
    cut = store.audit_log.export(since=now + timedelta(seconds=10), until=now + timedelta(seconds=12))
    assert sorted(int(entry.resource) for entry in cut) == [20, 21, 22, 23]


def test_counted_entries_of_an_actor_are_bounded() -> None:
    added: list[AuditEntry] = []

    class Log:
        def add(self, entries: list[AuditEntry]) -> None:
            added.extend(entries)

    trail = AuditTrail(Log())  # pyright: ignore[reportArgumentType]
    for number in range(3000):
        trail.count(_entry(f"actor {number % 100}", resource=str(number), status=404))
    trail.flush()
    assert sum(entry.count for entry in added) == 3000
    assert len(added) <= 1001
    assert max(Counter(entry.actor for entry in added if entry.actor != VARIOUS).values()) <= 21
    trail.close()


def test_entries_wait_for_the_database(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.security.audit._MAX_WAITING", 3)
    waiting = Store(store.database._engine.url.render_as_string(hide_password=False), connections=1, wait_s=0.05)
    trail = AuditTrail(waiting.audit_log)
    # The only connection is in use.
    with waiting.database.reading():
        for number in range(5):
            asyncio.run(trail.record(_entry(resource=str(number))))
        trail.count(replace(_entry("counted"), status=403))
        trail.count(replace(_entry("counted"), status=403))
        trail.flush()
    trail.close()
    found = [(entry.actor, entry.resource, entry.result, entry.count) for entry in waiting.audit_log.export()]
    kept = [("a", "0", "done", 1), ("a", "1", "done", 1), ("a", "2", "done", 1)]
    assert sorted(found) == sorted([*kept, ("service", "", "lost", 4)])
    waiting.close()


def test_change_without_an_answer_has_an_entry(store: Store) -> None:
    trail, access = AuditTrail(store.audit_log), AccessControl(store.keys, Settings())
    scope = {
        "type": "http",
        "method": "DELETE",
        "path": f"/floorplans/{'0' * 32}",
        "headers": [(b"host", b"localhost")],
        "client": ("127.0.0.1", 1),
        "server": ("127.0.0.1", 8000),
        "app": SimpleNamespace(state=SimpleNamespace(access_control=access, audit_trail=trail)),
    }
    never = Mock(side_effect=AssertionError("something is received or sent"))
    # The layers below return, as they do when the client has disconnected.
    asyncio.run(AuthorisationMiddleware(AsyncMock())(scope, never, never))
    trail.close()
    access.close()
    (entry,) = store.audit_log.page(limit=9)
    assert (entry.actor, entry.tenant, entry.status, entry.result) == (ANONYMOUS, "default", 499, "unanswered")
