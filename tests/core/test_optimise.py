"""Latent pose optimisation: it finds the truth, stays in its room, and a batch is its poses one by one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import shapely
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lalaloc_core.errors import BundleError
from lalaloc_core.localise.bundle import LAYOUT_WEIGHTS, Bundle
from lalaloc_core.localise.optimise import LpoConfig, PoseRefiner
from lalaloc_core.localise.poses import RefinementJob, RefinementResult
from lalaloc_core.nets.layout_encoder import RingLayoutEncoder
from lalaloc_core.render.profile import wall_profile
from lalaloc_core.render.sampling import PoseSet
from tests.strategies import Scene, convex_polygons, l_shape, plan_of, room_polygons, scene_of, seeds

CAMERA_M = 1.4
# Pruning looks at the other starts of a job; here each start counts for itself.
LM = LpoConfig(prune_after=99)
ADAM = LpoConfig(method="adam")


def exact_targets(encoder: RingLayoutEncoder, scene: Scene) -> np.ndarray:
    """Latents of the scene's own poses, at heading 0."""
    profile = wall_profile(
        scene.poses.position_m, np.zeros(len(scene.poses)), scene.walls_m, encoder.config.profile_columns
    )
    arrays = (profile, np.full(len(profile), CAMERA_M), scene.ceiling_height_m)
    return encoder(*(torch.tensor(array, dtype=torch.float32) for array in arrays)).numpy()


def job_near(encoder: RingLayoutEncoder, scene: Scene, seed: int, *, heading_known: bool) -> RefinementJob:
    """Starts within 15 cm of the truth (and 3° of heading 0), in the same room."""
    rng = np.random.default_rng(seed)
    count = len(scene.poses)
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, count), 0.15 * np.sqrt(rng.uniform(0.0, 1.0, count))
    moved = scene.poses.position_m + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inside = scene.plan.room_index_at(moved) == scene.poses.room_index
    return RefinementJob(
        targets=exact_targets(encoder, scene),
        position_m=np.where(inside[:, None], moved, scene.poses.position_m),
        heading=np.zeros(count) if heading_known else rng.uniform(-0.05, 0.05, count),
        walls_m=scene.walls_m,
        camera_height_m=np.full(count, CAMERA_M),
        ceiling_height_m=scene.ceiling_height_m,
        optimise_heading=not heading_known,
    )


def by_profile(job: RefinementJob, scene: Scene, columns: int, *, offset: float = 0.0) -> RefinementJob:
    """The same job, compared by the wall profiles of the scene's own poses; `offset` is added to the log profile."""
    profile = wall_profile(scene.poses.position_m, np.zeros(len(scene.poses)), scene.walls_m, columns)
    log_profile = (np.log(profile) + offset).astype(np.float32)
    return dataclasses.replace(job, log_profile=log_profile, precision=np.full_like(log_profile, 5.0))


