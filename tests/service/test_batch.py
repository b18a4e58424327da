"""Batches: lines in order, problems per photograph, limits, clients that leave or do not read."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.http.representations import LinesResponse
from service.storage.store import Store
from tests.service.conftest import StartApp, assert_problem, lines_of, localise, upload, wait_for
from tests.service.test_security import bearer, make_key

APP_SETTINGS = {"max_batch_photographs": 30, "max_sequence_bytes": 4_000_000, "max_photograph_bytes": 500_000}


def ask(client: httpx.Client, plan_id: str, pictures: list[bytes], **fields: str) -> httpx.Response:
    files = [("photo", (f"{number}.jpg", picture, "image/jpeg")) for number, picture in enumerate(pictures)]
    return client.post("/localise/batch", data={"floorplan_id": plan_id, "refine": "none"} | fields, files=files)


def test_photographs_are_answered_in_order_and_alone(client: httpx.Client, flat: str, sphere: bytes) -> None:
    lines = lines_of(ask(client, flat, [sphere, b"no picture", bytes(500_001), sphere], heading_deg="90"))
    found = [(line["index"], line["name"], line["status"]) for line in lines]
    assert found == [(0, "0.jpg", 200), (1, "1.jpg", 422), (2, "2.jpg", 413), (3, "3.jpg", 200)]
    assert lines[1]["problem"]["type"] == "urn:lalaloc:problem:invalid-photograph"
    assert "LALALOC_MAX_PHOTOGRAPH_BYTES" in lines[2]["problem"]["detail"]
    alone = localise(client, flat, sphere, refine="none", heading_deg=90).json()
    for line in (lines[0], lines[3]):
        assert line["answer"]["position"] == alone["position"]
        assert line["answer"]["heading_source"] == alone["heading_source"]


def test_batch_searches_a_venue(client: httpx.Client, flat: str, sphere: bytes) -> None:
    venue = client.post("/venues", json={"plans": [{"floorplan_id": flat, "level": 2}]}).json()
    files = [("photo", ("p.jpg", sphere, "image/jpeg"))]
    response = client.post("/localise/batch", data={"venue_id": venue["id"], "refine": "none"}, files=files)
    assert [line["answer"]["level"] for line in lines_of(response)] == [2]


@pytest.mark.parametrize("count", [31, 40])
def test_number_of_photographs_is_limited(client: httpx.Client, flat: str, count: int) -> None:
    problem = assert_problem(ask(client, flat, count * [b"x"]), 422, "invalid-request")
    assert "1 to 30 are needed (LALALOC_MAX_BATCH_PHOTOGRAPHS)" in problem["errors"][0]["message"]
    assert client.get("/limits").json()["max_batch_photographs"] == 30


def test_refusals_of_the_whole_batch_precede_the_lines(client: httpx.Client, flat: str, sphere: bytes) -> None:
    assert_problem(ask(client, "f" * 32, [sphere]), 404, "unknown-floorplan")
    assert_problem(ask(client, flat, 9 * [bytes(480_000)]), 413, "upload-too-large")
    assert_problem(ask(client, flat, [sphere], heading_deg="x"), 422, "invalid-request")
    # An error about the plan is that of all photographs.
    lines = lines_of(ask(client, flat, 5 * [sphere], rooms="attic"))
    assert {line["problem"]["type"] for line in lines} == {"urn:lalaloc:problem:invalid-hint"}


@pytest.mark.one_replica
def test_client_that_leaves_ends_the_batch(client: httpx.Client, flat: str, sphere: bytes) -> None:
    def metric(name: str) -> float:
        lines = client.get("/metrics").text.splitlines()
        return sum(float(line.split()[-1]) for line in lines if line.startswith(name))

    before = metric("lalaloc_localise_answers_total")
    files = [("photo", ("p.jpg", sphere, "image/jpeg"))] * 30
    with client.stream("POST", "/localise/batch", data={"floorplan_id": flat}, files=files) as response:
        assert json.loads(next(response.iter_lines()))["index"] == 0
    wait_for(lambda: metric("lalaloc_requests_in_flight") == 0)
    answered = metric("lalaloc_localise_answers_total") - before
    assert 1 <= answered < 30


@pytest.mark.one_replica
def test_each_photograph_counts_for_the_rate_limit(
    start_app: StartApp, app_store: Store, tmp_path: Path, sphere: bytes
) -> None:
    with start_app(tmp_path, api_keys=True, rate_per_minute=8, rate_burst=0) as client:
        client.headers.update(bearer(make_key(app_store, rate_per_minute=0)))
        plan_id = upload(client)
        client.headers.update(bearer(make_key(app_store)))
        assert len(lines_of(ask(client, plan_id, 6 * [sphere]))) == 6
        problem = assert_problem(ask(client, plan_id, 6 * [sphere]), 429, "rate-limited")
        assert "8 requests per minute" in problem["detail"]
        client.headers.update(bearer(make_key(app_store)))
        problem = assert_problem(ask(client, plan_id, 9 * [sphere]), 422, "invalid-request")
        assert "the rate limit is 8 per minute" in problem["errors"][0]["message"]


@pytest.mark.parametrize("reader", ["stops", "leaves"])
def test_lines_end_without_a_reader(reader: str) -> None:
    begun: list[int] = []
    ended = asyncio.Event()

    async def lines() -> AsyncGenerator[str]:
        try:
            for number in range(100):
                begun.append(number)
                yield str(number)
                if reader == "leaves" and number == 2:
                    await asyncio.sleep(60.0)
        finally:
            ended.set()

    async def receive() -> dict[str, Any]:
        while reader == "stops" or len(begun) < 3:
            await asyncio.sleep(0.01)
        return {"type": "http.disconnect"}

    async def send(_message: object) -> None:
        if reader == "stops" and len(begun) == 3:
            await asyncio.sleep(60.0)

    async def run() -> None:
        async with asyncio.timeout(30.0):
            await LinesResponse(lines(), patience_s=0.05)({"type": "http"}, receive, send)
        assert ended.is_set()

    asyncio.run(run())
    assert begun == [0, 1, 2]
