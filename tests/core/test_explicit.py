"""Localisation by explicit layouts: predicted wall profile, retrieval and alignment by depth."""

from __future__ import annotations

import math
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest
import shapely
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.errors import BundleError, ConfigError, InvalidInputError
from lalaloc_core.evaluate.methods.explicit import ExplicitLayout, VdrDecode, depth_aligner
from lalaloc_core.evaluate.methods.lalaloc import LaLaLoc
from lalaloc_core.evaluate.methods.method import Question
from lalaloc_core.evaluate.methods.similarity import DepthGrid, Layout
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import MatchingConfig
from lalaloc_core.localise.refine import LpoConfig, RefinementJob
from lalaloc_core.localise.refine.latent_refiner import PoseOptimiser
from lalaloc_core.localise.search.pipeline import LocaliseConfig
from lalaloc_core.nets.layout_network import DECODED_HEIGHT, DECODED_WIDTH, LayoutDecoder
from lalaloc_core.render.profile import layout_depth, wall_profile
from tests.core.questions import CAMERA_M, BareRoom, paint, question_at
from tests.core.test_headings import COLUMNS, RING
from tests.strategies import Scene, convex_polygons, crooked_flat, plan_of, present, room_polygons, scene_of, seeds

ROWS = 16
_ROUNDED = 2e-4
ROOM = [[0, 0], [4, 0], [4, 3], [0, 3.5]]


@dataclass(frozen=True, eq=False)
class PaintedRoom(BareRoom):
    def image(self, height: int, width: int) -> np.ndarray:
        position = np.array([self.position_m])
        walls = self.plan.walls_m[self.plan.room_index_at(position)]
        return paint(wall_profile(position, np.array([self.heading]), walls, COLUMNS)[0])


def depth_job(scene: Scene, starts_m: np.ndarray, truths_m: np.ndarray, columns: int) -> RefinementJob:
    """Return starts with the layout depth of another place in their room as target."""
    count = len(starts_m)
    profile = wall_profile(truths_m, np.zeros(count), scene.walls_m, columns)
    depth = layout_depth(profile, np.full(count, CAMERA_M), scene.ceiling_height_m, ROWS)
    return RefinementJob(
        targets=depth.reshape(count, -1),
        position_m=starts_m,
        heading=np.zeros(count),
        walls_m=scene.walls_m,
        camera_height_m=np.full(count, CAMERA_M),
        ceiling_height_m=scene.ceiling_height_m,
        optimise_heading=False,
    )


def moved_within(scene: Scene, seed: int) -> np.ndarray:
    """Return a scene's positions (n, 2) up to 0.1 m away in x and y, except where this leaves the room."""
    positions = scene.poses.position_m
    moved = positions + np.random.default_rng(seed).uniform(-0.1, 0.1, positions.shape)
    return np.where((scene.plan.room_index_at(moved) == 0)[:, None], moved, positions)


class TestAligner:
    def test_aligner_finds_the_pose_of_a_depth_image(self) -> None:
        scene = scene_of(plan_of(ROOM), 8, 0)
        truths = scene.poses.position_m
        job = depth_job(scene, moved_within(scene, 0), truths, 64)
        result = depth_aligner(rows=ROWS, columns=64).refine(job)
        assert np.linalg.norm(result.position_m - truths, axis=1).max() < 0.01

    # In narrow rooms the cost hardly depends on one direction, and the search can end far from the truth.
    @pytest.mark.slow
    @given(polygon=convex_polygons(), seed=seeds())
    @settings(max_examples=5)
    def test_aligner_matches_a_depth_image(self, polygon: list, seed: int) -> None:
        scene = scene_of(plan_of(polygon), 3, seed)
        job = depth_job(scene, moved_within(scene, seed), scene.poses.position_m, 64)
        first = depth_aligner(rows=ROWS, columns=64, config=LpoConfig(adam_steps=1)).refine(job)
        result = depth_aligner(rows=ROWS, columns=64).refine(job)
        assert (result.cost < 0.25 * first.cost + 1e-3).all()

    @given(polygon=room_polygons(), seed=seeds())
    @settings(max_examples=4)
    def test_aligner_stays_in_room_and_never_worsens(self, polygon: list, seed: int) -> None:
        scene = scene_of(plan_of(polygon), 3, seed, margin_m=0.05)
        starts = scene.poses.position_m
        job = depth_job(scene, starts, starts[::-1], 32)
        result = depth_aligner(rows=ROWS, columns=32, config=LpoConfig(adam_steps=40)).refine(job)
        assert shapely.contains(scene.plan.rooms[0].shape, shapely.points(result.position_m)).all()
        profile = wall_profile(starts, np.zeros(3), scene.walls_m, 32)
        depth = layout_depth(profile, np.full(3, CAMERA_M), scene.ceiling_height_m, ROWS).reshape(3, -1)
        assert (result.cost <= np.abs(depth - job.targets).mean(axis=1) + 1e-5).all()

    def test_thinned_images_keep_every_nth_column(self) -> None:
        scene = scene_of(plan_of(ROOM), 2, 0)
        job = depth_job(scene, scene.poses.position_m, scene.poses.position_m, 64)
        thinned = job.targets.reshape(2, ROWS, 64)[:, :, ::4].reshape(2, -1)
        aligner = depth_aligner(rows=ROWS, columns=64, thinning=4, config=LpoConfig(adam_steps=1))
        job = RefinementJob(**{**vars(job), "targets": thinned})
        np.testing.assert_allclose(aligner.refine(job).cost, 0.0, atol=1e-5)

    def test_levenberg_marquardt_needs_squares(self) -> None:
        with pytest.raises(ConfigError, match="l1"):
            PoseOptimiser(lambda profile, *_: profile, 32, norm="l1", config=LpoConfig())


