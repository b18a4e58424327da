"""Views, photographs that show a part of the horizon: renderings, training, export, and queries."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.errors import BundleError, ConfigError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.learn.export.run import export_views
from lalaloc_core.learn.synth.augmentation.framing import framed, seen_by
from lalaloc_core.learn.synth.homes.splits import TRAIN, home_of
from lalaloc_core.learn.synth.rendering.panorama import PanoramaRenderer, Window, sample_shots
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.training import losses
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.data import TrainingData
from lalaloc_core.learn.training.presets import PRESETS
from lalaloc_core.learn.training.run import train_views
from lalaloc_core.learn.training.view_stage import middle
from lalaloc_core.localise.bundle import Bundle, MatchingWeights
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.layouts import layouts_at
from lalaloc_core.localise.matching_cost import MatchingConfig, MatchingCost
from lalaloc_core.localise.poses import PredictedProfile, Query, RivalWall
from lalaloc_core.localise.view_encoder import OnnxViewEncoder
from lalaloc_core.nets.image_encoder import TrunkImageEncoder
from lalaloc_core.nets.view_encoder import ViewEncoder, ViewEncoderConfig
from lalaloc_core.render.sampling import PoseSet
from tests.core.test_bundle import exported_bundle

TINY = dataclasses.replace(
    PRESETS["tiny-trunk"],
    view=ViewEncoderConfig(
        image_height=64,
        image_width=64,
        sectors=4,
        trunk=PRESETS["tiny-trunk"].trunk.trunk,
        squeezed=(8, 8, 8, 8),
        mixer_width=16,
        mixer_blocks=1,
        mixer_heads=2,
    ),
)
SHORT = dataclasses.replace(TINY, image=dataclasses.replace(TINY.image, steps=2, batch=4))
CPU = torch.device("cpu")
COLUMNS = 64
EXACT = CameraHeight(1.5, 0.0)
PLAN = FloorPlan.from_dict(
    {"ceiling_height_m": 2.5, "rooms": [{"polygon": [[0, 0], [5, 0], [5, 3], [2, 3], [2, 6], [0, 6]]}]}
)

POSES = PoseSet(np.array([[1.0, 1.0], [4.0, 2.0], [1.0, 5.0]]), np.zeros(3, np.intp))


class TestRendering:
    def test_a_window_shows_the_middle_of_the_sphere(self) -> None:
        home, rng = home_of(TRAIN, 0, 1)
        materials = MaterialLibrary.create(np.random.default_rng(0), None)
        shots = sample_shots(home, 2, rng)
        sphere = PanoramaRenderer(materials, height=64, width=128).hits(shots).distance_m
        # A quarter of the azimuths, from 45 degrees above the horizon to 45 below.
        window = Window(TWO_PI / 4.0, math.pi / 4.0)
        part = PanoramaRenderer(materials, height=32, width=32, window=window).hits(shots).distance_m
        torch.testing.assert_close(part, sphere[:, 48:80, 16:48], rtol=1e-3, atol=1e-3)

    def test_a_level_camera_sees_its_fields_of_view(self) -> None:
        azimuths = torch.deg2rad(torch.arange(-59.5, 60.0))
        elevations = torch.deg2rad(torch.arange(44.5, -45.0, -1.0))
        seen = seen_by(azimuths, elevations, 90.0, 60.0)
        horizon, ahead = seen[len(elevations) // 2], seen[:, len(azimuths) // 2]
        assert horizon.sum() == 90
        assert ahead.sum() == 60
        # Lines that are level and straight rise less in elevation beside the centre.
        assert seen[:, 20].sum() < 60

    def test_random_cameras_keep_the_pixels_they_see(self) -> None:
        azimuths = torch.deg2rad(torch.linspace(-55.0, 55.0, 64))
        elevations = torch.deg2rad(torch.linspace(39.0, -44.0, 48))
        images = (torch.arange(64.0) * 3.0).expand(8, 48, 64)[..., None].expand(8, 48, 64, 3)
        shown = framed(images, azimuths, elevations, torch.Generator().manual_seed(3))
        opaque = shown[..., 3] == 255.0
        assert set(shown[..., 3].unique().tolist()) == {0.0, 255.0}
        assert 0.1 < opaque.float().mean() < 0.9
        # The error of levelling moves pixels by a few degrees at most.
        assert ((shown[..., 0] - images[..., 0]).abs()[opaque] < 15.0).all()


class TestEncoder:
    def test_transparent_pixels_do_not_matter(self) -> None:
        torch.manual_seed(0)
        encoder = ViewEncoder(TINY.view, TINY.ring).eval()
        image = torch.randint(0, 256, (1, 64, 64, 4), dtype=torch.uint8)
        image[..., 3] = 255
        image[:, :, 40:, 3] = 0
        other = image.clone()
        other[:, :, 40:, :3] = 9
        with torch.no_grad():
            first, second = (encoder(view, torch.ones(1)) for view in (image, other))
        torch.testing.assert_close(first.log_profile, second.log_profile)
        columns = 4 * encoder.columns_per_sector
        torch.testing.assert_close(first.seen[0], (40 / 64 * columns - torch.arange(columns)).clamp(0, 1))

    def test_it_starts_from_the_encoder_of_spheres(self) -> None:
        torch.manual_seed(0)
        sphere, encoder = TrunkImageEncoder(TINY.trunk, TINY.ring), ViewEncoder(TINY.view, TINY.ring)
        encoder.start_from(sphere)
        for name in ("trunk._conv_stem.weight", "to_openings.weight", "norm.weight"):
            assert torch.equal(encoder.state_dict()[name], sphere.state_dict()[name])
        # A map that is the same at all heights gives the same features, in proportion to the heights that are seen.
        weights = sphere.state_dict()["squeezes.0.weight"]
        weights.fill_(0.1)
        encoder.start_from(sphere)
        share = encoder.state_dict()["squeezes.0.weight"].sum() / weights.sum()
        assert float(share) == pytest.approx(TINY.view.width_rad(TINY.ring) / math.pi, rel=1e-4)


class TestTraining:
    def test_a_run_is_exported_and_answers_queries(self, tmp_path: Path) -> None:
        run = tmp_path / "run"
        train_views(SHORT, run, device=CPU, data=TrainingData(validation_scenes=1), workers=0)
        checkpoint = Checkpoint.load(run / "view.pt", stage="view")
        assert checkpoint.step == 2
        assert {"val_nll", "val_log_error_80", "val_opening_accuracy_106"} <= checkpoint.metrics.keys()
        origin = exported_bundle(tmp_path / "origin", TINY)
        with pytest.raises(BundleError, match="no encoder of views"):
            OnnxViewEncoder(origin)
        bundle = export_views(run, origin.folder, tmp_path / "out", version="2")
        bundle.check()
        stored = Bundle.open(bundle.folder).manifest.view
        assert stored is not None
        assert (stored.sectors, stored.image_width) == (4, 64)
        image = np.random.default_rng(0).integers(0, 256, (64, 64, 4), dtype=np.uint8)
        image[..., 3] = 255
        query = OnnxViewEncoder(bundle).query([(image, 0.0)], None, EXACT)
        assert query.profile is not None
        columns = TINY.profile_columns
        assert len(query.roll) == columns
        expected = np.zeros(columns, bool)
        expected[middle(TINY)] = True
        assert np.array_equal(query.profile.seen[0], expected)
        assert np.array_equal(query.profile.seen[3], np.roll(expected, 3))

    def test_a_data_set_is_refused(self, tmp_path: Path) -> None:
        data = TrainingData(dataset=GeneratedScenes(homes=1))
        with pytest.raises(ConfigError, match="without a data set"):
            train_views(SHORT, tmp_path, device=CPU, data=data)

    def test_only_seen_azimuths_count(self) -> None:
        target = torch.zeros(1, 4)
        modes = torch.zeros(1, 4, 2), torch.zeros(1, 4, 2), torch.full((1, 4, 2), math.log(0.5))
        known = torch.tensor([[True, True, False, False]])
        wrong = target.clone()
        wrong[:, 2:] = 5.0
        assert losses.laplace_mixture(*modes, wrong, known) == losses.laplace_mixture(*modes, target, known)
        wrong[:, 0] = 1.0
        # The mean of one azimuth at its centre and one that is a scale away.
        assert float(losses.laplace_mixture(*modes, wrong, known)) == pytest.approx(0.5)


class TestMatching:
    def costs(self, profile: PredictedProfile) -> np.ndarray:
        query = Query(np.zeros((1, 4)), np.zeros(1), 0.0, True, EXACT, profile)
        layouts = layouts_at(PLAN, POSES, np.zeros(3), COLUMNS)
        return MatchingCost(PLAN, query, 0.05, MatchingWeights(), MatchingConfig()).costs(layouts)[0][0]

    def test_azimuths_that_are_not_seen_cost_nothing(self) -> None:
        log_m = layouts_at(PLAN, POSES, np.zeros(3), COLUMNS).log_profile.astype(float)
        seen = np.arange(COLUMNS) < 20
        log_scale = np.where(seen, -3.0, np.inf)[None]
        first = self.costs(PredictedProfile(log_m[:1], log_scale))
        second = self.costs(PredictedProfile(np.where(seen, log_m[:1], 7.0), log_scale))
        assert first[0] == pytest.approx(0.0, abs=1e-6)
        assert (first[1:] > 0.1).all()
        np.testing.assert_allclose(first, second)
        # In the units of a full sphere: the unseen azimuths count as a perfect fit.
        whole = self.costs(PredictedProfile(log_m[:1], np.full((1, COLUMNS), -3.0)))
        assert (first < whole + 1e-6).all()

    def test_a_second_mode_explains_other_walls(self) -> None:
        log_m = layouts_at(PLAN, POSES, np.zeros(3), COLUMNS).log_profile.astype(float)
        log_scale = np.full((1, COLUMNS), -3.0)
        alone = self.costs(PredictedProfile(log_m[:1], log_scale))

        def with_rival(odds: float) -> np.ndarray:
            rival = RivalWall(log_m[1:2], log_scale, np.full((1, COLUMNS), odds))
            return self.costs(PredictedProfile(log_m[:1], log_scale, rival))

        np.testing.assert_allclose(with_rival(0.0), alone, rtol=1e-5)
        first, second, other = with_rival(0.5)
        assert first == pytest.approx(0.0, abs=1e-3)
        # A wall at the centre of a mode that is half as likely costs log 2, less what the first mode explains.
        assert 0.3 < second <= math.log(2.0)
        assert second < alone[1]
        assert other > second
