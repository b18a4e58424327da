"""Views, photographs that show a part of the horizon: renderings, training, export, and queries."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from lalaloc_core.bundle import Bundle, MatchingWeights
from lalaloc_core.conventions import ROOM_TYPES, TWO_PI, wrap_angle
from lalaloc_core.errors import BundleError, ConfigError
from lalaloc_core.evaluate.calibrate.calibration import store_matching_weights
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.learn.data.views import Stated, ViewPhotograph, ViewScenes
from lalaloc_core.learn.export.run_export import export_into
from lalaloc_core.learn.synth.augmentation import framed, seen_by
from lalaloc_core.learn.synth.homes.plans import TRAIN, home_of
from lalaloc_core.learn.synth.rendering.sphere_renderer import SphereRenderer, Window
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.learn.training import losses
from lalaloc_core.learn.training.batch_streams import UNKNOWN
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import PRESETS
from lalaloc_core.learn.training.run import train_stage
from lalaloc_core.learn.training.training_data import TrainingData
from lalaloc_core.learn.training.view_stage import middle
from lalaloc_core.localise.encode.view_encoder import ViewEncoder
from lalaloc_core.localise.match import MatchingConfig, MatchingCost, layouts_at
from lalaloc_core.localise.query import CameraHeight, PredictedProfile, Query
from lalaloc_core.localise.query.query import RivalWall
from lalaloc_core.nets.image_features import WallModes
from lalaloc_core.nets.sphere_network import TrunkImageEncoder
from lalaloc_core.nets.view_network import ViewNetwork
from lalaloc_core.photograph.patches import PatchSize
from lalaloc_core.photograph.photograph import Photograph
from lalaloc_core.render.sampling import PoseSet
from tests.core.test_bundle import exported_bundle
from tests.strategies import present

TINY = PRESETS["tiny-trunk"]
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
        sphere = SphereRenderer(materials, height=64, width=128).hits(shots).distance_m
        # A quarter of the azimuths, from 45 degrees above the horizon to 45 below.
        window = Window(TWO_PI / 4.0, math.pi / 4.0)
        part = SphereRenderer(materials, height=32, width=32, window=window).hits(shots).distance_m
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


class TestViewScenes:
    @pytest.mark.slow
    def test_views_state_what_is_known_and_show_where_they_look(self) -> None:
        spheres = GeneratedScenes(homes=1, seed=0, shots_per_home=1)
        name = spheres.scenes("validation")[0]

        def opened(stated: Stated) -> Photograph:
            (camera,) = ViewScenes(spheres, field_deg=80.0, stated=stated).load(name).cameras
            (photograph,) = camera.photographs.values()
            assert isinstance(photograph, ViewPhotograph)
            return photograph.open(PatchSize())

        nothing, field, tilt = opened("nothing"), opened("field"), opened("tilt")
        assert [view.hfov.source for view in (nothing, field, tilt)] == ["estimated", "given", "given"]
        assert [view.pitch.source == "given" for view in (nothing, field, tilt)] == [False, False, True]
        assert nothing.hfov.sd > field.hfov.sd
        (camera,) = spheres.load(name).cameras
        ahead, behind = ViewScenes(spheres, field_deg=80.0, per_camera=2).load(name).cameras
        assert (ahead.name, behind.name) == ("0@0", "0@-180")
        assert abs(wrap_angle(behind.heading - camera.heading)) == pytest.approx(math.pi)
        size = PatchSize()
        for view in (ahead, behind):
            (photograph,) = view.photographs.values()
            assert isinstance(photograph, ViewPhotograph)
            seen = photograph.open(size)
            (patch,) = seen.patches
            # The tilt is unknown to the reader, and its error moves pixels.
            assert abs(seen.pitch.value - photograph.pitch) < math.radians(4.0)
            height, width = 2 * round(90.0 / size.hfov_deg * size.width), round(360.0 / size.hfov_deg * size.width)
            top = round((90.0 - size.top_deg) / 180.0 * height)
            left = (width - size.width) // 2
            sphere = photograph.image(height, width)[top : top + size.height, left : left + size.width]
            difference = np.abs(patch.pixels.astype(float) - sphere)[patch.seen]
            wrong = np.abs(patch.pixels.astype(float) - sphere[:, ::-1])[patch.seen]
            assert difference.mean() < min(20.0, 0.6 * wrong.mean())


class TestEncoder:
    def test_transparent_pixels_do_not_matter(self) -> None:
        torch.manual_seed(0)
        encoder = ViewNetwork(TINY.view, TINY.ring).eval()
        image = torch.randint(0, 256, (1, 64, 64, 4), dtype=torch.uint8)
        image[..., 3] = 255
        image[:, :, 40:, 3] = 0
        other = image.clone()
        other[:, :, 40:, :3] = 9
        with torch.no_grad():
            first, second = (encoder(view, torch.ones(1)) for view in (image, other))
        torch.testing.assert_close(first.walls.log_profile, second.walls.log_profile)
        columns = 4 * encoder.columns_per_sector
        torch.testing.assert_close(first.seen[0], (40 / 64 * columns - torch.arange(columns)).clamp(0, 1))

    def test_objects_are_learnt_on_a_trunk_that_stays(self) -> None:
        torch.manual_seed(0)
        encoder = ViewNetwork(dataclasses.replace(TINY.view, objects=3), TINY.ring)
        # Earlier weights have no objects.
        encoder.load_state_dict(ViewNetwork(TINY.view, TINY.ring).state_dict())
        image = torch.randint(0, 256, (2, 64, 64, 4), dtype=torch.uint8)
        found = present(encoder(image, torch.ones(2)).objects)
        assert found.shape == (2, 3 + len(ROOM_TYPES))
        losses.objects(found, torch.tensor([[0.9, 0.1, 0.0]] * 2), torch.tensor([3, UNKNOWN])).backward()
        parts = {name.split(".")[0] for name, p in encoder.named_parameters() if p.grad is not None and p.grad.any()}
        assert parts == {"to_objects"}

    def test_it_starts_from_the_encoder_of_spheres(self) -> None:
        torch.manual_seed(0)
        sphere, encoder = TrunkImageEncoder(TINY.trunk, TINY.ring), ViewNetwork(TINY.view, TINY.ring)
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
    @pytest.mark.slow
    def test_a_run_is_exported_and_answers_queries(self, tmp_path: Path) -> None:
        run = tmp_path / "run"
        train_stage("view", SHORT, run, device=CPU, data=TrainingData(validation_scenes=1), workers=0)
        checkpoint = Checkpoint.load(run / "view.pt", stage="view")
        assert checkpoint.step == 2
        assert {"val_nll", "val_log_error_80", "val_opening_accuracy_106"} <= checkpoint.metrics.keys()
        origin = exported_bundle(tmp_path / "origin", TINY)
        with pytest.raises(BundleError, match="no encoder of views"):
            ViewEncoder(origin)
        bundle = export_into(origin.folder, run, tmp_path / "out", version="2")
        bundle.check()
        assert present(Bundle.open(bundle.folder).manifest.view).image_width == 64
        store_matching_weights(bundle, weights := MatchingWeights(tail=1.5), views=True)
        again = export_into(bundle.folder, run, tmp_path / "again", version="3")
        assert present(again.manifest.view).evidence == weights
        image = np.random.default_rng(0).integers(0, 256, (64, 64, 4), dtype=np.uint8)
        image[..., 3] = 255
        encoder = ViewEncoder(bundle)
        outputs = encoder.outputs([image], EXACT.height_m)
        query = encoder.query_of_outputs(outputs, [(0.0, 0.0)], None, EXACT)
        assert query.profile is not None
        columns = TINY.profile_columns
        assert len(query.roll) == columns
        expected = np.zeros(columns, bool)
        expected[middle(TINY)] = True
        assert np.array_equal(query.profile.seen[0], expected)
        assert np.array_equal(query.profile.seen[3], np.roll(expected, 3))
        # An uncertain tilt widens the predictions: numerically, by the distance of an edge seen at another elevation.
        tilt, error = math.radians(3.0), math.sqrt(math.radians(3.0) ** 2 - math.radians(0.7) ** 2)
        tilted = present(encoder.query_of_outputs(outputs, [(0.0, tilt)], None, EXACT).profile)
        log_m, seen = query.profile.log_m[0, expected], np.exp(query.profile.log_scale[0, expected])
        elevation = np.arctan(EXACT.height_m / np.exp(log_m))
        moved = np.log(np.tan(elevation + 1e-4) / np.tan(elevation)) / 1e-4 * error
        wider = np.hypot(seen, moved / math.sqrt(2.0))
        np.testing.assert_allclose(np.exp(tilted.log_scale[0, expected]), wider, rtol=1e-2)

    def test_a_data_set_is_refused(self, tmp_path: Path) -> None:
        data = TrainingData(dataset=GeneratedScenes(homes=1))
        with pytest.raises(ConfigError, match="without a data set"):
            train_stage("view", SHORT, tmp_path, device=CPU, data=data)

    def test_only_seen_azimuths_count(self) -> None:
        target = torch.zeros(1, 4)
        modes = WallModes(torch.zeros(1, 4, 2), torch.zeros(1, 4, 2), torch.full((1, 4, 2), math.log(0.5)))
        known = torch.tensor([[True, True, False, False]])
        wrong = target.clone()
        wrong[:, 2:] = 5.0
        assert losses.laplace_mixture(modes, wrong, known) == losses.laplace_mixture(modes, target, known)
        wrong[:, 0] = 1.0
        # The mean of one azimuth at its centre and one that is a scale away.
        assert float(losses.laplace_mixture(modes, wrong, known)) == pytest.approx(0.5)


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
