"""Computation and storage of queued grids, each under its lease."""

from __future__ import annotations

import logging
import uuid
from collections.abc import Callable, Collection
from functools import partial
from time import monotonic

from lalaloc_core.errors import LaLaLocError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import PoseGrid
from service import errors
from service.bounded_cache import BoundedCache
from service.capacity.fair_share import FairSemaphore
from service.grids.embedding import check_size, embed, grid_bytes
from service.grids.grid_jobs import GridJob, GridJobs
from service.settings import Settings
from service.storage import Store
from service.storage.grid_format import SortedPrototypes
from service.storage.records import GridKey, millimetres
from service.telemetry import LOGGER_NAME, Telemetry


class GridCache(BoundedCache[GridKey, PoseGrid]):
    """Cache of computed pose grids; safe to share between threads."""

    def __init__(self, store: Store, limit_bytes: int, telemetry: Telemetry) -> None:
        super().__init__(limit_bytes, grid_bytes)
        self._store, self._telemetry = store, telemetry

    def cached(self, key: GridKey) -> PoseGrid | None:
        """Return a grid from memory."""
        grid = self.get(key)
        if grid is not None:
            self._telemetry.grid_cache_hits.inc()
        return grid

    def find(self, key: GridKey) -> PoseGrid | None:
        """Return a grid from memory or from the store."""
        if (grid := self.cached(key)) is not None:
            return grid
        self._telemetry.grid_cache_misses.inc()
        return self.load(key)

    def find_all(self, keys: Collection[GridKey]) -> dict[GridKey, PoseGrid]:
        """Return the grids of a model that are in memory or in the store, as `find` does; one read for all others."""
        found = {key: grid for key in keys if (grid := self.cached(key)) is not None}
        missing = [key for key in keys if key not in found]
        self._telemetry.grid_cache_misses.inc(len(missing))
        loaded = self._store.grids.get_all(missing) if missing else {}
        for key, grid in loaded.items():
            self.put(key, grid)
        return found | loaded

    def load(self, key: GridKey) -> PoseGrid | None:
        """Return a grid as `find` does, without metrics."""
        return self.get_or_make(key, lambda: self._store.grids.get(key))

    def put(self, key: GridKey, value: PoseGrid) -> int:
        """Keep a grid; see `BoundedCache.put`."""
        evicted = super().put(key, value)
        self._telemetry.grid_cache_evictions.inc(evicted)
        return evicted


# Duration and interval (s) of retries to store a finished grid.
_KEEP_TRYING_S, _TRY_EVERY_S = 60.0, 1.0
# Not failures of the plan.
_ABANDONED = (
    errors.UnknownFloorPlanError,
    errors.PlanNotReadyError,
    errors.StoppingError,
    errors.StoreUnavailableError,
)
# Renewals, with the progress, per length of a lease.
_HEARTBEATS = 8.0
# Maximum number of unfinished attempts, by any replicas, before a grid counts as failed.
_MAX_ATTEMPTS = 5
# Stored pose grids (camera heights) per plan.
_MAX_GRIDS_PER_PLAN = 8


class _LeaseLostError(Exception):
    """Another replica took over the lease, or the plan was deleted."""


class _LeaseHeartbeat:
    """Periodic renewal of the lease of a job.

    Attributes:
        lost: the lease belongs to another replica, or its plan was deleted.
    """

    def __init__(self, renew: Callable[[], bool], every_s: float) -> None:
        self._renew, self._every_s = renew, every_s
        self._beat_at, self.lost = monotonic(), False

    def beat(self) -> None:
        if not self.lost and monotonic() >= self._beat_at:
            self.lost = not self._renew()
            self._beat_at = monotonic() + self._every_s


