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

import httpx
import pytest

from service.settings import SETTING_NAMES
from tests.service.conftest import StartApp, localise, upload, wait_for
from tests.service.postgres import PostgresServer

GUIDES = Path(__file__).parents[2] / "docs" / "how-to"
PAGE = (GUIDES / "operate.md").read_text(encoding="utf-8")


def stored(client: httpx.Client, panorama: bytes) -> tuple[list[dict[str, object]], object]:
    """Return all plans, and the position of the panorama in the oldest plan."""
    plans = client.get("/floorplans").json()["floorplans"]
    answer = localise(client, plans[-1]["id"], panorama, heading_deg=0)
    assert answer.status_code == 200, answer.text
    return plans, answer.json()["position"]


def test_sqlite_backup_restores_everything(start_app: StartApp, panorama: bytes, tmp_path: Path) -> None:
    data, backup = tmp_path / "data", tmp_path / "backup.sqlite3"
    own = {"database_url": f"sqlite:///{data / 'lalaloc.sqlite3'}"}
    data.mkdir()
    with start_app(data, **own) as client:
        upload(client)
        before = stored(client, panorama)
        # Same as `sqlite3 FILE ".backup COPY"`.
        with (
            closing(sqlite3.connect(data / "lalaloc.sqlite3")) as database,
            closing(sqlite3.connect(backup)) as copy,
        ):
            database.backup(copy)
        upload(client)
    shutil.copy(backup, data / "lalaloc.sqlite3")
    for name in ("lalaloc.sqlite3-wal", "lalaloc.sqlite3-shm"):
        (data / name).unlink(missing_ok=True)
    with start_app(data, **own) as client:
        assert stored(client, panorama) == before


@pytest.mark.parametrize("with_grids", [True, False])
def test_postgresql_dump_restores_everything(
    start_app: StartApp, postgres: PostgresServer, panorama: bytes, tmp_path: Path, with_grids: bool
) -> None:
    url, dump = own_database(postgres), str(tmp_path / "backup.dump")
    left_out = [] if with_grids else re.findall(r"--exclude-table-data=\w+", PAGE)
    assert with_grids or len(left_out) == 2
    with start_app(tmp_path / "a", database_url=url) as client:
        upload(client)
        before = stored(client, panorama)
        run(postgres, "pg_dump", "--format=custom", f"--file={dump}", *left_out, url)
        upload(client)
    options = re.search(r"pg_restore (.*) --dbname", PAGE)
    assert options is not None
    run(postgres, "pg_restore", *options[1].split(), f"--dbname={url}", dump)
    with start_app(tmp_path / "b", database_url=url) as client:
        wait_for(lambda: client.get("/readyz").json()["plans_preparing"] == 0)
        assert stored(client, panorama) == before


def test_replicas_of_two_models_coexist(
    start_app: StartApp, postgres: PostgresServer, tiny_bundle: Path, panorama: bytes, tmp_path: Path
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
                    localise(client, plan_id, panorama, heading_deg=0).json()["model"]["version"]
                    for client in (old, new)
                ]
                assert versions[1] == "next" != versions[0]


def test_documented_settings_exist() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in GUIDES.glob("*.md"))
    named = set(re.findall(r"LALALOC_([A-Z0-9_]+[A-Z0-9])", text))
    known = {name.upper() for name in SETTING_NAMES}
    # Variables of the compose files.
    assert named - known == {"DATABASE_PASSWORD", "PUBLISH"}


def own_database(postgres: PostgresServer) -> str:
    """Create a database of its own, because other tests only use schemas, and return its address."""
    name = f"backup_{uuid.uuid4().hex}"
    run(postgres, "psql", "--command", f"CREATE DATABASE {name}", postgres.url())
    return postgres.url().rpartition("/")[0] + f"/{name}"


def run(postgres: PostgresServer, program: str, *arguments: str) -> None:
    """Run one of PostgreSQL's programs."""
    done = subprocess.run([postgres.programs / program, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
