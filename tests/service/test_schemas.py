"""Rounding of measured and computed numbers in answers."""

from __future__ import annotations

import json
import math

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.localise.answers.documents import Position
from service.schemas import CandidateAnswer
from tests.service.conftest import localise, upload


def _numbers(value: object) -> list[float]:
    if isinstance(value, dict):
        return [number for inner in value.values() for number in _numbers(inner)]
    if isinstance(value, list):
        return [number for inner in value for number in _numbers(inner)]
    return [value] if isinstance(value, float) else []


def test_answers_are_rounded(client: httpx.Client, sphere: bytes) -> None:
    third = [[0, 0], [4 / 3, 0], [4 / 3, 10 / 3], [0, 10 / 3]]
    plan_id = upload(client, {"ceiling_height_m": 2.5, "rooms": [{"name": "x", "polygon": third}]})
    answers = [localise(client, plan_id, sphere), client.get(f"/floorplans/{plan_id}"), client.get("/floorplans")]
    documents = [json.loads(answer.text) for answer in answers]
    # The plan itself is unchanged.
    assert documents[1].pop("plan")["rooms"][0]["polygon"] == third
    numbers = _numbers(documents)
    assert len(numbers) > 20
    assert [number for number in numbers if number != round(number, 6)] == []
    # Uploaded numbers are unchanged.
    assert client.get(f"/floorplans/{plan_id}/original").json()["rooms"][0]["polygon"] == third


@given(st.floats(0.0, 360.0, exclude_max=True), st.floats(-1e4, 1e4))
def test_rounding_stays_within_the_limits(heading_deg: float, x_m: float) -> None:
    made = CandidateAnswer(
        floorplan_id="0" * 32,
        level=None,
        position=Position(x_m=x_m, y_m=-1e-9),
        heading_deg=heading_deg,
        room="x",
        room_id="x",
        probability=None,
        cost=0.0,
        latent_distance=2.0,
        geopose=None,
    )
    assert 0.0 <= made.heading_deg < 360.0
    assert abs((made.heading_deg - heading_deg + 180.0) % 360.0 - 180.0) <= 0.005 + 1e-9
    assert made.position.x_m == pytest.approx(x_m, abs=0.0005 + 1e-9)
    assert math.copysign(1.0, made.position.y_m) == 1.0
