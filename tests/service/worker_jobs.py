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


def run_after_gate(connection: Connection, log: str, gate: str) -> None:
    """Run jobs as soon as the file `gate` exists."""
    _note(log, "start")

    def load() -> Callable[[Any], Any]:
        _wait_for_file(gate)
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
        case "wait":
            _wait_for_file(argument)
        case "spin":
            begin = time.process_time()
            while time.process_time() < begin + argument:
                pass
        case "raise":
            raise ValueError(argument)
        case "die":
            os.kill(os.getpid(), signal.SIGKILL)
        case "bytes":
            return bytes(argument)
    return os.getpid()


def _wait_for_file(path: str) -> None:
    while not Path(path).exists():
        time.sleep(0.01)


def _note(log: str, line: str) -> None:
    with Path(log).open("a", encoding="utf-8") as file:
        file.write(f"{line}\n")
