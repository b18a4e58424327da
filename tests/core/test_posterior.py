"""Tests of the posterior over places, the probability map, signals, covariance and hints."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.bundle import Bundle, ConfidenceModel
from lalaloc_core.errors import InvalidHintError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import GridCosts, Posterior, Support, area_shares, pose_uncertainty, probability_map
from lalaloc_core.localise.belief.confidence import Signals, marginal_information, signals_of
from lalaloc_core.localise.belief.posterior import weighted_places
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import MatchingConfig, PoseGrid
from lalaloc_core.localise.query import NO_HINTS, CameraHeight, Candidate, Hints, Near, PredictedProfile, Query
from lalaloc_core.localise.query.hints import rooms_named
from lalaloc_core.localise.refine.latent_refiner import PoseRefiner
from lalaloc_core.localise.search.pipeline import Localisation, Refine, localise
from lalaloc_core.localise.search.retrieval import grid_costs
from lalaloc_core.render.sampling import PoseSet
from tests.core.questions import perfect_query
from tests.strategies import plan_of, present, rectangle, seeds

NOWHERE = Support(np.zeros(1, int), np.zeros((1, 2)), np.zeros(1), np.ones(1))
PLAIN = Query(np.eye(1), np.zeros(1), 0.0, heading_known=True, camera_height=CameraHeight(1.5))


def candidate(x_m: float, cost: float, hypothesis: int = 0) -> Candidate:
    return Candidate(x_m, 0.0, 0, 0.0, hypothesis, cost, 0.3)


def costs_at(places: list[float], cost: np.ndarray) -> GridCosts:
    position = np.stack([places, np.zeros(len(places))], axis=1)
    poses = PoseSet(position, np.zeros(len(places), int))
    return GridCosts.of_all(poses, np.atleast_2d(cost))


def posterior_at(
    grid: GridCosts, starts: list[Candidate], ends: list[Candidate] | None = None, query: Query = PLAIN
) -> Posterior:
    ends = starts if ends is None else ends
    candidates = sorted(ends, key=lambda end: end.cost)
    prior = np.zeros(len(grid.poses))
    places = weighted_places(grid, prior, query, starts=starts, ends=ends, temperature=16.0, separation_m=1.0)
    return places.posterior(candidates)


def test_map_is_of_the_refined_positions() -> None:
    plan = FloorPlan.from_dict({"ceiling_height_m": 2.5, "rooms": [{"polygon": [[-5, -2], [6, -2], [6, 2], [-5, 2]]}]})
    # Both candidates start beside the refined pose and end at it.
    places, cost = [-0.6, 0.0, 0.6, 3.0], np.array([0.2, 0.5, 0.2, 0.4])
    grid = costs_at(places, cost)
    starts = [candidate(-0.6, 0.2), candidate(0.6, 0.2)]
    ends = [dataclasses.replace(start, x_m=0.1, cost=0.02) for start in starts]
    found_map = probability_map(plan, grid.poses, posterior_at(grid, starts, ends))
    assert found_map.position_m[found_map.probability.argmax()] == pytest.approx([0.1, 0.0])
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
    found = posterior_at(grid, starts, [candidate(5.0, 0.17), candidate(0.1, 0.02)])
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
    places = weighted_places(grid, np.zeros(3), PLAIN, starts=starts, ends=ends, temperature=16.0, separation_m=1.0)
    assert places.posterior([ends[0], ends[2]]).candidate == pytest.approx((0.5, 0.5))


def test_poses_weigh_by_their_share_of_the_room() -> None:
    poses = PoseSet(np.zeros((5, 2)), np.array([0, 0, 0, 0, 1]))
    np.testing.assert_allclose(np.exp(area_shares(poses, np.array([1.0, 3.0]))), [0.25, 0.25, 0.25, 0.25, 3.0])


class TestSignals:
    def test_signals_are_computed_as_documented(self) -> None:
        profile = PredictedProfile(np.zeros((2, 4)), np.array([[-3.0, -2.0, -3.0, -2.0]]).repeat(2, axis=0))
        query = dataclasses.replace(PLAIN, profile=profile)
        posterior = Posterior(np.ones(1), 0.8, (0.7,), 1.0, NOWHERE)
        found = signals_of(query, candidate(5.0, 0.4), posterior, 0.6, 0.8)
        chances = {"cost_to_chance": math.log(0.61 / 0.81), "answer_to_chance": math.log(0.41 / 0.81)}
        expected = Signals(log_odds=math.log(4.0), cost=0.4, uncertainty=-2.5, latent_distance=0.3, **chances)
        assert dataclasses.astuple(found) == pytest.approx(dataclasses.astuple(expected))

    @pytest.mark.parametrize("profile", [None, PredictedProfile(np.zeros((1, 4)), np.full((1, 4), np.inf))])
    def test_signals_without_walls_or_cohort_are_zero(self, profile: PredictedProfile | None) -> None:
        posterior = Posterior(np.ones(1), 0.8, (0.7,), 1.0, NOWHERE)
        query = dataclasses.replace(PLAIN, profile=profile)
        found = signals_of(query, candidate(5.0, 0.4), posterior, 0.6, None)
        assert (found.uncertainty, found.cost_to_chance, found.answer_to_chance) == (0.0, 0.0, 0.0)

    @pytest.mark.parametrize(("mass", "log_odds"), [(0.0, -6.0), (1.0, 6.0), (1.0 + 1e-12, 6.0)])
    def test_log_odds_are_bounded(self, mass: float, log_odds: float) -> None:
        posterior = Posterior(np.ones(1), mass, (mass,), 1.0, NOWHERE)
        assert signals_of(PLAIN, candidate(0.0, 0.2), posterior, 0.2, None).log_odds == log_odds


MODEL = ConfidenceModel(
    known_heading={}, searched_heading={}, position_factor=0.5, position_factor_searched=0.7, heading_factor=0.3
)
ROOM_STD_M = math.hypot(5.0, 4.0) / math.sqrt(12.0)
ROOM = plan_of(rectangle(5.0, 4.0)).rooms[0]
unknowns = st.sampled_from([2, 3])


def information(seed: int, size: int, rank: int | None = None) -> np.ndarray:
    """Return a float32 information matrix of the given rank (full by default, at least 10 per m²)."""
    rows = np.random.default_rng(seed).normal(size=(size if rank is None else rank, size))
    matrix = rows.T @ rows + (np.eye(size) if rank is None else 0.0)
    return (10.0 * matrix).astype(np.float32)


def uncertainty_of(given: np.ndarray, model: ConfidenceModel = MODEL) -> tuple[np.ndarray, float | None]:
    return present(pose_uncertainty(given, ROOM, model))


class TestCovariance:
    @given(seed=seeds(), size=unknowns)
    def test_covariance_is_the_scaled_inverse(self, seed: int, size: int) -> None:
        given = information(seed, size)
        inverse = np.linalg.inv(given.astype(float))
        position_m2, heading_std = uncertainty_of(given)
        factor = present(MODEL.position_factor if size == 2 else MODEL.position_factor_searched)
        np.testing.assert_allclose(position_m2, factor * inverse[:2, :2], rtol=1e-3, atol=1e-6)
        if size == 3:
            assert heading_std == pytest.approx(math.sqrt(0.3 * inverse[2, 2]), rel=1e-3)
        else:
            assert heading_std is None

    @given(seed=seeds(), size=unknowns, rank=st.integers(0, 3), scale=st.floats(1e-12, 1e12))
    def test_covariance_is_symmetric_positive_and_bounded(self, seed: int, size: int, rank: int, scale: float) -> None:
        given = (scale * information(seed, size, min(rank, size))).astype(np.float32)
        position_m2, heading_std = uncertainty_of(given)
        np.testing.assert_array_equal(position_m2, position_m2.T)
        variance = np.linalg.eigvalsh(position_m2)
        assert variance.min() >= -1e-12 * variance.max()
        assert variance.max() <= ROOM_STD_M**2 * (1.0 + 1e-9)
        assert heading_std is None or 0.0 <= heading_std <= math.pi / math.sqrt(3.0)

    def test_unobserved_direction_is_as_wide_as_the_room_and_heading_uniform(self) -> None:
        position_m2, _ = uncertainty_of(np.diag([0.0, 400.0]))
        np.testing.assert_allclose(position_m2, np.diag([ROOM_STD_M**2, 0.5 / 400.0]), atol=1e-12)
        position_m2, heading_std = uncertainty_of(np.diag([100.0, 100.0, 0.0]))
        np.testing.assert_allclose(position_m2, 0.007 * np.eye(2), atol=1e-12)
        assert heading_std == math.pi / math.sqrt(3.0)

    @pytest.mark.parametrize(
        ("size", "missing"), [(2, "position_factor"), (3, "position_factor_searched"), (3, "heading_factor")]
    )
    def test_model_without_the_factor_has_no_covariance(self, size: int, missing: str) -> None:
        model = dataclasses.replace(MODEL, **{missing: None})
        assert pose_uncertainty(information(0, size), ROOM, model) is None
        # The factor of the other size does not matter.
        assert pose_uncertainty(information(0, 5 - size), ROOM, model) is not None


class TestMarginalInformation:
    @given(seed=seeds())
    def test_marginal_inverts_the_blocks_of_the_inverse(self, seed: int) -> None:
        given = information(seed, 3).astype(float)
        inverse = np.linalg.inv(given)
        by_position, by_heading = marginal_information(given)
        np.testing.assert_allclose(by_position, np.linalg.inv(inverse[:2, :2]), rtol=1e-6, atol=1e-6)
        assert by_heading == pytest.approx(1.0 / inverse[2, 2], rel=1e-4)


CAMERA_M = 1.5
Ask = Callable[..., Localisation]
# The plan has two identical rooms and a different one.
ROOM_M, OFFSET_M = (4.0, 3.0), 10.0
STANDS_M = (1.3, 0.9)
COPIES = [{"name": "Bedroom", "polygon": rectangle(*ROOM_M, corner=(x, 0.0))} for x in (0.0, OFFSET_M)]
HALL = {"name": "hall", "polygon": rectangle(7.0, 1.6, corner=(0.0, 5.0))}
PLAN = FloorPlan.from_dict({"ceiling_height_m": 2.5, "rooms": [*COPIES, HALL]})


@pytest.fixture(scope="module")
def encoders(opened_bundle: Bundle) -> PhotographEncoder:
    """PhotographEncoder with the temperature of the shipped model."""
    encoders = PhotographEncoder(opened_bundle, threads=1)
    manifest = encoders.manifest
    encoders.manifest = encoders.layouts.manifest = replace(
        manifest, evidence=replace(manifest.evidence, temperature=44.0)
    )
    return encoders


@pytest.fixture(scope="module")
def grid(encoders: PhotographEncoder) -> PoseGrid:
    return build_grid(PLAN, encoders.layouts, step_m=0.5, camera_height_m=CAMERA_M)


@pytest.fixture(scope="module")
def query(encoders: PhotographEncoder) -> Query:
    return perfect_query(encoders, PLAN, STANDS_M)


class TestLocalisation:
    @pytest.fixture
    def ask(self, grid: PoseGrid, encoders: PhotographEncoder, optimiser: PoseRefiner) -> Ask:
        def localised(query: Query, hints: Hints = NO_HINTS, refine: Refine = "lpo") -> Localisation:
            return localise(PLAN, grid, encoders.layouts, query, refine=refine, refiner=optimiser.refine, hints=hints)

        return localised

    @pytest.mark.parametrize("room", [0, 1])
    @pytest.mark.parametrize("refine", ["none", "vdr", "lpo"])
    def test_hint_decides_between_identical_rooms(self, ask: Ask, query: Query, room: int, refine: Refine) -> None:
        assert ask(query, refine=refine).posterior.candidate[:2] == pytest.approx([0.5, 0.5], abs=0.02)
        near = Near(STANDS_M[0] + room * OFFSET_M + 0.5, STANDS_M[1], 2.0)
        for hints in (Hints(near=near), Hints(rooms=frozenset({room}))):
            found = ask(query, hints, refine)
            assert found.candidates[0].room_index == room
            assert found.posterior.candidate[0] > 0.95
            assert found.hints_missed == ()

    @pytest.mark.parametrize("refine", ["none", "vdr", "lpo"])
    def test_wrong_hint_does_not_override_a_clear_match(
        self, ask: Ask, encoders: PhotographEncoder, refine: Refine
    ) -> None:
        query = perfect_query(encoders, PLAN, (2.1, 5.7))
        for hints, missed in (
            (Hints(near=Near(12.0, 1.5, 3.0)), ("near",)),
            (Hints(near=Near(12.0, 1.5, 3.0), rooms=frozenset({0, 1})), ("near", "rooms")),
        ):
            found = ask(query, hints, refine)
            assert found.candidates[0].room_index == 2
            assert np.linalg.norm(found.candidates[0].position_m - (2.1, 5.7)) < 0.5
            assert found.hints_missed == missed

    def test_hint_changes_the_odds_as_documented_and_not_the_cost(self, ask: Ask, query: Query) -> None:
        share = ROOM_M[0] * ROOM_M[1] / PLAN.area_m2
        odds = 1.0 + 0.98 / (0.02 * share)
        first, second = ask(query, Hints(rooms=frozenset({1})), "lpo").posterior.candidate[:2]
        assert first / second == pytest.approx(odds, rel=0.05)
        wrong = Hints(near=Near(2.0, 5.8, 1.0))
        assert ask(query, wrong).candidates[0].cost == pytest.approx(ask(query).candidates[0].cost, abs=1e-4)

    @pytest.mark.parametrize("refine", ["none", "vdr", "lpo"])
    def test_strict_hints_restrict_and_report_contradictions(
        self, ask: Ask, encoders: PhotographEncoder, refine: Refine
    ) -> None:
        query = perfect_query(encoders, PLAN, (2.1, 5.7))
        near = Near(11.0, 1.0, 0.8)
        found = ask(query, Hints(near=near, strict=True), refine)
        places = np.stack([candidate.position_m for candidate in found.candidates])
        assert (near.distance_m(places, np.zeros(len(places), int)) <= near.radius_m + 1e-9).all()
        assert found.hints_missed == ("near",)
        assert ask(query, Hints(rooms=frozenset({0}), strict=True), refine).candidates[0].room_index == 0

    def test_strict_hint_that_agrees_is_not_missed_and_needs_grid_poses(self, ask: Ask, query: Query) -> None:
        found = ask(query, Hints(rooms=frozenset({1}), strict=True))
        assert found.hints_missed == ()
        assert found.posterior.candidate[0] == pytest.approx(1.0, abs=1e-6)
        with pytest.raises(InvalidHintError, match=r"none of the \d+ grid poses, 0.5 m apart.*omit strict"):
            ask(query, Hints(near=Near(5.0, 1.5, 1.05), rooms=frozenset({2}), strict=True))


def test_allowed_poses_of_a_large_grid_are_compared(
    grid: PoseGrid, encoders: PhotographEncoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit, poses in (("ALL", 0), ("MIN", 8), ("MAX", 8)):
        monkeypatch.setattr(f"lalaloc_core.localise.search.retrieval._{limit}_COMPARED", poses)
    query = perfect_query(encoders, PLAN, (2.1, 5.7))
    hints = Hints(rooms=frozenset({1}), strict=True)
    costs = grid_costs(PLAN, grid, query, encoders.manifest.evidence, MatchingConfig(), hints)
    rooms, total = grid.poses.room_index[costs.pose[: costs.compared]], costs.total[: costs.compared]
    assert costs.compared < len(grid.poses)
    assert {1, 2} <= set(rooms.tolist())
    assert np.isfinite(total[rooms == 1]).all()
    assert np.isinf(total[rooms != 1]).all()


@given(seed=seeds(), radius_m=st.floats(0.1, 1000.0), strict=st.booleans())
def test_penalty_is_bounded_and_grows_with_distance(seed: int, radius_m: float, strict: bool) -> None:
    plan = plan_of(rectangle(8.0, 6.0))
    x_m, y_m = np.random.default_rng(seed).uniform([0.0, 0.0], [8.0, 6.0])
    distance_m = np.linspace(0.0, 3.0 * radius_m, 50)
    places = np.stack([x_m + distance_m, np.full(50, y_m)], axis=1)
    found = Hints(near=Near(x_m, y_m, radius_m), strict=strict).penalty(plan, places, np.zeros(50, int))
    assert found[0] == pytest.approx(0.0, abs=1e-12)
    assert (np.diff(found[np.isfinite(found)]) >= -1e-12).all()
    if strict:
        assert (np.isinf(found) == (distance_m > radius_m * (1.0 + 1e-6))).mean() > 0.97
    else:
        assert found.max() <= math.log1p(0.98 / 0.02 / 1e-3) + 1e-9


class TestChecks:
    @pytest.mark.parametrize(
        ("hints", "message"),
        [
            (Hints(near=Near(1.0, 1.0, 0.05)), "radius_m: it is 0.05 m; it must be between 0.1 and 1000 m"),
            (Hints(near=Near(1.0, 1.0, 2e3)), "radius_m: it is 2000 m"),
            (Hints(near=Near(math.nan, 1.0, 1.0)), "near: .* is not a point"),
            (
                Hints(near=Near(-6.0, 1.0, 5.0)),
                r"near: \(-6, 1\) is 6 m from the nearest room of the plan; the limit is radius_m",
            ),
            (Hints(rooms=frozenset()), "rooms: no room is named"),
        ],
    )
    def test_invalid_hints_are_refused(self, hints: Hints, message: str) -> None:
        with pytest.raises(InvalidHintError, match=message):
            hints.check(PLAN)

    def test_rooms_are_found_by_id_then_by_name(self) -> None:
        assert [room.id for room in PLAN.rooms] == ["bedroom", "bedroom-2", "hall"]
        assert rooms_named(PLAN, ["bedroom-2"]) == {1}
        assert rooms_named(PLAN, ["Bedroom"]) == {0, 1}
        assert rooms_named(PLAN, ["bedroom", " HALL "]) == {0, 2}
        with pytest.raises(InvalidHintError, match="no room 'attic'; its rooms are 'bedroom', 'bedroom-2', 'hall'"):
            rooms_named(PLAN, ["hall", "attic"])

    def test_no_hints_are_never_missed(self) -> None:
        assert NO_HINTS.are_none
        assert not replace(NO_HINTS, rooms=frozenset({1})).are_none
        assert NO_HINTS.missed(np.zeros(2), 0) == ()
