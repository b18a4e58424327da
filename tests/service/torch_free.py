"""Program that a test runs in its own process: localise with LPO, then list the modules that the service has loaded."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import httpx

from service.app import create_app
from service.settings import Settings
from tests.service.conftest import encode_picture, localise, serve, upload, wait_for


def main(bundle: str, data_dir: str) -> None:
    """Print the answer's stage and the names of all loaded top-level modules."""
    app = create_app(Settings(bundle=Path(bundle), data_dir=Path(data_dir), lpo_deadline_s=9.0, log_level="error"))
    with serve(app) as base_url, httpx.Client(base_url=base_url, timeout=30.0) as client:
        wait_for(lambda: client.get("/readyz").status_code == 200, 120.0)
        plan_id = upload(client)
        stage = localise(client, plan_id, encode_picture(256, 128, "PNG"), refine="lpo").json()["stage"]
        client.get(f"/floorplans/{plan_id}/mesh.glb").raise_for_status()
        client.get(f"/floorplans/{plan_id}/preview.svg").raise_for_status()
    print(json.dumps({"stage": stage, "modules": sorted({name.partition(".")[0] for name in sys.modules})}))


if __name__ == "__main__":
    main(*sys.argv[1:])
