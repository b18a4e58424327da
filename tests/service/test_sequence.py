"""Queries of several photographs of one turn: validation and answers."""

from __future__ import annotations

import json
from typing import Any

import httpx
import numpy as np
import pytest

from lalaloc_core.floorplan import FloorPlan
from tests.service.conftest import FLAT, assert_problem, document_of, encode_picture, localise_turn

APP_SETTINGS = {"max_sequence_photographs": 30, "max_sequence_bytes": 300_000}


@pytest.fixture(scope="module")
def pictures() -> list[bytes]:
    return [encode_picture(256, 128, kind) for kind in ("JPEG", "PNG", "WEBP")]


def ask(client: httpx.Client, plan_id: str, pictures: list[bytes], **fields: Any) -> httpx.Response:
    texts = {name: json.dumps(value) if isinstance(value, list) else value for name, value in fields.items()}
    return localise_turn(client, plan_id, *pictures, **texts)


def answer_to(client: httpx.Client, plan_id: str, pictures: list[bytes], **fields: Any) -> dict[str, Any]:
    return document_of(ask(client, plan_id, pictures, **fields))


@pytest.mark.parametrize("refine", ["none", "lpo"])
def test_every_sphere_has_a_pose_in_the_plan(
    client: httpx.Client, flat: str, pictures: list[bytes], refine: str
) -> None:
    answer = answer_to(client, flat, pictures, refine=refine, top_k=3)
    # This app has no LPO workers, so the best stage is the grid.
    assert answer["stage"] == "retrieval"
    assert answer["floorplan_id"] == flat
    assert len(answer["poses"]) == 3
    plan = FloorPlan.from_dict(FLAT)
    for pose in answer["poses"]:
        assert pose["position"] == pose["candidates"][0]["position"]
        assert 1 <= len(pose["candidates"]) <= 3
        for candidate in pose["candidates"]:
            position_m = np.array([[candidate["position"]["x_m"], candidate["position"]["y_m"]]])
            assert plan.rooms[int(plan.room_index_at(position_m)[0])].id == candidate["room_id"]
        assert pose["heading_source"] == "searched"


def test_given_headings_are_followed(client: httpx.Client, flat: str, pictures: list[bytes]) -> None:
    fields = {"headings_deg": [10, None, 200], "heading_tolerance_deg": 5, "refine": "none"}
    poses = answer_to(client, flat, pictures, **fields)["poses"]
    assert poses[1]["heading_source"] == "searched"
    for pose, given in ((poses[0], 10.0), (poses[2], 200.0)):
        if pose["heading_source"] == "given":
            assert abs((pose["heading_deg"] - given + 180.0) % 360.0 - 180.0) < 25.0  # to the next sector
        else:
            assert "which the photograph contradicts" in pose["warnings"][0]


def test_long_turn_is_localised(client: httpx.Client, flat: str, pictures: list[bytes]) -> None:
    assert len(answer_to(client, flat, 10 * pictures, refine="none")["poses"]) == 30


@pytest.mark.parametrize(
    "walk", [{"motion": "walk"}, {"motion": ""}, {"motions": [{}]}, {"camera_heights_m": [1.5, 1.6]}]
)
def test_walk_is_refused_by_name(client: httpx.Client, flat: str, pictures: list[bytes], walk: dict[str, Any]) -> None:
    problem = assert_problem(ask(client, flat, pictures[:2], **walk), 422, "invalid-request")
    assert [fault["field"] for fault in problem["errors"]] == [*walk]
    assert "send them to a session (POST /sessions), or to an album (POST /albums)" in problem["detail"]


@pytest.mark.parametrize(
    ("count", "fields", "field", "message"),
    [
        (1, {}, "photo", "is given 1 times, 2 to 30 are needed (LALALOC_MAX_SEQUENCE_PHOTOGRAPHS)"),
        (31, {}, "photo", "is given 31 times, 2 to 30 are needed"),
        (40, {}, "photo", "is given more than 30 times, 2 to 30 are needed (LALALOC_MAX_SEQUENCE_PHOTOGRAPHS)"),
        (2, {"headings_deg": [1.0]}, "headings_deg", "has 1 items, 2 photographs need 2"),
        (2, {"headings_deg": [400, None]}, "headings_deg.0", "must be at most 360"),
        (2, {"heading_tolerance_deg": 5}, "heading_tolerance_deg", "needs headings_deg"),
        (2, {"refine": "vdr"}, "refine", "must be 'none' or 'lpo'"),
        (2, {"top_k": 99}, "top_k", "the limit is 10 (max_top_k)"),
        (2, {"heading_deg": 5}, "heading_deg", "unknown part"),
    ],
)
def test_invalid_sequence_is_rejected(
    client: httpx.Client, flat: str, sphere: bytes, count: int, fields: dict[str, Any], field: str, message: str
) -> None:
    problem = assert_problem(ask(client, flat, [sphere] * count, **fields), 422, "invalid-request")
    assert [(fault["field"], message in fault["message"]) for fault in problem["errors"]] == [(field, True)]


def test_invalid_sphere_and_sequence_limits_are_refused(client: httpx.Client, flat: str, sphere: bytes) -> None:
    problem = assert_problem(ask(client, flat, [sphere, bytes(370_000)]), 413, "upload-too-large")
    assert "LALALOC_MAX_SEQUENCE_BYTES" in problem["detail"]
    limits = client.get("/limits").json()
    assert (limits["max_sequence_photographs"], limits["max_sequence_bytes"]) == (30, 300_000)
    assert_problem(ask(client, flat, [sphere, b"no picture"]), 422, "invalid-photograph")
    assert_problem(ask(client, "f" * 32, [sphere] * 2), 404, "unknown-floorplan")
