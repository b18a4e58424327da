"""The cost of a pose: a likelihood with heavy tails, sharp where the network is sure and the pose is exact."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.localise.evidence import EvidenceConfig, profile_costs, targets
from lalaloc_core.localise.poses import PredictedProfile, Query
from tests.strategies import seeds

CONFIG = EvidenceConfig(tail=2.0)


def query(log_m: np.ndarray, log_scale: np.ndarray) -> Query:
    count = len(log_m)
    return Query(np.eye(count), np.arange(count) * 0.1, 0.0, False, PredictedProfile(log_m, log_scale))


@given(seed=seeds(), reach_m=st.floats(0.0, 0.5))
def test_the_cost_is_the_documented_formula(seed: int, reach_m: float) -> None:
    rng = np.random.default_rng(seed)
    profiles, asked = rng.uniform(0.3, 6.0, (5, 12)), query(rng.normal(size=(3, 12)), rng.normal(-2.0, 1.0, (3, 12)))
    assert asked.profile is not None
    centre, precision = targets(asked, np.arange(3), reach_m, CONFIG)
    for k in range(3):
        costs = profile_costs(np.log(profiles), centre[k], precision[k])
        for cost, profile in zip(costs, profiles, strict=True):
            total = 0.0
            for d, mu, log_b in zip(profile, asked.profile.log_m[k], asked.profile.log_scale[k], strict=True):
                s = math.hypot(math.exp(log_b), reach_m / math.exp(mu))
                total += math.log(1.0 + ((math.log(d) - mu) / (2.0 * s)) ** 2)
            assert cost == pytest.approx(total / 12.0)


@given(seeds())
def test_it_is_zero_at_the_prediction_and_nowhere_less(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centre, precision = targets(query(rng.normal(size=(1, 8)), rng.normal(size=(1, 8))), np.array([0]), 0.1, CONFIG)
    costs = profile_costs(np.concatenate([centre, rng.normal(size=(20, 8))]), centre[0], precision[0])
    assert costs[0] == 0.0
    assert costs.min() == 0.0


def test_a_door_that_was_looked_through_costs_less_than_a_room_that_is_wrong_all_round() -> None:
    centre, precision = np.zeros(128), np.full(128, 10.0)
    door, other_room = np.zeros(128), np.full(128, 0.3)
    door[:10] = math.log(20.0)
    assert np.square(door).mean() > np.square(other_room).mean()
    through, wrong = profile_costs(np.stack([door, other_room]), centre, precision)
    assert through < 0.5 * wrong


def test_coarser_poses_are_judged_more_leniently_above_all_beside_walls() -> None:
    log_m = np.log(np.array([[0.3, 1.0, 4.0]]))
    fine, coarse = (targets(query(log_m, np.full((1, 3), -3.0)), np.array(0), r, CONFIG)[1] for r in (0.05, 0.3))
    assert (coarse < fine).all()
    assert (np.diff(coarse / fine) > 0.0).all()


def test_no_prediction_is_trusted_without_limit() -> None:
    _, precision = targets(query(np.zeros((1, 4)), np.full((1, 4), -80.0)), np.array(0), 0.0, CONFIG)
    np.testing.assert_allclose(precision, 1.0 / (2.0 * 1e-3))


def test_profiles_are_compared_where_there_are_some_and_they_are_wanted() -> None:
    asked = query(np.zeros((1, 4)), np.zeros((1, 4)))
    assert EvidenceConfig().compares_profiles(asked)
    assert not EvidenceConfig(use_profile=False).compares_profiles(asked)
    assert not EvidenceConfig().compares_profiles(Query(np.eye(1), np.zeros(1), 0.0, True))
