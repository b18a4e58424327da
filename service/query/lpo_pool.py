"""Pool of LPO worker processes, so that the service itself never imports torch."""

from __future__ import annotations

from typing import get_args

from lalaloc_core.bundle import Bundle
from lalaloc_core.localise.refine import RefinementJob, RefinementResult
from service.capacity.fair_share import FairSemaphore
from service.pools import JobLostError, LostReason, PoolState, WorkerPool, WorkerSpec
from service.settings import Settings
from service.telemetry import Telemetry
from service.workers.lpo import run_worker


class LpoPool:
    """Bounded pool of LPO workers; a failed job returns None, and the answer is then not refined.

    Workers load no torch unless poses are refined `by_latents`.
    """

    def __init__(
        self, bundle: Bundle, settings: Settings, telemetry: Telemetry, cores: FairSemaphore, by_latents: bool = True
    ) -> None:
        self._telemetry = telemetry
        arguments = (str(bundle.folder.resolve()), bundle.sha256, settings.compute.worker_threads, by_latents)
        self._workers: WorkerPool[RefinementJob, RefinementResult] = WorkerPool(
            WorkerSpec("lpo", run_worker, arguments, stall_s=settings.lpo.stall_s),
            workers=settings.cores.workers,
            queue_limit=settings.lpo.queue,
            accounts=telemetry.cpu_accounts,
            cores=cores,
            on_restart=lambda _reason: telemetry.pool_restarts.labels("lpo").inc(),
        )
        # Counters exist with value 0 from the start, so that the first miss shows as a rise.
        for reason in get_args(LostReason):
            telemetry.lpo_missed.labels(reason)
        telemetry.gauge("lalaloc_lpo_queue_depth", "LPO jobs waiting for a worker.", lambda: self._workers.waiting)
        telemetry.gauge("lalaloc_lpo_workers_ready", "LPO workers that are ready.", lambda: self.state.ready)
        telemetry.gauge(
            "lalaloc_lpo_workers_resident_bytes", "Memory of all LPO workers.", lambda: self._workers.resident_bytes
        )

    def start(self) -> None:
        """Start all workers and return at once; `state` tells when they are warm."""
        self._workers.start()

    @property
    def state(self) -> PoolState:
        """Numbers of workers, all and warm."""
        return self._workers.state

    async def refine(self, job: RefinementJob, timeout_s: float, client: str = "") -> RefinementResult | None:
        """Return the result of a job, or None if it failed or took longer than `timeout_s`.

        Cancelling removes a job that has not started from the queue. Clients take turns.
        """
        if self.state.workers == 0 or timeout_s <= 0.0:
            return None
        try:
            return await self._workers.run_job(job, timeout_s, client)
        except JobLostError as error:
            self._telemetry.lpo_missed.labels(error.reason).inc()
            return None

    def close(self, drain_s: float = 0.0) -> None:
        """End all workers: running jobs have `drain_s` (s) to finish, waiting jobs return None."""
        self._workers.close(drain_s)
