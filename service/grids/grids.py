"""Finds latent grids, or has them computed; safe to share between threads."""

from __future__ import annotations

import logging
import threading
import uuid
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from time import monotonic
from typing import Self

from lalaloc_core.errors import LaLaLocError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.poses import LatentGrid
from lalaloc_core.sampling import grid_size
from service.errors import (
    OverloadedError,
    PlanFailedError,
    PlanNotReadyError,
    PlanTooLargeError,
    StoppingError,
    StoreUnavailableError,
    UnknownFloorPlanError,
)
from service.grids.embedding import embed, grid_bytes
from service.grids.jobs import Job, Jobs
from service.grids.throttle import BackgroundThrottle
from service.lru import BoundedCache
from service.schemas import PlanStatus
from service.settings import Settings
from service.storage import Store
from service.storage.records import ComputedGrid, GridKey, PlanRecord, PlanSummary, millimetres
from service.telemetry import LOGGER_NAME, Telemetry

# Plans whose missing grids are queued at a time, so that replicas share a backlog.
_BATCH = 16
# Uploads compute small grids in turns; one that would wait for longer leaves its grid to the background.
_INLINE_WAIT_S = 1.0
# How long a finished grid is kept at hand while the database is away.
_KEEP_TRYING_S, _TRY_EVERY_S = 60.0, 1.0
# Not failures of the plan.
_ABANDONED = (UnknownFloorPlanError, PlanNotReadyError, StoppingError, StoreUnavailableError)
# Progress is told, and the lease renewed, so many times while it lasts.
_HEARTBEATS = 8.0
# So many replicas, or lives of one, may begin a grid without any of them finishing it.
_MOST_ATTEMPTS = 5


@dataclass(frozen=True)
class GridState:
    """How far a plan's own latent grid is; `poses` is None until it is computed."""

    status: PlanStatus
    progress: float
    poses: int | None
    reason: str | None = None

    @classmethod
    def after_upload(cls, prepared: ComputedGrid | None) -> Self:
        """That of a plan that was stored just now, with its grid or without."""
        return cls("preparing", 0.0, None) if prepared is None else cls("ready", 1.0, len(prepared.grid.poses))


class _LeaseLostError(Exception):
    """Another replica took the work over, or the plan is gone."""


class _LeaseHeartbeat:
    """Renews the lease of a job now and then.

    Attributes:
        lost: whether the lease is another's.
    """

    def __init__(self, renew: Callable[[], bool], every_s: float) -> None:
        self._renew = renew
        self._every_s = every_s
        self._beat_at = monotonic()
        self.lost = False

    def beat(self) -> None:
        """Renew the lease if it is time."""
        if not self.lost and monotonic() >= self._beat_at:
            self.lost = not self._renew()
            self._beat_at = monotonic() + self._every_s


