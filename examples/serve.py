"""`make serve`: run the service at http://127.0.0.1:8000 with the example plan until interrupted."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from collections.abc import Sequence

from examples.launch import ServiceFailedError, running_service
from examples.truth import PLAN_PATH
from lalaloc_client import Client, ClientError, FloorPlan

_PLAN_TIMEOUT_S = 120.0
_ENVIRONMENT = {"LALALOC_KEEP_ANSWERS_S": "86400"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the service and return 0 if interrupted, else the exit status of the service."""
    parser = argparse.ArgumentParser(prog="python -m examples.serve", description=__doc__)
    parser.add_argument("--port", type=int, default=8000, help="port to listen on, 0 for a free port (default: 8000)")
    port = parser.parse_args(arguments).port
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        # Keep localisations for a day, so that links to them can be shared. Photographs are never kept.
        environment = {name: value for name, value in _ENVIRONMENT.items() if name not in os.environ}
        with running_service(port, environment) as service:
            with Client(service.url) as client:
                plan = load_example_plan(client)
            print(f"ready: {service.url} (plan '{plan.name}': {plan.id}); stop with Ctrl-C", flush=True)
            return service.process.wait()
    except KeyboardInterrupt:
        return 0
    except (ServiceFailedError, ClientError) as error:
        print(f"serve: {error}", file=sys.stderr)
        return 1


def load_example_plan(client: Client) -> FloorPlan:
    """Return the stored example plan; upload it unless a plan of the same name exists."""
    name = json.loads(PLAN_PATH.read_bytes())["name"]
    stored = next((plan.id for plan in client.floorplans(name) if plan.name == name), None)
    return client.wait_until_ready(stored or client.upload_floorplan(PLAN_PATH).id, timeout_s=_PLAN_TIMEOUT_S)


if __name__ == "__main__":
    sys.exit(main())
