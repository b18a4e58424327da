"""Content of requests, and the generated files of the package."""

from __future__ import annotations

import base64
import io
import json
from typing import Any

import pytest
from PIL import Image

from lalaloc_client import AsyncClient, Client
from scripts.generate_client import generated_files
from tests.client.conftest import FailingServer, Planned

GEOPOSE: dict[str, Any] = {
    "id": "1",
    "timestamp": 1,
    "type": "geopose",
    "accuracy": {"position": 0.1, "orientation": 1.0},
    "geopose": {"position": {"lat": 0.0, "lon": 0.0, "h": 0.0}, "quaternion": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}},
    "lalaloc": {
        "floorplan_id": "p",
        "level": None,
        "position": {"x_m": 1.0, "y_m": 2.0},
        "heading_deg": 0.0,
        "room": "hall",
        "room_id": "hall",
        "confidence": None,
        "warnings": [],
    },
}


def test_blocking_client_is_up_to_date() -> None:
    stale = [path.name for path, text in generated_files().items() if path.read_text(encoding="utf-8") != text]
    assert stale == [], "run `make client`"


def test_clients_have_the_same_methods() -> None:
    assert [name for name in vars(Client) if name[0] != "_"] == [name for name in vars(AsyncClient) if name[0] != "_"]


@pytest.mark.parametrize(("file_format", "expected"), [("JPEG", "JPG"), ("PNG", "PNG"), ("WEBP", "WEBP")])
def test_geopose_names_the_image_format(failing: FailingServer, file_format: str, expected: str) -> None:
    buffer = io.BytesIO()
    Image.new("RGB", (8, 4)).save(buffer, file_format)
    failing.plan = [Planned(200, GEOPOSE)]
    with Client(failing.url) as client:
        client.geopose(buffer.getvalue(), floorplan_id="p")
    (reading,) = json.loads(failing.requests[0].body)["sensorReadings"]["cameraReadings"]
    assert reading["imageFormat"] == expected
    assert base64.b64decode(reading["imageBytes"]) == buffer.getvalue()


def test_geopose_rejects_other_files(failing: FailingServer) -> None:
    with Client(failing.url) as client, pytest.raises(ValueError, match="must be a JPEG, PNG or WebP file"):
        client.geopose(b"GIF89a", floorplan_id="p")
