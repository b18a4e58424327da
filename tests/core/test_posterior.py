"""Tests of the posterior over places, the probability map and the signals."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.confidence import Signals, signals_of
from lalaloc_core.localise.poses import Candidate, PredictedProfile, Query
from lalaloc_core.localise.posterior import GridCosts, Posterior, Support, area_shares, posterior_of, probability_map
from lalaloc_core.render.sampling import PoseSet
from tests.strategies import seeds

NOWHERE = Support(np.zeros(1, int), np.zeros((1, 2)), np.ones(1))
PLAIN = Query(np.eye(1), np.zeros(1), 0.0, heading_known=True, camera_height=CameraHeight(1.5))


def candidate(x_m: float, cost: float, hypothesis: int = 0) -> Candidate:
    return Candidate(x_m, 0.0, 0, 0.0, hypothesis, cost, 0.3)


def costs_at(places: list[float], cost: np.ndarray) -> GridCosts:
    position = np.stack([places, np.zeros(len(places))], axis=1)
    poses = PoseSet(position, np.zeros(len(places), int))
    return GridCosts.of_all(poses, np.atleast_2d(cost), np.zeros_like(np.atleast_2d(cost)))


def posterior_at(
    grid: GridCosts, starts: list[Candidate], ends: list[Candidate] | None = None, query: Query = PLAIN
) -> Posterior:
    ends = starts if ends is None else ends
    candidates = sorted(ends, key=lambda end: end.cost)
    return posterior_of(
        grid,
        np.zeros(len(grid.poses)),
        query,
        starts=starts,
        ends=ends,
        candidates=candidates,
        temperature=16.0,
        separation_m=1.0,
    )


def test_map_is_of_the_refined_positions() -> None:
    plan = FloorPlan.from_dict({"ceiling_height_m": 2.5, "rooms": [{"polygon": [[-5, -2], [6, -2], [6, 2], [-5, 2]]}]})
    # Both candidates start beside the refined pose and end at it.
    places, cost = [-0.6, 0.0, 0.6, 3.0], np.array([0.2, 0.5, 0.2, 0.4])
    grid = costs_at(places, cost)
    starts = [candidate(-0.6, 0.2), candidate(0.6, 0.2)]
    ends = [dataclasses.replace(start, x_m=0.1, cost=0.02) for start in starts]
    found_map = probability_map(plan, grid.poses, posterior_at(grid, starts, ends))
    best = found_map.probability.argmax()
    assert found_map.position_m[best] == pytest.approx([0.1, 0.0])
    at_end = np.linalg.norm(found_map.position_m - [0.1, 0.0], axis=1) < 1e-9
    assert found_map.probability[at_end].sum() > 0.9
    assert found_map.probability.sum() == pytest.approx(1.0)
    assert (found_map.room_index == 0).all()


def test_positions_moved_outside_rooms_leave_the_map() -> None:
    plan = FloorPlan.from_dict({"ceiling_height_m": 2.5, "rooms": [{"polygon": [[-1, -1], [1, -1], [1, 1], [-1, 1]]}]})
    grid = costs_at([0.2, 0.8], np.array([0.1, 0.12]))
    found_map = probability_map(plan, grid.poses, posterior_at(grid, [candidate(0.2, 0.1)], [candidate(0.5, 0.05)]))
    np.testing.assert_allclose(found_map.position_m, [[0.5, 0.0]])
    assert found_map.probability == pytest.approx([1.0])


@pytest.mark.parametrize("copies", [2, 4, 8, 50])
def test_equal_places_share_the_mass_without_candidates_too(copies: int) -> None:
    places = [5.0 * k for k in range(copies)]
    starts = [candidate(x, 0.1) for x in places[:20]]
    found = posterior_at(costs_at(places, np.full(copies, 0.1)), starts)
    assert found.candidate == pytest.approx([1.0 / copies] * min(copies, 20))
    # Refinement improves all copies equally, also the copies without a candidate.
    ends = [dataclasses.replace(start, cost=0.02) for start in starts]
    assert posterior_at(costs_at(places, np.full(copies, 0.1)), starts, ends).candidate[0] == pytest.approx(
        1.0 / copies
    )


def test_refined_cost_decides_between_modes() -> None:
    grid = costs_at([0.0, 5.0], np.array([0.20, 0.18]))
    starts = [candidate(5.0, 0.18), candidate(0.0, 0.20)]
    ends = [candidate(5.0, 0.17), candidate(0.1, 0.02)]
    found = posterior_at(grid, starts, ends)
    assert found.candidate[0] == pytest.approx(1.0 / (1.0 + math.exp(-16.0 * 0.15)), rel=1e-3)
    assert found.pose[0] == pytest.approx(found.candidate[0])


def test_copies_share_equally_regardless_of_the_grid() -> None:
    # The first copy has a grid pose at the minimum, the second has two half a step from it.
    grid = costs_at([0.0, 4.75, 5.25], np.array([0.02, 0.10, 0.10]))
    starts = [candidate(0.0, 0.02), candidate(4.75, 0.10)]
    ends = [candidate(0.0, 0.01), candidate(5.0, 0.01)]
    assert posterior_at(grid, starts, ends).candidate == pytest.approx([0.5, 0.5])


def test_uniform_corridor_spreads_the_mass() -> None:
    places = [0.5 * k for k in range(40)]
    found = posterior_at(costs_at(places, np.full(40, 0.05)), [candidate(x, 0.05) for x in places[::2]])
    # Three of the 40 poses lie within 1 m of the candidate.
    assert found.candidate[0] <= 0.1
    assert sum(found.candidate) <= 1.0 + 1e-9


@given(seeds(), st.integers(1, 12))
def test_probabilities_are_a_distribution(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    grid = costs_at(list(rng.uniform(0.0, 9.0, 30)), rng.uniform(0.0, 1.0, (3, 30)))
    query = dataclasses.replace(PLAIN, latents=np.eye(3), roll=np.array([0.0, 0.4, 0.8]), heading_known=False)
    starts = [candidate(float(x), c) for x, c in zip(rng.uniform(0, 9, count), rng.uniform(0, 1, count), strict=True)]
    found = posterior_at(grid, starts, query=query)
    assert found.pose.sum() == pytest.approx(1.0)
    assert all(value >= 0.0 for value in found.candidate)
    assert sum(found.candidate) <= 1.0 + 1e-9
    assert 0.0 <= found.heading <= 1.0 + 1e-9


def test_symmetric_room_has_two_headings() -> None:
    rolls = np.arange(64) * (2.0 * math.pi / 64)
    query = Query(np.eye(64), rolls, 0.0, heading_known=False, camera_height=CameraHeight(1.5))
    cost = np.full((64, 1), 2.0)
    cost[[0, 32]] = 0.0
    starts = [candidate(0.0, 0.0), candidate(0.0, 0.0, hypothesis=32)]
    found = posterior_at(costs_at([0.0], cost), starts, query=query)
    assert found.position == pytest.approx(1.0)
    assert found.candidate == pytest.approx((0.5, 0.5))
    assert found.heading == pytest.approx(0.5)


def test_candidates_that_meet_are_one_mode() -> None:
    # Two starts converge in the first copy, one in the second.
    grid = costs_at([0.0, 1.2, 10.0], np.array([0.05, 0.05, 0.05]))
    starts = [candidate(0.0, 0.05), candidate(1.2, 0.05), candidate(10.0, 0.05)]
    ends = [candidate(0.6, 0.01), candidate(0.6, 0.01), candidate(10.6, 0.01)]
    found = posterior_of(
        grid,
        np.zeros(3),
        PLAIN,
        starts=starts,
        ends=ends,
        candidates=[ends[0], ends[2]],
        temperature=16.0,
        separation_m=1.0,
    )
    assert found.candidate == pytest.approx((0.5, 0.5))


def test_poses_weigh_by_their_share_of_the_room() -> None:
    poses = PoseSet(np.zeros((5, 2)), np.array([0, 0, 0, 0, 1]))
    np.testing.assert_allclose(np.exp(area_shares(poses, np.array([1.0, 3.0]))), [0.25, 0.25, 0.25, 0.25, 3.0])


class TestSignals:
    def test_signals_are_computed_as_documented(self) -> None:
        profile = PredictedProfile(np.zeros((2, 4)), np.array([[-3.0, -2.0, -3.0, -2.0]]).repeat(2, axis=0))
        query = dataclasses.replace(PLAIN, profile=profile)
        posterior = Posterior(np.ones(1), 0.8, (0.7,), 1.0, NOWHERE)
        found = signals_of(query, candidate(5.0, 0.4), posterior, 0.6, 0.8)
        expected = Signals(
            log_odds=math.log(4.0),
            cost=0.4,
            uncertainty=-2.5,
            latent_distance=0.3,
            cost_to_chance=math.log(0.61 / 0.81),
            answer_to_chance=math.log(0.41 / 0.81),
        )
        assert dataclasses.astuple(found) == pytest.approx(dataclasses.astuple(expected))

    def test_signals_without_profile_or_cohort_are_zero(self) -> None:
        posterior = Posterior(np.ones(1), 0.8, (0.7,), 1.0, NOWHERE)
        found = signals_of(PLAIN, candidate(5.0, 0.4), posterior, 0.6, None)
        assert (found.uncertainty, found.cost_to_chance, found.answer_to_chance) == (0.0, 0.0, 0.0)

    @pytest.mark.parametrize(("mass", "log_odds"), [(0.0, -6.0), (1.0, 6.0), (1.0 + 1e-12, 6.0)])
    def test_log_odds_are_bounded(self, mass: float, log_odds: float) -> None:
        posterior = Posterior(np.ones(1), mass, (mass,), 1.0, NOWHERE)
        assert signals_of(PLAIN, candidate(0.0, 0.2), posterior, 0.2, None).log_odds == log_odds
