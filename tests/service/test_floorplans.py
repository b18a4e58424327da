"""Upload, listing and deletion of floor plans."""

from __future__ import annotations

import gzip
import io
import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import httpx
import pytest
import trimesh

from lalaloc_core.floorplan import FloorPlan
from tests.importers.test_fault_files import EXPECTED, REFUSED, content_of
from tests.service.conftest import FLAT, StartApp, assert_problem, document_of, localise, upload, wait_for
from tests.service.test_events import follow
from tests.strategies import rectangle


def _room(polygon: Any) -> dict[str, Any]:
    return {"ceiling_height_m": 2.5, "rooms": [{"name": "bath", "polygon": polygon}]}


# The core's tests have all faults; these are also ones of what is sent, and of the limits that a service sets.
BAD_PLANS = {
    "an integer beyond floats": (_room([[0, 0], [4, 0], [4, 10**400]]), "401 digits; the limit is 300"),
    "a list": ([1, 2], "must be an object"),
    "a lone surrogate": ({**FLAT, "name": "\ud800"}, "surrogates"),
    "too wide": (_room([[0, 0], [1600, 0], [1600, 1]]), "the limit is 1000 m (max_extent_m); check that the coord"),
}


@pytest.mark.parametrize("name", [*EXPECTED, *REFUSED])
def test_file_with_traits_of_real_ones_is_read_right_or_refused(client: httpx.Client, name: str) -> None:
    expected = EXPECTED.get(name)
    data = {} if expected is None else expected.options
    answer = client.post("/floorplans", files={"file": (name, content_of(name))}, data=data).json()
    if expected is None:
        assert re.search(REFUSED[name], answer["detail"])
    else:
        expected.check(answer["plan"], answer["import_report"])


@pytest.mark.parametrize(("plan", "message"), BAD_PLANS.values(), ids=BAD_PLANS.keys())
def test_invalid_plan_is_rejected_with_its_fault(client: httpx.Client, plan: Any, message: str) -> None:
    before = client.get("/floorplans").json()
    response = client.post("/floorplans", content=json.dumps(plan), headers={"content-type": "application/json"})
    assert message in assert_problem(response, 422, "invalid-floorplan")["detail"]
    assert client.get("/floorplans").json() == before


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_non_finite_coordinates_are_rejected(client: httpx.Client, number: str) -> None:
    body = json.dumps(_room([[0, 0], [4, 0], [4, "HERE"]])).replace('"HERE"', number)
    response = client.post("/floorplans", content=body, headers={"content-type": "application/json"})
    problem = assert_problem(response, 422, "invalid-floorplan")
    assert "finite" in problem["detail"]
    assert problem["room"] == "bath"


@pytest.mark.parametrize("body", [b"", b"  ", b"{", b"\xff\xfe\xfd", b"[" * 100_000], ids=repr)
def test_body_that_is_not_json_is_rejected(client: httpx.Client, body: bytes) -> None:
    response = client.post("/floorplans", content=body, headers={"content-type": "application/json"})
    assert_problem(response, 422, "invalid-floorplan")


@pytest.mark.parametrize("media", ["application/json", "multipart/form-data; boundary=x"])
def test_compressed_body_is_rejected(client: httpx.Client, media: str) -> None:
    headers = {"content-type": media, "content-encoding": "gzip"}
    response = client.post("/floorplans", content=gzip.compress(json.dumps(FLAT).encode()), headers=headers)
    assert "Content-Encoding 'gzip'" in assert_problem(response, 415, "unsupported-media")["detail"]
    assert response.headers["accept-encoding"] == "identity"
    plain = {"content-type": "application/json", "content-encoding": "identity"}
    assert client.post("/floorplans", content=json.dumps(FLAT).encode(), headers=plain).status_code == 201


