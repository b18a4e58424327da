"""The path of a query through all stages, with real networks on layouts."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.optimise import LatentPoseOptimiser
from lalaloc_core.localise.pipeline import Localisation, LocaliseConfig, Refine, StageClock, localise, panorama_heading
from lalaloc_core.localise.poses import Candidate, LatentGrid, Query, RefinementJob, RefinementResult
from lalaloc_core.localise.retrieval import build_grid
from lalaloc_core.sampling import PoseSet, random_poses
from tests.strategies import crooked_flat, plan_of, rectangle, seeds

CAMERA_M = 1.5


@pytest.fixture(scope="module")
def flat() -> FloorPlan:
    return crooked_flat()


@pytest.fixture(scope="module")
def grid(flat: FloorPlan, encoders: Encoders) -> LatentGrid:
    return build_grid(flat, encoders, step_m=0.5, camera_height_m=CAMERA_M)


def layout_query(encoders: Encoders, plan: FloorPlan, pose: PoseSet) -> Query:
    """What a perfect image encoder would make of a panorama of this pose."""
    return Query(encoders.poses(plan, pose, np.zeros(1), CAMERA_M), np.zeros(1), 0.0, heading_known=True)


def some_pose(plan: FloorPlan, seed: int) -> PoseSet:
    return random_poses(plan, 1, np.random.default_rng(seed))


def error_m(found: Localisation, pose: PoseSet) -> float:
    return float(np.linalg.norm(found.candidates[0].position_m - pose.position_m[0]))


class TestAccuracy:
    def test_every_stage_comes_nearer_and_optimisation_finds_the_pose(
        self, flat: FloorPlan, grid: LatentGrid, encoders: Encoders, optimiser: LatentPoseOptimiser
    ) -> None:
        errors: dict[Refine, list[float]] = {"none": [], "vdr": [], "lpo": []}
        for seed in range(20):
            pose = some_pose(flat, seed)
            query = layout_query(encoders, flat, pose)
            for refine, found in errors.items():
                answer = localise(flat, grid, encoders, query, refine=refine, refiner=optimiser.refine)
                found.append(error_m(answer, pose))
        median = {refine: float(np.median(found)) for refine, found in errors.items()}
        assert median["lpo"] < 0.005 < median["vdr"] < median["none"] < 0.5
        assert np.mean(np.array(errors["lpo"]) < 0.01) >= 0.8

    def test_each_stage_lowers_the_latent_distance(
        self, flat: FloorPlan, grid: LatentGrid, encoders: Encoders, optimiser: LatentPoseOptimiser
    ) -> None:
        for seed in range(10):
            query = layout_query(encoders, flat, some_pose(flat, seed))
            stages: tuple[Refine, ...] = ("lpo", "vdr", "none")
            answers = [localise(flat, grid, encoders, query, refine=s, refiner=optimiser.refine) for s in stages]
            distances = [answer.candidates[0].latent_distance for answer in answers]
            assert distances == sorted(distances)


class TestAnswer:
    @given(seed=seeds(), top_k=st.integers(1, 10), heading_known=st.booleans(), refine=st.sampled_from(["none", "lpo"]))
    @settings(max_examples=20)
    def test_candidates_are_apart_best_first_inside_their_rooms_and_not_too_many(
        self,
        flat: FloorPlan,
        grid: LatentGrid,
        encoders: Encoders,
        optimiser: LatentPoseOptimiser,
        seed: int,
        top_k: int,
        heading_known: bool,
        refine: Refine,
    ) -> None:
        image = np.random.default_rng(seed).integers(0, 256, (32, 64, 3), dtype=np.uint8)
        query = encoders.query(image, 1.0 if heading_known else None, CAMERA_M)
        found = localise(flat, grid, encoders, query, refine=refine, top_k=top_k, refiner=optimiser.refine)
        positions = np.stack([candidate.position_m for candidate in found.candidates])
        assert 1 <= len(positions) <= top_k
        gaps = np.linalg.norm(positions[:, None] - positions[None], axis=-1) + 10.0 * np.eye(len(positions))
        assert gaps.min() >= 1.0
        distances = [candidate.latent_distance for candidate in found.candidates]
        assert distances == sorted(distances)
        assert flat.room_index_at(positions).tolist() == [candidate.room_index for candidate in found.candidates]
        for candidate in found.candidates:
            assert -math.pi <= panorama_heading(query, candidate) <= math.pi

    def test_a_small_plan_has_fewer_places_than_asked_for(self, encoders: Encoders) -> None:
        plan = plan_of(rectangle(1.2, 1.2))
        grid = build_grid(plan, encoders, step_m=0.5, camera_height_m=CAMERA_M)
        query = layout_query(encoders, plan, PoseSet(np.array([[0.5, 0.6]]), np.array([0])))
        assert len(localise(plan, grid, encoders, query, refine="vdr", top_k=5).candidates) == 1

    def test_the_same_query_gets_the_same_answer(
        self, flat: FloorPlan, grid: LatentGrid, encoders: Encoders, optimiser: LatentPoseOptimiser
    ) -> None:
        query = layout_query(encoders, flat, some_pose(flat, 1))
        first, second = (localise(flat, grid, encoders, query, refiner=optimiser.refine).candidates for _ in range(2))
        assert first == second

    @given(st.floats(-math.pi, math.pi), st.floats(-10.0, 10.0))
    def test_headings_are_wrapped(self, roll: float, frame_heading: float) -> None:
        query = Query(np.eye(2), np.array([0.0, roll]), 0.0, heading_known=False)
        heading = panorama_heading(query, Candidate(0.0, 0.0, 0, frame_heading, 1, 0.0))
        assert -math.pi <= heading <= math.pi
        assert abs(wrap_angle(heading - roll - frame_heading)) < 1e-9


class TestStages:
    @pytest.fixture
    def query(self, flat: FloorPlan, encoders: Encoders) -> Query:
        return layout_query(encoders, flat, some_pose(flat, 3))

    def test_the_answer_says_how_far_it_went(
        self, flat: FloorPlan, grid: LatentGrid, encoders: Encoders, optimiser: LatentPoseOptimiser, query: Query
    ) -> None:
        def stage(**options: Any) -> tuple[str, set[str]]:
            found = localise(flat, grid, encoders, query, **options)
            return found.stage, set(found.timings_ms)

        assert stage(refine="none", refiner=optimiser.refine) == ("retrieval", {"retrieve"})
        assert stage(refine="vdr", refiner=optimiser.refine) == ("vdr", {"retrieve", "vdr"})
        assert stage(refine="lpo", refiner=optimiser.refine) == ("lpo", {"retrieve", "vdr", "lpo"})
        assert stage(refine="lpo", refiner=None) == ("vdr", {"retrieve", "vdr"})

    def test_a_refiner_that_cannot_answer_leaves_the_vdr_pose(
        self, flat: FloorPlan, grid: LatentGrid, encoders: Encoders, query: Query
    ) -> None:
        without = localise(flat, grid, encoders, query, refine="vdr")
        late = localise(flat, grid, encoders, query, refiner=lambda job: None)
        assert late.stage == "vdr"
        assert late.candidates == without.candidates

    def test_an_optimisation_that_makes_it_worse_or_fails_is_not_used(
        self, flat: FloorPlan, grid: LatentGrid, encoders: Encoders, query: Query
    ) -> None:
        def refiner(job: RefinementJob) -> RefinementResult:
            count = len(job.position_m)
            return RefinementResult(
                position_m=job.position_m + 0.1,
                heading=job.heading,
                latent_distance=np.where(np.arange(count) % 2, np.nan, 1.9),
                converged=np.zeros(count, dtype=bool),
                evaluations=np.ones(count, dtype=int),
            )

        without = localise(flat, grid, encoders, query, refine="vdr")
        assert localise(flat, grid, encoders, query, refiner=refiner).candidates == without.candidates

    def test_the_refiner_is_given_each_candidate_with_its_own_room_and_target(
        self, flat: FloorPlan, grid: LatentGrid, encoders: Encoders
    ) -> None:
        jobs: list[RefinementJob] = []
        image = np.random.default_rng(0).integers(0, 256, (32, 64, 3), dtype=np.uint8)
        for heading in (None, 0.5):
            query = encoders.query(image, heading, CAMERA_M)
            localise(flat, grid, encoders, query, refiner=lambda job: jobs.append(job))
            expected = localise(flat, grid, encoders, query, refine="vdr").candidates
            job = jobs[-1]
            assert job.optimise_heading == (heading is None)
            # In the order of retrieval; the answer is ranked anew.
            order = [int(np.linalg.norm(job.position_m - c.position_m, axis=1).argmin()) for c in expected]
            for index, candidate in zip(order, expected, strict=True):
                np.testing.assert_array_equal(job.position_m[index], candidate.position_m)
                np.testing.assert_array_equal(job.targets[index], query.latents[candidate.hypothesis])
                np.testing.assert_array_equal(job.walls_m[index], flat.walls_m[candidate.room_index])
                assert job.heading[index] == candidate.frame_heading
                assert job.camera_height_m[index] == CAMERA_M

    def test_only_as_many_candidates_are_optimised_as_configured(
        self, flat: FloorPlan, grid: LatentGrid, encoders: Encoders, query: Query
    ) -> None:
        sizes: list[int] = []

        def refiner(job: RefinementJob) -> None:
            sizes.append(len(job.position_m))

        config = LocaliseConfig(lpo_candidates=2)
        found = localise(flat, grid, encoders, query, top_k=4, refiner=refiner, config=config)
        assert sizes == [2]
        assert len(found.candidates) == 4

    def test_two_candidates_that_meet_become_one(
        self, flat: FloorPlan, grid: LatentGrid, encoders: Encoders, query: Query
    ) -> None:
        def refiner(job: RefinementJob) -> RefinementResult:
            count = len(job.position_m)
            together = np.repeat(job.position_m[:1], count, axis=0)
            return RefinementResult(
                together, job.heading, np.linspace(0.0, 1e-3, count), np.ones(count, bool), np.ones(count, int)
            )

        found = localise(flat, grid, encoders, query, top_k=5, refiner=refiner)
        places = np.stack([candidate.position_m for candidate in found.candidates])
        assert np.linalg.norm(places[1:] - places[0], axis=1).min(initial=9.0) >= 1.0

    def test_the_clock_counts_a_stage_that_fails(self) -> None:
        clock = StageClock()
        with pytest.raises(RuntimeError), clock.stage("lpo"):
            raise RuntimeError
        assert clock.timings_ms["lpo"] >= 0.0


class TestGrid:
    def test_the_grid_holds_the_latents_of_its_own_poses_at_heading_zero(
        self, flat: FloorPlan, grid: LatentGrid, encoders: Encoders
    ) -> None:
        assert len(grid.latents) == len(grid.poses)
        index = np.array([0, 5, len(grid.poses) - 1])
        some = PoseSet(grid.poses.position_m[index], grid.poses.room_index[index])
        np.testing.assert_allclose(encoders.poses(flat, some, np.zeros(3), CAMERA_M), grid.latents[index], atol=1e-5)

    def test_another_camera_height_is_another_grid(self, flat: FloorPlan, grid: LatentGrid, encoders: Encoders) -> None:
        higher = build_grid(flat, encoders, step_m=0.5, camera_height_m=1.8)
        assert dataclasses.replace(higher, latents=grid.latents).camera_height_m == 1.8
        assert np.abs(higher.latents - grid.latents).max() > 1e-3
