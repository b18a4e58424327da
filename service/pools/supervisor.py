"""Thread that keeps one worker process alive and feeds it."""

from __future__ import annotations

import logging
import math
import multiprocessing
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from time import monotonic
from typing import Any, Literal

from lalaloc_core.errors import LaLaLocError
from service.pools.job_queue import JobQueue, PendingJob
from service.telemetry import LOGGER_NAME
from service.workers.process import JobNews, JobResult, Ready, WorkerFailure

# Workers that die sooner than this after they were warm are replaced more and more slowly; the first one at once.
_HEALTHY_S = 5.0
_FIRST_BACKOFF_S = 0.25
# Shorter for workers that were warm before, because they will probably start again.
_MAX_BACKOFF_S, _MAX_BACKOFF_ONCE_WARM_S, _MAX_WARM_BACKOFF_S = 30.0, 5.0, 1.0
# After this many failed starts in a row, or without any success, jobs do not wait for the next start.
_HOPELESS_STARTS = 3
# Time limit and poll interval (s) for the end of a killed worker.
_KILL_S, _JOIN_S = 5.0, 0.2
# A busy machine may take this many times as long as a time limit for the work that it allows.
_PATIENCE = 4.0
# The service has threads, which `fork` does not copy.
_START_METHOD = "spawn"
# Looks at a process within its time limit, and the time (s) for which it may do nothing, if the limit is shorter.
_LOOKS, _MIN_IDLE_S = 4, 1.0


@dataclass(frozen=True)
class WorkerSpec:
    """Program of the processes of a pool.

    Attributes:
        name: name in the log and in the process list.
        target: called in the worker as `target(connection, *arguments)`; must be importable there.
        arguments: picklable arguments.
        stall_s: limit (s) of a job's CPU time; the worker is killed after it, or if it does nothing for as long.
        start_s: usual duration (s) of a start, until one has been measured.
        max_start_s: time limit (s) of a start; loading torch takes seconds, on a busy machine many.
        nice: niceness above the service's own, for work that no query waits for.
    """

    name: str
    target: Callable[..., None]
    arguments: tuple[Any, ...] = ()
    stall_s: float = 10.0
    start_s: float = 5.0
    max_start_s: float = 120.0
    nice: int = 0


