"""Tests of merged plans and of the probability that the right plan was searched."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.bundle import MatchingWeights
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.matching_cost import MatchingConfig, MatchingCost
from lalaloc_core.localise.poses import PoseGrid, PredictedProfile, Query
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from lalaloc_core.localise.venue.prototypes import most_probable, share_searched
from lalaloc_core.render.sampling import pose_grid
from lalaloc_core.render.sweep import profiles_at

COLUMNS, STEP_M = 64, 0.5
WEIGHTS, CONFIG = MatchingWeights(temperature=40.0), MatchingConfig()


def plan_of(width_m: float, depth_m: float, *, x_m: float = 0.0, openings: bool = False) -> FloorPlan:
    """Return a plan of two rooms side by side, optionally with a door, at a distance from the origin."""
    wall_m, near, far = 0.1, x_m, x_m + width_m
    document = {
        "ceiling_height_m": 2.5,
        "rooms": [
            {"name": "a", "polygon": [[near, 0], [far, 0], [far, depth_m], [near, depth_m]]},
            {"name": "b", "polygon": [[far + wall_m, 0], [far + 3, 0], [far + 3, 3], [far + wall_m, 3]]},
        ],
    }
    if openings:
        document["openings"] = [{"kind": "door", "line": [[far + 0.05, 1.0], [far + 0.05, 1.9]]}]
    return FloorPlan.from_dict(document)


def grid_of(plan: FloorPlan) -> PoseGrid:
    poses = pose_grid(plan, STEP_M)
    profile_m = profiles_at(plan, poses.position_m, poses.room_index, np.zeros(len(poses)), COLUMNS, np.float32)
    latents = np.tile(np.eye(1, 8, dtype=np.float32), (len(poses), 1))
    return PoseGrid(poses, latents, profile_m, STEP_M, 1.5)


def query_at(plan: FloorPlan, x_m: float, y_m: float, hypotheses: int = 1) -> Query:
    """Return a perfect prediction at a place; the first heading hypothesis is right."""
    position = np.array([[x_m, y_m]])
    profile = profiles_at(plan, position, plan.room_index_at(position), np.zeros(1), COLUMNS)[0]
    shifts = np.arange(hypotheses) * COLUMNS // hypotheses
    predicted = PredictedProfile.rolled(np.log(profile), np.full(COLUMNS, np.log(0.05)), shifts)
    roll = np.arange(hypotheses) * 2.0 * np.pi / hypotheses
    return Query(np.eye(1, 8)[[0] * hypotheses], roll, 0.0, hypotheses == 1, CameraHeight(1.5), predicted)


PLANS = [plan_of(4.0, 3.0, openings=True), plan_of(7.0, 2.0, x_m=1e6), plan_of(5.0, 5.0, openings=True)]


@pytest.fixture(scope="module")
def merged_plans() -> MergedPlans:
    return MergedPlans.of(PLANS, [grid_of(plan) for plan in PLANS], 1.5)


def test_merged_costs_equal_those_of_each_plan(merged_plans: MergedPlans) -> None:
    query = query_at(PLANS[0], 1.3, 1.1)
    whole, _ = MatchingCost(merged_plans.plan, query, 0.3, WEIGHTS, CONFIG).costs(
        merged_plans.grid.layouts(merged_plans.plan)
    )
    parts = []
    for plan in PLANS:
        grid = grid_of(plan)
        # Only opening kinds that every plan shows are compared; one plan shows none.
        compared = replace(plan, opening_kinds=frozenset())
        parts.append(MatchingCost(compared, query, 0.3, WEIGHTS, CONFIG).costs(grid.layouts(plan))[0])
    np.testing.assert_allclose(whole, np.concatenate(parts, axis=1), atol=1e-5)


def test_merged_layouts_equal_those_of_each_plan(merged_plans: MergedPlans) -> None:
    separate = [grid_of(plan).layouts(plan) for plan in PLANS]
    merged = merged_plans.grid.layouts(merged_plans.plan)
    assert merged.kind is not None
    assert merged.seen is not None
    assert len(merged) == sum(map(len, separate))
    first = 0
    for layouts in separate:
        rows = merged.rows(np.arange(first, first + len(layouts)))
        assert rows.kind is not None
        np.testing.assert_array_equal(rows.log_profile, layouts.log_profile)
        np.testing.assert_array_equal(rows.kind, np.zeros_like(rows.kind) if layouts.kind is None else layouts.kind)
        seen = 0 if layouts.seen is None else len(layouts.seen.row)
        assert seen == (0 if rows.seen is None else len(rows.seen.row))
        first += len(layouts)


def test_merged_plan_renders_like_each_plan(merged_plans: MergedPlans) -> None:
    grid = merged_plans.grid
    seen = profiles_at(
        merged_plans.plan, grid.poses.position_m, grid.poses.room_index, np.zeros(len(grid.poses)), COLUMNS, np.float32
    )
    np.testing.assert_allclose(seen, grid.profile_m, atol=2e-3)


def test_merged_rooms_map_to_their_plans(merged_plans: MergedPlans) -> None:
    separate = [grid_of(plan).poses for plan in PLANS]
    sizes = [len(poses) for poses in separate]
    room_index, last = merged_plans.grid.poses.room_index, np.cumsum(sizes)
    expected = np.repeat(np.arange(len(sizes)), sizes).tolist()
    assert [merged_plans.plan_of(int(room)) for room in room_index] == expected
    np.testing.assert_array_equal(merged_plans.by_plan(np.ones(len(room_index))), sizes)
    # No two plans are near each other.
    parts = np.split(merged_plans.grid.poses.position_m, last[:-1])
    for k, part in enumerate(parts):
        for later in parts[k + 1 :]:
            assert np.linalg.norm(part[:, None] - later[None], axis=-1).min() > 9.0
    assert np.abs(merged_plans.grid.poses.position_m).max() < 100.0


def test_most_probable_plans_are_searched_within_limits() -> None:
    log_mass, poses = np.array([-3.0, -1.0, -2.0, -9.0]), np.array([10, 500, 20, 30])
    assert most_probable(log_mass, poses, max_plans=3, max_poses=1000).tolist() == [1, 2, 0]
    assert most_probable(log_mass, poses, max_plans=2, max_poses=1000).tolist() == [1, 2]
    assert most_probable(log_mass, poses, max_plans=4, max_poses=525).tolist() == [1, 2]
    assert most_probable(log_mass, poses, max_plans=4, max_poses=5).tolist() == [1]
    # Plans without mass are skipped.
    log_mass = np.array([-np.inf, -1.0, -np.inf, -9.0])
    assert most_probable(log_mass, poses, max_plans=4, max_poses=1000).tolist() == [1, 3]


def test_plans_left_out_keep_their_share() -> None:
    copies = np.full(10, -2.0)
    assert share_searched(copies, np.arange(10), np.full(10, 0.1)) == 1.0
    # Four of ten copies were searched: each has a quarter of their mass, a tenth of all.
    assert share_searched(copies, np.arange(4), np.full(4, 0.25)) == pytest.approx(0.4)
    # One plan dominates the full search, so plans left out count as wrong.
    sharp = np.array([1.0 - 3e-5, 1e-5, 1e-5, 1e-5])
    assert share_searched(copies, np.arange(4), sharp) > 0.99
    # A wrong plan and one of four copies of the right plan were searched.
    mixed = np.array([-1.0, -2.0, -2.0, -2.0, -2.0, -7.0])
    assert share_searched(mixed, np.arange(2), np.array([0.0, 1.0])) == pytest.approx(0.25, abs=0.01)
    # Plans without mass change nothing.
    more = np.append(mixed, [-np.inf, -np.inf])
    assert share_searched(more, np.arange(2), np.array([0.0, 1.0])) == pytest.approx(0.25, abs=0.01)
