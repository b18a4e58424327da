"""Server-sent events about plans: progress of any replica, one final event, limits."""

from __future__ import annotations

import asyncio
import itertools
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import httpx
import pytest

from service import runtime
from service.app import create_app
from service.grids import builder
from service.http.events import PLAN_ENDS, ProgressEvents, plan_look
from service.schemas.stored_plans import PlanEvent
from service.settings import Settings
from service.storage.store import Store
from tests.service.conftest import FLAT, HALL, StartApp, assert_problem, metric, serve, upload, wait_for
from tests.service.postgres import PostgresServer
from tests.service.test_security import bearer, id_of, make_key

SLOW: dict[str, Any] = {"grid_step_m": 0.1, "max_grid_poses": 10**6}
Event = tuple[str, dict[str, Any]]


def _events(response: httpx.Response) -> Iterator[Event]:
    """Yield the events of a stream as they arrive, without comments."""
    name, data = "message", ""
    for line in response.iter_lines():
        field, _, value = line.partition(": ")
        if field == "event":
            name = value
        elif field == "data":
            data = value
        elif not line and data:
            yield name, json.loads(data)
            name, data = "message", ""


@contextmanager
def following(client: httpx.Client, plan_id: str) -> Iterator[Iterator[Event]]:
    with client.stream("GET", f"/floorplans/{plan_id}/events") as response:
        assert response.status_code == 200
        yield _events(response)


def follow(client: httpx.Client, plan_id: str) -> list[Event]:
    with following(client, plan_id) as events:
        return list(events)


def test_ready_plan_has_one_event_and_an_unknown_one_none(client: httpx.Client) -> None:
    plan_id = upload(client)
    with client.stream("GET", f"/floorplans/{plan_id}/events", headers={"Last-Event-ID": "7"}) as response:
        assert response.headers["content-type"] == "text/event-stream; charset=utf-8"
        assert response.headers["cache-control"] == "no-store"
        assert response.headers["x-accel-buffering"] == "no"
        events = list(_events(response))
    revision = client.get(f"/floorplans/{plan_id}").json()["revision"]
    assert events == [("ready", {"status": "ready", "progress": 1.0, "revision": revision})]
    for unknown in ("0" * 32, "x"):
        assert_problem(client.get(f"/floorplans/{unknown}/events"), 404, "unknown-floorplan")


def test_progress_is_streamed_until_ready(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, grid_step_m=0.2, max_grid_poses=10**5) as client:
        plan_id = upload(client, HALL, wait=False)
        begin = monotonic()
        events = follow(client, plan_id)
        took_s = monotonic() - begin
        assert [name for name, _ in events] == ["progress"] * (len(events) - 1) + ["ready"]
        assert len(events) >= 2
        assert len(events) <= 5.0 * took_s + 2
        progress = [event["progress"] for _, event in events]
        assert progress == sorted(progress)
        assert progress[-1] == 1.0
        assert all(event != following for event, following in itertools.pairwise(events))
        assert client.get(f"/floorplans/{plan_id}").json()["status"] == "ready"


def test_streams_of_deleted_plans_end_and_those_of_replaced_ones_go_on(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, **SLOW) as client:
        plan_id = upload(client, HALL, wait=False)
        with following(client, plan_id) as events:
            assert next(events)[0] == "progress"
            assert client.delete(f"/floorplans/{plan_id}").status_code == 204
            assert list(events)[-1] == ("deleted", {"status": "deleted"})
        wait_for(lambda: metric(client, "lalaloc_streams") == 0)
        plan_id = upload(client, HALL, wait=False)
        with following(client, plan_id) as events:
            before = next(events)[1]["revision"]
            after = client.put(f"/floorplans/{plan_id}", json=FLAT | {"name": "small"}).json()["revision"]
            name, last = list(events)[-1]
            assert (name, last["revision"]) == ("ready", after)
            assert before != after


