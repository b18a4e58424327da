"""What speaks for an answer: clear of rivals, a good fit, a network that is sure."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.localise.confidence import Signals, signals_of
from lalaloc_core.localise.poses import Candidate, PredictedProfile, Query
from tests.strategies import seeds

PLAIN = Query(np.eye(1), np.zeros(1), 0.0, heading_known=True)


def candidate(x_m: float, cost: float, latent_distance: float = 0.3) -> Candidate:
    return Candidate(x_m, 0.0, 0, 0.0, 0, cost, latent_distance)


def log_odds(*candidates: Candidate, complete: bool = True) -> float:
    return signals_of(PLAIN, candidates, complete=complete).log_odds


def test_a_place_without_any_rival_is_as_sure_as_can_be() -> None:
    assert log_odds(candidate(0.0, 0.2)) == 6.0
    # Starts that met, or turned differently, are at one place.
    assert log_odds(candidate(0.0, 0.2), candidate(0.9, 0.2), candidate(0.0, 0.3)) == 6.0


def test_an_equal_rival_leaves_even_odds_and_more_of_them_worse() -> None:
    assert log_odds(candidate(0.0, 0.2), candidate(5.0, 0.2)) == pytest.approx(0.0)
    three = log_odds(candidate(0.0, 0.2), candidate(5.0, 0.2), candidate(9.0, 0.2), candidate(14.0, 0.2))
    assert three == pytest.approx(-np.log(3.0))


@given(cost=st.floats(0.0, 1.0), gap=st.floats(0.0, 0.2), more=st.floats(0.01, 0.1))
def test_the_worse_the_rival_fits_the_better_the_odds(cost: float, gap: float, more: float) -> None:
    near = log_odds(candidate(0.0, cost), candidate(5.0, cost + gap))
    assert log_odds(candidate(0.0, cost), candidate(5.0, cost + gap + more)) > near


def test_places_that_were_not_looked_at_count_as_much_as_the_worst_that_were() -> None:
    # Nothing tells places apart, and the best few happen to lie at one place.
    flat = [candidate(0.0, 0.001), candidate(0.5, 0.001), candidate(0.3, 0.001)]
    assert log_odds(*flat, complete=False) == pytest.approx(-np.log(3.0))
    # One place stands out of all that were looked at: what was not looked at matters little.
    clear = [candidate(0.0, 0.05), candidate(6.0, 0.6), candidate(9.0, 1.1)]
    assert log_odds(*clear, complete=False) == pytest.approx(log_odds(*clear), abs=0.1)


@given(seeds())
def test_the_order_of_candidates_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    some = [candidate(x, cost, distance) for x, cost, distance in rng.uniform(0.0, [9.0, 1.0, 2.0], (8, 3))]
    shuffled = [some[k] for k in rng.permutation(8)]
    first, second = (dataclasses.astuple(signals_of(PLAIN, each, complete=False)) for each in (some, shuffled))
    np.testing.assert_allclose(first, second)


def test_the_best_candidate_and_the_prediction_are_told() -> None:
    profile = PredictedProfile(np.zeros((2, 4)), np.array([[-3.0, -2.0, -3.0, -2.0]]).repeat(2, axis=0))
    query = Query(np.eye(2), np.zeros(2), 0.0, heading_known=False, profile=profile)
    some = [candidate(5.0, 0.4, 0.1), candidate(0.0, 0.25, 0.7)]
    found = signals_of(query, some, complete=True)
    expected = Signals(log_odds=16.0 * 0.15, cost=0.25, uncertainty=-2.5, latent_distance=0.7)
    assert dataclasses.astuple(found) == pytest.approx(dataclasses.astuple(expected))
    assert signals_of(PLAIN, some, complete=True).uncertainty == 0.0
