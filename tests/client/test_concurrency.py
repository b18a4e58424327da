"""Queries that are sent at once wait in the client for as many as the service takes, and all are answered."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from lalaloc_client import AsyncClient, Client, RetryPolicy
from lalaloc_client.async_concurrency import AsyncConcurrencyLimit
from lalaloc_client.concurrency import ConcurrencyLimit
from tests.client.conftest import FailingServer, Planned
from tests.client.test_retries import LOCALISATION
from tests.service.conftest import FLAT, StartApp, upload

COUNT = 14
# Four queries, of which three are for one client, and nowhere to wait.
NARROW = {"max_queries": 4, "max_waiting_queries": 0}
ONCE = RetryPolicy(attempts=1)


@pytest.fixture(scope="module")
def narrow(start_app: StartApp, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """A service that takes few queries at a time."""
    with start_app(tmp_path_factory.mktemp("data"), **NARROW) as started:
        yield started


@pytest.fixture(scope="module")
def plan_id(narrow: httpx.Client) -> str:
    """A plan to ask about."""
    return upload(narrow, FLAT)


def fourteen_on_threads(client: Client, plan_id: str, panorama: bytes) -> list[Any]:
    with ThreadPoolExecutor(COUNT) as threads:
        return list(threads.map(lambda _: client.localise(plan_id, panorama, refine="none"), range(COUNT)))


def rejected(service: httpx.Client) -> float:
    lines = service.get("/metrics").text.splitlines()
    wanted = 'lalaloc_rejections_total{reason="overloaded"} '
    return next(float(line.removeprefix(wanted)) for line in lines if line.startswith(wanted))


def test_what_one_client_sends_at_once_is_answered_and_none_of_it_refused(
    narrow: httpx.Client, plan_id: str, panorama: bytes
) -> None:
    before = rejected(narrow)
    # Without a second attempt: what is not refused needs none.
    with Client(str(narrow.base_url), retry=ONCE) as client:
        answers = fourteen_on_threads(client, plan_id, panorama)
    assert len({answer.position for answer in answers}) == 1
    assert rejected(narrow) == before


def test_the_same_with_asyncio(narrow: httpx.Client, plan_id: str, panorama: bytes) -> None:
    async def ask() -> list[Any]:
        async with AsyncClient(str(narrow.base_url), retry=ONCE) as client:
            return await asyncio.gather(
                *(client.localise(plan_id, panorama, refine="none") for _ in range(COUNT)),
            )

    before = rejected(narrow)
    answers = asyncio.run(ask())
    assert len(answers) == COUNT
    assert rejected(narrow) == before


def test_more_than_the_service_takes_are_refused_asked_again_and_answered(
    narrow: httpx.Client, plan_id: str, panorama: bytes
) -> None:
    before = rejected(narrow)
    patient = RetryPolicy(attempts=40, total_s=60.0)
    with Client(str(narrow.base_url), retry=patient, max_queries=COUNT) as client:
        answers = fourteen_on_threads(client, plan_id, panorama)
    assert len(answers) == COUNT
    assert rejected(narrow) > before


def test_one_query_at_a_time_asks_for_no_limits(failing: FailingServer) -> None:
    failing.plan = [Planned(200, LOCALISATION)] * 3
    with Client(failing.url, retry=ONCE) as client:
        for _ in range(3):
            client.localise("p", b"picture")
    assert {one.path for one in failing.seen} == {"/localise"}


@pytest.mark.parametrize(
    ("told", "at_a_time"),
    [
        (Planned(200, {"max_queries": 8, "max_queries_per_tenant": 6}), 6),
        (Planned(200, {"max_queries": 8, "max_queries_per_tenant": 1}), 1),
        # Of a service that does not say, and with a key that may not ask.
        (Planned(200, {"max_queries": 8}), 3),
        (Planned(403, {"detail": "the key lacks the scope read"}), 3),
    ],
)
def test_as_many_are_under_way_as_the_service_says(failing: FailingServer, told: Planned, at_a_time: int) -> None:
    failing.plan = [told]
    goes_on = threading.Event()
    with Client(failing.url, retry=ONCE) as client, ThreadPoolExecutor(COUNT) as threads:

        def hold() -> None:
            nonlocal most, under_way
            with client._concurrency.hold():
                with lock:
                    under_way += 1
                    most = max(most, under_way)
                    if under_way == at_a_time:
                        reached.set()
                goes_on.wait(30.0)
                with lock:
                    under_way -= 1

        lock, reached, under_way, most = threading.Lock(), threading.Event(), 0, 0
        held = [threads.submit(hold) for _ in range(COUNT)]
        assert reached.wait(30.0)
        goes_on.set()
        for one in held:
            one.result()
    assert most == at_a_time
    # Only once, however many wait.
    assert [one.path for one in failing.seen] == ["/limits"]


def test_who_cannot_ask_fails_and_the_next_asks_again() -> None:
    answers: list[int | Exception] = [OSError("away"), 2]

    def ask() -> int:
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    limit = ConcurrencyLimit(None, ask)
    with limit.hold():
        with pytest.raises(OSError, match="away"), limit.hold():
            pass
        with limit.hold():
            pass
    assert not answers


def test_a_task_that_is_cancelled_while_it_waits_takes_no_turn() -> None:
    async def scenario() -> None:
        async def two() -> int:
            return 2

        limit, goes_on, held = AsyncConcurrencyLimit(None, two), asyncio.Event(), list[int]()

        async def hold(number: int) -> None:
            async with limit.hold():
                held.append(number)
                await goes_on.wait()

        tasks = [asyncio.create_task(hold(number)) for number in range(4)]
        while len(held) < 2:
            await asyncio.sleep(0)
        tasks[2].cancel()
        goes_on.set()
        await asyncio.gather(*tasks, return_exceptions=True)
        assert held == [0, 1, 3]

    asyncio.run(scenario())


@pytest.mark.parametrize("kind", [Client, AsyncClient])
def test_fewer_than_one_at_a_time_is_refused(kind: type[Client] | type[AsyncClient]) -> None:
    with pytest.raises(ValueError, match="max_queries is 0, at least 1"):
        kind("http://127.0.0.1:1", max_queries=0)
