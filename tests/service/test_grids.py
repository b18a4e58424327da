"""Pose grids: equal to the core's, computed once by any replica, limited in number, replaced with the model."""

from __future__ import annotations

import asyncio
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from lalaloc_core.bundle import Bundle, write_manifest
from lalaloc_core.errors import InvalidPoseError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import PoseGrid
from service.bounded_cache import BoundedCache
from service.capacity.cpu_accounts import CpuAccounts
from service.capacity.fair_share import FairSemaphore
from service.capacity.threads import BoundedReads
from service.errors import (
    OverloadedError,
    PlanFailedError,
    PlanNotReadyError,
    StoppingError,
    StoreBusyError,
    StoreUnavailableError,
    UnknownFloorPlanError,
)
from service.grids import builder
from service.grids.embedding import embed, grid_bytes
from service.grids.grid_jobs import MAX_ON_DEMAND
from service.grids.grid_provider import GridProvider, check_height_m, grid_height_m
from service.grids.sweeper import Sweeper
from service.settings import CONSTANTS, Settings
from service.storage.records import NewPlan, Original, PlanRecord
from service.storage.store import PlanLookup, Store
from service.telemetry import Telemetry
from tests.service.conftest import FLAT, OpenStore, StartApp, constants, localise, upload, wait_for
from tests.service.postgres import PostgresServer
from tests.strategies import plan_of, rectangle

PLAN = FloorPlan.from_dict(FLAT)
# The smaller one has about 1700 poses in seven chunks.
HALL, LARGE_HALL = plan_of(rectangle(20.0, 20.0), ceiling_m=3.0), plan_of(rectangle(30.0, 30.0), ceiling_m=3.0)


class CountingEncoders(PhotographEncoder):
    """Real encoders that count the rendered poses, and can wait between chunks."""

    def __init__(self, bundle: Bundle) -> None:
        super().__init__(bundle, threads=1)
        self._render, self.layouts.rendered = self.layouts.rendered, self.rendered
        self.embedded = 0
        self.pause_s = 0.0
        self.go_on = threading.Event()
        self.go_on.set()

    def rendered(self, *arguments: Any, **named: Any) -> Any:
        result = self._render(*arguments, **named)
        self.embedded += len(result)
        assert self.go_on.wait(30.0)
        time.sleep(self.pause_s)
        return result


@pytest.fixture
def encoders(bundle: Bundle) -> CountingEncoders:
    return CountingEncoders(bundle)


def _permits() -> FairSemaphore:
    return FairSemaphore(2, CpuAccounts())


def _add(store: Store, plan: FloorPlan = PLAN, plan_id: str = "p") -> PlanRecord:
    return store.plans.add("default", plan_id, NewPlan(plan, Original(b"{}")), limit=20)


def _begun(encoders: CountingEncoders, grids: GridProvider, record: PlanRecord) -> Future[PoseGrid]:
    """Begin to compute a grid, which waits for `encoders.go_on` within its first chunk."""
    encoders.go_on.clear()
    future = grids.compute(record, 1.5)
    wait_for(lambda: encoders.embedded > 0)
    return future


@pytest.fixture
def make_grids(encoders: CountingEncoders) -> Iterator[Callable[..., GridProvider]]:
    with ExitStack() as stack:

        def make(store: Store, own_encoders: PhotographEncoder | None = None, **settings: Any) -> GridProvider:
            values = {name: value for name, value in settings.items() if name not in CONSTANTS}
            stack.enter_context(constants({name: value for name, value in settings.items() if name in CONSTANTS}))
            grids = GridProvider(store, own_encoders or encoders, "m1", Settings(**values), Telemetry(), _permits())
            return stack.enter_context(closing(grids))

        yield make


MakeGrids = Callable[..., GridProvider]


@pytest.fixture
def shared(open_store: OpenStore) -> Store:
    """Return a store on a database of either kind, which other replicas open as well."""
    return open_store()


def test_chunked_grid_equals_the_core_grid(store: Store, make_grids: MakeGrids, encoders: PhotographEncoder) -> None:
    computed = make_grids(store).compute(_add(store, HALL), 1.5).result(30.0)
    expected = build_grid(HALL, encoders.layouts, step_m=0.5, camera_height_m=1.5, latents=False)
    np.testing.assert_array_equal(computed.poses.position_m, expected.poses.position_m)
    np.testing.assert_array_equal(computed.profile_m, expected.profile_m)
    np.testing.assert_array_equal(computed.layouts(HALL).log_profile, expected.layouts(HALL).log_profile)
    # Poses are compared by wall profiles, so latents are not computed.
    assert computed.latents is None
    assert computed.profile_m.dtype == np.float16


