"""Queries per second and how long they take, by number of clients, for two ways of running the service.

    python -m benchmarks.throughput --seconds 20

Prints a Markdown table. `one` is one process with its workers, `two` is two such replicas on one SQLite database and
behind the same port: what `uvicorn --workers 2` runs. Where there are more cores than two, each has half the workers.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx

from benchmarks.load import Load, ask_for, faults, per_second, percentiles_ms, upload_example_plan
from service.settings import Settings

ROOT = Path(__file__).resolve().parent.parent
_START_S, _STOP_S = 120.0, 40.0
_CLIENTS = (1, 2, 4, 8, 16)
# Nobody is refused: what is measured is how requests wait for each other.
_SHARED = {"LALALOC_LOG_LEVEL": "error", "LALALOC_MAX_QUERIES": "64", "LALALOC_LPO_QUEUE": "64"}
_SHARES = Settings.load().cores
SETTINGS = {
    "one": (1, {}),
    "two": (
        2,
        {
            "LALALOC_WORKERS": str(max(_SHARES.workers // 2, 1)),
            "LALALOC_COMPUTE_THREADS": str(max(_SHARES.compute_threads // 2, 1)),
        },
    ),
}


def main() -> int:
    """Run; 1 when an answer was wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="for each number of clients")
    parser.add_argument("--clients", type=int, nargs="*", default=_CLIENTS)
    options = parser.parse_args()
    print("| processes | clients | queries/s | p50 | p95 | p99 | at `lpo` | refused or wrong |", flush=True)
    print("|---|---|---|---|---|---|---|---|", flush=True)
    wrong = 0
    for name, (processes, settings) in SETTINGS.items():
        with under_uvicorn(processes, {**_SHARED, **settings}) as url:
            plan_id = upload_example_plan(url)
            ask_for(url, plan_id, Load(4, 5.0))
            for clients in options.clients:
                replies = ask_for(url, plan_id, Load(clients, options.seconds))
                took = percentiles_ms([reply for reply in replies if reply.answered])
                bad = sum(not reply.answered or reply.fault is not None for reply in replies)
                wrong += sum(faults(replies).values())
                lpo = sum(reply.stage == "lpo" for reply in replies) / len(replies)
                times = " | ".join(f"{took.get(q, float('nan')):.0f} ms" for q in ("p50", "p95", "p99"))
                print(f"| {name} | {clients} | {per_second(replies):.1f} | {times} | {lpo:.0%} | {bad} |", flush=True)
    return int(bool(wrong))


@contextmanager
def under_uvicorn(processes: int, settings: dict[str, str]) -> Iterator[str]:
    """The service under uvicorn with so many processes on one SQLite database; gives its address."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "uvicorn", "service.app:app", "--port", str(port), "--log-level", "warning"]
    command += ["--workers", str(processes)]
    with tempfile.TemporaryDirectory() as data:
        environment = {**os.environ, **settings, "LALALOC_DATA_DIR": data}
        process = subprocess.Popen(command, cwd=ROOT, env=environment, start_new_session=True)
        url = f"http://127.0.0.1:{port}"
        try:
            # Either process may answer: ask until none of them is cold.
            warm = 0
            deadline = time.monotonic() + _START_S
            while warm < 10 * processes:
                warm = warm + 1 if _ready(url) else 0
                if time.monotonic() > deadline:
                    raise TimeoutError("the service did not become ready")
                time.sleep(0.05)
            yield url
        finally:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait(_STOP_S)


def _ready(url: str) -> bool:
    try:
        # A connection of its own each time: processes share the port, and each accepts some.
        return httpx.get(f"{url}/readyz").status_code == httpx.codes.OK
    except httpx.TransportError:
        return False


if __name__ == "__main__":
    sys.exit(main())
