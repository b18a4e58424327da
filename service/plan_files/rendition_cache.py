"""Cache of the files made from stored plans, each made once per revision.

Worker processes make those of all but small plans: parsing a plan of 10,000 rooms takes seconds of the interpreter, in
which no other request would be answered.
"""

from __future__ import annotations

import asyncio
import logging
from concurrent.futures import Future
from contextvars import Context
from dataclasses import dataclass
from functools import partial

from lalaloc_core.bundle import Bundle
from lalaloc_core.conditions import CONDITIONS
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.localise.localisability.predicted_localisability import errors_of
from service.bounded_cache import BoundedCache
from service.capacity.fair_share import FairSemaphore, Shares
from service.capacity.threads import Threads
from service.errors import DamagedDataError, OverloadedError, UnknownFloorPlanError, UnmeasuredModelError
from service.plan_documents import PREDICTIONS, SLOW, Rendition, RenditionJob, RenditionKind
from service.plan_files.converter import Converter
from service.plan_files.renditions import make_rendition
from service.storage.plans import Plans
from service.telemetry import LOGGER_NAME

# Characters of a document up to which its files are made in this process: about 30 rooms.
_SMALL = 8192
_THREADS = 2
# A revision never changes.
_Key = tuple[str, RenditionKind]


@dataclass
class _PendingJob:
    """File that is being made, and the number of requests waiting for it."""

    task: asyncio.Task[Rendition] | None = None
    in_worker: Future | None = None
    waiting: int = 0

    def cancel(self) -> bool:
        """Cancel the job, unless a worker runs it already."""
        assert self.task is not None
        if self.in_worker is not None and not self.in_worker.cancel():
            return False
        self.task.cancel()
        return True


class RenditionCache:
    """Files of stored plans, for one event loop. Jobs that no request waits for are cancelled before they begin.

    `max_pending` files are made or wait, shared between clients. A prediction needs one of the `turns`, and a core.
    """

    def __init__(
        self,
        plans: Plans,
        converter: Converter,
        bundle: Bundle,
        *,
        step_m: float,
        limit_bytes: int,
        max_pending: int,
        turns: FairSemaphore,
        cores: FairSemaphore,
    ) -> None:
        self._plans, self._converter, self._bundle, self._step_m = plans, converter, bundle, step_m
        self._threads = Threads("lalaloc-renditions", _THREADS)
        self._cache: BoundedCache[_Key, Rendition] = BoundedCache(limit_bytes, lambda made: len(made.content))
        self._pending: dict[_Key, _PendingJob] = {}
        self._shares = Shares(max_pending)
        self._turns, self._cores = turns, cores

    def put(self, revision_id: str, kind: RenditionKind, made: Rendition) -> None:
        """Keep a file that was made elsewhere."""
        self._cache.put((revision_id, kind), made)

    async def get(self, plan_id: str, revision_id: str, kind: RenditionKind, client: str) -> Rendition:
        """Return a file of a stored plan, regardless of tenant. Callers check access first."""
        key = (revision_id, kind)
        if (cached := self._cache.get(key)) is not None:
            return cached
        job = self._pending.get(key)
        if job is None or job.task is None:
            if not self._shares.may_take(client):
                raise OverloadedError(self._shares.limit)
            self._shares.take(client)
            job = self._pending[key] = _PendingJob()
            # The task can outlive this request, so it must not log under its ids.
            job.task = asyncio.create_task(self._make(job, plan_id, key, client), context=Context())
            job.task.add_done_callback(partial(self._end, key, job, client))
        job.waiting += 1
        try:
            return await asyncio.shield(job.task)
        finally:
            job.waiting -= 1
            if not job.waiting and not job.task.done() and job.cancel():
                self._pending.pop(key, None)

    def close(self) -> None:
        """Finish the current jobs and drop the queued jobs."""
        self._threads.close()

    async def _make(self, job: _PendingJob, plan_id: str, key: _Key, client: str) -> Rendition:
        try:
            if key[1] in PREDICTIONS:
                made = await self._predicted(job, plan_id, key, client)
            else:
                made = await self._made(job, plan_id, key, client)
        except DamagedDataError as error:
            logging.getLogger(LOGGER_NAME).error(str(error), extra={"fields": {"floorplan": plan_id}})
            raise
        self._cache.put(key, made)
        return made

    async def _predicted(self, job: _PendingJob, plan_id: str, key: _Key, client: str) -> Rendition:
        try:
            errors_of(self._bundle.manifest)
        except InvalidInputError as error:
            raise UnmeasuredModelError(str(error)) from error
        report = b""
        if key[1] in CONDITIONS:
            report = (await self.get(plan_id, key[0], "localisability", client)).content
        # The turn comes first: a core must not be held by a prediction that waits.
        async with self._turns.held(client), self._cores.held(client):
            return await self._made(job, plan_id, key, client, report)

    async def _made(self, job: _PendingJob, plan_id: str, key: _Key, client: str, report: bytes = b"") -> Rendition:
        begun = await self._threads.run(client, self._begin, job, plan_id, key, client, report)
        if isinstance(begun, Rendition):
            return begun
        job.in_worker = begun
        return await self._converter.rendition(begun, key[1])

    def _begin(self, job: _PendingJob, plan_id: str, key: _Key, client: str, report: bytes) -> Rendition | Future:
        """Read a plan; return the file of a small one, and the job of a worker for others."""
        revision_id, kind = key
        stored = self._plans.stored(revision_id) if job.waiting else None
        if stored is None:
            raise UnknownFloorPlanError(plan_id)
        bundle = self._bundle if kind in PREDICTIONS else None
        rendition = RenditionJob(stored, kind, self._step_m, bundle, report)
        if len(stored.document.document) <= _SMALL and kind not in SLOW:
            return make_rendition(rendition)
        begun = self._converter.begin_rendition(rendition, client)
        if not job.waiting:
            begun.cancel()
        return begun

    def _end(self, key: _Key, job: _PendingJob, client: str, done: asyncio.Task[Rendition]) -> None:
        self._shares.give_back(client)
        if self._pending.get(key) is job:
            del self._pending[key]
        if not done.cancelled():
            # Retrieved here in case no request waits for it.
            done.exception()