def test_second_request_shares_the_computation(store: Store, make_grids: MakeGrids, encoders: CountingEncoders) -> None:
    grids, record = make_grids(store), _add(store)
    futures = [grids.compute(record, 1.5) for _ in range(5)]
    results = [future.result(30.0) for future in futures]
    assert all(result is results[0] for result in results)
    assert grids.cache.find(grids.key(record.revision_id, 1.5)) is results[0]
    assert encoders.embedded == len(results[0].poses)


def test_grid_of_unknown_plan_is_an_error(store: Store, make_grids: MakeGrids) -> None:
    grids, record = make_grids(store), _add(store)
    store.plans.delete("default", "p")
    with pytest.raises(UnknownFloorPlanError):
        grids.compute(record, 1.5).result(30.0)
    assert grids.pending == 0


# In memory


@pytest.mark.parametrize("cache_bytes", [0, 200_000])
def test_cache_stays_within_its_limit(store: Store, make_grids: MakeGrids, cache_bytes: int) -> None:
    grids, record = make_grids(store, grid_cache_bytes=cache_bytes), _add(store)
    for height_m in (1.5, 1.6, 1.7):
        grids.compute(record, height_m).result(30.0)
        assert grids.cache.bytes <= cache_bytes
        assert grids.cache.bytes == sum(grid_bytes(grid) for _, grid in grids.cache.items())
    assert (len(grids.cache.items()) > 0) == (cache_bytes > 0)
    # Evicted grids are still in the store.
    assert all(grids.cache.find(grids.key(record.revision_id, height_m)) is not None for height_m in (1.5, 1.6, 1.7))


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 60)), max_size=30), st.integers(0, 100))
def test_bounded_cache_drops_the_least_recently_used(puts: list[tuple[int, int]], limit_bytes: int) -> None:
    cache: BoundedCache[int, int] = BoundedCache(limit_bytes, lambda size: size)
    expected: list[tuple[int, int]] = []
    for key, size in puts:
        cache.put(key, size)
        expected = [entry for entry in expected if entry[0] != key]
        if size <= limit_bytes:
            expected.append((key, size))
        while sum(size for _, size in expected) > limit_bytes:
            expected.pop(0)
        assert sorted(cache.items()) == sorted(expected)
        assert cache.bytes == sum(size for _, size in expected)
        # Reading an entry makes it the most recently used.
        if expected:
            assert cache.get(expected[0][0]) == expected[0][1]
            expected.append(expected.pop(0))


def test_value_is_made_once_for_all_threads() -> None:
    cache: BoundedCache[str, int] = BoundedCache(100, lambda size: size)
    made: list[str] = []
    begun, goes_on = threading.Event(), threading.Event()

    def make() -> int:
        made.append("a")
        begun.set()
        assert goes_on.wait(20.0)
        return 7

    with ThreadPoolExecutor(4) as threads:
        first = threads.submit(cache.get_or_make, "a", make)
        assert begun.wait(20.0)
        others = [threads.submit(cache.get_or_make, "a", make) for _ in range(3)]
        assert cache.get_or_make("b", lambda: None) is None
        goes_on.set()
        assert [future.result(20.0) for future in (first, *others)] == [7] * 4
    assert made == ["a"]
    assert cache.get("a") == 7


def test_failed_call_fails_for_all_who_wait_and_is_made_again() -> None:
    cache: BoundedCache[str, int] = BoundedCache(100, lambda size: size)
    with pytest.raises(StoreUnavailableError):
        cache.get_or_make("a", Mock(side_effect=StoreUnavailableError))
    assert cache.get_or_make("a", lambda: 3) == 3


def test_cache_is_in_the_metrics(store: Store, encoders: PhotographEncoder) -> None:
    telemetry = Telemetry()
    grids = GridProvider(store, encoders, "m1", Settings(), telemetry, _permits())
    record = _add(store)
    key = grids.key(record.revision_id, 1.5)
    assert grids.cache.find(key) is None
    grids.compute(record, 1.5).result(30.0)
    assert grids.cache.find(key) is not None
    grids.close()
    text = telemetry.render().decode()
    assert "lalaloc_grid_cache_hits_total 1.0" in text
    assert "lalaloc_grid_cache_misses_total 1.0" in text
    assert "lalaloc_grid_cache_evictions_total 0.0" in text


