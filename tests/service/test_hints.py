"""Hints of a query: validation, and their effect on the search; source of its heading: request, compass or search."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import Posterior, Support
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import CameraHeight, Candidate, Hints, Near, Query
from lalaloc_core.localise.search.pipeline import Localisation
from lalaloc_core.render.sampling import PoseSet
from service.query.ground import Ground
from service.storage.records import PlanRecord
from tests.core.test_photo_sphere import xmp
from tests.painted import picture_file
from tests.service.conftest import FLAT, assert_problem, document_of, encode_picture, localise, upload
from tests.strategies import rectangle

APP_SETTINGS = {"compass_tolerance_deg": 15.0}
PLAN: dict[str, Any] = FLAT | {
    "rooms": [
        {"name": "Bedroom", "polygon": rectangle(4.0, 3.0)},
        {"name": "Bedroom", "polygon": rectangle(4.0, 3.0, corner=(5.0, 0.0))},
        {"name": "hall", "polygon": rectangle(9.0, 1.5, corner=(0.0, 4.0))},
    ]
}


@pytest.fixture(scope="module")
def plan_id(client: httpx.Client) -> str:
    return upload(client, PLAN)


@pytest.mark.parametrize(
    ("rooms", "possible"),
    [
        ("hall", {"hall"}),
        ("Bedroom", {"bedroom", "bedroom-2"}),
        (json.dumps(["bedroom-2"]), {"bedroom-2"}),
        (json.dumps(["hall", "bedroom"]), {"hall", "bedroom"}),
    ],
)
@pytest.mark.parametrize("refine", ["none", "lpo"])
def test_strict_rooms_exclude_others(
    client: httpx.Client, plan_id: str, sphere: bytes, rooms: str, possible: set[str], refine: str
) -> None:
    answer = document_of(localise(client, plan_id, sphere, rooms=rooms, strict="true", refine=refine))
    assert {candidate["room_id"] for candidate in answer["candidates"]} <= possible


def test_strict_point_bounds_all_candidates(client: httpx.Client, plan_id: str, sphere: bytes) -> None:
    fields = {"near": json.dumps({"x_m": 6.0, "y_m": 1.0}), "radius_m": 1.2}
    for candidate in localise(client, plan_id, sphere, strict="true", **fields).json()["candidates"]:
        assert np.hypot(candidate["position"]["x_m"] - 6.0, candidate["position"]["y_m"] - 1.0) <= 1.2 + 1e-3


@pytest.mark.parametrize(
    ("fields", "field", "message"),
    [
        ({"near": "7,2", "radius_m": 3}, "near", "not a JSON object"),
        ({"near": "[1, 2]", "radius_m": 3}, "near", "not a JSON object"),
        ({"near": "[" * 2000, "radius_m": 3}, "near", "not a JSON object"),
        ({"near": '{"x_m": 1}', "radius_m": 3}, "near.y_m", "is missing"),
        ({"near": '{"x_m": 1, "y_m": NaN}', "radius_m": 3}, "near.y_m", "must be finite"),
        ({"near": '{"x_m": 1, "y_m": 2}'}, "radius_m", "is missing"),
        ({"radius_m": 3}, "radius_m", "needs near"),
        ({"near": '{"x_m": 1, "y_m": 2}', "radius_m": 0}, "radius_m", "must be at least 0.1"),
        ({"near": '{"x_m": 1, "y_m": 2}', "radius_m": 1001}, "radius_m", "must be at most 1000"),
        ({"rooms": "[]"}, "rooms", "1 are needed"),
        ({"rooms": "[1]"}, "rooms.0", "valid string"),
        ({"rooms": '["hall"'}, "rooms", "not a JSON array"),
        ({"rooms": "hall", "strict": "maybe"}, "strict", "must be true or false"),
    ],
)
def test_invalid_hints_are_rejected(
    client: httpx.Client, plan_id: str, sphere: bytes, fields: dict[str, Any], field: str, message: str
) -> None:
    problem = assert_problem(localise(client, plan_id, sphere, **fields), 422, "invalid-request")
    assert [(fault["field"], message in fault["message"]) for fault in problem["errors"]] == [(field, True)]


@pytest.mark.parametrize(
    ("fields", "detail"),
    [
        ({"rooms": "attic"}, "rooms: the plan has no room 'attic'; its rooms are 'bedroom', 'bedroom-2', 'hall'"),
        ({"near": '{"x_m": -7, "y_m": 1}', "radius_m": 3}, "near: (-7, 1) is 7 m from the nearest room of the plan"),
        ({"near": '{"x_m": 4.5, "y_m": 1}', "radius_m": 0.51, "strict": "true"}, "strict: none of the"),
    ],
)
def test_hints_outside_the_plan_are_rejected(
    client: httpx.Client, plan_id: str, sphere: bytes, fields: dict[str, Any], detail: str
) -> None:
    assert detail in assert_problem(localise(client, plan_id, sphere, **fields), 422, "invalid-hint")["detail"]


def test_contradicted_hints_are_warned_about() -> None:
    plan = FloorPlan.from_dict(PLAN)
    query = Query(np.eye(1), np.zeros(1), 0.0, heading_known=True, camera_height=CameraHeight(1.5))
    answer = Candidate(1.0, 4.5, 2, 0.0, 0, 0.1, 0.2)
    posterior = Posterior(
        np.ones(1), 1.0, (1.0,), 1.0, Support(np.zeros(1, int), np.zeros((1, 2)), np.zeros(1), np.ones(1))
    )
    hints = Hints(near=Near(6.0, 4.5, 3.0), rooms=frozenset({0, 1}))
    found = Localisation(
        query=query, candidates=[answer], posterior=posterior, stage="lpo", signals={}, hints_missed=("near", "rooms")
    )
    now = datetime.now(UTC)
    record = PlanRecord(
        id="p", revision_id="r", revision=1, created_at=now, updated_at=now, tenant="t", plan=plan, failure=None
    )
    grid = PoseGrid(PoseSet(np.zeros((1, 2)), np.zeros(1, int)), None, np.ones((1, 8)), 1.0, 1.5)
    assert Ground.of_plan(record, grid, hints).hint_warnings(found) == [
        "near is within 3 m of (6, 4.5), which the photograph contradicts: the answer is 5.0 m from there",
        "rooms is 'bedroom', 'bedroom-2', which the photograph contradicts: the answer lies in room 'hall'",
    ]
    strict = Ground.of_plan(record, grid, replace(hints, strict=True))
    assert strict.hint_warnings(replace(found, hints_missed=("near",))) == [
        "near is within 3 m of (6, 4.5), which the photograph contradicts: the answer follows it because strict is set"
    ]


# Headings

NORTH_DEG = 30.0


def with_packet(**properties: object) -> bytes:
    picture = Image.open(io.BytesIO(encode_picture(512, 256, "PNG")))
    return picture_file(picture, "WEBP", lossless=True, xmp=xmp(**properties))


@pytest.fixture(scope="module")
def north(client: httpx.Client) -> str:
    return upload(client, FLAT | {"north_deg": NORTH_DEG})


def poses(response: httpx.Response) -> tuple[str, list[object]]:
    answer = document_of(response)
    return answer["heading_source"], [
        (candidate["position"], candidate["heading_deg"]) for candidate in answer["candidates"]
    ]


@pytest.mark.parametrize("compass_deg", [0.0, 100.0, 345.0])
def test_compass_is_used_if_north_is_known(client: httpx.Client, north: str, compass_deg: float) -> None:
    picture = with_packet(PoseHeadingDegrees=compass_deg)
    source, found = poses(localise(client, north, picture, refine="none"))
    assert source == "photograph"
    heading_deg = (compass_deg + NORTH_DEG) % 360.0
    given = localise(client, north, picture, refine="none", heading_deg=heading_deg, heading_tolerance_deg=15)
    assert poses(given) == ("given", found)


def test_compass_is_not_used_beside_a_heading_or_without_north(client: httpx.Client, north: str, flat: str) -> None:
    for plan_id, fields, source in ((north, {"heading_deg": 200}, "given"), (flat, {}, "searched")):
        with_compass = poses(localise(client, plan_id, with_packet(PoseHeadingDegrees=10), refine="none", **fields))
        assert with_compass[0] == source
        assert with_compass == poses(localise(client, plan_id, with_packet(), refine="none", **fields))


@pytest.mark.parametrize("properties", [{}, {"PoseHeadingDegrees": 400}, {"InitialViewHeadingDegrees": 90}])
def test_heading_is_searched_without_a_compass(client: httpx.Client, north: str, properties: dict[str, object]) -> None:
    assert poses(localise(client, north, with_packet(**properties), refine="none"))[0] == "searched"
