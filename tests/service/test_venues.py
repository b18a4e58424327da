"""Venues as resources: creation, paging, changes, deletion, tenants and limits."""

from __future__ import annotations

import json
import uuid
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.storage import Store
from tests.service.conftest import FLAT, StartApp, assert_problem, document_of, pages, upload
from tests.service.test_security import bearer, make_key

JSON = {"Content-Type": "application/json"}
ANCHOR = {"latitude": 51.7546, "longitude": -1.2545, "altitude_m": 61.0, "north_deg": 12.5}


@pytest.fixture(scope="module")
def plans(client: httpx.Client) -> list[str]:
    return [upload(client, FLAT | {"name": f"Flat {number}"}) for number in range(3)]


def member(plan_id: str, level: float = 0.0, **more: Any) -> dict[str, Any]:
    return {"floorplan_id": plan_id, "level": level, **more}


def make(client: httpx.Client, *members: dict[str, Any], **more: Any) -> dict[str, Any]:
    response = client.post("/venues", json={"plans": list(members), **more})
    return document_of(response, 201) | {"etag": response.headers["etag"]}


def plans_of(client: httpx.Client, venue_id: str, **params: Any) -> list[dict[str, Any]]:
    """Return all plans of a venue, page by page."""
    return [plan for page in pages(client, f"/venues/{venue_id}/plans", **params) for plan in page["plans"]]


def test_created_venue_is_returned(client: httpx.Client, plans: list[str]) -> None:
    response = client.post("/venues", json={"name": "12 Mill Lane", "anchor": ANCHOR, "plans": [member(plans[0], 1)]})
    assert response.status_code == 201
    venue = response.json()
    assert response.headers["location"] == f"/venues/{venue['id']}"
    assert (venue["name"], venue["anchor"], venue["plans"]) == ("12 Mill Lane", ANCHOR, 1)
    assert (venue["plans_ready"], venue["plans_failed"], venue["revision_number"]) == (1, 0, 1)
    looked_at = client.get(f"/venues/{venue['id']}")
    assert looked_at.json() == venue
    assert looked_at.headers["etag"] == response.headers["etag"]
    known = client.get(f"/venues/{venue['id']}", headers={"If-None-Match": response.headers["etag"]})
    assert known.status_code == 304


def test_plans_of_a_venue_are_paged_by_level(client: httpx.Client, plans: list[str]) -> None:
    members = [member(plans[0], 2, name="penthouse"), member(plans[1], -1), member(plans[2], 0.5)]
    venue = make(client, *members)
    found = plans_of(client, venue["id"], limit=1)
    placed = [(entry["floorplan_id"], entry["level"], entry["name"]) for entry in found]
    assert placed == [(plans[1], -1.0, "Flat 1"), (plans[2], 0.5, "Flat 2"), (plans[0], 2.0, "penthouse")]
    assert {entry["status"] for entry in found} == {"ready"}
    assert [entry["floorplan_id"] for entry in plans_of(client, venue["id"], level=0.5)] == [plans[2]]
    broken = client.get(f"/venues/{venue['id']}/plans", params={"cursor": "x" * 32 + "="})
    assert_problem(broken, 422, "invalid-request")


def test_venues_are_listed_newest_first(client: httpx.Client, plans: list[str]) -> None:
    word = uuid.uuid4().hex
    made = [make(client, member(plans[0]), name=f"{word} {number}")["id"] for number in range(3)]
    page = client.get("/venues", params={"name": word.upper(), "limit": 2}).json()
    assert [venue["id"] for venue in page["venues"]] == [made[2], made[1]]
    rest = client.get("/venues", params={"name": word, "limit": 2, "cursor": page["next_cursor"]}).json()
    assert [venue["id"] for venue in rest["venues"]] == [made[0]]
    assert rest["next_cursor"] is None


def test_put_replaces_and_patch_changes(client: httpx.Client, plans: list[str]) -> None:
    venue = make(client, member(plans[0]), member(plans[1], 1), name="old", anchor=ANCHOR)
    path = f"/venues/{venue['id']}"
    change = {"plans": [member(plans[0], 3), member(plans[2])], "remove": [plans[1]]}
    changed = document_of(client.patch(path, json=change))
    assert (changed["name"], changed["anchor"]) == ("old", ANCHOR)
    levels = {entry["floorplan_id"]: entry["level"] for entry in plans_of(client, venue["id"])}
    assert levels == {plans[0]: 3, plans[2]: 0}
    assert client.patch(path, json={"anchor": None}).json()["anchor"] is None
    assert client.patch(path, json={"name": "new"}).json()["plans"] == 2
    replaced = client.put(path, json={"plans": [member(plans[1])]}).json()
    assert (replaced["name"], replaced["plans"], replaced["revision_number"]) == ("venue", 1, 5)
    assert [entry["floorplan_id"] for entry in plans_of(client, venue["id"])] == [plans[1]]


