"""Queries per second of the service on Ray, by number of nodes, each of them a Ray node of its own on this machine.

    python -m benchmarks.on_ray --seconds 20

Prints a Markdown table, whose first rows, of no node, are the plain service. Every client asks about a plan of its own.
On one node there is one replica that searches, one encoder and one optimiser, on two nodes there are two of each; the
ingress is on the first. All of them share the cores of this machine, so what is measured is what being apart costs, not
what more machines gain. Needs the extra `ray`.
"""

from __future__ import annotations

import argparse
import os
import socket
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import ray
from ray import serve
from ray.cluster_utils import Cluster

from benchmarks.load import Load, Reply, ask_for, faults, per_second, percentiles_ms, upload_example_plan
from benchmarks.throughput import under_uvicorn
from service.on_ray import RayOptions
from service.on_ray.application import application
from service.settings import Settings

_NODES = (0, 1, 2)
_CLIENTS = (1, 2, 4, 8)
# A processor for each replica of a node, whatever there is.
_PROCESSORS_OF_A_NODE = 4
_OBJECT_STORE_BYTES = 200 * 2**20


def main() -> int:
    """Run; 1 when an answer was wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="for each number of clients")
    parser.add_argument("--clients", type=int, nargs="*", default=_CLIENTS)
    parser.add_argument("--nodes", type=int, nargs="*", default=_NODES)
    options = parser.parse_args()
    print("| nodes | clients | queries/s | p50 | p95 | p99 | at `lpo` | refused or wrong |", flush=True)
    print("|---|---|---|---|---|---|---|---|", flush=True)
    wrong = 0
    for nodes in options.nodes:
        # Nobody is refused: what is measured is how requests wait for each other.
        alone = {"LALALOC_LOG_LEVEL": "error", "LALALOC_MAX_QUERIES": "64", "LALALOC_LPO_QUEUE": "64"}
        with on_nodes(nodes) if nodes else under_uvicorn(1, alone) as url:
            plans = [upload_example_plan(url) for _ in range(max(options.clients))]
            _ask(url, plans, 5.0)
            for clients in options.clients:
                replies = _ask(url, plans[:clients], options.seconds)
                took = percentiles_ms([reply for reply in replies if reply.answered])
                bad = sum(not reply.answered or reply.fault is not None for reply in replies)
                wrong += sum(faults(replies).values())
                lpo = sum(reply.stage == "lpo" for reply in replies) / len(replies)
                times = " | ".join(f"{took.get(q, float('nan')):.0f} ms" for q in ("p50", "p95", "p99"))
                print(f"| {nodes} | {clients} | {per_second(replies):.1f} | {times} | {lpo:.0%} | {bad} |", flush=True)
    return int(bool(wrong))


def _ask(url: str, plans: list[str], seconds: float) -> list[Reply]:
    """One client for each plan."""
    with ThreadPoolExecutor(len(plans)) as threads:
        replies = threads.map(partial(ask_for, url, load=Load(1, seconds)), plans)
        return [reply for of_one in replies for reply in of_one]


@contextmanager
def on_nodes(nodes: int) -> Iterator[str]:
    """The service on a cluster of so many nodes, with one SQLite database; gives its address."""
    # Replicas would come after the clients otherwise, which they share the cores with.
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    node: dict[str, Any] = {"num_cpus": _PROCESSORS_OF_A_NODE, "object_store_memory": _OBJECT_STORE_BYTES}
    cluster = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
    try:
        for _ in range(nodes - 1):
            cluster.add_node(**node)
        ray.init(address=cluster.address, log_to_driver=False)
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        serve.start(http_options={"host": "127.0.0.1", "port": port})
        with tempfile.TemporaryDirectory() as data:
            settings = Settings(data_dir=Path(data), log_level="error", max_queries=64, lpo_queue=64)
            each = {f"{name}_{end}": nodes for name in ("encoder", "search", "lpo") for end in ("min", "max")}
            serve.run(application(settings, RayOptions(ingress_max=1, **each)))
            yield f"http://127.0.0.1:{port}"
            serve.shutdown()
    finally:
        ray.shutdown()
        cluster.shutdown()


if __name__ == "__main__":
    sys.exit(main())
