"""Tests of plan resources: paging, names, entity tags, revisions, deletion."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import InvalidRequestError
from service.routes.dependencies import cursor_text, parse_cursor
from service.storage.records import Cursor
from tests.service.conftest import FLAT, HALL, StartApp, assert_problem, localise, metric, pages, upload, wait_for
from tests.service.postgres import PostgresServer

NEVER = "0123456789abcdef" * 2


def _hall(step_m: float = 0.25) -> dict[str, Any]:
    """Return settings under which the grid of the hall is prepared slowly in the background."""
    return {"grid_step_m": step_m, "inline_grid_poses": 100}


def _named(name: str) -> dict[str, Any]:
    return {**FLAT, "name": name}


@pytest.fixture(scope="module")
def listed(start_app: StartApp, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[httpx.Client, list[str]]]:
    """App with seven plans, and their ids from old to new."""
    names = ["Flat 1", "flat 2", "House", "FLAT_3", "100% flat", "Ärger Straße", "house 2"]
    with start_app(tmp_path_factory.mktemp("data")) as client:
        yield client, [upload(client, _named(name), wait=False) for name in names]


def _pages(client: httpx.Client, **params: Any) -> list[list[str]]:
    return [[plan["id"] for plan in page["floorplans"]] for page in pages(client, "/floorplans", **params)]


@pytest.mark.parametrize(("limit", "sizes"), [(1, [1] * 7), (3, [3, 3, 1]), (7, [7]), (500, [7])])
def test_pages_have_every_plan_once_newest_first(
    listed: tuple[httpx.Client, list[str]], limit: int, sizes: list[int]
) -> None:
    client, ids = listed
    by_page = _pages(client, limit=limit)
    assert [len(page) for page in by_page] == sizes
    assert [plan_id for page in by_page for plan_id in page] == ids[::-1]


def test_paging_is_stable_under_changes(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path) as client:
        ids = [upload(client, wait=False) for _ in range(4)]
        first = client.get("/floorplans", params={"limit": 2}).json()
        upload(client, wait=False)
        # The cursor works after its plan is deleted.
        client.delete(f"/floorplans/{ids[2]}")
        second = client.get("/floorplans", params={"limit": 5, "cursor": first["next_cursor"]}).json()
        assert [plan["id"] for plan in first["floorplans"]] == [ids[3], ids[2]]
        assert [plan["id"] for plan in second["floorplans"]] == [ids[1], ids[0]]
        assert second["next_cursor"] is None


@pytest.mark.parametrize(
    ("name", "found"),
    [("flat", [4, 3, 1, 0]), ("HOUSE", [6, 2]), ("ärg", [5]), ("STRASSE", [5]), ("%", [4]), ("_", [3]), ("none", [])],
)
def test_plans_are_found_by_part_of_their_name(
    listed: tuple[httpx.Client, list[str]], name: str, found: list[int]
) -> None:
    client, ids = listed
    by_page = _pages(client, name=name, limit=2)
    assert [plan_id for page in by_page for plan_id in page] == [ids[index] for index in found]


@pytest.mark.parametrize(
    ("params", "field"),
    [
        ({"cursor": ""}, "cursor"),
        ({"cursor": "x"}, "cursor"),
        ({"cursor": "A" * 33}, "cursor"),
        ({"cursor": "é" * 32}, "cursor"),
        # A moment beyond the largest datetime.
        ({"cursor": "_" * 32}, "cursor"),
        ({"limit": 0}, "limit"),
        ({"limit": 501}, "limit"),
        ({"name": "a\0b"}, "name"),
        ({"name": "x" * 201}, "name"),
    ],
)
def test_invalid_list_parameters_are_refused(
    listed: tuple[httpx.Client, list[str]], params: dict[str, Any], field: str
) -> None:
    problem = assert_problem(listed[0].get("/floorplans", params=params), 422, "invalid-request")
    assert [fault["field"] for fault in problem["errors"]] == [field]


@given(
    st.datetimes(datetime(1970, 1, 1), datetime(9999, 12, 31), timezones=st.just(UTC)),
    st.binary(min_size=16, max_size=16),
)
def test_cursor_round_trip(moment: datetime, plan_id: bytes) -> None:
    place = Cursor(moment, plan_id.hex())
    assert parse_cursor(cursor_text(place)) == place


@given(st.text(alphabet="Aa9_-+/=", min_size=31, max_size=33))
def test_cursor_texts_are_unique(text: str) -> None:
    with contextlib.suppress(InvalidRequestError):
        assert cursor_text(parse_cursor(text)) == text


# Entity tags


@pytest.mark.parametrize("path", ["", "/original", "/preview.svg", "/mesh.glb"])
def test_matching_tag_gets_304(client: httpx.Client, path: str) -> None:
    url = f"/floorplans/{upload(client)}{path}"
    first = client.get(url)
    etag = first.headers["etag"]
    assert etag.startswith('"')
    assert first.headers["cache-control"] == "private, no-cache"
    for known in (etag, f'"other", {etag}', f"W/{etag}", "*", f',{etag} ,"x,y"'):
        again = client.get(url, headers={"If-None-Match": known})
        assert again.status_code == 304, known
        assert again.content == b""
        assert again.headers["etag"] == etag
        assert again.headers["cache-control"] == "private, no-cache"
    assert client.get(url, headers=[("If-None-Match", '"other"'), ("If-None-Match", etag)]).status_code == 304
    for tag in ('"other"', 'W/"other"', etag.upper().replace("F", "0")[:-1] + '0"'):
        changed = client.get(url, headers={"If-None-Match": tag})
        assert (changed.status_code, changed.content) == (200, first.content)
    assert "etag" not in client.get("/floorplans").headers


@pytest.mark.parametrize("value", ["", "x", '"', '"a" "b"', "*, *", '"a", b', "W/", 'w/"a"'])
def test_invalid_tag_header_is_refused(client: httpx.Client, value: str) -> None:
    url = f"/floorplans/{upload(client)}"
    looked_at = client.get(url, headers={"If-None-Match": value})
    assert assert_problem(looked_at, 422, "invalid-request")["errors"][0]["field"] == "If-None-Match"
    deleted = client.delete(url, headers={"If-Match": value})
    assert assert_problem(deleted, 422, "invalid-request")["errors"][0]["field"] == "If-Match"


def test_drawings_of_other_poses_have_other_tags(client: httpx.Client) -> None:
    url = f"/floorplans/{upload(client)}/preview.svg"
    poses: list[dict[str, int]] = [{}, {"x_m": 1, "y_m": 1}, {"x_m": 2, "y_m": 1}]
    assert len({client.get(url, params=pose).headers["etag"] for pose in poses}) == 3


def test_tag_identifies_bytes_while_preparing(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, **_hall()) as client:
        created = client.post("/floorplans", json=HALL)
        url = created.headers["location"]
        bodies: dict[str, set[bytes]] = {created.headers["etag"]: {created.content}}
        while (answer := client.get(url)).json()["status"] == "preparing":
            bodies.setdefault(answer.headers["etag"], set()).add(answer.content)
        bodies.setdefault(answer.headers["etag"], set()).add(answer.content)
        assert len(bodies) > 2
        assert all(len(same) == 1 for same in bodies.values())
        # Progress does not change the revision, so each tag is valid in If-Match.
        assert client.put(url, json=HALL, headers={"If-Match": created.headers["etag"]}).status_code == 200


# Revisions


def test_replaced_plan_has_another_revision(client: httpx.Client) -> None:
    created = client.post("/floorplans", json=FLAT)
    before, url = created.json(), created.headers["location"]
    response = client.put(url, json=_named("Flat 3, rebuilt"))
    assert response.status_code == 200
    after = response.json()
    assert (before["revision_number"], after["revision_number"]) == (1, 2)
    assert (after["id"], after["name"], after["created_at"]) == (before["id"], "Flat 3, rebuilt", before["created_at"])
    assert after["updated_at"] > before["updated_at"]
    assert after["revision"] != before["revision"]
    assert response.headers["etag"] != created.headers["etag"]
    assert response.headers["content-location"] == created.headers["content-location"] == url
    now = client.get(url)
    assert (now.json(), now.headers["etag"]) == (after, response.headers["etag"])
    listed = {plan["id"]: plan for plan in client.get("/floorplans").json()["floorplans"]}[before["id"]]
    assert (listed["revision"], listed["revision_number"]) == (after["revision"], 2)


def test_kept_revisions_can_be_read(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, max_revisions=2) as client:
        created = client.post("/floorplans", json=FLAT)
        url, revisions = created.headers["location"], [created.json()["revision"]]
        revisions += [client.put(url, json=_named(f"Flat {n}")).json()["revision"] for n in (4, 5)]
        for revision, name, status in ((revisions[1], "Flat 4", "superseded"), (revisions[2], "Flat 5", "ready")):
            plan = client.get(url, params={"revision": revision}).json()
            assert (plan["revision"], plan["name"], plan["status"]) == (revision, name, status)
        foreign = client.post("/floorplans", json=FLAT).json()["revision"]
        for unknown in (revisions[0], foreign, NEVER, "x", ""):
            assert_problem(client.get(url, params={"revision": unknown}), 404, "unknown-revision")


def test_answers_name_the_searched_revision(client: httpx.Client, sphere: bytes) -> None:
    created = client.post("/floorplans", json=FLAT).json()
    answers = [localise(client, created["id"], sphere, refine="none").json()]
    replaced = client.put(f"/floorplans/{created['id']}", json=_named("other")).json()
    answers.append(localise(client, created["id"], sphere, refine="none").json())
    assert [answer["floorplan_revision"] for answer in answers] == [created["revision"], replaced["revision"]]


def test_running_queries_survive_a_replacement(client: httpx.Client, sphere: bytes) -> None:
    plan_id = upload(client)
    url = f"/floorplans/{plan_id}"
    known, stop = {client.get(url).json()["revision"]}, threading.Event()

    def replace() -> None:
        while not stop.is_set():
            known.add(client.put(url, json=FLAT).json()["revision"])

    with ThreadPoolExecutor(4) as threads:
        replacing = threads.submit(replace)
        queries = [threads.submit(localise, client, plan_id, sphere, refine="none") for _ in range(12)]
        answers = [query.result() for query in queries]
        stop.set()
        replacing.result()
    assert [answer.status_code for answer in answers] == [200] * 12
    assert {answer.json()["floorplan_revision"] for answer in answers} <= known
    assert len(known) > 2


def test_put_creates_no_plans_and_an_invalid_plan_replaces_nothing(client: httpx.Client) -> None:
    for plan_id in (NEVER, "x"):
        assert_problem(client.put(f"/floorplans/{plan_id}", json=FLAT), 404, "unknown-floorplan")
    plan_id = upload(client)
    assert client.delete(f"/floorplans/{plan_id}").status_code == 204
    assert_problem(client.put(f"/floorplans/{plan_id}", json=FLAT), 404, "unknown-floorplan")
    url = f"/floorplans/{upload(client)}"
    before = client.get(url).json()
    assert_problem(client.put(url, json={"rooms": []}), 422, "invalid-floorplan")
    assert_problem(client.put(url, content=b"x", headers={"content-type": "text/plain"}), 415, "unsupported-media")
    assert client.get(url).json() == before


@pytest.mark.parametrize("method", ["PUT", "DELETE"])
def test_unexpected_revision_is_refused(client: httpx.Client, method: str) -> None:
    body: dict[str, Any] = {"json": FLAT} if method == "PUT" else {}
    created = client.post("/floorplans", json=FLAT)
    url, old = created.headers["location"], created.headers["etag"]
    replaced = client.put(url, json=FLAT, headers={"If-Match": old})
    new = replaced.headers["etag"]
    conditions = [{"If-Match": tag} for tag in (old, f"W/{new}", f'"{NEVER}"')]
    conditions += [{"If-None-Match": tag} for tag in ("*", new)]
    for condition in conditions:
        problem = assert_problem(client.request(method, url, headers=condition, **body), 412, "revision-mismatch")
        assert replaced.json()["revision"] in problem["detail"], condition
    assert client.get(url).headers["etag"] == new
    met = client.request(method, url, headers={"If-Match": f"{old}, {new}", "If-None-Match": old}, **body)
    assert met.is_success


@pytest.mark.parametrize("condition", ["*", "revision"])
def test_star_and_plain_revision_ids_are_conditions(client: httpx.Client, condition: str) -> None:
    created = client.post("/floorplans", json=FLAT)
    value = "*" if condition == "*" else f'"{created.json()["revision"]}"'
    url, headers = created.headers["location"], {"If-Match": value}
    assert client.put(url, json=FLAT, headers=headers).status_code == 200
    assert client.delete(url, headers=headers).status_code == (204 if condition == "*" else 412)


def test_one_of_many_replacements_succeeds(client: httpx.Client) -> None:
    created = client.post("/floorplans", json=FLAT)
    url, headers = created.headers["location"], {"If-Match": created.headers["etag"]}
    with ThreadPoolExecutor(6) as threads:
        answers = list(threads.map(lambda n: client.put(url, json=_named(f"{n}"), headers=headers), range(6)))
    assert sorted(answer.status_code for answer in answers) == [200] + [412] * 5
    winner = next(answer.json() for answer in answers if answer.status_code == 200)
    assert client.get(url).json()["name"] == winner["name"]
    assert client.get(url).json()["revision_number"] == 2


# Deletion and jobs


def test_replacing_a_plan_cancels_its_preparation(start_app: StartApp, tmp_path: Path) -> None:
    large = HALL | {"rooms": [{"name": "hall", "polygon": [[0, 0], [90, 0], [90, 90], [0, 90]]}]}
    with start_app(tmp_path, **_hall(0.1), max_grid_poses=10**6, sweep_s=3600.0) as client:
        plan_id = upload(client, large, wait=False)
        wait_for(lambda: client.get(f"/floorplans/{plan_id}").json()["progress"] > 0.0)
        assert client.put(f"/floorplans/{plan_id}", json=FLAT).status_code == 200
        wait_for(lambda: client.get(f"/floorplans/{plan_id}").json()["status"] == "ready")
        # The first preparation would have taken much longer.
        wait_for(lambda: "lalaloc_grids_pending 0.0" in client.get("/metrics").text, 5.0)


@pytest.mark.slow
def test_deleting_a_plan_cancels_its_preparation(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    with start_app(tmp_path, **_hall(0.1), max_grid_poses=10**6) as client:
        plan_id = upload(client, HALL, wait=False)
        wait_for(lambda: client.get(f"/floorplans/{plan_id}").json()["progress"] > 0.0)
        with ThreadPoolExecutor(1) as threads:
            waiting = threads.submit(localise, client, plan_id, sphere)
            wait_for(lambda: "lalaloc_requests_in_flight 1.0" in client.get("/metrics").text)
            assert client.delete(f"/floorplans/{plan_id}").status_code == 204
            assert_problem(waiting.result(), 404, "unknown-floorplan")
        wait_for(lambda: client.get("/readyz").json()["plans_preparing"] == 0, 10.0)
        assert_problem(client.get(f"/floorplans/{plan_id}"), 404, "unknown-floorplan")


@pytest.fixture
def replicas(postgres: PostgresServer, start_app: StartApp, tmp_path: Path) -> Iterator[list[httpx.Client]]:
    """Two apps on one PostgreSQL database."""
    shared = {"database_url": postgres.new_database(), "sweep_s": 0.2}
    with start_app(tmp_path / "a", **shared) as first, start_app(tmp_path / "b", **shared) as second:
        yield [first, second]


def test_replicas_see_changes_at_once(replicas: list[httpx.Client], sphere: bytes) -> None:
    first, second = replicas
    created = first.post("/floorplans", json=FLAT).json()
    url = f"/floorplans/{created['id']}"
    assert localise(second, created["id"], sphere, refine="none").json()["floorplan_revision"] == created["revision"]
    replaced = second.put(url, json=_named("new")).json()
    assert first.get(url).json()["name"] == "new"
    assert localise(first, created["id"], sphere, refine="none").json()["floorplan_revision"] == replaced["revision"]
    wait_for(lambda: all(metric(replica, "lalaloc_grid_cache_bytes") > 0 for replica in replicas))
    assert first.delete(url).status_code == 204
    assert_problem(second.get(url), 404, "unknown-floorplan")
    assert_problem(localise(second, created["id"], sphere), 404, "unknown-floorplan")
    # Both caches are empty.
    wait_for(lambda: all(metric(replica, "lalaloc_grid_cache_bytes") == 0 for replica in replicas), 10.0)
