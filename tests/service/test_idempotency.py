"""Kept answers: of requests with an `Idempotency-Key`, executed once, also after failures, and answers by id."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import func, select
from starlette.requests import Request
from starlette.responses import Response

from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.floorplan import FloorPlan
from service.capacity.threads import BoundedReads
from service.errors import (
    DecoderNotReadyError,
    PlanFailedError,
    StoreUnavailableError,
    UnknownFloorPlanError,
    UploadTimeoutError,
)
from service.http.idempotent_request import IdempotentRequest, parts_sha256
from service.http.uploads import Parts
from service.pools.job_queue import JobLostError
from service.storage.kept_answers import IdempotencyKeys
from service.storage.records import Claimed, NewPlan, Original
from service.storage.store import Store
from service.storage.stored_grids import StoredGrids
from service.storage.tables import IDEMPOTENCY, KEPT_ANSWERS
from service.uploaded_file import UploadedFile
from tests.service.conftest import FLAT, HALL, StartApp, assert_problem, connection_to, localise, upload, wait_for
from tests.service.test_store import _add

CONTENT = json.dumps(FLAT).encode()
NOTHING = Parts({}, {})


def _keyed(key: str) -> dict[str, str]:
    return {"Idempotency-Key": key}


def _post(client: httpx.Client, key: str, plan: Any = None) -> httpx.Response:
    return client.post("/floorplans", json=plan or FLAT, headers=_keyed(key))


def _query(client: httpx.Client, key: str, plan_id: str, picture: bytes, **fields: str) -> httpx.Response:
    data = {"floorplan_id": plan_id, "refine": "none"} | fields
    return client.post("/localise", data=data, files={"photo": ("p.jpg", picture)}, headers=_keyed(key))


def _post_content(client: httpx.Client) -> httpx.Response:
    return client.post("/floorplans", content=CONTENT, headers=_keyed("a") | {"Content-Type": "application/json"})


def _count(client: httpx.Client) -> int:
    return len(client.get("/floorplans", params={"limit": 500}).json()["floorplans"])


def _same(first: httpx.Response, again: httpx.Response) -> bool:
    assert "idempotency-replayed" not in first.headers
    assert again.headers["idempotency-replayed"] == "true"
    names = ("content-type", "location", "etag")
    kept, repeated = (
        (answer.status_code, answer.content, [answer.headers.get(name) for name in names]) for answer in (first, again)
    )
    return kept == repeated


@pytest.fixture
def own(start_app: StartApp, tmp_path: Path) -> Iterator[httpx.Client]:
    with start_app(tmp_path) as started:
        yield started


def test_repeated_upload_returns_the_same_plan(own: httpx.Client) -> None:
    first = _post(own, "a")
    assert first.status_code == 201
    assert _same(first, _post(own, "a"))
    assert _count(own) == 1
    assert own.get(first.headers["location"]).status_code == 200
    other = assert_problem(_post(own, "a", {**FLAT, "name": "other"}), 422, "idempotency-key-reused")
    assert "'a'" in other["detail"]
    # Another key or no key makes another upload.
    assert len({_post(own, "b").json()["id"], upload(own), upload(own)}) == 3
    assert _count(own) == 4
    # What was deleted since is made anew.
    assert own.delete(first.headers["location"]).status_code == 204
    assert own.get(_post(own, "a").headers["location"]).status_code == 200
    assert _count(own) == 4


def test_answer_survives_a_restart(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path) as client:
        first = _post(client, "a")
    with start_app(tmp_path) as client:
        assert _same(first, _post(client, "a"))


def test_multipart_boundary_does_not_matter(own: httpx.Client) -> None:
    first = _post_content(own)
    for name in ("flat.json", "again.json"):
        # Every form has its own boundary.
        assert _same(first, own.post("/floorplans", files={"file": (name, CONTENT)}, headers=_keyed("a")))


@pytest.mark.parametrize("key", ["x" * 255, "!~", '"quoted"'])
def test_visible_ascii_keys_are_accepted(client: httpx.Client, key: str) -> None:
    assert _same(_post(client, key), _post(client, key))


@pytest.mark.parametrize("keys", [[""], ["x" * 256], ["a b"], ["a\tb"], ["é"], ["a", "b"]])
def test_invalid_and_second_keys_are_refused(client: httpx.Client, sphere: bytes, keys: list[str]) -> None:
    headers = [(b"Idempotency-Key", key.encode("latin-1")) for key in keys]
    form = {"data": {"floorplan_id": "x"}, "files": {"photo": ("p.jpg", sphere)}}
    for response in (
        client.post("/floorplans", json=FLAT, headers=headers),
        client.post("/localise", headers=headers, **form),
    ):
        problem = assert_problem(response, 422, "invalid-request")
        assert [fault["field"] for fault in problem["errors"]] == ["Idempotency-Key"]
        assert "1 to 255" in problem["detail"]


def test_repeated_query_returns_the_same_answer(own: httpx.Client, sphere: bytes) -> None:
    plan_id = upload(own)
    first = _query(own, "a", plan_id, sphere)
    assert first.status_code == 200
    # Timings are equal too.
    assert _same(first, _query(own, "a", plan_id, sphere))
    assert_problem(_query(own, "a", plan_id, sphere, top_k="1"), 422, "idempotency-key-reused")
    assert_problem(_query(own, "a", plan_id, sphere + b"\0"), 422, "idempotency-key-reused")
    # Keys of queries and uploads are separate.
    assert _post(own, "a").status_code == 201


def test_permanent_refusal_is_kept_temporary_is_not(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    with start_app(tmp_path, max_floorplans=1) as client:
        bad = {"rooms": []}
        assert _same(_post(client, "bad", bad), _post(client, "bad", bad))
        # It contains the id of the request that was executed.
        assert _post(client, "bad", bad).json()["type"] == "urn:lalaloc:problem:invalid-floorplan"
        never = "0" * 32
        assert _same(_query(client, "q", never, sphere), _query(client, "q", never, sphere))
        plan_id = upload(client)
        assert_problem(_post(client, "full"), 507, "too-many-floorplans")
        client.delete(f"/floorplans/{plan_id}")
        assert _post(client, "full").status_code == 201


def test_one_of_many_parallel_requests_is_executed(own: httpx.Client) -> None:
    with ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(lambda _: _post(own, "a"), range(8)))
    done = [answer for answer in answers if answer.status_code == 201]
    for refused in answers:
        if refused not in done:
            assert_problem(refused, 409, "idempotency-in-progress")
            assert int(refused.headers["retry-after"]) >= 1
    assert len({answer.json()["id"] for answer in done}) == 1
    assert sum("idempotency-replayed" not in answer.headers for answer in done) == 1
    assert _count(own) == 1


def test_plan_of_a_dead_process_is_found_by_the_next(start_app: StartApp, tmp_path: Path, app_store: Store) -> None:
    with start_app(tmp_path) as client:
        # State after a crash: the plan is stored, the answer is not.
        digest = parts_sha256(Parts({}, _files({"file": CONTENT})))
        keys = IdempotencyKeys(app_store.database, app_store.quota, lease_s=1.0)
        claim = keys.begin("default", "POST /floorplans", "a", digest)
        assert isinstance(claim, Claimed)
        plan_id = claim.token
        assert_problem(_post_content(client), 409, "idempotency-in-progress")
        app_store.plans.add("default", plan_id, NewPlan(FloorPlan.from_json(CONTENT), Original(CONTENT)), limit=10)
        wait_for(lambda: _post_content(client).status_code == 201, 10.0)
        again = _post_content(client)
        assert again.json()["id"] == plan_id
        assert again.headers["idempotency-replayed"] == "true"
        assert _count(client) == 1


def test_upload_after_disconnect_is_executed_once(own: httpx.Client) -> None:
    head = (
        "POST /floorplans HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nIdempotency-Key: a\r\n"
        f"Content-Length: {len(CONTENT)}\r\n\r\n"
    )
    with connection_to(own) as connection:
        connection.sendall(head.encode() + CONTENT)
    wait_for(lambda: _post_content(own).status_code == 201, 10.0)
    assert _post_content(own).headers["idempotency-replayed"] == "true"
    assert _count(own) == 1


def test_query_after_disconnect_can_be_repeated_at_once(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    with start_app(tmp_path, grid_step_m=0.1, max_grid_poses=10**6) as client:
        plan_id = upload(client, HALL, wait=False)
        # The query waits for the plan's grid.
        form: Any = {"data": {"floorplan_id": plan_id, "refine": "none"}, "files": {"photo": ("p.jpg", sphere)}}
        query = client.build_request("POST", "/localise", headers=_keyed("a"), **form)
        body = query.read()
        head = b"".join(name + b": " + value + b"\r\n" for name, value in query.headers.raw)
        with connection_to(client) as connection:
            connection.sendall(b"POST /localise HTTP/1.1\r\n" + head + b"\r\n" + body)
            wait_for(lambda: "lalaloc_requests_in_flight 1.0" in client.get("/metrics").text)
        wait_for(lambda: "lalaloc_requests_in_flight 0.0" in client.get("/metrics").text)
        client.delete(f"/floorplans/{plan_id}")
        assert_problem(_query(client, "a", plan_id, sphere), 404, "unknown-floorplan")


def test_stored_upload_is_confirmed_without_database(own: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    # Reading the state of the grid follows the commit.
    monkeypatch.setattr(StoredGrids, "poses", Mock(side_effect=StoreUnavailableError))
    created = _post(own, "a")
    assert (created.status_code, created.json()["status"]) == (201, "ready")
    replaced = own.put(created.headers["location"], json=FLAT, headers={"If-Match": created.headers["etag"]})
    assert (replaced.status_code, replaced.json()["revision_number"]) == (200, 2)
    monkeypatch.undo()
    for answer in (replaced, own.get(created.headers["location"])):
        assert answer.headers["etag"] == replaced.headers["etag"]
        assert answer.json()["grid"]["poses"] == 110


def _idempotent(store: Store) -> IdempotentRequest:
    scope = {"type": "http", "method": "POST", "path": "/x", "headers": [(b"idempotency-key", b"a")], "state": {}}
    return IdempotentRequest(store.idempotency_keys, Request(scope), "default")


def test_failed_but_stored_upload_is_found_by_the_retry(store: Store) -> None:
    failures = iter([StoreUnavailableError(), None])

    def work(token: str) -> Response:
        store.plans.add("default", token, NewPlan(FloorPlan.from_json(CONTENT), Original(CONTENT)), limit=10)
        if (failure := next(failures)) is not None:
            raise failure
        return Response(token)

    with pytest.raises(StoreUnavailableError):
        _idempotent(store).run(NOTHING, work)
    answer = _idempotent(store).run(NOTHING, work)
    assert [summary.id for summary in store.plans.list_plans("default", limit=10)] == [bytes(answer.body).decode()]


def _poisoned() -> Exception:
    error = InvalidPhotographError("twice that took longer")
    error.__cause__ = JobLostError("poisoned")
    return error


@pytest.mark.parametrize(
    ("refusal", "kept"),
    [
        (InvalidPhotographError("no picture"), True),
        (UnknownFloorPlanError("x"), True),
        (_poisoned(), False),
        (PlanFailedError("x", "internal error"), False),
        (DecoderNotReadyError(), False),
        (UploadTimeoutError("too slow"), False),
    ],
)
def test_only_errors_of_the_request_are_kept(store: Store, refusal: Exception, kept: bool) -> None:
    refuse = Mock(side_effect=refusal)
    if kept:
        first = _idempotent(store).run(NOTHING, refuse)
        assert _idempotent(store).run(NOTHING, lambda token: Response(token)).body == first.body
        return
    with pytest.raises(type(refusal)):
        _idempotent(store).run(NOTHING, refuse)
    assert _idempotent(store).run(NOTHING, lambda _token: Response("done")).body == b"done"


@pytest.mark.parametrize("leaves", [True, False], ids=["disconnects", "retries later"])
def test_request_that_left_keeps_no_claim(store: Store, leaves: bool) -> None:
    never = Mock(side_effect=AssertionError("it has not begun"))

    async def ask() -> None:
        reads = BoundedReads(threads=1, max_pending=4, wait_s=30.0 if leaves else 0.2)
        # Writers wait for the lock.
        with store.database.writing():
            asking = asyncio.create_task(_idempotent(store).run_async(NOTHING, never, reads))
            await asyncio.sleep(0.3)
            asking.cancel()
            with pytest.raises(asyncio.CancelledError if leaves else StoreUnavailableError):
                await asking
        reads.close()

    asyncio.run(ask())
    claims = store.idempotency_keys
    wait_for(lambda: _token_of(store) is not None, 10.0)
    again = Claimed(_token_of(store) or "")
    wait_for(lambda: claims.begin("default", "POST /x", "a", parts_sha256(NOTHING)) == again, 10.0)


def _token_of(store: Store) -> str | None:
    with store.database.reading() as connection:
        return connection.scalar(select(IDEMPOTENCY.c.token))


PARTS = st.dictionaries(st.text(max_size=3), st.text(max_size=3), max_size=3)
FILES = st.dictionaries(st.text(max_size=3), st.binary(max_size=3), max_size=3)


def _files(contents: dict[str, bytes]) -> dict[str, UploadedFile]:
    return {name: UploadedFile(BytesIO(content)) for name, content in contents.items()}


@pytest.mark.slow
@given(PARTS, FILES, PARTS, FILES)
def test_digests_differ_for_different_parts(
    fields: dict[str, str], files: dict[str, bytes], other_fields: dict[str, str], other_files: dict[str, bytes]
) -> None:
    turned = Parts(dict(reversed(fields.items())), _files(dict(reversed(files.items()))))
    digest = parts_sha256(Parts(fields, _files(files)))
    assert parts_sha256(turned) == digest
    same = (fields, files) == (other_fields, other_files)
    assert (parts_sha256(Parts(other_fields, _files(other_files))) == digest) == same


# Answers by id


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
