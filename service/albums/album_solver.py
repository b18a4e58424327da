"""Background job that solves albums, each by one replica, which holds its lease."""

from __future__ import annotations

import asyncio
import logging
import uuid
from contextlib import suppress
from time import monotonic
from typing import Any

from lalaloc_core.errors import InvalidInputError
from service import errors
from service.capacity.threads import BoundedReads
from service.query import AlbumProgress, AlbumQuery, Localiser
from service.query.album_search import AT_A_TIME
from service.query_context import QueryContext
from service.schemas.albums import AlbumDocument
from service.settings import Settings
from service.storage import PlanLookup, Store
from service.storage.album_jobs import AlbumJob
from service.telemetry import LOGGER_NAME, Telemetry

# Renewals of the lease per its length.
_HEARTBEATS = 8.0
# Unfinished attempts, by any replicas, before an album counts as failed.
_MAX_ATTEMPTS = 5
# Pause (s) after an attempt that can succeed later, and limit of the pause after a solve, which is as long as the
# solve, so that an album that grows does not keep a core busy; a correction, which somebody looks at, waits less.
_RETRY_S, _MAX_REST_S, _MAX_REST_BEFORE_CORRECTION_S = 2.0, 3.0, 0.2
# Turn (s) of an album while others wait for their tenants' first.
_TURN_S = 5.0
# Solutions of albums that cannot succeed until something changes.
_FINAL = (errors.PlanFailedError, errors.VenueUnsearchableError, InvalidInputError)
# Errors that pass.
_PASSING = (
    errors.PlanNotReadyError,
    errors.VenueNotReadyError,
    errors.StoreUnavailableError,
    errors.OverloadedError,
    errors.DeadlineExceededError,
    errors.StoppingError,
    errors.UnknownFloorPlanError,
    errors.UnknownVenueError,
)
# The service itself, in the place of a tenant.
_SERVICE = ""


