"""Queries per second and their duration by number of clients, for several ways of running the service.

    python -m benchmarks.throughput --seconds 20 --processes 1 2 --clients 1 2 4 8 16
    python -m benchmarks.throughput --processes --ray-nodes 1 2 4 --kill

Prints a Markdown table. With 2 processes, `uvicorn --workers 2` runs two replicas on one SQLite database and one port;
each has half of the workers and compute threads where there are more cores than two. On Ray, each node runs one replica
that searches, one encoder and one LPO optimiser, the first node also runs the ingress, and each client has its own
plan. All nodes share the cores of this machine: the table shows the cost of distribution, not the gain of more
machines. `--ray-nodes` needs the extra `ray`. `--kill` adds a row in the middle of which a process or node is killed.
`LALALOC_DATABASE_URL` replaces the database of the processes, for instance by PostgreSQL.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import psutil

from benchmarks import harness
from examples.launch import ROOT
from service.settings import Settings

_CLIENTS = (1, 2, 4, 8, 16)
_START_S, _STOP_S = 120.0, 40.0
_CPUS_PER_NODE = 4
_OBJECT_STORE_BYTES = 200 * 2**20


def main() -> int:
    """Measure; return 1 when an answer was wrong."""
    parser = harness.argument_parser(__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="duration for each number of clients")
    parser.add_argument("--clients", type=int, nargs="*", default=_CLIENTS)
    parser.add_argument("--processes", type=int, nargs="*", default=(1, 2), help="processes of uvicorn")
    parser.add_argument("--ray-nodes", type=int, nargs="*", default=(), help="nodes of a Ray cluster on this machine")
    parser.add_argument("--kill", action="store_true", help="kill one of several processes or nodes in a further row")
    options = parser.parse_args()
    services = {f"{count} processes": _uvicorn(count) for count in options.processes}
    services |= {f"{count} Ray nodes": _ray_service(count) for count in options.ray_nodes}
    harness.print_table_head("service", "clients", "queries/s", "p50", "p95", "p99", "stage `lpo`", "refused or failed")
    failures = 0
    for name, service in services.items():
        with service as (url, kill):
            plans = max(options.clients) if name.endswith("nodes") else 1
            plan_ids = [harness.upload_example_plan(url) for _ in range(plans)]
            harness.run_load(url, plan_ids, 4, 5.0)
            for clients in options.clients:
                result = harness.run_load(url, plan_ids[:clients], clients, options.seconds)
                failures += result.failures
                print(_row(result, name, clients), flush=True)
            if options.kill and not name.startswith("1 "):
                timer = threading.Timer(0.5 * options.seconds, kill)
                timer.start()
                result = harness.run_load(url, plan_ids, max(options.clients), options.seconds)
                timer.join()
                print(_row(result, f"{name}, one killed", max(options.clients)), flush=True)
    return int(failures > 0)


def _row(result: harness.LoadResult, *cells: object) -> str:
    answered = [time_ms for times_ms in result.durations_ms.values() for time_ms in times_ms]
    times = [f"{harness.percentile(answered, percent):.0f} ms" for percent in (50, 95, 99)]
    lpo = len(result.durations_ms.get("lpo", ()))
    share = f"{lpo / max(len(answered), 1):.0%}"
    figures = (f"{len(answered) / result.seconds:.1f}", *times, share, result.refused + result.failures)
    return harness.table_row(*cells, *figures)


@contextmanager
def _uvicorn(processes: int) -> Iterator[tuple[str, Callable[[], None]]]:
    """Run the service in processes; yield its address, and how to kill one of them."""
    cores, settings = Settings.load().cores, dict(harness.UNLIMITED)
    if processes > 1:
        settings["LALALOC_WORKERS"] = str(max(cores.workers // processes, 1))
        settings["LALALOC_COMPUTE_THREADS"] = str(max(cores.compute_threads // processes, 1))
    port = _free_port()
    command = [sys.executable, "-m", "uvicorn", "service.app:app", "--port", str(port), "--log-level", "warning"]
    with tempfile.TemporaryDirectory() as data:
        environment = {**os.environ, **settings, "LALALOC_LOG_LEVEL": "error", "LALALOC_DATA_DIR": data}
        server = subprocess.Popen(
            [*command, "--workers", str(processes)], cwd=ROOT, env=environment, start_new_session=True
        )
        url = f"http://127.0.0.1:{port}"
        try:
            # The processes share the port, so only several answers in a row show that all are ready.
            harness.wait_until(lambda: all(_is_ready(url) for _ in range(10 * processes)), "it is ready", _START_S)
            # The last child is a worker; the first one tracks resources of all.
            yield url, lambda: psutil.Process(server.pid).children()[-1].kill()
        finally:
            os.killpg(server.pid, signal.SIGTERM)
            server.wait(_STOP_S)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return probe.getsockname()[1]


def _is_ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/readyz").status_code == httpx.codes.OK
    except httpx.TransportError:
        return False


@contextmanager
def _ray_service(nodes: int) -> Iterator[tuple[str, Callable[[], None]]]:
    """Run the service on nodes of Ray; yield its address, and how to kill the last of them."""
    import ray
    from ray import serve
    from ray.cluster_utils import Cluster

    from service.on_ray import RayOptions
    from service.on_ray.application import application

    # By default Ray runs replicas at a lower priority than the clients, which share their cores.
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    node: dict[str, Any] = {"num_cpus": _CPUS_PER_NODE, "object_store_memory": _OBJECT_STORE_BYTES}
    cluster = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
    try:
        others = [cluster.add_node(**node) for _ in range(nodes - 1)]
        ray.init(address=cluster.address, log_to_driver=False)
        port = _free_port()
        serve.start(http_options={"host": "127.0.0.1", "port": port})
        with tempfile.TemporaryDirectory() as data:
            settings = Settings(data_dir=Path(data), log_level="error", max_queries=64)
            replicas = {f"{name}_{end}": nodes for name in ("encoder", "search", "lpo") for end in ("min", "max")}
            serve.run(application(settings, RayOptions(ingress_max=1, **replicas)))
            yield f"http://127.0.0.1:{port}", lambda: cluster.remove_node(others[-1], allow_graceful=False)
            serve.shutdown()
    finally:
        ray.shutdown()
        cluster.shutdown()


if __name__ == "__main__":
    sys.exit(main())
