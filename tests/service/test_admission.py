"""Admission: a slot, a short wait or a refusal, and no work for disconnected clients."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from time import monotonic

import httpx
import pytest

from service.capacity.admission_control import Slots
from service.errors import OverloadedError, ShareExceededError
from tests.service.conftest import FLAT, StartApp, assert_problem, connection_to, localise, metric, upload, wait_for
from tests.service.test_localise import HALL

pytestmark = pytest.mark.one_replica

# Slots of one client address; one more is left for others.
PLACES = 3
IN_FLIGHT = "lalaloc_requests_in_flight"


@pytest.fixture(scope="module")
def small(start_app: StartApp, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """Yield an app with few slots, one computing thread, and large grids that take long."""
    limits = {"max_pending_requests": PLACES + 1, "max_queries": 1, "max_waiting_queries": 0, "max_reads": 2}
    limits["compute_threads"] = 1
    with start_app(tmp_path_factory.mktemp("data"), upload_deadline_s=30.0, **limits) as client:
        yield client


@contextmanager
def _open_upload(client: httpx.Client, path: str = "/floorplans") -> Iterator[socket.socket]:
    """Open an upload that never sends its body."""
    with connection_to(client) as connection:
        head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        connection.sendall(f"{head}Content-Length: 100000\r\n\r\n{{".encode())
        yield connection


def test_requests_beyond_the_limit_are_refused(small: httpx.Client) -> None:
    with ExitStack() as uploads:
        for _ in range(PLACES):
            uploads.enter_context(_open_upload(small))
        wait_for(lambda: metric(small, IN_FLIGHT) == PLACES)
        response = small.post("/floorplans", json=FLAT)
        assert f"{PLACES} of your requests are in progress" in assert_problem(response, 503, "overloaded")["detail"]
        assert 1 <= int(response.headers["retry-after"]) <= 30
        # Reads have slots of their own; health and metrics need none.
        assert small.get("/floorplans").status_code == 200
        assert small.get("/healthz").status_code == 200
        # A refusal does not wait for the body.
        assert uploads.enter_context(_open_upload(small)).recv(4096).startswith(b"HTTP/1.1 503 ")
    wait_for(lambda: metric(small, IN_FLIGHT) == 0)
    upload(small)


def test_excess_query_is_refused_before_its_upload(small: httpx.Client, sphere: bytes) -> None:
    plan_id = upload(small)
    with ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(lambda _: localise(small, plan_id, sphere), range(24)))
    refused = [answer for answer in answers if answer.status_code != 200]
    assert refused
    assert len(refused) < len(answers)
    for answer in refused:
        assert_problem(answer, 503, "overloaded")
    assert localise(small, plan_id, sphere).status_code == 200
    assert 'lalaloc_rejections_total{reason="overloaded"}' in small.get("/metrics").text


def test_parallel_queries_of_one_client_are_all_answered(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    # The constants of `small` hold for all apps while it runs.
    with start_app(tmp_path, max_queries=4, max_waiting_queries=16) as client, ThreadPoolExecutor(14) as threads:
        plan_id = upload(client)
        answers = list(threads.map(lambda _: localise(client, plan_id, sphere, refine="none"), range(14)))
        assert [answer.status_code for answer in answers] == [200] * 14
        assert metric(client, "lalaloc_queries_waiting") == metric(client, "lalaloc_queries_in_work") == 0


def test_slot_queue_is_bounded_and_round_robin() -> None:
    async def scenario() -> None:
        slots, order, goes_on = Slots(2, 4), list[str](), asyncio.Event()

        async def query(client: str, wait_s: float = 30.0) -> None:
            async with slots.wait_and_hold(client, monotonic() + wait_s):
                order.append(client)
                await goes_on.wait()

        # One in progress and three that wait leave one of each to others.
        own = [asyncio.create_task(query("a")) for _ in range(6)]
        await asyncio.sleep(0)
        assert (slots.in_use, slots.waiting) == (1, 3)
        others = [asyncio.create_task(query("b")) for _ in range(2)]
        await asyncio.sleep(0)
        assert (slots.in_use, slots.waiting) == (2, 4)
        with pytest.raises(OverloadedError):
            slots.check("c")
        with pytest.raises(OverloadedError):
            await query("c")
        # A place in the queue becomes free when its request leaves or times out.
        others[1].cancel()
        await asyncio.sleep(0)
        assert slots.waiting == 3
        with pytest.raises(OverloadedError):
            await query("c", wait_s=0.01)
        assert slots.waiting == 3
        late = asyncio.create_task(query("c"))
        await asyncio.sleep(0)
        goes_on.set()
        outcomes = await asyncio.gather(*own, late, others[0], return_exceptions=True)
        assert [type(outcome) for outcome in outcomes].count(ShareExceededError) == 2
        # The last client waits for one query of the other client, not for all.
        assert sorted(order) == ["a", "a", "a", "a", "b", "c"]
        assert order.index("c") <= 3
        assert slots.in_use == slots.waiting == 0

    asyncio.run(scenario())


def test_slot_of_a_cancelled_query_goes_to_the_next() -> None:
    async def scenario() -> None:
        slots = Slots(1, 4)

        async def query() -> None:
            async with slots.wait_and_hold("a", monotonic() + 30.0):
                pass

        with slots.hold("a"):
            late = asyncio.create_task(query())
            await asyncio.sleep(0)
        late.cancel()
        await asyncio.gather(late, return_exceptions=True)
        assert late.cancelled()
        await asyncio.wait_for(query(), 1.0)
        assert slots.in_use == slots.waiting == 0

    asyncio.run(scenario())


@pytest.mark.slow
def test_query_that_would_miss_its_deadline_is_refused_at_once() -> None:
    async def scenario() -> None:
        slots = Slots(16, 16)

        async def query(client: str, seconds: float) -> None:
            async with slots.wait_and_hold(client, monotonic() + 0.4):
                await asyncio.sleep(seconds)

        # Four at a time take more than their time limit.
        for _ in range(8):
            await asyncio.gather(*(query("a", 0.5) for _ in range(4)), return_exceptions=True)
        begin = monotonic()
        outcomes = await asyncio.gather(
            *(query("a", 0.01) for _ in range(12)), query("b", 0.01), return_exceptions=True
        )
        assert monotonic() - begin < 0.2
        refused = [outcome for outcome in outcomes if isinstance(outcome, OverloadedError)]
        assert 8 <= len(refused) <= 11
        assert all((error.retry_after_s or 0) >= 1 for error in refused)
        # A client with a single query at a time, and another client, are served.
        assert outcomes[-1] is None
        await query("a", 0.01)

    asyncio.run(scenario())


def test_query_waiting_for_a_grid_blocks_no_other(small: httpx.Client, sphere: bytes) -> None:
    ready, preparing = upload(small), upload(small, HALL, wait=False)
    with ThreadPoolExecutor(1) as threads:
        waiting = threads.submit(localise, small, preparing, sphere)
        # Until its picture is encoded, it takes the place of a query.
        wait_for(lambda: metric(small, IN_FLIGHT) == 1)
        wait_for(lambda: localise(small, ready, sphere).status_code == 200)
        assert not waiting.done()
        assert small.delete(f"/floorplans/{preparing}").status_code == 204
        assert waiting.result().status_code in (200, 404, 503)


def test_disconnect_frees_the_slot(small: httpx.Client, sphere: bytes) -> None:
    preparing = upload(small, HALL, wait=False)
    query = small.build_request("POST", "/localise", data={"floorplan_id": preparing}, files={"photo": ("p", sphere)})
    head = b"".join(name + b": " + value + b"\r\n" for name, value in query.headers.raw)
    with connection_to(small) as connection:
        connection.sendall(b"POST /localise HTTP/1.1\r\n" + head + b"\r\n" + query.read())
        wait_for(lambda: metric(small, IN_FLIGHT) == 1)
    wait_for(lambda: metric(small, IN_FLIGHT) == 0)
    assert 'lalaloc_disconnects_total{route="/localise"} 1.0' in small.get("/metrics").text
    assert small.delete(f"/floorplans/{preparing}").status_code == 204
    assert metric(small, "lalaloc_queries_in_work") == 0
