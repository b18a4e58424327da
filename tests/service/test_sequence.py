"""Queries of several panoramas: validation and answers."""

from __future__ import annotations

import json
import math
from typing import Any

import httpx
import numpy as np
import pytest

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.sequence import Motion
from service.schemas import SequenceForm
from service.schemas.sequence import StatedMotion
from tests.service.conftest import FLAT, assert_problem, encode_picture, localise, upload

MOTION = {"distance_m": 1.5, "distance_std_m": 0.1, "turn_deg": 30, "turn_std_deg": 3}


@pytest.fixture(scope="module")
def app_settings() -> dict[str, Any]:
    return {"max_sequence_photographs": 30, "max_sequence_bytes": 300_000}


@pytest.fixture(scope="module")
def plan_id(client: httpx.Client) -> str:
    return upload(client)


@pytest.fixture(scope="module")
def pictures() -> list[bytes]:
    return [encode_picture(256, 128, kind) for kind in ("JPEG", "PNG", "WEBP")]


def ask(client: httpx.Client, plan_id: str, pictures: list[bytes], **fields: Any) -> httpx.Response:
    data = {"floorplan_id": plan_id} | {
        name: json.dumps(value) if isinstance(value, list) else str(value) for name, value in fields.items()
    }
    files = [("panorama", ("p.jpg", picture, "image/jpeg")) for picture in pictures]
    return client.post("/localise/sequence", data=data, files=files)


def answer_to(client: httpx.Client, plan_id: str, pictures: list[bytes], **fields: Any) -> dict[str, Any]:
    response = ask(client, plan_id, pictures, **fields)
    assert response.status_code == 200, response.text
    return response.json()


@pytest.mark.parametrize("refine", ["none", "lpo"])
def test_every_panorama_has_a_pose_in_the_plan(
    client: httpx.Client, plan_id: str, pictures: list[bytes], refine: str
) -> None:
    answer = answer_to(client, plan_id, pictures, motions=[MOTION, None], refine=refine, top_k=3)
    # This app has no LPO workers, so the best stage is the grid.
    assert answer["stage"] == "retrieval"
    assert answer["floorplan_id"] == plan_id
    assert len(answer["poses"]) == 3
    plan = FloorPlan.from_dict(FLAT)
    for pose in answer["poses"]:
        assert pose["position"] == pose["candidates"][0]["position"]
        assert 1 <= len(pose["candidates"]) <= 3
        for candidate in pose["candidates"]:
            position_m = np.array([[candidate["position"]["x_m"], candidate["position"]["y_m"]]])
            assert plan.rooms[int(plan.room_index_at(position_m)[0])].id == candidate["room_id"]
        assert pose["heading_source"] == "searched"


def test_exact_motion_is_followed(client: httpx.Client, plan_id: str, pictures: list[bytes]) -> None:
    sharp = {"distance_m": 2.0, "distance_std_m": 0.01, "turn_deg": 90, "turn_std_deg": 1}
    answer = answer_to(client, plan_id, pictures[:2], motions=[sharp], refine="none")
    first, second = answer["poses"]
    away_m = math.dist(*(tuple(pose["position"].values()) for pose in (first, second)))
    turned_deg = (second["heading_deg"] - first["heading_deg"]) % 360.0
    if not answer["warnings"]:
        assert away_m == pytest.approx(2.0, abs=1.1)
        assert turned_deg == pytest.approx(90.0, abs=25.0)
    else:
        assert "motions[0] (distance_m 2, turn_deg 90" in answer["warnings"][0]


def test_sequence_without_motions_equals_single_answers(
    client: httpx.Client, plan_id: str, pictures: list[bytes]
) -> None:
    fields = {"camera_height_m": 1.5, "camera_height_std_m": 0, "refine": "none"}
    together = answer_to(client, plan_id, pictures, **fields)["poses"]
    for picture, pose in zip(pictures, together, strict=True):
        response = localise(client, plan_id, picture, **fields)
        assert response.status_code == 200, response.text
        alone = response.json()
        assert pose["cost"] == pytest.approx(alone["cost"], abs=1e-3)
        # A room with half-turn symmetry has two equally good candidates.
        best = [
            candidate
            for candidate in alone["candidates"]
            if candidate["cost"] == pytest.approx(alone["cost"], abs=1e-4)
        ]
        assert len(best) <= 2
        assert (pose["position"], pose["heading_deg"]) in [
            (candidate["position"], candidate["heading_deg"]) for candidate in best
        ]


def test_given_headings_are_followed(client: httpx.Client, plan_id: str, pictures: list[bytes]) -> None:
    fields = {"headings_deg": [10, None, 200], "heading_tolerance_deg": 5, "refine": "none"}
    poses = answer_to(client, plan_id, pictures, **fields)["poses"]
    assert poses[1]["heading_source"] == "searched"
    for pose, given in ((poses[0], 10.0), (poses[2], 200.0)):
        if pose["heading_source"] == "given":
            assert abs((pose["heading_deg"] - given + 180.0) % 360.0 - 180.0) < 25.0  # to the next sector
        else:
            assert "which the panorama contradicts" in pose["warnings"][0]


