"""Venues made from a plan file of several levels: all of its plans and the venue, or nothing."""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import httpx
import pytest
from sqlalchemy import text
from sqlalchemy.exc import IntegrityError

from benchmarks.large_venues import random_home
from lalaloc_core.floorplan import FloorPlan
from service.errors import UnknownVenueError
from service.storage.database import Database
from service.storage.plan_rows import plan_bytes
from service.storage.records import NewPlan, Original, PlanRecord, VenueRecord
from service.storage.store import Store
from tests.importers.conftest import zip_file
from tests.importers.test_crop import SCALE, _storeys
from tests.importers.test_ifc import ifc_flat, ifc_house
from tests.importers.test_roomplan import two_stories
from tests.painted import picture_file
from tests.service.conftest import FLAT, DatabaseOf, StartApp, assert_problem, document_of, wait_for
from tests.service.test_security import bearer, make_key
from tests.service.test_venues import plans_of
from tests.strategies import present

SQUARE = [[11.0, 48.0], [11.00005, 48.0], [11.00005, 48.00005], [11.0, 48.00005], [11.0, 48.0]]


def room(level: str, side: float = 1.0, **properties: Any) -> dict[str, Any]:
    """Return a room of `side` times 4 m x 5.5 m as a feature of GeoJSON."""
    (x0, y0), ring = SQUARE[0], SQUARE
    ring = [[x0 + side * (x - x0), y0 + side * (y - y0)] for x, y in ring]
    properties = {"indoor": "room", "level": level, "name": f"room {level}"} | properties
    return {"type": "Feature", "properties": properties, "geometry": {"type": "Polygon", "coordinates": [ring]}}


def geojson(*features: dict[str, Any]) -> bytes:
    return json.dumps({"type": "FeatureCollection", "features": features or [room("0"), room("1")]}).encode()


def osm() -> bytes:
    root = ElementTree.Element("osm", version="0.6")
    for number, (x, y) in enumerate(SQUARE[:4]):
        ElementTree.SubElement(root, "node", id=str(number), lon=str(x), lat=str(y))
    for level in (0, 1):
        way = ElementTree.SubElement(root, "way", id=str(level))
        for node in (0, 1, 2, 3, 0):
            ElementTree.SubElement(way, "nd", ref=str(node))
        for key, value in (("indoor", "room"), ("level", str(level)), ("name", f"room {level}")):
            ElementTree.SubElement(way, "tag", k=key, v=value)
    return ElementTree.tostring(root)


def imdf() -> bytes:
    def collection(*features: dict[str, Any]) -> str:
        return json.dumps({"type": "FeatureCollection", "features": features})

    levels = [
        {"id": f"level-{n}", "type": "Feature", "feature_type": "level", "geometry": None,
         "properties": {"ordinal": n, "name": {"en": f"Level {n}"}}}
        for n in (0, 1)
    ]  # fmt: skip
    units = []
    for n in (0, 1):
        properties = {"level_id": f"level-{n}", "category": "room", "name": {"en": f"room {n}"}}
        units.append({**room(""), "id": f"unit-{n}", "feature_type": "unit", "properties": properties})
    files = {"manifest.json": "{}", "level.geojson": collection(*levels), "unit.geojson": collection(*units)}
    return zip_file(files)


def send(client: httpx.Client, content: bytes, file_name: str = "Duplex.bin", **fields: Any) -> httpx.Response:
    headers = fields.pop("headers", {})
    return client.post("/venues", files={"file": (file_name, content)}, data=fields, headers=headers)


def counts(client: httpx.Client, headers: dict[str, str] | None = None) -> tuple[int, int]:
    """Return the numbers of stored plans and venues."""

    def count(path: str) -> int:
        answer = client.get(path, params={"limit": 500}, headers=headers or {}).json()
        return len(answer[path.removeprefix("/")])

    return count("/floorplans"), count("/venues")


@pytest.mark.parametrize("make", [geojson, osm, imdf, two_stories], ids=["GeoJSON", "OSM", "IMDF", "RoomPlan"])
def test_levels_become_a_venue(client: httpx.Client, make: Callable[[], bytes]) -> None:
    response = send(client, make())
    assert response.status_code == 201, response.text
    venue = response.json()
    assert response.headers["location"] == f"/venues/{venue['id']}"
    assert (venue["name"], venue["plans"], venue["plans_ready"], venue["anchor"]) == ("Duplex", 2, 2, None)
    entries = plans_of(client, venue["id"])
    assert [entry["level"] for entry in entries] == [0.0, 1.0]
    names = [entry["name"].casefold().replace("story", "level") for entry in entries]
    assert names == ["duplex – level 0", "duplex – level 1"]
    for number, entry in enumerate(entries):
        plan = client.get(f"/floorplans/{entry['floorplan_id']}").json()
        assert (plan["name"], plan["status"]) == (entry["name"], "ready")
        assert plan["import_report"]["level"]["number"] == number
    assert client.delete(f"/venues/{venue['id']}").status_code == 204