class TestPredictedProfile:
    @given(heading=st.floats(-math.pi, TWO_PI))
    @settings(max_examples=15)
    def test_profile_is_turned_to_heading_zero(self, perfect: PhotographEncoder, heading: float) -> None:
        plan, position = crooked_flat(), (1.37, 1.12)
        image = PaintedRoom(plan, position, heading).image(0, 0)
        profile, left_over = perfect.spheres.profile(image, heading, CAMERA_M)
        assert abs(left_over) <= 0.5 * TWO_PI / COLUMNS + 1e-9
        expected = wall_profile(np.array([position]), np.array([left_over]), plan.walls_m[[0]], COLUMNS)[0]
        np.testing.assert_allclose(profile, expected, atol=_ROUNDED)

    def test_profile_averages_sphere_and_mirror_image(self, encoders: PhotographEncoder, opened_bundle: Bundle) -> None:
        image = np.random.default_rng(0).integers(0, 256, (RING.image_height, RING.image_width, 3), dtype=np.uint8)
        profile, left_over = encoders.spheres.profile(image, 0.0, CAMERA_M)
        predicted_profiles = []
        for view in (image, image[:, ::-1]):
            inputs = {"image": np.ascontiguousarray(view[None]), "camera_height_m": np.array([CAMERA_M], np.float32)}
            (predicted,) = present(encoders.spheres.session).run(["log_profile"], inputs)
            predicted_profiles.append(np.asarray(predicted)[0])
        assert left_over == 0.0
        np.testing.assert_allclose(
            np.log(profile), 0.5 * (predicted_profiles[0] + predicted_profiles[1][::-1]), atol=1e-5
        )
        assert profile.shape == (COLUMNS,)
        # Side by side on two threads, they give the same.
        threads: list[str] = []
        with ThreadPoolExecutor(1, "helper", lambda: threads.append(threading.current_thread().name)) as helper:
            beside = PhotographEncoder(opened_bundle, threads=1)
            beside.spheres.helper = lambda: helper
            np.testing.assert_allclose(beside.spheres.profile(image, 0.0, CAMERA_M)[0], profile, rtol=1e-4)
        assert threads == ["helper_0"]

    def test_network_without_profile_is_a_bundle_error(self, opened_bundle: Bundle) -> None:
        encoders = PhotographEncoder(opened_bundle, threads=1)
        encoders.spheres.predicts_profile = False
        with pytest.raises(BundleError, match="log_profile"):
            encoders.spheres.profile(np.zeros((RING.image_height, RING.image_width, 3), np.uint8), 0.0, CAMERA_M)


