"""The sweep renderer against the renderer that casts every ray at every wall."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.synth.homes.buildings import building_of
from lalaloc_core.learn.synth.homes.splits import VALIDATION
from lalaloc_core.render.layout import layout_view
from lalaloc_core.render.profile import wall_profile
from lalaloc_core.render.sampling import PoseSet, pose_grid, random_poses
from lalaloc_core.render.sweep import SweptViews, profiles_at, swept_views
from tests.strategies import plan_document, plan_of, rectangle, rows_of_rooms, seeds, spiral

COLUMNS, EYE_M = 64, 1.5


def full_behind_m(view: SweptViews) -> np.ndarray:
    """Return the distances behind openings in the form of `LayoutView`: the wall's distance for other rays."""
    behind_m = view.distance_m.copy()
    behind_m[view.row, view.column] = view.behind_m
    return behind_m


def assert_the_same(plan: FloorPlan, poses: PoseSet, heading: np.ndarray, misses: float = 0.0) -> None:
    """Check that both renderers agree on all rays but a share `misses` that graze a corner, where rounding decides."""
    swept = swept_views(poses.position_m, heading, poses.room_index, plan.wall_table, COLUMNS, EYE_M)
    cast = layout_view(poses.position_m, heading, poses.room_index, plan.geometry, COLUMNS, EYE_M)
    differs = ~np.isclose(swept.distance_m, cast.distance_m, rtol=1e-4) | (swept.kind != cast.kind)
    differs |= ~np.isclose(full_behind_m(swept), cast.behind_m, rtol=1e-3)
    assert differs.mean() <= misses
    assert (np.diff(swept.row) >= 0).all()


@settings(max_examples=25, deadline=None)
@given(rows_of_rooms(), seeds())
def test_sweep_matches_cast_in_rows_of_rooms(plan: FloorPlan, seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = random_poses(plan, 6, rng, 0.1)
    assert_the_same(plan, poses, rng.uniform(-math.pi, math.pi, 6), misses=2 / (6 * COLUMNS))


@pytest.mark.parametrize("turned", [False, True])
def test_sweep_matches_cast_in_a_building(turned: bool) -> None:
    plan = building_of(VALIDATION, 0, 2300.0, hall_share=0.8).plan
    assert max(len(room.walls_m) for room in plan.rooms) > 100
    every = pose_grid(plan, 1.0)
    rng = np.random.default_rng(0)
    some = np.sort(rng.permutation(len(every))[:300])
    heading = rng.uniform(-4.0, 4.0, len(some)) if turned else np.full(len(some), 0.3)
    poses = PoseSet(every.position_m[some], every.room_index[some])
    assert_the_same(plan, poses, heading, misses=1e-3)


def test_free_standing_walls_have_two_sides() -> None:
    document = plan_document(rectangle(8.0, 6.0))
    document["rooms"][0]["walls"] = [[[3.0, 1.0], [3.0, 5.0]], [[5.0, 2.0], [6.0, 4.0]]]
    document["openings"] = [{"kind": "passage", "line": [[3.0, 2.0], [3.0, 3.0]]}]
    plan = FloorPlan.from_dict(document)
    poses = pose_grid(plan, 0.7)
    assert_the_same(plan, poses, np.zeros(len(poses)), misses=1e-3)
    assert len(swept_views(poses.position_m, np.zeros(len(poses)), poses.room_index, plan.wall_table, 64, 1.5).row)


@pytest.mark.parametrize("origin_m", [(0.0, 0.0), (4e5, -5e6)])
def test_profiles_in_a_spiral_far_from_the_origin(origin_m: tuple[float, float]) -> None:
    plan = plan_of((np.array(spiral(80)) + origin_m).tolist())
    poses = pose_grid(plan, 0.5)
    heading = np.linspace(-1.0, 1.0, len(poses))
    swept = profiles_at(plan, poses.position_m, poses.room_index, heading, COLUMNS)
    cast = wall_profile(poses.position_m, heading, plan.walls_m[poses.room_index], COLUMNS)
    assert (~np.isclose(swept, cast, rtol=1e-6)).mean() < 1e-3


def test_profile_outside_rooms_is_infinite() -> None:
    plan = plan_of(rectangle(2.0, 2.0))
    outside = profiles_at(plan, np.array([[9.0, 1.0]]), np.zeros(1, int), np.zeros(1), 8)
    assert np.isinf(outside).all()
