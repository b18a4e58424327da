"""Tests of stored pose grids and of the leases on them, on SQLite and PostgreSQL."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import struct
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from sqlalchemy import select, update

from service.storage.grid_format import pack
from service.storage.store import Store
from service.storage.tables import GRID_CHUNKS, GRID_LEASES, LATENT_GRIDS
from tests.service.conftest import OpenStore, wait_for
from tests.service.test_store import _add, _assert_same, _grid, _key, _put, _rows
from tests.strategies import present


@pytest.fixture
def store(open_store: OpenStore) -> Store:
    return open_store()


def test_grid_round_trip_is_exact_and_copies_nothing(store: Store) -> None:
    grid = _grid(count=5000)
    key = _key(_add(store))
    assert _put(store, key, grid)
    assert _rows(store, GRID_CHUNKS) > 1
    found = present(store.grids.get(key))
    _assert_same(found, grid)
    flags = present(found.latents).flags
    assert not flags.owndata
    assert not flags.writeable


def test_grid_without_latents_has_half_precision(store: Store) -> None:
    whole, key = _grid(count=50), _key(_add(store))
    grid = dataclasses.replace(whole, latents=None, profile_m=whole.profile_m.astype(np.float16))
    assert _put(store, key, grid)
    found = present(store.grids.get(key))
    assert found.latents is None
    assert found.profile_m.dtype == np.float16
    np.testing.assert_array_equal(found.profile_m, grid.profile_m)
    np.testing.assert_array_equal(found.poses.room_index, grid.poses.room_index)
    assert len(pack(grid).content) < 0.3 * len(pack(whole).content)


@pytest.mark.parametrize("changed", [{"model_sha256": "m2"}, {"step_m": 0.25}, {"camera_height_mm": 1520}])
def test_grid_is_found_by_its_key_only(store: Store, changed: dict[str, object]) -> None:
    revision_id = _add(store)
    _put(store, _key(revision_id))
    assert store.grids.get(_key(revision_id, **changed)) is None


def test_grids_of_the_previous_model_are_kept(store: Store) -> None:
    revision_id = _add(store)
    for model in ("m1", "m2", "m3"):
        _put(store, _key(revision_id, model_sha256=model))
    kept = [store.grids.get(_key(revision_id, model_sha256=model)) is not None for model in ("m1", "m2", "m3")]
    assert kept == [False, True, True]


def test_own_grid_is_never_dropped(store: Store) -> None:
    revision_id = _add(store)
    _put(store, _key(revision_id))
    for height_mm in (1600, 1620, 1640, 1660):
        _put(store, _key(revision_id, camera_height_mm=height_mm), keep=3)
    assert {height_mm for _, height_mm in store.grids.poses("m1", 0.5)} == {1500, 1640, 1660}


def _swapped_poses(content: bytes) -> bytes:
    """Return a valid grid, but not the one that was computed."""
    return content[:16] + content[32:48] + content[16:32] + content[48:]


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content[:-1],
        lambda content: content + b"x",
        lambda content: b"NOPE" + content[4:],
        lambda content: content[:4] + b"\x08" + content[5:],
        lambda content: b"",
        # First coordinate of the first pose.
        lambda content: content[:16] + struct.pack("<d", math.nan) + content[24:],
        # Last value of the last profile, before the room indices.
        lambda content: content[: -7 * 4 - 4] + struct.pack("<f", math.inf) + content[-7 * 4 :],
        _swapped_poses,
    ],
    ids=["cut off", "too long", "another format", "more poses", "empty", "no number", "infinite", "another digest"],
)
def test_damaged_grid_counts_as_missing(store: Store, damage: Callable[[bytes], bytes]) -> None:
    key = _key(_add(store))
    _put(store, key)
    with store.database.writing() as connection:
        content = present(connection.scalar(select(GRID_CHUNKS.c.content)))
        damaged = damage(bytes(content))
        connection.execute(update(GRID_CHUNKS).values(content=damaged))
        # Size and digest agree, so that only the content is wrong.
        if damage is not _swapped_poses:
            digest = hashlib.sha256(damaged).hexdigest()
            connection.execute(update(LATENT_GRIDS).values(size_bytes=len(damaged), sha256=digest))
    assert store.grids.get(key) is None
    assert _put(store, key)
    assert store.grids.get(key) is not None


def test_grid_without_digest_counts_as_missing(store: Store) -> None:
    key = _key(_add(store))
    _put(store, key)
    with store.database.writing() as connection:
        connection.execute(update(LATENT_GRIDS).values(sha256=None))
    assert store.grids.get(key) is None
    assert store.grids.poses("m1", 0.5) == {}
    assert [summary.revision_id for summary in store.grids.missing("m1", 0.5, 10)] == [key.revision_id]
    assert store.grids.count_unprepared("m1", 0.5) == 1
    assert _put(store, key)
    assert store.grids.get(key) is not None


# Leases


def test_lease_of_a_fast_clock_is_expired(store: Store) -> None:
    key = _key(_add(store))
    store.leases.claim(key, "ahead", 60.0)
    two_days_s = 2 * 24 * 3600.0
    with store.database.writing() as connection:
        connection.execute(update(GRID_LEASES).values(lease_until_s=GRID_LEASES.c.lease_until_s + two_days_s))
    assert store.leases.progress("m1", 0.5, [key.revision_id]) == {}
    assert [summary.revision_id for summary in store.grids.missing("m1", 0.5, 10)] == [key.revision_id]
    assert store.leases.claim(key, "me", 60.0) == 2
    assert store.leases.claim(key, "other", 60.0) is None


def test_lease_without_length_holds_until_its_end(store: Store) -> None:
    key = _key(_add(store))
    store.leases.claim(key, "earlier", 60.0)
    with store.database.writing() as connection:
        connection.execute(update(GRID_LEASES).values(length_s=None))
    assert store.leases.claim(key, "me", 60.0) is None


def test_lease_counts_attempts_until_released_or_its_grid_is_stored(store: Store) -> None:
    key, counts = _key(_add(store)), []
    for owner in ("one", "two", "one"):
        counts.append(store.leases.claim(key, owner, 0.001))
        time.sleep(0.01)
    assert counts == [1, 2, 3]
    store.leases.release(key, "one")
    assert store.leases.claim(key, "two", 60.0) == 1
    _put(store, key)
    assert _rows(store, GRID_LEASES) == 0


def test_lease_is_exclusive_until_it_expires(open_store: OpenStore) -> None:
    first, second = open_store(), open_store()
    key = _key(_add(first))
    assert first.leases.claim(key, "one", 0.5)
    assert not second.leases.claim(key, "two", 0.5)
    assert first.leases.renew(key, "one", 0.5, 0.25)
    assert second.leases.progress("m1", 0.5, [key.revision_id]) == {(key.revision_id, 1500): 0.25}
    wait_for(lambda: second.leases.progress("m1", 0.5, [key.revision_id]) == {})
    assert second.leases.claim(key, "two", 60.0)
    assert not first.leases.renew(key, "one", 0.5, 0.5)
    first.leases.release(key, "one")
    assert not first.leases.claim(key, "one", 60.0)


def test_concurrent_claims_give_one_lease(open_store: OpenStore) -> None:
    stores = [open_store(), open_store()]
    key = _key(_add(stores[0]))
    start = threading.Barrier(8)

    def claim(number: int) -> bool:
        start.wait(10.0)
        return stores[number % 2].leases.claim(key, f"owner {number}", 60.0) is not None

    with ThreadPoolExecutor(8) as threads:
        assert sum(threads.map(claim, range(8))) == 1


def test_deleted_plan_has_no_lease_and_gets_no_grid(store: Store) -> None:
    key = _key(_add(store, "p"))
    assert store.leases.claim(key, "me", 60.0)
    store.plans.delete("default", "p")
    assert not _put(store, key)
    assert _rows(store, LATENT_GRIDS) == 0
    assert not store.leases.renew(key, "me", 60.0, 0.5)
    assert not store.leases.claim(key, "me", 60.0)


def test_missing_grids_exclude_leased_and_failed(store: Store) -> None:
    revisions = {name: _add(store, name) for name in ("stored", "leased", "failed", "other height", "missing")}
    _put(store, _key(revisions["stored"]))
    store.leases.claim(_key(revisions["leased"]), "someone", 1.0)
    store.plans.set_failure(revisions["failed"], "too large")
    _put(store, _key(revisions["other height"], camera_height_mm=1600))

    def missing() -> list[str]:
        return [summary.id for summary in store.grids.missing("m1", 0.5, 10)]

    assert missing() == ["other height", "missing"]
    wait_for(lambda: missing() == ["leased", "other height", "missing"])
    store.plans.clear_failures()
    assert [summary.id for summary in store.grids.missing("m1", 0.5, 2)] == ["leased", "failed"]
    assert len(store.grids.missing("m2", 0.5, 10)) == store.grids.count_unprepared("m2", 0.5) == 5
    store.leases.claim(_key(revisions["missing"]), "someone", 60.0)
    assert store.grids.count_unprepared("m1", 0.5) == 4
