"""Tests of the coarse pass against the exhaustive search."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.learn.synth.homes.buildings import Building, building_of
from lalaloc_core.learn.synth.homes.splits import VALIDATION
from lalaloc_core.localise.bundle import MatchingWeights
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.coarse_pass import LowestCosts, PairLimits, _bounds, _table, coarse_costs, likeliest
from lalaloc_core.localise.layouts import layouts_at
from lalaloc_core.localise.matching_cost import MatchingConfig, MatchingCost
from lalaloc_core.localise.poses import PoseGrid, PredictedOpenings, PredictedProfile, Query, rolled
from lalaloc_core.localise.retrieval import grid_costs, retrieve
from lalaloc_core.render.sampling import PoseSet, pose_grid, random_poses
from tests.strategies import seeds

STEP_M, COLUMNS, HYPOTHESES, QUERIES = 0.7, 64, 32, 24
WEIGHTS, CONFIG = MatchingWeights(temperature=40.0, openings=0.4), MatchingConfig()


@pytest.fixture(scope="module")
def building() -> Building:
    return building_of(VALIDATION, 3, 350.0, hall_share=0.0)


@pytest.fixture(scope="module")
def grid(building: Building) -> PoseGrid:
    poses = pose_grid(building.plan, STEP_M)
    layouts = layouts_at(building.plan, poses, np.zeros(len(poses)), COLUMNS)
    return PoseGrid.without_latents(poses, layouts, STEP_M, 1.5)


@pytest.fixture(scope="module")
def queries(building: Building) -> list[Query]:
    """Return predictions at random poses with typical errors: furniture hides a third of the columns."""
    rng = np.random.default_rng(0)
    poses = random_poses(building.plan, QUERIES, rng, 0.2)
    found = []
    shifts = np.arange(HYPOTHESES) * COLUMNS // HYPOTHESES
    for index in range(QUERIES):
        pose = PoseSet(poses.position_m[[index]], poses.room_index[[index]])
        layouts = layouts_at(building.plan, pose, rng.uniform(-3.0, 3.0, 1), COLUMNS)
        assert layouts.kind is not None
        log_m = layouts.log_profile[0] + rng.normal(0.0, 0.05, COLUMNS) + rng.uniform(-0.06, 0.06)
        hidden = rng.random(COLUMNS) < 0.3
        log_m[hidden] -= rng.exponential(0.3, int(hidden.sum()))
        probability = np.full((COLUMNS, 4), 0.05)
        probability[np.arange(COLUMNS), layouts.kind[0]] += 0.8
        profile = PredictedProfile.rolled(log_m, np.full(COLUMNS, np.log(0.06)), shifts)
        openings = PredictedOpenings(rolled(np.log(probability), shifts), np.array([0.7, 0.1, 0.15, 0.05]))
        roll = np.arange(HYPOTHESES) * (2.0 * np.pi / HYPOTHESES)
        height = CameraHeight(1.5) if index % 2 else CameraHeight(1.5, float("inf"))
        latents = np.tile(np.eye(1, 8), (HYPOTHESES, 1))
        found.append(Query(latents, roll, 0.0, False, height, profile, openings))
    return found


def matching_cost_of(building: Building, query: Query, weights: MatchingWeights = WEIGHTS) -> MatchingCost:
    return MatchingCost(building.plan, query, CONFIG.grid_reach * STEP_M, weights, CONFIG)


def probabilities(pose: np.ndarray, cost: np.ndarray, poses: int) -> np.ndarray:
    weight = np.exp(-WEIGHTS.temperature * (cost - cost.min()).astype(float))
    return np.bincount(pose, weight, poses) / weight.sum()


def test_best_pose_and_posterior_equal_the_exhaustive_search(
    building: Building, grid: PoseGrid, queries: list[Query]
) -> None:
    compared = 0
    for query in queries:
        found = grid_costs(building.plan, grid, query, WEIGHTS, CONFIG)
        every, offset = matching_cost_of(building, query).costs(grid.layouts(building.plan))
        hypothesis, pose = np.unravel_index(every.argmin(), every.shape)
        best = retrieve(found, grid, query, top_k=5, separation_m=1.0)[0]
        np.testing.assert_array_equal(best.position_m, grid.poses.position_m[pose])
        assert best.hypothesis == hypothesis
        assert best.cost == pytest.approx(float(every.min()), abs=1e-5)
        assert best.height_offset == pytest.approx(float(offset[hypothesis, pose]))
        exact = slice(0, found.compared)
        np.testing.assert_allclose(found.cost[exact], every[found.hypothesis[exact], found.pose[exact]], atol=1e-5)
        places = np.tile(np.arange(len(grid.poses)), HYPOTHESES)
        expected = probabilities(places, every.ravel(), len(grid.poses))
        got = probabilities(found.pose, found.cost, len(grid.poses))
        assert 0.5 * np.abs(expected - got).sum() < 0.01
        compared += found.compared
    assert compared < 0.15 * QUERIES * len(grid.poses) * HYPOTHESES


def test_estimated_pairs_keep_their_share_of_the_probability(
    building: Building, grid: PoseGrid, queries: list[Query], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lalaloc_core.localise.retrieval._MIN_COMPARED", 64)
    monkeypatch.setattr("lalaloc_core.localise.retrieval._MAX_COMPARED", 64)
    # At this temperature thousands of pairs share the probability.
    unsure = MatchingWeights(temperature=8.0, openings=0.4)
    ratios = []
    for query in queries:
        found = grid_costs(building.plan, grid, query, unsure, CONFIG)
        every, _ = matching_cost_of(building, query, unsure).costs(grid.layouts(building.plan))
        assert found.compared == 64 < len(found.cost)
        whole = np.exp(-8.0 * (every - every.min()).astype(float)).sum()
        ratios.append(np.exp(-8.0 * (found.cost - every.min()).astype(float)).sum() / whole)
        seen = np.exp(-8.0 * (found.cost[:64] - every.min()).astype(float)).sum() / whole
        assert seen < 0.8
    assert 0.75 < np.median(ratios) < 1.3


def test_pair_costs_equal_the_full_matrix(building: Building, grid: PoseGrid, queries: list[Query]) -> None:
    layouts, rng = grid.layouts(building.plan), np.random.default_rng(1)
    assert layouts.seen is not None
    matching_cost = MatchingCost(building.plan, queries[1], 0.3, WEIGHTS, CONFIG)
    every, offset = matching_cost.costs(layouts)
    pose, hypothesis = rng.integers(0, len(layouts), 700), rng.integers(0, HYPOTHESES, 700)
    cost, found = matching_cost.pairs(layouts, pose, hypothesis)
    np.testing.assert_allclose(cost, every[hypothesis, pose], atol=1e-5)
    assert (found == offset[hypothesis, pose]).mean() > 0.99


@pytest.mark.parametrize(
    "limits", [PairLimits(at_most=6000, at_least=200, window=0.5), PairLimits(at_most=300, at_least=300)]
)
@pytest.mark.parametrize("hinted", [False, True])
def test_likeliest_pairs_equal_a_complete_coarse_pass(
    building: Building, grid: PoseGrid, queries: list[Query], limits: PairLimits, hinted: bool
) -> None:
    compared, rng = 0, np.random.default_rng(2)
    for query in queries[:8]:
        penalty = np.where(rng.random(len(grid.poses)) < 0.5, np.inf, 0.1) if hinted else None
        matching_cost = matching_cost_of(building, query)
        binned, room_index = grid.binned(building.plan), grid.poses.room_index
        every = coarse_costs(binned, matching_cost, room_index)
        every = every if penalty is None else every + penalty[:, None]
        found, pair = likeliest(binned, matching_cost, room_index, limits, penalty)
        count = int((every <= every.min() + limits.window).sum())
        count = min(max(count, limits.at_least), limits.at_most)
        np.testing.assert_allclose(found[:count], np.sort(every.ravel())[:count], atol=1e-6)
        np.testing.assert_allclose(every.ravel()[pair], found, atol=1e-6)
        assert len(np.unique(pair)) == len(pair) <= limits.at_most
        compared += len(np.unique(pair // HYPOTHESES))
    assert compared < 8 * len(grid.poses)


def test_bound_is_at_most_the_coarse_cost(building: Building, grid: PoseGrid, queries: list[Query]) -> None:
    ranks = []
    for query in queries[:8]:
        matching_cost = matching_cost_of(building, query)
        binned, room_index = grid.binned(building.plan), grid.poses.room_index
        every = coarse_costs(binned, matching_cost, room_index)
        table = _table(binned, matching_cost).reshape(-1, len(matching_cost.offsets), matching_cost.hypotheses)
        bound = _bounds(binned, table) + matching_cost.room_costs.min(axis=0)[room_index]
        least = every.min(axis=1)
        assert (bound <= least).all()
        ranks.append((bound < bound[least.argmin()]).mean())
    assert np.median(ranks) < 0.1


@given(seeds(), st.integers(1, 60))
def test_lowest_costs_of_slices_equal_those_of_the_whole(seed: int, limit: int) -> None:
    rng = np.random.default_rng(seed)
    cost = rng.normal(size=(90, 3))
    cost[rng.random(cost.shape) < 0.2] = np.inf
    lowest = LowestCosts(limit)
    for first in range(0, 90, 16):
        lowest.offer(np.arange(first, min(first + 16, 90)), cost[first : first + 16])
    found, pair = lowest.ranked()
    finite = np.sort(cost[np.isfinite(cost)])
    np.testing.assert_array_equal(found, finite[:limit])
    np.testing.assert_array_equal(cost.ravel()[pair], found)
