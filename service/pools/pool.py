"""Interface of a pool: jobs go in, results or a `JobLostError` come out."""

from __future__ import annotations

import asyncio
import hashlib
import pickle
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from time import monotonic
from typing import Any, Generic, TypeVar

from service.capacity.cpu_accounts import CpuAccounts
from service.capacity.fair_share import FairSemaphore, Shares
from service.pools.job_queue import JobLostError, JobQueue, PendingJob
from service.pools.supervisor import Supervisor, WorkerSpec

# Several, so that no client waits while large jobs of others are copied.
_SUBMITTING_THREADS = 8

Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class PoolState:
    """Number of workers, how many are warm, whether each has been warm once, and the error of the last failed start."""

    workers: int
    ready: int
    warmed_up: bool
    fault: str | None


class _Parts:
    """File of a pickled job. Its uploaded file stays one part, as copying it would hold the interpreter's lock."""

    def __init__(self) -> None:
        self.parts: list[bytes | memoryview] = []
        self.digest = hashlib.sha256()

    def write(self, part: bytes | pickle.PickleBuffer) -> None:
        # Large arrays come as buffers of their shape, and pipes count bytes.
        content = part.raw() if isinstance(part, pickle.PickleBuffer) else part
        if content:
            self.parts.append(content)
            self.digest.update(content)


class WorkerPool(Generic[Job, Result]):
    """Bounded queue in front of supervised workers, which the first job starts; safe to use from any thread.

    Args:
        spec: program of the workers.
        workers: number of workers.
        queue_limit: maximum number of waiting jobs, besides the running ones.
        keep_spare: keep one worker free of clients that already have jobs running; for jobs that take seconds.
        accounts: CPU time of the clients; jobs are charged to theirs.
        cores: cores to compute on, of which a job of `run_job` holds one; None: jobs need none.
        on_restart: called with the reason whenever a worker is replaced.
    """

    def __init__(
        self,
        spec: WorkerSpec,
        *,
        workers: int,
        queue_limit: int,
        keep_spare: bool = False,
        accounts: CpuAccounts | None = None,
        cores: FairSemaphore | None = None,
        on_restart: Callable[[str], None] = lambda _reason: None,
    ) -> None:
        self._queue = JobQueue(
            queue_limit, self._served_by, accounts or CpuAccounts(), Shares(workers) if keep_spare else None
        )
        self._cores = cores
        self._supervisors = [Supervisor(spec, index, self._queue, on_restart) for index in range(workers)]
        self._submitting = ThreadPoolExecutor(_SUBMITTING_THREADS, thread_name_prefix=f"{spec.name}-submit")
        self._begun, self._lock = False, threading.Lock()

    def start(self) -> None:
        """Start all workers, if that was not done, and return at once; `state` tells when they are warm."""
        with self._lock:
            if self._begun or self._queue.closed:
                return
            self._begun = True
            for supervisor in self._supervisors:
                supervisor.start()

    @property
    def state(self) -> PoolState:
        """Numbers of workers, all and warm."""
        faults = [supervisor.fault for supervisor in self._supervisors if supervisor.fault is not None]
        return PoolState(
            workers=len(self._supervisors),
            ready=sum(supervisor.ready for supervisor in self._supervisors),
            warmed_up=all(supervisor.warmed_up for supervisor in self._supervisors),
            fault=faults[0] if faults else None,
        )

    @property
    def waiting(self) -> int:
        """Number of jobs that wait for a worker."""
        return len(self._queue)

    @property
    def resident_bytes(self) -> int:
        """Memory of all workers."""
        return sum(supervisor.resident_bytes for supervisor in self._supervisors)

    def submit(
        self, job: Job, timeout_s: float, client: str = "", on_news: Callable[[Any], None] = lambda _value: None
    ) -> Future[Result]:
        """Queue a job of a client. Cancelling the future removes a waiting job; a running job is finished.

        `on_news` is called with what the worker tells meanwhile, see `PendingJob`.

        The future has the result, the error of the job, or a `JobLostError`, and can be done later than the deadline. A
        job that cannot be run in time raises that error.
        """
        self.start()
        content = _Parts()
        pickle.Pickler(content, protocol=pickle.HIGHEST_PROTOCOL).dump(job)
        pending = PendingJob(content.parts, content.digest.digest(), monotonic() + timeout_s, client, on_news)
        self._queue.put(pending)
        return pending.future

    async def run_job(self, job: Job, timeout_s: float, client: str = "") -> Result:
        """Run a client's job and return its result or raise `JobLostError`; one that nobody awaits is not started."""
        deadline = monotonic() + timeout_s
        try:
            async with asyncio.timeout(timeout_s), self._cores.held(client) if self._cores else nullcontext():
                return await self._run(job, deadline, client)
        except TimeoutError:
            raise JobLostError("deadline") from None

    async def _run(self, job: Job, deadline: float, client: str) -> Result:
        if self._queue.closed:
            raise JobLostError("closing")
        # On a thread, because copying and hashing a large job would block the event loop.
        submitted = self._submitting.submit(self.submit, job, deadline - monotonic(), client)
        try:
            return await asyncio.wrap_future(await asyncio.wrap_future(submitted))
        except asyncio.CancelledError:
            submitted.add_done_callback(_take_back)
            raise

    def close(self, drain_s: float = 0.0) -> None:
        """End all workers and wait for them: running jobs have `drain_s` (s) to finish, waiting jobs are lost."""
        self._queue.close()
        deadline = monotonic() + drain_s
        with self._lock:
            begun = self._supervisors if self._begun else []
        for supervisor in begun:
            supervisor.stop(deadline)
        self._submitting.shutdown()

    def _served_by(self, deadline: float) -> bool:
        return any(supervisor.expected_ready <= deadline for supervisor in self._supervisors)


def _take_back(submitted: Future[Future[Any]]) -> None:
    """Cancel a job whose caller left during or after its submission."""
    if not submitted.cancelled() and submitted.exception() is None:
        submitted.result().cancel()
