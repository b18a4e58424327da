"""Files made from stored plans: once per revision, outside the service's process, and never for a known tag."""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import threading
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
from pydantic import BaseModel

from lalaloc_core.bundle import Bundle, default_bundle
from lalaloc_core.draw.plan import Marker, draw_rooms, plan_svg
from lalaloc_core.floorplan import FloorPlan, OpeningFace
from lalaloc_core.floorplan.plan_document import read_plan
from service.capacity.cpu_accounts import CpuAccounts
from service.capacity.fair_share import FairSemaphore
from service.errors import OverloadedError
from service.plan_documents import Rendition, RenditionJob, RenditionKind
from service.plan_files import rendition_cache
from service.plan_files.converter import Converter
from service.plan_files.plan_mesh import plan_glb
from service.plan_files.rendition_cache import RenditionCache
from service.plan_files.renditions import plan_layout
from service.settings import Settings
from service.storage import Store
from service.storage.records import NewPlan, Original
from service.telemetry import Telemetry
from tests.growth import assert_no_worse_than_linear
from tests.service.conftest import FLAT, StartApp, assert_problem, metric, tiled_plan, upload, wait_for
from tests.strategies import plan_of, present, spiral

READS = ["", "/layout", "/preview.svg", "/mesh.glb", "/original", "/export", "/export?format=dxf"]


class _BlockedMaker:
    """Maker that counts its files and waits for `release`."""

    def __init__(self) -> None:
        self.made: list[RenditionKind] = []
        self.release = threading.Event()

    def __call__(self, job: RenditionJob) -> Rendition:
        assert self.release.wait(30.0)
        self.made.append(job.kind)
        return Rendition(f"{job.stored.revision_id} {job.kind}".encode(), (0.0, 0.0, 1.0, 1.0))


@pytest.fixture
def maker(monkeypatch: pytest.MonkeyPatch) -> _BlockedMaker:
    maker = _BlockedMaker()
    monkeypatch.setattr(rendition_cache, "make_rendition", maker)
    return maker


@pytest.fixture
def cache(store: Store) -> Iterator[RenditionCache]:
    converter = Converter(Settings(import_workers=1), Telemetry())
    bundle = Bundle.open(default_bundle())
    permits = {name: FairSemaphore(1, CpuAccounts()) for name in ("turns", "cores")}
    cache = RenditionCache(store.plans, converter, bundle, step_m=0.5, limit_bytes=100_000, max_pending=4, **permits)
    yield cache
    converter.close()
    cache.close()


def _add(store: Store, document: dict[str, Any] = FLAT) -> str:
    """Store a plan, and return its revision."""
    plan = FloorPlan.from_dict(document)
    return store.plans.add("default", "p", NewPlan(plan, Original(b"{}")), limit=10).revision_id


async def _started(work: Coroutine[Any, Any, Rendition]) -> asyncio.Task[Rendition]:
    task = asyncio.create_task(work)
    await asyncio.sleep(0)
    return task


def test_file_is_made_once_for_all_requests(store: Store, cache: RenditionCache, maker: _BlockedMaker) -> None:
    revision_id = _add(store)

    async def request() -> None:
        tasks = [await _started(cache.get("p", revision_id, "mesh", client)) for client in "aab"]
        maker.release.set()
        first, *others = await asyncio.gather(*tasks)
        assert all(made is first for made in [*others, await cache.get("p", revision_id, "mesh", "c")])
        await cache.get("p", revision_id, "layout", "c")

    asyncio.run(request())
    assert maker.made == ["mesh", "layout"]


@pytest.mark.one_replica
def test_reads_of_a_client_do_not_wait_for_its_files(client: httpx.Client, maker: _BlockedMaker) -> None:
    plan_id = upload(client)
    with ThreadPoolExecutor(3) as threads:
        paths = [f"/floorplans/{plan_id}/{kind}" for kind in ("layout", "mesh.glb", "export?format=geojson")]
        made = [threads.submit(client.get, path) for path in paths]
        try:
            wait_for(lambda: metric(client, "lalaloc_reads_in_flight") == len(made))
            assert client.get("/limits", timeout=10.0).status_code == 200
        finally:
            maker.release.set()
        assert [answer.result().status_code for answer in made] == [200] * 3


