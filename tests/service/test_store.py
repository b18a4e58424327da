"""What is stored comes back the same, in one piece or not at all."""

from __future__ import annotations

import io
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from lalaloc_core.errors import ConfigError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.poses import LatentGrid
from lalaloc_core.sampling import PoseSet
from service.errors import TooManyFloorPlansError
from service.store import GridKey, Store
from tests.service.conftest import FLAT


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    opened = Store(_url(tmp_path))
    yield opened
    opened.close()


def _url(folder: Path) -> str:
    return f"sqlite:///{folder / 'test.sqlite3'}"


def _add(store: Store, plan_id: str = "a" * 32) -> str:
    store.add_plan(plan_id, FloorPlan.from_dict(FLAT), original=b"{}", limit=100)
    return plan_id


def _key(plan_id: str, **changes: object) -> GridKey:
    values = {"plan_id": plan_id, "model_sha256": "m1", "step_m": 0.5, "camera_height_mm": 1500} | changes
    return GridKey(**values)  # pyright: ignore[reportArgumentType]


def _grid(seed: int = 0, count: int = 7) -> LatentGrid:
    rng = np.random.default_rng(seed)
    poses = PoseSet(rng.normal(size=(count, 2)), rng.integers(0, 2, count))
    latents, profile_m = rng.normal(size=(count, 128)), rng.uniform(0.3, 6.0, (count, 32))
    return LatentGrid(poses, latents.astype(np.float32), profile_m.astype(np.float32), 0.5, 1.5)


def _put(store: Store, key: GridKey, grid: LatentGrid, keep: int = 8) -> bool:
    return store.put_grid(key, grid, keep=keep, always_keep_mm=1500)


def test_a_plan_and_its_original_survive_reopening(tmp_path: Path) -> None:
    first = Store(_url(tmp_path))
    first.add_plan("p1", FloorPlan.from_dict(FLAT), original=b"\x00 as sent \xff", limit=10)
    first.close()
    second = Store(_url(tmp_path))
    record = second.plan("p1")
    assert record is not None
    assert record.plan.to_dict() == FloorPlan.from_dict(FLAT).to_dict()
    assert record.created_at.tzinfo is not None
    assert second.original("p1") == b"\x00 as sent \xff"
    second.close()


def test_a_grid_comes_back_exactly(store: Store) -> None:
    key, grid = _key(_add(store)), _grid()
    assert _put(store, key, grid)
    found = store.grid(key)
    assert found is not None
    np.testing.assert_array_equal(found.latents, grid.latents)
    np.testing.assert_array_equal(found.profile_m, grid.profile_m)
    assert found.profile_m.dtype == np.float32
    np.testing.assert_array_equal(found.poses.position_m, grid.poses.position_m)
    np.testing.assert_array_equal(found.poses.room_index, grid.poses.room_index)
    assert (found.step_m, found.camera_height_m) == (0.5, 1.5)


@pytest.mark.parametrize("changed", [{"model_sha256": "m2"}, {"step_m": 0.25}, {"camera_height_mm": 1520}])
def test_a_grid_is_found_for_its_own_key_only(store: Store, changed: dict[str, object]) -> None:
    plan_id = _add(store)
    _put(store, _key(plan_id), _grid())
    assert store.grid(_key(plan_id, **changed)) is None


def test_a_new_model_replaces_the_grids_of_the_old_one(store: Store) -> None:
    plan_id = _add(store)
    _put(store, _key(plan_id), _grid())
    _put(store, _key(plan_id, model_sha256="m2"), _grid(1))
    assert store.grid(_key(plan_id)) is None
    assert store.grid(_key(plan_id, model_sha256="m2")) is not None


def test_grids_of_other_heights_are_bounded_and_the_plans_own_is_never_dropped(store: Store) -> None:
    plan_id = _add(store)
    _put(store, _key(plan_id), _grid())
    for height_mm in (1600, 1620, 1640, 1660):
        _put(store, _key(plan_id, camera_height_mm=height_mm), _grid(), keep=3)
    assert set(store.grid_poses("m1", 0.5)) == {(plan_id, 1500), (plan_id, 1640), (plan_id, 1660)}


