"""The browser computes the same layout as the renderer."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from lalaloc_core.conventions import OPENING_CLASSES, row_elevations
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.render.profile import cast_rays, layout_depth, render_layout
from tests.service.conftest import upload
from tests.web.conftest import EXAMPLES, Visit

COLUMNS, ROWS = 96, 64
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
def poses(flat: FloorPlan) -> list[tuple[int, float, float, float]]:
    """Return poses in every room: room, x, y, heading in degrees."""
    random = np.random.default_rng(5)
    poses = []
    for index, room in enumerate(flat.rooms):
        floor = room.free_floor(0.2)
        x_min, y_min, x_max, y_max = floor.bounds
        for x, y in random.uniform((x_min, y_min), (x_max, y_max), (4, 2)):
            if floor.buffer(-1e-6).contains(type(floor.representative_point())(x, y)):
                poses.append((index, float(x), float(y), float(random.uniform(0, 360))))
    return poses


def _in_browser(desktop: Visit, flat: FloorPlan, poses: list[Any], function: str, extra: str) -> list[Any]:
    plan_id = upload(desktop.client, flat.to_dict())
    rooms = desktop.client.get(f"/floorplans/{plan_id}/layout").json()["rooms"]
    page = desktop.open()
    script = f"""async ([rooms, poses, height]) => {{
        const page = await import('/web/app.js');
        return poses.map(([room, x, y, heading]) => page.{function}({extra}));
    }}"""
    return page.evaluate(script, [rooms, poses, HEIGHT_M])


def test_view_agrees_with_the_renderer(
    desktop: Visit, flat: FloorPlan, poses: list[tuple[int, float, float, float]]
) -> None:
    call = f"{{x_m: x, y_m: y, heading_deg: heading}}, rooms[room], {COLUMNS}, height"
    seen = _in_browser(desktop, flat, poses, "layoutView", call)
    room, x, y, heading = (np.array(values) for values in zip(*poses, strict=True))
    expected = render_layout(np.stack([x, y], axis=1), np.radians(heading), room, flat.geometry, COLUMNS, HEIGHT_M)
    distance = np.array([[column["distance_m"] for column in view] for view in seen])
    np.testing.assert_allclose(distance, expected.distance_m, rtol=1e-9)
    kinds = np.array([[OPENING_CLASSES.index(column["kind"]) for column in view] for view in seen])
    assert (kinds == expected.kind).mean() > 0.999
    assert {1, 2, 3} <= set(kinds.ravel().tolist())
    ceiling = np.array([flat.rooms[room].ceiling_height_m for room, *_ in poses])
    depth = layout_depth(expected.distance_m, np.full(len(poses), HEIGHT_M), ceiling, ROWS)
    elevation = row_elevations(ROWS)[None, :, None]
    low, high = (
        np.array([[column[name] for column in view] for view in seen])[:, None, :] for name in ("floor", "ceiling")
    )
    on_wall = np.isclose(depth * np.cos(elevation), expected.distance_m[:, None, :], rtol=1e-9, atol=0.0)
    np.testing.assert_array_equal(on_wall, (elevation > low) & (elevation < high))


@pytest.mark.slow
def test_lines_follow_floor_and_ceiling(
    desktop: Visit, flat: FloorPlan, poses: list[tuple[int, float, float, float]]
) -> None:
    drawn, heights_m = _in_browser(desktop, flat, poses, "layoutLines", "x, y, rooms[room], height"), set[float]()
    for (index, x, y, _), lines in zip(poses, drawn, strict=True):
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