def test_pending_files_are_shared_and_abandoned_ones_are_not_made(
    store: Store, cache: RenditionCache, maker: _BlockedMaker
) -> None:
    revision_id = _add(store)
    kinds: tuple[RenditionKind, ...] = ("mesh", "layout", "drawing", "native")

    async def request() -> None:
        tasks = [await _started(cache.get("p", revision_id, kind, "greedy")) for kind in kinds[:3]]
        with pytest.raises(OverloadedError):
            await cache.get("p", revision_id, kinds[3], "greedy")
        tasks.append(await _started(cache.get("p", revision_id, kinds[3], "modest")))
        # The client disconnects.
        tasks[2].cancel()
        with suppress(asyncio.CancelledError):
            await tasks[2]
        maker.release.set()
        await asyncio.gather(tasks[0], tasks[1], tasks[3])

    asyncio.run(request())
    assert set(maker.made) == {"mesh", "layout", "native"}


def test_worker_finishes_a_file_without_a_client(store: Store, cache: RenditionCache) -> None:
    revision_id = _add(store, tiled_plan(12, openings=True))

    async def request() -> None:
        task = await _started(cache.get("p", revision_id, "layout", "a"))
        while not multiprocessing.active_children():
            await asyncio.sleep(0.01)
        pending = next(iter(cache._pending.values()))
        while pending.in_worker is None or not pending.in_worker.running():
            await asyncio.sleep(0.01)
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        # It continues for the next request, instead of being made from the start.
        await _started(cache.get("p", revision_id, "layout", "a"))
        assert next(iter(cache._pending.values())) is pending
        assert json.loads((await present(pending.task)).content)["revision"] == revision_id

    asyncio.run(request())