def test_levels_of_a_model_are_searched(client: httpx.Client, sphere: bytes) -> None:
    venue = send(client, ifc_house().content(), name="Haus", ceiling_height_m="2.5").json()
    entries = plans_of(client, venue["id"])
    found = [(entry["name"], entry["level"], entry["rooms"]) for entry in entries]
    assert found == [("Haus – EG", 0.0, 2), ("Haus – Obergeschoss", 1.0, 1)]
    query = {"venue_id": venue["id"], "refine": "none"}
    answer = client.post("/localise", data=query, files={"photo": ("p.jpg", sphere, "image/jpeg")}).json()
    assert answer["floorplan_id"] in {entry["floorplan_id"] for entry in entries}


def test_levels_keep_their_plan_as_a_file(client: httpx.Client) -> None:
    venue = send(client, geojson()).json()
    for entry in plans_of(client, venue["id"]):
        original = client.get(f"/floorplans/{entry['floorplan_id']}/original")
        assert original.headers["content-type"] == "application/json"
        again = client.post("/floorplans", content=original.content, headers={"content-type": "application/json"})
        assert again.json()["plan"] == client.get(f"/floorplans/{entry['floorplan_id']}").json()["plan"]


def test_storeys_of_a_picture_become_a_venue_and_keep_it(client: httpx.Client) -> None:
    picture = picture_file(_storeys())
    venue = send(client, picture, "House.png", metres_per_pixel=str(SCALE)).json()
    found = [(entry["name"], entry["rooms"]) for entry in plans_of(client, venue["id"])]
    assert sorted(found) == [("House – Storey 1", 2), ("House – Storey 2", 1)]
    for entry in plans_of(client, venue["id"]):
        assert client.get(f"/floorplans/{entry['floorplan_id']}/original").content == picture


def test_file_without_levels_becomes_a_venue_of_one_plan(client: httpx.Client) -> None:
    content = json.dumps(FLAT).encode()
    for file, name, plan_name, level in (
        (content, "house", "Flat 3", 0.0),
        (ifc_flat().content(), "house", "EG", 0.0),
        (geojson(room("2")), "house", "house", 2.0),
    ):
        venue = send(client, file, "house.x").json()
        [entry] = plans_of(client, venue["id"])
        assert (venue["name"], entry["name"], entry["level"]) == (name, plan_name, level)
        assert client.get(f"/floorplans/{entry['floorplan_id']}/original").content == file


def test_levels_without_numbers_are_ordered(client: httpx.Client) -> None:
    venue = send(client, geojson(room("Ground"), room("Attic"))).json()
    found = [(entry["name"], entry["level"]) for entry in plans_of(client, venue["id"])]
    assert found == [("Duplex – Ground", 0.0), ("Duplex – Attic", 1.0)]


def test_large_levels_are_prepared_in_the_background(client: httpx.Client) -> None:
    halls = [room(str(level), side=12.0) for level in range(2)]
    venue = send(client, geojson(*halls)).json()
    path = f"/venues/{venue['id']}"
    wait_for(lambda: client.get(path).json()["plans_ready"] == 2)


@pytest.mark.parametrize(
    ("content", "kind", "words"),
    [
        (geojson(room("0"), room("1", side=1e3)), "invalid-floorplan", "level '1': "),
        (b"AC1032 dwg", "invalid-floorplan", "DWG"),
        (b"  ", "invalid-floorplan", "the body is empty"),
    ],
)
def test_invalid_file_stores_nothing(client: httpx.Client, content: bytes, kind: str, words: str) -> None:
    before = counts(client)
    assert words in assert_problem(send(client, content), 422, kind)["detail"]
    assert counts(client) == before


def test_options_are_checked(client: httpx.Client) -> None:
    problem = assert_problem(send(client, geojson(), level="1", units="miles"), 422, "invalid-request")
    assert {fault["field"] for fault in problem["errors"]} == {"level", "units"}
    unnamed = client.post("/venues", data={"name": "x"}, files={"plan": ("a", b"b")})
    assert "file" in assert_problem(unnamed, 422, "invalid-request")["detail"]
    text_body = client.post("/venues", content=b"x", headers={"content-type": "text/plain"})
    assert_problem(text_body, 415, "unsupported-media")


