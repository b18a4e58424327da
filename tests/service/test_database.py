"""Tests of the database itself: its schema, SQLite's settings, connections and outages."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import event

from lalaloc_core.errors import ConfigError
from service.errors import StoreBusyError, StoreUnavailableError
from service.storage.store import Store
from service.storage.tables import METADATA
from tests.service.conftest import OpenStore
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

    def use() -> None:
        with store.database.reading():
            time.sleep(0.1)

    with ThreadPoolExecutor(10) as threads:
        uses = [threads.submit(use) for _ in range(10)]
    assert {type(used.exception()) for used in uses} == {type(None), StoreBusyError}
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
