"""A client of the service: what an application of your own would do, with nothing but httpx."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import httpx

_POLL_S = 0.2


class ServiceRefusedError(Exception):
    """The service answered with a problem (RFC 9457); the message is its own."""


class LocaliseClient:
    """The parts of the HTTP API that localising a panorama takes."""

    def __init__(self, base_url: str, *, timeout_s: float = 60.0) -> None:
        self._http = httpx.Client(base_url=base_url, timeout=timeout_s)

    def __enter__(self) -> LocaliseClient:
        return self

    def __exit__(self, *_: object) -> None:
        self._http.close()

    def is_ready(self) -> bool:
        """Whether the service is up, its model loaded and its optimisers warm."""
        try:
            return self._http.get("/readyz").status_code == httpx.codes.OK
        except httpx.TransportError:
            return False

    def floorplans(self) -> list[dict[str, Any]]:
        """The newest stored plans, in short."""
        return _content(self._http.get("/floorplans", params={"limit": 500}))["floorplans"]

    def upload_plan(self, path: Path) -> dict[str, Any]:
        """Store a plan in the native format; its latent grid is computed in the background."""
        return _content(self._http.post("/floorplans", files={"file": (path.name, path.read_bytes())}))

    def wait_for_plan(self, floorplan_id: str, *, timeout_s: float) -> dict[str, Any]:
        """The plan, once its latent grid is ready or has failed.

        Raises:
            TimeoutError: it was neither within `timeout_s`.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            plan = _content(self._http.get(f"/floorplans/{floorplan_id}"))
            if plan["status"] != "preparing":
                return plan
            if time.monotonic() > deadline:
                raise TimeoutError(f"plan {floorplan_id} is still preparing after {timeout_s:g} s")
            time.sleep(_POLL_S)

    def localise(
        self,
        floorplan_id: str,
        panorama: Path,
        *,
        heading_deg: float | None = None,
        heading_tolerance_deg: float | None = None,
        camera_height_m: float | None = None,
    ) -> dict[str, Any]:
        """Where in the plan the panorama was taken.

        Args:
            heading_deg: azimuth of the picture's centre column; None when unknown, then it is found as well.
            heading_tolerance_deg: how far off that may be, up to 45; None when it is exact.
            camera_height_m: None stands for the plan's own.
        """
        fields: dict[str, Any] = {"floorplan_id": floorplan_id}
        optional = {
            "heading_deg": heading_deg,
            "heading_tolerance_deg": heading_tolerance_deg,
            "camera_height_m": camera_height_m,
        }
        fields |= {name: value for name, value in optional.items() if value is not None}
        picture = {"panorama": (panorama.name, panorama.read_bytes())}
        return _content(self._http.post("/localise", data=fields, files=picture))


def _content(response: httpx.Response) -> dict[str, Any]:
    """The JSON of an answer.

    Raises:
        ServiceRefusedError: the answer is an error.
    """
    if response.is_error:
        raise ServiceRefusedError(f"{response.status_code} {response.text.strip()}")
    return response.json()
