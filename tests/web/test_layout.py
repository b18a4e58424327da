"""The browser computes the same layout as the renderer."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.render.profile import cast_rays
from tests.service.conftest import upload
from tests.web.conftest import EXAMPLES, Visit

HEIGHT_M = 1.37


@pytest.fixture(scope="module")
def flat() -> FloorPlan:
    """Return the example flat with a column and a stub of wall in its largest room, and a door of unknown height."""
    plan = FloorPlan.from_json((EXAMPLES / "flat.json").read_bytes()).to_dict()
    plan["name"] = "Flat with a column"
    plan["rooms"][0]["holes"] = [[[2.5, 1.0], [3.0, 1.0], [3.0, 1.4], [2.5, 1.4]]]
    plan["rooms"][0]["walls"] = [[[1.2, 3.0], [1.9, 3.6]]]
    plan["openings"][0] |= {"sill_m": None, "head_m": None}
    return FloorPlan.from_dict(plan)


@pytest.fixture(scope="module")
def positions(flat: FloorPlan) -> list[tuple[int, float, float]]:
    """Return positions in every room: room, x, y."""
    random = np.random.default_rng(5)
    positions = []
    for index, room in enumerate(flat.rooms):
        floor = room.free_floor(0.2)
        x_min, y_min, x_max, y_max = floor.bounds
        for x, y in random.uniform((x_min, y_min), (x_max, y_max), (4, 2)):
            if floor.buffer(-1e-6).contains(type(floor.representative_point())(x, y)):
                positions.append((index, float(x), float(y)))
    return positions


def test_lines_follow_floor_ceiling_and_doors(
    desktop: Visit, flat: FloorPlan, positions: list[tuple[int, float, float]]
) -> None:
    plan_id = upload(desktop.client, flat.to_dict())
    rooms = desktop.client.get(f"/floorplans/{plan_id}/layout").json()["rooms"]
    script = """async ([rooms, positions, height]) => {
        const { layoutLines } = await import('/web/app.js');
        return positions.map(([room, x, y]) => layoutLines(x, y, rooms[room], height));
    }"""
    drawn = desktop.open().evaluate(script, [rooms, positions, HEIGHT_M])
    heights_m = set[float]()
    for (index, x, y), lines in zip(positions, drawn, strict=True):
        room = flat.rooms[index]
        along = [
            line["points"] for line in lines if line["kind"] == "edge" and line["points"][0][0] != line["points"][-1][0]
        ]
        # Ends lie in corners, where a ray can meet either wall.
        points = np.array([point for line in along for point in line[1:-1]])
        distance = cast_rays(np.array([[x, y]]), points[None, :, 0], room.walls_m[None])[0]
        bounds = np.arctan2([[-HEIGHT_M], [room.ceiling_height_m - HEIGHT_M]], distance)
        assert np.abs(bounds - points[None, :, 1]).min(axis=0).max() < 1e-9
        # The lines of floor and ceiling go around once.
        spans = [line[-1][0] - line[0][0] for line in along]
        assert sum(spans) == pytest.approx(2 * 2 * math.pi, abs=1e-6)
        door = np.array([point for line in lines if line["kind"] == "door" for point in line["points"]]).reshape(-1, 2)
        away_m = cast_rays(np.array([[x, y]]), door[None, :, 0], room.walls_m[None])[0]
        heights_m |= set(np.round(HEIGHT_M + np.tan(door[:, 1]) * away_m, 3).tolist())
    # Doors end at their height, or at the usual one.
    assert {2.02, 2.05} <= heights_m
    assert not heights_m & {2.4, 2.6}
