"""Start the service as a separate process, wait until it is ready, and stop it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from lalaloc_client import Client, ConnectionFailedError, RetryPolicy

ROOT = Path(__file__).resolve().parent.parent

_POLL_S = 0.2
_READY_TIMEOUT_S = 180.0
_STOP_TIMEOUT_S = 20.0


class ServiceFailedError(Exception):
    """The service did not start; its log gives the reason."""


@dataclass(frozen=True)
class RunningService:
    """Running service at `url`."""

    url: str
    process: subprocess.Popen[str]


@contextmanager
def running_service(port: int, environment: Mapping[str, str], checkout: Path = ROOT) -> Iterator[RunningService]:
    """Run the service at 127.0.0.1 until the block ends, on `port`, 0 for a free one. It logs to standard error.

    `environment` adds to the variables of this process; the service runs in the folder `checkout`.
    """
    command = [sys.executable, "-m", "service", "--host", "127.0.0.1", "--port", str(port)]
    variables = {**os.environ, **environment}
    process = subprocess.Popen(command, cwd=checkout, env=variables, stdout=subprocess.PIPE, text=True)
    try:
        url = _announced_url(process)
        _wait_until_ready(url, process)
        yield RunningService(url, process)
    finally:
        _stop(process)


def _announced_url(process: subprocess.Popen[str]) -> str:
    """Return the address that the service prints after it has bound its port."""
    assert process.stdout is not None
    line = process.stdout.readline().strip()
    if not line:
        raise ServiceFailedError(f"the service ended with status {process.wait()} before it listened")
    return line


def _wait_until_ready(url: str, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + _READY_TIMEOUT_S
    # This loop retries, because it also checks the process.
    with Client(url, timeout_s=5.0, retry=RetryPolicy(attempts=1)) as client:
        while True:
            with suppress(ConnectionFailedError):
                if client.ready().ready:
                    return
            if process.poll() is not None:
                raise ServiceFailedError(f"the service ended with status {process.returncode} while starting")
            if time.monotonic() > deadline:
                raise ServiceFailedError(f"the service is not ready after {_READY_TIMEOUT_S:g} s")
            time.sleep(_POLL_S)


def _stop(process: subprocess.Popen[str]) -> None:
    process.terminate()
    try:
        process.wait(_STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
