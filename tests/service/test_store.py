"""Tests of the store on SQLite and PostgreSQL."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import numpy as np
import pytest
from sqlalchemy import delete, event, func, select, update

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.render.sampling import PoseSet
from service.errors import RevisionMismatchError, ServiceError, TooManyFloorPlansError, UnknownFloorPlanError
from service.storage import database
from service.storage.kept_answers import KEPT_FOR, IdempotencyKeys
from service.storage.plans import PlanDocument
from service.storage.records import (
    Claimed,
    ComputedGrid,
    Conflict,
    GridKey,
    InProgress,
    NewPlan,
    Original,
    StoredAnswer,
)
from service.storage.statements import CHUNK_BYTES
from service.storage.store import Store
from service.storage.tables import IDEMPOTENCY, METADATA, ORIGINAL_CHUNKS, REVISIONS, TENANTS
from tests.service.conftest import FLAT, OpenStore, original_of
from tests.strategies import present

PLAN = FloorPlan.from_dict(FLAT)


@pytest.fixture
def store(open_store: OpenStore) -> Store:
    return open_store()


def _url(folder: Path) -> str:
    return f"sqlite:///{folder / 'test.sqlite3'}"


def _add(store: Store, plan_id: str = "a" * 32, *, tenant: str = "default", name: str = "Flat 3") -> str:
    plan = FloorPlan.from_dict({**FLAT, "name": name})
    return store.plans.add(tenant, plan_id, NewPlan(plan, Original(b"{}")), limit=100).revision_id


def _key(revision_id: str, **changes: object) -> GridKey:
    values = {"revision_id": revision_id, "model_sha256": "m1", "step_m": 0.5, "camera_height_mm": 1500} | changes
    return GridKey(**values)  # pyright: ignore[reportArgumentType]


def _grid(seed: int = 0, count: int = 7) -> PoseGrid:
    rng = np.random.default_rng(seed)
    poses = PoseSet(rng.normal(size=(count, 2)), rng.integers(0, 2, count))
    latents, profile_m = rng.normal(size=(count, 128)), rng.uniform(0.3, 6.0, (count, 32))
    return PoseGrid(poses, latents.astype(np.float32), profile_m.astype(np.float32), 0.5, 1.5)


def _put(store: Store, key: GridKey, grid: PoseGrid | None = None, keep: int = 8) -> bool:
    return store.grids.put(key, grid or _grid(), keep=keep, always_keep_mm=1500)


def _assert_same(found: PoseGrid | None, grid: PoseGrid) -> None:
    assert found is not None
    assert found.latents is not None
    np.testing.assert_array_equal(found.latents, grid.latents)
    np.testing.assert_array_equal(found.profile_m, grid.profile_m)
    np.testing.assert_array_equal(found.poses.position_m, grid.poses.position_m)
    np.testing.assert_array_equal(found.poses.room_index, grid.poses.room_index)
    assert (found.latents.dtype, found.profile_m.dtype) == (np.float32, np.float32)
    assert (found.step_m, found.camera_height_m) == (grid.step_m, grid.camera_height_m)


def _rows(store: Store, table: object) -> int:
    with store.database.reading() as connection:
        return connection.scalar(select(func.count()).select_from(table)) or 0  # pyright: ignore[reportArgumentType]


def _filled_tables(store: Store) -> list[str]:
    """Return the tables with rows, except the counters of tenants."""
    return [table.name for table in METADATA.sorted_tables if table is not TENANTS and _rows(store, table)]


# Plans and originals


def test_plan_cache_saves_parsing_unless_disabled(tmp_path: Path) -> None:
    kept, not_kept = Store(_url(tmp_path)), Store(_url(tmp_path), plan_cache_bytes=0)
    revision_id = _add(kept, "p")
    for store, same in ((kept, True), (not_kept, False)):
        reads = [store.plans.get("default", "p") for _ in range(2)]
        assert reads[0] is not None
        assert reads[1] is not None
        assert (reads[0].plan is reads[1].plan) == same
        assert reads[0].plan.to_dict() == reads[1].plan.to_dict()
        assert store.plan_cache.revisions() == ({revision_id} if same else set())
    changed = FloorPlan.from_dict({**FLAT, "name": "changed"})
    kept.plans.add_revision("default", "p", NewPlan(changed, Original(b"{}")), keep=5)
    records = [kept.plans.get("default", "p"), kept.plans.get("default", "p", revision_id)]
    assert [record and record.plan.name for record in records] == ["changed", "Flat 3"]
    assert kept.plans.delete("default", "p")
    assert kept.plan_cache.revisions() == set()
    for store in (kept, not_kept):
        store.close()


@pytest.mark.parametrize("size", [0, 1, CHUNK_BYTES, 2 * CHUNK_BYTES + 3])
def test_stored_plan_is_visible_to_other_processes(open_store: OpenStore, size: int) -> None:
    first, second = open_store(), open_store()
    original = np.random.default_rng(1).bytes(size)
    added = first.plans.add("default", "p1", NewPlan(PLAN, Original(original)), limit=10)
    record = present(second.plans.get("default", "p1"))
    assert record.plan.to_dict() == PLAN.to_dict()
    assert (record.revision_id, record.revision) == (added.revision_id, 1)
    assert record.created_at == added.created_at
    assert record.created_at.utcoffset() == timedelta(0)
    assert original_of(second, "p1") == original
    assert first.plans.delete("default", "p1")
    assert second.plans.get("default", "p1") is None


def test_plan_is_stored_with_its_grid(store: Store) -> None:
    computed = ComputedGrid(model_sha256="m1", grid=_grid())
    record = store.plans.add("default", "p1", NewPlan(PLAN, Original(b"{}"), grid=computed), limit=10)
    _assert_same(store.grids.get(computed.key(record.revision_id)), computed.grid)


@pytest.mark.parametrize("broken", ["original", "grid"])
def test_failed_insert_stores_nothing(store: Store, broken: str) -> None:
    grid = ComputedGrid(model_sha256=None if broken == "grid" else "m1", grid=_grid())  # pyright: ignore[reportArgumentType]
    original = None if broken == "original" else b"{}"
    with pytest.raises(Exception, match=r"(?i)not.null|buffer"):
        store.plans.add("default", "p", NewPlan(PLAN, Original(original), grid=grid), limit=10)  # pyright: ignore[reportArgumentType]
    assert store.plans.get("default", "p") is None
    assert _filled_tables(store) == []


def test_plan_limit_is_per_tenant(store: Store) -> None:
    _add(store, tenant="one")
    store.plans.add("two", "b", NewPlan(PLAN, Original(b"{}")), limit=1)
    with pytest.raises(TooManyFloorPlansError, match="1 stored floor plans"):
        store.plans.add("two", "c", NewPlan(PLAN, Original(b"{}")), limit=1)
    assert [summary.id for summary in store.plans.list_plans("two", limit=10)] == ["b"]


def test_plan_limit_holds_under_concurrency(open_store: OpenStore, monkeypatch: pytest.MonkeyPatch) -> None:
    # SQLite polls for its lock, so on a busy machine a writer can wait long for its turn.
    monkeypatch.setattr(database, "_SQLITE_WAIT_MS", 120_000)
    stores, plan = [open_store(), open_store()], NewPlan(PLAN, Original(b"{}"))
    with ThreadPoolExecutor(8) as threads:
        adding = [threads.submit(stores[n % 2].plans.add, "default", f"p{n}", plan, limit=5) for n in range(20)]
    assert Counter(type(added.exception()) for added in adding) == {type(None): 5, TooManyFloorPlansError: 15}
    assert len(stores[0].plans.list_plans("default", limit=10)) == 5


def test_plan_is_hidden_from_other_tenants(store: Store) -> None:
    revision_id = _add(store, "p", tenant="one")
    assert store.plans.get("two", "p") is None
    assert store.plans.get("two", "p", revision_id) is None
    assert store.plans.list_plans("two", limit=10) == []
    assert not store.plans.delete("two", "p")
    with pytest.raises(UnknownFloorPlanError):
        store.plans.add_revision("two", "p", NewPlan(PLAN, Original(b"")), keep=5)
    assert store.plans.get("one", "p") is not None


@pytest.mark.parametrize("half_way", ["SELECT revisions.document", "SELECT original_chunks"])
def test_read_during_deletion_is_complete(open_store: OpenStore, half_way: str) -> None:
    first, second = open_store(), open_store()
    original = bytes(CHUNK_BYTES + 1)
    added = first.plans.add("default", "p", NewPlan(PLAN, Original(original)), limit=10)

    def delete_elsewhere(*arguments: Any) -> None:
        if arguments[2].startswith(half_way):
            first.plans.delete("default", "p")

    event.listen(second.database._engine, "before_cursor_execute", delete_elsewhere)
    if "chunks" in half_way:
        assert second.originals.checked(added.revision_id) == ("application/json", len(original))
        assert second.originals.checked(added.revision_id) is None
        assert second.originals.chunk(added.revision_id, 0) is None
    else:
        assert second.plans.get("default", "p") == dataclasses.replace(added, plan=ANY)
    assert second.plans.get("default", "p") is None


def test_plan_is_parsed_outside_the_transaction(open_store: OpenStore) -> None:
    _add(open_store(), "p")
    in_use = []

    def watching() -> Store:
        store = open_store()

        def watched(document: PlanDocument) -> FloorPlan | None:
            in_use.append(store.database._engine.pool.checkedout())  # pyright: ignore[reportAttributeAccessIssue]
            return document.plan()

        store.plans.parse_with(watched)
        return store

    assert watching().plans.get("default", "p") is not None
    watching().plans.add("default", "p", NewPlan(PLAN, Original(b"{}")), limit=10)
    assert in_use == [0, 0]


def test_warnings_are_stored_and_not_recomputed(open_store: OpenStore) -> None:
    plan = dataclasses.replace(PLAN, warnings=("as found at the upload",))
    open_store().plans.add("default", "p", NewPlan(plan, Original(b"{}")), limit=10)
    assert present(open_store().plans.get("default", "p")).plan.warnings == plan.warnings


def test_plan_without_digest_is_validated_on_reading(open_store: OpenStore) -> None:
    rooms = [{"name": name, "polygon": [[0, 0], [4, 0], [4, 3], [0, 3]]} for name in ("one", "other")]
    plan = FloorPlan.from_dict({"ceiling_height_m": 2.5, "rooms": rooms})
    store = open_store()
    store.plans.add("default", "p", NewPlan(plan, Original(b"{}")), limit=10)
    with store.database.writing() as connection:
        connection.execute(update(REVISIONS).values(document_sha256=None, warnings=None))
    assert present(open_store().plans.get("default", "p")).plan.warnings == plan.warnings != ()


@pytest.mark.parametrize("cut_off", [True, False])
def test_damaged_original_is_an_error(store: Store, cut_off: bool) -> None:
    added = store.plans.add("default", "p", NewPlan(PLAN, Original(bytes(CHUNK_BYTES + 1))), limit=10)
    with store.database.writing() as connection:
        last = ORIGINAL_CHUNKS.c.number == 1
        connection.execute(
            delete(ORIGINAL_CHUNKS).where(last) if cut_off else update(ORIGINAL_CHUNKS).where(last).values(content=b"x")
        )
    with pytest.raises(ServiceError, match="original of floor plan 'p'"):
        store.originals.checked(added.revision_id)


def test_deleted_plan_leaves_no_rows(store: Store) -> None:
    revision_id = _add(store, "p")
    store.plans.add_revision("default", "p", NewPlan(PLAN, Original(b"second")), keep=5)
    _put(store, _key(revision_id))
    store.leases.claim(_key(revision_id, camera_height_mm=1600), "me", 60.0)
    assert store.plans.delete("default", "p")
    assert not store.plans.delete("default", "p")
    assert store.plans.get("default", "p", revision_id) is None
    assert store.grids.get(_key(revision_id)) is None
    assert _filled_tables(store) == []


def test_summaries_skip_missing_plans(store: Store) -> None:
    _add(store, "a", name="one")
    _add(store, "b", name="two")
    assert {summary.id: summary.name for summary in store.plans.summaries({"b", "gone"})} == {"b": "two"}
    assert store.plans.summaries(set()) == []


def test_repeated_upload_is_stored_once(store: Store) -> None:
    first = store.plans.add("default", "p", NewPlan(PLAN, Original(b"{}")), limit=1)
    again = store.plans.add("default", "p", NewPlan(PLAN, Original(b"{}")), limit=1)
    assert (again.revision_id, again.revision) == (first.revision_id, 1)
    assert len(store.plans.list_plans("default", limit=10)) == 1


# Revisions


def test_one_of_two_concurrent_revisions_is_rejected(open_store: OpenStore) -> None:
    stores, plan = [open_store(), open_store()], NewPlan(PLAN, Original(b"x"))
    old = _add(stores[0], "p")
    with ThreadPoolExecutor(2) as threads:
        adding = [threads.submit(one.plans.add_revision, "default", "p", plan, keep=5, expected=old) for one in stores]
    assert Counter(type(added.exception()) for added in adding) == {type(None): 1, RevisionMismatchError: 1}


def test_revisions_and_grids_are_limited(store: Store) -> None:
    ids = [_add(store, "p")]
    for number in range(4):
        _put(store, _key(ids[-1]))
        ids.append(
            store.plans.add_revision("default", "p", NewPlan(PLAN, Original(b"%d" % number)), keep=3).revision_id
        )
    kept = [store.plans.get("default", "p", revision_id) is not None for revision_id in ids]
    assert kept == [False, False, True, True, True]
    # Running queries can still need the grid of the previous revision.
    assert {revision_id for revision_id, _ in store.grids.poses("m1", 0.5)} == {ids[3]}
    assert _rows(store, ORIGINAL_CHUNKS) == 3


# Idempotency and keys

ANSWER = StoredAnswer(200, {"etag": '"x"'}, b'{"id": "x"}')


def _claimed(keys: IdempotencyKeys, tenant: str, route: str, key: str) -> Claimed:
    claim = keys.begin(tenant, route, key, "body")
    assert isinstance(claim, Claimed)
    return claim


def test_idempotent_request_is_carried_out_once(open_store: OpenStore) -> None:
    first, second = open_store(), open_store()
    claim = _claimed(first.idempotency_keys, "t", "POST /floorplans", "k")
    assert second.idempotency_keys.begin("t", "POST /floorplans", "k", "body") == InProgress()
    assert second.idempotency_keys.begin("t", "POST /floorplans", "k", "another") == Conflict()
    first.idempotency_keys.finish("t", "POST /floorplans", "k", claim.token, ANSWER)
    assert second.idempotency_keys.begin("t", "POST /floorplans", "k", "body") == ANSWER
    assert second.idempotency_keys.begin("t", "POST /floorplans", "k", "another") == Conflict()
    for route in (("u", "POST /floorplans", "k"), ("t", "POST /localise", "k"), ("t", "POST /floorplans", "l")):
        assert isinstance(second.idempotency_keys.begin(*route, "body"), Claimed)


def test_abandoned_request_can_be_claimed_again(store: Store) -> None:
    claim = _claimed(store.idempotency_keys, "t", "r", "k")
    store.idempotency_keys.abandon("t", "r", "k", "not the token")
    assert store.idempotency_keys.begin("t", "r", "k", "body") == InProgress()
    store.idempotency_keys.abandon("t", "r", "k", claim.token)
    assert store.idempotency_keys.begin("t", "r", "k", "another") == Conflict()
    # The token stays the same, because something can have been stored under it.
    assert store.idempotency_keys.begin("t", "r", "k", "body") == claim
    assert store.idempotency_keys.begin("t", "r", "k", "body") == InProgress()
    store.idempotency_keys.finish("t", "r", "k", claim.token, ANSWER)
    store.idempotency_keys.abandon("t", "r", "k", claim.token)
    assert store.idempotency_keys.begin("t", "r", "k", "body") == ANSWER


def test_expired_claim_is_taken_over_with_its_token(open_store: OpenStore) -> None:
    stores = [open_store(), open_store()]
    dead = _claimed(IdempotencyKeys(stores[0].database, stores[0].quota, lease_s=0.2), "t", "r", "k")
    time.sleep(0.3)
    with ThreadPoolExecutor(4) as threads:
        claims = list(threads.map(lambda n: stores[n % 2].idempotency_keys.begin("t", "r", "k", "body"), range(4)))
    assert [claim for claim in claims if claim != InProgress()] == [Claimed(dead.token)]
    # The answer of the first attempt no longer counts.
    stores[0].idempotency_keys.finish("t", "r", "k", dead.token, ANSWER)
    stores[1].idempotency_keys.finish("t", "r", "k", dead.token, dataclasses.replace(ANSWER, body=b"late"))
    assert stores[0].idempotency_keys.begin("t", "r", "k", "body") == ANSWER


def test_idempotency_keys_expire_after_a_day(store: Store) -> None:
    for key in ("old", "new"):
        claim = _claimed(store.idempotency_keys, "t", "r", key)
        store.idempotency_keys.finish("t", "r", key, claim.token, ANSWER)
    with store.database.writing() as connection:
        yesterday = datetime.now(UTC) - KEPT_FOR - timedelta(minutes=1)
        connection.execute(update(IDEMPOTENCY).where(IDEMPOTENCY.c.key == "old").values(created_at=yesterday))
    # Expired keys are not returned even before they are purged.
    assert isinstance(store.idempotency_keys.begin("t", "r", "old", "another"), Claimed)
    with store.database.writing() as connection:
        connection.execute(update(IDEMPOTENCY).where(IDEMPOTENCY.c.key == "old").values(created_at=yesterday))
    assert store.idempotency_keys.purge() == 1
    assert store.idempotency_keys.begin("t", "r", "new", "body") == ANSWER


def test_claim_of_a_fast_clock_is_expired(store: Store) -> None:
    claim = _claimed(store.idempotency_keys, "t", "r", "k")
    assert isinstance(store.idempotency_keys.begin("t", "r", "k", "body"), InProgress)
    with store.database.writing() as connection:
        connection.execute(update(IDEMPOTENCY).values(lease_until_s=IDEMPOTENCY.c.lease_until_s + 48 * 3600.0))
    assert store.idempotency_keys.begin("t", "r", "k", "body") == claim
    assert isinstance(store.idempotency_keys.begin("t", "r", "k", "body"), InProgress)
