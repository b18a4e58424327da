"""Upgrades from every released version, of databases that its own code wrote (`released/`)."""

from __future__ import annotations

import re
import sqlite3
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.operations import Operations
from alembic.script import ScriptDirectory

from service.storage import Store, migrations
from service.storage.plan_rows import place_columns
from service.storage.stored_bytes import ROW_BYTES
from service.storage.tables import FLOORPLANS, METADATA, ORIGINAL_CHUNKS, REVISIONS
from tests.service.conftest import StartApp, document_of, localise, original_of, upload, wait_for
from tests.service.postgres import PostgresServer
from tests.strategies import present

RELEASED = Path(__file__).parent / "released"


def parts(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")))


VERSIONS = sorted((path.stem for path in RELEASED.glob("*.sql")), key=parts)
# PostgreSQL came with 0.2.0.
CASES = [("sqlite", version) for version in VERSIONS] + [("postgresql", version) for version in VERSIONS[1:]]
CHANGELOG = Path(__file__).parents[2] / "CHANGELOG.md"


def test_every_released_version_is_tested() -> None:
    headings = re.findall(r"^## \[(\d+\.\d+\.\d+)\]", CHANGELOG.read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(headings, key=parts) == VERSIONS


def script_of(version: str) -> str:
    return (RELEASED / f"{version}.sql").read_text(encoding="utf-8")


def changed_file(folder: Path, script: str, change: str, *values: object) -> str:
    """Write a released database with a change to an SQLite file, and return its URL."""
    file = folder / "lalaloc.sqlite3"
    with closing(sqlite3.connect(file)) as database:
        database.executescript(script)
        database.execute(change, values)
        database.commit()
    return f"sqlite:///{file}"


@pytest.fixture
def script(version: str) -> str:
    return script_of(version)


@pytest.fixture
def url(kind: str, script: str, tmp_path: Path, request: pytest.FixtureRequest) -> str:
    """Return the URL of the released database."""
    file = tmp_path / "lalaloc.sqlite3"
    with closing(sqlite3.connect(file)) as database:
        # As its service left it.
        database.execute("PRAGMA journal_mode=WAL").fetchall()
        database.executescript(script)
    if kind == "sqlite":
        return f"sqlite:///{file}"
    postgres: PostgresServer = request.getfixturevalue("postgres")
    url = postgres.new_database()
    _copy(sa.create_engine(f"sqlite:///{file}"), sa.create_engine(url.replace("postgresql:", "postgresql+psycopg:")))
    return url


def _copy(source: sa.Engine, target: sa.Engine) -> None:
    """Migrate an empty PostgreSQL database to the revision of an SQLite file, and copy its rows."""
    scripts = ScriptDirectory(str(Path(migrations.__file__).parent))
    with source.connect() as reading, target.begin() as writing:
        revision = present(MigrationContext.configure(reading).get_current_revision())
        context = MigrationContext.configure(writing)
        with Operations.context(context):
            for step in reversed(list(scripts.iterate_revisions(revision, "base"))):
                step.module.upgrade()
                context.stamp(scripts, step.revision)
        # The types of SQLite, so that times and bytes are converted.
        tables = sa.MetaData()
        tables.reflect(reading)
        for table in tables.sorted_tables:
            rows: list[Any] = [dict(row._mapping) for row in reading.execute(sa.select(table))]
            if rows and table.name != "alembic_version":
                writing.execute(sa.insert(table), rows)
        writing.exec_driver_sql("SELECT setval('latent_grids_id_seq', (SELECT max(id) FROM latent_grids))")
    source.dispose()
    target.dispose()


def _rows(url: str) -> dict[str, int]:
    engine = sa.create_engine(url.replace("postgresql:", "postgresql+psycopg:"))
    with engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, METADATA) == []
        counts = {
            table.name: connection.scalar(sa.select(sa.func.count()).select_from(table)) or 0
            for table in METADATA.sorted_tables
        }
    engine.dispose()
    return counts


@pytest.mark.parametrize(
    ("kind", "version"),
    [pytest.param(*case, marks=[] if case == ("sqlite", VERSIONS[-1]) else [pytest.mark.slow]) for case in CASES],
)
def test_rows_of_a_released_version_are_kept(version: str, script: str, url: str) -> None:
    with closing(Store(url)) as store:
        counts, inserted = _rows(url), re.findall(r'^INSERT INTO "(\w+)"', script, re.MULTILINE)
        # Grids without a digest are computed again; the others are kept, even if this model does not use them.
        for table in sorted(set(inserted) - {"alembic_version", "originals", "latent_grids_2"}):
            lost = version == "0.2.0" and table in ("latent_grids", "grid_chunks")
            assert counts[table] == (0 if lost else inserted.count(table)), table
        _assert_counted(store, counts)


def _assert_counted(store: Store, counts: dict[str, int]) -> None:
    """Check the columns that migrations compute: stored bytes and places; plans are deleted."""
    content = sa.select(sa.func.sum(sa.func.length(ORIGINAL_CHUNKS.c.content)))
    texts = (REVISIONS.c.document, REVISIONS.c.warnings, REVISIONS.c.report)
    size = sum((sa.func.coalesce(sa.func.length(text), 0) for text in texts), start=sa.literal(ROW_BYTES))
    size += content.where(ORIGINAL_CHUNKS.c.revision_id == REVISIONS.c.id).scalar_subquery()
    with store.database.reading() as connection:
        assert connection.scalars(sa.select(REVISIONS.c.id).where(REVISIONS.c.stored_bytes != size)).all() == []
        places = {row.id: row._mapping for row in connection.execute(sa.select(FLOORPLANS))}
    accounts = store.quota.accounts()
    assert sum(account.used.venues for account in accounts.values()) == ROW_BYTES * (
        counts["venues"] + counts["venue_plans"]
    )
    for tenant in accounts:
        for summary in store.plans.list_plans(tenant, limit=10):
            record = present(store.plans.get(tenant, summary.id))
            place = place_columns(record.plan)
            assert {name: places[summary.id][name] for name in place} == pytest.approx(place)
            store.plans.delete(tenant, summary.id)
    assert {account.used.plans + account.used.grids for account in store.quota.accounts().values()} == {0}


def test_plan_that_cannot_be_read_gets_no_place(tmp_path: Path) -> None:
    url = changed_file(tmp_path, script_of("0.2.0"), "UPDATE revisions SET document = 'damaged'")
    with closing(Store(url)) as store, store.database.reading() as connection:
        assert connection.scalars(sa.select(FLOORPLANS.c.reach_m)).all() == [None]


@pytest.mark.parametrize("grids", ["latent_grids", "latent_grids_2"])
def test_files_of_the_first_version_are_kept(tmp_path: Path, grids: str) -> None:
    script, original = script_of("0.1.0").replace("latent_grids_2", grids), b"\x00 as sent \xff" * 200_000
    with closing(Store(changed_file(tmp_path, script, "UPDATE originals SET content = ?", original))) as store:
        [summary] = store.plans.list_plans("default", limit=10)
        assert summary.name == "Flat of 0.1.0"
        assert summary.created_at == datetime(2026, 11, 24, 17, 7, 46, 882394, tzinfo=UTC)
        assert original_of(store, summary.id) == original
        # Grids are computed again.
        assert [missing.id for missing in store.grids.missing("m1", 0.5, 10)] == [summary.id]


@pytest.mark.parametrize(
    ("before", "after"),
    [("localise read write", {"localise", "read", "write", "metrics"}), ("localise write", {"localise", "write"})],
)
def test_keys_that_read_get_the_scope_of_metrics(tmp_path: Path, before: str, after: set[str]) -> None:
    url = changed_file(tmp_path, script_of("0.5.0"), "UPDATE api_keys SET scopes = ?", before)
    with closing(Store(url)) as store:
        assert [(key.scopes, key.expires_at) for key in store.keys.list_keys()] == [(after, None)]


@pytest.mark.slow
@pytest.mark.one_replica
@pytest.mark.parametrize(("kind", "version"), CASES)
def test_data_of_a_released_version_are_used(
    version: str, script: str, url: str, start_app: StartApp, sphere: bytes, tmp_path: Path
) -> None:
    key = re.search(r"^-- key (\S+)$", script, re.MULTILINE)
    with start_app(tmp_path, database_url=url, api_keys=key is not None) as client:
        if key is not None:
            client.headers["Authorization"] = f"Bearer {key[1]}"
        _assert_works(client, version, script, sphere)


def _assert_works(client: httpx.Client, version: str, script: str, sphere: bytes) -> None:
    [plan] = client.get("/floorplans").json()["floorplans"]
    assert plan["name"] == (f"Renamed in {version}" if parts(version) > (0, 1, 0) else f"Flat of {version}")
    address = f"/floorplans/{plan['id']}"
    wait_for(lambda: client.get(address).json()["status"] == "ready")
    assert client.get(f"{address}/original").json()["name"] == plan["name"]
    if parts(version) > (0, 1, 0):
        first = present(re.search(r"^INSERT INTO \"revisions\" VALUES\('(\w+)','\w+',1,", script, re.MULTILINE))
        assert client.get(f"{address}?revision={first[1]}").json()["name"] == f"Flat of {version}"
    document_of(localise(client, plan["id"], sphere, heading_deg=0))
    if parts(version) >= (0, 3, 0):
        [venue] = client.get("/venues").json()["venues"]
        answer = client.post("/localise", data={"venue_id": venue["id"], "heading_deg": 0}, files={"photo": sphere})
        assert answer.json()["floorplan_id"] == plan["id"]
    if parts(version) >= (0, 8, 0):
        [album] = client.get("/albums").json()["albums"]
        assert len(client.get(f"/albums/{album['id']}/photographs").json()["photographs"]) == 1
    # Tables that were moved take new rows, and rows are deleted with their plan.
    upload(client)
    assert client.delete(address).status_code == 204
    assert [found["name"] for found in client.get("/floorplans").json()["floorplans"]] == ["Flat 3"]
