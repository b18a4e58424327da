"""Localisation by explicit layouts: predicted wall profile, retrieval and alignment by depth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnxruntime
import pytest
import shapely
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.errors import BundleError, ConfigError, InvalidInputError
from lalaloc_core.evaluate.methods.alignment import depth_aligner
from lalaloc_core.evaluate.methods.explicit import ExplicitLayout
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.optimise import LpoConfig, PoseOptimiser
from lalaloc_core.localise.poses import RefinementJob
from lalaloc_core.render.depth import layout_depth
from lalaloc_core.render.profile import wall_profile
from lalaloc_core.render.sampling import PoseSet
from tests.core.questions import CAMERA_M, BareRoom, question_at
from tests.core.test_headings import COLUMNS, RING, paint
from tests.strategies import Scene, convex_polygons, crooked_flat, plan_of, room_polygons, scene_of, seeds

ROWS = 16
_ROUNDED = 2e-4


class PaintedProfile(onnxruntime.InferenceSession):
    """Stub of the image encoder's session: returns the wall profile painted on the picture (`paint`)."""

    def __init__(self) -> None:
        """Skip loading."""

    def run(self, output_names: Any, input_feed: Any, run_options: Any = None) -> list[np.ndarray]:
        assert output_names == ["ring", "log_profile", "log_scale"]
        pixels = input_feed["image"][:, 0].astype(np.float64)
        log_m = np.log((pixels[..., 0] * 65536 + pixels[..., 1] * 256 + pixels[..., 2]) * 1e-4).astype(np.float32)
        # Explicit layouts use neither the ring nor the predicted scale.
        return [np.zeros((1, RING.channels, RING.sectors), np.float32), log_m, np.zeros_like(log_m)]


@dataclass(frozen=True, eq=False)
class PaintedRoom(BareRoom):
    """Photograph that shows only its wall profile."""

    def image(self, height: int, width: int) -> np.ndarray:
        position = np.array([self.position_m])
        walls = self.plan.walls_m[self.plan.room_index_at(position)]
        return paint(wall_profile(position, np.array([self.heading]), walls, COLUMNS)[0])


@pytest.fixture(scope="module")
def painted(opened_bundle: Bundle) -> Encoders:
    encoders = Encoders(opened_bundle, threads=1)
    encoders._image = PaintedProfile()
    return encoders


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


class TestAligner:
    @given(polygon=convex_polygons(), seed=seeds())
    @settings(max_examples=5)
    def test_aligner_finds_the_pose_of_a_depth_image(self, polygon: list, seed: int) -> None:
        scene = scene_of(plan_of(polygon), 3, seed)
        rng = np.random.default_rng(seed)
        moved = scene.poses.position_m + rng.uniform(-0.1, 0.1, (3, 2))
        starts = np.where((scene.plan.room_index_at(moved) == 0)[:, None], moved, scene.poses.position_m)
        result = depth_aligner(rows=ROWS, columns=64).refine(depth_job(scene, starts, scene.poses.position_m, 64))
        assert np.linalg.norm(result.position_m - scene.poses.position_m, axis=1).max() < 0.01

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
        scene = scene_of(plan_of([[0, 0], [4, 0], [4, 3], [0, 3.5]]), 2, 0)
        job = depth_job(scene, scene.poses.position_m, scene.poses.position_m, 64)
        thinned = job.targets.reshape(2, ROWS, 64)[:, :, ::4].reshape(2, -1)
        aligner = depth_aligner(rows=ROWS, columns=64, thinning=4, config=LpoConfig(adam_steps=1))
        job = RefinementJob(**{**vars(job), "targets": thinned})
        np.testing.assert_allclose(aligner.refine(job).cost, 0.0, atol=1e-5)

    @given(room_polygons(), seeds(), st.sampled_from(["l1", "l2"]))
    @settings(max_examples=10)
    def test_first_step_follows_finite_differences(self, polygon: list, seed: int, norm: Any) -> None:
        scene = scene_of(plan_of(polygon), 1, seed)
        start = scene.poses.position_m
        targets = torch.linspace(0.0, 1.0, 3)[None]

        # Smooth in the profile, so that differences and derivatives agree.
        def embedding(profile_m: torch.Tensor, *_: torch.Tensor) -> torch.Tensor:
            return torch.stack([profile_m.log().mean(1), profile_m.square().mean(1), profile_m[:, 0]], dim=1)

        job = RefinementJob(**{**vars(depth_job(scene, start, start, 32)), "targets": targets.numpy()})

        def distance(offset: np.ndarray) -> float:
            profile = torch.from_numpy(wall_profile(start + offset, np.zeros(1), scene.walls_m, 32))
            residual = embedding(profile) - targets
            return float(residual.abs().mean() if norm == "l1" else residual.norm())

        step = 1e-5
        gradient = np.array([(distance(step * e) - distance(-step * e)) / (2 * step) for e in np.eye(2)])
        once = LpoConfig(method="adam", adam_steps=2, adam_learning_rate=1e-3)
        moved = PoseOptimiser(embedding, 32, norm=norm, config=once).refine(job).position_m[0] - start[0]
        # Adam's first step has the sign of the gradient; it is kept only where it lowers the distance.
        clear = np.abs(gradient) > 1e-2 * np.abs(gradient).max()
        if np.any(moved != 0.0):
            assert (np.sign(moved[clear]) == -np.sign(gradient[clear])).all()
            np.testing.assert_allclose(np.abs(moved[clear]), 1e-3, rtol=1e-2)
        else:
            assert distance(-1e-3 * np.sign(gradient)) >= distance(np.zeros(2)) - 1e-6

    def test_levenberg_marquardt_needs_squares(self) -> None:
        with pytest.raises(ConfigError, match="l1"):
            PoseOptimiser(lambda profile, *_: profile, 32, norm="l1", config=LpoConfig())