class GridBuilder:
    """Thread that computes and stores grids.

    Attributes:
        jobs: jobs of the thread.
    """

    def __init__(
        self,
        store: Store,
        encoders: PhotographEncoder,
        cache: GridCache,
        cores: FairSemaphore,
        settings: Settings,
        telemetry: Telemetry,
    ) -> None:
        self._store, self._encoders, self._cache = store, encoders, cache
        self._cores, self._settings, self._telemetry = cores, settings, telemetry
        self._owner = uuid.uuid4().hex
        # Leases of the running jobs, all on the one thread of `GridJobs`.
        self._heartbeats: list[_LeaseHeartbeat] = []
        self.jobs = GridJobs(self._work)

    def _work(self, job: GridJob) -> None:
        """Run a job; every outcome is set on its future, unless another replica holds the lease."""
        try:
            outcome = self._cache.load(job.key) or self._compute(job)
        except _LeaseLostError:
            job.remote = True
            return
        except Exception as error:
            outcome = error
            self._note_failure(job, error)
        self.jobs.end(job, outcome)

    def _compute(self, job: GridJob) -> PoseGrid:
        if job.cancelled.is_set():
            raise self._why_cancelled(job)
        record = self._store.plans.get_by_revision(job.key.revision_id)
        if record is None:
            raise errors.UnknownFloorPlanError(job.plan_id)
        check_size(record.plan, self._settings)
        attempts = self._store.leases.claim(job.key, self._owner, self._settings.grids.grid_lease_s)
        if attempts is None:
            raise _LeaseLostError
        # The previous owner of the lease can have finished the grid.
        grid = self._cache.load(job.key)
        if grid is not None:
            self._store.leases.release(job.key, self._owner)
            return grid
        if attempts > _MAX_ATTEMPTS:
            reason = f"its pose grid was begun {_MAX_ATTEMPTS} times and never finished"
            raise errors.PlanFailedError(job.plan_id, reason)
        # Small grids that interrupt this one are charged to the same client.
        with self._telemetry.cpu_accounts.charged(record.tenant):
            with self._telemetry.grid_seconds.time():
                grid = self._embed(job, record.plan, record.tenant)
            with self._cores.hold(record.tenant):
                prototypes = SortedPrototypes.of_grid(grid, record.plan)
        try:
            if not self._put(job, grid, prototypes, always_keep_mm=millimetres(record.plan.camera_height_m)):
                raise errors.UnknownFloorPlanError(job.plan_id)
        except errors.StorageQuotaError:
            if not job.on_demand:
                raise
            # Queries can use the grid without its being stored.
            self._store.leases.release(job.key, self._owner)
        self._cache.put(job.key, grid)
        return grid

    def _embed(self, job: GridJob, plan: FloorPlan, client: str) -> PoseGrid:
        heartbeat = _LeaseHeartbeat(lambda: self._renew(job), self._settings.grids.grid_lease_s / _HEARTBEATS)

        def check() -> None:
            # All of them: during a small grid, the lease of the large one that it interrupts must be renewed, too.
            for running in self._heartbeats:
                running.beat()
            if heartbeat.lost:
                # Leases are deleted with their plan; in that case the job fails when it is polled.
                raise _LeaseLostError
            if job.cancelled.is_set():
                raise self._why_cancelled(job)

        def after_chunk(progress: float) -> None:
            job.progress = progress
            if progress < 1.0:
                self.jobs.preempt(job)
            check()

        height_m = job.key.camera_height_m
        self._heartbeats.append(heartbeat)
        try:
            return embed(
                plan,
                self._encoders,
                step_m=job.key.step_m,
                camera_height_m=height_m,
                computing=partial(self._cores.hold, client),
                after_room=check,
                after_chunk=after_chunk,
            )
        finally:
            self._heartbeats.pop()

    def _why_cancelled(self, job: GridJob) -> Exception:
        if self.jobs.closing.is_set():
            return errors.StoppingError()
        if not self._store.plans.has_revision(job.key.revision_id):
            return errors.UnknownFloorPlanError(job.plan_id)
        # The plan has a new revision, which the next query finds.
        return errors.PlanNotReadyError(job.plan_id, 0.0, 0.0)

    def _renew(self, job: GridJob) -> bool:
        try:
            return self._store.leases.renew(job.key, self._owner, self._settings.grids.grid_lease_s, job.progress)
        except errors.StoreUnavailableError:
            # No other replica can take the lease during the outage either.
            return True

    def _put(self, job: GridJob, grid: PoseGrid, prototypes: SortedPrototypes, *, always_keep_mm: int) -> bool:
        """Store a grid; retry during an outage of the database, because the computation can have taken minutes."""
        give_up_at = monotonic() + _KEEP_TRYING_S
        while True:
            try:
                return self._store.grids.put(
                    job.key, grid, keep=_MAX_GRIDS_PER_PLAN, always_keep_mm=always_keep_mm, prototypes=prototypes
                )
            except errors.StoreUnavailableError:
                if monotonic() > give_up_at or job.cancelled.wait(_TRY_EVERY_S):
                    raise

    def _note_failure(self, job: GridJob, error: Exception) -> None:
        logger = logging.getLogger(LOGGER_NAME)
        if isinstance(error, _ABANDONED):
            logger.info("pose grid abandoned", extra={"fields": {"floorplan": job.plan_id, "reason": str(error)}})
        else:
            logger.error("pose grid failed", exc_info=error, extra={"fields": {"floorplan": job.plan_id}})
        try:
            if not job.on_demand and not isinstance(error, _ABANDONED):
                self._store.plans.set_failure(job.key.revision_id, _reason(error))
            self._store.leases.release(job.key, self._owner)
        except Exception:
            # The lease expires, and the replica that takes it over will fail in the same way.
            logger.exception("cannot record the failure", extra={"fields": {"floorplan": job.plan_id}})


def _reason(error: Exception) -> str:
    """Return the error of a failed grid as a text for users; unexpected errors are not disclosed."""
    if isinstance(error, errors.PlanFailedError):
        return error.reason
    return str(error) if isinstance(error, LaLaLocError) else "internal error"
