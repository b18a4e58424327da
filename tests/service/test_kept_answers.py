"""Kept answers: off by default, limited in time and number, without the sphere."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest
from sqlalchemy import func, select

from service.storage.store import Store
from service.storage.tables import KEPT_ANSWERS
from tests.service.conftest import StartApp, assert_problem, localise, upload, wait_for
from tests.service.test_store import _add


def test_answers_are_not_kept_by_default(client: httpx.Client, sphere: bytes) -> None:
    assert localise(client, upload(client), sphere).json()["answer_id"] is None
    assert_problem(client.get(f"/answers/{'0' * 32}"), 404, "unknown-answer")


def test_kept_answer_is_identical_until_deleted(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    with start_app(tmp_path, keep_answers_s=3600.0) as client:
        plan_id = upload(client)
        answer = localise(client, plan_id, sphere, include="posterior")
        address = f"/answers/{answer.json()['answer_id']}"
        assert client.get(address).content == answer.content
        second_id = localise(client, plan_id, sphere).json()["answer_id"]
        assert client.delete(address).status_code == 204
        assert_problem(client.get(address), 404, "unknown-answer")
        assert_problem(client.delete(address), 404, "unknown-answer")
        assert client.get(f"/answers/{second_id}").status_code == 200
        client.delete(f"/floorplans/{plan_id}").raise_for_status()
        assert_problem(client.get(f"/answers/{second_id}"), 404, "unknown-answer")


def test_kept_answer_expires(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    with start_app(tmp_path, keep_answers_s=0.5) as client:
        answer_id = localise(client, upload(client), sphere).json()["answer_id"]
        wait_for(lambda: client.get(f"/answers/{answer_id}").status_code == 404)
        assert_problem(client.get(f"/answers/{answer_id}"), 404, "unknown-answer")


def test_oldest_answers_are_dropped(app_store: Store) -> None:
    plan_id = "a" * 32
    _add(app_store, plan_id)
    ids = [app_store.answers.add("default", plan_id, lambda answer_id: f"text {answer_id}", limit=2) for _ in range(3)]
    first, second, third = (answer_id or pytest.fail("not kept") for answer_id in ids)
    assert app_store.answers.get("default", first, kept_s=60.0) is None
    assert app_store.answers.get("default", second, kept_s=60.0) == f"text {second}"
    assert app_store.answers.get("somebody else", third, kept_s=60.0) is None
    assert not app_store.answers.delete("somebody else", third)
    assert app_store.answers.add("default", "0" * 32, str, limit=2) is None
    assert app_store.answers.add("somebody else", plan_id, str, limit=2) is None
    assert app_store.answers.purge(kept_s=60.0) == 0
    assert app_store.answers.purge(kept_s=0.0) == 2
    with app_store.answers._database.reading() as connection:
        assert connection.scalar(select(func.count()).select_from(KEPT_ANSWERS)) == 0
