"""Clients of load tests, run by locust: one tenant with correct requests, and one that keeps the service busy.

`harness.run_load` runs it for the benchmarks. By hand, with a plan that is ready:

    locust -f benchmarks/locustfile.py --host http://127.0.0.1:8000 --plan-ids ID TenantUser

Successful requests are counted under the stage that answered ("lpo", "vdr"), refusals with `Retry-After` under
"refused"; every other answer is a failure.
"""

from __future__ import annotations

import math
import random
import sys
import time
from argparse import ArgumentParser
from itertools import cycle, islice
from pathlib import Path
from typing import Any, cast

from locust import HttpUser, events, task
from locust.clients import ResponseContextManager
from locust.env import Environment
from requests.adapters import HTTPAdapter

from examples.truth import PLAN_PATH, read_poses

# A position error above this is a wrong answer: the example panoramas are located to a few centimetres.
MAX_ERROR_M = 0.5
REFUSALS = (429, 503)


@events.init_command_line_parser.add_listener
def add_arguments(parser: ArgumentParser) -> None:
    """Add the options of both users."""
    parser.add_argument(
        "--plan-ids", required=True, help="plans to localise in, comma-separated; each client takes one"
    )
    parser.add_argument("--pause", type=float, default=1.0, help="seconds to wait after a refusal, ± 50 %%")
    parser.add_argument("--picture", default="", help="file that BusyUser sends as its panorama")
    parser.add_argument("--source-address", default="", help="local address of BusyUser, its tenant without API keys")


@events.quitting.add_listener
def print_failures(environment: Environment, **_arguments: object) -> None:
    """Print every kind of failure and its number."""
    for failure in environment.stats.errors.values():
        print(f"{failure.occurrences} times: {failure.error}", file=sys.stderr)


class TenantUser(HttpUser):
    """Client that localises the example panoramas one after the other and checks the answers."""

    started = 0

    def on_start(self) -> None:
        """Choose the client's plan and first panorama."""
        plan_ids = self.environment.parsed_options.plan_ids.split(",")
        queries = [(pose, pose.picture.read_bytes()) for pose in read_poses()]
        self._plan_id = plan_ids[TenantUser.started % len(plan_ids)]
        self._queries = islice(cycle(queries), TenantUser.started % len(queries), None)
        TenantUser.started += 1

    @task
    def localise(self) -> None:
        """Send one panorama with its heading and camera height."""
        pose, picture = next(self._queries)
        fields = {
            "floorplan_id": self._plan_id,
            "heading_deg": f"{pose.heading_deg}",
            "camera_height_m": f"{pose.camera_height_m}",
        }
        files = {"panorama": (pose.file, picture)}
        with self.client.post("/localise", data=fields, files=files, catch_response=True, timeout=60.0) as response:
            refused = response.status_code in REFUSALS and response.headers.get("retry-after", "").isdecimal()
            if refused:
                _rename(response, "refused")
                response.success()
            elif response.status_code != 200:
                response.failure(f"status {response.status_code}: {response.text and response.text[:200]}")
            else:
                answer = response.json()
                _rename(response, answer["stage"])
                position = answer["position"]
                error_m = math.dist((position["x_m"], position["y_m"]), (pose.x_m, pose.y_m))
                if error_m > MAX_ERROR_M:
                    response.failure(f"{pose.file}: {error_m:.2f} m off at stage {answer['stage']}")
        if refused:
            time.sleep(self.environment.parsed_options.pause * random.uniform(0.5, 1.5))


def _rename(response: ResponseContextManager, name: str) -> None:
    """Choose the entry of the statistics that a request is counted under."""
    cast(dict[str, Any], response.request_meta)["name"] = name


class BusyUser(HttpUser):
    """Client of another tenant that repeats one expensive request and retries early."""

    def on_start(self) -> None:
        """Read the picture and bind to the tenant's address."""
        options = self.environment.parsed_options
        self._picture = Path(options.picture).read_bytes() if options.picture else PLAN_PATH.read_bytes()
        self._plan_id = options.plan_ids.split(",")[0]
        self.client.mount("http://", _BoundAdapter(options.source_address))

    @task
    def localise(self) -> None:
        """Send the picture without a heading."""
        form, files = {"floorplan_id": self._plan_id}, {"panorama": ("p", self._picture)}
        with self.client.post("/localise", data=form, files=files, catch_response=True, timeout=60.0) as response:
            response.success()
        if response.status_code in REFUSALS:
            time.sleep(0.05)


class _BoundAdapter(HTTPAdapter):
    """Connections from one local address."""

    def __init__(self, address: str) -> None:
        self._address = address
        super().__init__()

    def init_poolmanager(self, *arguments: object, **options: object) -> None:
        super().init_poolmanager(*arguments, source_address=(self._address, 0), **options)  # type: ignore[arg-type]
