"""Hints of queries about venues: validation, and their effect on the choice of plans and the search."""

from __future__ import annotations

import json
from typing import Any

import httpx
import numpy as np
import pytest

from lalaloc_core.floorplan.earth import Anchor
from service.venues import venue_plans
from tests.service.conftest import FLAT, assert_problem, document_of, upload
from tests.service.test_venue_queries import STUDIO, ask, venue_of

ANCHOR = {"latitude": 48.1372, "longitude": 11.5756}


def place(east_m: float, north_m: float = 0.0) -> dict[str, float]:
    """Return a place by its distance (m) from the anchor."""
    ((longitude, latitude),) = Anchor(**ANCHOR).to_earth(np.array([[east_m, north_m]]))
    return {"latitude": float(latitude), "longitude": float(longitude)}


@pytest.fixture(scope="module")
def storeys(client: httpx.Client) -> list[str]:
    """Upload three equal flats above each other and a studio 100 m to the east, all with anchors."""
    flats = [upload(client, FLAT | {"anchor": ANCHOR, "north_deg": 0, "name": f"{level}"}) for level in range(3)]
    return [*flats, upload(client, STUDIO | {"anchor": place(100.0), "north_deg": 0})]


@pytest.fixture(scope="module")
def venue_id(client: httpx.Client, storeys: list[str]) -> str:
    """Create a venue of these plans, on levels 0, 1, 2 and 3."""
    return venue_of(client, *storeys)


def answer_to(client: httpx.Client, venue_id: str, picture: bytes, **fields: Any) -> dict[str, Any]:
    return document_of(ask(client, venue_id, picture, **{"refine": "none", "top_k": 10, **fields}))