# Several replicas


def test_replicas_share_one_computation(open_store: OpenStore, make_grids: MakeGrids, bundle: Bundle) -> None:
    first_store, second_store = open_store(), open_store()
    first_encoders, second_encoders = CountingEncoders(bundle), CountingEncoders(bundle)
    first = make_grids(first_store, first_encoders, grid_lease_s=10.0)
    second = make_grids(second_store, second_encoders, grid_lease_s=10.0)
    record = _add(first_store, HALL)
    first_future = _begun(first_encoders, first, record)
    second_future = second.compute(record, 1.5)
    wait_for(lambda: len(second._jobs.remote()) == 1)
    first_encoders.go_on.set()
    wait_for(lambda: first.progress(first.key(record.revision_id, 1.5)) > 0.0 or first_future.done())
    summary = second_store.plans.list_plans("default", limit=1)[0]
    assert second.states([summary])[0].status in ("preparing", "ready")
    grid = first_future.result(30.0)
    wait_for(lambda: _looked(second) or second_future.done())
    np.testing.assert_array_equal(second_future.result(30.0).profile_m, grid.profile_m)
    assert (first_encoders.embedded, second_encoders.embedded) == (len(grid.poses), 0)
    assert second.states([summary])[0].poses == len(grid.poses)


def _looked(grids: GridProvider) -> bool:
    grids.poll_remote()
    return False


def test_remote_progress_is_reported(open_store: OpenStore, make_grids: MakeGrids) -> None:
    store = open_store()
    grids, record = make_grids(open_store()), _add(store, HALL)
    key = grids.key(record.revision_id, 1.5)
    store.leases.claim(key, "another replica", 60.0)
    store.leases.renew(key, "another replica", 60.0, 0.25)
    state = grids.states(store.plans.list_plans("default", limit=1))[0]
    assert (state.status, state.progress) == ("preparing", 0.25)
    grids.compute(record, 1.5)
    wait_for(lambda: _looked(grids) or grids.progress(key) == 0.25)


def test_lease_of_dead_replica_is_taken_over(shared: Store, make_grids: MakeGrids, encoders: CountingEncoders) -> None:
    grids, record = make_grids(shared), _add(shared)
    shared.leases.claim(grids.key(record.revision_id, 1.5), "dead", 1.0)
    future = grids.compute(record, 1.5)
    wait_for(lambda: len(grids._jobs.remote()) == 1)
    grids.poll_remote()
    assert encoders.embedded == 0
    wait_for(lambda: _looked(grids) or future.done())
    assert len(future.result(30.0).poses) == encoders.embedded


def test_unfinished_attempts_fail(shared: Store, make_grids: MakeGrids, encoders: CountingEncoders) -> None:
    grids, record = make_grids(shared), _add(shared)
    key = grids.key(record.revision_id, 1.5)
    # As replicas that lose their lease or die.
    for number in range(5):
        assert shared.leases.claim(key, f"replica {number % 2}", 0.001)
        time.sleep(0.01)
    with pytest.raises(PlanFailedError, match="begun 5 times"):
        grids.compute(record, 1.5).result(30.0)
    assert encoders.embedded == 0
    state = grids.states(shared.plans.list_plans("default", limit=1))[0]
    assert (state.status, state.reason) == ("failed", "its pose grid was begun 5 times and never finished")
    # The next start tries again.
    shared.plans.clear_failures()
    assert len(grids.compute(record, 1.5).result(30.0).poses) == encoders.embedded


def test_non_finite_grid_fails(store: Store, make_grids: MakeGrids, bundle: Bundle) -> None:
    class Overflowing(CountingEncoders):
        def rendered(self, *arguments: Any, **named: Any) -> Any:
            layouts = super().rendered(*arguments, **named)
            layouts.log_profile[-1, 0] = np.nan
            return layouts

    record = _add(store)
    grids = make_grids(store, Overflowing(bundle))
    with pytest.raises(InvalidPoseError, match=r"no latents at camera_height_m 1\.5"):
        grids.compute(record, 1.5).result(30.0)
    assert grids.prepare(PLAN, "") is None
    assert grids.states(store.plans.list_plans("default", limit=1))[0].status == "failed"