class TestMethod:
    @pytest.mark.parametrize("position", [(1.13, 1.02), (5.21, 1.42), (2.34, 4.81)])
    @pytest.mark.parametrize("heading", [None, 0.0, 2.3])
    def test_perfect_prediction_is_located(
        self, perfect: PhotographEncoder, position: tuple[float, float], heading: float | None
    ) -> None:
        plan = crooked_flat()
        photograph = None if heading is None else PaintedRoom(plan, position, heading)
        question = question_at(plan, position, photograph=photograph, heading=heading or 0.0)
        answer = ExplicitLayout(perfect).locate(question)
        errors = [math.hypot(f.x_m - position[0], f.y_m - position[1]) for f in answer.stages.values()]
        assert list(answer.stages) == ["retrieval", "vdr", "align"]
        assert list(answer.timings_ms) == ["encode", "retrieve", "vdr", "align"]
        assert errors[0] < 0.5
        assert errors[2] < 0.02
        distances = [found.distance for found in answer.stages.values()]
        assert distances[2] <= distances[1]  # type: ignore[operator]
        for found in answer.stages.values():
            assert found.room_index == question.camera.room_index
            assert abs(wrap_angle(found.heading - question.camera.heading)) < 1e-9

    @given(seed=seeds())
    @settings(max_examples=3)
    def test_retrieval_minimises_mean_depth_difference(self, perfect: PhotographEncoder, seed: int) -> None:
        document = crooked_flat().to_dict()
        document["rooms"][1]["ceiling_height_m"] = 3.1
        plan = FloorPlan.from_dict(document)
        question = question_at(plan, scene_of(plan, 1, seed).poses.position_m[0])
        answer = ExplicitLayout(perfect).locate(question)
        profile_m, ceiling_m = question.true_profile(COLUMNS), question.ceiling_height_m
        layout = Layout(profile_m=profile_m, camera_height_m=CAMERA_M, ceiling_height_m=ceiling_m)
        expected = DepthGrid(plan, question.grid, CAMERA_M, rows=32, columns=COLUMNS).distances(layout)
        assert expected[present(answer.retrieved)] == pytest.approx(expected.min(), abs=1e-5)
        assert answer.stages["retrieval"].distance == pytest.approx(expected.min(), abs=1e-5)

    def test_unknown_heading_is_refused(self, perfect: PhotographEncoder) -> None:
        with pytest.raises(InvalidInputError, match="heading"):
            ExplicitLayout(perfect).locate(question_at(crooked_flat(), (1.0, 1.0), heading_known=False))


class TrueDecoder(LayoutDecoder):
    """Stub of a perfect decoder: the layout depth of the true pose for every latent."""

    def __init__(self, question: Question) -> None:
        super().__init__()
        camera, ceiling = np.array([CAMERA_M]), np.array([question.ceiling_height_m])
        self.depth = layout_depth(question.true_profile(COLUMNS)[None], camera, ceiling, DECODED_HEIGHT)

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        depth = torch.from_numpy(self.depth.astype(np.float32)).expand(len(latent), -1, -1)
        return depth.repeat_interleave(DECODED_WIDTH // depth.shape[2], dim=2)


@pytest.mark.parametrize("position", [(1.4, 1.3), (2.1, 0.9), (3.1, 1.6)])
def test_perfect_decoder_finds_the_truth(encoders: PhotographEncoder, position: tuple[float, float]) -> None:
    question = question_at(plan_of([[0.0, 0.0], [4.0, 0.0], [4.0, 2.2], [0.0, 3.0]]), position)
    answer = VdrDecode(encoders, TrueDecoder(question)).locate(question)
    found = answer.stages["decode"]
    assert math.hypot(found.x_m - position[0], found.y_m - position[1]) < 0.02
    assert found.distance == pytest.approx(0.0, abs=0.01)
    assert list(answer.timings_ms) == ["encode", "retrieve", "vdr", "decode"]


@pytest.mark.parametrize("heading_known", [True, False])
def test_retrieval_and_vdr_equal_lalaloc(encoders: PhotographEncoder, heading_known: bool) -> None:
    torch.manual_seed(0)
    question = question_at(crooked_flat(), (1.2, 1.1), heading=0.7, heading_known=heading_known)
    answer = VdrDecode(encoders, LayoutDecoder()).locate(question)
    by_latent = LocaliseConfig(matching=MatchingConfig(use_profile=False))
    expected = LaLaLoc(encoders, refine="vdr", config=by_latent).locate(question)
    assert list(answer.stages) == ["retrieval", "vdr", "decode"]
    assert {stage: answer.stages[stage] for stage in expected.stages} == expected.stages
    assert answer.retrieved == expected.retrieved
    # The decoder is untrained; the pose still stays in its room.
    found = answer.stages["decode"]
    assert crooked_flat().room_index_at(np.array([[found.x_m, found.y_m]]))[0] == found.room_index
    if heading_known:
        assert found.heading == pytest.approx(0.7)


def test_decoded_layouts_have_the_compared_width(encoders: PhotographEncoder) -> None:
    torch.manual_seed(0)
    decoder = LayoutDecoder().eval()
    latents = np.random.default_rng(0).normal(size=(3, 128)).astype(np.float32)
    decoded = VdrDecode(encoders, decoder).decode(latents).reshape(3, DECODED_HEIGHT, COLUMNS)
    with torch.no_grad():
        whole = decoder(torch.from_numpy(latents)).numpy()
    np.testing.assert_allclose(decoded, whole[:, :, :: DECODED_WIDTH // COLUMNS], atol=1e-6)