class AlbumSolver:
    """Solver of the albums of all tenants, which take turns if they are more than are solved at a time.

    `reads` are threads for the database, whose calls can read and write the features of an album.
    """

    def __init__(
        self,
        store: Store,
        plans: PlanLookup,
        localiser: Localiser,
        reads: BoundedReads,
        settings: Settings,
        telemetry: Telemetry,
    ) -> None:
        self._store, self._plans, self._localiser = store, plans, localiser
        self._reads, self._settings, self._telemetry = reads, settings, telemetry
        self._owner = uuid.uuid4().hex
        self._changed = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._running: dict[str, asyncio.Task[None]] = {}
        self._corrected: dict[str, asyncio.Event] = {}
        # Begin and progress of each tenant's turn that is not over, and tenants that had one in this round.
        self._turns: dict[str, tuple[float, AlbumProgress]] = {}
        self._served: set[str] = set()

    def wake(self, corrected: str | None = None) -> None:
        """Look for albums to solve now, from any thread; those that other replicas changed are found at intervals.

        `corrected` is the tenant of an album with a new correction.
        """
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._changed.set)
            if corrected is not None and (running := self._corrected.get(corrected)) is not None:
                self._loop.call_soon_threadsafe(running.set)

    async def run(self) -> None:
        """Solve albums until the task is cancelled."""
        self._loop = asyncio.get_running_loop()
        try:
            while True:
                try:
                    with suppress(errors.StoreUnavailableError):
                        await self._begin_due()
                except Exception:
                    # The next look may succeed, and nobody sees the end of this task.
                    logging.getLogger(LOGGER_NAME).exception("looking for albums to solve failed")
                with suppress(TimeoutError):
                    async with asyncio.timeout(self._settings.grids.sweep_s):
                        await self._changed.wait()
                self._changed.clear()
        finally:
            self._loop = None
            for task in self._running.values():
                task.cancel()
            await asyncio.gather(*self._running.values(), return_exceptions=True)

    async def _begin_due(self) -> None:
        """Start a task for each album that is due, of tenants without one; if there is no room, end a turn for them."""
        room, find = AT_A_TIME - len(self._running), self._store.album_jobs.due
        sha256, begun = self._localiser.model.sha256, list(self._running)
        due = await self._reads.run(_SERVICE, find, sha256, begun, max(room, 1), list(self._served))
        if not due:
            # Nobody waits, so the round is over.
            self._served.clear()
        elif room <= 0:
            self._end_turn()
        for tenant, album_id in due[:room]:
            if tenant in self._served:
                # All that wait had a turn.
                self._served.clear()
            self._served.add(tenant)
            task = self._running[tenant] = asyncio.create_task(self._solve(tenant, album_id))
            task.add_done_callback(lambda _, tenant=tenant: self._end(tenant))

    def _end_turn(self) -> None:
        """Stop the solve whose turn is over for longest, if any; it goes on with what it found at its next turn.

        Each turn compares a photograph at least, and the assignment of all to rooms is not interrupted.
        """
        latest = monotonic() - _TURN_S
        over = ((begin, tenant) for tenant, (begin, solve) in self._turns.items() if 0.0 < solve.share < 1.0)
        if (first := min(over, default=None)) is not None and first[0] <= latest:
            self._turns.pop(first[1])[1].stopped = True

    def _end(self, tenant: str) -> None:
        for known in (self._running, self._corrected, self._turns):
            known.pop(tenant, None)
        self._changed.set()

    async def _solve(self, tenant: str, album_id: str) -> None:
        """Solve an album, if its lease is free, and rest."""
        begin, corrected = monotonic(), asyncio.Event()
        self._corrected[tenant] = corrected
        try:
            claim, lease_s = self._store.album_jobs.claim, self._settings.grids.grid_lease_s
            job = await self._reads.run(tenant, claim, album_id, self._owner, lease_s)
            if job is not None:
                await self._attempt(job)
                if tenant not in self._turns:
                    # Others wait.
                    return
        except errors.StoreUnavailableError:
            await asyncio.sleep(_RETRY_S)
        except Exception:
            logging.getLogger(LOGGER_NAME).exception("solving an album failed", extra={"fields": {"album": album_id}})
            await asyncio.sleep(_RETRY_S)
        rest_s = min(monotonic() - begin, _MAX_REST_S)
        await asyncio.sleep(min(rest_s, _MAX_REST_BEFORE_CORRECTION_S))
        with suppress(TimeoutError):
            async with asyncio.timeout(rest_s - _MAX_REST_BEFORE_CORRECTION_S):
                await corrected.wait()

    async def _attempt(self, job: AlbumJob) -> None:
        """Solve a claimed album; its lease ends in any case, at the latest by itself."""
        progress = AlbumProgress()
        self._turns[job.album.tenant] = monotonic(), progress
        heartbeat = asyncio.create_task(self._renew(job, progress))
        finished = failed = False
        try:
            with self._telemetry.album_seconds.time():
                await self._pin(job, progress)
            finished = True
        except _PASSING as error:
            fields = {"album": job.album.id, "reason": str(error)}
            logging.getLogger(LOGGER_NAME).info("album waits", extra={"fields": fields})
            raise errors.StoreUnavailableError from error
        except Exception:
            # A solve that was stopped, as its album was deleted or another replica has it, did not fail.
            if progress.stopped:
                return
            failed = True
            raise
        finally:
            progress.stopped = True
            heartbeat.cancel()
            if not finished:
                # In a task of its own, so that the end of the service does not interrupt it.
                await asyncio.shield(asyncio.ensure_future(self._release(job, failed=failed)))

    async def _pin(self, job: AlbumJob, progress: AlbumProgress) -> None:
        album = job.album
        document = AlbumDocument.model_validate_json(album.options)
        place = await self._plans.place(album.tenant, document.floorplan_id, document.venue_id, self._reads)
        if job.attempts > _MAX_ATTEMPTS:
            reason = f"it was begun {_MAX_ATTEMPTS} times and never finished"
            await self._finish(job, place.revision_id, failure=reason)
            return
        context = QueryContext.starting(album.tenant, self._settings.requests.request_deadline_s)
        query = AlbumQuery(
            album_id=album.id,
            document=document,
            photographs=job.photographs,
            is_same_place=album.place_revision_id == place.revision_id,
            context=context,
            progress=progress,
        )
        try:
            outcome = await self._localiser.answer(place, query)
        except _FINAL as error:
            reason = error.reason if isinstance(error, errors.PlanFailedError) else str(error)
            await self._finish(job, place.revision_id, failure=reason)
            return
        await self._finish(job, place.revision_id, pins=outcome.pins, solution=outcome.solution)

    async def _finish(self, job: AlbumJob, place_revision_id: str, **result: Any) -> None:
        values: dict[str, Any] = {"pins": {}, "solution": None} | result
        finish = self._store.album_jobs.finish
        await self._reads.run(job.album.tenant, finish, job, self._owner, place_revision_id, **values)

    async def _renew(self, job: AlbumJob, progress: AlbumProgress) -> None:
        """Renew the lease until the task is cancelled; stop the solve if it is lost."""
        lease_s = self._settings.grids.grid_lease_s
        renew, album = self._store.album_jobs.renew, job.album
        while not progress.stopped:
            await asyncio.sleep(lease_s / _HEARTBEATS)
            try:
                # During an outage no other replica can take the lease either.
                with suppress(errors.StoreUnavailableError):
                    share = min(max(progress.share, 0.0), 1.0)
                    # The thread that solves goes on adding to it.
                    found = dict(progress.found.popitem() for _ in range(len(progress.found)))
                    if not await self._reads.run(album.tenant, renew, album.id, self._owner, lease_s, share, found):
                        progress.stopped = True
            except Exception:
                # The next renewal may succeed, and nobody sees the end of this task.
                fields = {"album": album.id}
                logging.getLogger(LOGGER_NAME).exception("renewing a lease failed", extra={"fields": fields})

    async def _release(self, job: AlbumJob, *, failed: bool) -> None:
        release = self._store.album_jobs.release
        with suppress(errors.StoreUnavailableError):
            await self._reads.run(job.album.tenant, release, job.album.id, self._owner, failed=failed)
