"""Sequences: sums over paths against enumeration, derivatives against differences, and walks that are found again."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.errors import InvalidMotionError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.pipeline import localise
from lalaloc_core.localise.poses import PoseGrid, PredictedProfile, Query
from lalaloc_core.localise.ranking import panorama_heading
from lalaloc_core.localise.retrieval import build_grid
from lalaloc_core.localise.sequence.chain import best_paths, forward_backward
from lalaloc_core.localise.sequence.joint import motion_residuals, refine_sequence
from lalaloc_core.localise.sequence.motion import FLOOR, Motion, States, Transition, transition
from lalaloc_core.localise.sequence.search import SequenceRefiner, localise_sequence
from lalaloc_core.render.sampling import PoseSet
from tests.strategies import plan_of, rectangle

MOTIONS = {
    "nothing": Motion(),
    "a turn": Motion(turn=0.7, turn_std=0.3),
    "a distance": Motion(distance_m=1.0, distance_std_m=0.2),
    "both": Motion(distance_m=1.0, distance_std_m=0.2, turn=0.7, turn_std=0.3),
    "with a direction": Motion(distance_m=1.0, distance_std_m=0.2, turn=0.7, direction=1.2, direction_std=0.3),
}


def states(seed: int, places: int, headings: int) -> States:
    rng = np.random.default_rng(seed)
    sector = math.tau / headings if headings > 1 else 0.0
    return States(rng.uniform(0.0, 2.0, (places, 2)), 0.3 * seed + sector * np.arange(headings), sector)


def dense(made: Transition, motion: Motion) -> np.ndarray:
    """What a transition says of every pair of states, (n k, m l)."""
    n, k, m, after = made.sizes
    places = np.ones((m, k, n))
    if made.places is not None:
        full = made.places.toarray()
        if made.is_directed:
            places = np.stack([full.reshape(m, k, n, k)[:, j, :, j] for j in range(k)], axis=1)
        else:
            places = np.repeat(full[:, None, :], k, axis=1)
    turns = np.ones((k, after)) if made.turns is None else made.turns
    return (np.einsum("mkn,kl->nkml", places, turns) + made.floor).reshape(n * k, m * after)


@pytest.fixture(params=MOTIONS, ids=str)
def chain(request: Any) -> tuple[list[np.ndarray], list[Transition], np.ndarray, list[np.ndarray]]:
    motion = MOTIONS[request.param]
    pictures = [states(0, 5, 4), states(1, 4, 3), states(2, 6, 1)]
    rng = np.random.default_rng(5)
    log_likelihood = [rng.normal(0.0, 2.0, (2, len(one.position_m), len(one.heading))) for one in pictures]
    transitions = [transition(motion, *pair, 0.5) for pair in itertools.pairwise(pictures)]
    return log_likelihood, transitions, np.log([0.3, 0.7]), [dense(one, motion) for one in transitions]


class TestChain:
    def test_sums_over_paths_are_those_of_all_of_them(self, chain: Any) -> None:
        log_likelihood, transitions, log_prior, pairs = chain
        found = forward_backward(log_likelihood, transitions, log_prior)
        shape = [one[0].size for one in log_likelihood]
        total, height, state = 0.0, np.zeros(2), [np.zeros(size) for size in shape]
        for j in range(2):
            for path in itertools.product(*(range(size) for size in shape)):
                weight = math.exp(
                    log_prior[j] + sum(one[j].ravel()[s] for one, s in zip(log_likelihood, path, strict=True))
                )
                weight *= math.prod(pair[a, b] for pair, (a, b) in zip(pairs, itertools.pairwise(path), strict=True))
                total += weight
                height[j] += weight
                for t, s in enumerate(path):
                    state[t][s] += weight
        assert found.log_evidence == pytest.approx(math.log(total), abs=1e-9)
        np.testing.assert_allclose(found.height, height / total, atol=1e-12)
        for one, expected in zip(found.state, state, strict=True):
            np.testing.assert_allclose(one.ravel(), expected / total, atol=1e-12)

    def test_the_best_path_through_every_state_is_the_best_of_all_through_it(self, chain: Any) -> None:
        log_likelihood, transitions, _, pairs = chain
        one_height = [one[0] for one in log_likelihood]
        found = best_paths(one_height, transitions)
        shape = [one.size for one in one_height]
        best = [np.full(size, -np.inf) for size in shape]
        # Of a sum of what is measured and the floor, the better counts.
        parts = [
            np.log(np.maximum(pair - (FLOOR if made.floor else 0.0), made.floor))
            for pair, made in zip(pairs, transitions, strict=True)
        ]

        def score(path: tuple[int, ...]) -> float:
            seen = sum(one.ravel()[s] for one, s in zip(one_height, path, strict=True))
            return seen + sum(part[a, b] for part, (a, b) in zip(parts, itertools.pairwise(path), strict=True))

        for path in itertools.product(*(range(size) for size in shape)):
            for t, s in enumerate(path):
                best[t][s] = max(best[t][s], score(path))
        for t, (one, expected) in enumerate(zip(found.score, best, strict=True)):
            np.testing.assert_allclose(one.ravel(), expected, atol=1e-9)
            for s in range(shape[t]):
                path = found.through(t, s)
                assert path[t] == s
                assert score(tuple(path)) == pytest.approx(expected[s], abs=1e-9)

    def test_some_of_the_poses_alone_are_the_same_chain(self, chain: Any) -> None:
        log_likelihood, transitions, log_prior, _ = chain
        kept = [np.array([0, 2, 3]), np.array([1, 3]), np.array([0, 4, 5])]
        part = [one[:, index] for one, index in zip(log_likelihood, kept, strict=True)]
        among = [made.among(*pair) for made, pair in zip(transitions, itertools.pairwise(kept), strict=True)]
        masked = [np.full_like(one, -1e3) for one in log_likelihood]
        for one, whole, index in zip(masked, log_likelihood, kept, strict=True):
            one[:, index] = whole[:, index]
        found, expected = (
            forward_backward(one, made, log_prior) for one, made in ((part, among), (masked, transitions))
        )
        assert found.log_evidence == pytest.approx(expected.log_evidence, abs=1e-9)
        for one, whole, index in zip(found.state, expected.state, kept, strict=True):
            np.testing.assert_allclose(one, whole[index], atol=1e-12)

    def test_without_motions_pictures_are_independent_but_for_their_height(self) -> None:
        rng = np.random.default_rng(1)
        log_likelihood = [rng.normal(0.0, 3.0, (3, 6, 4)) for _ in range(3)]
        pictures = [states(seed, 6, 4) for seed in range(3)]
        transitions = [transition(Motion(), *pair, 0.5) for pair in itertools.pairwise(pictures)]
        found = forward_backward(log_likelihood, transitions, np.log(np.full(3, 1 / 3)))
        by_height = np.exp(sum(np.logaddexp.reduce(one.reshape(3, -1), axis=1) for one in log_likelihood))
        np.testing.assert_allclose(found.height, by_height / by_height.sum())
        for one, state in zip(log_likelihood, found.state, strict=True):
            alone = np.exp(one - np.logaddexp.reduce(one.reshape(3, -1), axis=1)[:, None, None])
            np.testing.assert_allclose(state, np.einsum("j,jnk->nk", found.height, alone), atol=1e-12)


@pytest.mark.parametrize("name", MOTIONS)
def test_derivatives_of_motions_are_those_of_differences(name: str) -> None:
    motion, rng = MOTIONS[name], np.random.default_rng(0)
    position_m, heading = rng.uniform(0.0, 3.0, (5, 2, 2)), rng.uniform(-3.0, 3.0, (5, 2))
    off, by_both = motion_residuals(motion, position_m, heading)
    for unknown in range(6):
        picture, axis = divmod(unknown, 3)
        moved, turned = position_m.copy(), heading.copy()
        if axis < 2:
            moved[:, picture, axis] += 1e-6
        else:
            turned[:, picture] += 1e-6
        expected = (motion_residuals(motion, moved, turned)[0] - off) / 1e-6
        np.testing.assert_allclose(by_both[:, :, unknown], expected, atol=1e-3)


def test_a_direction_that_says_next_to_nothing_costs_no_more_than_a_distance() -> None:
    side = 45
    position = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2) * 0.5
    many = States(position, np.linspace(0.0, math.tau, 64, endpoint=False), math.tau / 64)
    vague = Motion(distance_m=2.0, distance_std_m=1000.0, direction=0.3, direction_std=math.pi)
    made = transition(vague, many, many, 0.5)
    assert made.places is not None
    assert not made.is_directed
    assert made.places.nnz <= len(position) ** 2
    # A walk with usual odometry keeps its direction.
    usual = transition(Motion(distance_m=2.4, distance_std_m=0.12, direction=0.3, direction_std=0.035), many, many, 0.5)
    assert usual.is_directed
    assert usual.places is not None
    assert usual.places.nnz < 4_000_000


def test_a_motion_is_as_it_was_made() -> None:
    # From (1, 1) looking along +x, 2 m to the right hand, then looking along +y.
    position_m, heading = np.array([[[1.0, 1.0], [1.0, -1.0]]]), np.array([[math.pi / 2, 0.0]])
    motion = Motion(distance_m=2.0, turn=-math.pi / 2, direction=math.pi / 2)
    np.testing.assert_allclose(motion_residuals(motion, position_m, heading)[0], 0.0, atol=1e-9)
    assert wrap_angle(heading[0, 1] - heading[0, 0]) == pytest.approx(-math.pi / 2)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"distance_m": -1.0}, "distance_m is -1"),
        ({"distance_m": 1001.0}, "distance_m is 1001"),
        ({"distance_m": 1.0, "distance_std_m": 0.0}, "distance_std_m is 0; it must be between 0.001"),
        ({"turn": math.nan}, "turn is nan"),
        ({"turn": 1.0, "turn_std": 0.0}, "turn_std is 0"),
        ({"direction": 1.0}, "without distance_m"),
    ],
)
def test_motions_that_cannot_be_are_refused(values: dict[str, float], message: str) -> None:
    with pytest.raises(InvalidMotionError, match=message):
        replace(Motion(**values))


CAMERA_M, STEP_M, HEADINGS = 1.5, 0.5, 32
Walk = list[tuple[tuple[float, float], int, float]]
# From one of two rooms that look alike into the hall, and along it.
WALK: Walk = [((11.3, 0.9), 1, 0.3), ((8.1, 5.7), 2, 2.0), ((4.9, 5.9), 2, 4.4)]


@pytest.fixture(scope="module")
def plan() -> FloorPlan:
    hall = [[1.0, 5.0], [13.0, 5.0], [13.0, 6.4], [3.0, 6.4], [3.0, 8.0], [1.0, 8.0]]
    return plan_of(rectangle(4.0, 3.0), rectangle(4.0, 3.0, at=(10.0, 0.0)), hall)


@pytest.fixture(scope="module")
def grid(plan: FloorPlan, encoders: Encoders) -> PoseGrid:
    return build_grid(plan, encoders, step_m=STEP_M, camera_height_m=CAMERA_M)


def seen(encoders: Encoders, plan: FloorPlan, walk: Walk, height: CameraHeight) -> list[Query]:
    """What a perfect image encoder says along a walk whose headings are unknown."""
    queries = []
    for place, room, heading in walk:
        pose = PoseSet(np.array([place]), np.array([room]))
        roll = np.arange(HEADINGS) * (math.tau / HEADINGS)
        profile_m = np.concatenate([encoders.profiles(plan, pose, np.array([heading - one])) for one in roll])
        profile = PredictedProfile(np.log(profile_m), np.full_like(profile_m, -3.0))
        latents = encoders.layouts(profile_m, np.full(HEADINGS, CAMERA_M), np.full(HEADINGS, 2.5))
        queries.append(Query(latents, roll, 0.0, heading_known=False, camera_height=height, profile=profile))
    return queries


def measured(walk: Walk, *, directed: bool = False) -> list[Motion]:
    """What was measured along a walk, exactly."""
    motions = []
    for (first, _, heading), (second, _, later) in itertools.pairwise(walk):
        moved = np.subtract(second, first)
        turn = float(wrap_angle(later - heading))
        motion = Motion(distance_m=float(np.hypot(*moved)), turn=turn, turn_std=math.radians(2.0))
        if directed:
            motion = replace(motion, direction=float(wrap_angle(math.atan2(*moved) - heading)))
        motions.append(motion)
    return motions


class TestSearch:
    @pytest.mark.parametrize("directed", [False, True])
    @pytest.mark.parametrize("refiner", [None, refine_sequence])
    def test_neighbours_tell_rooms_apart_that_look_alike(
        self, plan: FloorPlan, grid: PoseGrid, encoders: Encoders, directed: bool, refiner: SequenceRefiner | None
    ) -> None:
        queries = seen(encoders, plan, WALK, CameraHeight(CAMERA_M, 0.0))
        alone = localise_sequence(plan, grid, encoders, queries, [Motion()] * 2, refiner=refiner)
        # The two rooms look alike, and each of them from two sides.
        shares = alone.pictures[0].posterior.candidate[:4]
        assert min(shares) > 0.15
        assert max(shares) < 0.3
        found = localise_sequence(plan, grid, encoders, queries, measured(WALK, directed=directed), refiner=refiner)
        assert found.stage == ("retrieval" if refiner is None else "lpo")
        assert found.motions_contradicted == ()
        for (place, room, heading), picture in zip(WALK, found.pictures, strict=True):
            answer = picture.candidates[0]
            assert answer.room_index == room
            error_m = np.linalg.norm(answer.position_m - place)
            if refiner is None:
                assert error_m < 0.5
                continue
            turned = wrap_angle(panorama_heading(picture.query, answer) - heading)
            assert error_m < 0.02
            assert abs(turned) < math.radians(0.5)
            assert picture.posterior.candidate[0] > 0.98
            assert picture.posterior.heading > 0.98
        assert refiner is None or found.path_probability > 0.98

    def test_without_motions_each_is_answered_as_if_it_were_alone(
        self, plan: FloorPlan, grid: PoseGrid, encoders: Encoders
    ) -> None:
        queries = seen(encoders, plan, WALK, CameraHeight(CAMERA_M, 0.0))
        together = localise_sequence(plan, grid, encoders, queries, [Motion()] * 2)
        for query, picture in zip(queries, together.pictures, strict=True):
            alone = localise(plan, grid, encoders, query, refine="none")
            np.testing.assert_allclose(picture.posterior.pose, alone.posterior.pose, atol=2e-3)
            assert picture.candidates[0].cost == pytest.approx(alone.candidates[0].cost, abs=1e-5)

    def test_a_motion_that_cannot_be_is_told_and_not_believed(
        self, plan: FloorPlan, grid: PoseGrid, encoders: Encoders
    ) -> None:
        queries = seen(encoders, plan, WALK, CameraHeight(CAMERA_M, 0.0))
        first, second = measured(WALK)
        wrong = replace(second, distance_m=9.5)
        found = localise_sequence(plan, grid, encoders, queries, [first, wrong], refiner=refine_sequence)
        assert found.motions_contradicted == (1,)
        for (place, _, _), picture in zip(WALK, found.pictures, strict=True):
            assert np.linalg.norm(picture.candidates[0].position_m - place) < 0.05

    def test_all_pictures_share_one_height_that_is_found(
        self, plan: FloorPlan, grid: PoseGrid, encoders: Encoders
    ) -> None:
        stated = CameraHeight(CAMERA_M, math.inf)
        # What looks 12 % too near was taken from 12 % higher up.
        queries = [query.scaled(-math.log(1.12)) for query in seen(encoders, plan, WALK, stated)]
        found = localise_sequence(plan, grid, encoders, queries, measured(WALK), refiner=refine_sequence)
        assert len({picture.candidates[0].height_offset for picture in found.pictures}) == 1
        assert found.camera_height_m == pytest.approx(1.12 * CAMERA_M, rel=0.01)
        for (place, _, _), picture in zip(WALK, found.pictures, strict=True):
            assert np.linalg.norm(picture.candidates[0].position_m - place) < 0.05

    def test_of_large_grids_the_best_places_are_compared(
        self, plan: FloorPlan, grid: PoseGrid, encoders: Encoders, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("lalaloc_core.localise.sequence.search._MAX_PLACES", 60)
        queries = seen(encoders, plan, WALK, CameraHeight(CAMERA_M, 0.0))
        found = localise_sequence(plan, grid, encoders, queries, measured(WALK), refiner=refine_sequence)
        assert [picture.candidates[0].room_index for picture in found.pictures] == [1, 2, 2]

    def test_a_model_without_a_profile_is_answered_from_the_grid(
        self, plan: FloorPlan, grid: PoseGrid, encoders: Encoders
    ) -> None:
        queries = [replace(one, profile=None) for one in seen(encoders, plan, WALK, CameraHeight(CAMERA_M, 0.0))]
        found = localise_sequence(plan, grid, encoders, queries, measured(WALK), refiner=refine_sequence)
        assert found.stage == "retrieval"
        assert sum(found.pictures[0].posterior.candidate) <= 1.0 + 1e-9

    def test_motions_are_counted(self, plan: FloorPlan, grid: PoseGrid, encoders: Encoders) -> None:
        queries = seen(encoders, plan, WALK, CameraHeight(CAMERA_M, 0.0))
        with pytest.raises(InvalidMotionError, match="1 motions are given; 3 pictures need 2"):
            localise_sequence(plan, grid, encoders, queries, [Motion()])
