"""Directions of walls that the lines of a photograph tell, and what they tell of its heading."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from lalaloc_core.errors import InvalidFeaturesError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encode.features import FeatureEncoder, read_features
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.match import PlaceCost
from lalaloc_core.localise.query import NO_HINTS, CameraHeight, WallDirection
from lalaloc_core.localise.search.pipeline import localise
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from lalaloc_core.photograph import StatedCamera, open_photograph
from tests.core.questions import perfect_query
from tests.core.shipped import bundle, encoder, level_view
from tests.core.taken import jpeg
from tests.strategies import present

HYPOTHESES = 72


def rooms(*turned_deg: float) -> FloorPlan:
    """Return a plan of equal rooms of 4 x 3 m, each turned clockwise about its centre."""
    outline = np.array([[-2.0, -1.5], [2.0, -1.5], [2.0, 1.5], [-2.0, 1.5]])
    polygons = []
    for number, angle in enumerate(np.radians(turned_deg)):
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        polygons.append((outline @ turn + (10.0 * number, 0.0)).tolist())
    return FloorPlan.from_dict({"rooms": [{"name": str(k), "polygon": each} for k, each in enumerate(polygons)]})


def apart_deg(first: float, second: float) -> float:
    """Return the angle between two directions that repeat by a quarter turn."""
    return abs((first - second + 45.0) % 90.0 - 45.0)


@pytest.mark.parametrize(("name", "walls_deg"), [("living_room", 60.0), ("real/hotel_room", 30.0)])
def test_direction_turns_with_the_camera(name: str, walls_deg: float) -> None:
    for heading in (50.0, 75.0, 100.0, 125.0):
        walls = present(level_view(name, heading).wall_direction)
        assert apart_deg(math.degrees(walls.value) + heading, walls_deg) < 2.0
        assert walls.source == "estimated"


def test_direction_is_told_beside_a_stated_tilt() -> None:
    free = present(level_view("study", 25.0).wall_direction)
    stated = present(level_view("study", 25.0, 0.0).wall_direction)
    assert apart_deg(math.degrees(free.value), math.degrees(stated.value)) < 0.1


def test_blank_wall_tells_no_direction() -> None:
    content = jpeg(np.full((480, 640, 3), 180, np.uint8))
    for stated in (StatedCamera(hfov_deg=80.0), StatedCamera()):
        assert open_photograph(content, sphere_size=(128, 256), stated=stated).wall_direction is None


def test_walls_of_a_room_count_by_length() -> None:
    shares = rooms(0.0, 30.0).wall_directions
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, rtol=1e-6)
    assert shares[0, 0] == pytest.approx(1.0)
    assert shares[1, 30] == pytest.approx(1.0)
    # A corner that is cut off at 45 degrees.
    cut = {"name": "bay", "polygon": [[0, 0], [4, 0], [4, 2], [3, 3], [0, 3]]}
    (shares,) = FloorPlan.from_dict({"rooms": [cut]}).wall_directions
    assert shares[45] == pytest.approx(math.sqrt(2.0) / (4.0 + 2.0 + math.sqrt(2.0) + 3.0 + 3.0), rel=1e-5)


def test_headings_across_the_walls_cost_more_than_those_along_them() -> None:
    plan = rooms(0.0, 30.0)
    asked = perfect_query(encoder(), plan, (0.0, 0.0), hypotheses=HYPOTHESES)
    asked = replace(asked, wall_directions=(WallDirection(math.radians(10.0), math.radians(1.0)),))
    cost = present(PlaceCost.of(plan, asked, NO_HINTS, 1.0, np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([0, 1])))
    by_heading = cost.of_poses(np.arange(2))
    heading_deg = np.degrees(asked.roll)
    for room, turned_deg in enumerate((0.0, 30.0)):
        along = np.array([apart_deg(heading + 10.0, turned_deg) < 0.1 for heading in heading_deg])
        assert along.sum() == 4
        np.testing.assert_allclose(by_heading[room, along], 0.0, atol=1e-3)
        # Lines can be of something else, so that no heading is ruled out.
        across = np.array([apart_deg(heading + 10.0, turned_deg) > 20.0 for heading in heading_deg])
        assert ((by_heading[room, across] > 2.0) & (by_heading[room, across] < 6.0)).all()
    pairs = cost.of_pairs(np.array([0, 1]), np.array([3, 5]))
    np.testing.assert_allclose(pairs, by_heading[[0, 1], [3, 5]])
    by_pairs = by_heading.reshape(2, HYPOTHESES // 2, 2).min(axis=2)
    np.testing.assert_allclose(cost.lowest(np.arange(2), 2), by_pairs, atol=1e-6)


def test_direction_tells_a_turned_room_among_equal_ones() -> None:
    plan = rooms(0.0, 30.0)
    grid = build_grid(plan, encoder().layouts, step_m=0.5, camera_height_m=1.5, latents=False)
    # Predictions that tell nothing, at heading 0.
    asked = perfect_query(encoder(), plan, (10.0, 0.0), log_scale=3.0)
    for walls_deg, expected in ((30.0, 1), (90.0, 0)):
        told = replace(asked, wall_directions=(WallDirection(math.radians(walls_deg), math.radians(1.0)),))
        assert localise(plan, grid, encoder().layouts, told, refine="none").candidates[0].room_index == expected


def test_uncertain_directions_tell_nothing_and_several_count_by_their_mean() -> None:
    plan = rooms(0.0)
    asked = perfect_query(encoder(), plan, (0.0, 0.0), hypotheses=HYPOTHESES)

    def found(*directions: WallDirection) -> PlaceCost | None:
        told = replace(asked, wall_directions=directions)
        return PlaceCost.of(plan, told, NO_HINTS, 1.0, np.zeros((1, 2)), np.zeros(1, int))

    def cost(*directions: WallDirection) -> np.ndarray:
        return present(found(*directions)).of_poses(np.array([0]))

    assert found(WallDirection(0.0, math.radians(20.0))) is None
    exact, other = (WallDirection(math.radians(each), math.radians(1.0)) for each in (0.0, 20.0))
    np.testing.assert_allclose(cost(exact, other), (cost(exact) + cost(other)) / 2.0, rtol=1e-5)


def test_merged_plans_keep_the_directions_of_their_rooms() -> None:
    plans = [rooms(0.0), rooms(30.0, 60.0)]
    grids = [build_grid(each, encoder().layouts, step_m=1.0, camera_height_m=1.5, latents=False) for each in plans]
    merged = MergedPlans.of(plans, grids, 1.5).plan
    np.testing.assert_allclose(
        merged.wall_directions, np.concatenate([each.wall_directions for each in plans]), atol=1e-6
    )


def test_features_keep_the_direction() -> None:
    photograph = level_view("study", 25.0)
    content = FeatureEncoder(bundle(), threads=1).features(photograph)
    read, known = present(read_features(content, bundle()).wall_direction), present(photograph.wall_direction)
    assert (read.value, read.sd) == pytest.approx((known.value, known.sd))
    # Files of earlier versions have none.
    begin = content.index(b'"wall_direction"')
    end = content.index(b"}, ", begin) + 3
    earlier = content[:6] + (int.from_bytes(content[6:10], "little") - (end - begin)).to_bytes(4, "little")
    assert read_features(earlier + content[10:begin] + content[end:], bundle()).wall_direction is None
    wrong = replace(photograph, wall_direction=replace(known, value=9.0))
    with pytest.raises(InvalidFeaturesError, match="wall_direction"):
        read_features(FeatureEncoder(bundle(), threads=1).features(wrong), bundle())


def test_query_has_the_directions_of_all_photographs_of_a_spot() -> None:
    first, second = level_view("study", 0.0), level_view("study", 70.0)
    asked = encoder().query(first, None, CameraHeight(1.5), others=[(second, math.radians(70.0))])
    assert len(asked.wall_directions) == 2
    one, other = (math.degrees(each.azimuth) for each in asked.wall_directions)
    assert apart_deg(one, other) < 3.0