class Supervisor:
    """Keeper of one worker process; everything but `stop` runs on its own thread."""

    def __init__(self, spec: WorkerSpec, index: int, queue: JobQueue, on_restart: Callable[[str], None]) -> None:
        """Create a supervisor, which `start` starts; closing the queue ends its thread after the current job."""
        self.ready, self.warmed_up = False, False
        self.fault: str | None = None
        self._spec, self._index, self._queue = spec, index, queue
        self._on_restart, self._failed_starts = on_restart, 0
        self._start_s, self._starts_at = spec.start_s, monotonic()
        self._process: BaseProcess | None = None
        # Job of the worker, also of one that died: until the next worker is ready, only this job's client goes without.
        self._held: PendingJob | None = None
        self._thread = threading.Thread(target=self._run, name=f"{self._spec.name}-supervisor-{index}", daemon=True)

    def start(self) -> None:
        """Start the thread, and with it the worker."""
        self._starts_at = monotonic()
        self._thread.start()

    @property
    def expected_ready(self) -> float:
        """Time (`monotonic`) at which the worker is expected to be warm, or infinity if starts keep failing."""
        now = monotonic()
        if self.ready:
            return now
        if self._failed_starts >= _HOPELESS_STARTS or (self._failed_starts and not self.warmed_up):
            return math.inf
        expected = self._starts_at + self._start_s
        # A late worker will probably take as long again.
        return expected if expected > now else now + (now - self._starts_at)

    @property
    def resident_bytes(self) -> int:
        """Memory of the worker; 0 without a worker, and on systems other than Linux."""
        values = _status(self._process, "statm").split()
        return int(values[1]) * os.sysconf("SC_PAGE_SIZE") if values else 0

    def stop(self, deadline: float) -> None:
        """End the worker after its job, or at the deadline (`monotonic`); the queue must be closed."""
        self._thread.join(max(deadline - monotonic(), 0.0))
        give_up = monotonic() + _KILL_S
        while self._thread.is_alive() and monotonic() < give_up:
            # The supervisor wakes up when its worker ends; it can just have started another one.
            if self._process is not None:
                self._process.kill()
            self._thread.join(_JOIN_S)

    def _run(self) -> None:
        short_lives = 0
        while not self._queue.closed:
            begin = monotonic()
            try:
                reason = self._live()
            except Exception as error:
                self.fault = reason = f"cannot run a worker: {type(error).__name__}: {error}"
            if self._queue.closed:
                return
            self._on_restart(reason)
            fields = {"pool": self._spec.name, "worker": self._index, "reason": reason}
            logging.getLogger(LOGGER_NAME).warning("worker is replaced", extra={"fields": fields})
            self._failed_starts = 0 if self.fault is None else self._failed_starts + 1
            short_lives = 0 if monotonic() - begin > self._start_s + _HEALTHY_S else short_lives + 1
            self._pause(short_lives)

    def _pause(self, short_lives: int) -> None:
        """Back off after several short lives in a row."""
        max_s = _MAX_BACKOFF_ONCE_WARM_S if self.warmed_up else _MAX_BACKOFF_S
        if self.fault is None:
            max_s = _MAX_WARM_BACKOFF_S
        # The exponent is bounded, because workers can die for years.
        pause_s = min(_FIRST_BACKOFF_S * 2.0 ** min(short_lives - 2, 20), max_s) if short_lives > 1 else 0.0
        self._starts_at = monotonic() + pause_s
        self._queue.rest(pause_s)

    def _live(self) -> str:
        """Run one worker until it ends, and return the reason."""
        self._starts_at = monotonic()
        connection, process = self._launch()
        try:
            self.fault = self._await_ready(connection, process)
            # Also after a failed start: a worker that never comes must not be held for ever.
            self._release()
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
        context = multiprocessing.get_context(_START_METHOD)
        ours, theirs = context.Pipe()
        process = context.Process(
            target=self._spec.target,
            args=(theirs, *self._spec.arguments),
            name=f"lalaloc-{self._spec.name}-{self._index}",
            daemon=True,
        )
        with theirs:
            # Closing our copy of its end makes the pipe break when the worker dies.
            process.start()
        self._process = process
        if self._spec.nice:
            # It can have ended already.
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, process.pid or 0, os.getpriority(os.PRIO_PROCESS, 0) + self._spec.nice)
        return ours, process

    def _await_ready(self, connection: Connection, process: BaseProcess) -> str | None:
        """Wait for the worker; return the error of a failed start, None after a successful one."""
        with Watchdog(process, self._spec.max_start_s) as watchdog:
            message = _receive(connection)
        if isinstance(message, Ready):
            return None
        if isinstance(message, WorkerFailure):
            return message.reason
        late = f"the worker did not start within {self._spec.max_start_s:g} s"
        return late if watchdog.verdict else "the worker died starting"

    def _serve(self, connection: Connection, process: BaseProcess) -> str:
        """Hand out jobs until the worker dies or stalls, or the queue is closed; return the reason."""
        while not self._queue.closed:
            if not process.is_alive():
                return "died idle"
            pending = self._queue.take()
            if pending is None:
                continue
            self._held = pending
            begin = monotonic()
            with Watchdog(process, self._spec.stall_s) as watchdog:
                # A worker that died before it had the whole job was not crashed by it.
                sent = process.is_alive() and _send(connection, pending.content)
                answer = _receive(connection) if sent else None
                while isinstance(answer, JobNews):
                    pending.on_news(answer.value)
                    answer = _receive(connection)
            # A worker that died has not told its CPU time, which is at most this long.
            known = answer.cpu_s if isinstance(answer, JobResult | WorkerFailure) else watchdog.cpu_s
            cpu_s = known if known is not None else monotonic() - begin
            self._queue.accounts.charge(pending.client, cpu_s)
            if answer is None:
                self.ready = False
                self._starts_at = monotonic()
                pending.stalled = sent and watchdog.verdict == "stalled"
                pending.stops += watchdog.verdict == "stopped"
                pending.deaths += sent and watchdog.verdict is None
                self._queue.give_back(pending)
                return watchdog.verdict or ("died at work" if sent else "died idle")
            self._release()
            self._settle(pending, answer)
        return "closing"

    def _release(self) -> None:
        if self._held is not None:
            self._queue.release(self._held)
            self._held = None

    def _settle(self, pending: PendingJob, answer: object) -> None:
        if isinstance(answer, JobResult):
            is_error = isinstance(answer.value, LaLaLocError)
            (pending.future.set_exception if is_error else pending.future.set_result)(answer.value)
            return
        reason = answer.reason if isinstance(answer, WorkerFailure) else f"unexpected message {type(answer).__name__}"
        fields = {"pool": self._spec.name, "worker": self._index, "reason": reason}
        logging.getLogger(LOGGER_NAME).error("job failed", extra={"fields": fields})
        pending.fail("fault")


