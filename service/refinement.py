"""Latent pose optimisation in a pool of worker processes, so that the service itself never imports torch.

Every worker has a pipe of its own and a supervising thread that starts it, hands it one job at a time, and replaces
it when it dies or stalls. Nothing that happens to a worker reaches the caller except as the answer None.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import queue
import threading
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from time import monotonic

from lalaloc_core.bundle import Bundle
from lalaloc_core.localise.poses import RefinementJob, RefinementResult
from service.lpo_worker import WorkerFault, WorkerReady, run_worker
from service.settings import Settings
from service.telemetry import LOGGER_NAME, Telemetry

# Loading torch takes seconds on a busy machine; a worker silent for longer will not come.
_WARM_UP_S = 120.0
# How soon an idle supervisor notices that its worker was killed.
_IDLE_CHECK_S = 0.2
_FIRST_BACKOFF_S, _LONGEST_BACKOFF_S = 0.5, 30.0
_STOP_S = 5.0


@dataclass(frozen=True)
class PoolState:
    """Workers wanted and warm, whether each has been warm once, and why the last start failed."""

    workers: int
    ready: int
    warmed_up: bool
    fault: str | None


class _Ticket:
    """One job on its way through the pool."""

    def __init__(self, job: RefinementJob, deadline: float) -> None:
        self.job = job
        self.deadline = deadline
        self.retried = False
        self._future: Future[RefinementResult | None] = Future()

    @property
    def expired(self) -> bool:
        return monotonic() >= self.deadline

    def answer(self, result: RefinementResult | None) -> None:
        self._future.set_result(result)

    def wait(self) -> tuple[bool, RefinementResult | None]:
        """Whether there was an answer before the deadline, and the answer."""
        try:
            return True, self._future.result(timeout=max(self.deadline - monotonic(), 0.0))
        except FutureTimeoutError:
            return False, None


class LpoPool:
    """Bounded pool of LPO workers; `refine` may be called from any thread."""

    def __init__(self, bundle: Bundle, settings: Settings, telemetry: Telemetry) -> None:
        self._telemetry = telemetry
        self._queue: queue.Queue[_Ticket] = queue.Queue(maxsize=settings.lpo_queue)
        self._closing = threading.Event()
        self._supervisors = [_Supervisor(self, index, bundle, settings) for index in range(settings.workers)]
        telemetry.gauge("lalaloc_lpo_queue_depth", "LPO jobs waiting for a worker.", self._queue.qsize)
        telemetry.gauge("lalaloc_lpo_workers_ready", "LPO workers that are warm.", lambda: self.state.ready)

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

    def refine(self, job: RefinementJob, timeout_s: float) -> RefinementResult | None:
        """The result of a job, or None when there is none within `timeout_s`, whatever the reason."""
        if not self._supervisors or timeout_s <= 0.0:
            return None
        if not any(supervisor.ready for supervisor in self._supervisors):
            return self._miss("not-ready")
        ticket = _Ticket(job, monotonic() + timeout_s)
        try:
            self._queue.put_nowait(ticket)
        except queue.Full:
            return self._miss("queue-full")
        answered, result = ticket.wait()
        if not answered:
            return self._miss("deadline")
        return result if result is not None else self._miss("fault")

    def close(self) -> None:
        """End all workers and wait for them."""
        self._closing.set()
        for supervisor in self._supervisors:
            supervisor.stop()
        while True:
            try:
                self._queue.get_nowait().answer(None)
            except queue.Empty:
                return

    @property
    def closing(self) -> threading.Event:
        """Set when the pool shuts down."""
        return self._closing

    def next_ticket(self) -> _Ticket | None:
        """The next job that is still of use; None when none came in a short while."""
        try:
            ticket = self._queue.get(timeout=_IDLE_CHECK_S)
        except queue.Empty:
            return None
        if ticket.expired:
            ticket.answer(None)
            return None
        return ticket

    def give_back(self, ticket: _Ticket) -> None:
        """A worker died over this job: let another one try, once, if there is one and time is left."""
        if not ticket.retried and not ticket.expired and self.state.ready > 0:
            ticket.retried = True
            # Without room for a second try, the caller gets what it gets without LPO.
            with contextlib.suppress(queue.Full):
                self._queue.put_nowait(ticket)
                return
        ticket.answer(None)

    def note_restart(self, index: int, reason: str) -> None:
        """Count and log that a worker has to be replaced."""
        self._telemetry.lpo_restarts.inc()
        fields = {"worker": index, "reason": reason}
        logging.getLogger(LOGGER_NAME).warning("LPO worker is replaced", extra={"fields": fields})

    def _miss(self, reason: str) -> None:
        self._telemetry.lpo_missed.labels(reason).inc()


class _Supervisor:
    """Keeps one worker process alive and feeds it; everything but `stop` happens on its own thread."""

    def __init__(self, pool: LpoPool, index: int, bundle: Bundle, settings: Settings) -> None:
        self.ready = False
        self.warmed_up = False
        self.fault: str | None = None
        self._pool = pool
        self._index = index
        self._arguments = (str(bundle.folder.resolve()), bundle.sha256, settings.worker_threads)
        self._stall_s = settings.lpo_stall_s
        self._process: BaseProcess | None = None
        self._thread = threading.Thread(target=self._run, name=f"lpo-supervisor-{index}", daemon=True)

    def start(self) -> None:
        """Start the thread, and with it the worker."""
        self._thread.start()

    def stop(self) -> None:
        """End the worker and wait for both; the pool must be closing already."""
        deadline = monotonic() + _STOP_S
        while self._thread.is_alive() and monotonic() < deadline:
            # A supervisor that waits for its worker wakes up when the worker ends; it may just have started another.
            if self._process is not None:
                self._process.kill()
            self._thread.join(_IDLE_CHECK_S)

    def _run(self) -> None:
        backoff_s = _FIRST_BACKOFF_S
        while not self._pool.closing.is_set():
            try:
                reason = self._run_once()
            except OSError as error:
                self.fault = reason = f"cannot start a worker: {error}"
            if self._pool.closing.is_set():
                return
            self._pool.note_restart(self._index, reason)
            if self.fault is None:
                backoff_s = _FIRST_BACKOFF_S
            else:
                self._pool.closing.wait(backoff_s)
                backoff_s = min(2.0 * backoff_s, _LONGEST_BACKOFF_S)

    def _run_once(self) -> str:
        """The life of one worker; returns why it ended."""
        connection, process = self._launch()
        try:
            self.fault = self._await_ready(connection, process)
            if self.fault is not None:
                return self.fault
            self.warmed_up = self.ready = True
            return self._serve(connection, process)
        finally:
            self.ready = False
            _end(connection, process)

    def _launch(self) -> tuple[Connection, BaseProcess]:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(
            target=run_worker, args=(theirs, *self._arguments), name=f"lalaloc-lpo-{self._index}", daemon=True
        )
        process.start()
        self._process = process
        # With our copy closed, the pipe breaks when the worker dies.
        theirs.close()
        return ours, process

    def _await_ready(self, connection: Connection, process: BaseProcess) -> str | None:
        """Why the worker did not become ready; None when it did."""
        message = _receive(connection, process, _WARM_UP_S)
        if isinstance(message, WorkerReady):
            return None
        if isinstance(message, WorkerFault):
            return message.reason
        return f"the worker did not start within {_WARM_UP_S:g} s" if process.is_alive() else "the worker died starting"

    def _serve(self, connection: Connection, process: BaseProcess) -> str:
        """Hand out jobs until the worker dies or stalls, or the pool closes; returns why it ended."""
        while not self._pool.closing.is_set():
            ticket = self._pool.next_ticket()
            if ticket is None:
                if not process.is_alive():
                    return "died idle"
                continue
            try:
                connection.send(ticket.job)
                answer = _receive(connection, process, self._stall_s)
            except OSError:
                answer = None
            if answer is None:
                self.ready = False
                self._pool.give_back(ticket)
                return "stalled" if process.is_alive() else "died at work"
            if isinstance(answer, WorkerFault):
                fields = {"worker": self._index, "reason": answer.reason}
                logging.getLogger(LOGGER_NAME).error("LPO failed", extra={"fields": fields})
            ticket.answer(answer if isinstance(answer, RefinementResult) else None)
        return "closing"


def _receive(connection: Connection, process: BaseProcess, timeout_s: float) -> object | None:
    """The worker's next message; None when it died or stayed silent."""
    wait([connection, process.sentinel], timeout_s)
    try:
        return connection.recv() if connection.poll() else None
    except (EOFError, OSError):
        return None


def _end(connection: Connection, process: BaseProcess) -> None:
    connection.close()
    process.kill()
    process.join(_STOP_S)
