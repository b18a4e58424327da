"""Tests of the matching cost: walls, openings, ceiling, room type and camera height."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.conventions import DOOR_CODE, OPENING_CLASSES, PASSAGE_CODE, ROOM_TYPES, WALL_CODE, WINDOW_CODE
from lalaloc_core.errors import ConfigError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.match import Layouts, MatchingConfig, MatchingCost
from lalaloc_core.localise.match.cost_terms import class_losses, precisions
from lalaloc_core.localise.match.pose_grid import SeenThrough
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.localise.query.query import PredictedCeiling, PredictedOpenings, PredictedProfile, PredictedRoomType
from tests.strategies import seeds

CONFIG = MatchingConfig()
EXACT = CameraHeight(1.5, 0.0)
WEIGHTS = MatchingWeights(openings=0.5, ceiling=0.25, room_type=0.125, tail=2.0, temperature=10.0)
PRIOR = np.array([0.7, 0.15, 0.1, 0.05])
PLAN = FloorPlan.from_dict(
    {
        "rooms": [
            {"name": "hall", "type": "corridor", "ceiling_height_m": 2.5, "polygon": [[0, 0], [4, 0], [4, 3], [0, 3]]},
            {"name": "den", "types": [], "ceiling_height_m": 3.5, "polygon": [[4.1, 0], [8, 0], [8, 3], [4.1, 3]]},
        ],
        "openings": [{"kind": "door", "line": [[4, 1], [4, 2]]}, {"kind": "window", "line": [[1, 0], [2, 0]]}],
    }
)


def make_query(log_m: np.ndarray, log_scale: np.ndarray, height: CameraHeight = EXACT, **more: Any) -> Query:
    count = len(log_m)
    profile = PredictedProfile(log_m, log_scale)
    return Query(np.eye(count), np.arange(count) * 0.1, 0.0, False, height, profile, **more)


def openings(probability: np.ndarray) -> PredictedOpenings:
    return PredictedOpenings(np.log(probability), PRIOR)


def costs(query: Query, layouts: Layouts, reach_m: float = 0.1, **changed: Any) -> np.ndarray:
    return MatchingCost(PLAN, query, reach_m, WEIGHTS, dataclasses.replace(CONFIG, **changed)).costs(layouts)[0]


def hall_layouts(log_profile: np.ndarray, kind: np.ndarray | None = None, seen: SeenThrough | None = None) -> Layouts:
    return Layouts(log_profile.astype(np.float32), np.zeros(len(log_profile), int), kind, seen)


class TestWalls:
    @given(seed=seeds(), reach_m=st.floats(0.0, 0.5), columns=st.sampled_from([9, 12]))
    def test_cost_is_the_documented_formula(self, seed: int, reach_m: float, columns: int) -> None:
        rng = np.random.default_rng(seed)
        profiles = rng.uniform(0.3, 6.0, (5, columns))
        query = make_query(rng.normal(size=(3, columns)), rng.normal(-2.0, 1.0, (3, columns)))
        assert query.profile is not None
        found = costs(query, hall_layouts(np.log(profiles)), reach_m)
        for k in range(3):
            for cost, profile in zip(found[k], profiles, strict=True):
                total = 0.0
                for d, mu, log_b in zip(profile, query.profile.log_m[k], query.profile.log_scale[k], strict=True):
                    s = math.hypot(math.exp(log_b), reach_m / math.exp(mu))
                    total += math.log(1.0 + ((math.log(d) - mu) / (2.0 * s)) ** 2)
                assert cost == pytest.approx(total / columns, rel=1e-4, abs=1e-5)

    def test_open_door_costs_less_than_a_wrong_room(self) -> None:
        query = make_query(np.zeros((1, 128)), np.full((1, 128), math.log(0.05)))
        door, other_room = np.zeros(128), np.full(128, 0.3)
        door[:10] = math.log(20.0)
        assert np.square(door).mean() > np.square(other_room).mean()
        through, wrong = costs(query, hall_layouts(np.stack([door, other_room])), 0.0)[0]
        assert through < 0.5 * wrong

    def test_precision_is_bounded_and_lowered_by_reach_most_beside_walls(self) -> None:
        profile = np.log(np.array([[0.3, 1.0, 4.0]])), np.full((1, 3), -3.0)
        fine, coarse = (precisions(*profile, reach_m, WEIGHTS.tail)[0] for reach_m in (0.05, 0.3))
        assert (coarse < fine).all()
        assert (np.diff(coarse / fine) > 0.0).all()
        np.testing.assert_allclose(
            precisions(np.zeros((1, 4)), np.full((1, 4), -80.0), 0.0, WEIGHTS.tail), 1.0 / (2.0 * 1e-3)
        )

    def test_opening_fits_the_wall_or_the_room_behind(self) -> None:
        columns, wall, behind = 16, np.zeros((3, 16)), math.log(4.0)
        door = np.arange(4)
        seen = SeenThrough(
            np.repeat([0, 1], 4), np.tile(door, 2), np.full(8, DOOR_CODE, np.uint8), np.full(8, behind, np.float32)
        )
        open_m, shut_m = np.zeros((1, columns)), np.zeros((1, columns))
        open_m[0, door] = behind
        log_scale = np.full((1, columns), -3.0)
        for log_m in (open_m, shut_m):
            with_door, _, without = costs(make_query(log_m, log_scale), hall_layouts(wall, seen=seen), open_door=0.4)[0]
            assert with_door < 0.4
            if log_m is open_m:
                assert without > with_door + 0.5
        # A wall half-way into the next room fits neither.
        between = np.zeros((1, columns))
        between[0, door] = 0.5 * behind
        assert costs(make_query(between, log_scale), hall_layouts(wall, seen=seen), open_door=0.4)[0, 0] > 0.6
        ignoring = costs(make_query(open_m, log_scale), hall_layouts(wall, seen=seen), use_see_through=False)[0]
        assert ignoring[0] == pytest.approx(ignoring[2])


class TestOpenings:
    @given(seeds())
    def test_cost_is_the_documented_formula(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        probability = rng.dirichlet(np.ones(4), (2, 12))
        kind = rng.choice([WALL_CODE, DOOR_CODE, WINDOW_CODE], (5, 12)).astype(np.uint8)
        log_m = np.zeros((2, 12))
        query = make_query(log_m, log_m, openings=openings(probability))
        # The plan has no passages: their probability counts as wall.
        merged, prior = probability.copy(), PRIOR.copy()
        merged[..., WALL_CODE] += merged[..., PASSAGE_CODE]
        prior[WALL_CODE] += prior[PASSAGE_CODE]
        ratio = (0.03 + 0.97 * merged / prior)[..., :PASSAGE_CODE]
        found = costs(query, hall_layouts(np.zeros((5, 12)), kind), reach_m=0.0)
        for k in range(2):
            for n in range(5):
                terms = [math.log(ratio[k, w].max() / ratio[k, w, kind[n, w]]) for w in range(12)]
                assert found[k, n] == pytest.approx(0.5 * np.mean(terms), rel=1e-4, abs=1e-6)

    def test_unclaimed_opening_kind_costs_nothing(self) -> None:
        plan = FloorPlan.from_dict({**PLAN.to_dict(), "opening_kinds": ["door"]})
        window = np.full((1, 8, 4), 0.01)
        window[..., WINDOW_CODE] = 0.97
        query = make_query(np.zeros((1, 8)), np.zeros((1, 8)), openings=openings(window))
        layouts = hall_layouts(np.zeros((1, 8)), np.full((1, 8), WALL_CODE, np.uint8))
        claimed, unclaimed = (
            MatchingCost(p, query, 0.0, WEIGHTS, CONFIG).costs(layouts)[0][0, 0] for p in (PLAN, plan)
        )
        assert claimed > 1.0
        assert unclaimed < 0.02

    def test_trust_mixes_the_drawn_class_with_what_is_left_out_elsewhere(self) -> None:
        plan = FloorPlan.from_dict({**PLAN.to_dict(), "opening_kinds": ["window"], "opening_trust": {"door": 0.6}})
        probability = np.random.default_rng(3).dirichlet(np.ones(4), (1, 8))
        query = make_query(np.zeros((1, 8)), np.zeros((1, 8)), openings=openings(probability))
        kinds = [WALL_CODE, DOOR_CODE, WINDOW_CODE, PASSAGE_CODE]
        layouts = hall_layouts(np.zeros((4, 8)), np.repeat(np.array(kinds, np.uint8)[:, None], 8, axis=1))
        found = MatchingCost(plan, query, 0.0, WEIGHTS, CONFIG).costs(layouts)[0][0]
        ratio = probability[0] / PRIOR
        missing = PRIOR * [1.0, 0.4, 0.0, 1.0]
        elsewhere = ratio @ missing / missing.sum()
        drawn = np.stack([elsewhere, 0.6 * ratio[:, 1] + 0.4 * elsewhere, ratio[:, 2], elsewhere], axis=1)
        likelihood = np.log(0.03 + 0.97 * drawn)
        expected = 0.5 * (likelihood.max(axis=1, keepdims=True) - likelihood).mean(axis=0)
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)

    @pytest.mark.parametrize("kinds", [[], ["door"], ["window", "passage"]])
    def test_trust_of_0_and_1_costs_the_same_as_a_list_of_kinds(self, kinds: list[str]) -> None:
        trust = {kind: float(kind in kinds) for kind in ("door", "window", "passage")}
        listed, trusted = (
            FloorPlan.from_dict(PLAN.to_dict() | claims)
            for claims in ({"opening_kinds": kinds}, {"opening_kinds": [], "opening_trust": trust})
        )
        probability = np.random.default_rng(4).dirichlet(np.ones(4), (1, 8))
        query = make_query(np.zeros((1, 8)), np.zeros((1, 8)), openings=openings(probability))
        layouts = hall_layouts(np.zeros((4, 8)), np.repeat(np.arange(4, dtype=np.uint8)[:, None], 8, axis=1))
        found = [MatchingCost(plan, query, 0.0, WEIGHTS, CONFIG).costs(layouts)[0] for plan in (listed, trusted)]
        np.testing.assert_array_equal(found[0], found[1])

    def test_uninformative_openings_favour_no_kind(self) -> None:
        # An uninformative prediction equals the prior, so every class costs the same.
        query = make_query(np.zeros((1, 8)), np.zeros((1, 8)), openings=openings(np.tile(PRIOR, (1, 8, 1))))
        kinds = np.array([[WALL_CODE] * 8, [WINDOW_CODE] * 8, [DOOR_CODE] * 8], np.uint8)
        assert np.ptp(costs(query, hall_layouts(np.zeros((3, 8)), kinds))[0]) < 1e-3

    def test_openings_are_blurred_by_the_distance_of_walls_that_are_seen(self) -> None:
        seen = np.arange(64) < 20
        probability = np.tile(PRIOR, (1, 64, 1))
        probability[:, 5] = [0.1, 0.1, 0.1, 0.7]
        view, sphere = (
            make_query(log_m, log_scale, openings=openings(probability))
            for log_m, log_scale in [
                (np.where(seen, np.log(8.0), 0.0)[None], np.where(seen, -1.0, np.inf)[None]),
                (np.full((1, 64), np.log(8.0)), np.full((1, 64), -1.0)),
            ]
        )
        layouts = hall_layouts(np.zeros((2, 64)), np.array([[WALL_CODE] * 64, [DOOR_CODE] * 64], np.uint8))
        by_view, by_sphere = (
            MatchingCost(PLAN, query, 1.0, WEIGHTS, CONFIG).terms(layouts, np.zeros(2, np.intp), np.zeros(2)).openings
            for query in (view, sphere)
        )
        np.testing.assert_allclose(by_view, by_sphere, rtol=1e-6)

    @given(seeds(), st.sets(st.sampled_from([DOOR_CODE, WINDOW_CODE, PASSAGE_CODE])))
    def test_appearance_is_a_mixture_over_what_is_seen(self, seed: int, claimed: set[int]) -> None:
        rng = np.random.default_rng(seed)
        probability, prior = rng.dirichlet(np.ones(4), 5), rng.dirichlet(np.full(4, 5.0))
        appearance, floor = rng.dirichlet(np.ones(4), 4), 0.03
        trust = [float(kind in claimed) for kind in range(4)]
        found = class_losses(probability, prior, trust, floor, appearance.tolist())
        for azimuth, drawn in np.ndindex(found.shape):
            # Classes that the plan does not claim are drawn as wall.
            kinds = [drawn] if drawn in claimed else [kind for kind in range(4) if kind not in claimed]
            share = sum(
                prior[kind] / prior[kinds].sum() * appearance[kind, seen] * probability[azimuth, seen] / prior[seen]
                for kind in kinds
                for seen in range(4)
            )
            assert found[azimuth, drawn] == pytest.approx(-math.log(floor + (1.0 - floor) * share), abs=1e-9)
        itself = class_losses(probability, prior, trust, floor, np.eye(4).tolist())
        np.testing.assert_allclose(class_losses(probability, prior, trust, floor), itself, atol=1e-12)

    @pytest.mark.parametrize("rows", [((1.0, 0.0),) * 4, ((0.5, 0.3, 0.1, 0.0),) * 4, ((1.5, -0.5, 0.0, 0.0),) * 4])
    def test_invalid_appearance_is_refused(self, rows: tuple[tuple[float, ...], ...]) -> None:
        with pytest.raises(ConfigError, match="4 rows of 4 probabilities that sum to 1"):
            MatchingWeights(appearance=rows)

    def test_reach_blurs_openings(self) -> None:
        door = np.full((1, 128, 4), 0.01)
        door[..., WALL_CODE] = 0.97
        door[0, 60:70] = [0.01, 0.97, 0.01, 0.01]
        query = make_query(np.full((1, 128), math.log(2.0)), np.zeros((1, 128)), openings=openings(door))
        beside = np.zeros((1, 128), np.uint8)
        beside[0, 66:76] = DOOR_CODE
        fine, coarse = (
            costs(query, hall_layouts(np.full((1, 128), math.log(2.0)), beside), r)[0, 0] for r in (0.0, 0.3)
        )
        assert coarse < fine

    @given(seed=seeds())
    def test_losses_of_a_turned_prediction_are_those_of_each_hypothesis(self, seed: int) -> None:
        rng, shifts = np.random.default_rng(seed), np.array([0, 2, 5, 11])
        probability = rng.dirichlet(np.ones(len(OPENING_CLASSES)), 16)
        turned = np.stack([np.roll(probability, shift, axis=0) for shift in shifts])
        query = make_query(np.zeros((4, 16)), np.zeros((4, 16)), openings=openings(turned))
        # The other headings are not those that the prediction was turned by.
        found, each = (
            MatchingCost(PLAN, dataclasses.replace(query, roll=roll), 0.2, WEIGHTS, CONFIG).opening_costs(np.arange(16))
            for roll in (shifts * (math.tau / 16), query.roll)
        )
        assert found is not None
        assert each is not None
        np.testing.assert_allclose(found, each, atol=1e-6)


class TestCeilingAndRoomType:
    def test_ceiling_cost_is_zero_at_the_predicted_height(self) -> None:
        query = make_query(np.zeros((1, 4)), np.zeros((1, 4)), ceiling=PredictedCeiling(math.log(1.0), -3.0))
        layouts = Layouts(np.zeros((2, 4), np.float32), np.array([0, 1]))
        hall, den = costs(query, layouts)[0]
        assert hall == pytest.approx(0.0, abs=1e-6)
        scale = 2.0 * math.hypot(math.exp(-3.0), 0.04)
        assert den == pytest.approx(0.25 * math.log(1.0 + (math.log(2.0) / scale) ** 2), rel=1e-4)
        assert costs(query, layouts, use_ceiling=False)[0, 1] == 0.0

    def test_ceiling_determines_the_camera_height(self) -> None:
        # At 1.5 m the predicted ceiling lies 1 m above the camera: at the 2.5 m of the plan.
        height = CameraHeight(1.8, math.inf)
        query = make_query(
            np.zeros((1, 4)), np.full((1, 4), 2.0), height, ceiling=PredictedCeiling(math.log(1.2), -3.0)
        )
        _, offset = MatchingCost(PLAN, query, 0.1, WEIGHTS, CONFIG).costs(hall_layouts(np.zeros((1, 4))))
        assert 1.8 * math.exp(offset[0, 0]) == pytest.approx(1.5, rel=0.06)

    def test_only_stated_room_types_are_compared(self) -> None:
        def costs_of(room_type: str) -> np.ndarray:
            probability = np.full(len(ROOM_TYPES), 0.01)
            probability[ROOM_TYPES.index(room_type)] = 0.85
            prior = np.full(len(ROOM_TYPES), 1.0 / len(ROOM_TYPES))
            query = make_query(
                np.zeros((1, 4)), np.zeros((1, 4)), room_type=PredictedRoomType(np.log(probability), prior)
            )
            return costs(query, Layouts(np.zeros((2, 4), np.float32), np.array([0, 1])))[0]

        corridor, bedroom = costs_of("corridor"), costs_of("bedroom")
        assert corridor[0] == pytest.approx(0.0, abs=1e-9)
        assert 0.0 < corridor[1] < bedroom[0]
        # The second room has no type, so its cost does not depend on the prediction.
        assert corridor[1] == pytest.approx(bedroom[1])


class TestCameraHeight:
    def test_best_height_offset_is_found_and_penalised(self) -> None:
        height = CameraHeight(1.5, 0.1)
        true = height.offsets[0]
        profile = np.random.default_rng(0).normal(size=(1, 16))
        query = make_query(profile - true, np.full((1, 16), -4.0), height)
        cost, offset = MatchingCost(PLAN, query, 0.05, WEIGHTS, CONFIG).costs(hall_layouts(profile))
        assert offset[0, 0] == true
        assert cost[0, 0] == pytest.approx(height.penalty(np.array([true]))[0] / WEIGHTS.temperature, abs=1e-5)

    @given(st.floats(0.5, 2.5), st.floats(0.01, 0.5))
    def test_offsets_cover_the_probable_range_densely(self, height_m: float, std_m: float) -> None:
        height = CameraHeight(height_m, std_m)
        assert np.abs(height.offsets).min() < 1e-12
        assert np.diff(height.offsets).max(initial=0.0) <= 0.1 + 1e-9
        assert height.offsets[-1] == pytest.approx(1.5 * std_m / height_m)
        low, high = height.bounds
        assert low < height.offsets[0] <= 0.0 <= height.offsets[-1] < high

    def test_unknown_height_covers_hand_held_heights(self) -> None:
        height = CameraHeight(1.5, math.inf)
        heights_m = 1.5 * np.exp(height.offsets)
        np.testing.assert_allclose(heights_m[[0, -1]], [0.8, 2.2])
        assert (height.penalty(height.offsets) == 0.0).all()

    @pytest.mark.parametrize(
        ("height_m", "std_m"), [(0.0, 0.1), (-1.0, 0.1), (math.nan, 0.1), (1.5, -0.1), (1.5, math.nan)]
    )
    def test_invalid_height_is_refused(self, height_m: float, std_m: float) -> None:
        with pytest.raises(ValueError, match="camera height"):
            CameraHeight(height_m, std_m)


def test_terms_add_up_to_the_cost() -> None:
    rng = np.random.default_rng(0)
    seen = SeenThrough(np.array([1, 2]), np.array([3, 5]), np.full(2, DOOR_CODE, np.uint8), np.full(2, 1.5, np.float32))
    log_profile = rng.normal(size=(4, 12)).astype(np.float32)
    kind = rng.choice([WALL_CODE, DOOR_CODE], (4, 12)).astype(np.uint8)
    layouts = Layouts(log_profile, np.array([0, 1, 0, 1]), kind, seen)
    types = np.full(len(ROOM_TYPES), 1.0 / len(ROOM_TYPES))
    query = make_query(
        rng.normal(size=(2, 12)),
        rng.normal(-2.0, 0.5, (2, 12)),
        CameraHeight(1.5, 0.1),
        openings=openings(rng.dirichlet(np.ones(len(OPENING_CLASSES)), (2, 12))),
        ceiling=PredictedCeiling(0.2, -2.0),
        room_type=PredictedRoomType(np.log(rng.dirichlet(np.ones(len(ROOM_TYPES)))), types),
    )
    matching_cost = MatchingCost(PLAN, query, 0.1, WEIGHTS, CONFIG)
    cost, offset = matching_cost.costs(layouts)
    for k in range(2):
        terms = matching_cost.terms(layouts, np.full(4, k), offset[k])
        np.testing.assert_allclose(terms.total(WEIGHTS), cost[k], rtol=1e-4)
        assert min(values.min() for values in terms) >= 0.0
    # At an exact height, also the means over azimuths with the costs of rooms do.
    exact = MatchingCost(PLAN, dataclasses.replace(query, camera_height=EXACT), 0.1, WEIGHTS, CONFIG)
    by_azimuth = exact.by_azimuth(layouts)
    assert by_azimuth.shape == (2, 4, 12)
    expected = by_azimuth.mean(axis=2) + exact.room_costs[0, layouts.room_index]
    np.testing.assert_allclose(exact.costs(layouts)[0], expected, rtol=1e-4)
