"""Concurrent queries wait in the client for the service's limit, and all are answered."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from unittest.mock import Mock

import httpx
import pytest

from lalaloc_client import AsyncClient, Client, RetryPolicy
from lalaloc_client.asynchronous.concurrency import AsyncConcurrencyLimit
from lalaloc_client.blocking.concurrency import ConcurrencyLimit
from tests.client.conftest import FailingServer, Planned
from tests.client.test_retries import LOCALISATION
from tests.service.conftest import metric

COUNT = 14
REJECTED = 'lalaloc_rejections_total{reason="overloaded"}'
ONCE = RetryPolicy(attempts=1)
# Four concurrent queries, three of them per client, and no queue.
APP_SETTINGS = {"max_queries": 4, "max_waiting_queries": 0}


def query_on_threads(client: Client, plan_id: str, sphere: bytes) -> list[Any]:
    with ThreadPoolExecutor(COUNT) as threads:
        return list(threads.map(lambda _: client.localise(plan_id, sphere, refine="none"), range(COUNT)))


def test_concurrent_queries_are_not_rejected(app: httpx.Client, plan_id: str, sphere: bytes) -> None:
    before = metric(app, REJECTED)
    with Client(str(app.base_url), retry=ONCE) as client:
        answers = query_on_threads(client, plan_id, sphere)
    assert len({answer.position for answer in answers}) == 1
    assert metric(app, REJECTED) == before


def test_concurrent_queries_with_asyncio_are_not_rejected(app: httpx.Client, plan_id: str, sphere: bytes) -> None:
    async def query() -> list[Any]:
        async with AsyncClient(str(app.base_url), retry=ONCE) as client:
            return await asyncio.gather(*(client.localise(plan_id, sphere, refine="none") for _ in range(COUNT)))

    before = metric(app, REJECTED)
    assert len(asyncio.run(query())) == COUNT
    assert metric(app, REJECTED) == before


@pytest.mark.slow
def test_rejected_queries_are_retried(app: httpx.Client, plan_id: str, sphere: bytes) -> None:
    before = metric(app, REJECTED)
    patient = RetryPolicy(attempts=40, total_s=60.0)
    with Client(str(app.base_url), retry=patient, max_queries=COUNT) as client:
        answers = query_on_threads(client, plan_id, sphere)
    assert len(answers) == COUNT
    assert metric(app, REJECTED) > before


def test_sequential_queries_do_not_fetch_limits(failing: FailingServer) -> None:
    failing.plan = [Planned(200, LOCALISATION)] * 3
    with Client(failing.url, retry=ONCE) as client:
        for _ in range(3):
            client.localise("p", b"picture")
    assert {request.path for request in failing.requests} == {"/localise"}


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        (Planned(200, {"max_queries": 8, "max_queries_per_tenant": 6}), 6),
        (Planned(200, {"max_queries": 8, "max_queries_per_tenant": 1}), 1),
        # The service does not state a limit; the key lacks the scope to read it.
        (Planned(200, {"max_queries": 8}), 3),
        (Planned(403, {"detail": "the key lacks the scope read"}), 3),
    ],
)
def test_concurrency_follows_the_limit_of_the_service(failing: FailingServer, limits: Planned, expected: int) -> None:
    failing.plan = [limits]
    released = threading.Event()
    with Client(failing.url, retry=ONCE) as client, ThreadPoolExecutor(COUNT) as threads:

        def hold() -> None:
            nonlocal highest, running
            with client._concurrency.hold():
                with lock:
                    running += 1
                    highest = max(highest, running)
                    if running == expected:
                        reached.set()
                released.wait(30.0)
                with lock:
                    running -= 1

        lock, reached, running, highest = threading.Lock(), threading.Event(), 0, 0
        futures = [threads.submit(hold) for _ in range(COUNT)]
        assert reached.wait(30.0)
        released.set()
        for future in futures:
            future.result()
    assert highest == expected
    assert [request.path for request in failing.requests] == ["/limits"]


def test_failed_fetch_of_the_limit_is_repeated() -> None:
    fetch = Mock(side_effect=[OSError("unreachable"), 2])
    limit = ConcurrencyLimit(None, fetch)
    with limit.hold():
        with pytest.raises(OSError, match="unreachable"), limit.hold():
            pass
        with limit.hold():
            pass
    assert fetch.call_count == 2


def test_cancelled_task_takes_no_slot() -> None:
    async def scenario() -> None:
        async def fetch() -> int:
            return 2

        limit, released, held = AsyncConcurrencyLimit(None, fetch), asyncio.Event(), list[int]()

        async def hold(number: int) -> None:
            async with limit.hold():
                held.append(number)
                await released.wait()

        tasks = [asyncio.create_task(hold(number)) for number in range(4)]
        while len(held) < 2:
            await asyncio.sleep(0)
        tasks[2].cancel()
        released.set()
        await asyncio.gather(*tasks, return_exceptions=True)
        assert held == [0, 1, 3]

    asyncio.run(scenario())


@pytest.mark.parametrize("kind", [Client, AsyncClient])
def test_limit_below_one_is_rejected(kind: type[Client] | type[AsyncClient]) -> None:
    with pytest.raises(ValueError, match="max_queries is 0; it must be at least 1"):
        kind("http://127.0.0.1:1", max_queries=0)
