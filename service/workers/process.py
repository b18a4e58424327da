"""The inside of a worker process: announce itself, then answer one job at a time until the parent is gone.

A `Supervisor` starts such processes and watches over them. Imports little, because every worker imports it.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Ready:
    """What a worker says once it is warm."""


@dataclass(frozen=True)
class JobResult:
    """A job's answer."""

    value: Any


@dataclass(frozen=True)
class WorkerFailure:
    """What a worker says instead of an answer, or instead of being ready."""

    reason: str


def serve_jobs(
    connection: Connection, load: Callable[[], Callable[[Any], Any]], is_fit: Callable[[], bool] = lambda: True
) -> None:
    """Load what does the work, then answer jobs until the pipe closes.

    Args:
        load: takes its time and returns the function from job to answer. What either raises is told to the parent; a
            worker whose function raised goes on with the next job.
        is_fit: asked after each job; a worker that is not ends, and is replaced.
    """
    # Ctrl-C and a service manager's signal reach the whole process group; the parent decides when its workers end.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    _die_with_parent()
    try:
        work = load()
    except Exception as error:
        _send(connection, WorkerFailure(f"{type(error).__name__}: {error}"))
        return
    message: Ready | JobResult | WorkerFailure = Ready()
    while _send(connection, message) and is_fit():
        try:
            job = connection.recv()
        except (EOFError, OSError):
            return
        try:
            message = JobResult(work(job))
        except Exception as error:
            message = WorkerFailure(f"{type(error).__name__}: {error}")


def limit_memory(memory_bytes: int) -> None:
    """Let allocations fail, where the system can, beyond what is in use now and `memory_bytes`."""
    if sys.platform != "linux":
        return
    import resource

    limit = address_space_bytes() + memory_bytes
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))


def address_space_bytes() -> int:
    """How much this process has asked for; 0 where that cannot be told (it can on Linux)."""
    if sys.platform != "linux":
        return 0
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    return pages * os.sysconf("SC_PAGE_SIZE")


def _die_with_parent() -> None:
    """Also in the middle of a job; an idle worker would notice that the pipe closed."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _send(connection: Connection, message: Ready | JobResult | WorkerFailure) -> bool:
    """False when the parent is gone."""
    try:
        connection.send(message)
    except OSError:
        return False
    return True
