"""Tests of the search of a turn: relative headings by enumeration, and places of photographs in a plan."""

from __future__ import annotations

import itertools
import math
from functools import partial

import numpy as np
import pytest

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import MatchingConfig, MatchingCost, PoseGrid
from lalaloc_core.localise.query import CameraHeight, Candidate, Query
from lalaloc_core.localise.search import turn_search
from lalaloc_core.localise.search.pipeline import localise, run_steps
from lalaloc_core.localise.search.turn_search import RelativeHeading, SearchedTurn, TurnLocalisation, searched_turn
from tests.core.questions import HEADINGS, queries_along
from tests.strategies import plan_of, rectangle

CAMERA_M, STEP_M = 1.5, 0.5
SPOT_M, ROOM = (1.6, 7.0), 2
HALL = [[1.0, 5.0], [13.0, 5.0], [13.0, 6.4], [3.0, 6.4], [3.0, 8.0], [1.0, 8.0]]
PLAN = plan_of(rectangle(4.0, 3.0), rectangle(4.0, 3.0, corner=(10.0, 0.0)), HALL)


@pytest.fixture(scope="module")
def grid(encoders: PhotographEncoder) -> PoseGrid:
    return build_grid(PLAN, encoders.layouts, step_m=STEP_M, camera_height_m=CAMERA_M)


def query_at(encoders: PhotographEncoder, heading: float) -> Query:
    (query,) = queries_along(encoders, PLAN, [(SPOT_M, ROOM, heading)], CameraHeight(CAMERA_M, 0.0))
    return query


@pytest.fixture
def search(grid: PoseGrid, encoders: PhotographEncoder) -> partial[SearchedTurn]:
    def found(headings: list[float], relative: list[RelativeHeading], place: Candidate | None = None) -> SearchedTurn:
        queries = [query_at(encoders, heading) for heading in headings]
        return run_steps(searched_turn(PLAN, grid, encoders.layouts, queries, relative, MatchingConfig(), place), None)

    return partial(found)


def misses_deg(found: SearchedTurn, headings: list[float]) -> np.ndarray:
    turns = np.subtract(headings, headings[0])
    return np.degrees(np.abs(wrap_angle(np.array(found.headings) - turns)))


def test_headings_equal_those_of_enumeration() -> None:
    rng = np.random.default_rng(3)
    relative = [RelativeHeading(0, 0.0, 0.0), RelativeHeading(1, 0.0, 0.0), RelativeHeading(0, 1.2, 0.4)]
    heading = [math.tau / count * np.arange(count) + offset for count, offset in ((6, 0.1), (5, 0.0), (4, 0.7))]
    seen = [rng.normal(0.0, 2.0, (7, len(each))) for each in heading]
    prior = rng.normal(0.0, 0.5, 7)

    def weight(row: int, column: int) -> float:
        off = wrap_angle(heading[2][row] - heading[0][column] - 1.2) / math.hypot(0.4, 0.5 * math.tau / 4)
        return math.exp(-0.5 * off**2) + turn_search._FLOOR

    joint = np.zeros((7, 6, 5, 4))
    for place, first, second, third in itertools.product(*map(range, joint.shape)):
        evidence = seen[0][place, first] + seen[1][place, second] + seen[2][place, third]
        joint[place, first, second, third] = math.exp(prior[place] + evidence) * weight(third, first)
    place = int(joint.sum(axis=(1, 2, 3)).argmax())
    best = int(joint[place].sum(axis=(1, 2)).argmax())
    rows = [best, int(joint[place].sum(axis=(0, 2)).argmax()), int(joint[place].sum(axis=1)[best].argmax())]
    found = turn_search._most_probable(seen, heading, relative, prior, 1e-12)
    expected = [heading[number][row] for number, row in enumerate(rows)]
    # Headings lie between hypotheses, nearest to the best.
    off = wrap_angle(np.array(found.headings) - np.array(expected) + expected[0])
    assert np.abs(off).max() < math.tau / 4


