"""Jobs of computing grids, by one thread of this replica or by another replica, whichever holds the lease.

A job waits in the queue, is computed here under a lease, or is *remote*: another replica holds the lease, and its
progress is polled. When its lease expires, the job returns to the queue. Small grids go first, even in the middle of a
large one.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field

from lalaloc_core.localise.match import PoseGrid
from service.errors import OverloadedError, StoppingError
from service.storage.records import GridKey

# Limits of the queue. Callers get an error beyond them, and `GridProvider.queue_missing` finds missing grids later.
MAX_JOBS = 256
MAX_ON_DEMAND = 16
# Maximum number of poses of a small grid, which does not wait behind larger ones.
_SMALL_POSES = 2000


@dataclass(eq=False)
class GridJob:
    """Grid to be computed.

    Attributes:
        poses: estimated number of poses.
        on_demand: a query needs the grid, for a camera height other than the plan's own.
        cancelled: event that ends the work.
        progress: share that is done, 0 to 1, here or in another replica.
        remote: another replica computes the grid.
    """

    key: GridKey
    plan_id: str
    poses: int
    on_demand: bool
    future: Future[PoseGrid] = field(default_factory=Future)
    cancelled: threading.Event = field(default_factory=threading.Event)
    progress: float = 0.0
    remote: bool = False


class GridJobs:
    """Jobs of this replica, and the thread that works on them."""

    def __init__(self, work: Callable[[GridJob], None]) -> None:
        # Computes a job and ends it with `end`, or leaves it `remote`; must not raise.
        self._work = work
        self._changed = threading.Condition()
        self._jobs: dict[GridKey, GridJob] = {}
        self._queued: list[GridJob] = []
        self.closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="grids", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return len(self._jobs)

    def get(self, key: GridKey) -> GridJob | None:
        """Return the job for a grid."""
        return self._jobs.get(key)

    def add(self, key: GridKey, *, plan_id: str, poses: int, on_demand: bool) -> GridJob:
        """Return the job for a grid, a new one if there is none."""
        with self._changed:
            job = self._jobs.get(key)
            if job is not None:
                return job
            if self.closing.is_set():
                raise StoppingError()
            if on_demand and sum(pending.on_demand for pending in self._jobs.values()) >= MAX_ON_DEMAND:
                raise OverloadedError(MAX_ON_DEMAND)
            if len(self._jobs) >= MAX_JOBS:
                raise OverloadedError(MAX_JOBS)
            job = GridJob(key, plan_id, poses, on_demand)
            # Marked as running, so that no caller can cancel the future for the others.
            job.future.set_running_or_notify_cancel()
            self._jobs[key] = job
            self._queued.append(job)
            self._changed.notify()
            return job

    def end(self, job: GridJob, outcome: PoseGrid | Exception) -> None:
        """Remove a job, then set its result, so that waiting queries find the plan in its final state."""
        with self._changed:
            self._jobs.pop(job.key, None)
        if isinstance(outcome, Exception):
            job.future.set_exception(outcome)
        else:
            job.future.set_result(outcome)

    def remote(self) -> list[GridJob]:
        """Return the jobs whose lease another replica holds."""
        with self._changed:
            return [job for job in self._jobs.values() if job.remote]

    def requeue(self, job: GridJob) -> None:
        """Queue a remote job whose lease expired."""
        with self._changed:
            job.remote = False
            self._queued.append(job)
            self._changed.notify()

    def revisions(self) -> set[str]:
        """Return the revisions with jobs."""
        with self._changed:
            return {key.revision_id for key in self._jobs}

    def cancel(self, revision_id: str) -> None:
        """Cancel the jobs of a deleted revision."""
        with self._changed:
            for job in self._jobs.values():
                if job.key.revision_id == revision_id:
                    job.cancelled.set()

    def preempt(self, large: GridJob) -> None:
        """Compute one of the small grids that wait, between two chunks of a large one."""
        if large.poses > _SMALL_POSES and (job := self._next(_SMALL_POSES)) is not None:
            self._work(job)

    def close(self) -> None:
        """Stop the work; jobs that still wait fail with `StoppingError`."""
        with self._changed:
            self.closing.set()
            self._queued.clear()
            for job in self._jobs.values():
                job.cancelled.set()
            self._changed.notify()
        self._thread.join()
        for job in list(self._jobs.values()):
            self.end(job, StoppingError())

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queued or self.closing.is_set())
            if self.closing.is_set():
                return
            if (job := self._next()) is not None:
                self._work(job)

    def _next(self, max_poses: int | None = None) -> GridJob | None:
        """Take the smallest job from the queue."""
        with self._changed:
            job = min(self._queued, key=lambda job: job.poses, default=None)
            if job is None or (max_poses is not None and job.poses > max_poses):
                return None
            self._queued.remove(job)
            return job
