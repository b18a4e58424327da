"""The posterior of an answer, and the layout of a plan."""

from __future__ import annotations

import httpx
import numpy as np
import pytest

from lalaloc_core.floorplan import FloorPlan
from tests.service.conftest import FLAT, assert_problem, localise, upload

DOORS = [
    {"kind": "passage", "line": [[4, 0.5], [4, 1.5]], "head_m": 2.1},
    {"kind": "window", "line": [[7, 0], [8, 0]], "sill_m": 0.9, "head_m": 2.1},
]


def test_posterior_is_included_on_request(client: httpx.Client, sphere: bytes) -> None:
    plan_id = upload(client)
    answer = localise(client, plan_id, sphere, include="posterior", heading_deg=10.0).json()
    posterior = answer["posterior"]
    step_m = client.get(f"/floorplans/{plan_id}").json()["grid"]["step_m"]
    assert posterior["step_m"] == step_m
    assert len(posterior["x_m"]) == len(posterior["y_m"]) == len(posterior["probability"]) > 0
    assert sum(posterior["probability"]) == pytest.approx(1.0, abs=1e-3)
    assert min(posterior["probability"]) > 0.0
    plan = FloorPlan.from_dict(FLAT)
    places = np.array([posterior["x_m"], posterior["y_m"]]).T
    assert all(any(room.shape.covers(type(room.shape.centroid)(*place)) for room in plan.rooms) for place in places)
    assert localise(client, plan_id, sphere, heading_deg=10.0).json()["posterior"] is None


def test_unknown_include_is_rejected(client: httpx.Client, sphere: bytes) -> None:
    problem = assert_problem(localise(client, upload(client), sphere, include="grid"), 422, "invalid-request")
    (fault,) = problem["errors"]
    assert fault["field"] == "include"
    assert "posterior" in fault["message"]


def test_layout_has_walls_and_openings(client: httpx.Client) -> None:
    document = FLAT | {"openings": DOORS}
    plan_id = upload(client, document)
    layout = client.get(f"/floorplans/{plan_id}/layout").json()
    plan = FloorPlan.from_dict(document)
    assert layout["floorplan_id"] == plan_id
    assert [room["id"] for room in layout["rooms"]] == [room.id for room in plan.rooms]
    for drawn, room in zip(layout["rooms"], plan.rooms, strict=True):
        np.testing.assert_allclose(drawn["walls_m"], room.walls_m)
        assert drawn["ceiling_height_m"] == room.ceiling_height_m
    kitchen, living = layout["rooms"]
    assert [opening["kind"] for opening in kitchen["openings"]] == ["passage"]
    assert sorted(opening["kind"] for opening in living["openings"]) == ["passage", "window"]
    (window,) = (opening for opening in living["openings"] if opening["kind"] == "window")
    x0, y0, x1, y1 = living["walls_m"][window["wall"]]
    ends = sorted(x0 + share * (x1 - x0) for share in (window["start"], window["end"]))
    assert (y0, y1) == (0.0, 0.0)
    assert ends == pytest.approx([7.0, 8.0])
    assert (window["sill_m"], window["head_m"]) == (0.9, 2.1)
    assert kitchen["openings"][0]["sill_m"] is None


def test_layout_of_older_revision_is_available(client: httpx.Client) -> None:
    plan_id = upload(client)
    first = client.get(f"/floorplans/{plan_id}").json()["revision"]
    client.put(f"/floorplans/{plan_id}", json=FLAT | {"openings": DOORS}).raise_for_status()
    now = client.get(f"/floorplans/{plan_id}/layout")
    assert any(room["openings"] for room in now.json()["rooms"])
    before = client.get(f"/floorplans/{plan_id}/layout", params={"revision": first}).json()
    assert before["revision"] == first
    assert not any(room["openings"] for room in before["rooms"])
    assert (
        client.get(f"/floorplans/{plan_id}/layout", headers={"If-None-Match": now.headers["etag"]}).status_code == 304
    )
    assert_problem(client.get(f"/floorplans/{plan_id}/layout", params={"revision": "0" * 32}), 404, "unknown-revision")
    assert_problem(client.get("/floorplans/none/layout"), 404, "unknown-floorplan")
