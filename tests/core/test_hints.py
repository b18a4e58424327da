"""Tests of hints: they decide between equal matches and do not override a clear one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.errors import InvalidHintError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.hints import NO_HINTS, Hints, Near, rooms_named
from lalaloc_core.localise.matching_cost import MatchingConfig
from lalaloc_core.localise.optimise import PoseRefiner
from lalaloc_core.localise.pipeline import Localisation, Refine, localise
from lalaloc_core.localise.poses import PoseGrid, PredictedProfile, Query
from lalaloc_core.localise.retrieval import build_grid, grid_costs
from lalaloc_core.render.sampling import PoseSet
from tests.strategies import plan_of, rectangle, seeds

CAMERA_M = 1.5
Ask = Callable[..., Localisation]
# The plan has two identical rooms and a different one.
ROOM_M, OFFSET_M = (4.0, 3.0), 10.0
STANDS = PoseSet(np.array([[1.3, 0.9]]), np.array([0]))


@pytest.fixture(scope="module")
def encoders(opened_bundle: Bundle) -> Encoders:
    """Encoders with the temperature of the shipped model."""
    encoders = Encoders(opened_bundle, threads=1)
    encoders.manifest = replace(encoders.manifest, evidence=replace(encoders.manifest.evidence, temperature=44.0))
    return encoders


@pytest.fixture(scope="module")
def plan() -> FloorPlan:
    copies = [{"name": "Bedroom", "polygon": rectangle(*ROOM_M, at=(x, 0.0))} for x in (0.0, OFFSET_M)]
    hall = {"name": "hall", "polygon": rectangle(7.0, 1.6, at=(0.0, 5.0))}
    return FloorPlan.from_dict({"ceiling_height_m": 2.5, "rooms": [*copies, hall]})


@pytest.fixture(scope="module")
def grid(plan: FloorPlan, encoders: Encoders) -> PoseGrid:
    return build_grid(plan, encoders, step_m=0.5, camera_height_m=CAMERA_M)


def query_at(encoders: Encoders, plan: FloorPlan, pose: PoseSet) -> Query:
    """Return the query of a perfect image encoder at a pose."""
    latents, profile_m = encoders.poses(plan, pose, np.zeros(1), CAMERA_M)
    profile = PredictedProfile(np.log(profile_m), np.full_like(profile_m, -4.0))
    height = CameraHeight(CAMERA_M, 0.0)
    return Query(latents, np.zeros(1), 0.0, heading_known=True, camera_height=height, profile=profile)


@pytest.fixture(scope="module")
def query(plan: FloorPlan, encoders: Encoders) -> Query:
    return query_at(encoders, plan, STANDS)


class TestLocalisation:
    @pytest.fixture
    def ask(self, plan: FloorPlan, grid: PoseGrid, encoders: Encoders, optimiser: PoseRefiner) -> Ask:
        def localised(query: Query, hints: Hints = NO_HINTS, refine: Refine = "lpo") -> Localisation:
            return localise(plan, grid, encoders, query, refine=refine, refiner=optimiser.refine, hints=hints)

        return localised

    @pytest.mark.parametrize("room", [0, 1])
    @pytest.mark.parametrize("refine", ["none", "vdr", "lpo"])
    def test_hint_decides_between_identical_rooms(self, ask: Ask, query: Query, room: int, refine: Refine) -> None:
        unhinted = ask(query, refine=refine)
        assert unhinted.posterior.candidate[:2] == pytest.approx([0.5, 0.5], abs=0.02)
        near = Near(STANDS.position_m[0, 0] + room * OFFSET_M + 0.5, STANDS.position_m[0, 1], 2.0)
        for hints in (Hints(near=near), Hints(rooms=frozenset({room}))):
            found = ask(query, hints, refine)
            assert found.candidates[0].room_index == room
            assert found.posterior.candidate[0] > 0.95
            assert found.hints_missed == ()

    @pytest.mark.parametrize("refine", ["none", "vdr", "lpo"])
    def test_wrong_hint_does_not_override_a_clear_match(
        self, ask: Ask, plan: FloorPlan, encoders: Encoders, refine: Refine
    ) -> None:
        stands = PoseSet(np.array([[2.1, 5.7]]), np.array([2]))
        query = query_at(encoders, plan, stands)
        for hints, missed in (
            (Hints(near=Near(12.0, 1.5, 3.0)), ("near",)),
            (Hints(near=Near(12.0, 1.5, 3.0), rooms=frozenset({0, 1})), ("near", "rooms")),
        ):
            found = ask(query, hints, refine)
            assert found.candidates[0].room_index == 2
            assert np.linalg.norm(found.candidates[0].position_m - stands.position_m[0]) < 0.5
            assert found.hints_missed == missed

    def test_hint_changes_the_odds_as_documented(self, ask: Ask, plan: FloorPlan, query: Query) -> None:
        share = ROOM_M[0] * ROOM_M[1] / plan.area_m2
        odds = 1.0 + 0.98 / (0.02 * share)
        found = ask(query, Hints(rooms=frozenset({1})), "lpo")
        first, second = found.posterior.candidate[:2]
        assert first / second == pytest.approx(odds, rel=0.05)

    @pytest.mark.parametrize("refine", ["none", "vdr", "lpo"])
    def test_strict_hints_restrict_and_report_contradictions(
        self, ask: Ask, plan: FloorPlan, encoders: Encoders, refine: Refine
    ) -> None:
        query = query_at(encoders, plan, PoseSet(np.array([[2.1, 5.7]]), np.array([2])))
        near = Near(11.0, 1.0, 0.8)
        found = ask(query, Hints(near=near, strict=True), refine)
        places = np.stack([candidate.position_m for candidate in found.candidates])
        assert (near.distance_m(places, np.zeros(len(places), int)) <= near.radius_m + 1e-9).all()
        assert found.hints_missed == ("near",)
        assert ask(query, Hints(rooms=frozenset({0}), strict=True), refine).candidates[0].room_index == 0

    def test_strict_hint_that_agrees_is_not_missed(self, ask: Ask, query: Query) -> None:
        found = ask(query, Hints(rooms=frozenset({1}), strict=True))
        assert found.hints_missed == ()
        assert found.posterior.candidate[0] == pytest.approx(1.0, abs=1e-6)

    def test_hints_do_not_change_the_cost(self, ask: Ask, query: Query) -> None:
        wrong = Hints(near=Near(2.0, 5.8, 1.0))
        assert ask(query, wrong).candidates[0].cost == pytest.approx(ask(query).candidates[0].cost, abs=1e-4)

    def test_strict_hints_without_grid_poses_are_an_error(self, ask: Ask, query: Query) -> None:
        with pytest.raises(InvalidHintError, match=r"none of the \d+ grid poses, 0.5 m apart.*omit strict"):
            ask(query, Hints(near=Near(5.0, 1.5, 1.05), rooms=frozenset({2}), strict=True))


def test_allowed_poses_of_a_large_grid_are_compared(
    plan: FloorPlan, grid: PoseGrid, encoders: Encoders, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lalaloc_core.localise.retrieval._ALL_COMPARED", 0)
    monkeypatch.setattr("lalaloc_core.localise.retrieval._MIN_COMPARED", 8)
    monkeypatch.setattr("lalaloc_core.localise.retrieval._MAX_COMPARED", 8)
    query = query_at(encoders, plan, PoseSet(np.array([[2.1, 5.7]]), np.array([2])))
    hints = Hints(rooms=frozenset({1}), strict=True)
    costs = grid_costs(plan, grid, query, encoders.manifest.evidence, MatchingConfig(), hints)
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
        ("near", "message"),
        [
            (Near(1.0, 1.0, 0.05), "radius_m: it is 0.05 m; it must be between 0.1 and 1000 m"),
            (Near(1.0, 1.0, 2e3), "radius_m: it is 2000 m"),
            (Near(math.nan, 1.0, 1.0), "near: .* is not a point"),
            (Near(-6.0, 1.0, 5.0), r"near: \(-6, 1\) is 6 m from the nearest room of the plan; the limit is radius_m"),
        ],
    )
    def test_invalid_mark_is_refused(self, plan: FloorPlan, near: Near, message: str) -> None:
        with pytest.raises(InvalidHintError, match=message):
            Hints(near=near).check(plan)

    def test_empty_room_hint_is_refused(self, plan: FloorPlan) -> None:
        with pytest.raises(InvalidHintError, match="rooms: no room is named"):
            Hints(rooms=frozenset()).check(plan)

    def test_rooms_are_found_by_id_then_by_name(self, plan: FloorPlan) -> None:
        assert [room.id for room in plan.rooms] == ["bedroom", "bedroom-2", "hall"]
        assert rooms_named(plan, ["bedroom-2"]) == {1}
        assert rooms_named(plan, ["Bedroom"]) == {0, 1}
        assert rooms_named(plan, ["bedroom", " HALL "]) == {0, 2}
        with pytest.raises(InvalidHintError, match="no room 'attic'; its rooms are 'bedroom', 'bedroom-2', 'hall'"):
            rooms_named(plan, ["hall", "attic"])

    def test_no_hints_are_never_missed(self) -> None:
        assert NO_HINTS.are_none
        assert not replace(NO_HINTS, rooms=frozenset({1})).are_none
        assert NO_HINTS.missed(np.zeros(2), 0) == ()
