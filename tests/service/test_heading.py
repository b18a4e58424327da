"""Source of a query's heading: request, compass or search."""

from __future__ import annotations

import io
from collections.abc import Iterator

import httpx
import pytest
from PIL import Image

from tests.core.test_photo_sphere import xmp
from tests.painted import picture_file
from tests.service.conftest import FLAT, StartApp, encode_picture, localise, upload

NORTH_DEG = 30.0


def with_packet(**properties: object) -> bytes:
    picture = Image.open(io.BytesIO(encode_picture(512, 256, "PNG")))
    return picture_file(picture, "WEBP", lossless=True, xmp=xmp(**properties))


@pytest.fixture(scope="module")
def compass_client(start_app: StartApp, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    with start_app(tmp_path_factory.mktemp("data"), compass_tolerance_deg=15.0) as started:
        yield started


@pytest.fixture(scope="module")
def north(compass_client: httpx.Client) -> str:
    return upload(compass_client, FLAT | {"north_deg": NORTH_DEG})


def poses(response: httpx.Response) -> tuple[str, list[object]]:
    assert response.status_code == 200, response.text
    answer = response.json()
    return answer["heading_source"], [
        (candidate["position"], candidate["heading_deg"]) for candidate in answer["candidates"]
    ]


@pytest.mark.parametrize("compass_deg", [0.0, 100.0, 345.0])
def test_compass_is_used_if_north_is_known(compass_client: httpx.Client, north: str, compass_deg: float) -> None:
    picture = with_packet(PoseHeadingDegrees=compass_deg)
    source, found = poses(localise(compass_client, north, picture, refine="none"))
    assert source == "photograph"
    heading_deg = (compass_deg + NORTH_DEG) % 360.0
    given = localise(compass_client, north, picture, refine="none", heading_deg=heading_deg, heading_tolerance_deg=15)
    assert poses(given) == ("given", found)


def test_requested_heading_takes_precedence(compass_client: httpx.Client, north: str) -> None:
    fields = {"refine": "none", "heading_deg": 200}
    with_compass = poses(localise(compass_client, north, with_packet(PoseHeadingDegrees=10), **fields))
    assert with_compass[0] == "given"
    assert with_compass == poses(localise(compass_client, north, with_packet(), **fields))


@pytest.mark.parametrize("properties", [{}, {"PoseHeadingDegrees": 400}, {"InitialViewHeadingDegrees": 90}])
def test_heading_is_searched_without_a_compass(
    compass_client: httpx.Client, north: str, properties: dict[str, object]
) -> None:
    assert poses(localise(compass_client, north, with_packet(**properties), refine="none"))[0] == "searched"


def test_heading_is_searched_without_north(compass_client: httpx.Client) -> None:
    plan_id = upload(compass_client)
    with_compass = poses(localise(compass_client, plan_id, with_packet(PoseHeadingDegrees=10), refine="none"))
    assert with_compass[0] == "searched"
    assert with_compass == poses(localise(compass_client, plan_id, with_packet(), refine="none"))
