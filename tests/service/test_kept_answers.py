"""Answers that are kept: only where that is asked for, only for as long, and never the panorama."""

from __future__ import annotations

from pathlib import Path
from time import sleep

import httpx
import pytest
from sqlalchemy import func, select

from service.storage.store import Store
from service.storage.tables import KEPT_ANSWERS
from tests.service.conftest import DatabaseOf, StartApp, assert_problem, localise, upload


def test_no_answer_is_kept_unless_that_is_asked_for(client: httpx.Client, panorama: bytes) -> None:
    assert localise(client, upload(client), panorama).json()["answer_id"] is None
    assert_problem(client.get(f"/answers/{'0' * 32}"), 404, "unknown-answer")


def test_a_kept_answer_is_told_again_to_the_byte_until_it_is_forgotten(
    start_app: StartApp, tmp_path: Path, panorama: bytes
) -> None:
    with start_app(tmp_path, keep_answers_s=3600.0) as client:
        plan_id = upload(client)
        told = localise(client, plan_id, panorama, include="posterior")
        address = f"/answers/{told.json()['answer_id']}"
        assert client.get(address).content == told.content
        other = localise(client, plan_id, panorama).json()["answer_id"]
        assert client.delete(address).status_code == 204
        assert_problem(client.get(address), 404, "unknown-answer")
        assert_problem(client.delete(address), 404, "unknown-answer")
        assert client.get(f"/answers/{other}").status_code == 200
        client.delete(f"/floorplans/{plan_id}").raise_for_status()
        assert_problem(client.get(f"/answers/{other}"), 404, "unknown-answer")


def test_a_kept_answer_is_gone_after_its_time(start_app: StartApp, tmp_path: Path, panorama: bytes) -> None:
    with start_app(tmp_path, keep_answers_s=0.5) as client:
        answer_id = localise(client, upload(client), panorama).json()["answer_id"]
        sleep(0.6)
        assert_problem(client.get(f"/answers/{answer_id}"), 404, "unknown-answer")


def test_the_oldest_answer_makes_room_and_what_is_old_is_dropped(
    start_app: StartApp, database_of: DatabaseOf, tmp_path: Path
) -> None:
    with start_app(tmp_path) as client:
        plan_id = upload(client)
        store = Store(database_of(tmp_path))
        ids = [store.answers.add("default", plan_id, lambda answer_id: f"text {answer_id}", limit=2) for _ in range(3)]
        first, second, third = (answer_id or pytest.fail("not kept") for answer_id in ids)
        assert store.answers.get("default", first, kept_s=60.0) is None
        assert store.answers.get("default", second, kept_s=60.0) == f"text {second}"
        assert store.answers.get("somebody else", third, kept_s=60.0) is None
        assert not store.answers.delete("somebody else", third)
        assert store.answers.add("default", "0" * 32, str, limit=2) is None
        assert store.answers.add("somebody else", plan_id, str, limit=2) is None
        assert store.answers.purge(kept_s=60.0) == 0
        assert store.answers.purge(kept_s=0.0) == 2
        with store.answers._database.reading() as connection:
            assert connection.scalar(select(func.count()).select_from(KEPT_ANSWERS)) == 0
        store.close()
