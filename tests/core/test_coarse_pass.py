"""The search by a first look, against the search that compares everything."""

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
    """What a network would say of random places, with the errors that networks make: furniture hides a third."""
    rng = np.random.default_rng(0)
    poses = random_poses(building.plan, QUERIES, rng, 0.2)
    found = []
    shifts = np.arange(HYPOTHESES) * COLUMNS // HYPOTHESES
    for index in range(QUERIES):
        one = PoseSet(poses.position_m[[index]], poses.room_index[[index]])
        layouts = layouts_at(building.plan, one, rng.uniform(-3.0, 3.0, 1), COLUMNS)
        assert layouts.kind is not None
        log_m = layouts.log_profile[0] + rng.normal(0.0, 0.05, COLUMNS) + rng.uniform(-0.06, 0.06)
        hidden = rng.random(COLUMNS) < 0.3
        log_m[hidden] -= rng.exponential(0.3, int(hidden.sum()))
        said = np.full((COLUMNS, 4), 0.05)
        said[np.arange(COLUMNS), layouts.kind[0]] += 0.8
        profile = PredictedProfile.rolled(log_m, np.full(COLUMNS, np.log(0.06)), shifts)
        openings = PredictedOpenings(rolled(np.log(said), shifts), np.array([0.7, 0.1, 0.15, 0.05]))
        roll = np.arange(HYPOTHESES) * (2.0 * np.pi / HYPOTHESES)
        height = CameraHeight(1.5) if index % 2 else CameraHeight(1.5, float("inf"))
        latents = np.tile(np.eye(1, 8), (HYPOTHESES, 1))
        found.append(Query(latents, roll, 0.0, False, height, profile, openings))
    return found


def probabilities(pose: np.ndarray, cost: np.ndarray, poses: int) -> np.ndarray:
    weight = np.exp(-WEIGHTS.temperature * (cost - cost.min()).astype(float))
    return np.bincount(pose, weight, poses) / weight.sum()


def test_the_best_place_and_the_posterior_are_those_of_comparing_everything(
    building: Building, grid: PoseGrid, queries: list[Query]
) -> None:
    compared = 0
    for query in queries:
        found = grid_costs(building.plan, grid, query, WEIGHTS, CONFIG)
        every, offset = MatchingCost(building.plan, query, CONFIG.grid_reach * STEP_M, WEIGHTS, CONFIG).costs(
            grid.layouts(building.plan)
        )
        hypothesis, pose = np.unravel_index(every.argmin(), every.shape)
        best = retrieve(found, grid, query, top_k=5, separation_m=1.0)[0]
        np.testing.assert_array_equal(best.position_m, grid.poses.position_m[pose])
        assert best.hypothesis == hypothesis
        assert best.cost == pytest.approx(float(every.min()), abs=1e-5)
        assert best.height_offset == pytest.approx(float(offset[hypothesis, pose]))
        told = slice(0, found.compared)
        np.testing.assert_allclose(found.cost[told], every[found.hypothesis[told], found.pose[told]], atol=1e-5)
        places = np.tile(np.arange(len(grid.poses)), HYPOTHESES)
        expected = probabilities(places, every.ravel(), len(grid.poses))
        got = probabilities(found.pose, found.cost, len(grid.poses))
        assert 0.5 * np.abs(expected - got).sum() < 0.01
        compared += found.compared
    # ... and that it is a small part of them.
    assert compared < 0.15 * QUERIES * len(grid.poses) * HYPOTHESES