def test_deleting_a_plan_takes_original_and_grids_along(store: Store) -> None:
    plan_id = _add(store)
    _put(store, _key(plan_id), _grid())
    assert store.delete_plan(plan_id)
    assert not store.delete_plan(plan_id)
    assert store.plan(plan_id) is None
    assert store.original(plan_id) is None
    assert store.grid(_key(plan_id)) is None
    assert store.grid_poses("m1", 0.5) == {}


def test_a_grid_of_a_deleted_plan_is_not_stored(store: Store) -> None:
    plan_id = _add(store)
    store.delete_plan(plan_id)
    assert not _put(store, _key(plan_id), _grid())
    assert store.grid_poses("m1", 0.5) == {}


def test_a_plan_that_cannot_be_stored_whole_is_not_stored_at_all(store: Store) -> None:
    with pytest.raises(Exception, match=r"(?i)not null|interface|bind|type"):
        store.add_plan("p", FloorPlan.from_dict(FLAT), original=None, limit=10)  # pyright: ignore[reportArgumentType]
    assert store.plan("p") is None
    assert store.plan_count() == 0


def test_the_number_of_plans_is_limited(store: Store) -> None:
    _add(store)
    with pytest.raises(TooManyFloorPlansError, match="1 floor plans"):
        store.add_plan("b", FloorPlan.from_dict(FLAT), original=b"{}", limit=1)
    assert store.plan_count() == 1


def _archive(**arrays: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


@pytest.mark.parametrize(
    "arrays",
    [
        b"not an archive",
        _archive(position_m=np.zeros((3, 2)), room_index=np.zeros(3), latents=np.zeros((3, 128))),
        _archive(
            position_m=np.zeros((3, 2)), room_index=np.zeros(3), latents=np.zeros((3, 128)), profile_m=np.ones((2, 32))
        ),
    ],
    ids=["not an archive", "no profiles", "too few profiles"],
)
def test_damaged_or_incomplete_arrays_count_as_not_stored(store: Store, tmp_path: Path, arrays: bytes) -> None:
    key = _key(_add(store))
    _put(store, key, _grid())
    with sqlite3.connect(tmp_path / "test.sqlite3") as raw:
        raw.execute("UPDATE latent_grids_2 SET arrays = ?", (arrays,))
    assert store.grid(key) is None


def test_grids_of_an_older_format_are_dropped_and_plans_are_kept(tmp_path: Path) -> None:
    older = Store(_url(tmp_path))
    plan_id = _add(older)
    _put(older, _key(plan_id), _grid())
    older.close()
    with sqlite3.connect(tmp_path / "test.sqlite3") as raw:
        raw.execute("ALTER TABLE latent_grids_2 RENAME TO latent_grids")
    store = Store(_url(tmp_path))
    assert store.plan(plan_id) is not None
    # Not counted among the stored ones either, so that the service computes it again when it starts.
    assert store.grid_poses("m1", 0.5) == {}
    assert store.grid(_key(plan_id)) is None
    assert _put(store, _key(plan_id), _grid())
    assert store.grid(_key(plan_id)) is not None
    store.close()
    with sqlite3.connect(tmp_path / "test.sqlite3") as raw:
        assert raw.execute("SELECT name FROM sqlite_master WHERE name = 'latent_grids'").fetchall() == []


def test_sqlite_runs_with_foreign_keys_and_a_write_ahead_log(store: Store) -> None:
    with store._engine.connect() as connection:
        assert connection.exec_driver_sql("PRAGMA journal_mode").scalar() == "wal"
        assert connection.exec_driver_sql("PRAGMA foreign_keys").scalar() == 1


@pytest.mark.parametrize("url", ["nonsense", "sqlite:////no/such/folder/x.sqlite3", "nosuchdialect://x"])
def test_a_database_that_cannot_be_opened_is_a_configuration_error(url: str) -> None:
    with pytest.raises(ConfigError, match="database"):
        Store(url)


def test_listing_is_newest_first_and_paged(store: Store) -> None:
    ids = [_add(store, f"{index:032d}") for index in range(5)]
    assert [summary.id for summary in store.plans()] == ids[::-1]
    assert [summary.id for summary in store.plans(offset=1, limit=2)] == [ids[3], ids[2]]