@pytest.fixture(params=["all", "chosen"])
def search(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Search all plans in full, or only the three most probable ones."""
    if request.param == "chosen":
        monkeypatch.setattr(venue_plans, "MAX_SEARCHED", 3)
    return request.param


@pytest.mark.parametrize("level", [0, 1, 2])
def test_level_distinguishes_equal_storeys(
    client: httpx.Client, venue_id: str, storeys: list[str], sphere: bytes, search: str, level: int
) -> None:
    answer = answer_to(client, venue_id, sphere, level=level)
    if answer["floorplan_id"] == storeys[3]:
        # This small model cannot tell the flats apart.
        assert answer["warnings"] == [f"level is {level}, which the photograph contradicts: the answer is on level 3"]
    found = [candidate["level"] for candidate in answer["candidates"] if candidate["floorplan_id"] != storeys[3]]
    assert found[0] == level


def test_strict_level_excludes_other_levels(
    client: httpx.Client, venue_id: str, storeys: list[str], sphere: bytes, search: str
) -> None:
    answer = answer_to(client, venue_id, sphere, level=3, strict="true")
    assert {candidate["floorplan_id"] for candidate in answer["candidates"]} == {storeys[3]}
    assert answer["level"] == 3.0


def test_near_on_earth_applies_to_all_storeys(
    client: httpx.Client, venue_id: str, storeys: list[str], sphere: bytes, search: str
) -> None:
    near = json.dumps(place(2.0, 1.5))
    answer = answer_to(client, venue_id, sphere, near=near, radius_m=1.0, strict="true")
    assert {candidate["floorplan_id"] for candidate in answer["candidates"]} == set(storeys[:3])
    for candidate in answer["candidates"]:
        assert np.hypot(candidate["position"]["x_m"] - 2.0, candidate["position"]["y_m"] - 1.5) <= 1.0 + 1e-3
    both = answer_to(client, venue_id, sphere, near=near, radius_m=1.0, strict="true", level=2)
    assert {candidate["floorplan_id"] for candidate in both["candidates"]} == {storeys[2]}
    east = answer_to(client, venue_id, sphere, near=json.dumps(place(103.0, 1.0)), radius_m=3.0, strict="true")
    assert {candidate["floorplan_id"] for candidate in east["candidates"]} == {storeys[3]}


def test_anchored_venue_accepts_points_in_its_frame(client: httpx.Client, sphere: bytes) -> None:
    own = upload(client, FLAT | {"anchor": place(0.0, -2.0), "north_deg": 0})
    venue_id = venue_of(client, upload(client), own, anchor=ANCHOR)
    fields = {"near": '{"x_m": 2, "y_m": 0.8}', "radius_m": 0.8, "strict": "true"}
    answer = answer_to(client, venue_id, sphere, **fields)
    for candidate in answer["candidates"]:
        # The second plan's own anchor places its origin 2 m further south.
        y_m = 2.8 if candidate["floorplan_id"] == own else 0.8
        assert np.hypot(candidate["position"]["x_m"] - 2.0, candidate["position"]["y_m"] - y_m) <= 0.8 + 1e-3
    assert {candidate["floorplan_id"] for candidate in answer["candidates"]} > {own}


def test_rooms_apply_to_all_plans_with_them(
    client: httpx.Client, venue_id: str, storeys: list[str], sphere: bytes
) -> None:
    answer = answer_to(client, venue_id, sphere, rooms="kitchen", strict="true")
    assert {candidate["room"] for candidate in answer["candidates"]} == {"kitchen"}
    several = answer_to(client, venue_id, sphere, rooms='["kitchen", "studio"]', strict="true")
    assert {candidate["room"] for candidate in several["candidates"]} <= {"kitchen", "studio"}


def test_plans_without_an_anchor_are_warned_about(client: httpx.Client, storeys: list[str], sphere: bytes) -> None:
    venue_id = venue_of(client, storeys[0], upload(client, STUDIO))
    fields = {"near": json.dumps(place(2.0, 1.5)), "radius_m": 5.0}
    free = answer_to(client, venue_id, sphere, **fields)
    assert "1 of the venue's 2 floor plans have no anchor and are not affected by near" in free["warnings"]
    strict = answer_to(client, venue_id, sphere, strict="true", **fields)
    expected = "1 of the venue's 2 floor plans have no anchor and were not searched, because near is strict"
    assert expected in strict["warnings"]
    assert {candidate["floorplan_id"] for candidate in strict["candidates"]} == {storeys[0]}


def test_room_search_in_some_plans_is_warned_about(
    client: httpx.Client, venue_id: str, sphere: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(venue_plans, "MAX_SEARCHED", 2)
    answer = answer_to(client, venue_id, sphere, rooms='["kitchen", "studio", "living room"]', level=0)
    assert "the hint rooms was applied to the 2 most probable of 4 floor plans" in answer["warnings"]
    elsewhere = answer_to(client, venue_id, sphere, rooms="attic")
    assert "the hint rooms was applied to the 2 most probable of 4 floor plans" in elsewhere["warnings"]


@pytest.mark.parametrize(
    ("fields", "detail"),
    [
        ({"level": 7}, "level: no floor plan of the venue is on level 7; its levels are 0, 1, 2, 3"),
        ({"near": '{"x_m": 1, "y_m": 1}', "radius_m": 3}, "the venue has no anchor"),
        ({"near": json.dumps(place(50.0)), "radius_m": 10}, "m from the nearest floor plan of the venue"),
        ({"rooms": "attic"}, "rooms: none of the 4 floor plans that are searched has a room 'attic'"),
        ({"rooms": "studio", "level": 0, "strict": "true"}, "strict: none of the"),
    ],
)
def test_hints_outside_the_venue_are_rejected(
    client: httpx.Client, venue_id: str, sphere: bytes, fields: dict[str, Any], detail: str
) -> None:
    assert detail in assert_problem(ask(client, venue_id, sphere, **fields), 422, "invalid-hint")["detail"]


def test_near_needs_an_anchor(client: httpx.Client, sphere: bytes) -> None:
    response = ask(client, venue_of(client, upload(client)), sphere, near=json.dumps(place(0.0)), radius_m=10)
    problem = assert_problem(response, 422, "invalid-hint")
    assert "neither the venue nor any of its floor plans has an anchor" in problem["detail"]