def test_what_is_only_estimated_has_its_share_of_the_probability(
    building: Building, grid: PoseGrid, queries: list[Query], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lalaloc_core.localise.retrieval._MIN_COMPARED", 64)
    monkeypatch.setattr("lalaloc_core.localise.retrieval._MAX_COMPARED", 64)
    # So little sure of anything that thousands of pairs share what is probable.
    unsure = MatchingWeights(temperature=8.0, openings=0.4)
    ratios = []
    for query in queries:
        found = grid_costs(building.plan, grid, query, unsure, CONFIG)
        every, _ = MatchingCost(building.plan, query, CONFIG.grid_reach * STEP_M, unsure, CONFIG).costs(
            grid.layouts(building.plan)
        )
        assert found.compared == 64 < len(found.cost)
        whole = np.exp(-8.0 * (every - every.min()).astype(float)).sum()
        ratios.append(np.exp(-8.0 * (found.cost - every.min()).astype(float)).sum() / whole)
        seen = np.exp(-8.0 * (found.cost[:64] - every.min()).astype(float)).sum() / whole
        assert seen < 0.8
    assert 0.75 < np.median(ratios) < 1.3


def test_openings_and_what_lies_behind_them_count_for_pairs_as_for_all(
    building: Building, grid: PoseGrid, queries: list[Query]
) -> None:
    layouts, rng = grid.layouts(building.plan), np.random.default_rng(1)
    assert layouts.seen is not None
    evidence = MatchingCost(building.plan, queries[1], 0.3, WEIGHTS, CONFIG)
    every, offset = evidence.costs(layouts)
    pose, hypothesis = rng.integers(0, len(layouts), 700), rng.integers(0, HYPOTHESES, 700)
    cost, found = evidence.pairs(layouts, pose, hypothesis)
    np.testing.assert_allclose(cost, every[hypothesis, pose], atol=1e-5)
    assert (found == offset[hypothesis, pose]).mean() > 0.99


@pytest.mark.parametrize(
    "wanted", [PairLimits(at_most=6000, at_least=200, window=0.5), PairLimits(at_most=300, at_least=300)]
)
@pytest.mark.parametrize("hinted", [False, True])
def test_the_likeliest_pairs_are_those_of_a_first_look_at_all(
    building: Building, grid: PoseGrid, queries: list[Query], wanted: PairLimits, hinted: bool
) -> None:
    looked_at, rng = 0, np.random.default_rng(2)
    for query in queries[:8]:
        against = np.where(rng.random(len(grid.poses)) < 0.5, np.inf, 0.1) if hinted else None
        evidence = MatchingCost(building.plan, query, CONFIG.grid_reach * STEP_M, WEIGHTS, CONFIG)
        binned, room_index = grid.binned(building.plan), grid.poses.room_index
        every = coarse_costs(binned, evidence, room_index)
        every = every if against is None else every + against[:, None]
        found, place = likeliest(binned, evidence, room_index, wanted, against)
        count = int((every <= every.min() + wanted.window).sum())
        count = min(max(count, wanted.at_least), wanted.at_most)
        np.testing.assert_allclose(found[:count], np.sort(every.ravel())[:count], atol=1e-6)
        np.testing.assert_allclose(every.ravel()[place], found, atol=1e-6)
        assert len(np.unique(place)) == len(place) <= wanted.at_most
        looked_at += len(np.unique(place // HYPOTHESES))
    assert looked_at < 8 * len(grid.poses)


def test_no_pose_costs_less_than_its_bound(building: Building, grid: PoseGrid, queries: list[Query]) -> None:
    ranks = []
    for query in queries[:8]:
        evidence = MatchingCost(building.plan, query, CONFIG.grid_reach * STEP_M, WEIGHTS, CONFIG)
        binned, room_index = grid.binned(building.plan), grid.poses.room_index
        every = coarse_costs(binned, evidence, room_index)
        table = _table(binned, evidence).reshape(-1, len(evidence.offsets), evidence.hypotheses)
        bound = _bounds(binned, table) + evidence.room_costs.min(axis=0)[room_index]
        least = every.min(axis=1)
        assert (bound <= least).all()
        ranks.append((bound < bound[least.argmin()]).mean())
    # ... and bounds tell poses apart.
    assert np.median(ranks) < 0.1


@given(seeds(), st.integers(1, 60))
def test_the_fewest_of_slices_are_those_of_the_whole(seed: int, limit: int) -> None:
    rng = np.random.default_rng(seed)
    cost = rng.normal(size=(90, 3))
    cost[rng.random(cost.shape) < 0.2] = np.inf
    fewest = LowestCosts(limit)
    for first in range(0, 90, 16):
        fewest.offer(np.arange(first, min(first + 16, 90)), cost[first : first + 16])
    found, place = fewest.ranked()
    finite = np.sort(cost[np.isfinite(cost)])
    np.testing.assert_array_equal(found, finite[:limit])
    np.testing.assert_array_equal(cost.ravel()[place], found)
