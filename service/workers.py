"""Pools of supervised worker processes, for work that may take long, eat memory, or crash.

A worker process answers one job at a time over a pipe of its own. A supervising thread starts it, feeds it, kills it
when it stalls, and replaces it when it dies. What happens to a worker reaches callers only as a `JobLostError`.

    pool = WorkerPool(WorkerSpec("decode", run_decoder, (limits,), stall_s=10.0), workers=2, queue_limit=16)
    pool.start()
    answer = await pool.answer(job, timeout_s=5.0)      # cancelling it cancels the job

with `run_decoder(connection, limits)` a function of a module that calls `worker_process.serve_jobs`.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import math
import multiprocessing
import pickle
import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from time import monotonic
from typing import Any, Generic, Literal, TypeVar

from service.telemetry import LOGGER_NAME
from service.worker_process import Answered, Fault, Ready

Job = TypeVar("Job")
Answer = TypeVar("Answer")
LostReason = Literal["not-ready", "queue-full", "deadline", "poisoned", "fault", "died", "closing"]

# How soon an idle supervisor notices that its worker was killed.
_IDLE_CHECK_S = 0.2
# A worker that dies this soon after it was warm, or before, is replaced more and more slowly; the first time at once.
_HEALTHY_S = 5.0
_FIRST_BACKOFF_S = 0.25
# Those that got warm may well do so again.
_LONGEST_BACKOFF_S, _LONGEST_WARM_BACKOFF_S = 30.0, 1.0
# After so many failed starts in a row, or none that succeeded, nobody waits for the next one.
_HOPELESS_STARTS = 3
# So many workers may die or stall over one job.
_TRIES_PER_JOB = 2
_POISON_MEMORY_S, _POISON_MEMORY = 600.0, 256
_KILL_S = 5.0


class JobLostError(Exception):
    """A job has no answer.

    Attributes:
        reason: `not-ready`: no worker is warm, nor will be in time. `queue-full`: too many jobs wait already.
            `deadline`: no answer in time. `poisoned`: workers died or stalled over this job. `fault`: the work raised
            an error, which the log has. `died`: the worker died, and there is no time for another try. `closing`: the
            pool shuts down.
    """

    def __init__(self, reason: LostReason) -> None:
        self.reason: LostReason = reason
        super().__init__(f"the job has no answer: {reason}")


@dataclass(frozen=True)
class WorkerSpec:
    """What to run in the processes of a pool.

    Attributes:
        name: of the processes, in the log, and in the process list.
        target: called in the worker as `target(connection, *arguments)`; has to be importable there.
        arguments: picklable.
        stall_s: a worker busy with one job for longer is killed.
        start_s: what a start usually takes, until one has been measured.
        longest_start_s: a worker not warm after that will not come.
    """

    name: str
    target: Callable[..., None]
    arguments: tuple[Any, ...] = ()
    stall_s: float = 10.0
    start_s: float = 5.0
    longest_start_s: float = 120.0


@dataclass(frozen=True)
class PoolState:
    """Workers wanted and warm, whether each has been warm once, and why the last start failed."""

    workers: int
    ready: int
    warmed_up: bool
    fault: str | None


class _Ticket:
    """One job on its way through the pool."""

    def __init__(self, content: bytes, digest: bytes, deadline: float) -> None:
        self.content = content
        self.digest = digest
        self.deadline = deadline
        self.deaths = self.stalls = 0
        self.future: Future[Any] = Future()

    @property
    def wanted(self) -> bool:
        """Whether starting it is of use: it has time left, and nobody gave it up."""
        return monotonic() < self.deadline and not self.future.cancelled()

    def lose(self, reason: LostReason) -> None:
        # Whoever waited may have given up at this very moment.
        if self.future.running() or self.future.set_running_or_notify_cancel():
            self.future.set_exception(JobLostError(reason))


class WorkerPool(Generic[Job, Answer]):
    """Bounded queue before some supervised workers; may be used from any thread."""

    def __init__(
        self,
        spec: WorkerSpec,
        *,
        workers: int,
        queue_limit: int,
        on_restart: Callable[[str], None] = lambda _reason: None,
    ) -> None:
        """A pool that has not been started.

        Args:
            queue_limit: jobs that may wait for a worker, besides those at work.
            on_restart: called with the reason whenever a worker has to be replaced.
        """
        self.spec = spec
        self._queue_limit = queue_limit
        self._on_restart = on_restart
        self._waiting: deque[_Ticket] = deque()
        self._poisoned: OrderedDict[bytes, float] = OrderedDict()
        self._changed = threading.Condition()
        self._closing = False
        self._submitting = ThreadPoolExecutor(1, thread_name_prefix=f"{spec.name}-submit")
        self._supervisors = [_Supervisor(self, index) for index in range(workers)]

    def start(self) -> None:
        """Start all workers; returns at once, see `state` for when they are warm."""
        for supervisor in self._supervisors:
            supervisor.start()

    @property
    def state(self) -> PoolState:
        """How many workers are wanted and warm."""
        faults = [supervisor.fault for supervisor in self._supervisors if supervisor.fault is not None]
        return PoolState(
            workers=len(self._supervisors),
            ready=sum(supervisor.ready for supervisor in self._supervisors),
            warmed_up=all(supervisor.warmed_up for supervisor in self._supervisors),
            fault=faults[0] if faults else None,
        )

    @property
    def waiting(self) -> int:
        """Jobs that wait for a worker."""
        return len(self._waiting)

    @property
    def closing(self) -> bool:
        """Whether the pool shuts down."""
        return self._closing

    def submit(self, job: Job, timeout_s: float) -> Future[Answer]:
        """Queue a job. Cancelling the future takes it out of the queue again; at work it is finished.

        Returns:
            a future that gives the answer or raises `JobLostError`; it may do so later than the deadline.

        Raises:
            JobLostError: there is no use in waiting.
        """
        content = pickle.dumps(job, protocol=pickle.HIGHEST_PROTOCOL)
        ticket = _Ticket(content, hashlib.sha256(content).digest(), monotonic() + timeout_s)
        with self._changed:
            reason = self._refusal(ticket)
            if reason is not None:
                raise JobLostError(reason)
            self._waiting.append(ticket)
            self._changed.notify()
        return ticket.future

    async def answer(self, job: Job, timeout_s: float) -> Answer:
        """The answer to a job, awaited; a job that is no longer awaited is not started.

        Raises:
            JobLostError: there is none within `timeout_s`.
        """
        if self._closing:
            raise JobLostError("closing")
        # On a thread: copying and hashing a large job would hold up everybody else.
        submitted = self._submitting.submit(self.submit, job, timeout_s)
        try:
            async with asyncio.timeout(timeout_s):
                return await asyncio.wrap_future(await asyncio.wrap_future(submitted))
        except TimeoutError:
            submitted.add_done_callback(_take_back)
            raise JobLostError("deadline") from None
        except asyncio.CancelledError:
            submitted.add_done_callback(_take_back)
            raise

    def close(self, drain_s: float = 0.0) -> None:
        """End all workers and wait for them: jobs at work have `drain_s` to finish, those that wait are lost."""
        with self._changed:
            self._closing = True
            waiting = list(self._waiting)
            self._waiting.clear()
            self._changed.notify_all()
        for ticket in waiting:
            ticket.lose("closing")
        deadline = monotonic() + drain_s
        for supervisor in self._supervisors:
            supervisor.stop(deadline)
        self._submitting.shutdown()

    def _refusal(self, ticket: _Ticket) -> LostReason | None:
        if self._closing:
            return "closing"
        if not ticket.wanted:
            return "deadline"
        if self._poisoned.get(ticket.digest, 0.0) > monotonic():
            return "poisoned"
        if not self._served_by(ticket.deadline):
            return "not-ready"
        if len(self._waiting) >= self._queue_limit:
            self._drop_unwanted()
        return "queue-full" if len(self._waiting) >= self._queue_limit else None

    def _drop_unwanted(self) -> None:
        for ticket in [ticket for ticket in self._waiting if not ticket.wanted]:
            self._waiting.remove(ticket)
            ticket.lose("deadline")

    def _served_by(self, deadline: float) -> bool:
        return any(supervisor.expected_ready <= deadline for supervisor in self._supervisors)

    def next_ticket(self) -> _Ticket | None:
        """For supervisors: the next job that is still of use; None when none came in a short while."""
        with self._changed:
            if not self._waiting and not self._closing:
                self._changed.wait(_IDLE_CHECK_S)
            ticket = self._waiting.popleft() if self._waiting else None
        if ticket is None:
            return None
        if monotonic() >= ticket.deadline:
            ticket.lose("deadline")
            return None
        return ticket if ticket.future.running() or ticket.future.set_running_or_notify_cancel() else None

    def give_back(self, ticket: _Ticket) -> None:
        """For supervisors: the worker with this job died; let another one try, if the job may and has the time."""
        reason: LostReason | None = None
        with self._changed:
            if ticket.deaths + ticket.stalls >= _TRIES_PER_JOB:
                reason = "poisoned"
                # A worker may stall because the machine is busy; that says nothing about the next time.
                if ticket.stalls == 0:
                    self._ban(ticket.digest)
            elif self._closing:
                reason = "closing"
            elif not ticket.wanted or not self._served_by(ticket.deadline):
                reason = "died"
            else:
                # Past the limit by at most one job per worker, and in front of those that came later.
                self._waiting.appendleft(ticket)
                self._changed.notify()
        if reason is not None:
            ticket.lose(reason)

    def _ban(self, digest: bytes) -> None:
        self._poisoned[digest] = monotonic() + _POISON_MEMORY_S
        while len(self._poisoned) > _POISON_MEMORY:
            self._poisoned.popitem(last=False)

    def pause(self, duration_s: float) -> None:
        """For supervisors: wait, but not longer than until the pool shuts down."""
        with self._changed:
            self._changed.wait_for(lambda: self._closing, duration_s)

    def note_restart(self, index: int, reason: str) -> None:
        """For supervisors: count and log that a worker has to be replaced."""
        self._on_restart(reason)
        fields = {"pool": self.spec.name, "worker": index, "reason": reason}
        logging.getLogger(LOGGER_NAME).warning("worker is replaced", extra={"fields": fields})


def _take_back(submitted: Future[Future[Any]]) -> None:
    """Give up a job whose caller left while it was being submitted, or after."""
    if not submitted.cancelled() and submitted.exception() is None:
        submitted.result().cancel()


class _Supervisor:
    """Keeps one worker process alive and feeds it; everything but `stop` happens on its own thread."""

    def __init__(self, pool: WorkerPool[Any, Any], index: int) -> None:
        self.ready = False
        self.warmed_up = False
        self.fault: str | None = None
        self._pool = pool
        self._spec = pool.spec
        self._index = index
        self._failed_starts = 0
        self._start_s = self._spec.start_s
        self._starts_at = monotonic()
        self._process: BaseProcess | None = None
        self._thread = threading.Thread(target=self._run, name=f"{self._spec.name}-supervisor-{index}", daemon=True)

    def start(self) -> None:
        """Start the thread, and with it the worker."""
        self._thread.start()

    @property
    def expected_ready(self) -> float:
        """When (`monotonic`) the worker will be warm, as far as can be told: as fast as last time, or never."""
        now = monotonic()
        if self.ready:
            return now
        if self._failed_starts >= _HOPELESS_STARTS or (self._failed_starts and not self.warmed_up):
            return math.inf
        expected = self._starts_at + self._start_s
        # One that is late may well take as long again.
        return expected if expected > now else now + (now - self._starts_at)

    def stop(self, deadline: float) -> None:
        """End the worker once its job is done, at the deadline (`monotonic`) in any case; the pool must be closing."""
        self._thread.join(max(deadline - monotonic(), 0.0))
        give_up = monotonic() + _KILL_S
        while self._thread.is_alive() and monotonic() < give_up:
            # A supervisor that waits for its worker wakes up when the worker ends; it may just have started another.
            if self._process is not None:
                self._process.kill()
            self._thread.join(_IDLE_CHECK_S)

    def _run(self) -> None:
        short_lives = 0
        while not self._pool.closing:
            begin = monotonic()
            try:
                reason = self._live()
            except Exception as error:
                self.fault = reason = f"cannot run a worker: {type(error).__name__}: {error}"
            if self._pool.closing:
                return
            self._pool.note_restart(self._index, reason)
            self._failed_starts = 0 if self.fault is None else self._failed_starts + 1
            short_lives = 0 if monotonic() - begin > self._start_s + _HEALTHY_S else short_lives + 1
            self._pause(short_lives)

    def _pause(self, short_lives: int) -> None:
        """Back off after so many short lives in a row."""
        longest_s = _LONGEST_WARM_BACKOFF_S if self.fault is None else _LONGEST_BACKOFF_S
        # Bounded before it is raised to a power: worker after worker may die for years.
        pause_s = min(_FIRST_BACKOFF_S * 2.0 ** min(short_lives - 2, 20), longest_s) if short_lives > 1 else 0.0
        self._starts_at = monotonic() + pause_s
        self._pool.pause(pause_s)

    def _live(self) -> str:
        """The life of one worker; returns why it ended."""
        self._starts_at = monotonic()
        connection, process = self._launch()
        try:
            self.fault = self._await_ready(connection, process)
            if self.fault is not None:
                return self.fault
            self._start_s = monotonic() - self._starts_at
            self.warmed_up = self.ready = True
            return self._serve(connection, process)
        finally:
            self.ready = False
            connection.close()
            process.kill()
            process.join(_KILL_S)

    def _launch(self) -> tuple[Connection, BaseProcess]:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(
            target=self._spec.target,
            args=(theirs, *self._spec.arguments),
            name=f"lalaloc-{self._spec.name}-{self._index}",
            daemon=True,
        )
        with theirs:
            # With our copy of its end closed, the pipe breaks when the worker dies.
            process.start()
        self._process = process
        return ours, process

    def _await_ready(self, connection: Connection, process: BaseProcess) -> str | None:
        """Why the worker did not become ready; None when it did."""
        with _Watchdog(process, self._spec.longest_start_s) as watchdog:
            message = _receive(connection)
        if isinstance(message, Ready):
            return None
        if isinstance(message, Fault):
            return message.reason
        late = f"the worker did not start within {self._spec.longest_start_s:g} s"
        return late if watchdog.barked else "the worker died starting"

    def _serve(self, connection: Connection, process: BaseProcess) -> str:
        """Hand out jobs until the worker dies or stalls, or the pool closes; returns why it ended."""
        while not self._pool.closing:
            if not process.is_alive():
                return "died idle"
            ticket = self._pool.next_ticket()
            if ticket is None:
                continue
            with _Watchdog(process, self._spec.stall_s) as watchdog:
                # A worker that died before it had the whole job did not die over it.
                sent = process.is_alive() and _send(connection, ticket.content)
                answer = _receive(connection) if sent else None
            if answer is None:
                self.ready = False
                self._starts_at = monotonic()
                ticket.stalls += watchdog.barked
                ticket.deaths += sent and not watchdog.barked
                self._pool.give_back(ticket)
                return "stalled" if watchdog.barked else "died at work" if sent else "died idle"
            self._settle(ticket, answer)
        return "closing"

    def _settle(self, ticket: _Ticket, answer: object) -> None:
        if isinstance(answer, Answered):
            ticket.future.set_result(answer.value)
            return
        reason = answer.reason if isinstance(answer, Fault) else f"unexpected message {type(answer).__name__}"
        fields = {"pool": self._spec.name, "worker": self._index, "reason": reason}
        logging.getLogger(LOGGER_NAME).error("job failed", extra={"fields": fields})
        ticket.lose("fault")


class _Watchdog:
    """Kills a process unless the block ends in time: reads and writes of its pipe then end, even half-way."""

    def __init__(self, process: BaseProcess, limit_s: float) -> None:
        self.barked = False
        self._process = process
        self._timer = threading.Timer(limit_s, self._bark)
        self._timer.daemon = True

    def __enter__(self) -> _Watchdog:
        self._timer.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._timer.cancel()

    def _bark(self) -> None:
        self.barked = True
        self._process.kill()


def _send(connection: Connection, content: bytes) -> bool:
    """False when the worker died before it had everything."""
    try:
        connection.send_bytes(content)
    except OSError:
        return False
    return True


def _receive(connection: Connection) -> object | None:
    """The worker's next message; None when it died, perhaps in the middle of the message."""
    try:
        return connection.recv()
    except (EOFError, OSError):
        return None
