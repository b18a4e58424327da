"""Disk space of SQLite: deletions on a full disk, space that goes back, and lost files."""

from __future__ import annotations

import errno
import json
import logging
import shutil
import sqlite3
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from lalaloc_core.errors import ConfigError
from lalaloc_core.floorplan import FloorPlan
from service.cli.entry_point import main
from service.errors import StoreFullError
from service.storage import database, disk_reserve
from service.storage.records import DEFAULT_TENANT, NewPlan, Original
from service.storage.store import Store
from service.telemetry import LOGGER_NAME
from tests.service.conftest import FLAT, DatabaseOf, StartApp, assert_problem, original_of, upload, wait_for

PLAN = FloorPlan.from_dict(FLAT)
MIB = 2**20
pytestmark = pytest.mark.one_replica


def _file(folder: Path) -> Path:
    return folder / "lalaloc.sqlite3"


def _open(folder: Path) -> Store:
    return Store(f"sqlite:///{_file(folder)}")


def _add(store: Store, plan_id: str, size: int) -> None:
    store.plans.add("a", plan_id, NewPlan(PLAN, Original(bytes(size))), limit=100)


def _make_old(folder: Path) -> None:
    """Make a file as earlier versions did: it keeps its free pages."""
    _open(folder).close()
    with sqlite3.connect(_file(folder)) as raw:
        raw.execute("PRAGMA auto_vacuum = NONE")
        raw.execute("VACUUM")
    raw.close()


def test_deletion_writes_a_fraction_of_the_deleted_bytes(tmp_path: Path) -> None:
    store = _open(tmp_path)
    _add(store, "p", 20 * MIB)
    with store.database._driver_cursor() as cursor:
        cursor.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
    assert store.plans.delete("a", "p")
    assert _file(tmp_path).with_name("lalaloc.sqlite3-wal").stat().st_size < MIB
    store.close()


@pytest.mark.slow
def test_file_shrinks_after_deletions(tmp_path: Path) -> None:
    store = _open(tmp_path)
    for number in range(3):
        _add(store, f"p{number}", 10 * MIB)
    store.database.give_back()
    assert _file(tmp_path).stat().st_size > 30 * MIB
    # Not the last ones, so that pages are moved.
    for number in range(2):
        assert store.plans.delete("a", f"p{number}")
    store.database.give_back(lambda: True)
    assert _file(tmp_path).stat().st_size > 30 * MIB
    store.database.give_back()
    assert _file(tmp_path).stat().st_size < 16 * MIB
    assert original_of(store, "p2") == bytes(10 * MIB)
    store.close()


@pytest.mark.slow
def test_old_file_shrinks_after_it_was_compacted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LALALOC_DATA_DIR", str(tmp_path))
    _make_old(tmp_path)
    store = _open(tmp_path)
    _add(store, "p", 20 * MIB)
    assert store.plans.delete("a", "p")
    store.database.give_back()
    assert _file(tmp_path).stat().st_size > 20 * MIB
    assert main(["compact"]) == 0
    store.database.give_back()
    assert _file(tmp_path).stat().st_size < 5 * MIB
    _add(store, "p", 20 * MIB)
    assert store.plans.delete("a", "p")
    store.database.give_back()
    assert _file(tmp_path).stat().st_size < 10 * MIB
    store.close()


@pytest.mark.slow
def test_service_returns_space_by_itself(start_app: StartApp, database_of: DatabaseOf, tmp_path: Path) -> None:
    # Stored without an upload, whose time and speed are limited.
    store, plan_id = Store(database_of(tmp_path)), "0" * 32
    store.plans.add(DEFAULT_TENANT, plan_id, NewPlan(PLAN, Original(bytes(20 * MIB))), limit=100)
    store.close()
    if not _file(tmp_path).exists():
        pytest.skip("about SQLite's file")
    assert _file(tmp_path).stat().st_size > 20 * MIB
    with start_app(tmp_path, sweep_s=0.1) as client:
        # The database can be busy with the plan's pose grid.
        wait_for(lambda: client.delete(f"/floorplans/{plan_id}").status_code in (204, 404))
        wait_for(lambda: _file(tmp_path).stat().st_size < 10 * MIB, timeout_s=300.0)


