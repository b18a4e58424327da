"""Requests to a service whose database is damaged, full or deleted."""

from __future__ import annotations

import logging
import os
import random
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import pytest

from service.telemetry import LOGGER_NAME
from tests.service.conftest import FLAT, StartApp, assert_problem, localise, upload, wait_for

pytestmark = pytest.mark.one_replica


def _sqlite(data_dir: Path) -> Path:
    path = data_dir / "lalaloc.sqlite3"
    if not path.exists():
        pytest.skip("about SQLite's file")
    return path


def test_damaged_plan_can_be_replaced_and_deleted(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    with start_app(tmp_path) as client:
        replaced, deleted = upload(client), upload(client)
    with sqlite3.connect(_sqlite(tmp_path)) as raw:
        raw.execute("UPDATE revisions SET document = replace(document, '4.0', '4.5')")
    raw.close()
    with start_app(tmp_path) as client:
        for path in ("", "/preview.svg", "/mesh.glb"):
            assert_problem(client.get(f"/floorplans/{deleted}{path}"), 500, "internal")
        assert_problem(localise(client, deleted, sphere), 500, "internal")
        assert client.get(f"/floorplans/{deleted}/original").json() == FLAT
        assert {entry["id"] for entry in client.get("/floorplans").json()["floorplans"]} == {replaced, deleted}
        assert client.delete(f"/floorplans/{deleted}").status_code == 204
        assert_problem(client.get(f"/floorplans/{deleted}"), 404, "unknown-floorplan")
        assert client.put(f"/floorplans/{replaced}", json=FLAT).status_code == 200
        assert localise(client, replaced, sphere, refine="none").status_code == 200


def test_deleted_data_folder_is_store_unavailable(start_app: StartApp, tmp_path: Path) -> None:
    data_dir = tmp_path / "data"
    data_dir.mkdir()
    with start_app(data_dir) as client:
        upload(client)
        _sqlite(data_dir)
        shutil.rmtree(data_dir)
        problem = assert_problem(client.post("/floorplans", json=FLAT), 503, "store-unavailable")
        assert "removed or replaced" in problem["detail"]
        assert_problem(client.get("/floorplans"), 503, "store-unavailable")


def _truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def _overwrite(path: Path) -> None:
    with path.open("r+b") as file:
        file.seek(4096)
        file.write(random.Random(5).randbytes(path.stat().st_size - 4096))


def _zero_header(path: Path) -> None:
    with path.open("r+b") as file:
        file.write(bytes(4096))


@pytest.mark.parametrize("damage", [_truncate, _overwrite, _zero_header])
def test_file_that_is_damaged_while_the_service_runs_is_store_unavailable(
    start_app: StartApp, tmp_path: Path, sphere: bytes, damage: Callable[[Path], None], caplog: pytest.LogCaptureFixture
) -> None:
    # It does not pass its records on to the root logger.
    logger = logging.getLogger(LOGGER_NAME)
    with start_app(tmp_path, sweep_s=0.2) as client, ExitStack() as stack:
        logger.addHandler(caplog.handler)
        stack.callback(logger.removeHandler, caplog.handler)
        plan_id = upload(client)
        assert localise(client, plan_id, sphere, refine="none").status_code == 200
        assert client.get("/readyz").json()["database"] == "answers"
        assert "lalaloc_database_up 1.0" in client.get("/metrics").text
        path = _sqlite(tmp_path)

        def refuses_when_damaged() -> bool:
            # What a sweep wrote since the last attempt are whole pages of the log, which would heal the file.
            with suppress(sqlite3.DatabaseError), closing(sqlite3.connect(path)) as raw:
                raw.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            damage(path)
            return client.post("/floorplans", json=FLAT).status_code != 201

        wait_for(refuses_when_damaged)
        problem = assert_problem(client.post("/floorplans", json=FLAT), 503, "store-unavailable")
        assert "restore a backup" in problem["detail"]
        wait_for(lambda: client.get("/readyz").json()["database"] == "damaged")
        for _ in range(3):
            assert localise(client, plan_id, sphere, refine="none").status_code == 200
        for url in ("/floorplans", "/usage", "/venues"):
            assert client.get(url).status_code in (200, 503)
        assert client.get("/readyz").status_code == 200
        assert "lalaloc_database_up 0.0" in client.get("/metrics").text
    logged = [record for record in caplog.records if record.getMessage() == "the database file is damaged"]
    assert len(logged) == 1
    assert "restore" in getattr(logged[0], "fields")["remedy"]  # noqa: B009
    assert not [record for record in caplog.records if record.exc_info]
