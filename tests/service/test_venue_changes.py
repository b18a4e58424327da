"""Plans that come, go and change: queries of their venue search what is stored, in every replica, at once."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import httpx
import numpy as np
import pytest
from sqlalchemy import update

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.venue.plan_index import PlanIndex
from lalaloc_core.render.sampling import PoseSet
from service.bounded_cache import BoundedCache
from service.storage import Store
from service.storage.records import GridKey, NewPlan, Original, VenueMember
from service.storage.tables import FLOORPLANS, TENANTS
from service.venues import venue_plans
from service.venues.plan_indices import Indexed
from service.venues.venue_plans import VenuePlans
from tests.service.conftest import FLAT, StartApp, upload
from tests.service.test_venue_queries import STUDIO, ask, venue_of

MODEL, VENUE, TENANT = ("m1", 0.5), "f" * 32, "default"


class _Grids:
    model = MODEL


class Replica:
    """Store and reader of venues of one replica."""

    def __init__(self, url: str) -> None:
        self.store = Store(url)
        limits: dict[str, Any] = {"limit_bytes": 2**20, "max_poses": 1}
        self._plans = VenuePlans(self.store, cast(Any, _Grids()), cast(Any, None), **limits)

    def rows(self) -> list[tuple[Any, ...]]:
        return [tuple(row) for row in self._plans._members(TENANT, VENUE)]

    def rows_read_anew(self) -> list[tuple[Any, ...]]:
        return [tuple(row) for row in self.store.venues.searchable_plans(VENUE, *MODEL)]


class Changes:
    """Random changes of plans of a venue, by any replica."""

    def __init__(self, replicas: list[Replica], seed: int) -> None:
        self._rng, self._replicas, self._count = random.Random(seed), replicas, 0
        self.plans: dict[str, str] = {}
        self.store.venues.add(TENANT, VENUE, "venue", None, [], limit=1)
        for _ in range(12):
            self.upload()

    @property
    def store(self) -> Store:
        return self._rng.choice(self._replicas).store

    def some(self) -> str:
        return self._rng.choice(sorted(self.plans))

    def upload(self) -> None:
        self._count += 1
        plan_id, plan = f"{self._count:032x}", FloorPlan.from_dict({**FLAT, "name": f"plan {self._count}"})
        record = self.store.plans.add(TENANT, plan_id, NewPlan(plan, Original(b"{}")), limit=99)
        self.plans[plan_id] = record.revision_id
        self.place(plan_id)

    def place(self, plan_id: str | None = None) -> None:
        name = self._rng.choice([None, "in the venue"])
        member = VenueMember(plan_id or self.some(), float(self._rng.randrange(3)), name)
        self.store.venues.change(TENANT, VENUE, members=[member], max_plans=99)

    def remove(self) -> None:
        if members := self.store.venues.plans(VENUE, limit=99):
            self.store.venues.change(TENANT, VENUE, removed=[self._rng.choice(members).plan_id], max_plans=99)

    def replace(self) -> None:
        plan_id, plan = self.some(), FloorPlan.from_dict({**FLAT, "name": f"again {self._rng.random()}"})
        record = self.store.plans.add_revision(TENANT, plan_id, NewPlan(plan, Original(b"{}")), keep=3)
        self.plans[plan_id] = record.revision_id

    def prepare(self) -> None:
        assert self.store.grids.put(self._key(self.some()), _grid(), keep=8, always_keep_mm=1500)

    def fail(self) -> None:
        self.store.plans.set_failure(self.plans[self.some()], "too dark")

    def try_again(self) -> None:
        self.store.plans.clear_failures()

    def delete(self) -> None:
        if len(self.plans) > 1:
            plan_id = self.some()
            del self.plans[plan_id]
            self.store.plans.delete(TENANT, plan_id)

    def prepare_by_an_earlier_version(self) -> None:
        """Store a grid, and count its bytes alone."""
        store = self.store
        with store.database.reading() as connection:
            before = connection.execute(TENANTS.select()).one()
        self.prepare()
        columns = TENANTS.c
        with store.database.writing() as connection:
            values = {name: getattr(before, name) for name in ("changes", "counted_bytes")}
            connection.execute(update(TENANTS).values(values))
            own = FLOORPLANS.c.changed
            connection.execute(update(FLOORPLANS).where(own > before.changes).values(changed=0))
            connection.execute(update(TENANTS).values({"grids_bytes": columns.grids_bytes + 512}))

    def _key(self, plan_id: str) -> GridKey:
        sha256, step_m = MODEL
        revision_id = self.plans[plan_id]
        return GridKey(revision_id=revision_id, model_sha256=sha256, step_m=step_m, camera_height_mm=1500)


def _grid() -> PoseGrid:
    poses = PoseSet(np.zeros((3, 2)), np.zeros(3, int))
    return PoseGrid(poses, np.zeros((3, 4), np.float32), np.ones((3, 8), np.float32), 0.5, 1.5)


@pytest.fixture
def replicas(database_of: Callable[[Path], str], tmp_path: Path) -> Iterator[list[Replica]]:
    url = database_of(tmp_path)
    found = [Replica(url), Replica(url)]
    yield found
    for replica in found:
        replica.store.close()


@pytest.mark.parametrize("seed", range(3))
def test_rows_after_any_changes_are_those_that_are_stored(replicas: list[Replica], seed: int) -> None:
    changes = Changes(replicas, seed)
    kinds = [changes.upload, changes.place, changes.remove, changes.replace, changes.prepare, changes.prepare]
    kinds += [changes.fail, changes.try_again, changes.delete, changes.prepare_by_an_earlier_version]
    rng = random.Random(seed)
    for _ in range(40):
        for kind in rng.choices(kinds, k=rng.choice([1, 1, 2])):
            kind()
        # One replica can miss several changes.
        for replica in rng.choice([replicas, replicas[:1], replicas[1:]]):
            assert replica.rows() == replica.rows_read_anew()


def test_other_changes_leave_the_rows_in_memory(replicas: list[Replica], monkeypatch: pytest.MonkeyPatch) -> None:
    Changes(replicas, 0)
    first, second = replicas
    before = first.rows()
    second.store.answers.add(TENANT, f"{1:032x}", lambda answer_id: answer_id, limit=9)
    monkeypatch.setattr(first.store.venues, "searchable_plans", lambda *_: pytest.fail("read of the rows"))
    second.store.plans.add(TENANT, "a" * 32, NewPlan(FloorPlan.from_dict(FLAT), Original(b"{}")), limit=99)
    assert first.rows() == before


@pytest.mark.slow
@pytest.mark.one_replica
def test_index_is_kept_for_the_next_query_if_the_first_misses_its_deadline(
    start_app: StartApp, tmp_path: Path, sphere: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(venue_plans, "MAX_SEARCHED", 2)
    built, build, missed = [], PlanIndex.build, threading.Event()
    put, kept = BoundedCache.put, threading.Event()

    def slow(*args: Any, **options: Any) -> PlanIndex:
        built.append(1)
        missed.wait(60.0)
        return build(*args, **options)

    def observed(cache: BoundedCache[Any, Any], key: Any, value: Any) -> int:
        evictions = put(cache, key, value)
        if isinstance(value, Indexed):
            kept.set()
        return evictions

    monkeypatch.setattr(PlanIndex, "build", slow)
    monkeypatch.setattr(BoundedCache, "put", observed)
    with start_app(tmp_path, request_deadline_s=6.0) as client:
        venue_id = venue_of(client, *(upload(client, {**STUDIO, "name": f"{number}"}) for number in range(4)))
        # The second one waits for the first one's index, and no longer than its own deadline.
        with ThreadPoolExecutor(2) as threads:
            answers = list(threads.map(lambda _: ask(client, venue_id, sphere, refine="none"), range(2)))
        assert [answer.status_code for answer in answers] == [504, 504]
        missed.set()
        assert kept.wait(60.0)
        assert ask(client, venue_id, sphere, refine="none").status_code == 200
    assert len(built) == 1


@pytest.mark.one_replica
def test_queries_are_right_while_plans_change(
    start_app: StartApp, tmp_path: Path, sphere: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(venue_plans, "MAX_SEARCHED", 3)
    with start_app(tmp_path, request_deadline_s=120.0) as client, ThreadPoolExecutor(2) as threads:
        plan_ids = [upload(client, {**STUDIO, "name": f"{number}"}) for number in range(5)]
        flat = upload(client)
        venue_id, ended = venue_of(client, *plan_ids, flat), threading.Event()

        def answers() -> list[httpx.Response]:
            found = []
            while not ended.is_set() or not found:
                found.append(ask(client, venue_id, sphere, refine="none"))
            return found

        running = [threads.submit(answers) for _ in range(2)]
        for number, plan_id in enumerate(plan_ids[:4]):
            client.patch(f"/venues/{venue_id}", json={"remove": [plan_id]}).raise_for_status()
            client.put(f"/floorplans/{flat}", json={**FLAT, "name": f"flat {number}"}).raise_for_status()
            again = {"plans": [{"floorplan_id": plan_id, "level": number}]}
            client.patch(f"/venues/{venue_id}", json=again).raise_for_status()
        client.delete(f"/floorplans/{plan_ids[0]}").raise_for_status()
        member = {"plans": [{"floorplan_id": upload(client, FLAT), "level": 7}]}
        client.patch(f"/venues/{venue_id}", json=member).raise_for_status()
        ended.set()
        for response in (response for future in running for response in future.result()):
            assert response.status_code == 200, response.text
        updated = ask(client, venue_id, sphere, refine="none", top_k=10).json()
    # A new process makes the index anew.
    with start_app(tmp_path, request_deadline_s=120.0) as client:
        anew = ask(client, venue_id, sphere, refine="none", top_k=10).json()
    assert {plan["floorplan_id"] for plan in updated["plans"]} == {plan["floorplan_id"] for plan in anew["plans"]}
    assert plan_ids[0] not in {plan["floorplan_id"] for plan in updated["plans"]}
    assert updated["confidence"] == pytest.approx(anew["confidence"], abs=1e-6)
    assert updated["position"] == pytest.approx(anew["position"], abs=1e-6)
