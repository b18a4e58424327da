"""Cache of drawings: one drawing per revision, bounded queue, cancellation."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any

import pytest

from lalaloc_core.draw.plan import Marker, draw_rooms, plan_svg
from lalaloc_core.floorplan import FloorPlan
from service.errors import OverloadedError
from service.preview import drawings as module
from service.preview.drawings import Drawings
from service.preview.mesh import plan_glb
from service.storage.records import PlanRecord
from tests.growth import assert_no_worse_than_linear
from tests.service.conftest import FLAT
from tests.strategies import plan_of, spiral

NOW = datetime(2026, 1, 1, tzinfo=UTC)


def _record(revision_id: str) -> PlanRecord:
    return PlanRecord(
        id="p",
        tenant="default",
        revision_id=revision_id,
        revision=1,
        created_at=NOW,
        updated_at=NOW,
        plan=FloorPlan.from_dict(FLAT),
        failure=None,
    )


class _BlockedRenderer:
    """Renderer that counts its drawings and waits for `release`."""

    def __init__(self) -> None:
        self.drawn = 0
        self.release = threading.Event()

    def __call__(self, plan: FloorPlan) -> str:
        assert self.release.wait(30.0)
        self.drawn += 1
        return draw_rooms(plan)


@pytest.fixture
def renderer(monkeypatch: pytest.MonkeyPatch) -> _BlockedRenderer:
    renderer = _BlockedRenderer()
    monkeypatch.setattr(module, "draw_rooms", renderer)
    return renderer


@pytest.fixture
def drawings() -> Iterator[Drawings]:
    made = Drawings(limit_bytes=100_000, max_waiting=2)
    yield made
    made.close()


async def _started(work: Coroutine[Any, Any, bytes]) -> asyncio.Task[bytes]:
    task = asyncio.create_task(work)
    await asyncio.sleep(0)
    return task


def test_revision_is_drawn_once_for_all_markers(drawings: Drawings, renderer: _BlockedRenderer) -> None:
    record, marker = _record("one"), Marker(x_m=1.0, y_m=2.0, heading_deg=30.0)

    async def request() -> list[bytes]:
        tasks = [await _started(drawings.svg(record, shown)) for shown in (None, marker, None)]
        renderer.release.set()
        return [*await asyncio.gather(*tasks), await drawings.svg(record, marker)]

    results = asyncio.run(request())
    assert renderer.drawn == 1
    plain, marked = plan_svg(record.plan).encode(), plan_svg(record.plan, marker).encode()
    assert results == [plain, marked, plain, marked]


def test_new_revision_is_drawn_and_meshes_are_cached(drawings: Drawings, renderer: _BlockedRenderer) -> None:
    renderer.release.set()

    async def request() -> bytes:
        for revision_id in ("one", "two", "one"):
            await drawings.svg(_record(revision_id), None)
        meshes = [await drawings.glb(_record("one")) for _ in range(2)]
        assert meshes[0] is meshes[1]
        return meshes[0]

    assert asyncio.run(request()) == plan_glb(_record("one").plan)
    assert renderer.drawn == 2


def test_queue_is_bounded_and_abandoned_jobs_are_cancelled(drawings: Drawings, renderer: _BlockedRenderer) -> None:
    async def request() -> None:
        first = await _started(drawings.svg(_record("one"), None))
        abandoned = await _started(drawings.svg(_record("two"), None))
        with pytest.raises(OverloadedError, match="2 requests are in progress"):
            await drawings.svg(_record("three"), None)
        # The client disconnects.
        abandoned.cancel()
        with suppress(asyncio.CancelledError):
            await abandoned
        third = await _started(drawings.svg(_record("three"), None))
        renderer.release.set()
        await asyncio.gather(first, third)

    asyncio.run(request())
    assert renderer.drawn == 2


def test_drawing_time_is_linear_in_the_plan() -> None:
    def draw(corners: int) -> Any:
        return lambda: draw_rooms(plan_of(*[spiral(corners)] * 6))

    assert_no_worse_than_linear(draw, 240)