class _Disk:
    """Disk with little space, as seen by the reserve; SQLite's part of it is limited in pages."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.free = 10**9
        monkeypatch.setattr(disk_reserve.shutil, "disk_usage", lambda _folder: SimpleNamespace(free=self.free))


def test_upload_needs_room_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk, store = _Disk(monkeypatch), _open(tmp_path)
    _add(store, "p", MIB)
    disk.free = 15 * MIB
    with pytest.raises(StoreFullError):
        _add(store, "q", 10 * MIB)
    disk.free = 20 * MIB
    _add(store, "q", 10 * MIB)
    # Deleted pages are used again.
    assert store.plans.delete("a", "q")
    disk.free = 15 * MIB
    _add(store, "q", 10 * MIB)
    store.close()


def test_deletion_on_a_full_disk_uses_the_reserve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk, store = _Disk(monkeypatch), _open(tmp_path)
    store.database.give_back()
    for plan_id in ("p", "q"):
        _add(store, plan_id, 3 * MIB)
    reserve = _file(tmp_path).with_name("lalaloc.sqlite3-reserve")
    assert reserve.stat().st_size == 4 * MIB
    transaction = store.database._transaction

    def full_without_reserve(engine: Any) -> Any:
        if reserve.stat().st_size:
            raise StoreFullError
        return transaction(engine)

    monkeypatch.setattr(store.database, "_transaction", full_without_reserve)
    disk.free = 0
    assert store.plans.delete("a", "p")
    # Nothing is stored until the reserve is whole again, so that the next deletion works, too.
    assert reserve.stat().st_size == 0
    with pytest.raises(StoreFullError):
        _add(store, "r", 1)
    assert store.plans.delete("a", "q")
    monkeypatch.undo()
    store.database.give_back()
    assert reserve.stat().st_size == 4 * MIB
    _add(store, "r", 1)
    store.close()


def test_failed_reserve_leaves_no_file_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reserve = disk_reserve.DiskReserve(str(tmp_path / "x"))
    monkeypatch.setattr(Path, "open", Mock(side_effect=OSError(errno.ENOSPC, "full")))
    assert not reserve.restore()
    assert not (tmp_path / "x-reserve").exists()


@pytest.mark.parametrize("empty", [True, False])
def test_lost_file_beside_its_log_prevents_the_start(tmp_path: Path, empty: bool) -> None:
    store = _open(tmp_path)
    _add(store, "p", 10)
    for suffix in ("", "-wal"):
        shutil.copy(f"{_file(tmp_path)}{suffix}", tmp_path / f"copy{suffix}")
    store.close()
    (tmp_path / "copy").unlink()
    if empty:
        (tmp_path / "copy").touch()
    with pytest.raises(ConfigError, match=r"copy-wal' beside it has .* bytes of its data"):
        Store(f"sqlite:///{tmp_path / 'copy'}")
    assert (tmp_path / "copy-wal").stat().st_size > 0


def test_start_without_plans_is_a_warning(start_app: StartApp, tmp_path: Path) -> None:
    warnings: list[str] = []
    handler, logger = logging.Handler(logging.WARNING), logging.getLogger(LOGGER_NAME)
    handler.emit = lambda record: warnings.append(record.getMessage())
    logger.addHandler(handler)
    try:
        with start_app(tmp_path, log_level="warning") as client:
            upload(client)
        assert warnings == ["the database has no floor plans"]
        with start_app(tmp_path, log_level="warning"):
            pass
        assert len(warnings) == 1
    finally:
        logger.removeHandler(handler)


def limit_pages(monkeypatch: pytest.MonkeyPatch, pages: int) -> None:
    """Limit the size of SQLite files that are opened later."""
    prepare = database._prepare_sqlite

    def with_little_room(connection: Any, record: Any) -> None:
        prepare(connection, record)
        connection.execute(f"PRAGMA max_page_count = {pages}")

    monkeypatch.setattr(database, "_prepare_sqlite", with_little_room)


def test_full_database_refuses_uploads_and_allows_deletions(
    start_app: StartApp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit_pages(monkeypatch, 1000)
    padded = json.dumps(FLAT).encode() + b" " * 1_100_000
    headers = {"content-type": "application/json"}
    with start_app(tmp_path) as client:
        if not _file(tmp_path).exists():
            pytest.skip("about SQLite's file")
        plans = []
        while (answer := client.post("/floorplans", content=padded, headers=headers)).status_code == 201:
            plans.append(answer.json()["id"])
        assert_problem(answer, 507, "store-full")
        assert answer.headers["retry-after"] == "60"
        assert client.get(f"/floorplans/{plans[0]}").status_code == 200
        for plan_id in plans:
            assert client.delete(f"/floorplans/{plan_id}").status_code == 204
        upload(client)
