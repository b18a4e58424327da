"""Tests of the database itself: its schema, SQLite's settings, connections and outages."""

from __future__ import annotations

import json
import sqlite3
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import event

from lalaloc_core.errors import ConfigError
from lalaloc_core.floorplan import FloorPlan
from service.errors import StoreBusyError, StoreUnavailableError
from service.storage.store import Store
from service.storage.tables import METADATA
from tests.service.conftest import FLAT, OpenStore, original_of
from tests.service.postgres import PostgresServer
from tests.service.test_store import _add, _url


@pytest.fixture
def store(open_store: OpenStore) -> Store:
    return open_store()


def test_migrations_match_the_tables(store: Store) -> None:
    with store.database.reading() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, METADATA) == []


def test_concurrent_starts_migrate_once(url: str) -> None:
    with ThreadPoolExecutor(4) as threads:
        stores = list(threads.map(lambda _: Store(url), range(4)))
    _add(stores[0])
    assert all(len(store.plans.list_plans("default", limit=10)) == 1 for store in stores)
    for store in stores:
        store.close()


def test_newer_database_is_rejected(store: Store, url: str) -> None:
    with store.database.writing() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
    with pytest.raises(ConfigError, match="9999"):
        Store(url)


_FIRST_SCHEMA = """
CREATE TABLE floorplans (
    id VARCHAR(32) NOT NULL, created_at DATETIME NOT NULL, name TEXT NOT NULL, document TEXT NOT NULL,
    room_count INTEGER NOT NULL, area_m2 FLOAT NOT NULL, camera_height_m FLOAT NOT NULL, failure TEXT, PRIMARY KEY (id)
);
CREATE INDEX floorplans_by_age ON floorplans (created_at, id);
CREATE TABLE originals (
    plan_id VARCHAR(32) NOT NULL, content BLOB NOT NULL, PRIMARY KEY (plan_id),
    FOREIGN KEY(plan_id) REFERENCES floorplans (id) ON DELETE CASCADE
);
CREATE TABLE {grids} (
    id INTEGER NOT NULL, plan_id VARCHAR(32) NOT NULL, model_sha256 VARCHAR(64) NOT NULL, step_m FLOAT NOT NULL,
    camera_height_mm INTEGER NOT NULL, poses INTEGER NOT NULL, arrays BLOB NOT NULL, PRIMARY KEY (id),
    UNIQUE (plan_id, model_sha256, step_m, camera_height_mm),
    FOREIGN KEY(plan_id) REFERENCES floorplans (id) ON DELETE CASCADE
);
"""


@pytest.mark.parametrize("grids", ["latent_grids", "latent_grids_2"])
def test_migration_from_the_first_version(tmp_path: Path, grids: str) -> None:
    original = b"\x00 as sent \xff" * 200_000
    with sqlite3.connect(tmp_path / "test.sqlite3") as raw:
        raw.executescript(_FIRST_SCHEMA.format(grids=grids))
        for number in (1, 2):
            plan_id, created_at = f"{number}" * 32, f"2026-01-0{number} 10:00:00.123456"
            document = FloorPlan.from_dict({**FLAT, "name": f"Flat {number}"}).to_dict()
            values = (plan_id, created_at, f"Flat {number}", json.dumps(document), 2, 36.0, 1.5, None)
            raw.execute("INSERT INTO floorplans VALUES (?, ?, ?, ?, ?, ?, ?, ?)", values)
            raw.execute("INSERT INTO originals VALUES (?, ?)", (plan_id, original))
            raw.execute(f"INSERT INTO {grids} VALUES (?, ?, 'm1', 0.5, 1500, 7, x'00')", (number, plan_id))
    raw.close()
    store = Store(_url(tmp_path))
    assert [summary.name for summary in store.plans.list_plans("default", limit=10)] == ["Flat 2", "Flat 1"]
    record = store.plans.get("default", "1" * 32)
    assert record is not None
    assert record.created_at == datetime(2026, 1, 1, 10, 0, 0, 123456, tzinfo=UTC)
    assert record.plan.to_dict() == FloorPlan.from_dict({**FLAT, "name": "Flat 1"}).to_dict()
    assert original_of(store, "1" * 32) == original
    # Grids are computed again.
    assert [summary.name for summary in store.grids.missing("m1", 0.5, 10)] == ["Flat 1", "Flat 2"]
    with store.database.reading() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, METADATA) == []
    store.close()
    again = Store(_url(tmp_path))
    assert len(again.plans.list_plans("default", limit=10)) == 2
    again.close()


def test_sqlite_uses_foreign_keys_and_wal(tmp_path: Path) -> None:
    store = Store(_url(tmp_path))
    with store.database.reading() as connection:
        assert connection.exec_driver_sql("PRAGMA journal_mode").scalar() == "wal"
        assert connection.exec_driver_sql("PRAGMA foreign_keys").scalar() == 1
        # Commits reach the disk before they are acknowledged.
        assert connection.exec_driver_sql("PRAGMA synchronous").scalar() == 2
    store.close()


@pytest.mark.parametrize(
    "url",
    [
        "nonsense",
        "sqlite:////no/such/folder/x.sqlite3",
        "nosuchdialect://x",
        "sqlite://",
        "mysql://x/y",
        "postgresql://127.0.0.1:9/x",
    ],
)
def test_unusable_database_is_a_config_error(url: str) -> None:
    with pytest.raises(ConfigError, match="database"):
        Store(url)


def test_connections_and_waiting_are_limited(url: str) -> None:
    store = Store(url, connections=2, wait_s=0.2)
    with store.database.reading(), store.database.reading(), pytest.raises(StoreUnavailableError):
        store.plans.list_plans("default", limit=1)
    assert store.plans.list_plans("default", limit=1) == []
    store.close()


def test_database_that_answers_others_is_busy(url: str) -> None:
    store = Store(url, connections=1, wait_s=0.25)

    def use(_number: int) -> StoreUnavailableError | None:
        try:
            with store.database.reading():
                time.sleep(0.1)
        except StoreUnavailableError as error:
            return error
        return None

    with ThreadPoolExecutor(10) as threads:
        refused = [error for error in threads.map(use, range(10)) if error is not None]
    assert refused
    assert all(isinstance(error, StoreBusyError) for error in refused)
    with store.database.reading(), pytest.raises(StoreUnavailableError) as caught:
        store.plans.list_plans("default", limit=1)
    assert not isinstance(caught.value, StoreBusyError)
    store.close()


def test_postgresql_urls_are_accepted(postgres: PostgresServer) -> None:
    plain = postgres.new_database()
    for url in (plain, plain.replace("postgresql:", "postgresql+psycopg:"), plain.replace("postgresql:", "postgres:")):
        store = Store(url)
        assert store.plans.list_plans("default", limit=1) == []
        store.close()


def test_store_reconnects_after_an_outage(postgres: PostgresServer) -> None:
    store = Store(postgres.new_database())
    _add(store, "p")
    postgres.stop()
    try:
        for _ in range(3):
            with pytest.raises(StoreUnavailableError):
                store.plans.get("default", "p")
    finally:
        postgres.start()
    assert store.plans.get("default", "p") is not None
    store.close()


def test_cached_plan_needs_one_query(store: Store) -> None:
    _add(store, "p")
    statements: list[str] = []
    event.listen(store.database._engine, "before_cursor_execute", lambda *arguments: statements.append(arguments[2]))
    assert store.plans.get("default", "p") is not None
    assert len([statement for statement in statements if statement.startswith("SELECT floorplans")]) == 1
    assert not any("document" in statement for statement in statements)