def test_change_needs_the_expected_revision(client: httpx.Client, plans: list[str]) -> None:
    venue = make(client, member(plans[0]))
    path, stale = f"/venues/{venue['id']}", {"If-Match": venue["etag"]}
    assert client.patch(path, json={"name": "second"}, headers=stale).status_code == 200
    for refused in (
        client.patch(path, json={"name": "third"}, headers=stale),
        client.put(path, json={"name": "third"}, headers=stale),
        client.delete(path, headers=stale),
    ):
        assert "venue" in assert_problem(refused, 412, "revision-mismatch")["detail"]
    current = client.get(path)
    assert current.json()["name"] == "second"
    assert client.delete(path, headers={"If-Match": current.headers["etag"]}).status_code == 204
    assert_problem(client.get(path), 404, "unknown-venue")
    assert client.get(f"/floorplans/{plans[0]}").status_code == 200


def test_deleted_plan_leaves_its_venues(client: httpx.Client, plans: list[str]) -> None:
    leaving = upload(client)
    venue, other = make(client, member(leaving), member(plans[0], 1)), make(client, member(plans[0]))
    path = f"/venues/{venue['id']}"
    assert client.delete(f"/floorplans/{leaving}").status_code == 204
    after = client.get(path)
    assert after.headers["etag"] != venue["etag"]
    assert (after.json()["plans"], after.json()["revision_number"]) == (1, 2)
    assert [entry["floorplan_id"] for entry in plans_of(client, venue["id"])] == [plans[0]]
    refused = client.patch(path, json={"name": "x"}, headers={"If-Match": venue["etag"]})
    assert_problem(refused, 412, "revision-mismatch")
    # Venues without the plan are unchanged.
    assert client.get(f"/venues/{other['id']}").headers["etag"] == other["etag"]


def test_replaced_plan_stays_in_its_venues(client: httpx.Client) -> None:
    plan_id = upload(client)
    venue = make(client, member(plan_id, 4))
    assert client.put(f"/floorplans/{plan_id}", json=FLAT | {"name": "rebuilt"}).status_code == 200
    [entry] = plans_of(client, venue["id"])
    assert (entry["name"], entry["level"]) == ("rebuilt", 4.0)
    assert client.get(f"/venues/{venue['id']}").json()["revision"] == venue["revision"]


BAD_VENUES: dict[str, tuple[Any, str, str]] = {
    "latitude": ({"anchor": ANCHOR | {"latitude": 91}}, "anchor.latitude", "at most 90"),
    "longitude": ({"anchor": ANCHOR | {"longitude": -181}}, "anchor.longitude", "at least -180"),
    "altitude": ({"anchor": ANCHOR | {"altitude_m": 1e9}}, "anchor.altitude_m", "at most 100000"),
    "north": ({"anchor": ANCHOR | {"north_deg": 361}}, "anchor.north_deg", "at most 360"),
    "half an anchor": ({"anchor": {"latitude": 1.0}}, "anchor.longitude", "missing"),
    "text for a number": ({"anchor": ANCHOR | {"latitude": "51"}}, "anchor.latitude", "not a number"),
    "unknown key": ({"floors": []}, "floors", ""),
    "no plan": ({"plans": [member("0" * 32)]}, "plans", "floor plan '" + "0" * 32 + "' does not exist"),
    "no id": ({"plans": [member("flat 3")]}, "plans", "floor plan 'flat 3' does not exist"),
    "level": ({"plans": [member("0" * 32, 1001)]}, "plans.0.level", "at most 1000"),
    "twice": ({"plans": [member("0" * 32), member("0" * 32, 1)]}, "plans", "2 times"),
    "empty name": ({"name": " "}, "name", "empty"),
    "control characters": ({"name": "a\0b"}, "name", "control"),
    "long name": ({"name": "x" * 201}, "name", "at most 200"),
    "a list": ([], "body", ""),
}