@pytest.mark.slow
@pytest.mark.one_replica
def test_streams_are_limited_and_freed_on_disconnect(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, max_streams=3, **SLOW) as client:
        plan_id = upload(client, HALL, wait=False)
        url = f"/floorplans/{plan_id}/events"
        with client.stream("GET", url) as first, client.stream("GET", url) as second:
            # An iterator that is dropped closes its stream.
            both = [_events(first), _events(second)]
            assert [next(events)[0] for events in both] == ["progress"] * 2
            refused = client.get(url)
            assert_problem(refused, 503, "overloaded")
            assert int(refused.headers["retry-after"]) >= 1
            assert client.get(f"/floorplans/{plan_id}").status_code == 200
        wait_for(lambda: metric(client, "lalaloc_streams") == 0)
        with client.stream("GET", url) as again:
            assert next(_events(again))[0] == "progress"


@pytest.mark.slow
def test_stream_ends_at_its_deadline(start_app: StartApp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime, "STREAM_DEADLINE_S", 1.0)
    with start_app(tmp_path, **SLOW) as client:
        plan_id = upload(client, HALL, wait=False)
        begin = monotonic()
        assert {name for name, _ in follow(client, plan_id)} == {"progress"}
        assert monotonic() - begin > 0.9


def test_streams_end_when_the_service_stops(tiny_bundle: Path, tmp_path: Path) -> None:
    app = create_app(Settings(data_dir=tmp_path, bundle=tiny_bundle, workers=0, log_level="error", **SLOW))
    with serve(app) as base_url, httpx.Client(base_url=base_url, timeout=30.0) as client:
        plan_id = upload(client, HALL, wait=False)
        with following(client, plan_id) as events:
            assert next(events)[0] == "progress"
            app.state.admission.stop()
            assert {name for name, _ in events} <= {"progress"}


def test_idle_stream_sends_heartbeats(tiny_bundle: Path, tmp_path: Path) -> None:
    app = create_app(Settings(data_dir=tmp_path, bundle=tiny_bundle, workers=0, log_level="error", **SLOW))
    with serve(app) as base_url, httpx.Client(base_url=base_url, timeout=30.0) as client:
        plan_id = upload(client, HALL, wait=False)
        runtime = app.state.runtime

        async def authorised() -> bool:
            return True

        async def read() -> list[bytes]:
            look, ended = partial(plan_look, runtime.store, runtime.grids), PlanEvent(status="deleted")
            events = ProgressEvents(
                look, ended, PLAN_ENDS, runtime.admission, runtime.reads, max_s=0.5, heartbeat_s=0.05
            )
            return [chunk async for chunk in events.stream(plan_id, authorised)]

        assert asyncio.run(read()).count(b": heartbeat\n\n") >= 3


@pytest.mark.slow
def test_stream_ends_when_its_key_is_revoked(
    start_app: StartApp, app_store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The plan stays in preparation until the key is revoked, however busy the machine is.
    revoked = threading.Event()
    embed = builder.embed
    monkeypatch.setattr(builder, "embed", lambda *args, **options: (revoked.wait(60.0), embed(*args, **options))[1])
    with start_app(tmp_path, api_keys=True, key_cache_s=0.1, **SLOW) as client:
        other, key = make_key(app_store), make_key(app_store)
        client.headers.update(bearer(other))
        plan_id = upload(client, HALL, wait=False)
        with client.stream("GET", f"/floorplans/{plan_id}/events", headers=bearer(key)) as response:
            chunks = response.iter_raw()
            # The stream goes on past several checks of the key.
            end = monotonic() + 2.5
            while monotonic() < end:
                next(chunks)
            app_store.keys.revoke(id_of(key))
            assert b"event: ready" not in b"".join(chunks)
        revoked.set()


@pytest.mark.slow
def test_progress_of_another_replica_is_streamed(postgres: PostgresServer, start_app: StartApp, tmp_path: Path) -> None:
    shared = {"database_url": postgres.new_database(), "sweep_s": 0.2, "grid_lease_s": 0.8, **SLOW}
    with start_app(tmp_path / "a", **shared) as first, start_app(tmp_path / "b", **shared) as second:
        plan_id = upload(first, HALL, wait=False)
        wait_for(lambda: first.get(f"/floorplans/{plan_id}").json()["progress"] > 0.0)
        with following(second, plan_id) as events:
            assert max(next(events)[1]["progress"] for _ in range(3)) > 0.0
            sleep(0.1)
            assert first.delete(f"/floorplans/{plan_id}").status_code == 204
            assert list(events)[-1][0] == "deleted"
