"""Work of every route, which grows at most linearly with the input.

Work is counted, not timed: the lines of this project that the threads of the service run, and the steps of SQLite's
virtual machine. Libraries and worker processes are not counted; `tests/core` and `tests/importers` check what they do.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import httpx
import pytest
from sqlalchemy import event
from sqlalchemy.engine import Engine

import lalaloc_core
import service
from benchmarks.harness import Caller
from benchmarks.heaviest import LOADS, Load, Stored, building, missing_routes, store_venue
from service.storage.records import AuditEntry
from service.storage.store import Store
from tests.service.conftest import StartApp, upload, wait_for
from tests.service.test_security import bearer, make_key

pytestmark = pytest.mark.skipif(
    os.environ.get("TEST_DATABASE", "sqlite") != "sqlite", reason="counts steps of SQLite in this process"
)
# The first request warms up and does not count. Beyond 128 plans venues are searched by an index, which changes build.
_SIZES = (15, 30, 60, 120)
_ACCEPTED = {200, 201, 204, 304}
_COUNTED = tuple(str(Path(package.__file__ or "").parent) for package in (lalaloc_core, service))
_SQLITE_STEPS = 10
# Twice the input adds twice as much with linear work, 2.3 times with n log n, and 4 times with quadratic work.
_MAX_GROWTH = 2.4
# Operations that do not belong to the request, and the share of a small request that may come on top, as where larger
# bodies are spooled.
_NOISE, _NOISE_SHARE = 1000, 0.15


class Counter:
    """Operations of the threads and database connections that begin after `watch`."""

    def __init__(self) -> None:
        self._active = False
        # Counting on is atomic, unlike `+=`.
        self._operations = itertools.count()

    def watch(self) -> None:
        threading.settrace(self._called)
        event.listen(Engine, "connect", self._connected)

    def unwatch(self) -> None:
        threading.settrace(None)  # type: ignore[arg-type]
        event.remove(Engine, "connect", self._connected)

    def count(self, load: Load, caller: Caller, stored: Stored, size: int) -> int:
        before, self._active = next(self._operations), True
        load.work(caller, stored, size)
        self._active = False
        return next(self._operations) - before

    def _called(self, frame: FrameType, _event: str, _argument: Any) -> Any:
        return self._line if self._active and frame.f_code.co_filename.startswith(_COUNTED) else None

    def _line(self, _frame: FrameType, _event: str, _argument: Any) -> Any:
        next(self._operations)
        return self._line

    def _connected(self, connection: Any, _record: Any) -> None:
        connection.set_progress_handler(self._step, _SQLITE_STEPS)

    def _step(self) -> int:
        for _ in range(_SQLITE_STEPS):
            next(self._operations)
        return 0


@pytest.fixture(scope="module")
def counter() -> Iterator[Counter]:
    counter = Counter()
    counter.watch()
    yield counter
    counter.unwatch()


@pytest.fixture(scope="module")
def client(
    counter: Counter, start_app: StartApp, tiny_view_bundle: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[httpx.Client]:
    unlimited = {"rate_per_minute": 0, "rate_burst": 0, "keep_answers_s": 3600.0}
    # No regular work meanwhile, and the coarsest pose grids.
    quiet = {"sweep_s": 3600.0, "grid_step_m": 5.0}
    with pytest.MonkeyPatch.context() as patch:
        # Worker processes, which are not counted, read large plans and make their files.
        for name in ("plan_files.rendition_cache._SMALL", "plan_files.converter.LARGE", "routes.plan_uploads.LARGE"):
            patch.setattr(f"service.{name}", 10**9)
        data_dir = tmp_path_factory.mktemp("data")
        with start_app(data_dir, bundle=tiny_view_bundle, api_keys=True, **unlimited, **quiet) as started:
            started.headers.update(bearer(_fill_pages(Store(f"sqlite:///{data_dir / 'lalaloc.sqlite3'}"))))
            yield started


def _fill_pages(store: Store) -> str:
    """Store keys, tenants and entries of the audit log for whole pages, and return a key with all scopes."""
    for number in range(_SIZES[-1]):
        make_key(store)
        store.tenants.change_limits(f"t{number}", cpu_share=1.0)
    entry = AuditEntry(actor="a", tenant="t", action="keys create", resource="x", detail='{"name": "x"}')
    store.audit_log.add([entry] * _SIZES[-1])
    key = make_key(store)
    store.close()
    return key


def _caller(client: httpx.Client, count: Callable[[int], None] = lambda _status: None) -> Caller:
    return Caller(str(client.base_url), client.headers["authorization"].removeprefix("Bearer "), count)


@pytest.fixture(scope="module")
def stored(client: httpx.Client) -> dict[int, Stored]:
    """Return a plan and a venue by the number of their rooms and homes."""
    caller, resources = _caller(client), {}
    for size in _SIZES:
        plan_id = upload(client, building(size, openings_per_room=2))
        resources[size] = Stored.of(caller, plan_id, *store_venue(caller, size))
    return resources


def test_every_route_has_a_load() -> None:
    assert missing_routes() == []


# The work of refused inputs is limited; `tests/core/test_bounded_work.py` checks it.
@pytest.mark.slow
@pytest.mark.parametrize(
    "load", [load for load in LOADS if not load.refusals], ids=lambda load: f"{load.routes[0]} {load.title}"
)
def test_work_grows_linearly(client: httpx.Client, counter: Counter, stored: dict[int, Stored], load: Load) -> None:
    statuses: list[int] = []
    caller = _caller(client, statuses.append)
    operations = []
    for size in _SIZES:
        # Pose grids of earlier requests are ready.
        wait_for(lambda: client.get("/readyz").json()["plans_preparing"] == 0)
        operations.append(counter.count(load, caller, stored[size], size))
    _, small, middle, large = operations
    assert set(statuses) <= _ACCEPTED
    noise = max(_NOISE, _NOISE_SHARE * small)
    assert large - middle <= _MAX_GROWTH * max(middle - small, 0) + noise, operations