def test_lease_is_renewed_during_sampling(bundle: Bundle) -> None:
    square = [[0, 0], [2, 0], [2, 2], [0, 2]]
    rooms = [{"name": f"{k}", "polygon": [[x + 3 * k, y] for x, y in square]} for k in range(5)]
    plan, rooms_done = FloorPlan.from_dict({"ceiling_height_m": 2.5, "rooms": rooms}), list[int]()

    def lose_after_three() -> None:
        rooms_done.append(len(rooms_done))
        if len(rooms_done) == 3:
            raise StoppingError

    encoders = CountingEncoders(bundle)
    with pytest.raises(StoppingError):
        embed(plan, encoders, step_m=0.5, camera_height_m=1.5, after_room=lose_after_three)
    assert len(rooms_done) == 3
    assert encoders.embedded == 0


def test_overtaken_replica_gives_way(shared: Store, make_grids: MakeGrids, encoders: CountingEncoders) -> None:
    grids, record = make_grids(shared, grid_lease_s=0.2), _add(shared, HALL)
    key = grids.key(record.revision_id, 1.5)
    future = _begun(encoders, grids, record)
    wait_for(lambda: shared.leases.claim(key, "another replica", 60.0) is not None)
    encoders.go_on.set()
    wait_for(lambda: len(grids._jobs.remote()) == 1)
    assert encoders.embedded < 1521
    grid = build_grid(HALL, encoders.layouts, step_m=0.5, camera_height_m=1.5)
    assert shared.grids.put(key, grid, keep=8, always_keep_mm=1500)
    wait_for(lambda: _looked(grids) or future.done())
    np.testing.assert_array_equal(future.result().profile_m, grid.profile_m)


def test_remote_deletion_cancels_the_grid(
    open_store: OpenStore, shared: Store, make_grids: MakeGrids, encoders: CountingEncoders
) -> None:
    grids, record = make_grids(shared, grid_lease_s=0.1), _add(shared, HALL)
    future = _begun(encoders, grids, record)
    assert open_store().plans.delete("default", "p")
    encoders.go_on.set()
    wait_for(lambda: _looked(grids) or future.done())
    assert isinstance(future.exception(), UnknownFloorPlanError)
    assert encoders.embedded < 1521
    assert grids.pending == 0


def test_work_of_stopped_replica_is_taken_over(
    open_store: OpenStore, make_grids: MakeGrids, encoders: CountingEncoders, bundle: Bundle
) -> None:
    first, second = open_store(), open_store()
    stopping, record = make_grids(first), _add(first, HALL)
    future = _begun(encoders, stopping, record)
    closing = threading.Thread(target=stopping.close)
    closing.start()
    wait_for(stopping._jobs.closing.is_set)
    encoders.go_on.set()
    closing.join(30.0)
    assert isinstance(future.exception(), StoppingError)
    grids = make_grids(second, CountingEncoders(bundle))
    assert not grids.queue_missing()
    assert grids.pending == 1
    wait_for(lambda: grids.pending == 0)
    assert grids.cache.find(grids.key(record.revision_id, 1.5)) is not None


def test_unqueued_plans_count_as_preparing(shared: Store, make_grids: MakeGrids, encoders: CountingEncoders) -> None:
    for number in range(20):
        _add(shared, plan_id=f"plan {number}")
    grids = make_grids(shared)
    encoders.go_on.clear()
    # Sixteen are queued at a time, and the rest is counted.
    assert grids.queue_missing()
    assert (grids.pending, grids.preparing) == (16, 20)
    encoders.go_on.set()
    wait_for(lambda: grids.pending == 0)
    # Grids that another replica computes, dead or alive, count as well.
    key = grids.key(shared.grids.missing("m1", 0.5, 1)[0].revision_id, 1.5)
    shared.leases.claim(key, "another replica", 60.0)
    grids.queue_missing()
    assert (grids.pending, grids.preparing) == (3, 4)
    wait_for(lambda: grids.pending == 0)
    shared.leases.release(key, "another replica")
    grids.queue_missing()
    wait_for(lambda: grids.pending == 0)
    grids.queue_missing()
    assert grids.preparing == 0