class Grids:
    """The latent grids of one model at one grid step.

    Attributes:
        queries: queries say here when they compute, and grids make way for them.
    """

    def __init__(
        self,
        store: Store,
        encoders: Encoders,
        model_sha256: str,
        settings: Settings,
        telemetry: Telemetry,
    ) -> None:
        self._store = store
        self._encoders = encoders
        self._model_sha256 = model_sha256
        self._settings = settings
        self._telemetry = telemetry
        self.throttle = BackgroundThrottle()
        self._owner = uuid.uuid4().hex
        self._cache: BoundedCache[GridKey, LatentGrid] = BoundedCache(settings.grid_cache_bytes, grid_bytes)
        self._loading = threading.Lock()
        self._inline = threading.Lock()
        # Of the jobs that are being computed, all by the one thread of `Jobs`.
        self._heartbeats: list[_LeaseHeartbeat] = []
        self._jobs = Jobs(self._work)
        self._unprepared = 0
        telemetry.gauge("lalaloc_grids_pending", "Latent grids computed or waiting for it here.", lambda: self.pending)
        telemetry.gauge("lalaloc_grids_preparing", "Plans without a latent grid, wherever.", lambda: self.preparing)
        telemetry.gauge("lalaloc_grid_cache_bytes", "Latent grids in memory.", lambda: self._cache.bytes)

    @property
    def pending(self) -> int:
        """Latent grids being computed or waiting for it here."""
        return len(self._jobs)

    @property
    def preparing(self) -> int:
        """The same here and elsewhere, with plans whose grid nobody has queued yet, as of the last `queue_missing`."""
        return max(self.pending, self._unprepared)

    def key(self, revision_id: str, camera_height_m: float) -> GridKey:
        """The key of a revision's grid for this model and grid step."""
        return GridKey(
            revision_id=revision_id,
            model_sha256=self._model_sha256,
            step_m=self._settings.grid_step_m,
            camera_height_mm=millimetres(camera_height_m),
        )

    def states(self, plans: list[PlanSummary]) -> list[GridState]:
        """How far each plan's own grid is, whoever computes it."""
        keys = [self.key(summary.revision_id, summary.camera_height_m) for summary in plans]
        step_m, revision_ids = self._settings.grid_step_m, [summary.revision_id for summary in plans]
        places = [(key.revision_id, key.camera_height_mm) for key in keys]
        jobs = [self._jobs.get(key) for key in keys]
        stored = self._store.grids.poses(self._model_sha256, step_m, revision_ids)
        leased = {}
        if not all(place in stored for place in places):
            leased = self._store.leases.progress(self._model_sha256, step_m, revision_ids)
            # Leases end as grids are stored, which may have been just now.
            stored = self._store.grids.poses(self._model_sha256, step_m, revision_ids)
        return [
            _state(summary.failure, stored.get(place), leased.get(place), job)
            for summary, place, job in zip(plans, places, jobs, strict=True)
        ]

    def check_size(self, plan: FloorPlan) -> None:
        """Refuse a plan whose grid would be too large.

        Raises:
            PlanTooLargeError: states the estimated number of poses and the limit.
        """
        estimate = self._estimate(plan)
        if estimate > self._settings.max_grid_poses:
            raise PlanTooLargeError(estimate, self._settings.max_grid_poses, self._settings.grid_step_m)

    def prepare(self, plan: FloorPlan) -> ComputedGrid | None:
        """The own grid of a small plan, computed at once; None when that is left to the background."""
        if self._estimate(plan) > self._settings.inline_grid_poses or not self._inline.acquire(timeout=_INLINE_WAIT_S):
            return None
        try:
            with self._telemetry.timed(self._telemetry.grid_seconds):
                grid = embed(
                    plan,
                    self._encoders,
                    step_m=self._settings.grid_step_m,
                    camera_height_m=millimetres(plan.camera_height_m) / 1000.0,
                    after_chunk=lambda _progress, worked_s: self.throttle.pause(worked_s),
                )
            return ComputedGrid(model_sha256=self._model_sha256, grid=grid)
        except Exception:
            # The background fails at it as well, and records it with the plan.
            logging.getLogger(LOGGER_NAME).exception("latent grid failed")
            return None
        finally:
            self._inline.release()

    def on_plan_stored(self, record: PlanRecord, prepared: ComputedGrid | None) -> None:
        """After a plan was stored: keep the grid that was stored with it at hand, or have it computed."""
        if prepared is not None:
            self._remember(prepared.key(record.revision_id), prepared.grid)
            return
        # What cannot be queued now is queued later, here or by another replica.
        with suppress(StoppingError, OverloadedError):
            self.compute(record, record.plan.camera_height_m)

    def find(self, key: GridKey) -> LatentGrid | None:
        """A grid that has been computed before, from memory or from the store.

        Raises:
            StoreUnavailableError: it is not in memory, and the database is away.
        """
        grid = self.cached(key)
        if grid is not None:
            return grid
        self._telemetry.grid_cache_misses.inc()
        return self._load(key)

    def cached(self, key: GridKey) -> LatentGrid | None:
        """A grid that is in memory."""
        grid = self._cache.get(key)
        if grid is not None:
            self._telemetry.grid_cache_hits.inc()
        return grid

    def compute(self, record: PlanRecord, camera_height_m: float) -> Future[LatentGrid]:
        """Compute a grid in the background; asking again while that runs gives the same future.

        The future raises UnknownFloorPlanError when the plan is deleted meanwhile, PlanNotReadyError when it gets a
        new revision, StoppingError when the service stops, StoreUnavailableError when the database goes away;
        cancelling it has no effect, others may be waiting for it too.

        Raises:
            OverloadedError: too many grids are waiting already.
            StoppingError: the service stops.
        """
        key = self.key(record.revision_id, camera_height_m)
        on_demand = key.camera_height_mm != millimetres(record.plan.camera_height_m)
        return self._jobs.add(key, plan_id=record.id, poses=self._estimate(record.plan), on_demand=on_demand).future

    def progress(self, key: GridKey) -> float:
        """Share of a grid that is computed, 0 to 1; 0 also for one that nobody computes."""
        job = self._jobs.get(key)
        return job.progress if job else 0.0

    def forget(self, revision_ids: set[str]) -> None:
        """Drop the grids of revisions that are gone from memory, and stop computing them."""
        self._cache.drop(lambda key, _: key.revision_id in revision_ids)
        for revision_id in revision_ids:
            self._jobs.cancel(revision_id)

    def cancel(self, revision_id: str) -> None:
        """Stop computing the grids of a revision that is gone, or no longer its plan's."""
        self._jobs.cancel(revision_id)

    def revisions(self) -> set[str]:
        """The revisions with grids in memory, or with grids that are to be computed."""
        return {key.revision_id for key, _ in self._cache.items()} | self._jobs.revisions()

    def queue_missing(self) -> bool:
        """Queue the oldest grids that nobody computes, unless there is enough to do; tells whether more may be left."""
        if len(self._jobs) >= _BATCH:
            return True
        model = (self._model_sha256, self._settings.grid_step_m)
        missing = self._store.grids.missing(*model, _BATCH)
        self._unprepared = self._store.grids.count_unprepared(*model)
        with suppress(StoppingError, OverloadedError):
            for summary in missing:
                key = self.key(summary.revision_id, summary.camera_height_m)
                poses = summary.room_count + int(summary.area_m2 / key.step_m**2)
                self._jobs.add(key, plan_id=summary.id, poses=poses, on_demand=False)
        return len(missing) == _BATCH

    def poll_remote(self) -> None:
        """Note how far other replicas are, and look after grids that they finished or gave up."""
        jobs = self._jobs.remote()
        if not jobs:
            return
        revision_ids = [job.key.revision_id for job in jobs]
        leased = self._store.leases.progress(self._model_sha256, self._settings.grid_step_m, revision_ids)
        for job in jobs:
            progress = leased.get((job.key.revision_id, job.key.camera_height_mm))
            if progress is None or job.cancelled.is_set():
                self._jobs.requeue(job)
            else:
                job.progress = progress

    def close(self) -> None:
        """Stop computing; what was not finished is left to another replica, or at the next start."""
        self._jobs.close()

    def _estimate(self, plan: FloorPlan) -> int:
        return grid_size(plan, self._settings.grid_step_m)

    def _load(self, key: GridKey) -> LatentGrid | None:
        """A grid from the store; one at a time, so that many queries for one plan read it once."""
        with self._loading:
            grid = self._cache.get(key)
            if grid is None:
                grid = self._store.grids.get(key)
                if grid is not None:
                    self._remember(key, grid)
            return grid

    def _remember(self, key: GridKey, grid: LatentGrid) -> None:
        self._telemetry.grid_cache_evictions.inc(self._cache.put(key, grid))

    def _work(self, job: Job) -> None:
        """See a job through; whatever happens ends up in its future, unless another replica is at it."""
        try:
            outcome = self._load(job.key) or self._compute(job)
        except _LeaseLostError:
            job.remote = True
            return
        except Exception as error:
            outcome = error
            self._note_failure(job, error)
        self._jobs.end(job, outcome)

    def _compute(self, job: Job) -> LatentGrid:
        if job.cancelled.is_set():
            raise self._why_cancelled(job)
        record = self._store.plans.by_revision(job.key.revision_id)
        if record is None:
            raise UnknownFloorPlanError(job.plan_id)
        self.check_size(record.plan)
        attempts = self._store.leases.claim(job.key, self._owner, self._settings.grid_lease_s)
        if attempts is None:
            raise _LeaseLostError
        # Whoever had the lease until now may have finished.
        grid = self._load(job.key)
        if grid is not None:
            self._store.leases.release(job.key, self._owner)
            return grid
        if attempts > _MOST_ATTEMPTS:
            reason = f"its latent grid was begun {_MOST_ATTEMPTS} times and never finished"
            raise PlanFailedError(job.plan_id, reason)
        with self._telemetry.timed(self._telemetry.grid_seconds):
            grid = self._embed(job, record.plan)
        if not self._put(job, grid, always_keep_mm=millimetres(record.plan.camera_height_m)):
            raise UnknownFloorPlanError(job.plan_id)
        self._remember(job.key, grid)
        return grid

    def _embed(self, job: Job, plan: FloorPlan) -> LatentGrid:
        heartbeat = _LeaseHeartbeat(lambda: self._renew(job), self._settings.grid_lease_s / _HEARTBEATS)

        def after_chunk(progress: float, worked_s: float) -> None:
            job.progress = progress
            # A small grid may be computed between two chunks of a large one, whose lease must last meanwhile.
            for other in self._heartbeats:
                other.beat()
            if heartbeat.lost:
                # Leases go with their plans; if this one has, the job fails when it is looked at again.
                raise _LeaseLostError
            if progress < 1.0:
                self._jobs.preempt(job)
                self.throttle.pause(worked_s)
            if job.cancelled.is_set():
                raise self._why_cancelled(job)

        height_m = job.key.camera_height_m
        self._heartbeats.append(heartbeat)
        try:
            return embed(plan, self._encoders, step_m=job.key.step_m, camera_height_m=height_m, after_chunk=after_chunk)
        finally:
            self._heartbeats.pop()

    def _why_cancelled(self, job: Job) -> Exception:
        if self._jobs.closing.is_set():
            return StoppingError()
        if not self._store.plans.is_kept(job.key.revision_id):
            return UnknownFloorPlanError(job.plan_id)
        # The plan has another revision by now, which the next query finds.
        return PlanNotReadyError(job.plan_id, 0.0, 0.0)

    def _renew(self, job: Job) -> bool:
        try:
            return self._store.leases.renew(job.key, self._owner, self._settings.grid_lease_s, job.progress)
        except StoreUnavailableError:
            # Nobody else can take the lease meanwhile either.
            return True

    def _put(self, job: Job, grid: LatentGrid, *, always_keep_mm: int) -> bool:
        """Store a grid; it may have taken minutes, so a database that is away for a moment is waited for."""
        give_up_at = monotonic() + _KEEP_TRYING_S
        while True:
            try:
                keep = self._settings.max_grids_per_plan
                return self._store.grids.put(job.key, grid, keep=keep, always_keep_mm=always_keep_mm)
            except StoreUnavailableError:
                if monotonic() > give_up_at or job.cancelled.wait(_TRY_EVERY_S):
                    raise

    def _note_failure(self, job: Job, error: Exception) -> None:
        logger = logging.getLogger(LOGGER_NAME)
        if isinstance(error, _ABANDONED):
            logger.info("latent grid abandoned", extra={"fields": {"floorplan": job.plan_id, "reason": str(error)}})
        else:
            logger.error("latent grid failed", exc_info=error, extra={"fields": {"floorplan": job.plan_id}})
        try:
            if not job.on_demand and not isinstance(error, _ABANDONED):
                self._store.plans.set_failure(job.key.revision_id, _reason(error))
            self._store.leases.release(job.key, self._owner)
        except Exception:
            # The lease runs out, and whoever takes it over fails in the same way.
            logger.exception("cannot record the failure", extra={"fields": {"floorplan": job.plan_id}})


def _reason(error: Exception) -> str:
    """Why a grid failed, in a text that is fit for users: that of errors which are raised on purpose."""
    if isinstance(error, PlanFailedError):
        return error.reason
    return str(error) if isinstance(error, LaLaLocError) else "internal error"


def _state(failure: str | None, poses: int | None, elsewhere: float | None, job: Job | None) -> GridState:
    if poses is not None:
        return GridState("ready", 1.0, poses)
    if failure is not None and job is None:
        return GridState("failed", 0.0, None, failure)
    return GridState("preparing", max(elsewhere or 0.0, job.progress if job else 0.0), None)