class TestPredictedProfile:
    @given(heading=st.floats(-math.pi, TWO_PI))
    @settings(max_examples=15)
    def test_profile_is_turned_to_heading_zero(self, painted: Encoders, heading: float) -> None:
        plan, position = crooked_flat(), (1.37, 1.12)
        image = PaintedRoom(plan, position, heading).image(0, 0)
        profile, left_over = painted.profile(image, heading, CAMERA_M)
        assert abs(left_over) <= 0.5 * TWO_PI / COLUMNS + 1e-9
        expected = wall_profile(np.array([position]), np.array([left_over]), plan.walls_m[[0]], COLUMNS)[0]
        np.testing.assert_allclose(profile, expected, atol=_ROUNDED)

    def test_profile_averages_panorama_and_mirror_image(self, encoders: Encoders) -> None:
        image = np.random.default_rng(0).integers(0, 256, (RING.image_height, RING.image_width, 3), dtype=np.uint8)
        profile, left_over = encoders.profile(image, 0.0, CAMERA_M)
        predicted_profiles = []
        for view in (image, image[:, ::-1]):
            inputs = {"image": np.ascontiguousarray(view[None]), "camera_height_m": np.array([CAMERA_M], np.float32)}
            assert encoders._image is not None
            (predicted,) = encoders._image.run(["log_profile"], inputs)
            predicted_profiles.append(np.asarray(predicted)[0])
        assert left_over == 0.0
        np.testing.assert_allclose(
            np.log(profile), 0.5 * (predicted_profiles[0] + predicted_profiles[1][::-1]), atol=1e-5
        )
        assert profile.shape == (COLUMNS,)

    def test_network_without_profile_is_a_bundle_error(self, opened_bundle: Bundle) -> None:
        encoders = Encoders(opened_bundle, threads=1)
        encoders.predicts_profile = False
        with pytest.raises(BundleError, match="log_profile"):
            encoders.profile(np.zeros((RING.image_height, RING.image_width, 3), np.uint8), 0.0, CAMERA_M)


class TestMethod:
    @pytest.mark.parametrize("position", [(1.13, 1.02), (5.21, 1.42), (2.34, 4.81)])
    @pytest.mark.parametrize("heading", [None, 0.0, 2.3])
    def test_perfect_prediction_is_located(
        self, painted: Encoders, position: tuple[float, float], heading: float | None
    ) -> None:
        plan = crooked_flat()
        photograph = None if heading is None else PaintedRoom(plan, position, heading)
        question = question_at(plan, position, photograph=photograph, heading=heading or 0.0)
        answer = ExplicitLayout(painted).locate(question)
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
    def test_retrieval_minimises_mean_depth_difference(self, painted: Encoders, seed: int) -> None:
        plan = _two_ceilings()
        scene = scene_of(plan, 1, seed)
        question = question_at(plan, scene.poses.position_m[0])
        answer = ExplicitLayout(painted).locate(question)
        expected = [
            _slow_distance(question.true_profile(COLUMNS), plan, question.grid, k) for k in range(len(question.grid))
        ]
        assert answer.retrieved is not None
        assert expected[answer.retrieved] == pytest.approx(min(expected), abs=1e-5)
        assert answer.stages["retrieval"].distance == pytest.approx(min(expected), abs=1e-5)

    def test_unknown_heading_is_refused(self, painted: Encoders) -> None:
        with pytest.raises(InvalidInputError, match="heading"):
            ExplicitLayout(painted).locate(question_at(crooked_flat(), (1.0, 1.0), heading_known=False))


def _two_ceilings() -> FloorPlan:
    document = crooked_flat().to_dict()
    document["rooms"][1]["ceiling_height_m"] = 3.1
    return FloorPlan.from_dict(document)


def _slow_distance(profile_m: np.ndarray, plan: FloorPlan, grid: PoseSet, index: int) -> float:
    """Return the mean |difference| of two depth images of 32 rows, under the ceiling of the pose's room."""
    room = plan.rooms[int(grid.room_index[index])]
    seen = wall_profile(grid.position_m[index][None], np.zeros(1), room.walls_m[None], COLUMNS)[0]
    total = 0.0
    for i in range(32):
        elevation = (0.5 - (i + 0.5) / 32) * math.pi
        height = room.ceiling_height_m - CAMERA_M if elevation > 0.0 else CAMERA_M
        farthest = height / abs(math.sin(elevation))
        pairs = zip(profile_m, seen, strict=True)
        total += sum(
            abs(min(a / math.cos(elevation), farthest) - min(b / math.cos(elevation), farthest)) for a, b in pairs
        )
    return total / (32 * COLUMNS)
