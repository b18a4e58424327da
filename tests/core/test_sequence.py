"""Tests of sequences: sums over paths, motion residuals, and localisation of walks."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from lalaloc_core.bundle import Bundle, default_bundle
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.errors import InvalidMotionError
from lalaloc_core.evaluate.methods.lalaloc import local_refiner
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.synthetic.generated import RenderedPhotograph, split_renderer_cache
from lalaloc_core.learn.synth.homes.plans import VALIDATION, home_of
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.localise.belief import photograph_heading
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import CameraHeight, PredictedProfile, Query
from lalaloc_core.localise.search.pipeline import localise
from lalaloc_core.localise.sequence.chain_inference import best_paths, forward_backward
from lalaloc_core.localise.sequence.joint_refinement import motion_residuals, refine_sequence
from lalaloc_core.localise.sequence.measured_motion import FLOOR, Motion, States, Transition, transition
from lalaloc_core.localise.sequence.sequence_search import (
    SequenceLocalisation,
    SequenceRefiner,
    linked,
    localise_sequence,
)
from lalaloc_core.localise.sequence.turn_localisation import found_turns, judged_turn
from lalaloc_core.render.sampling import PoseSet
from tests.strategies import plan_of, present, rectangle

MOTIONS = {
    "none": Motion(),
    "turn": Motion(turn=0.7, turn_std=0.3),
    "distance": Motion(distance_m=1.0, distance_std_m=0.2),
    "both": Motion(distance_m=1.0, distance_std_m=0.2, turn=0.7, turn_std=0.3),
    "direction": Motion(distance_m=1.0, distance_std_m=0.2, turn=0.7, direction=1.2, direction_std=0.3),
}


def states(seed: int, places: int, headings: int) -> States:
    rng = np.random.default_rng(seed)
    sector = math.tau / headings if headings > 1 else 0.0
    return States(rng.uniform(0.0, 2.0, (places, 2)), 0.3 * seed + sector * np.arange(headings), sector)


def dense(step: Transition, motion: Motion) -> np.ndarray:
    """Return the transition factor of every pair of states, (n k, m l)."""
    n, k, m, after = step.sizes
    places = np.ones((m, k, n))
    if step.places is not None:
        full = step.places.toarray()
        if step.is_directed:
            places = np.stack([full.reshape(m, k, n, k)[:, j, :, j] for j in range(k)], axis=1)
        else:
            places = np.repeat(full[:, None, :], k, axis=1)
    turns = np.ones((k, after)) if step.turns is None else step.turns
    return (np.einsum("mkn,kl->nkml", places, turns) + step.floor).reshape(n * k, m * after)


@pytest.fixture(params=MOTIONS, ids=str)
def chain(request: Any) -> tuple[list[np.ndarray], list[Transition], np.ndarray, list[np.ndarray]]:
    motion = MOTIONS[request.param]
    pictures = [states(0, 5, 4), states(1, 4, 3), states(2, 6, 1)]
    rng = np.random.default_rng(5)
    log_likelihood = [rng.normal(0.0, 2.0, (2, len(picture.position_m), len(picture.heading))) for picture in pictures]
    transitions = [transition(motion, *pair, 0.5) for pair in itertools.pairwise(pictures)]
    return log_likelihood, transitions, np.log([0.3, 0.7]), [dense(step, motion) for step in transitions]


class TestChain:
    def test_forward_backward_sums_over_all_paths(self, chain: Any) -> None:
        log_likelihood, transitions, log_prior, pairs = chain
        found = forward_backward(log_likelihood, transitions, log_prior)
        shape = [values[0].size for values in log_likelihood]
        total, height, state = 0.0, np.zeros(2), [np.zeros(size) for size in shape]
        for j in range(2):
            for path in itertools.product(*(range(size) for size in shape)):
                weight = math.exp(
                    log_prior[j] + sum(values[j].ravel()[s] for values, s in zip(log_likelihood, path, strict=True))
                )
                weight *= math.prod(pair[a, b] for pair, (a, b) in zip(pairs, itertools.pairwise(path), strict=True))
                total += weight
                height[j] += weight
                for t, s in enumerate(path):
                    state[t][s] += weight
        assert found.log_evidence == pytest.approx(math.log(total), abs=1e-9)
        np.testing.assert_allclose(found.height, height / total, atol=1e-12)
        for values, expected in zip(found.state, state, strict=True):
            np.testing.assert_allclose(values.ravel(), expected / total, atol=1e-12)

    def test_best_path_through_each_state_is_optimal(self, chain: Any) -> None:
        log_likelihood, transitions, _, pairs = chain
        first_height = [values[0] for values in log_likelihood]
        found = best_paths(first_height, transitions)
        shape = [values.size for values in first_height]
        best = [np.full(size, -np.inf) for size in shape]
        # The best path takes the larger of the factor and the floor, not their sum.
        parts = [
            np.log(np.maximum(pair - (FLOOR if step.floor else 0.0), step.floor))
            for pair, step in zip(pairs, transitions, strict=True)
        ]

        def score(path: tuple[int, ...]) -> float:
            likelihood = sum(values.ravel()[s] for values, s in zip(first_height, path, strict=True))
            return likelihood + sum(part[a, b] for part, (a, b) in zip(parts, itertools.pairwise(path), strict=True))

        for path in itertools.product(*(range(size) for size in shape)):
            for t, s in enumerate(path):
                best[t][s] = max(best[t][s], score(path))
        for t, (values, expected) in enumerate(zip(found.score, best, strict=True)):
            np.testing.assert_allclose(values.ravel(), expected, atol=1e-9)
            for s in range(shape[t]):
                path = found.through(t, s)
                assert path[t] == s
                assert score(tuple(path)) == pytest.approx(expected[s], abs=1e-9)

    def test_subset_of_states_equals_a_masked_chain(self, chain: Any) -> None:
        log_likelihood, transitions, log_prior, _ = chain
        kept = [np.array([0, 2, 3]), np.array([1, 3]), np.array([0, 4, 5])]
        part = [values[:, index] for values, index in zip(log_likelihood, kept, strict=True)]
        among = [step.among(*pair) for step, pair in zip(transitions, itertools.pairwise(kept), strict=True)]
        masked = [np.full_like(values, -1e3) for values in log_likelihood]
        for values, whole, index in zip(masked, log_likelihood, kept, strict=True):
            values[:, index] = whole[:, index]
        found, expected = (
            forward_backward(values, step, log_prior) for values, step in ((part, among), (masked, transitions))
        )
        assert found.log_evidence == pytest.approx(expected.log_evidence, abs=1e-9)
        for values, whole, index in zip(found.state, expected.state, kept, strict=True):
            np.testing.assert_allclose(values, whole[index], atol=1e-12)

    def test_photographs_without_motions_share_only_the_height(self) -> None:
        rng = np.random.default_rng(1)
        log_likelihood = [rng.normal(0.0, 3.0, (3, 6, 4)) for _ in range(3)]
        pictures = [states(seed, 6, 4) for seed in range(3)]
        transitions = [transition(Motion(), *pair, 0.5) for pair in itertools.pairwise(pictures)]
        found = forward_backward(log_likelihood, transitions, np.log(np.full(3, 1 / 3)))
        by_height = np.exp(sum(np.logaddexp.reduce(values.reshape(3, -1), axis=1) for values in log_likelihood))
        np.testing.assert_allclose(found.height, by_height / by_height.sum())
        for values, state in zip(log_likelihood, found.state, strict=True):
            alone = np.exp(values - np.logaddexp.reduce(values.reshape(3, -1), axis=1)[:, None, None])
            np.testing.assert_allclose(state, np.einsum("j,jnk->nk", found.height, alone), atol=1e-12)


@pytest.mark.parametrize("name", MOTIONS)
def test_motion_derivatives_equal_finite_differences(name: str) -> None:
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


def test_vague_direction_is_ignored() -> None:
    side = 45
    position = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2) * 0.5
    many = States(position, np.linspace(0.0, math.tau, 64, endpoint=False), math.tau / 64)
    vague = Motion(distance_m=2.0, distance_std_m=1000.0, direction=0.3, direction_std=math.pi)
    step = transition(vague, many, many, 0.5)
    assert not step.is_directed
    assert present(step.places).nnz <= len(position) ** 2
    # A direction of typical odometry is kept.
    usual = transition(Motion(distance_m=2.4, distance_std_m=0.12, direction=0.3, direction_std=0.035), many, many, 0.5)
    assert usual.is_directed
    assert present(usual.places).nnz < 4_000_000


def test_motion_follows_the_sign_conventions() -> None:
    # The camera faces +x, moves 2 m to its right, and turns to +y.
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
def test_invalid_motion_is_refused(values: dict[str, float], message: str) -> None:
    with pytest.raises(InvalidMotionError, match=message):
        replace(Motion(**values))


CAMERA_M, STEP_M, HEADINGS = 1.5, 0.5, 32
Walk = list[tuple[tuple[float, float], int, float]]
Search = Callable[..., SequenceLocalisation]
# The walk leads from one of two identical rooms into the hall and along it.
WALK: Walk = [((11.3, 0.9), 1, 0.3), ((8.1, 5.7), 2, 2.0), ((4.9, 5.9), 2, 4.4)]


@pytest.fixture(scope="module")
def plan() -> FloorPlan:
    hall = [[1.0, 5.0], [13.0, 5.0], [13.0, 6.4], [3.0, 6.4], [3.0, 8.0], [1.0, 8.0]]
    return plan_of(rectangle(4.0, 3.0), rectangle(4.0, 3.0, corner=(10.0, 0.0)), hall)


@pytest.fixture(scope="module")
def grid(plan: FloorPlan, encoders: PhotographEncoder) -> PoseGrid:
    return build_grid(plan, encoders.layouts, step_m=STEP_M, camera_height_m=CAMERA_M)


def queries_along(encoders: PhotographEncoder, plan: FloorPlan, walk: Walk, height: CameraHeight) -> list[Query]:
    """Return the queries of a perfect image encoder along a walk, headings unknown."""
    queries = []
    for place, room, heading in walk:
        pose = PoseSet(np.array([place]), np.array([room]))
        roll = np.arange(HEADINGS) * (math.tau / HEADINGS)
        profile_m = np.concatenate([encoders.layouts.profiles(plan, pose, np.array([heading - turn])) for turn in roll])
        profile = PredictedProfile(np.log(profile_m), np.full_like(profile_m, -3.0))
        latents = encoders.layouts.latents(profile_m, np.full(HEADINGS, CAMERA_M), np.full(HEADINGS, 2.5))
        queries.append(Query(latents, roll, 0.0, heading_known=False, camera_height=height, profile=profile))
    return queries


def motions_along(walk: Walk, *, directed: bool = False) -> list[Motion]:
    """Return the exact motions between the photographs of a walk."""
    motions = []
    for (first, _, heading), (second, _, later) in itertools.pairwise(walk):
        moved = np.subtract(second, first)
        turn = float(wrap_angle(later - heading))
        motion = Motion(distance_m=float(np.hypot(*moved)), turn=turn, turn_std=math.radians(2.0))
        if directed:
            motion = replace(motion, direction=float(wrap_angle(math.atan2(*moved) - heading)))
        motions.append(motion)
    return motions


@pytest.fixture(scope="module")
def search(plan: FloorPlan, grid: PoseGrid, encoders: PhotographEncoder) -> Search:
    return partial(localise_sequence, plan, grid, encoders.layouts)


@pytest.fixture(scope="module")
def walk_queries(plan: FloorPlan, encoders: PhotographEncoder) -> list[Query]:
    return queries_along(encoders, plan, WALK, CameraHeight(CAMERA_M, 0.0))


class TestSearch:
    @pytest.mark.parametrize("directed", [False, True])
    @pytest.mark.parametrize("refiner", [None, refine_sequence])
    def test_sequence_distinguishes_identical_rooms(
        self, search: Search, walk_queries: list[Query], directed: bool, refiner: SequenceRefiner | None
    ) -> None:
        alone = search(walk_queries, [Motion()] * 2, refiner=refiner)
        # The rooms are identical, and each is symmetric.
        shares = alone.pictures[0].posterior.candidate[:4]
        assert min(shares) > 0.15
        assert max(shares) < 0.3
        found = search(walk_queries, motions_along(WALK, directed=directed), refiner=refiner)
        assert found.stage == ("retrieval" if refiner is None else "lpo")
        assert found.motions_contradicted == ()
        for (place, room, heading), picture in zip(WALK, found.pictures, strict=True):
            best = picture.candidates[0]
            assert best.room_index == room
            error_m = np.linalg.norm(best.position_m - place)
            if refiner is None:
                assert error_m < 0.5
                continue
            turned = wrap_angle(photograph_heading(picture.query, best) - heading)
            assert error_m < 0.02
            assert abs(turned) < math.radians(0.5)
            assert picture.posterior.candidate[0] > 0.98
            assert picture.posterior.heading > 0.98
        assert refiner is None or found.path_probability > 0.98

    def test_photographs_without_motions_are_independent(
        self, plan: FloorPlan, grid: PoseGrid, encoders: PhotographEncoder, search: Search, walk_queries: list[Query]
    ) -> None:
        together = search(walk_queries, [Motion()] * 2)
        for query, picture in zip(walk_queries, together.pictures, strict=True):
            alone = localise(plan, grid, encoders.layouts, query, refine="none")
            np.testing.assert_allclose(picture.posterior.pose, alone.posterior.pose, atol=2e-3)
            assert picture.candidates[0].cost == pytest.approx(alone.candidates[0].cost, abs=1e-5)

    def test_turn_is_judged_by_all_its_photographs_together(
        self, plan: FloorPlan, grid: PoseGrid, encoders: PhotographEncoder, search: Search
    ) -> None:
        spot: Walk = [((1.6, 7.0), 2, 0.3), ((1.6, 7.0), 2, 1.5)]
        queries = queries_along(encoders, plan, spot, CameraHeight(CAMERA_M, 0.0))
        found = search(queries, [Motion(distance_m=0.0, distance_std_m=0.1)], refiner=refine_sequence)
        assert found_turns(found) == pytest.approx([0.0, 1.2], abs=0.01)
        joint = localise(plan, grid, encoders.layouts, queries[0], refine="none")
        judged = judged_turn(found, joint)
        for picture, before in zip(judged.pictures, found.pictures, strict=True):
            assert picture.candidates == before.candidates
            assert picture.signals == {before.stage: joint.signals[joint.stage]}
            assert picture.posterior.position == pytest.approx(joint.posterior.position, abs=0.05)
        support = joint.posterior.support
        away = replace(joint.posterior, support=replace(support, position_m=support.position_m + 3.0))
        elsewhere = judged_turn(found, replace(joint, posterior=away))
        assert elsewhere.path_probability < 0.05
        assert elsewhere.pictures[0].candidates == found.pictures[0].candidates

    def test_contradicted_motion_is_reported_and_ignored(self, search: Search, walk_queries: list[Query]) -> None:
        first, second = motions_along(WALK)
        wrong = replace(second, distance_m=9.5)
        found = search(walk_queries, [first, wrong], refiner=refine_sequence)
        assert found.motions_contradicted == (1,)
        for (place, _, _), picture in zip(WALK, found.pictures, strict=True):
            assert np.linalg.norm(picture.candidates[0].position_m - place) < 0.05

    def test_shared_camera_height_is_found(self, plan: FloorPlan, encoders: PhotographEncoder, search: Search) -> None:
        stated = CameraHeight(CAMERA_M, math.inf)
        # Distances that are predicted 12 % too small mean a camera 12 % higher.
        queries = [query.scaled(-math.log(1.12)) for query in queries_along(encoders, plan, WALK, stated)]
        found = search(queries, motions_along(WALK), refiner=refine_sequence)
        offsets = [picture.candidates[0].height_offset for picture in found.pictures]
        assert offsets == pytest.approx([math.log(1.12)] * len(WALK), abs=0.01)
        assert found.camera_height_m == pytest.approx(1.12 * CAMERA_M, rel=0.01)
        for (place, _, _), picture in zip(WALK, found.pictures, strict=True):
            assert np.linalg.norm(picture.candidates[0].position_m - place) < 0.05

    def test_heights_differ_between_photographs(
        self, plan: FloorPlan, encoders: PhotographEncoder, search: Search
    ) -> None:
        factors = np.linspace(0.95, 1.05, len(WALK))
        queries = [
            query.scaled(-math.log(factor))
            for factor, query in zip(factors, queries_along(encoders, plan, WALK, CameraHeight(CAMERA_M)), strict=True)
        ]
        found = search(queries, motions_along(WALK), refiner=refine_sequence)
        offsets = [picture.candidates[0].height_offset for picture in found.pictures]
        assert offsets == pytest.approx(np.log(factors), abs=0.03)
        for (place, _, _), picture in zip(WALK, found.pictures, strict=True):
            assert np.linalg.norm(picture.candidates[0].position_m - place) < 0.05

    def test_number_of_places_is_limited(
        self, search: Search, walk_queries: list[Query], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("lalaloc_core.localise.sequence.sequence_search._MAX_PLACES", 60)
        found = search(walk_queries, motions_along(WALK), refiner=refine_sequence)
        assert [picture.candidates[0].room_index for picture in found.pictures] == [1, 2, 2]

    def test_model_without_profiles_uses_the_grid(self, search: Search, walk_queries: list[Query]) -> None:
        queries = [replace(query, profile=None) for query in walk_queries]
        found = search(queries, motions_along(WALK), refiner=refine_sequence)
        assert found.stage == "retrieval"
        assert sum(found.pictures[0].posterior.candidate) <= 1.0 + 1e-9

    def test_wrong_number_of_motions_is_refused(self, search: Search, walk_queries: list[Query]) -> None:
        with pytest.raises(InvalidMotionError, match="1 motions are given; 3 pictures need 2"):
            search(walk_queries, [Motion()])


@pytest.fixture(scope="module")
def shipped() -> Bundle:
    return Bundle.open(default_bundle())


class TestConfidence:
    """Walks through furnished homes, with the shipped model, exact odometry and a height for each photograph."""

    HOMES, HEIGHTS_M, STATED_M = (0, 6, 17), (1.25, 1.65, 1.45), 1.45
    # Joint refinement moves a pose from where its own walls fit best.
    TOLERANCE = 0.05

    @pytest.mark.slow
    @pytest.mark.parametrize("index", HOMES)
    @pytest.mark.parametrize("heights", ["each", "one"])
    def test_sequence_is_as_sure_as_its_photographs(self, shipped: Bundle, index: int, heights: str) -> None:
        encoders, refiner = PhotographEncoder(shipped, threads=1), local_refiner(shipped)
        home, rng = home_of(VALIDATION, 0, index)
        shots = [
            replace(shot, camera_height_m=height_m)
            for shot, height_m in zip(sample_shots(home, 3, rng, "full"), self.HEIGHTS_M, strict=True)
        ]
        stated = CameraHeight(self.STATED_M)
        renderers = split_renderer_cache(VALIDATION, 0, None)
        size = shipped.manifest.image_height, shipped.manifest.image_width
        queries = [
            encoders.spheres.query(
                RenderedPhotograph(shot, renderers).image(*size),
                None,
                stated.at(shot.camera_height_m) if heights == "each" else stated,
            )
            for shot in shots
        ]
        walk = [((shot.position_m[0], shot.position_m[1]), shot.room_index, shot.heading) for shot in shots]
        grid = build_grid(home.plan, encoders.layouts, step_m=STEP_M, camera_height_m=self.STATED_M, latents=False)
        alone = [localise(home.plan, grid, encoders.layouts, query, refiner=refiner) for query in queries]
        together = localise_sequence(
            home.plan, grid, encoders.layouts, queries, motions_along(walk), refiner=refine_sequence
        )
        assert together.motions_contradicted == ()
        model = shipped.manifest.confidence_for(view=False)
        sure = [present(picture.confidence(model)).position for picture in alone]
        joint = [present(picture.confidence(model)).position for picture in together.pictures]
        assert min(joint) > max(sure) - self.TOLERANCE
        assert present(together.confidence(shipped.manifest)) > max(sure) - self.TOLERANCE
        for shot, picture in zip(shots, together.pictures, strict=True):
            assert np.linalg.norm(picture.candidates[0].position_m - shot.position_m) < 1.0

    @pytest.mark.parametrize(
        ("motions", "missed", "expected"),
        [
            ([Motion(distance_m=1.0), Motion(distance_m=2.0)], (), (0.9, 0.9, 0.9)),
            ([Motion(distance_m=1.0), Motion(distance_m=2.0)], (1,), (0.9, 0.9, 0.3)),
            ([Motion(distance_m=1.0), Motion(turn=0.5)], (), (0.9, 0.9, 0.3)),
            ([Motion(), Motion(distance_m=2.0)], (), (0.2, 0.9, 0.9)),
        ],
    )
    def test_fit_holds_for_photographs_that_are_linked(
        self,
        search: Search,
        walk_queries: list[Query],
        shipped: Bundle,
        monkeypatch: pytest.MonkeyPatch,
        motions: list[Motion],
        missed: tuple[int, ...],
        expected: tuple[float, ...],
    ) -> None:
        found = search(walk_queries, [Motion()] * 2)
        own = dict(zip((picture.signals["retrieval"].cost for picture in found.pictures), (0.2, 0.9, 0.3), strict=True))
        manifest = shipped.manifest
        model = present(manifest.confidence_for(view=False))
        monkeypatch.setattr(type(model), "fit_probability", lambda self, stage, signals, **_: own[signals["cost"]])
        pictures = linked([replace(picture, linked_fit=0.0) for picture in found.pictures], motions, missed, manifest)
        fits = [present(picture.confidence(model)).fit for picture in pictures]
        assert fits == pytest.approx(expected)
        # A photograph can be of a plan that was not searched.
        assert present(pictures[0].confidence(model, 0.5)).fit == pytest.approx(0.5 * expected[0])