def test_each_photograph_can_have_a_camera_height(client: httpx.Client, plan_id: str, pictures: list[bytes]) -> None:
    common = answer_to(client, plan_id, pictures, camera_height_m=1.2, refine="none")
    for heights_m in ([1.2, 1.2, 1.2], [1.2, None, 1.2]):
        each = answer_to(client, plan_id, pictures, camera_height_m=1.2, camera_heights_m=heights_m, refine="none")
        assert each["poses"] == common["poses"]
    exact = {"camera_height_m": 1.2, "camera_height_std_m": 0, "refine": "none"}
    poses = answer_to(client, plan_id, pictures, camera_heights_m=[None, 1.6, 0.9], **exact)["poses"]
    assert [pose["camera_height_m"] for pose in poses] == [1.2, 1.6, 0.9]
    alone = localise(client, plan_id, pictures[1], **(exact | {"camera_height_m": 1.6})).json()
    assert poses[1]["cost"] == pytest.approx(alone["cost"], abs=1e-3)
    refused = ask(client, plan_id, pictures, camera_heights_m=[None, 2.45, 0.9])
    assert "camera_height_m is 2.45" in assert_problem(refused, 422, "invalid-pose")["detail"]
    plan = upload(client, {name: value for name, value in FLAT.items() if name != "camera_height_m"})
    refused = assert_problem(ask(client, plan, pictures, camera_heights_m=[None, 1.6, 0.9]), 422, "invalid-pose")
    assert "give all heights" in refused["detail"]
    assert len(answer_to(client, plan, pictures, camera_heights_m=[1.2, 1.6, 0.9])["poses"]) == 3


def test_long_sequence_is_localised(client: httpx.Client, plan_id: str, pictures: list[bytes]) -> None:
    motions = 27 * [MOTION | {"distance_m": 0.0, "direction_deg": 10.0, "direction_std_deg": 20.0}] + 2 * [None]
    answer = answer_to(client, plan_id, 10 * pictures, motions=motions, refine="none")
    assert len(answer["poses"]) == 30


@pytest.mark.parametrize(
    ("count", "fields", "field", "message"),
    [
        (1, {}, "photo", "is given 1 times, 2 to 30 are needed (LALALOC_MAX_SEQUENCE_PHOTOGRAPHS)"),
        (31, {}, "photo", "is given 31 times, 2 to 30 are needed"),
        (40, {}, "photo", "is given more than 30 times, 2 to 30 are needed (LALALOC_MAX_SEQUENCE_PHOTOGRAPHS)"),
        (3, {"motions": [MOTION]}, "motions", "has 1 items, 3 photographs need 2"),
        (2, {"headings_deg": [1.0]}, "headings_deg", "has 1 items, 2 photographs need 2"),
        (2, {"camera_heights_m": [1.5]}, "camera_heights_m", "has 1 items, 2 photographs need 2"),
        (2, {"camera_heights_m": [1.5, -1]}, "camera_heights_m.1", "must be at least"),
        (2, {"camera_heights_m": [1.5, None], "motion": "turn"}, "camera_heights_m", "send camera_height_m"),
        (2, {"motions": "{}"}, "motions", "not a JSON array"),
        (2, {"motions": "[" * 2000}, "motions", "not a JSON array"),
        (2, {"motions": [MOTION | {"distance_m": -1}]}, "motions.0.distance_m", "must be at least 0"),
        (2, {"motions": [MOTION | {"distance_std_m": 0}]}, "motions.0.distance_std_m", "must be at least 0.001"),
        (2, {"motions": [MOTION | {"far": 1}]}, "motions.0.far", "Extra inputs"),
        (2, {"motions": [{"direction_deg": 3}]}, "motions.0.direction_deg", "needs distance_m"),
        (2, {"headings_deg": [400, None]}, "headings_deg.0", "must be at most 360"),
        (2, {"heading_tolerance_deg": 5}, "heading_tolerance_deg", "needs headings_deg"),
        (2, {"refine": "vdr"}, "refine", "must be 'none' or 'lpo'"),
        (2, {"top_k": 99}, "top_k", "the limit is 10 (max_top_k)"),
        (2, {"heading_deg": 5}, "heading_deg", "unknown part"),
    ],
)
def test_invalid_sequence_is_rejected(
    client: httpx.Client, plan_id: str, panorama: bytes, count: int, fields: dict[str, Any], field: str, message: str
) -> None:
    problem = assert_problem(ask(client, plan_id, [panorama] * count, **fields), 422, "invalid-request")
    assert [(fault["field"], message in fault["message"]) for fault in problem["errors"]] == [(field, True)]


def test_invalid_panorama_is_rejected(client: httpx.Client, plan_id: str, panorama: bytes) -> None:
    assert_problem(ask(client, plan_id, [panorama, b"no picture"]), 422, "invalid-panorama")
    assert_problem(ask(client, "f" * 32, [panorama] * 2), 404, "unknown-floorplan")


def test_sequence_limits_are_enforced_and_reported(client: httpx.Client, plan_id: str, panorama: bytes) -> None:
    problem = assert_problem(ask(client, plan_id, [panorama, bytes(370_000)]), 413, "upload-too-large")
    assert "LALALOC_MAX_SEQUENCE_BYTES" in problem["detail"]
    limits = client.get("/limits").json()
    assert (limits["max_sequence_photographs"], limits["max_sequence_bytes"]) == (30, 300_000)


def test_stated_motion_is_parsed() -> None:
    stated = StatedMotion(**MOTION, direction_deg=-45, direction_std_deg=2)
    assert stated.motion == Motion(
        distance_m=1.5,
        distance_std_m=0.1,
        turn=math.radians(30),
        turn_std=math.radians(3),
        direction=math.radians(-45),
        direction_std=math.radians(2),
    )
    assert SequenceForm.model_validate({"floorplan_id": "p"}).steps(3) == [Motion(), Motion()]
