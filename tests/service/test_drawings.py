"""Drawings of stored plans: made once per revision, one at a time, and not for clients that are gone."""

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


class _Pen:
    """Draws as the service does, once it is let; counts."""

    def __init__(self) -> None:
        self.drawn = 0
        self.go_on = threading.Event()

    def __call__(self, plan: FloorPlan) -> str:
        assert self.go_on.wait(30.0)
        self.drawn += 1
        return draw_rooms(plan)


@pytest.fixture
def pen(monkeypatch: pytest.MonkeyPatch) -> _Pen:
    pen = _Pen()
    monkeypatch.setattr(module, "draw_rooms", pen)
    return pen


@pytest.fixture
def drawings() -> Iterator[Drawings]:
    made = Drawings(limit_bytes=100_000, max_waiting=2)
    yield made
    made.close()


async def _begun(work: Coroutine[Any, Any, bytes]) -> asyncio.Task[bytes]:
    task = asyncio.create_task(work)
    await asyncio.sleep(0)
    return task


def test_a_revision_is_drawn_once_wherever_the_camera_stands(drawings: Drawings, pen: _Pen) -> None:
    record, marker = _record("one"), Marker(x_m=1.0, y_m=2.0, heading_deg=30.0)

    async def ask() -> list[bytes]:
        tasks = [await _begun(drawings.svg(record, where)) for where in (None, marker, None)]
        pen.go_on.set()
        return [*await asyncio.gather(*tasks), await drawings.svg(record, marker)]

    answers = asyncio.run(ask())
    assert pen.drawn == 1
    plain, marked = plan_svg(record.plan).encode(), plan_svg(record.plan, marker).encode()
    assert answers == [plain, marked, plain, marked]


def test_another_revision_is_drawn_anew_and_meshes_are_kept_too(drawings: Drawings, pen: _Pen) -> None:
    pen.go_on.set()

    async def ask() -> bytes:
        for revision_id in ("one", "two", "one"):
            await drawings.svg(_record(revision_id), None)
        meshes = [await drawings.glb(_record("one")) for _ in range(2)]
        assert meshes[0] is meshes[1]
        return meshes[0]

    assert asyncio.run(ask()) == plan_glb(_record("one").plan)
    assert pen.drawn == 2


def test_what_waits_is_bounded_and_what_nobody_waits_for_is_not_begun(drawings: Drawings, pen: _Pen) -> None:
    async def ask() -> None:
        first = await _begun(drawings.svg(_record("one"), None))
        gone = await _begun(drawings.svg(_record("two"), None))
        with pytest.raises(OverloadedError, match="2 others"):
            await drawings.svg(_record("three"), None)
        # Its client hangs up.
        gone.cancel()
        with suppress(asyncio.CancelledError):
            await gone
        third = await _begun(drawings.svg(_record("three"), None))
        pen.go_on.set()
        await asyncio.gather(first, third)

    asyncio.run(ask())
    assert pen.drawn == 2


def test_the_time_for_a_drawing_grows_with_the_plan_and_no_faster() -> None:
    def draw(corners: int) -> Any:
        return lambda: draw_rooms(plan_of(*[spiral(corners)] * 6))

    assert_no_worse_than_linear(draw, 240)