def profile_cost(job: RefinementJob, position_m: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """What a job by profiles minimises, with numpy, at one pose per start."""
    assert job.log_profile is not None
    assert job.precision is not None
    log_profile = np.log(wall_profile(position_m, heading, job.walls_m, job.log_profile.shape[1]))
    return np.log1p(np.square((log_profile - job.log_profile) * job.precision)).mean(axis=1)


def errors_m(result: RefinementResult, scene: Scene) -> np.ndarray:
    return np.linalg.norm(result.position_m - scene.poses.position_m, axis=1)


def latent_distance(result: RefinementResult) -> np.ndarray:
    """Of a job that is compared by latents."""
    assert result.latent_distance is not None
    return result.latent_distance


def one_pose(job: RefinementJob, index: int) -> RefinementJob:
    """The job of a single one of its poses."""
    arrays = {name: value[index : index + 1] for name, value in vars(job).items() if isinstance(value, np.ndarray)}
    return dataclasses.replace(job, **arrays)


class TestConvergence:
    @pytest.mark.parametrize("heading_known", [True, False])
    @given(polygon=convex_polygons(), seed=seeds())
    @settings(max_examples=20)
    def test_levenberg_marquardt_finds_the_truth_in_convex_rooms(
        self, smooth_encoder: RingLayoutEncoder, heading_known: bool, polygon: list, seed: int
    ) -> None:
        scene = scene_of(plan_of(polygon), 4, seed)
        job = job_near(smooth_encoder, scene, seed, heading_known=heading_known)
        result = PoseRefiner(smooth_encoder, LM).refine(job)
        assert errors_m(result, scene).max() < 1e-3
        assert np.abs(result.heading).max() < 1e-3
        assert latent_distance(result).max() < 1e-3
        assert result.evaluations.max() <= LM.max_iterations

    @pytest.mark.parametrize(("config", "wanted"), [(LM, 0.95), (ADAM, 0.85)], ids=["lm", "adam"])
    @pytest.mark.parametrize("heading_known", [True, False])
    def test_most_starts_reach_a_centimetre_where_corners_hide_parts_of_the_room(
        self, smooth_encoder: RingLayoutEncoder, config: LpoConfig, wanted: float, heading_known: bool
    ) -> None:
        scene = scene_of(plan_of(l_shape(5.0, 4.0, 2.0, 2.5)), 24, 0)
        job = job_near(smooth_encoder, scene, 1, heading_known=heading_known)
        result = PoseRefiner(smooth_encoder, config).refine(job)
        assert np.mean(errors_m(result, scene) < 0.01) >= wanted

    def test_adam_and_levenberg_marquardt_agree(self, smooth_encoder: RingLayoutEncoder) -> None:
        scene = scene_of(plan_of(l_shape(5.0, 4.0, 2.0, 2.5)), 4, 3)
        job = job_near(smooth_encoder, scene, 3, heading_known=True)
        first, second = (PoseRefiner(smooth_encoder, config).refine(job) for config in (LM, ADAM))
        np.testing.assert_allclose(first.position_m, second.position_m, atol=5e-3)

    @pytest.mark.parametrize("config", [LM, ADAM], ids=["lm", "adam"])
    @given(polygon=room_polygons(), seed=seeds())
    @settings(max_examples=6)
    def test_the_answer_is_never_worse_than_the_start(
        self, smooth_encoder: RingLayoutEncoder, config: LpoConfig, polygon: list, seed: int
    ) -> None:
        scene = scene_of(plan_of(polygon), 4, seed)
        job = job_near(smooth_encoder, scene, seed, heading_known=False)
        at_start = exact_targets(
            smooth_encoder, Scene(scene.plan, PoseSet(job.position_m, scene.poses.room_index), scene.heading)
        )
        # Compared at heading 0, so start there.
        job = dataclasses.replace(job, heading=np.zeros(4))
        result = PoseRefiner(smooth_encoder, config).refine(job)
        assert (latent_distance(result) <= np.linalg.norm(at_start - job.targets, axis=1) + 1e-5).all()

    def test_a_start_at_the_truth_stays_there_and_says_it_converged(self, smooth_encoder: RingLayoutEncoder) -> None:
        scene = scene_of(plan_of(l_shape(5.0, 4.0, 2.0, 2.5)), 3, 5)
        job = dataclasses.replace(
            job_near(smooth_encoder, scene, 0, heading_known=True), position_m=scene.poses.position_m
        )
        result = PoseRefiner(smooth_encoder, LM).refine(job)
        assert errors_m(result, scene).max() < 1e-4
        assert result.converged.all()

    @given(seeds())
    @settings(max_examples=10)
    def test_plans_far_from_the_origin_lose_no_precision(self, smooth_encoder: RingLayoutEncoder, seed: int) -> None:
        polygon = np.add(l_shape(5.0, 4.0, 2.0, 2.5), [500.0, -500.0])
        scene = scene_of(plan_of(polygon.tolist()), 3, seed)
        job = job_near(smooth_encoder, scene, seed, heading_known=True)
        near = dataclasses.replace(
            job, position_m=job.position_m - [500.0, -500.0], walls_m=job.walls_m - [500.0, -500.0, 500.0, -500.0]
        )
        here, there = (PoseRefiner(smooth_encoder, LM).refine(each) for each in (near, job))
        np.testing.assert_allclose(there.position_m - [500.0, -500.0], here.position_m, atol=1e-4)


class TestProfiles:
    @pytest.mark.parametrize("heading_known", [True, False])
    @given(polygon=convex_polygons(), seed=seeds())
    @settings(max_examples=10)
    def test_the_truth_is_found_by_its_wall_profile(
        self, smooth_encoder: RingLayoutEncoder, heading_known: bool, polygon: list, seed: int
    ) -> None:
        scene = scene_of(plan_of(polygon), 4, seed)
        job = job_near(smooth_encoder, scene, seed, heading_known=heading_known)
        job = by_profile(job, scene, smooth_encoder.config.profile_columns)
        result = PoseRefiner(smooth_encoder, LM).refine(job)
        assert errors_m(result, scene).max() < 5e-3
        assert np.abs(result.heading).max() < 5e-3

    @pytest.mark.parametrize("latent_weight", [0.0, 0.5])
    def test_cost_and_latent_distance_are_those_of_the_pose_it_ends_at(
        self, smooth_encoder: RingLayoutEncoder, latent_weight: float
    ) -> None:
        scene = scene_of(plan_of(l_shape(5.0, 4.0, 2.0, 2.5)), 5, 2)
        job = job_near(smooth_encoder, scene, 2, heading_known=False)
        job = by_profile(job, scene, smooth_encoder.config.profile_columns, offset=0.05)
        job = dataclasses.replace(job, latent_weight=latent_weight)
        result = PoseRefiner(smooth_encoder, LpoConfig()).refine(job)
        fit = profile_cost(job, result.position_m, result.heading)
        assert (fit <= profile_cost(job, job.position_m, job.heading) + 1e-5).all()
        if not latent_weight:
            # Of latents nothing was asked.
            assert result.latent_distance is None
            np.testing.assert_allclose(result.cost, fit, rtol=1e-3, atol=1e-4)
            return
        np.testing.assert_allclose(result.cost, fit + latent_weight * latent_distance(result), rtol=1e-3, atol=1e-4)
        profile = wall_profile(result.position_m, result.heading, scene.walls_m, smooth_encoder.config.profile_columns)
        arrays = (profile, np.full(5, CAMERA_M), scene.ceiling_height_m)
        latents = smooth_encoder(*(torch.tensor(array, dtype=torch.float32) for array in arrays)).numpy()
        np.testing.assert_allclose(latent_distance(result), np.linalg.norm(latents - job.targets, axis=1), atol=1e-4)

    @given(seeds())
    @settings(max_examples=10)
    def test_information_is_the_curvature_of_the_cost_where_the_fit_is_exact(
        self, smooth_encoder: RingLayoutEncoder, seed: int
    ) -> None:
        scene = scene_of(plan_of([[0.0, 0.0], [5.0, 0.3], [4.4, 3.8], [0.4, 3.2]]), 1, seed)
        columns = smooth_encoder.config.profile_columns
        job = job_near(smooth_encoder, scene, seed, heading_known=False)
        job = by_profile(job, scene, columns)
        job = dataclasses.replace(job, position_m=scene.poses.position_m, heading=np.zeros(1))
        (information,) = PoseRefiner(smooth_encoder, LM).refine(job).information
        np.testing.assert_allclose(information, information.T, rtol=1e-5)
        for step in 2e-4 * np.eye(3):
            costs = [profile_cost(job, job.position_m + sign * step[:2], sign * step[2:]) for sign in (1.0, -1.0)]
            # The optimiser's cost is half the sum over the columns, and the two sides cancel what is not curvature.
            assert 0.5 * columns * np.mean(costs) == pytest.approx(0.5 * step @ information @ step, rel=0.05)


class TestStayingInside:
    @pytest.mark.parametrize("config", [LM, ADAM], ids=["lm", "adam"])
    @given(here=room_polygons(), elsewhere=room_polygons(), seed=seeds(), heading_known=st.booleans())
    @settings(max_examples=15)
    def test_a_pose_never_leaves_its_room_whatever_the_target(
        self,
        smooth_encoder: RingLayoutEncoder,
        config: LpoConfig,
        here: list,
        elsewhere: list,
        seed: int,
        heading_known: bool,
    ) -> None:
        config = dataclasses.replace(config, adam_steps=40)
        # Starts anywhere in one room, even beside a wall; targets seen in another one, or pointing nowhere at all.
        scene = scene_of(plan_of(here), 5, seed, margin_m=0.01)
        targets = exact_targets(smooth_encoder, scene_of(plan_of(elsewhere), 5, seed))
        targets[0] = -targets[0]
        job = dataclasses.replace(
            job_near(smooth_encoder, scene, seed, heading_known=heading_known),
            targets=targets,
            position_m=scene.poses.position_m,
        )
        result = PoseRefiner(smooth_encoder, config).refine(job)
        assert np.isfinite(result.position_m).all()
        assert np.isfinite(result.heading).all()
        assert shapely.contains(scene.plan.rooms[0].shape, shapely.points(result.position_m)).all()

    @pytest.mark.parametrize("config", [LM, ADAM], ids=["lm", "adam"])
    def test_a_target_behind_a_thin_wall_does_not_pull_the_pose_through_it(
        self, smooth_encoder: RingLayoutEncoder, config: LpoConfig
    ) -> None:
        left = [[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [0.0, 3.0]]
        both = plan_of(left, [[3.05, 0.0], [6.0, 0.0], [6.0, 3.0], [3.05, 3.0]])
        start = Scene(both, PoseSet(np.array([[2.9, 1.5]]), np.array([0])), np.zeros(1))
        wide = plan_of([[0.0, 0.0], [6.0, 0.0], [6.0, 3.0], [0.0, 3.0]])
        target = Scene(wide, PoseSet(np.array([[3.6, 1.5]]), np.array([0])), np.zeros(1))
        job = dataclasses.replace(
            job_near(smooth_encoder, start, 0, heading_known=True),
            targets=exact_targets(smooth_encoder, target),
            position_m=start.poses.position_m,
        )
        assert both.room_index_at(PoseRefiner(smooth_encoder, config).refine(job).position_m).tolist() == [0]


class TestBatches:
    @pytest.mark.parametrize("heading_known", [True, False])
    @given(polygon=room_polygons(), seed=seeds())
    @settings(max_examples=8)
    def test_a_batch_is_its_poses_one_by_one(
        self, smooth_encoder: RingLayoutEncoder, heading_known: bool, polygon: list, seed: int
    ) -> None:
        optimiser = PoseRefiner(smooth_encoder, LM)
        scene = scene_of(plan_of(polygon), 4, seed)
        job = job_near(smooth_encoder, scene, seed, heading_known=heading_known)
        together = optimiser.refine(job)
        for index in range(4):
            alone = optimiser.refine(one_pose(job, index))
            np.testing.assert_allclose(alone.position_m[0], together.position_m[index], atol=1e-3)
            np.testing.assert_allclose(alone.heading[0], together.heading[index], atol=1e-3)
            np.testing.assert_allclose(latent_distance(alone)[0], latent_distance(together)[index], atol=1e-4)

    def test_poses_of_different_rooms_and_heights_share_a_batch(self, smooth_encoder: RingLayoutEncoder) -> None:
        plan = plan_of(l_shape(5.0, 4.0, 2.0, 2.5), [[6.0, 0.0], [9.0, 0.0], [8.0, 3.0]])
        poses = PoseSet(np.array([[1.0, 1.0], [7.5, 1.0]]), np.array([0, 1]))
        scene = Scene(plan, poses, np.zeros(2))
        job = job_near(smooth_encoder, scene, 0, heading_known=True)
        result = PoseRefiner(smooth_encoder, LM).refine(job)
        assert errors_m(result, scene).max() < 1e-3

    @given(seeds())
    @settings(max_examples=10)
    def test_pruning_starts_without_a_chance_leaves_the_answer_as_it_is(
        self, smooth_encoder: RingLayoutEncoder, seed: int
    ) -> None:
        # One target, one start near it and four anywhere: the answer is the best of the five.
        scene = scene_of(plan_of(l_shape(5.0, 4.0, 2.0, 2.5)), 5, seed)
        job = job_near(smooth_encoder, scene, seed, heading_known=True)
        job = dataclasses.replace(job, targets=job.targets[:1].repeat(5, axis=0))
        pruned, full = (PoseRefiner(smooth_encoder, config).refine(job) for config in (LpoConfig(), LM))
        best = int(latent_distance(full).argmin())
        assert latent_distance(pruned).min() <= 1e-3 + latent_distance(full)[best]
        answer = pruned.position_m[int(latent_distance(pruned).argmin())]
        np.testing.assert_allclose(answer, full.position_m[best], atol=5e-3)

    @given(seeds())
    @settings(max_examples=10)
    def test_the_best_start_is_never_pruned(self, smooth_encoder: RingLayoutEncoder, seed: int) -> None:
        scene = scene_of(plan_of(l_shape(5.0, 4.0, 2.0, 2.5)), 1, seed)
        job = job_near(smooth_encoder, scene, seed, heading_known=False)
        strict = LpoConfig(prune_after=1, prune_ratio=1.0)
        pruned, full = (PoseRefiner(smooth_encoder, config).refine(job) for config in (strict, LM))
        np.testing.assert_allclose(pruned.position_m, full.position_m, atol=1e-6)

    def test_a_known_heading_comes_back_as_it_was(self, smooth_encoder: RingLayoutEncoder) -> None:
        scene = scene_of(plan_of(l_shape(5.0, 4.0, 2.0, 2.5)), 3, 1)
        job = job_near(smooth_encoder, scene, 0, heading_known=True)
        job = dataclasses.replace(job, heading=np.array([0.01, -0.02, 0.0]))
        np.testing.assert_allclose(PoseRefiner(smooth_encoder).refine(job).heading, job.heading, atol=1e-7)


class TestLoading:
    def test_weights_that_do_not_fit_the_configuration_are_a_bundle_error(self, opened_bundle: Bundle) -> None:
        sizes = {**opened_bundle.manifest.layout_config, "layout_width": 24}
        wrong = dataclasses.replace(
            opened_bundle, manifest=dataclasses.replace(opened_bundle.manifest, layout_config=sizes)
        )
        with pytest.raises(BundleError, match="does not load"):
            PoseRefiner.from_bundle(wrong)

    @pytest.mark.parametrize("change", [{"architecture": "transformer"}, {"layout_config": {"depth": 3}}])
    def test_a_manifest_of_an_unknown_network_is_a_bundle_error(self, opened_bundle: Bundle, change: dict) -> None:
        wrong = dataclasses.replace(opened_bundle, manifest=dataclasses.replace(opened_bundle.manifest, **change))
        with pytest.raises(BundleError, match="does not load"):
            PoseRefiner.from_bundle(wrong)

    def test_a_bundle_without_the_weights_is_a_bundle_error(self, opened_bundle: Bundle) -> None:
        files = {k: v for k, v in opened_bundle.manifest.files.items() if k != LAYOUT_WEIGHTS}
        wrong = dataclasses.replace(opened_bundle, manifest=dataclasses.replace(opened_bundle.manifest, files=files))
        with pytest.raises(BundleError, match="has no file"):
            PoseRefiner.from_bundle(wrong)
