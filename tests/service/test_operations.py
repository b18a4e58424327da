"""Procedures of docs/how-to/operate.md: backup, restore, model upgrade."""

from __future__ import annotations

import json
import re
import shutil
import sqlite3
import subprocess
import uuid
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx
import pytest

from lalaloc_core.bundle import default_bundle
from service.cli.entry_point import main as lalaloc_service
from service.storage import Store
from tests.service import test_albums as albums
from tests.service.conftest import StartApp, document_of, localise, upload, wait_for
from tests.service.postgres import PostgresServer
from tests.strategies import present

GUIDES = Path(__file__).parents[2] / "docs" / "how-to"
PAGE = (GUIDES / "operate.md").read_text(encoding="utf-8")


def stored(client: httpx.Client, sphere: bytes) -> tuple[list[dict[str, object]], object]:
    """Return all plans, and the position of the sphere in the oldest plan."""
    plans = client.get("/floorplans").json()["floorplans"]
    return plans, document_of(localise(client, plans[-1]["id"], sphere, heading_deg=0))["position"]


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the data folder that the commands use."""
    monkeypatch.setenv("LALALOC_DATA_DIR", str(tmp_path / "data"))
    return tmp_path / "data"


def on_sqlite(data: Path) -> dict[str, Any]:
    """Return the arguments of an app on SQLite, as `TEST_DATABASE` changes the default."""
    data.mkdir(exist_ok=True)
    return {"data_dir": data, "database_url": f"sqlite:///{data / 'lalaloc.sqlite3'}"}


def test_sqlite_backup_restores_everything(
    start_app: StartApp, sphere: bytes, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    backup = str(tmp_path / "backup.sqlite3")
    with start_app(**on_sqlite(data)) as client:
        upload(client)
        before = stored(client, sphere)
        assert lalaloc_service(["backup", backup]) == 0
        later = upload(client)
        # A running service would go on in the file before.
        assert lalaloc_service(["restore", backup, "--yes"]) == 1
        assert "stop the service first" in capsys.readouterr().err
        assert client.get(f"/floorplans/{later}").status_code == 200
    assert lalaloc_service(["restore", backup, "--yes"]) == 0
    earlier = present(re.search(r"is '(.*)'; delete it", capsys.readouterr().out))
    with start_app(**on_sqlite(data)) as client:
        assert stored(client, sphere) == before
        assert client.get(f"/floorplans/{later}").status_code == 404
    # The database before is a backup as well.
    assert lalaloc_service(["restore", earlier[1], "--yes"]) == 0
    with start_app(**on_sqlite(data)) as client:
        assert client.get(f"/floorplans/{later}").status_code == 200


def pinned_album(client: httpx.Client) -> tuple[str, dict[str, Any], list[dict[str, Any]]]:
    """Return an album with two pins and a correction: its id, itself, and its photographs."""
    album_id = albums.create(client, upload(client, albums.HOME))
    lines = albums.add(client, album_id, [(albums.EXAMPLES / name).read_bytes() for name in albums.NAMES[:2]])
    albums.correct(client, album_id, lines[0]["photograph"]["id"], {"elsewhere": True})
    return album_id, albums.wait_until_solved(client, album_id), albums.photographs(client, album_id)


def is_same_album(client: httpx.Client, album_id: str, album: Any, rows: Any) -> bool:
    """Return True if an album is as it was, and goes on: a correction is undone, and all is solved again."""
    same = client.get(f"/albums/{album_id}").json() == album and albums.photographs(client, album_id) == rows
    albums.correct(client, album_id, rows[0]["id"], None)
    albums.wait_until_solved(client, album_id)
    return same and albums.photographs(client, album_id)[0]["pin"]["place"] is not None


@pytest.mark.slow
def test_sqlite_backup_restores_albums(start_app: StartApp, data: Path, tmp_path: Path) -> None:
    backup = str(tmp_path / "backup.sqlite3")
    shipped = on_sqlite(data) | {"bundle": default_bundle(), "request_deadline_s": 90.0, "sweep_s": 0.2}
    with start_app(**shipped) as client:
        before = pinned_album(client)
        assert lalaloc_service(["backup", backup]) == 0
        assert client.delete(f"/albums/{before[0]}").status_code == 204
    assert lalaloc_service(["restore", backup, "--yes"]) == 0
    with start_app(**shipped) as client:
        assert is_same_album(client, *before)


def test_lost_or_damaged_database_is_restored(
    start_app: StartApp, sphere: bytes, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    backup, database = str(tmp_path / "backup.sqlite3"), data / "lalaloc.sqlite3"
    with start_app(**on_sqlite(data)) as client:
        upload(client)
        before = stored(client, sphere)
        assert lalaloc_service(["backup", backup]) == 0
    for content in (None, b"no database" * 1000):
        shutil.rmtree(data)
        if content is not None:
            data.mkdir()
            database.write_bytes(content)
            database.with_name("lalaloc.sqlite3-wal").write_bytes(content)
        assert lalaloc_service(["restore", backup, "--yes"]) == 0
        assert ("the database before" in capsys.readouterr().out) == (content is not None)
        with start_app(**on_sqlite(data)) as client:
            assert stored(client, sphere) == before


def test_commits_in_the_log_of_a_copy_are_restored(data: Path, tmp_path: Path) -> None:
    data.mkdir()
    store, copy = Store(f"sqlite:///{data / 'lalaloc.sqlite3'}"), tmp_path / "copy.sqlite3"
    store.tenants.change_limits("acme", cpu_share=2.0)
    for suffix in ("", "-wal"):
        shutil.copy(f"{data / 'lalaloc.sqlite3'}{suffix}", f"{copy}{suffix}")
    store.close()
    shutil.rmtree(data)
    assert lalaloc_service(["restore", str(copy), "--yes"]) == 0
    restored = Store(f"sqlite:///{data / 'lalaloc.sqlite3'}")
    assert restored.tenants.limits()["acme"].cpu_share == 2.0
    restored.close()


def broken(backup: Path, change: str) -> None:
    """Break a backup in one of several ways."""
    if change == "missing":
        backup.unlink()
    elif change == "text":
        backup.write_text("no database")
    elif change == "truncated":
        backup.write_bytes(backup.read_bytes()[:-8192])
    else:
        with closing(sqlite3.connect(backup)) as copy:
            copy.executescript(change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("missing", "there is no file"),
        ("text", "is not an SQLite file, or damaged"),
        ("truncated", "damaged|malformed"),
        ("DROP TABLE floorplans", "no table of floor plans"),
        ("UPDATE alembic_version SET version_num = '9999'", "9999"),
    ],
)
def test_unusable_backup_changes_nothing(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: str, message: str
) -> None:
    database, backup = data / "lalaloc.sqlite3", tmp_path / "backup.sqlite3"
    data.mkdir()
    Store(f"sqlite:///{database}").close()
    assert lalaloc_service(["backup", str(backup)]) == 0
    before, files = database.read_bytes(), {path.name for path in data.iterdir()}
    broken(backup, change)
    assert lalaloc_service(["restore", str(backup), "--yes"]) == 1
    assert re.search(message, capsys.readouterr().err)
    assert database.read_bytes() == before
    assert {path.name for path in data.iterdir()} == files


def test_backup_overwrites_nothing(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    backup = tmp_path / "backup.sqlite3"
    assert lalaloc_service(["backup", str(backup)]) == 1
    assert "there is no database" in capsys.readouterr().err
    assert not data.exists()
    data.mkdir()
    Store(f"sqlite:///{data / 'lalaloc.sqlite3'}").close()
    backup.write_text("mine")
    assert lalaloc_service(["backup", str(backup)]) == 1
    assert "exists; name a new file" in capsys.readouterr().err
    assert lalaloc_service(["backup", str(tmp_path / "no" / "folder")]) == 1
    assert "does not exist" in capsys.readouterr().err
    assert backup.read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"data", "backup.sqlite3"}


def test_backup_of_postgresql_names_its_programs(
    data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LALALOC_DATABASE_URL", "postgresql://host/lalaloc")
    for command in (["backup", "x"], ["restore", "x", "--yes"]):
        assert lalaloc_service(command) == 1
        assert "use pg_dump and pg_restore" in capsys.readouterr().err


@pytest.mark.parametrize("with_grids", [True, False])
def test_postgresql_dump_restores_everything(
    start_app: StartApp, postgres: PostgresServer, sphere: bytes, tmp_path: Path, with_grids: bool
) -> None:
    url, dump = own_database(postgres), str(tmp_path / "backup.dump")
    left_out = [] if with_grids else re.findall(r"--exclude-table-data=\w+", PAGE)
    assert with_grids or len(left_out) == 2
    with start_app(tmp_path / "a", database_url=url) as client:
        upload(client)
        before = stored(client, sphere)
        run(postgres, "pg_dump", "--format=custom", f"--file={dump}", *left_out, url)
        upload(client)
    options = present(re.search(r"pg_restore (.*) --dbname", PAGE))
    run(postgres, "pg_restore", *options[1].split(), f"--dbname={url}", dump)
    with start_app(tmp_path / "b", database_url=url) as client:
        wait_for(lambda: client.get("/readyz").json()["plans_preparing"] == 0)
        assert stored(client, sphere) == before


def test_replicas_of_two_models_coexist(
    start_app: StartApp, postgres: PostgresServer, tiny_bundle: Path, sphere: bytes, tmp_path: Path
) -> None:
    url, bundle = postgres.new_database(), tmp_path / "next"
    shutil.copytree(tiny_bundle, bundle)
    manifest = json.loads((bundle / "manifest.json").read_text(encoding="utf-8"))
    (bundle / "manifest.json").write_text(json.dumps(manifest | {"version": "next"}), encoding="utf-8")
    with start_app(tmp_path / "old", database_url=url) as old:
        plan_id = upload(old)
        with start_app(tmp_path / "new", database_url=url, bundle=bundle) as new:
            wait_for(lambda: new.get("/readyz").json()["plans_preparing"] == 0)
            for _ in range(2):
                versions = [
                    localise(client, plan_id, sphere, heading_deg=0).json()["model"]["version"] for client in (old, new)
                ]
                assert versions[1] == "next" != versions[0]


def own_database(postgres: PostgresServer) -> str:
    """Create a database of its own, because other tests only use schemas, and return its address."""
    name = f"backup_{uuid.uuid4().hex}"
    run(postgres, "psql", "--command", f"CREATE DATABASE {name}", postgres.url())
    return postgres.url().rpartition("/")[0] + f"/{name}"


def run(postgres: PostgresServer, program: str, *arguments: str) -> None:
    done = subprocess.run([postgres.programs / program, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
