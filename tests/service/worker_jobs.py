"""Programs of the workers of `test_pools`; in a module of its own, because every worker imports it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from service.workers.process import serve_jobs


def run(connection: Connection, log: str) -> None:
    """Run jobs `(kind, argument)`; every job and every start adds a line to `log`."""
    _note(log, "start")
    serve_jobs(connection, lambda: lambda job: _work(log, *job))


def run_slow_start(connection: Connection, log: str, start_s: float) -> None:
    """Run jobs after a slow start."""
    _note(log, "start")

    def load() -> Callable[[Any], Any]:
        time.sleep(start_s)
        return lambda job: _work(log, *job)

    serve_jobs(connection, load)


def run_broken(_connection: Connection, log: str) -> None:
    """End before being ready."""
    _note(log, "start")


def _work(log: str, kind: str, argument: Any) -> Any:
    _note(log, kind)
    match kind:
        case "echo":
            return argument
        case "sleep":
            time.sleep(argument)
        case "raise":
            raise ValueError(argument)
        case "die":
            os.kill(os.getpid(), signal.SIGKILL)
        case "bytes":
            return bytes(argument)
    return os.getpid()


def _note(log: str, line: str) -> None:
    with Path(log).open("a", encoding="utf-8") as file:
        file.write(f"{line}\n")
