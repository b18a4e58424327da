"""Bounded queue of jobs, with a memory of the jobs that crashed workers."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from time import monotonic
from typing import Any, Literal

from cachetools import TTLCache

from service.capacity.cpu_accounts import CpuAccounts
from service.capacity.fair_share import FairQueue, Shares

LostReason = Literal[
    "not-ready", "queue-full", "deadline", "poisoned", "stalled", "stopped", "fault", "died", "closing"
]

# Interval (s) in which an idle supervisor checks that its worker is alive.
_IDLE_CHECK_S = 0.2
# A second try, as the first worker can have been killed for another reason.
_TRIES_PER_JOB = 2
_POISON_MEMORY_S, _POISON_MEMORY = 600.0, 256


class JobLostError(Exception):
    """Job without a result.

    Attributes:
        reason: `not-ready`: no worker is warm, nor will be in time. `queue-full`: too many jobs wait already.
            `deadline`: no result in time. `poisoned`: the job crashed workers. `stalled`: the job exceeded its limit of
            CPU time. `stopped`: two workers stood still, or got too little CPU time on a busy machine. `fault`: the job
            raised an error, which is logged. `died`: the worker died, and no time is left for another try. `closing`:
            the pool shuts down.
    """

    def __init__(self, reason: LostReason) -> None:
        self.reason: LostReason = reason
        super().__init__(f"the job has no answer: {reason}")


class PendingJob:
    """Job that waits or runs.

    Attributes:
        content: the pickled job, in parts that are not empty.
        digest: of the content; equal jobs have equal digests.
        on_news: called on the supervisor's thread with what the worker tells while it runs the job; returns at once.
    """

    def __init__(
        self,
        content: Sequence[bytes | memoryview],
        digest: bytes,
        deadline: float,
        client: str = "",
        on_news: Callable[[Any], None] = lambda _value: None,
    ) -> None:
        self.content, self.digest, self.deadline, self.client = content, digest, deadline, client
        self.on_news, self.deaths, self.stops, self.stalled = on_news, 0, 0, False
        self.future: Future[Any] = Future()

    @property
    def wanted(self) -> bool:
        """True if the job has time left and was not cancelled."""
        return monotonic() < self.deadline and not self.future.cancelled()

    def fail(self, reason: LostReason) -> None:
        """End the job without a result."""
        # The caller can cancel at this very moment.
        if self.future.running() or self.future.set_running_or_notify_cancel():
            self.future.set_exception(JobLostError(reason))


class JobQueue:
    """Jobs that wait for a worker, those of the client with the least recent CPU time first. Thread-safe.

    `served_by` tells whether a worker is expected to be warm at a time (`monotonic`); without shares in the `workers`,
    a client can use all of them.

    Attributes:
        accounts: CPU time of the clients.
    """

    def __init__(
        self, limit: int, served_by: Callable[[float], bool], accounts: CpuAccounts, workers: Shares | None = None
    ) -> None:
        self.accounts, self._served_by, self._workers = accounts, served_by, workers
        # Of a client's queries, the one that ends first: in turns, none would be answered in time.
        self._waiting: FairQueue[PendingJob] = FairQueue(accounts, lambda pending: pending.deadline)
        self._room = Shares(limit)
        self._poisoned: TTLCache[bytes, bool] = TTLCache(_POISON_MEMORY, _POISON_MEMORY_S, monotonic)
        self._changed, self._closed = threading.Condition(), False

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def closed(self) -> bool:
        """True if the queue takes no more jobs."""
        return self._closed

    def put(self, pending: PendingJob) -> None:
        """Add a job."""
        with self._changed:
            reason = self._refusal(pending)
            if reason is not None:
                raise JobLostError(reason)
            self._room.take(pending.client)
            self._waiting.append(pending.client, pending)
            self._changed.notify()

    def take(self) -> PendingJob | None:
        """Return the next wanted job, marked as running, or None if there was none for a short while.

        Its client holds a worker until `release`.
        """
        with self._changed:
            pending = self._next()
            if pending is None and not self._closed:
                self._changed.wait(_IDLE_CHECK_S)
                pending = self._next()
        if pending is None:
            return None
        if monotonic() >= pending.deadline:
            pending.fail("deadline")
        elif pending.future.running() or pending.future.set_running_or_notify_cancel():
            return pending
        self.release(pending)
        return None

    def release(self, pending: PendingJob) -> None:
        """Free the worker that had this job, also if the worker died."""
        if self._workers is not None:
            with self._changed:
                self._workers.give_back(pending.client)
                # An idle worker can now take a job that its client's share did not allow before.
                self._changed.notify()

    def give_back(self, pending: PendingJob) -> None:
        """Queue a job again whose worker died, if it has tries and time left; fail it otherwise, and if it stalled."""
        reason: LostReason | None = None
        with self._changed:
            if self._closed:
                # Its worker was killed for that.
                reason = "closing"
            elif pending.stalled:
                # Not retried, because it would take as long again.
                reason = "stalled"
            elif pending.stops >= _TRIES_PER_JOB:
                reason = "stopped"
            elif pending.deaths >= _TRIES_PER_JOB:
                reason = "poisoned"
                self._poisoned[pending.digest] = True
            elif not pending.wanted or not self._served_by(pending.deadline):
                reason = "died"
            else:
                # Exceeds the limit by at most one job per worker, and goes first.
                self._room.take(pending.client)
                self._waiting.append_first(pending.client, pending)
                self._changed.notify()
        if reason is not None:
            pending.fail(reason)

    def rest(self, duration_s: float) -> None:
        """Wait for `duration_s`, or until the queue is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed, duration_s)

    def close(self) -> None:
        """Fail all waiting jobs, and take no more."""
        with self._changed:
            self._closed = True
            waiting = self._waiting.drop(lambda _ticket: True)
            self._changed.notify_all()
        for pending in waiting:
            pending.fail("closing")

    def _refusal(self, pending: PendingJob) -> LostReason | None:
        if self._closed:
            return "closing"
        if not pending.wanted:
            return "deadline"
        if pending.digest in self._poisoned:
            return "poisoned"
        if not self._served_by(pending.deadline):
            return "not-ready"
        if not self._room.may_take(pending.client):
            self._drop_unwanted()
        return None if self._room.may_take(pending.client) else "queue-full"

    def _next(self) -> PendingJob | None:
        found = self._waiting.take(self._workers.may_take) if self._workers is not None else self._waiting.take()
        if found is None:
            return None
        pending = found[1]
        self._room.give_back(pending.client)
        if self._workers is not None:
            self._workers.take(pending.client)
        return pending

    def _drop_unwanted(self) -> None:
        for pending in self._waiting.drop(lambda pending: not pending.wanted):
            self._room.give_back(pending.client)
            pending.fail("deadline")