@pytest.mark.parametrize("content_type", ["text/plain", "application/x-www-form-urlencoded", None])
def test_other_content_types_are_rejected(client: httpx.Client, content_type: str | None) -> None:
    headers = {} if content_type is None else {"content-type": content_type}
    response = client.post("/floorplans", content=json.dumps(FLAT).encode(), headers=headers)
    assert "application/json" in assert_problem(response, 415, "unsupported-media")["detail"]


def test_upload_returns_the_plan(client: httpx.Client) -> None:
    response = client.post("/floorplans", json=FLAT)
    assert response.status_code == 201
    plan = response.json()
    assert response.headers["location"] == f"/floorplans/{plan['id']}"
    assert plan["name"] == "Flat 3"
    assert plan["status"] in ("preparing", "ready")
    assert [room["name"] for room in plan["rooms"]] == ["kitchen", "living room"]
    assert [room["area_m2"] for room in plan["rooms"]] == [12.0, 24.0]
    assert [room["ceiling_height_m"] for room in plan["rooms"]] == [2.4, 2.5]
    assert plan["area_m2"] == 36.0
    assert plan["grid"]["step_m"] == 0.5
    assert plan["bounds"] == {"x_min_m": 0.0, "y_min_m": 0.0, "x_max_m": 9.0, "y_max_m": 6.0}


def test_plan_can_be_downloaded_and_uploaded_again(client: httpx.Client) -> None:
    openings = [{"kind": "window", "line": [[0.5, 0.0], [1.5, 0.0]], "sill_m": 0.9, "head_m": 2.0}]
    uploaded = client.post("/floorplans", json=FLAT | {"openings": openings, "north_deg": 30}).json()
    stored = client.get(f"/floorplans/{uploaded['id']}").json()
    plan = stored["plan"]
    assert plan["north_deg"] == 30
    assert [room["polygon"] for room in plan["rooms"]] == [
        room.polygon_m.tolist() for room in FloorPlan.from_dict(FLAT).rooms
    ]
    assert [{key: opening[key] for key in openings[0]} for opening in plan["openings"]] == openings
    assert [room["id"] for room in stored["rooms"]] == [room["id"] for room in plan["rooms"]]
    again = client.post("/floorplans", json=plan).json()
    assert again["plan"] == plan
    for made in (uploaded, again):
        client.delete(f"/floorplans/{made['id']}")


def test_json_file_equals_json_body(client: httpx.Client) -> None:
    content = json.dumps(FLAT).encode()
    files = {"file": ("flat.json", content, "application/octet-stream")}
    plan = document_of(client.post("/floorplans", files=files), 201)
    assert client.get(f"/floorplans/{plan['id']}/original").content == content
    assert plan["rooms"] == client.post("/floorplans", json=FLAT).json()["rooms"]


def test_unknown_and_missing_parts_are_rejected(client: httpx.Client) -> None:
    file = ("flat.json", json.dumps(FLAT).encode())
    response = client.post("/floorplans", files={"file": file}, data={"colour": "2"})
    (fault,) = assert_problem(response, 422, "invalid-request")["errors"]
    assert fault["field"] == "colour"
    assert fault["message"].startswith("unknown part; known: ceiling_height_m, crop, file, known_distance, layers")
    missing = assert_problem(client.post("/floorplans", files={"plan": file}), 422, "invalid-request")
    assert {"field": "file", "message": "is missing"} in missing["errors"]
    twice = client.post("/floorplans", files=[("file", file), ("file", file)])
    assert "more than once" in assert_problem(twice, 422, "invalid-request")["detail"]


@pytest.mark.parametrize("content_type", ["multipart/form-data", "multipart/form-data; boundary=x"])
def test_malformed_form_is_rejected(client: httpx.Client, content_type: str) -> None:
    response = client.post("/floorplans", content=b"no form", headers={"content-type": content_type})
    assert_problem(response, 400, "malformed-request")