def test_sweep_drops_deleted_revisions_from_memory(open_store: OpenStore, make_grids: MakeGrids) -> None:
    store, elsewhere = open_store(), open_store()
    grids = make_grids(store)
    records = {name: _add(store, plan_id=name) for name in ("deleted", "changed", "kept")}
    for name, record in records.items():
        grids.compute(record, 1.5).result(30.0)
        assert store.plans.get("default", name) == record
    elsewhere.plans.delete("default", "deleted")
    elsewhere.plans.add_revision("default", "changed", NewPlan(PLAN, Original(b"")), keep=5)
    Sweeper(store, grids, Telemetry(), sweep_s=5.0, keep_answers_s=0.0).sweep()
    assert grids.revisions() == store.plan_cache.revisions() == {records["kept"].revision_id}


def test_sweep_cancels_revisions_replaced_remotely(
    open_store: OpenStore, make_grids: MakeGrids, encoders: CountingEncoders
) -> None:
    store, elsewhere = open_store(), open_store()
    grids = make_grids(store)
    # The first grid has begun, the others wait.
    futures = [_begun(encoders, grids, _add(store, HALL))]
    for _ in range(3):
        record = elsewhere.plans.add_revision("default", "p", NewPlan(HALL, Original(b"")), keep=5)
        futures.append(grids.compute(record, 1.5))
    Sweeper(store, grids, Telemetry(), sweep_s=5.0, keep_answers_s=0.0).sweep()
    encoders.go_on.set()
    assert len(futures.pop().result(60.0).poses) == 1521
    assert [type(future.exception(30.0)) for future in futures] == [PlanNotReadyError] * 3
    assert encoders.embedded <= 256 + 1521


def test_remote_job_of_replaced_revision_ends(shared: Store, make_grids: MakeGrids) -> None:
    grids, record = make_grids(shared), _add(shared)
    shared.leases.claim(grids.key(record.revision_id, 1.5), "another replica", 60.0)
    future = grids.compute(record, 1.5)
    wait_for(lambda: len(grids._jobs.remote()) == 1)
    shared.plans.add_revision("default", "p", NewPlan(PLAN, Original(b"")), keep=5)
    grids.cancel(record.revision_id)
    grids.poll_remote()
    assert isinstance(future.exception(30.0), PlanNotReadyError)


# A large grid in the background


@pytest.mark.slow
def test_overtaken_grid_keeps_its_lease(store: Store, make_grids: MakeGrids, encoders: CountingEncoders) -> None:
    grids = make_grids(store, grid_lease_s=2.0)
    large, small = _add(store, LARGE_HALL, "large"), _add(store, HALL, "small")
    slow = _begun(encoders, grids, large)
    quick = grids.compute(small, 1.5)
    # Six chunks, which take longer than the lease.
    encoders.pause_s = 0.5
    encoders.go_on.set()
    while not quick.done():
        assert not store.leases.claim(grids.key(large.revision_id, 1.5), "another replica", 60.0)
        time.sleep(0.1)
    encoders.pause_s = 0.0
    assert not slow.done()
    assert len(slow.result(60.0).poses) > 2000


def test_queue_of_grids_is_limited(store: Store, make_grids: MakeGrids, encoders: CountingEncoders) -> None:
    grids, record = make_grids(store), _add(store)
    encoders.go_on.clear()
    futures = [grids.compute(record, 1.0 + 0.02 * number) for number in range(MAX_ON_DEMAND)]
    with pytest.raises(OverloadedError, match=str(MAX_ON_DEMAND)):
        grids.compute(record, 2.2)
    own = grids.compute(record, 1.5)
    encoders.go_on.set()
    assert all(future.result(60.0) is not None for future in (*futures, own))


# Outages of the database


def _looked_up(lookup: PlanLookup, tenant: str, plan_id: str) -> PlanRecord | None:
    async def find() -> PlanRecord | None:
        reads = BoundedReads(threads=1, max_pending=1, wait_s=30.0)
        try:
            return await lookup.find(tenant, plan_id, reads)
        finally:
            reads.close()

    return asyncio.run(find())


