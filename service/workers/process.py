"""Main loop of a worker process: report readiness, then run one job at a time until the parent is gone.

`service.pools.supervisor` is the other end. This module imports little, because every worker imports it.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from time import process_time
from typing import Any

from lalaloc_core.errors import InvalidInputError
from service.errors import DamagedDataError

_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Ready:
    """Message of a worker that is warm."""


@dataclass(frozen=True)
class JobNews:
    """Message about a job that goes on."""

    value: Any


@dataclass(frozen=True)
class JobResult:
    """Message with the result of a job, or its error about what it was given, and the CPU time (s) that it took."""

    value: Any
    cpu_s: float


@dataclass(frozen=True)
class WorkerFailure:
    """Message with the error of a job, or of a failed start, and the CPU time (s) of the job."""

    reason: str
    cpu_s: float = 0.0


def serve_jobs(
    connection: Connection, load: Callable[[], Callable[[Any], Any]], is_fit: Callable[[], bool] = lambda: True
) -> None:
    """Load the function that runs jobs, then run jobs until the pipe closes.

    Args:
        connection: the worker's end of the pipe.
        load: slow; returns the function from job to result. Errors of either are reported to the parent, those about
            what a job was given as results, and a worker whose function raised one continues with the next job.
        is_fit: called after each job; the worker ends, and is replaced, when it returns False.
    """
    # Ctrl-C and a service manager's signal reach the whole process group, but the parent decides when its workers end.
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
            # In parts, of which the last is empty.
            job = pickle.loads(b"".join(iter(connection.recv_bytes, b"")))
        except (EOFError, OSError):
            return
        begin = process_time()
        try:
            message = JobResult(work(job), process_time() - begin)
        except (InvalidInputError, DamagedDataError) as error:
            message = JobResult(error, process_time() - begin)
        except Exception as error:
            message = WorkerFailure(f"{type(error).__name__}: {error}", process_time() - begin)


def tell(connection: Connection, value: Any) -> None:
    """Tell the parent news of the job that runs; see `PendingJob.on_news`. The value is picklable and small."""
    _send(connection, JobNews(value))


def limit_memory(memory_bytes: int) -> None:
    """Make allocations fail beyond the current use plus `memory_bytes`; on Linux only."""
    if sys.platform != "linux":
        return
    import resource

    limit = address_space_bytes() + memory_bytes
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))


def address_space_bytes() -> int:
    """Return the size of this process's address space; 0 on systems other than Linux."""
    if sys.platform != "linux":
        return 0
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    return pages * os.sysconf("SC_PAGE_SIZE")


def _die_with_parent() -> None:
    """Ask the kernel to kill this process with its parent, even in the middle of a job."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _send(connection: Connection, message: Ready | JobNews | JobResult | WorkerFailure) -> bool:
    """Send a message; False if the parent is gone."""
    try:
        connection.send(message)
    except OSError:
        return False
    return True