def test_repeated_request_makes_one_venue(client: httpx.Client) -> None:
    key = {"Idempotency-Key": uuid.uuid4().hex}
    before = counts(client)
    first, second = (send(client, geojson(), headers=key) for _ in range(2))
    assert (first.status_code, second.content) == (201, first.content)
    assert second.headers["idempotency-replayed"] == "true"
    assert counts(client) == (before[0] + 2, before[1] + 1)
    assert_problem(send(client, geojson(), headers=key, name="x"), 422, "idempotency-key-reused")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limits", "status", "kind", "words"),
    [
        ({"max_floorplans": 1}, 507, "too-many-floorplans", "LALALOC_MAX_FLOORPLANS"),
        ({"max_venues": 1}, 507, "too-many-venues", "max_venues"),
        ({"max_venue_plans": 1}, 422, "invalid-request", "has 2 levels; the limit is 1"),
        ({"max_grid_poses": 20}, 422, "floorplan-too-large", "the plan of level '0' needs"),
        ({"max_stored_bytes": 2000}, 507, "storage-quota", "LALALOC_MAX_STORED_BYTES"),
        ({"max_plan_bytes": 200}, 413, "upload-too-large", "LALALOC_MAX_PLAN_BYTES"),
        ({"max_rooms": 1}, 422, "invalid-floorplan", "level '0': "),
    ],
)
def test_limits_refuse_the_whole_file(
    start_app: StartApp, tmp_path: Path, limits: dict[str, Any], status: int, kind: str, words: str
) -> None:
    with start_app(tmp_path, **limits) as client:
        if "max_venues" in limits:
            assert client.post("/venues", json={}).status_code == 201
        before = counts(client)
        content = geojson(room("0"), room("0", side=0.9), room("1")) if "max_rooms" in limits else geojson()
        assert words in assert_problem(send(client, content), status, kind)["detail"]
        assert counts(client) == before
        assert client.get("/usage").json()["stored_bytes"]["by_kind"]["plans"] == 0


def test_levels_belong_to_the_tenant(start_app: StartApp, tmp_path: Path, app_store: Store) -> None:
    with start_app(tmp_path, api_keys=True) as client:
        keys = [make_key(app_store, tenant=tenant, scopes=("read", "write")) for tenant in ("mine", "theirs")]
        mine, theirs = map(bearer, keys)
        venue = send(client, geojson(), headers=mine).json()
        assert (counts(client, mine), counts(client, theirs)) == ((2, 1), (0, 0))
        assert_problem(client.get(f"/venues/{venue['id']}", headers=theirs), 404, "unknown-venue")
        reader = bearer(make_key(app_store, tenant="mine", scopes=("read", "localise")))
        assert_problem(send(client, geojson(), headers=reader), 403, "insufficient-scope")
        used = client.get("/usage", headers=mine).json()["stored_bytes"]["by_kind"]
        app_store.quota.recount()
        assert client.get("/usage", headers=mine).json()["stored_bytes"]["by_kind"] == used


def street(first: int, count: int = 3) -> bytes:
    """Return a file of homes of two rooms in the native format, alternately on the levels 0 and 1."""
    return json.dumps({"plans": [{**random_home(n), "level": n % 2} for n in range(first, first + count)]}).encode()


def extend(client: httpx.Client, venue_id: str, content: bytes, **headers: str) -> httpx.Response:
    return client.patch(f"/venues/{venue_id}", files={"file": ("street.json", content)}, headers=headers)


def test_files_of_plans_make_and_extend_a_venue(client: httpx.Client) -> None:
    venue = send(client, street(0), "Street.json").json()
    # Ready at once, although the file passes through a worker.
    assert (venue["name"], venue["plans"], venue["plans_ready"]) == ("Street", 3, 3)
    before, key = counts(client), {"Idempotency-Key": uuid.uuid4().hex}
    extended = document_of(extend(client, venue["id"], street(3), **key))
    assert (extended["plans"], extended["plans_ready"]) == (6, 6)
    assert extended["revision"] != venue["revision"]
    again = extend(client, venue["id"], street(3), **key)
    assert (again.json(), again.headers["Idempotency-Replayed"]) == (extended, "true")
    assert counts(client) == (before[0] + 3, before[1])
    entries = plans_of(client, venue["id"])
    assert {(entry["name"], entry["level"]) for entry in entries} == {(f"home {n:05d}", n % 2) for n in range(6)}
    # The same plan as of an upload of its own, and the same pose grid.
    alone = client.post("/floorplans", json=random_home(4)).json()
    home = client.get("/floorplans/" + next(e["floorplan_id"] for e in entries if e["name"] == alone["name"])).json()
    for member in ("rooms", "area_m2", "status", "grid", "openings"):
        assert home.get(member) == alone.get(member), member
    assert json.loads(client.get(f"/floorplans/{home['id']}/original").content)["name"] == home["name"]
    for entry in (*entries, {"floorplan_id": alone["id"]}):
        client.delete(f"/floorplans/{entry['floorplan_id']}")
    client.delete(f"/venues/{venue['id']}")