def test_misread_photograph_does_not_choose_the_place() -> None:
    heading = [math.tau / 8 * np.arange(8)] * 3
    seen = [np.zeros((20, 8)) for _ in heading]
    # Two photographs agree on a place, and the third fits another one better than all others.
    seen[0][3, 2], seen[1][3, 5], seen[2][11, 1] = 6.0, 6.0, 20.0
    relative = [RelativeHeading(number, 0.0, 0.0) for number in range(3)]
    found = turn_search._most_probable(seen, heading, relative, np.zeros(20), 0.2)
    assert found.headings[1] == pytest.approx(3.0 * math.tau / 8)


def test_unknown_relative_headings_are_found_in_few_places(
    search: partial[SearchedTurn], monkeypatch: pytest.MonkeyPatch
) -> None:
    headings = [0.3, 1.5, 4.0]
    found = search(headings, [RelativeHeading(index, 0.0, 0.0) for index in range(3)])
    assert misses_deg(found, headings).max() < 0.75 * 360.0 / HEADINGS
    assert found.contradicted == ()
    monkeypatch.setattr(turn_search, "_MAX_PLACES", 8)
    found = search(headings[:2], [RelativeHeading(index, 0.0, 0.0) for index in range(2)])
    assert misses_deg(found, headings[:2]).max() < 0.75 * 360.0 / HEADINGS


def test_headings_beside_a_sphere_are_searched_near_its_place(
    search: partial[SearchedTurn], monkeypatch: pytest.MonkeyPatch
) -> None:
    headings, costs, compared = [0.3, 1.5, 4.0] * 6, MatchingCost.costs, list[int]()
    counted = lambda *given: compared.append(len(given[1])) or costs(*given)  # noqa: E731
    monkeypatch.setattr(MatchingCost, "costs", counted)
    unknown = [RelativeHeading(index, 0.0, 0.0) for index in range(18)]
    found = search(headings, unknown, Candidate(*SPOT_M, ROOM, 0.0, 0, 0.0, 0.0))
    assert misses_deg(found, headings).max() < 0.75 * 360.0 / HEADINGS
    assert max(compared) <= turn_search._NEAR
    # Few photographs choose the places of many.
    monkeypatch.setattr(turn_search, "_MAX_PLACES", 8)
    compared.clear()
    search(headings, unknown)
    assert sum(count > 8 for count in compared) == turn_search._MAX_CHOOSING


def test_relative_headings_within_groups_are_kept(search: partial[SearchedTurn]) -> None:
    headings = [0.3, 1.5, 4.0, 4.7]
    groups = [RelativeHeading(0, 0.0, 0.0), RelativeHeading(0, 1.2, 0.01), RelativeHeading(1, 0.0, 0.0)]
    found = search(headings, [*groups, RelativeHeading(1, 0.7, 0.01)])
    assert found.headings[1] == pytest.approx(1.2)
    assert wrap_angle(found.headings[3] - found.headings[2]) == pytest.approx(0.7)
    assert misses_deg(found, headings).max() < 0.75 * 360.0 / HEADINGS


def test_wrong_relative_heading_is_reported_and_ignored(search: partial[SearchedTurn]) -> None:
    headings = [0.3, 1.5, 4.0]
    told = [RelativeHeading(0, 0.0, 0.0), RelativeHeading(0, 2.9, 0.1), RelativeHeading(0, 3.7, 0.1)]
    found = search(headings, told)
    assert found.contradicted == (1,)
    assert misses_deg(found, headings).max() < 0.75 * 360.0 / HEADINGS


def test_photographs_have_the_place_of_all_and_their_own_headings(grid: PoseGrid, encoders: PhotographEncoder) -> None:
    joint = localise(PLAN, grid, encoders.layouts, query_at(encoders, 0.3), refine="none")
    found = TurnLocalisation(joint, [-0.5, 0.0, 1.0])
    np.testing.assert_allclose(found.turns, [0.0, 0.5, 1.5])
    for picture, heading in zip(found.pictures, found.headings, strict=True):
        assert picture.candidates == joint.candidates
        np.testing.assert_allclose(picture.query.roll, joint.query.roll + heading)