@pytest.mark.parametrize(("document", "field", "message"), BAD_VENUES.values(), ids=BAD_VENUES.keys())
def test_invalid_venue_is_rejected_with_its_field(
    client: httpx.Client, document: Any, field: str, message: str
) -> None:
    problem = assert_problem(client.post("/venues", json=document), 422, "invalid-request")
    assert [fault["field"] for fault in problem["errors"]] == [field]
    assert message in problem["detail"]


@pytest.mark.parametrize("body", [b"", b"{", b'{"name": "a", "name": "b"}', b'{"anchor": {"latitude": NaN}}'], ids=repr)
def test_malformed_json_is_rejected(client: httpx.Client, body: bytes) -> None:
    response = client.post("/venues", content=body, headers={"content-type": "application/json"})
    assert_problem(response, 422, "invalid-request")


def test_invalid_change_changes_nothing(client: httpx.Client, plans: list[str]) -> None:
    venue = make(client, member(plans[0]))
    path = f"/venues/{venue['id']}"
    for change, message in (
        ({}, "changes nothing"),
        ({"name": None}, "name"),
        ({"remove": [plans[1]]}, "does not have"),
        ({"plans": [member(plans[0])], "remove": [plans[0]]}, "which is also in plans"),
        ({"name": "x", "plans": [member("0" * 32)]}, "does not exist"),
    ):
        assert message in assert_problem(client.patch(path, json=change), 422, "invalid-request")["detail"]
    assert client.get(path).headers["etag"] == venue["etag"]


def test_repeated_request_creates_one_venue(client: httpx.Client, plans: list[str]) -> None:
    key = {"Idempotency-Key": uuid.uuid4().hex}
    body = {"name": f"once {key['Idempotency-Key']}", "plans": [member(plans[0])]}
    first, second = (client.post("/venues", json=body, headers=key) for _ in range(2))
    assert second.content == first.content
    assert second.headers["idempotency-replayed"] == "true"
    assert len(client.get("/venues", params={"name": body["name"]}).json()["venues"]) == 1
    assert_problem(client.post("/venues", json={"name": "another"}, headers=key), 422, "idempotency-key-reused")


def test_venue_limits_are_reported(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, max_venues=1, max_venue_plans=2, max_venue_bytes=500) as client:
        plans = [upload(client) for _ in range(3)]
        full = [member(plan) for plan in plans]
        detail = client.post("/venues", json={"plans": full}).json()["detail"]
        assert "has 3 floor plans; the limit is 2 (LALALOC_MAX_VENUE_PLANS)" in detail
        venue = make(client, *full[:2])
        grown = client.patch(f"/venues/{venue['id']}", json={"plans": full[2:]})
        assert "would have 3 plans; the limit is 2" in assert_problem(grown, 422, "invalid-request")["detail"]
        moved = client.patch(f"/venues/{venue['id']}", json={"plans": full[2:], "remove": [plans[0]]})
        assert moved.json()["plans"] == 2
        assert "max_venues" in assert_problem(client.post("/venues", json={}), 507, "too-many-venues")["detail"]
        long = client.put(f"/venues/{venue['id']}", json={"name": "x" * 600})
        assert "(LALALOC_MAX_VENUE_BYTES)" in assert_problem(long, 413, "upload-too-large")["detail"]


def test_venues_are_separate_per_tenant(start_app: StartApp, tmp_path: Path, app_store: Store) -> None:
    with start_app(tmp_path, api_keys=True) as client:
        keys = [make_key(app_store, tenant=tenant, scopes=("read", "write")) for tenant in ("mine", "theirs")]
        mine, theirs = map(bearer, keys)
        plan_id = client.post("/floorplans", json=FLAT, headers=mine).json()["id"]
        stolen = client.post("/venues", json={"plans": [member(plan_id)]}, headers=theirs)
        assert "does not exist" in assert_problem(stolen, 422, "invalid-request")["detail"]
        venue = client.post("/venues", json={"plans": [member(plan_id)]}, headers=mine).json()
        path = f"/venues/{venue['id']}"
        for method, body in (("GET", None), ("PUT", {}), ("PATCH", {"name": "x"}), ("DELETE", None)):
            refused = client.request(method, path, content=json.dumps(body), headers=theirs | JSON)
            assert_problem(refused, 404, "unknown-venue")
        assert_problem(client.get(f"{path}/plans", headers=theirs), 404, "unknown-venue")
        assert client.get("/venues", headers=theirs).json()["venues"] == []
        reader = bearer(make_key(app_store, tenant="mine", scopes=("read",)))
        assert client.get(path, headers=reader).json()["plans"] == 1
        assert_problem(client.delete(path, headers=reader), 403, "insufficient-scope")
