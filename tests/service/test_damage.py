"""Requests to a service whose database is damaged, full or deleted."""

from __future__ import annotations

import json
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from service.storage import database
from tests.service.conftest import FLAT, StartApp, assert_problem, localise, upload

pytestmark = pytest.mark.one_replica


def _sqlite(data_dir: Path) -> Path:
    path = data_dir / "lalaloc.sqlite3"
    if not path.exists():
        pytest.skip("about SQLite's file")
    return path


def test_damaged_plan_can_be_replaced_and_deleted(start_app: StartApp, tmp_path: Path, panorama: bytes) -> None:
    with start_app(tmp_path) as client:
        replaced, deleted = upload(client), upload(client)
    with sqlite3.connect(_sqlite(tmp_path)) as raw:
        raw.execute("UPDATE revisions SET document = replace(document, '4.0', '4.5')")
    raw.close()
    with start_app(tmp_path) as client:
        for path in ("", "/preview.svg", "/mesh.glb"):
            assert_problem(client.get(f"/floorplans/{deleted}{path}"), 500, "internal")
        assert_problem(localise(client, deleted, panorama), 500, "internal")
        assert client.get(f"/floorplans/{deleted}/original").json() == FLAT
        assert {entry["id"] for entry in client.get("/floorplans").json()["floorplans"]} == {replaced, deleted}
        assert client.delete(f"/floorplans/{deleted}").status_code == 204
        assert_problem(client.get(f"/floorplans/{deleted}"), 404, "unknown-floorplan")
        assert client.put(f"/floorplans/{replaced}", json=FLAT).status_code == 200
        assert localise(client, replaced, panorama, refine="none").status_code == 200


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


def test_full_disk_is_a_507_and_reads_continue(
    start_app: StartApp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare = database._prepare_sqlite

    def with_little_room(connection: Any, record: Any) -> None:
        prepare(connection, record)
        connection.execute("PRAGMA max_page_count = 250")

    monkeypatch.setattr(database, "_prepare_sqlite", with_little_room)
    with start_app(tmp_path) as client:
        plan_id = upload(client)
        _sqlite(tmp_path)
        padded = json.dumps(FLAT).encode() + b" " * 1_100_000
        answer = client.post("/floorplans", content=padded, headers={"content-type": "application/json"})
        assert_problem(answer, 507, "store-full")
        assert answer.headers["retry-after"] == "60"
        assert client.get(f"/floorplans/{plan_id}").status_code == 200
