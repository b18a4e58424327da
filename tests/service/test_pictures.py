"""Answers drawn as pictures: `POST /localise` with an image type in `Accept`."""

from __future__ import annotations

import io
from typing import Any
from xml.etree import ElementTree

import httpx
import numpy as np
import pytest
from PIL import Image
from starlette.requests import Request

from lalaloc_client import Client
from service.http.representations import preferred
from tests.service.conftest import assert_problem

JSON, PNG, SVG = "application/json", "image/png", "image/svg+xml"


def request_picture(
    client: httpx.Client, plan_id: str, photograph: bytes, accept: str, query: str = "", **headers: str
) -> httpx.Response:
    data = {"floorplan_id": plan_id, "heading_deg": "30", "refine": "vdr"}
    files: dict[str, Any] = {"photo": ("p.jpg", photograph, "image/jpeg")}
    return client.post(f"/localise{query}", data=data, files=files, headers={"Accept": accept} | headers)


# By default, a picture shows both.
@pytest.mark.parametrize("query", ["?picture=plan", "?picture=photograph", "?picture=both", ""])
def test_answer_is_drawn_as_svg(client: httpx.Client, flat: str, sphere: bytes, query: str) -> None:
    answer = request_picture(client, flat, sphere, JSON).json()
    response = request_picture(client, flat, sphere, SVG, query)
    assert response.status_code == 200, response.text
    assert response.headers["content-type"].split(";")[0] == SVG
    assert "Accept" in response.headers["vary"]
    assert "default-src 'none'" in response.headers["content-security-policy"]
    root = ElementTree.fromstring(response.text)
    words = " ".join(root.itertext())
    assert f"x {answer['position']['x_m']:.2f} m" in words
    assert "heading 30.0° (given)" in words
    classes = {element.get("class") for element in root.iter()}
    assert ("layout" in classes) == (query != "?picture=plan")
    assert ("camera" in classes) == (query != "?picture=photograph")
    hrefs = [value for element in root.iter() for name, value in element.items() if name.endswith("href")]
    assert hrefs
    assert all(href.startswith("data:image/") for href in hrefs), "nothing is loaded from elsewhere"


def test_png_contains_the_photograph(client: httpx.Client, flat: str, sphere: bytes) -> None:
    response = request_picture(client, flat, sphere, PNG, "?picture=photograph")
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == PNG
    with Image.open(io.BytesIO(response.content)) as drawn, Image.open(io.BytesIO(sphere)) as sent:
        assert drawn.width == 1600
        # Upper part of the photograph, without lines.
        inside = np.asarray(drawn.convert("RGB").crop((36, 104, 36 + 1528, 104 + 150)).resize((64, 8))).astype(float)
        above = np.asarray(sent.convert("RGB").crop((0, 0, 512, 50)).resize((64, 8))).astype(float)
    assert np.abs(inside - above).mean() < 6.0


def test_problems_are_json(client: httpx.Client, flat: str, sphere: bytes) -> None:
    assert_problem(request_picture(client, flat, b"no picture", PNG), 422, "invalid-photograph")
    assert_problem(request_picture(client, "0" * 32, sphere, PNG), 404, "unknown-floorplan")
    problem = assert_problem(request_picture(client, flat, sphere, PNG, "?picture=mesh"), 422, "invalid-request")
    assert problem["errors"][0]["field"] == "picture"
    problem = assert_problem(request_picture(client, flat, sphere, JSON, "?picture=plan"), 422, "invalid-request")
    assert "Accept: image/png" in problem["errors"][0]["message"]
    keyed = request_picture(client, flat, sphere, PNG, **{"Idempotency-Key": "one"})
    problem = assert_problem(keyed, 422, "invalid-request")
    assert problem["errors"][0]["field"] == "Idempotency-Key"


def test_client_requests_pictures(client: httpx.Client, flat: str, sphere: bytes) -> None:
    with Client(str(client.base_url)) as service:
        svg = service.picture(flat, sphere, "plan", picture_format="svg", heading_deg=30.0, refine="none")
        assert svg.startswith(b"<svg")
        with pytest.raises(ValueError, match="'gif'"):
            service.picture(flat, sphere, picture_format="gif")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("accept", "expected"),
    [
        (None, JSON),
        ("*/*", JSON),
        ("text/html", JSON),
        ("image/png", PNG),
        ("IMAGE/PNG", PNG),
        ("image/*", PNG),
        ("image/svg+xml, image/png;q=0.5", SVG),
        ("image/svg+xml;q=0.2, image/png;q=0.5", PNG),
        ("application/json, image/png", JSON),
        ("image/png, */*;q=0.1", PNG),
        ("image/png;q=0, */*", JSON),
        ("image/*, application/json;q=0.9, image/png;q=0.1", SVG),
        ("image/png;q=nonsense, image/svg+xml", SVG),
        (" , ;q=1,,", JSON),
    ],
)
def test_accept_header_selects_the_representation(accept: str | None, expected: str) -> None:
    headers = [] if accept is None else [(b"accept", accept.encode())]
    assert preferred(Request({"type": "http", "headers": headers}), (JSON, PNG, SVG)) == expected
