"""Work of every route, which grows at most linearly with the input.

Work is counted, not timed: the lines of Python that the threads of the service run, and the steps of SQLite's virtual
machine. Worker processes are not counted; `tests/core` and `tests/importers` check what they run.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

import httpx
import pytest
from sqlalchemy import event
from sqlalchemy.engine import Engine

from benchmarks.harness import Caller
from benchmarks.heaviest import LOADS, Load, Stored, building, missing_routes, store_venue
from tests.service.conftest import StartApp, upload

pytestmark = pytest.mark.skipif(
    os.environ.get("TEST_DATABASE", "sqlite") != "sqlite", reason="counts steps of SQLite in this process"
)
# The first one only warms up.
_SIZES = (4, 8, 16, 32)
_ACCEPTED = {200, 201, 204, 304}
_SQLITE_STEPS = 10
# Growth by linear work is 2, by n log n less than 2.4, by quadratic work 4.
_MAX_GROWTH = 3.0
# Work of the event loop that does not belong to the request, as a share of the smallest request's.
_NOISE = 0.2


class Counter:
    """Operations of the threads and database connections that begin after `watch`."""

    def __init__(self) -> None:
        self._active = False
        self._operations = 0

    def watch(self) -> None:
        threading.settrace(self._called)
        event.listen(Engine, "connect", self._connected)

    def unwatch(self) -> None:
        threading.settrace(None)  # type: ignore[arg-type]
        event.remove(Engine, "connect", self._connected)

    def count(self, load: Load, caller: Caller, stored: Stored, size: int) -> int:
        self._operations, self._active = 0, True
        load.work(caller, stored, size)
        self._active = False
        return self._operations

    def _called(self, _frame: FrameType, _event: str, _argument: Any) -> Any:
        return self._line if self._active else None

    def _line(self, _frame: FrameType, _event: str, _argument: Any) -> Any:
        self._operations += 1
        return self._line

    def _connected(self, connection: Any, _record: Any) -> None:
        connection.set_progress_handler(self._step, _SQLITE_STEPS)

    def _step(self) -> int:
        self._operations += _SQLITE_STEPS
        return 0


@pytest.fixture(scope="module")
def counter() -> Iterator[Counter]:
    counter = Counter()
    counter.watch()
    yield counter
    counter.unwatch()


@pytest.fixture(scope="module")
def client(counter: Counter, start_app: StartApp, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    unlimited = {"rate_per_minute": 0, "rate_burst": 0, "keep_answers_s": 3600.0}
    with start_app(tmp_path_factory.mktemp("data"), **unlimited) as started:
        yield started


@pytest.fixture(scope="module")
def stored(client: httpx.Client) -> dict[int, Stored]:
    """Return a plan and a venue by the number of their rooms and homes."""
    caller, resources = Caller(str(client.base_url)), {}
    for size in _SIZES:
        plan_id = upload(client, building(size, openings_per_room=2))
        etag = client.get(f"/floorplans/{plan_id}").headers["etag"]
        resources[size] = Stored(plan_id, etag, *store_venue(caller, size))
    return resources


def test_every_route_has_a_load() -> None:
    assert missing_routes() == []


@pytest.mark.parametrize("load", LOADS, ids=lambda load: f"{load.route} {load.title}")
def test_work_grows_linearly(client: httpx.Client, counter: Counter, stored: dict[int, Stored], load: Load) -> None:
    statuses: list[int] = []
    caller = Caller(str(client.base_url), count=statuses.append)
    _, small, middle, large = (counter.count(load, caller, stored[size], size) for size in _SIZES)
    print("WORK", load.route, load.title, small, middle, large, statuses)
    assert set(statuses) <= _ACCEPTED | load.refusals
    assert large - middle <= _MAX_GROWTH * max(middle - small, 0) + _NOISE * small
