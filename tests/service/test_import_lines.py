"""Imports whose steps are sent as lines of JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import pytest

from benchmarks.plan_drawing import draw_plan
from tests.service.conftest import FLAT, StartApp, assert_problem, connection_to, lines_of, wait_for
from tests.service.test_plan_files import plan_file
from tests.service.test_venue_levels import geojson

_WITHOUT_SCALE = b'<svg xmlns="http://www.w3.org/2000/svg"><rect width="4" height="3"/></svg>'
LINES = {"Accept": "application/x-ndjson"}


@pytest.fixture(scope="module")
def picture() -> tuple[bytes, dict[str, str]]:
    """Return a drawn plan as PNG, and the option with its scale."""
    drawn = draw_plan("thick", 0)
    return drawn.png(), {"metres_per_pixel": str(drawn.metres_per_pixel)}


def send(
    client: httpx.Client, path: str, content: bytes, fields: dict[str, str] | None = None, key: str | None = None
) -> list[dict[str, Any]]:
    """Upload a file; return the lines of the answer."""
    files = {"file": ("plan", content)}
    headers = LINES | ({} if key is None else {"Idempotency-Key": key})
    return lines_of(client.post(path, files=files, data=fields or {}, headers=headers))


def test_steps_of_a_picture_precede_the_plan(client: httpx.Client, picture: tuple[bytes, dict[str, str]]) -> None:
    *steps, last = send(client, "/floorplans", *picture)
    names = [line["step"] for line in steps]
    assert names[0] == "waiting for a worker"
    # Short steps can be left out; the texts take most of the time.
    assert "reading texts" in names
    assert last["status"] == 201
    stored = client.get(f"/floorplans/{last['answer']['id']}")
    assert (last["etag"], last["answer"]) == (stored.headers["etag"], stored.json())


def test_levels_of_a_venue_are_counted(client: httpx.Client) -> None:
    *steps, last = send(client, "/venues", geojson())
    assert last["status"] == 201
    assert len(client.get(f"/venues/{last['answer']['id']}/plans").json()["plans"]) == 2
    assert {(line["done"], line["total"]) for line in steps if "total" in line} <= {(0, 2), (1, 2)}


def test_refusal_is_the_last_line_or_precedes_them(client: httpx.Client) -> None:
    *steps, last = send(client, "/floorplans", _WITHOUT_SCALE)
    alone = client.post("/floorplans", files={"file": ("plan", _WITHOUT_SCALE)})
    problem = assert_problem(alone, 422, "invalid-floorplan")
    assert steps
    assert last["status"] == 422
    assert last["problem"] | {"request_id": problem["request_id"]} == problem
    response = client.post("/floorplans", files={"file": ("plan", b"x")}, data={"units": "cubits"}, headers=LINES)
    assert_problem(response, 422, "invalid-request")


def test_native_plan_and_venue_of_stored_plans_have_answers_as_before(client: httpx.Client) -> None:
    response = client.post("/floorplans", json=FLAT, headers=LINES)
    *_, last = map(json.loads, response.text.splitlines())
    assert (last["status"], last["answer"]["name"]) == (201, FLAT["name"])
    venue = client.post("/venues", json={"plans": [{"floorplan_id": last["answer"]["id"]}]}, headers=LINES)
    assert (venue.status_code, venue.headers["content-type"]) == (201, "application/json")


def test_json_is_the_default(client: httpx.Client) -> None:
    for accept in ("*/*", "application/json, application/x-ndjson", "application/x-ndjson;q=0.5, application/json"):
        response = client.post("/floorplans", json=FLAT, headers={"Accept": accept})
        assert (response.status_code, response.json()["name"]) == (201, FLAT["name"])


def test_same_key_stores_the_plan_once_with_and_without_lines(client: httpx.Client) -> None:
    content, key = plan_file("svg"), "lines-1"
    *_, first = send(client, "/floorplans", content, key=key)
    *_, again = send(client, "/floorplans", content, key=key)
    assert "replayed" not in first
    assert again == first | {"replayed": True}
    alone = client.post("/floorplans", files={"file": ("plan", content)}, headers={"Idempotency-Key": key})
    assert (alone.status_code, alone.json()) == (201, first["answer"])
    refusals = [send(client, "/floorplans", b"%PDF-1.4", key="lines-2")[-1] for _ in range(2)]
    assert [line["status"] for line in refusals] == [422, 422]
    assert refusals[1] == refusals[0] | {"replayed": True}


@pytest.mark.slow
def test_plan_of_a_client_that_left_is_stored(
    start_app: StartApp, tmp_path: Path, picture: tuple[bytes, dict[str, str]]
) -> None:
    form: dict[str, Any] = {"files": {"file": ("plan", picture[0])}, "data": picture[1]}
    with start_app(tmp_path) as own:
        request = own.build_request("POST", "/floorplans", headers=LINES, **form)
        head = "".join(f"{name}: {value}\r\n" for name, value in request.headers.items())
        with connection_to(own) as connection:
            connection.sendall(f"POST /floorplans HTTP/1.1\r\n{head}\r\n".encode() + request.read())
            received = b""
            while b"reading" not in received and b"opening" not in received:
                received += connection.recv(65_536)
        wait_for(lambda: len(own.get("/floorplans").json()["floorplans"]) == 1)
        wait_for(lambda: own.get("/readyz").status_code == 200)