class Watchdog:
    """Timer that kills a process at its time limit; reads and writes of its pipe then end as well.

    The limit is one of CPU time, so that a busy machine ends no job. A process that does nothing for as long is killed
    too, and one that gets too little CPU time for several times as long.

    Attributes:
        verdict: `stalled` if the process used up its CPU time, `stopped` if it was killed otherwise, else None.
        cpu_s: CPU time of a killed process; None if it is not known.
    """

    def __init__(self, process: BaseProcess, limit_s: float) -> None:
        """Prepare the timer of a process, in seconds."""
        self.verdict: Literal["stalled", "stopped"] | None = None
        self.cpu_s: float | None = None
        self._process, self._limit_s = process, limit_s
        self._lock = threading.Lock()
        self._ended = False

    def __enter__(self) -> Watchdog:
        """Start the timer."""
        self._begin = self._progress = monotonic()
        self._used_before = self._used = _cpu_s(self._process)
        self._arm(self._limit_s / _LOOKS)
        return self

    def __exit__(self, *_error: object) -> None:
        """Cancel the timer."""
        with self._lock:
            self._ended = True
            self._timer.cancel()

    def expire(self, verdict: Literal["stalled", "stopped"] = "stalled") -> None:
        """Kill the process."""
        with self._lock:
            if self._ended:
                return
            self._ended, self.verdict = True, verdict
            self._process.kill()

    def _arm(self, pause_s: float) -> None:
        self._timer = threading.Timer(pause_s, self._look)
        self._timer.daemon = True
        self._timer.start()

    def _look(self) -> None:
        now, used = monotonic(), _cpu_s(self._process)
        if used is None or self._used_before is None:
            # The platform does not tell the CPU time.
            spent_s = now - self._begin
        else:
            self.cpu_s = spent_s = used - self._used_before
            if used != self._used:
                self._used, self._progress = used, now
        if spent_s >= self._limit_s:
            self.expire("stalled")
        elif now - self._progress >= max(self._limit_s, _MIN_IDLE_S) or now - self._begin >= _PATIENCE * self._limit_s:
            self.expire("stopped")
        else:
            with self._lock:
                if not self._ended:
                    self._arm(self._limit_s / _LOOKS)


def _cpu_s(process: BaseProcess) -> float | None:
    """Return the CPU time (s) of a process; None on systems other than Linux, and after its end."""
    # The second value is the name in brackets; user and system time are the 12th and 13th after it.
    values = _status(process, "stat").rpartition(")")[2].split()
    return (int(values[11]) + int(values[12])) / os.sysconf("SC_CLK_TCK") if values else None


def _status(process: BaseProcess | None, file: str) -> str:
    """Return a file of /proc; empty without the process, and on systems other than Linux."""
    try:
        return Path(f"/proc/{process.pid if process is not None else None}/{file}").read_text(encoding="utf-8")
    except OSError:
        return ""


def _send(connection: Connection, content: Sequence[bytes | memoryview]) -> bool:
    """Send the parts of a job, and an empty one; False if the worker died before it had all of it."""
    try:
        for part in (*content, b""):
            connection.send_bytes(part)
    except OSError:
        return False
    return True


def _receive(connection: Connection) -> object | None:
    """Return the worker's next message; None if it died, even in the middle of the message."""
    try:
        return connection.recv()
    except (EOFError, OSError):
        return None
