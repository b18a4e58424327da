"""Small flat of three rooms, used by the tests of all formats."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from typing import Any

import pytest
import shapely
from shapely.geometry.base import BaseGeometry

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import ImportedPlan
from tests.painted import png_file

# Two rooms above a corridor, walls of 10 cm; a door to each room, a window, a column, a free-standing wall.
FLAT = {
    "name": "Flat",
    "ceiling_height_m": 2.5,
    "rooms": [
        {"name": "bedroom", "type": "bedroom", "polygon": [[0, 2], [4, 2], [4, 5], [0, 5]],
         "holes": [[[3, 4], [3.4, 4], [3.4, 4.4], [3, 4.4]]]},
        {"name": "living room", "type": "living", "polygon": [[4.1, 2], [9, 2], [9, 5], [4.1, 5]],
         "walls": [[[6.5, 3.2], [7.5, 3.2]]]},
        {"name": "corridor", "type": "corridor", "polygon": [[0, 0], [9, 0], [9, 1.9], [0, 1.9]]},
    ],
    "openings": [
        {"kind": "door", "line": [[1, 1.95], [1.9, 1.95]]},
        {"kind": "door", "line": [[5, 1.95], [5.9, 1.95]]},
        {"kind": "window", "line": [[1, 5], [2.5, 5]]},
        {"kind": "passage", "line": [[4.05, 2.5], [4.05, 3.7]]},
    ],
}  # fmt: skip


@pytest.fixture
def flat() -> FloorPlan:
    return FloorPlan.from_dict(json.loads(json.dumps(FLAT)))


# Payloads of tests of hostile files.
_SVG = '<svg xmlns="http://www.w3.org/2000/svg"><text>&x;</text></svg>'
_ENTITIES = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
NESTED_ENTITIES = f'<!DOCTYPE svg [<!ENTITY l0 "lol">{_ENTITIES}<!ENTITY x "&l9;">]>{_SVG}'.encode()
EXTERNAL_ENTITY = f'<!DOCTYPE svg [<!ENTITY x SYSTEM "file:///etc/passwd">]>{_SVG}'.encode()


def zip_file(files: Mapping[str, bytes | str]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return stream.getvalue()


def dxf_file(document: Any) -> bytes:
    """Return a document of ezdxf as the bytes of a file."""
    text = io.StringIO()
    document.write(text)
    return text.getvalue().encode()


def large_picture(side_px: int) -> bytes:
    """Return a PNG picture whose header claims a size that its data does not have."""
    return png_file(side_px, side_px, b"", colour_type=0)


ZIP_BOMB = zip_file({"unit.geojson": b" " * 3_000_000})


def shapes(document: dict) -> list[shapely.Polygon]:
    """Return the rooms of a document as polygons."""
    return [shapely.Polygon(room["polygon"], room.get("holes")) for room in document["rooms"]]


def lines(document: dict, kind: str) -> list[shapely.LineString]:
    """Return the openings of a kind as lines."""
    return [shapely.LineString(opening["line"]) for opening in document.get("openings", []) if opening["kind"] == kind]


def names_and_types(plan: ImportedPlan) -> list[tuple[str, str]]:
    return [(room["name"], room["type"]) for room in plan.document["rooms"]]


def assert_same_plan(found: ImportedPlan, expected: dict, *, within_m: float = 2e-3, shift: bool = False) -> None:
    """Compare rooms, holes and openings in any order; with `shift`, after moving the plan as a whole."""
    found_rooms, expected_rooms = shapes(found.document), shapes(expected)
    move = (0.0, 0.0)
    if shift:
        a, b = shapely.union_all(found_rooms).bounds, shapely.union_all(expected_rooms).bounds
        move = (b[0] - a[0], b[1] - a[1])

    def moved(shape: BaseGeometry) -> BaseGeometry:
        return shapely.transform(shape, lambda points: points + move)

    assert len(found_rooms) == len(expected_rooms)
    for room in expected_rooms:
        assert min(shapely.hausdorff_distance(moved(candidate), room) for candidate in found_rooms) <= within_m
    for kind in ("door", "window", "passage"):
        found_lines, true_lines = lines(found.document, kind), lines(expected, kind)
        assert len(found_lines) == len(true_lines), kind
        for line in true_lines:
            assert min(shapely.hausdorff_distance(moved(candidate), line) for candidate in found_lines) <= within_m