@pytest.mark.slow
def test_recent_plans_are_served_during_an_outage(postgres: PostgresServer, make_grids: MakeGrids) -> None:
    url = postgres.new_database()
    store, elsewhere, without_memory = Store(url), Store(url), Store(url, plan_cache_bytes=0)
    grids, record = make_grids(store), _add(store)
    known = PlanLookup(store, max_age_s=600.0)
    forgetful = PlanLookup(store, max_age_s=0.0)
    without = PlanLookup(without_memory, max_age_s=600.0)
    assert _looked_up(known, "default", "p") == _looked_up(forgetful, "default", "p") == record
    assert _looked_up(without, "default", "p") is not None
    grids.compute(record, 1.5).result(30.0)
    _add(elsewhere, plan_id="q")
    postgres.stop()
    try:
        assert _looked_up(known, "default", "p") == record
        assert grids.cache.find(grids.key(record.revision_id, 1.5)) is not None
        unknown = [(known, "default", "q"), (known, "other", "p"), (forgetful, "default", "p")]
        for plans, tenant, plan_id in [*unknown, *2 * [(without, "default", "p")]]:
            with pytest.raises(StoreUnavailableError):
                _looked_up(plans, tenant, plan_id)
        with pytest.raises(StoreUnavailableError):
            grids.compute(record, 1.6).result(30.0)
    finally:
        postgres.start()
    wait_for(lambda: _looked_up(known, "default", "q") is not None)
    # An outage is not a failure of the plan.
    assert grids.compute(record, 1.6).result(30.0) is not None
    store.plans.delete("default", "p")
    wait_for(lambda: _looked_up(known, "default", "p") is None)
    for opened in (store, elsewhere, without_memory):
        opened.close()


def test_busy_database_does_not_serve_cached_plans(tmp_path: Path) -> None:
    store = Store(f"sqlite:///{tmp_path / 'test.sqlite3'}", connections=1, wait_s=0.05)
    known = PlanLookup(store, max_age_s=600.0)
    record = _add(store)
    assert _looked_up(known, "default", "p") == record
    with store.database.reading():
        # As if the database answered other callers meanwhile.
        store.database._answered_s = float("inf")
        for _ in range(2):
            with pytest.raises(StoreBusyError):
                _looked_up(known, "default", "p")
        store.database._answered_s = 0.0
        assert _looked_up(known, "default", "p") == record
    store.close()


# The whole service


@given(st.floats(0.0, 3.0))
@example(2.399)
@example(0.1)
@example(0.001)
def test_rounded_height_is_below_the_ceiling(asked_m: float) -> None:
    now = datetime.now(UTC)
    record = PlanRecord(
        id="p", tenant="t", revision_id="r", revision=1, created_at=now, updated_at=now, plan=PLAN, failure=None
    )
    if not 0.1 <= asked_m < 2.4:
        with pytest.raises(InvalidPoseError, match=r"at least 0\.1 and below .*2\.4"):
            check_height_m(record, asked_m)
        return
    check_height_m(record, asked_m)
    assert grid_height_m(record, asked_m, latents_alone=False) == PLAN.camera_height_m
    height_m = grid_height_m(record, asked_m, latents_alone=True)
    assert 0.0 < height_m < 2.4
    assert abs(height_m - asked_m) <= 0.0201
    assert grid_height_m(record, height_m, latents_alone=True) == pytest.approx(height_m)


@pytest.mark.one_replica
def test_new_model_recomputes_grids(start_app: StartApp, tiny_bundle: Path, tmp_path: Path, sphere: bytes) -> None:
    with start_app(tmp_path / "data") as client:
        plan_id = upload(client)
        old = localise(client, plan_id, sphere, refine="none").json()["model"]["sha256"]
    other = tmp_path / "other"
    shutil.copytree(tiny_bundle, other)
    (other / "note.txt").write_text("another model")
    bundle = write_manifest(other, Bundle.open(tiny_bundle).manifest)
    assert bundle.sha256 != old
    with start_app(tmp_path / "data", bundle=other) as client:
        wait_for(lambda: client.get(f"/floorplans/{plan_id}").json()["status"] == "ready")
        assert "lalaloc_grid_seconds_count 1.0" in client.get("/metrics").text
        assert localise(client, plan_id, sphere, refine="none").json()["model"]["sha256"] == bundle.sha256


def test_profile_model_needs_one_grid_for_all_heights(
    start_app: StartApp, app_store: Store, tmp_path: Path, sphere: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(builder, "_MAX_GRIDS_PER_PLAN", 3)
    with start_app(tmp_path) as client:
        plan_id = upload(client)
        for height_m in (1.6, 1.7, 1.8, 1.9):
            answer = localise(client, plan_id, sphere, refine="none", camera_height_m=height_m)
            assert answer.json()["camera_height_m"] == height_m
    with start_app(tmp_path) as client:
        sha256 = client.get("/readyz").json()["model"]["sha256"]
    assert {height for _, height in app_store.grids.poses(sha256, 0.5)} == {1500}
