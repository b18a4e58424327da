"""Refusals of every route, in the words of users: no addresses of objects, names of libraries or tracebacks."""

from __future__ import annotations

import json
import re
from typing import Any

import httpx
import pytest

from tests.core.fault_photographs import LIBRARY_WORDS
from tests.core.taken import EXAMPLES
from tests.service.conftest import FLAT, upload

KITCHEN = (EXAMPLES / "kitchen.jpg").read_bytes()
DIGITS = "9" * 4400
# Bodies by media type that no route can use, damaged in ways that parsers notice in their own words.
BODIES: list[tuple[str, bytes]] = [
    ("application/json", b""),
    ("application/json", b"{"),
    ("application/json", b"\xff\xfe"),
    ("application/json", b"[" * 5000),
    ("application/json", b'{"rooms": [{"polygon": [[0, 0], [1e308, 0], [1e309, 1]]}]}'),
    ("application/json", f'{{"bytes": {DIGITS}}}'.encode()),
    ("application/json", b'{"name": "\\ud800", "floorplan_id": "\\u0000"}'),
    ("application/json", json.dumps(FLAT | {"rooms": "none"}).encode()),
    ("application/merge-patch+json", b"{"),
    ("application/xml", b"<a><b></a>"),
    ("text/plain", b"plan"),
    ("image/jpeg", KITCHEN[:300]),
    ("multipart/form-data; boundary=b", b"--b\r\nContent-Disposition: form-data\r\n\r\n--b--"),
    ("multipart/form-data", b"--b--"),
]
# Files that claim a format and are damaged behind their first bytes.
FILES: dict[str, bytes] = {
    "plan.dxf": b"0\nSECTION\n2\nENTITIES\n0\nLINE\n10\nx\n0\nEOF\n",
    "plan.ifc": b"ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\n#1=IFCSPACE(#1);\nENDSEC;",
    "plan.pdf": b"%PDF-1.7\n1 0 obj\n<< /Type /Catalog >>\nxref\n",
    "plan.svg": b"<svg xmlns='http://www.w3.org/2000/svg'><path d='M 0 0 L nan 1'/></svg>",
    "plan.gml": b"<core:IndoorFeatures xmlns:core='http://www.opengis.net/indoorgml/1.0/core'>",
    "plan.osm": b"<osm><node id='1' lat='nan' lon='0'/></osm>",
    "plan.yaml": b"image: &a plan.png\nresolution: *a\n",
    "plan.zip": b"PK\x03\x04" + bytes(60),
    "plan.geojson": b'{"type": "FeatureCollection", "features": [{"geometry": {"type": "Polygon", "coordinates": 1}}]}',
    "plan.png": b"\x89PNG\r\n\x1a\n" + bytes(80),
    "plan.jpg": KITCHEN[:3000],
    "plan.webp": b"RIFF\x00\x00\x00\x00WEBPVP8 " + bytes(40),
    "plan.tiff": b"II*\0" + bytes(80),
}
APP_SETTINGS = {"bundle": "tiny_view_bundle"}


@pytest.fixture(scope="module")
def ids(client: httpx.Client) -> dict[str, str]:
    plan_id = upload(client)
    session = client.post("/sessions", json={"floorplan_id": plan_id}).json()["id"]
    venue_id = client.post("/venues", json={"name": "12 Mill Lane"}).json()["id"]
    names = {"file": "manifest.json", "answer_id": "a", "key_id": "k", "tenant": "t"}
    names |= {"album_id": "a", "photograph_id": "p"}
    return {"floorplan_id": plan_id, "venue_id": venue_id, "session_id": session, **names}


def operations(client: httpx.Client, *methods: str, media: str = "") -> list[tuple[str, str]]:
    """Return the operations of some methods, or those whose body can be of a media type."""
    paths: dict[str, Any] = client.get("/openapi.json").json()["paths"]
    of_methods = [(method, path) for path, known in paths.items() for method in known if method in methods]
    return [(method.upper(), path) for method, path in of_methods if media in str(paths[path][method])]


def check(response: httpx.Response) -> None:
    """Check that an answer is no failure of the service, and a refusal has no words of libraries."""
    asked = f"{response.request.method} {response.request.url}: {response.text[:500]}"
    assert response.status_code < 500 or response.status_code == 501, asked
    if response.status_code >= 400:
        assert not any(word in response.text for word in LIBRARY_WORDS), asked
        assert not re.search(r"<[\w.]+ object|\bline \d+, in |\b[A-Z]\w+Error\b|site-packages|\.py\b", response.text), (
            asked
        )


def test_bodies_that_no_route_can_use(client: httpx.Client, ids: dict[str, str]) -> None:
    refused = 0
    routes = operations(client, "post", "put", "patch")
    assert len(routes) >= 12
    for method, path in routes:
        for media_type, body in BODIES:
            response = client.request(method, path.format(**ids), content=body, headers={"Content-Type": media_type})
            check(response)
            refused += response.status_code >= 400
    assert refused > 10 * len(routes)


@pytest.mark.parametrize("name", FILES)
def test_damaged_files_in_every_form(client: httpx.Client, ids: dict[str, str], name: str) -> None:
    statuses = set[int]()
    for method, path in operations(client, "post", "put", "patch", media="multipart/form-data"):
        for part in ("file", "photo", "features", "film"):
            data = {"floorplan_id": ids["floorplan_id"], "top_k": "one", "heading_deg": "nan"} if part != "file" else {}
            for fields in (data, {"floorplan_id": ids["floorplan_id"]}):
                response = client.request(method, path.format(**ids), data=fields, files={part: (name, FILES[name])})
                check(response)
                statuses.add(response.status_code)
    assert 422 in statuses


def test_ids_and_queries_that_nothing_has(client: httpx.Client, ids: dict[str, str]) -> None:
    strange = ("none", "\u00e9", "a" * 300, "%00", "..%2f", DIGITS)
    for method, path in operations(client, "get", "put", "patch", "post", "delete"):
        if "{" in path:
            for text in strange:
                check(client.request(method, re.sub(r"\{\w+\}", text, path)))
        if method == "GET" and not path.endswith("/events"):
            for query in ("level=nan", f"limit={DIGITS}", "step_m=1e999", "coarse=%ff", "format=%00", "at=x&at=y"):
                check(client.get(f"{path.format(**ids)}?{query}"))