def test_file_that_cannot_be_added_changes_nothing(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, max_venue_plans=5, max_floorplans=6) as client:
        venue = send(client, street(0), "Street.json")
        path, before = f"/venues/{venue.json()['id']}", counts(client)
        venue_id, used = venue.json()["id"], client.get("/usage").json()["stored_bytes"]
        problem = assert_problem(extend(client, venue_id, street(3)), 422, "invalid-request")
        assert "would have 6 plans; the limit is 5 (LALALOC_MAX_VENUE_PLANS)" in problem["detail"]
        assert_problem(extend(client, venue_id, street(3, 4)), 507, "too-many-floorplans")
        assert_problem(extend(client, venue_id, street(3, 2), **{"If-Match": '"old"'}), 412, "revision-mismatch")
        assert_problem(extend(client, "0" * 32, street(3, 2)), 404, "unknown-venue")
        wrong = json.dumps({"plans": [random_home(3), {**random_home(4), "rooms": []}]}).encode()
        problem = assert_problem(extend(client, venue_id, wrong), 422, "invalid-floorplan")
        assert "level 'home 00004'" in problem["detail"]
        assert counts(client) == before
        assert client.get("/usage").json()["stored_bytes"] == used
        assert client.get(path).json() == venue.json()
        tag = client.get(path).headers["etag"]
        assert extend(client, venue_id, street(3, 2), **{"If-Match": tag}).json()["plans"] == 5


def assert_stored_once(attempt: Callable[[], tuple[VenueRecord, list[PlanRecord]]]) -> None:
    """Check that one of four attempts at the same time stores three plans, and that all get the same revision."""
    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(lambda _: attempt(), range(4)))
    assert len({venue.revision_id for venue, _ in found}) == 1
    assert sorted(len(records) for _, records in found) == [0, 0, 0, 3]


def test_attempts_at_the_same_time_extend_and_store_once(app_store: Store) -> None:
    token, limits = uuid.uuid4().hex, dict[str, Any](max_plans=9, max_venue_plans=9)
    venue, _ = app_store.venue_imports.add("t", uuid.uuid4().hex, "house", new_plans(1), max_plans=9, max_venues=9)
    assert_stored_once(lambda: app_store.venue_imports.extend("t", venue.id, token, new_plans(), **limits))
    assert present(app_store.venues.get("t", venue.id)).plans == 4
    used = app_store.quota.account("t").used
    app_store.quota.recount()
    assert app_store.quota.account("t").used == used
    with pytest.raises(UnknownVenueError):
        app_store.venue_imports.extend("other", venue.id, "f" * 32, new_plans(), **limits)
    venue_id = uuid.uuid4().hex
    assert_stored_once(
        lambda: app_store.venue_imports.add("u", venue_id, "house", new_plans(), max_plans=9, max_venues=9)
    )
    assert len(app_store.plans.list_plans("u", limit=99)) == 3


def new_plans(count: int = 3) -> list[NewPlan]:
    plans = [FloorPlan.from_dict(FLAT | {"name": f"Level {number}"}) for number in range(count)]
    return [NewPlan(plan=plan, level=float(level), original=Original(b"{}")) for level, plan in enumerate(plans)]


def test_plans_of_a_long_file_do_not_displace_those_in_use(tmp_path: Path) -> None:
    cache_bytes = 30 * plan_bytes(FloorPlan.from_dict(FLAT))
    store = Store(f"sqlite:///{tmp_path / 'store.sqlite3'}", plan_cache_bytes=cache_bytes)
    used = store.plans.add("t", "used", NewPlan(FloorPlan.from_dict(FLAT), Original(b"{}")), limit=99)
    store.venue_imports.add("t", uuid.uuid4().hex, "street", new_plans(60), max_plans=99, max_venues=9)
    assert store.plan_cache.revisions() == {used.revision_id}
    read = store.plans.list_plans("t", limit=99)[0]
    assert store.plans.get("t", read.id) is not None
    assert store.plan_cache.revisions() == {used.revision_id, read.revision_id}
    store.close()


def test_failure_between_two_plans_stores_none(tmp_path: Path, database_of: DatabaseOf) -> None:
    url = database_of(tmp_path)
    store = Store(url)
    database = Database(url)
    if database.is_postgresql:
        pytest.skip("the trigger is in SQLite's dialect")
    with database.writing() as connection:
        refuse = "BEGIN SELECT RAISE(ABORT, 'no'); END"
        connection.execute(text(f"CREATE TRIGGER t BEFORE INSERT ON floorplans WHEN NEW.name = 'Level 2' {refuse}"))
    with pytest.raises(IntegrityError):
        store.venue_imports.add("t", uuid.uuid4().hex, "house", new_plans(), max_plans=9, max_venues=9)
    assert store.plans.list_plans("t", limit=9) == []
    assert store.venues.list_venues("t", limit=9) == []
    assert store.quota.account("t").used.total == 0
    database.close()
    store.close()
