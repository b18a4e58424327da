"""Tenants: the operator's limits, stored bytes and their quota, and purging, on SQLite and PostgreSQL."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import func, select

from lalaloc_core.floorplan import FloorPlan
from service.cli.entry_point import main
from service.errors import StorageQuotaError
from service.storage.album_rows import NewAlbum, NewPhotograph
from service.storage.records import (
    Claimed,
    ComputedGrid,
    GridKey,
    NewPlan,
    OperatorLimits,
    Original,
    StoredAnswer,
    VenueMember,
)
from service.storage.store import Store
from service.storage.tables import AUDIT_LOG, IDEMPOTENCY, METADATA, TENANTS
from tests.service.conftest import FLAT, StartApp, assert_problem, localise, upload, wait_for
from tests.service.test_store import _claimed, _grid

PLAN = FloorPlan.from_dict(FLAT)
MIB = 2**20


@pytest.fixture
def store(configured_url: str) -> Iterator[Store]:
    with closing(Store(configured_url, stored_bytes=10 * MIB, idempotency_bytes=MIB)) as opened:
        yield opened


def _add(store: Store, tenant: str, plan_id: str, size: int = MIB, **options: object) -> str:
    """Store a plan with a file of some size, and return the id of its revision."""
    original = Original(bytes(size))
    return store.plans.add(tenant, plan_id, NewPlan(PLAN, original, **options), limit=100).revision_id  # pyright: ignore[reportArgumentType]


def _keep_answer(store: Store, tenant: str, key: str, size: int) -> Claimed:
    claim = _claimed(store.idempotency_keys, tenant, "POST /x", key)
    store.idempotency_keys.finish(tenant, "POST /x", key, claim.token, StoredAnswer(200, {}, bytes(size)))
    return claim


def _recounted(store: Store, tenant: str) -> None:
    """Check that the counters are the sums of the rows."""
    counted = store.quota.account(tenant)
    store.quota.recount()
    assert store.quota.account(tenant) == counted


# Limits of the operator


def test_limits_are_set_and_reset(configured_url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tenants", "limit", "acme", "--stored-bytes", "1000", "--cpu-share", "0.5"]) == 0
    assert main(["tenants", "limit", "acme", "--bytes-in-flight", "2000", "--cpu-share", "default"]) == 0
    printed = capsys.readouterr().out.splitlines()[-3:]
    assert printed == ["stored_bytes: 1000", "bytes_in_flight: 2000", "cpu_share: default"]
    assert main(["tenants", "list", "--json"]) == 0
    [listed] = json.loads(capsys.readouterr().out)
    limits = {"stored_bytes": 1000, "bytes_in_flight": 2000, "cpu_share": None}
    assert listed == {"tenant": "acme", "used_bytes": 0, **limits}
    assert main(["tenants", "list"]) == 0
    assert capsys.readouterr().out.splitlines()[1].split() == ["acme", "0", "1000", "2000", "default"]


@pytest.mark.parametrize(
    "arguments",
    [
        ["limit", "acme", "--stored-bytes", "-1"],
        ["limit", "acme", "--stored-bytes", str(2**63)],
        ["limit", "acme", "--cpu-share", "0"],
        ["limit", "acme", "--cpu-share", "nan"],
        # It needs --yes.
        ["purge", "acme"],
    ],
)
def test_incomplete_command_is_a_usage_error(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as exit_info:
        main(["tenants", *arguments])
    assert exit_info.value.code == 2


def test_limits_in_memory_follow_the_database(store: Store) -> None:
    assert store.tenants.of("acme") == OperatorLimits()
    store.tenants.change_limits("acme", stored_bytes=2**40)
    store.tenants.refresh()
    assert store.tenants.of("acme") == OperatorLimits(stored_bytes=2**40)
    assert store.tenants.of("other") == OperatorLimits()
    store.tenants.change_limits("acme", stored_bytes=None)
    store.tenants.refresh()
    assert store.tenants.of("acme") == OperatorLimits()


# Stored bytes


def test_stored_bytes_follow_every_change(store: Store) -> None:
    revision_id = _add(store, "a", "p" * 32)
    assert MIB < store.quota.account("a").used.plans < 1.01 * MIB
    _add(store, "a", "q" * 32, 2 * MIB, grid=ComputedGrid(model_sha256="m1", grid=_grid()))
    key = GridKey(revision_id=revision_id, model_sha256="m1", step_m=0.5, camera_height_mm=1500)
    for height_mm in (1500, 1500, 1600, 1620, 1640):
        height_key = replace(key, camera_height_mm=height_mm)
        assert store.grids.put(height_key, _grid(count=1000), keep=2, always_keep_mm=1500)
    _recounted(store, "a")
    for _ in range(4):
        store.plans.add_revision("a", "p" * 32, NewPlan(PLAN, Original(bytes(MIB))), keep=2)
        _recounted(store, "a")
    assert store.quota.account("a").used.plans == pytest.approx(4 * MIB, rel=0.01)
    store.venues.add("a", "v", "venue", None, [VenueMember("p" * 32), VenueMember("q" * 32)], limit=9)
    store.venues.change("a", "v", removed=["q" * 32], max_plans=9)
    _recounted(store, "a")
    kept = [store.answers.add("a", "p" * 32, lambda answer_id: answer_id * 100, limit=2) for _ in range(4)]
    _keep_answer(store, "a", "k", 1000)
    _recounted(store, "a")
    album = NewAlbum(name="a", plan_id="q" * 32, venue_id=None, options="{}", model_sha256="m1")
    store.albums.add("a", "c" * 32, album, ttl_s=60.0, limit=9)
    photograph = NewPhotograph(sha256="0" * 64, name="p.jpg", facts="{}", entry=bytes(1000))
    for _ in range(2):
        store.albums.add_photograph("a", "c" * 32, photograph, ttl_s=60.0, limit=9)
    _recounted(store, "a")
    used = store.quota.account("a").used
    assert 1000 < used.albums < 10_000
    # No session was begun.
    assert {kind for kind, size in vars(used).items() if size == 0} == {"sessions"}
    assert store.answers.delete("a", kept[-1] or "")
    assert store.plans.delete("a", "p" * 32)
    _recounted(store, "a")
    assert store.plans.delete("a", "q" * 32)
    assert store.venues.delete("a", "v")
    store.idempotency_keys.delete_all("a")
    assert store.quota.account("a").used.total == 0
    _recounted(store, "a")


def test_tenant_cannot_store_more_than_its_quota(store: Store) -> None:
    for number in range(9):
        _add(store, "a", f"p{number}")
    with pytest.raises(StorageQuotaError, match=r"needs .* more; the limit is 10485760 .*LALALOC_MAX_STORED_BYTES"):
        _add(store, "a", "q")
    with pytest.raises(StorageQuotaError):
        store.plans.add_revision("a", "p0", NewPlan(PLAN, Original(bytes(MIB))), keep=2)
    store.tenants.change_limits("a", stored_bytes=store.quota.account("a").used.total)
    with pytest.raises(StorageQuotaError, match="lalaloc-service tenants limit"):
        store.venues.add("a", "v", "venue", None, [], limit=9)
    with pytest.raises(StorageQuotaError):
        store.answers.add("a", "p0", lambda answer_id: answer_id, limit=9)
    store.tenants.change_limits("a", stored_bytes=None)
    assert store.plans.get("a", "q") is None
    _recounted(store, "a")
    _add(store, "b", "q")
    assert store.plans.delete("a", "p0")
    _add(store, "a", "p0")


def test_room_for_the_grid_is_needed_at_the_upload(store: Store) -> None:
    with pytest.raises(StorageQuotaError):
        _add(store, "a", "p", later_bytes=10 * MIB)
    revision_id = _add(store, "a", "p", later_bytes=8 * MIB)
    store.tenants.change_limits("a", stored_bytes=2 * MIB)
    key = GridKey(revision_id=revision_id, model_sha256="m1", step_m=0.5, camera_height_mm=1500)
    with pytest.raises(StorageQuotaError, match="lalaloc-service tenants limit"):
        store.grids.put(key, _grid(count=2000), keep=8, always_keep_mm=1500)
    assert store.grids.get(key) is None
    _recounted(store, "a")


def test_concurrent_uploads_do_not_exceed_the_quota(store: Store, url: str) -> None:
    stores = [store, Store(url, stored_bytes=10 * MIB)]
    with ThreadPoolExecutor(8) as threads:
        adding = [threads.submit(_add, stores[number % 2], "a", f"p{number}", 2 * MIB) for number in range(16)]
    assert Counter(type(added.exception()) for added in adding) == {type(None): 4, StorageQuotaError: 12}
    assert store.quota.account("a").used.total <= 10 * MIB
    _recounted(store, "a")
    stores[1].close()


def test_oldest_idempotent_answers_are_deleted_first(store: Store) -> None:
    first = _keep_answer(store, "a", "0", 10_000)
    for number in range(1, 150):
        _keep_answer(store, "a", str(number), 10_000)
        assert store.quota.account("a").used.idempotency <= MIB
    assert store.idempotency_keys.begin("a", "POST /x", "149", "body") == StoredAnswer(200, {}, bytes(10_000))
    assert _claimed(store.idempotency_keys, "a", "POST /x", "0") != first
    _recounted(store, "a")


def test_idempotent_answer_beyond_the_quota_is_not_kept(store: Store) -> None:
    _add(store, "a", "p", 10 * MIB - 10_000)
    claim = _claimed(store.idempotency_keys, "a", "POST /x", "k")
    with pytest.raises(StorageQuotaError):
        store.idempotency_keys.finish("a", "POST /x", "k", claim.token, StoredAnswer(200, {}, bytes(20_000)))
    store.idempotency_keys.abandon("a", "POST /x", "k", claim.token)
    # The next attempt works under the same token, so nothing is stored twice.
    assert store.idempotency_keys.begin("a", "POST /x", "k", "body") == claim
    for number in range(100):
        unfinished = _claimed(store.idempotency_keys, "a", "POST /x", f"k{number}")
        store.idempotency_keys.abandon("a", "POST /x", f"k{number}", unfinished.token)
    with store.database.reading() as connection:
        assert (connection.scalar(select(func.count()).select_from(IDEMPOTENCY)) or 0) < 30
    _recounted(store, "a")


def test_purge_deletes_all_of_one_tenant(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    for tenant in ("a", "b"):
        _add(store, tenant, f"p{tenant}", grid=ComputedGrid(model_sha256="m1", grid=_grid()))
        store.venues.add(tenant, f"v{tenant}", "venue", None, [VenueMember(f"p{tenant}")], limit=9)
        store.answers.add(tenant, f"p{tenant}", lambda answer_id: answer_id, limit=2)
        _keep_answer(store, tenant, "k", 100)
    kept = store.quota.account("b")
    assert main(["tenants", "purge", "a", "--yes"]) == 0
    assert "deleted 1 floor plans of tenant 'a'" in capsys.readouterr().out
    assert store.quota.account("a").used.total == 0
    assert store.quota.account("b") == kept
    assert main(["tenants", "purge", "b", "--yes"]) == 0
    with store.database.reading() as connection:
        counts = {table.name: select(func.count()).select_from(table) for table in METADATA.sorted_tables}
        left = {name: connection.scalar(count) for name, count in counts.items()}
    assert {name for name, count in left.items() if count} == {TENANTS.name, AUDIT_LOG.name}


# The service


def _usage(client: httpx.Client) -> dict[str, Any]:
    return client.get("/usage").json()["stored_bytes"]


@pytest.mark.slow
def test_full_tenant_is_refused_and_can_delete(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    padded = json.dumps(FLAT).encode() + b" " * MIB
    headers = {"content-type": "application/json"}
    with start_app(tmp_path, max_stored_bytes=4 * MIB, keep_answers_s=60.0) as client:
        plans = []
        while (answer := client.post("/floorplans", content=padded, headers=headers)).status_code == 201:
            plans.append(answer.json()["id"])
        assert 2 <= len(plans) <= 3
        problem = assert_problem(answer, 507, "storage-quota")
        used = _usage(client)
        assert used["limit"] == 4 * MIB
        assert f"{used['used']} bytes are stored" in problem["detail"]
        assert "LALALOC_MAX_STORED_BYTES" in problem["detail"]
        assert sum(used["by_kind"].values()) == used["used"]
        put = client.put(f"/floorplans/{plans[0]}", content=padded, headers=headers)
        assert_problem(put, 507, "storage-quota")
        assert localise(client, plans[0], sphere).status_code == 200
        for plan_id in plans:
            assert client.delete(f"/floorplans/{plan_id}").status_code == 204
        left = _usage(client)
        assert left["used"] == left["by_kind"]["idempotency"] == 0
        upload(client)


@pytest.mark.one_replica
def test_stored_bytes_are_metrics(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, sweep_s=0.1) as client:
        upload(client)
        expected = f'lalaloc_stored_bytes{{kind="plans",tenant="default"}} {float(_usage(client)["by_kind"]["plans"])}'
        wait_for(lambda: expected in client.get("/metrics").text)
        assert re.search(r'lalaloc_stored_bytes_limit\{tenant="default"\} \d', client.get("/metrics").text)
