"""Scans of Apple RoomPlan."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers import import_plan
from tests.importers.conftest import lines, shapes


def _surface(start: tuple[float, float], end: tuple[float, float], low_m: float, high_m: float, **members: Any) -> dict:
    """Return a surface between two points (x, z) of the scan's frame."""
    (x0, z0), (x1, z1) = start, end
    turn = math.atan2(z1 - z0, x1 - x0)
    c, s = math.cos(turn), math.sin(turn)
    centre = [0.5 * (x0 + x1), 0.5 * (low_m + high_m), 0.5 * (z0 + z1)]
    transform = [c, 0.0, s, 0.0, 0.0, 1.0, 0.0, 0.0, -s, 0.0, c, 0.0, *centre, 1.0]
    return {"dimensions": [math.dist(start, end), high_m - low_m, 0.0], "transform": transform, **members}


def _scan(story: int = 0) -> dict[str, list]:
    """Two rooms, 4 m x 3 m and 3 m x 3 m, on a floor 1.4 m below the origin."""
    corners = [(0, 0), (4, 0), (7, 0), (7, 3), (4, 3), (0, 3)]
    pairs = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 0), (1, 4)]
    lying = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, -1.0, 0.0, 0.0, 3.5, -1.4, 1.5, 1.0]
    floor = {"dimensions": [7.0, 3.0, 0.0], "transform": lying, "story": story,
             "polygonCorners": [[-3.5, -1.5, 0], [3.5, -1.5, 0], [3.5, 1.5, 0], [-3.5, 1.5, 0]]}  # fmt: skip
    return {
        "walls": [_surface(corners[a], corners[b], -1.4, 1.2, story=story) for a, b in pairs],
        "doors": [_surface((4, 1), (4, 1.9), -1.4, 0.6, story=story)],
        "windows": [_surface((1, 0), (2.5, 0), -0.5, 0.7, story=story)],
        "openings": [],
        "objects": [],
        "floors": [floor],
        "sections": [{"label": "livingRoom", "center": [2.0, -1.4, 1.5], "story": story}],
    }


def two_stories() -> bytes:
    """Return a scan of two stories, of two rooms each."""
    ground, upper = _scan(), _scan(1)
    return json.dumps({key: [*ground[key], *upper[key]] for key in ground}).encode()


def test_scan_becomes_rooms_and_openings():
    plan = import_plan(json.dumps(_scan()).encode())
    assert sorted(room.area for room in shapes(plan.document)) == pytest.approx([9.0, 12.0], rel=0.01)
    living = next(room for room in plan.document["rooms"] if room.get("type") == "living")
    # The scan's z points towards the viewer: down on the plan.
    assert min(y for _, y in living["polygon"]) == pytest.approx(-3.0, abs=0.01)
    assert plan.document["ceiling_height_m"] == pytest.approx(2.6)
    (door,), (window,) = lines(plan.document, "door"), lines(plan.document, "window")
    assert (door.length, window.length) == pytest.approx((0.9, 1.5), abs=1e-3)
    heights = [(opening.get("sill_m"), opening["head_m"]) for opening in plan.document["openings"]]
    assert sorted(heights, key=str) == [(0.9, 2.1), (None, 2.0)]
    assert plan.document["opening_kinds"] == ["door", "window", "passage"]


def test_floors_replace_walls_with_gaps():
    scan = _scan()
    scan["walls"] = [wall for wall in scan["walls"] if wall["dimensions"][0] != 4.0]
    (room,) = shapes(import_plan(json.dumps(scan).encode()).document)
    assert room.area == pytest.approx(21.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"walls": [], "floors": []}, "no walls and no floors"),
        ({"walls": [{"dimensions": [1, 2, 0], "transform": [1]}]}, "the transform of wall 0 must be 16 numbers"),
        ({"doors": 3}, "'doors' of the RoomPlan scan must be a list of objects"),
    ],
)
def test_invalid_scans_are_refused(change: dict, message: str):
    with pytest.raises(InvalidFloorPlanError, match=message):
        import_plan(json.dumps(_scan() | change).encode())
