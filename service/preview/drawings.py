"""Drawings and meshes of stored plans: made once per revision, on a thread of their own, kept while there is room."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial

from lalaloc_core.draw.plan import Marker, draw_rooms, plan_svg
from service.bounded_cache import BoundedCache
from service.errors import OverloadedError
from service.preview.mesh import plan_glb
from service.storage.records import PlanRecord
from service.threads import Threads

# (revision, what is made of it): a revision never changes.
_Key = tuple[str, str]


@dataclass
class _Making:
    """What is being made, or waits for it, and how many requests wait for that."""

    future: Future[bytes]
    waiting: int = 0


class Drawings:
    """For one event loop. What nobody waits for any more, as its clients hung up, is not begun."""

    def __init__(self, *, limit_bytes: int, max_waiting: int) -> None:
        """Args:
        limit_bytes: of what is kept.
        max_waiting: revisions that may be drawn or wait for it.
        """
        self._threads = Threads("lalaloc-drawings", 1)
        self._kept: BoundedCache[_Key, bytes] = BoundedCache(limit_bytes, len)
        self._making: dict[_Key, _Making] = {}
        self._max_waiting = max_waiting

    async def svg(self, record: PlanRecord, marker: Marker | None) -> bytes:
        """The drawing of a plan, with a camera in it or without.

        Raises:
            OverloadedError: too many others are waiting to be drawn.
        """
        return plan_svg(record.plan, marker, rooms=await self.rooms(record)).encode()

    async def rooms(self, record: PlanRecord) -> str:
        """What `lalaloc_core.draw.draw_rooms` makes of a plan.

        Raises:
            OverloadedError: too many others are waiting to be drawn.
        """
        return (await self._made((record.revision_id, "rooms"), lambda: draw_rooms(record.plan).encode())).decode()

    async def glb(self, record: PlanRecord) -> bytes:
        """The mesh of a plan.

        Raises:
            OverloadedError: too many others are waiting to be drawn.
        """
        return await self._made((record.revision_id, "glb"), partial(plan_glb, record.plan))

    def close(self) -> None:
        """Finish what is being drawn, drop the rest."""
        self._threads.close()

    async def _made(self, key: _Key, make: Callable[[], bytes]) -> bytes:
        if (kept := self._kept.get(key)) is not None:
            return kept
        making = self._making.get(key)
        if making is None:
            if len(self._making) >= self._max_waiting:
                raise OverloadedError(self._max_waiting)
            making = self._making[key] = _Making(self._threads.submit(make))
        making.waiting += 1
        try:
            content = await asyncio.shield(asyncio.wrap_future(making.future))
            self._kept.put(key, content)
            return content
        finally:
            making.waiting -= 1
            if making.waiting == 0:
                self._making.pop(key, None)
                # Without effect on what has begun.
                making.future.cancel()
