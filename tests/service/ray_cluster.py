"""Ray cluster on this machine for the tests, and the service as an application on it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from service.settings import Settings
from tests.local_servers import free_port

# One replica each, but several that search, so that requests are routed, and two shards of the index of venues.
REPLICAS = {"ingress_max": 1, "encoder_max": 1, "search_min": 2, "search_max": 2, "lpo_max": 1, "index_shards": 2}
NAME = "lalaloc"
# More CPUs than the machine has, because several replicas share one here.
_PROCESSORS = 8
_OBJECT_STORE_BYTES = 200 * 2**20
_ATTEMPTS = 3


@contextmanager
def ray_cluster() -> Iterator[str]:
    """Run a cluster of one node with Ray Serve, and yield the address of its proxy."""
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install -c constraints.txt -e '.[ray]'")
    from ray import serve

    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # Otherwise replicas run at a lower priority than other processes.
    os.environ.setdefault("RAY_worker_niceness", "0")
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            ray.init(
                num_cpus=_PROCESSORS,
                include_dashboard=False,
                log_to_driver=False,
                object_store_memory=_OBJECT_STORE_BYTES,
            )
            break
        except Exception:
            # Ray's fixed limit of half a minute for starting a node is too short on a busy machine.
            ray.shutdown()
            if attempt == _ATTEMPTS:
                raise
    try:
        port = free_port()
        serve.start(http_options={"host": "127.0.0.1", "port": port})
        yield f"http://127.0.0.1:{port}"
        serve.shutdown()
    finally:
        ray.shutdown()


@contextmanager
def serving(settings: Settings) -> Iterator[None]:
    """Run the service on the cluster; one at a time."""
    from ray import serve

    from service.on_ray import RayOptions
    from service.on_ray.application import application

    if NAME in serve.status().applications:
        pytest.skip("about two applications at a time, and there is one on Ray")
    serve.run(application(settings, RayOptions(**REPLICAS)), name=NAME, route_prefix="/")
    try:
        yield
    finally:
        serve.delete(NAME)
