"""Queries about venues: the right plan, level and place."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import httpx
import pytest

from lalaloc_core.localise.match import PoseGrid
from service.grids import builder
from service.storage.store import Store
from service.storage.stored_grids import StoredGrids
from service.venues import venue_plans
from tests.core.taken import EXAMPLES
from tests.service.conftest import FLAT, HOME, StartApp, assert_problem, document_of, localise, upload, wait_for
from tests.service.test_localise import HALL

KITCHEN = (EXAMPLES / "kitchen.jpg").read_bytes()
POSES = {pose["file"]: pose for pose in json.loads((EXAMPLES / "poses.json").read_text())}
STUDIO = {"ceiling_height_m": 2.6, "rooms": [{"name": "studio", "polygon": [[0, 0], [9, 0], [9, 2.2], [0, 2.2]]}]}


def venue_of(client: httpx.Client, *plan_ids: str, **more: Any) -> str:
    """Create a venue with plans on levels 0, 1, 2 and so on."""
    plans = [{"floorplan_id": plan_id, "level": level} for level, plan_id in enumerate(plan_ids)]
    return document_of(client.post("/venues", json={"plans": plans, **more}), 201)["id"]


def ask(client: httpx.Client, venue_id: str, picture: bytes, **fields: Any) -> httpx.Response:
    data = {"venue_id": venue_id} | {name: str(value) for name, value in fields.items()}
    return client.post("/localise", data=data, files={"photo": ("p.jpg", picture, "image/jpeg")})


def turned(plan: dict[str, Any]) -> dict[str, Any]:
    """Return a plan with x and y exchanged: a mirror image with the same rooms."""

    def swapped(points: list[list[float]]) -> list[list[float]]:
        return [[y, x] for x, y in points]

    rooms = [{**room, "polygon": swapped(room["polygon"])} for room in plan["rooms"]]
    openings = [{**opening, "line": swapped(opening["line"])} for opening in plan.get("openings", [])]
    return {**plan, "rooms": rooms} | ({"openings": openings} if openings else {})


@pytest.fixture(scope="module")
def others(shipped: httpx.Client) -> list[str]:
    return [upload(shipped, plan) for plan in (FLAT, STUDIO, turned(HOME))]


@pytest.mark.parametrize("name", sorted(POSES))
@pytest.mark.parametrize("given", [True, False], ids=["heading given", "heading searched"])
def test_right_plan_is_found_among_several(
    shipped: httpx.Client, home: str, others: list[str], name: str, given: bool
) -> None:
    pose = POSES[name]
    fields = {"heading_deg": pose["heading_deg"]} if given else {}
    venue_id = venue_of(shipped, others[0], others[1], home)
    answer = document_of(ask(shipped, venue_id, (EXAMPLES / name).read_bytes(), **fields))
    assert (answer["venue_id"], answer["floorplan_id"], answer["level"]) == (venue_id, home, 2.0)
    assert abs(answer["position"]["x_m"] - pose["x_m"]) < 0.5
    assert abs(answer["position"]["y_m"] - pose["y_m"]) < 0.5
    assert answer["plans"][0]["floorplan_id"] == home
    probabilities = [plan["probability"] for plan in answer["plans"]]
    assert probabilities == sorted(probabilities, reverse=True)
    assert sum(probabilities) <= 1.0
    assert probabilities[0] >= answer["confidence"] - 1e-4
    shares = [candidate["probability"] for candidate in answer["candidates"]]
    assert shares == sorted(shares, reverse=True)
    # For any heading of the camera.
    assert shares[0] <= answer["confidence"]
    assert {candidate["floorplan_id"] for candidate in answer["candidates"]} <= {home, others[0], others[1]}


def test_venue_of_one_plan_equals_the_plan(shipped: httpx.Client, home: str) -> None:
    alone = localise(shipped, home, KITCHEN, heading_deg=250).json()
    found = ask(shipped, venue_of(shipped, home), KITCHEN, heading_deg=250).json()
    # Refinement can begin at another grid pose near the place.
    assert found["position"] == pytest.approx(alone["position"], abs=0.06)
    assert found["confidence"] == pytest.approx(alone["confidence"], abs=1e-3)
    assert (alone["venue_id"], alone["level"], alone["plans"]) == (None, None, None)


@pytest.mark.one_replica
@pytest.mark.parametrize("most", [128, pytest.param(2, marks=pytest.mark.slow)], ids=["all plans", "probable plans"])
def test_turn_is_found_in_a_venue(
    shipped: httpx.Client, home: str, others: list[str], monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    monkeypatch.setattr(venue_plans, "MAX_SEARCHED", most)
    venue_id = venue_of(shipped, *others, home)
    files = [("photo", (name, KITCHEN, "image/jpeg")) for name in ("a.jpg", "b.jpg")]
    found = document_of(shipped.post("/localise/sequence", data={"venue_id": venue_id, "motion": "turn"}, files=files))
    assert (found["venue_id"], found["floorplan_id"], found["stage"]) == (venue_id, home, "lpo")
    for pose in found["poses"]:
        assert (pose["floorplan_id"], pose["level"]) == (home, 3.0)
        assert abs(pose["position"]["x_m"] - POSES["kitchen.jpg"]["x_m"]) < 0.5
        assert abs(pose["position"]["y_m"] - POSES["kitchen.jpg"]["y_m"]) < 0.5
    assert found["warnings"] == []
    assert found["confidence"] > 0.5


def test_equal_flats_share_the_probability(shipped: httpx.Client, home: str, others: list[str]) -> None:
    twin = upload(shipped, HOME)
    answer = ask(shipped, venue_of(shipped, home, others[0], twin), KITCHEN, heading_deg=250, top_k=10).json()
    assert 0.3 < answer["confidence"] <= 0.55
    [first, second] = [plan for plan in answer["plans"] if plan["floorplan_id"] in (home, twin)]
    assert first["probability"] == pytest.approx(second["probability"], abs=0.05)
    assert max(first["probability"], second["probability"]) <= 0.55
    best = answer["candidates"][:2]
    assert {candidate["floorplan_id"] for candidate in best} == {home, twin}
    assert best[0]["position"] == pytest.approx(best[1]["position"], abs=0.3)


@pytest.mark.one_replica
def test_most_probable_plans_are_searched(
    shipped: httpx.Client, home: str, others: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    copies = [upload(shipped, HOME) for _ in range(3)]
    venue_id = venue_of(shipped, *others, home, *copies)
    whole = ask(shipped, venue_id, KITCHEN, heading_deg=250, top_k=10).json()
    monkeypatch.setattr(venue_plans, "MAX_SEARCHED", 2)
    # First from the store, then from memory.
    for _ in range(2):
        chosen = ask(shipped, venue_id, KITCHEN, heading_deg=250, top_k=10).json()
        assert chosen["floorplan_id"] in (home, *copies)
        assert len(chosen["plans"]) == 2
        # Copies that were not searched keep their shares.
        assert chosen["confidence"] == pytest.approx(whole["confidence"], abs=0.05)
        assert chosen["confidence"] <= 0.3


@pytest.mark.parametrize("stored", ["NULL", "x'4c4c5032'"], ids=["nothing", "fewer poses"])
def test_missing_prototypes_are_made(
    start_app: StartApp, tmp_path: Path, app_store: Store, sphere: bytes, monkeypatch: pytest.MonkeyPatch, stored: str
) -> None:
    monkeypatch.setattr(venue_plans, "MAX_SEARCHED", 1)
    with start_app(tmp_path) as client:
        venue_id = venue_of(client, upload(client), upload(client, STUDIO))
        with app_store.database.writing() as connection:
            value = "'\\x4c4c5032'" if stored != "NULL" and app_store.database.is_postgresql else stored
            connection.exec_driver_sql(f"UPDATE latent_grids SET prototypes = {value}")
            grid_ids = connection.exec_driver_sql("SELECT id FROM latent_grids").scalars().all()
        assert app_store.grids.prototypes(grid_ids) == {}
        assert ask(client, venue_id, sphere, refine="none").status_code == 200
        assert app_store.grids.prototypes(grid_ids).keys() == set(grid_ids)


@pytest.mark.slow
def test_replaced_plan_is_chosen_by_its_new_revision(
    start_app: StartApp, tmp_path: Path, sphere: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(venue_plans, "MAX_SEARCHED", 1)
    indexed = list[int]()
    choose = venue_plans.VenuePlans.choose

    def noted(self: venue_plans.VenuePlans, known: Any, index: Any, *arguments: Any) -> Any:
        indexed.append(sum(shard.sizes.prototypes for shard, _ in index.shards))
        return choose(self, known, index, *arguments)

    monkeypatch.setattr(venue_plans.VenuePlans, "choose", noted)
    with start_app(tmp_path, request_deadline_s=60.0) as client:
        plan_ids = [upload(client), upload(client, STUDIO)]
        venue_id = venue_of(client, *plan_ids)

        def answer() -> dict[str, Any]:
            return document_of(ask(client, venue_id, sphere, refine="none"))

        first, again = answer(), answer()
        assert indexed[0] == indexed[1]
        assert first["plans"] == again["plans"]
        for plan_id in plan_ids:
            assert client.put(f"/floorplans/{plan_id}", json=HALL).status_code == 200
            wait_for(lambda plan_id=plan_id: client.get(f"/floorplans/{plan_id}").json()["status"] == "ready")
        replaced = answer()
        assert replaced["floorplan_revision"] != first["floorplan_revision"]
        assert indexed[2] > indexed[1]
        assert answer()["floorplan_id"] == replaced["floorplan_id"]
    monkeypatch.setattr(StoredGrids, "prototypes", lambda *_: pytest.fail("read of the database"))
    # Again, from the prototype file.
    with start_app(tmp_path, request_deadline_s=60.0) as client:
        assert document_of(ask(client, venue_id, sphere, refine="none"))["floorplan_id"] == replaced["floorplan_id"]


NEVER = "0" * 32
BAD_FIELDS: dict[str, tuple[dict[str, str], str, str]] = {
    "neither": ({}, "floorplan_id", "is missing"),
    "both": ({"venue_id": NEVER, "floorplan_id": NEVER}, "floorplan_id", "set floorplan_id or venue_id, not both"),
    "level": ({"floorplan_id": NEVER, "level": "1"}, "floorplan_id", "level needs venue_id"),
    "level of none": ({"venue_id": NEVER, "level": "1001"}, "level", "at most 1000"),
    "posterior": ({"venue_id": NEVER, "include": "posterior"}, "include", "one plan"),
}


@pytest.mark.parametrize(("fields", "field", "message"), BAD_FIELDS.values(), ids=BAD_FIELDS.keys())
def test_query_needs_exactly_one_of_plan_and_venue(
    client: httpx.Client, sphere: bytes, fields: dict[str, str], field: str, message: str
) -> None:
    files = {"photo": ("p.jpg", sphere, "image/jpeg")}
    problem = assert_problem(client.post("/localise", data=fields, files=files), 422, "invalid-request")
    assert [fault["field"] for fault in problem["errors"]] == [field]
    assert message in problem["detail"]


def test_sequence_needs_exactly_one_of_plan_and_venue(client: httpx.Client, sphere: bytes) -> None:
    files = 2 * [("photo", ("p.jpg", sphere, "image/jpeg"))]
    for fields, kind in (({}, "is missing"), ({"venue_id": NEVER, "floorplan_id": NEVER}, "not both")):
        response = client.post("/localise/sequence", data=fields | {"motion": "turn"}, files=files)
        assert kind in assert_problem(response, 422, "invalid-request")["detail"]
    unknown = client.post("/localise/sequence", data={"venue_id": NEVER, "motion": "turn"}, files=files)
    assert_problem(unknown, 404, "unknown-venue")


def test_unsearchable_venue_is_an_error(client: httpx.Client, sphere: bytes) -> None:
    assert_problem(ask(client, NEVER, sphere), 404, "unknown-venue")
    assert_problem(ask(client, "no id", sphere), 404, "unknown-venue")
    problem = assert_problem(ask(client, venue_of(client), sphere), 409, "venue-unsearchable")
    assert "no floor plans" in problem["detail"]


def test_plans_with_too_low_ceilings_are_skipped(client: httpx.Client, flat: str, sphere: bytes) -> None:
    low = upload(client, {**STUDIO, "ceiling_height_m": 2.0})
    answer = ask(client, venue_of(client, flat, low), sphere, camera_height_m=2.1, refine="none").json()
    assert {entry["floorplan_id"] for entry in answer["plans"]} == {flat}
    assert "ceilings below camera_height_m" in answer["warnings"][0]
    assert_problem(ask(client, venue_of(client, low), sphere, camera_height_m=2.1), 422, "invalid-pose")


@pytest.mark.slow
def test_plans_that_are_not_ready_are_warned_about(
    start_app: StartApp, tmp_path: Path, sphere: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on, embed = threading.Event(), builder.embed

    def held(*arguments: Any, **options: Any) -> PoseGrid:
        go_on.wait(60.0)
        return embed(*arguments, **options)

    monkeypatch.setattr(builder, "embed", held)
    with start_app(tmp_path, request_deadline_s=5.0) as client:
        wait_for(lambda: client.get("/readyz").status_code == 200)
        ready, hall = upload(client), upload(client, HALL, wait=False)
        answer = document_of(ask(client, venue_of(client, ready, hall), sphere, refine="none"))
        assert answer["floorplan_id"] == ready
        assert answer["warnings"] == ["1 of the venue's 2 floor plans are preparing and were not searched"]
        waiting = ask(client, venue_of(client, hall), sphere, refine="none")
        assert "none of the 1 floor plans" in assert_problem(waiting, 503, "venue-not-ready")["detail"]
        assert int(waiting.headers["retry-after"]) >= 1
        go_on.set()


def test_deleted_plan_is_not_searched(client: httpx.Client, flat: str, sphere: bytes) -> None:
    leaving = upload(client, STUDIO)
    venue_id = venue_of(client, flat, leaving)
    assert len(ask(client, venue_id, sphere, refine="none").json()["plans"]) == 2
    client.delete(f"/floorplans/{leaving}")
    assert [entry["floorplan_id"] for entry in ask(client, venue_id, sphere, refine="none").json()["plans"]] == [flat]