def test_deleted_plan_is_not_found(client: httpx.Client) -> None:
    plan_id = upload(client)
    assert client.delete(f"/floorplans/{plan_id}").status_code == 204
    assert_problem(client.delete(f"/floorplans/{plan_id}"), 404, "unknown-floorplan")
    for path in ("", "/original", "/preview.svg", "/mesh.glb"):
        assert_problem(client.get(f"/floorplans/{plan_id}{path}"), 404, "unknown-floorplan")


def test_preview_and_mesh_have_their_media_types(client: httpx.Client) -> None:
    plan_id = upload(client, wait=False)
    drawing = client.get(f"/floorplans/{plan_id}/preview.svg", params={"x_m": 1, "y_m": 2, "heading_deg": 30})
    assert drawing.headers["content-type"].startswith("image/svg+xml")
    assert ElementTree.fromstring(drawing.content).tag.endswith("svg")
    assert 'class="camera"' in drawing.text
    mesh = client.get(f"/floorplans/{plan_id}/mesh.glb")
    assert mesh.headers["content-type"] == "model/gltf-binary"
    assert trimesh.load(io.BytesIO(mesh.content), file_type="glb")
    sure = {"x_m": 1, "y_m": 2, "covariance_m2": [0.04, 0.01, 0.09]}
    assert "<ellipse" in client.get(f"/floorplans/{plan_id}/preview.svg", params=sure).text
    for numbers in ([0.04, 0.01], [-0.04, 0.0, 0.09], [0.04, 0.1, 0.09]):
        wrong = client.get(f"/floorplans/{plan_id}/preview.svg", params=sure | {"covariance_m2": numbers})
        assert assert_problem(wrong, 422, "invalid-request")["errors"][0]["field"].startswith("covariance_m2")
    half = client.get(f"/floorplans/{plan_id}/preview.svg", params={"x_m": 1})
    assert_problem(half, 422, "invalid-request")
    far = client.get(f"/floorplans/{plan_id}/preview.svg", params={"x_m": 1, "y_m": 1e6})
    (fault,) = assert_problem(far, 422, "invalid-request")["errors"]
    assert (fault["field"], "is 1e+06; it must lie between " in fault["message"]) == ("y_m", True)


def test_failed_grid_is_reported_and_retried_at_start(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    with start_app(tmp_path) as client:
        plan_id = upload(client)
    # With a finer grid the stored plan exceeds the limit, so its grid cannot be computed.
    with start_app(tmp_path, grid_step_m=0.25, max_grid_poses=146) as client:
        wait_for(lambda: client.get(f"/floorplans/{plan_id}").json()["status"] == "failed")
        assert "the limit is 146" in client.get(f"/floorplans/{plan_id}").json()["reason"]
        assert_problem(localise(client, plan_id, sphere), 409, "floorplan-failed")
        name, event = follow(client, plan_id)[-1]
        assert name == event["status"] == "failed"
        assert "the limit is 146" in event["reason"]
    with start_app(tmp_path, grid_step_m=0.25) as client:
        wait_for(lambda: client.get(f"/floorplans/{plan_id}").json()["status"] == "ready")
        assert client.get(f"/floorplans/{plan_id}").json()["reason"] is None


def test_assumed_ceiling_is_not_stored(client: httpx.Client) -> None:
    plan = client.post("/floorplans", json={"rooms": [{"name": "den", "polygon": rectangle(4.0, 4.0)}]}).json()
    assert plan["warnings"] == ["no ceiling height is given; 2.5 m is assumed (set ceiling_height_m)"]
    assert "ceiling_height_m" not in plan["plan"]["rooms"][0]
    assert plan["plan"].get("ceiling_height_m") is None
    assert plan["rooms"][0]["ceiling_height_m"] == 2.5
    # The plan's height applies to all rooms without their own.
    low = plan["plan"] | {"ceiling_height_m": 2.2}
    changed = client.put(f"/floorplans/{plan['id']}", json=low).json()
    assert (changed["warnings"], changed["rooms"][0]["ceiling_height_m"]) == ([], 2.2)
