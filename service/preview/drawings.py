"""Cache of drawings and meshes of stored plans, made once per revision on a thread of their own."""

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

# (revision, product). A revision never changes.
_Key = tuple[str, str]


@dataclass
class _PendingJob:
    """Job that is queued or running, and the number of requests waiting for it."""

    future: Future[bytes]
    waiting: int = 0


class Drawings:
    """Drawings and meshes for one event loop. Queued jobs are cancelled when no request waits for them."""

    def __init__(self, *, limit_bytes: int, max_waiting: int) -> None:
        """Start the thread.

        Args:
            limit_bytes: size of the cache.
            max_waiting: largest number of revisions being drawn or waiting.
        """
        self._threads = Threads("lalaloc-drawings", 1)
        self._cache: BoundedCache[_Key, bytes] = BoundedCache(limit_bytes, len)
        self._pending: dict[_Key, _PendingJob] = {}
        self._max_waiting = max_waiting

    async def svg(self, record: PlanRecord, marker: Marker | None) -> bytes:
        """Return the drawing of a plan, optionally with a camera.

        Raises:
            OverloadedError: too many plans are waiting to be drawn.
        """
        return plan_svg(record.plan, marker, rooms=await self.rooms(record)).encode()

    async def rooms(self, record: PlanRecord) -> str:
        """Return the rooms of a plan as SVG elements, from `lalaloc_core.draw.plan.draw_rooms`.

        Raises:
            OverloadedError: too many plans are waiting to be drawn.
        """
        drawn = await self._get_or_make((record.revision_id, "rooms"), lambda: draw_rooms(record.plan).encode())
        return drawn.decode()

    async def glb(self, record: PlanRecord) -> bytes:
        """Return the mesh of a plan.

        Raises:
            OverloadedError: too many plans are waiting to be drawn.
        """
        return await self._get_or_make((record.revision_id, "glb"), partial(plan_glb, record.plan))

    def close(self) -> None:
        """Finish the current job and drop the queued jobs."""
        self._threads.close()

    async def _get_or_make(self, key: _Key, make: Callable[[], bytes]) -> bytes:
        if (cached := self._cache.get(key)) is not None:
            return cached
        job = self._pending.get(key)
        if job is None:
            if len(self._pending) >= self._max_waiting:
                raise OverloadedError(self._max_waiting)
            job = self._pending[key] = _PendingJob(self._threads.submit(make))
        job.waiting += 1
        try:
            content = await asyncio.shield(asyncio.wrap_future(job.future))
            self._cache.put(key, content)
            return content
        finally:
            job.waiting -= 1
            if job.waiting == 0:
                self._pending.pop(key, None)
                # A running job is not affected.
                job.future.cancel()