@pytest.fixture
def converted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the names of models that this process serialises, and of documents that it parses, as it does so."""
    calls: list[str] = []

    def watch(owner: Any, name: str, label: Callable[[Any], str]) -> None:
        original = getattr(owner, name)

        def watched(self: Any, *args: Any, **kwargs: Any) -> Any:
            calls.append(label(self))
            return original(self, *args, **kwargs)

        monkeypatch.setattr(owner, name, watched)

    watch(BaseModel, "model_dump_json", lambda model: type(model).__name__)
    watch(FloorPlan, "to_dict", lambda plan: "plan")

    def parsed(*args: Any) -> dict[str, Any]:
        calls.append("parse")
        return read_plan(*args)

    monkeypatch.setattr("lalaloc_core.floorplan.plan.read_plan", parsed)
    return calls


@pytest.mark.one_replica
@pytest.mark.parametrize("path", READS)
def test_known_tag_converts_nothing(
    start_app: StartApp, tmp_path: Path, path: str, converted: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with start_app(tmp_path, plan_cache_bytes=0) as client:
        url = f"/floorplans/{upload(client)}{path}"
        first = client.get(url)
        assert first.status_code == 200
        for module in ("plan_rows", "statements"):
            monkeypatch.setattr(f"service.storage.{module}.read_chunks", None)
        converted.clear()
        answers = [client.get(url, headers={"If-None-Match": first.headers["etag"]}) for _ in range(3)]
        assert {answer.status_code for answer in answers} == {304}
        assert converted == []


@pytest.mark.one_replica
def test_repeated_reads_convert_a_plan_once(start_app: StartApp, tmp_path: Path, converted: list[str]) -> None:
    with start_app(tmp_path) as client:
        plan_id = upload(client)
        for path in READS:
            first = client.get(f"/floorplans/{plan_id}{path}")
            converted.clear()
            assert client.get(f"/floorplans/{plan_id}{path}").content == first.content
            # The state of the pose grid is four short fields.
            assert converted == ["PlanStateAnswer"] * (path == "")


@pytest.mark.slow
@pytest.mark.one_replica
def test_large_plans_are_converted_by_workers(start_app: StartApp, tmp_path: Path, converted: list[str]) -> None:
    document = tiled_plan(12, openings=True)
    with start_app(tmp_path) as client:
        plan_id = upload(client, document)
    with start_app(tmp_path) as client:
        # After the start, no file is in memory; pose grids are in the database.
        converted.clear()
        bodies = {path: client.get(f"/floorplans/{plan_id}{path}") for path in READS}
        assert converted == ["PlanStateAnswer"]
        assert [body.status_code for body in bodies.values()] == [200] * len(READS)
    plan = FloorPlan.from_dict(document)
    assert bodies["/mesh.glb"].content == plan_glb(plan)
    assert bodies["/preview.svg"].content == plan_svg(plan).encode()
    assert json.loads(bodies["/layout"].content)["rooms"] == json.loads(plan_layout(plan, "p", "r"))["rooms"]
    assert [room["area_m2"] for room in bodies[""].json()["rooms"]] == [16.0] * 144


@pytest.mark.slow
@pytest.mark.one_replica
def test_localisability_is_predicted_once_per_revision_and_model(
    start_app: StartApp, tiny_view_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin, begun = Converter.begin_rendition, list[str]()

    def watched(self: Converter, job: RenditionJob, client: str) -> Any:
        begun.append(job.kind)
        return begin(self, job, client)

    monkeypatch.setattr(Converter, "begin_rendition", watched)
    with start_app(tmp_path, bundle=tiny_view_bundle) as client:
        url = f"/floorplans/{upload(client)}/localisability"
        drawn = client.get(f"{url}.svg")
        assert drawn.headers["content-type"] == "image/svg+xml"
        assert "phone photograph is found within 1 m, heading unknown" in drawn.text
        sphere = client.get(f"{url}.svg", params={"photograph": "sphere", "heading": "known"})
        assert "a sphere is found within 1 m, heading known" in sphere.text
        first = client.get(url)
        answer = first.json()
        assert answer["spacing_m"] == 0.5
        assert [room["name"] for room in answer["rooms"]] == [room["name"] for room in FLAT["rooms"]]
        assert {place["room"] for place in answer["places"]} == {room["id"] for room in answer["rooms"]}
        assert set(answer["gains"]) == {"heading", "three_photographs", "sphere", "room_hint", "doors"}
        assert answer["advice"] != []
        rough = client.get(url, params={"coarse": True})
        assert (rough.json()["coarse"], rough.json()["advice"], answer["coarse"]) == (True, [], False)
        assert rough.headers["etag"] != first.headers["etag"]
        again = client.get(url, headers={"If-None-Match": first.headers["etag"]})
        assert (again.status_code, client.get(url).content) == (304, first.content)
        assert_problem(client.get(f"{url}.svg?photograph=drone"), 422, "invalid-request")
    kinds = ["localisability", "phone_unknown_heading", "sphere_known_heading", "coarse localisability"]
    assert begun == kinds
    with start_app(tmp_path) as client:
        # Another model, without measured errors.
        refused = client.get(url, headers={"If-None-Match": first.headers["etag"]})
        assert_problem(refused, 501, "model-unmeasured")


def test_marked_drawing_is_that_of_the_core(client: httpx.Client) -> None:
    plan_id, plan = upload(client), FloorPlan.from_dict(FLAT)
    marked = client.get(f"/floorplans/{plan_id}/preview.svg", params={"x_m": 9.5, "y_m": 2, "heading_deg": 30})
    assert marked.text == plan_svg(plan, Marker(x_m=9.5, y_m=2.0, heading_deg=30.0))


class _CountedIndex(int):
    """Index of a room that counts its comparisons."""

    compared = 0

    def __eq__(self, other: object) -> bool:
        _CountedIndex.compared += 1
        return int(self) == other

    __hash__ = int.__hash__


@pytest.mark.parametrize("make", [lambda plan: plan_layout(plan, "p", "r"), plan_glb, draw_rooms])
def test_rooms_are_not_compared_with_every_opening(make: Callable[[FloorPlan], object]) -> None:
    plan = FloorPlan.from_dict(tiled_plan(8, openings=True))
    faces = tuple(
        OpeningFace(**{**vars(face), "room": _CountedIndex(face.room)})  # pyright: ignore[reportArgumentType]
        for face in plan.opening_faces
    )
    _CountedIndex.compared = 0
    object.__setattr__(plan, "opening_faces", faces)
    make(plan)
    assert _CountedIndex.compared <= 2 * len(faces)


def test_drawing_time_is_linear_in_the_plan() -> None:
    def draw(corners: int) -> Any:
        return lambda: draw_rooms(plan_of(*[spiral(corners)] * 6))

    assert_no_worse_than_linear(draw, 240)
