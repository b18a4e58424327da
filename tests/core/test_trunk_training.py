"""Training of image encoders: batches, losses and learning rates of the trunk, warm starts, and the best checkpoint."""

from __future__ import annotations

import dataclasses
import itertools
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from lalaloc_core.bundle import Bundle, default_bundle
from lalaloc_core.cli import main
from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES
from lalaloc_core.errors import CheckpointError, ConfigError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Camera
from lalaloc_core.learn.export.run_export import export_into, export_run
from lalaloc_core.learn.training import losses, run
from lalaloc_core.learn.training.batch_streams import UNKNOWN, SphereBatches, seen_openings
from lalaloc_core.learn.training.batches import Photographs
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import PRESETS, OptimiserConfig, TrainConfig
from lalaloc_core.learn.training.image_stage import ImageStage
from lalaloc_core.learn.training.layout_stage import EndToEndStage
from lalaloc_core.learn.training.loop import run_stage
from lalaloc_core.learn.training.run import train_stage
from lalaloc_core.learn.training.sources import GeneratedSource
from lalaloc_core.learn.training.stages import build_image_encoder, build_layout_encoder, build_optimiser
from lalaloc_core.learn.training.training_data import TrainingData
from lalaloc_core.learn.training.validate import cached_pictures
from lalaloc_core.learn.training.warm_start import load_warm_start, mean_with
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.nets.sphere_network import TrunkImageEncoder
from lalaloc_core.nets.trunk import Trunk
from tests.core.test_training import LineStage, same_weights
from tests.strategies import present

TINY = PRESETS["tiny-trunk"]
SHORT = TINY.with_settings({"image.steps": 2})
FEW = TrainingData(validation_scenes=1)
CPU = torch.device("cpu")
RING = PRESETS["tiny"]
SHORT_RING = RING.with_settings({"image.steps": 2, "layout.steps": 2})
WALL, DOOR, WINDOW, PASSAGE = range(len(OPENING_CLASSES))


def some_photographs() -> Photographs:
    generator = torch.Generator().manual_seed(5)
    images = torch.randint(0, 256, (3, *TINY.image_size, 3), dtype=torch.uint8, generator=generator)
    width = TINY.image_size[1]
    log_distance = torch.rand(3, width, generator=generator)
    log_distance[:, : width // 2] = torch.nan
    openings, types = 0.3 * torch.rand(3, width, 3, generator=generator), torch.tensor([1, UNKNOWN, 3])
    return Photographs(images, openings, log_distance, types, torch.ones(3))


def stage_of(config: TrainConfig = TINY, photographs: Photographs | None = None) -> ImageStage:
    torch.manual_seed(0)
    return ImageStage(config, GeneratedSource(config), build_layout_encoder(config), photographs)


def parts_with_gradient(stage: ImageStage) -> set[str]:
    parameters = stage.encoder.named_parameters()
    return {name.split(".")[0] for name, p in parameters if p.grad is not None and p.grad.any()}


@pytest.fixture(scope="module")
def batch() -> dict[str, torch.Tensor]:
    found: Any = next(iter(SphereBatches(TINY, GeneratedSource(TINY))))
    return found


def plan(**changes: Any) -> FloorPlan:
    """Return a square room of 4 m with a window in its northern wall."""
    document: dict[str, Any] = {
        "rooms": [{"polygon": [[0, 0], [4, 0], [4, 4], [0, 4]], "ceiling_height_m": 2.5, "type": "bedroom"}],
        "openings": [{"kind": "window", "line": [[1, 4], [3, 4]], "sill_m": 0.9, "head_m": 2.0}],
        "opening_kinds": ["door", "window", "passage"],
    }
    return FloorPlan.from_dict(document | changes)


def camera(height_m: float) -> Camera:
    middle_m = np.array([2.0, 2.0])
    return Camera(name="", position_m=middle_m, room_index=0, heading=0.0, camera_height_m=height_m, photographs={})


class TestLabels:
    def test_opening_kinds_match_the_plan(self) -> None:
        kind, _ = seen_openings(plan(), camera(1.5), 0.0, 64)
        azimuth_deg = ((np.arange(64) + 0.5) / 64 - 0.5) * 360.0
        # The window reaches one metre to either side, two metres ahead.
        expected = np.where(np.abs(azimuth_deg) < np.degrees(np.arctan(0.5)), WINDOW, WALL)
        np.testing.assert_array_equal(kind, expected)
        np.testing.assert_array_equal(seen_openings(plan(), camera(0.8), 0.0, 64)[0], WALL)

    def test_edges_of_openings_match_the_plan(self) -> None:
        kind, edges = seen_openings(plan(), camera(1.5), 0.0, 64)
        assert np.array_equal(np.isfinite(edges).all(axis=0), kind == WINDOW)
        # The window is two metres ahead, 0.6 m below the camera to 0.5 m above it.
        np.testing.assert_allclose(edges[:, 32], np.arctan2([-0.6, 0.5], 2.0 / np.cos(np.pi / 64)), rtol=1e-5)
        # Walls are unknown in plans without all openings.
        kind, _ = seen_openings(plan(opening_kinds=["window"]), camera(1.5), 0.0, 64)
        assert set(kind) == {UNKNOWN, WINDOW}

    def test_renderings_tell_where_walls_are_seen(self) -> None:
        (sample, *_) = GeneratedSource(TINY).samples(0, 64, 128)
        assert isinstance(sample.image, np.ndarray)
        walls = sample.image[..., 3]
        assert set(np.unique(walls)) == {0, 255}
        # Neither the floor below nor the ceiling above the camera is a wall.
        assert not walls[0].any()
        assert not walls[-1].any()
        assert 0.5 < np.mean(walls[31:33] > 0) <= 1.0

    def test_hidden_walls_are_learnt_by_column(self) -> None:
        walls = torch.zeros(1, 12, 8)
        walls[0, 4:8, :4] = 1.0
        seen = torch.ones(1, 4, dtype=torch.bool)
        right, wrong = torch.tensor([[9.0, 9.0, -9.0, -9.0]]), torch.tensor([[-9.0, 9.0, -9.0, -9.0]])
        assert float(losses.wall_seen(right, walls, seen)) < 0.01
        assert float(losses.wall_seen(wrong, walls, seen)) > 2.0
        seen[0, 0] = False
        assert float(losses.wall_seen(wrong, walls, seen)) < 0.01

    def test_batches_hold_openings_and_room_types(self, batch: dict[str, torch.Tensor]) -> None:
        kind = batch["opening_kind"]
        assert kind.shape == batch["profile_m"].shape
        assert set(kind.unique().tolist()) <= set(range(len(OPENING_CLASSES)))
        assert 0.3 < float((kind == WALL).float().mean()) < 0.95
        # All generated rooms have a type; code 0 means no type.
        assert bool(((batch["room_type"] >= 1) & (batch["room_type"] < len(ROOM_TYPES))).all())

    def test_other_architectures_have_no_class_labels(self) -> None:
        found: Any = next(iter(SphereBatches(PRESETS["tiny"], GeneratedSource(PRESETS["tiny"]))))
        assert not {"opening_kind", "room_type"} & set(found)


class TestLosses:
    def test_every_head_gets_a_gradient(self, batch: dict[str, torch.Tensor]) -> None:
        stage = stage_of(photographs=some_photographs())
        terms = stage.losses(batch)
        assert set(terms) == {"ring", "profile", "l2", "opening", "edges", "ceiling", "room_type", "photographs"}
        torch.stack(list(terms.values())).sum().backward()
        heads = {"to_ring", "to_profile", "to_openings", "to_edges", "to_ceiling", "to_room_type"}
        assert parts_with_gradient(stage) == heads | {"trunk", "squeezes", "join", "mixer", "norm"}
        assert all(p.grad is None for p in stage.teacher.parameters())

    def test_photographs_add_one_loss(self, batch: dict[str, torch.Tensor]) -> None:
        plain = TINY.with_settings({"image.optics": 0.0, "image.style_mixing": 0.0})
        with_them = stage_of(plain, some_photographs()).losses(batch)
        without = stage_of(plain).losses(batch)
        assert with_them.keys() - without.keys() == {"photographs"}
        for name, term in without.items():
            torch.testing.assert_close(with_them[name], term, rtol=1e-4, atol=1e-5)

    def test_photograph_weights_train_their_heads(self, batch: dict[str, torch.Tensor]) -> None:
        for weight, head in (("photograph_weight", "to_openings"), ("photograph_profile_weight", "to_profile")):
            alone = {"image.photograph_weight": 0.0, "image.photograph_profile_weight": 0.0, f"image.{weight}": 1.0}
            stage = stage_of(TINY.with_settings(alone), some_photographs())
            stage.losses(batch)["photographs"].backward()
            assert {name for name in parts_with_gradient(stage) if name.startswith("to_")} == {head}

    def test_losses_fall_on_a_repeated_batch(self, batch: dict[str, torch.Tensor]) -> None:
        stage = stage_of(TINY.with_settings({"image.optics": 0.0}))
        optimiser = build_optimiser(stage.modules, OptimiserConfig(learning_rate=1e-2))
        history = []
        for _ in range(25):
            terms = stage.losses(batch)
            optimiser.zero_grad()
            torch.stack(list(terms.values())).sum().backward()
            optimiser.step()
            history.append({name: term.item() for name, term in terms.items()})
        for name in ("profile", "opening", "ceiling", "room_type", "ring"):
            assert history[-1][name] < history[0][name], name

    def test_trunk_has_its_own_learning_rate(self) -> None:
        stage = stage_of()
        optimiser = build_optimiser(stage.modules, OptimiserConfig(learning_rate=1e-3, trunk_factor=0.1))
        assert isinstance(stage.encoder, TrunkImageEncoder)
        trunk = {id(p) for p in stage.encoder.trunk.parameters() if p.requires_grad}
        factors = {id(p): group["factor"] for group in optimiser.param_groups for p in group["params"]}
        assert {factors[id(p)] for p in stage.encoder.parameters() if id(p) in factors and id(p) not in trunk} == {1.0}
        assert {factors[key] for key in trunk} == {0.1}
        frozen = [p for p in stage.encoder.trunk.parameters() if not p.requires_grad]
        assert frozen
        assert not {id(p) for p in frozen} & factors.keys()

    def test_a_part_can_be_trained_alone(self, batch: dict[str, torch.Tensor]) -> None:
        stage = stage_of()
        settings = OptimiserConfig(learning_rate=1e-2, only=("image_encoder.to_profile",))
        optimiser = build_optimiser(stage.modules, settings)
        before = {name: value.clone() for name, value in stage.encoder.named_parameters()}
        torch.stack(list(stage.losses(batch).values())).sum().backward()
        optimiser.step()
        changed = {name for name, value in stage.encoder.named_parameters() if not torch.equal(value, before[name])}
        assert changed == {"to_profile.weight", "to_profile.bias"}
        with pytest.raises(ConfigError, match="has 'to_profile', but no parameter begins with it"):
            build_optimiser(stage.modules, OptimiserConfig(only=("to_profile",)))


@pytest.fixture(scope="module")
def folder(tiny_bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train against the layout encoder of a ring, resume once, and export a bundle."""
    folder = tmp_path_factory.mktemp("run")
    run.train_stage("image", SHORT, folder, device=CPU, data=FEW, workers=0, layout_from=tiny_bundle)
    longer = SHORT.with_settings({"image.steps": 3})
    run.train_stage("image", longer, folder, device=CPU, data=FEW, workers=0, resume=True)
    export_run(folder, folder / "bundle", name="tiny-trunk", version="1", last=True)
    return folder


@pytest.mark.slow
class TestRuns:
    def test_run_is_validated_resumed_and_served(self, folder: Path) -> None:
        checkpoint = Checkpoint.load(folder / "image.pt", stage="image")
        assert checkpoint.step == 3
        assert 0.0 <= checkpoint.metrics["val_opening_accuracy"] <= 1.0
        assert checkpoint.metrics["val_log_error"] > 0.0
        counted = checkpoint.weights["image_encoder"]
        assert int(counted["counted"]) == 3
        assert counted["opening_share"].sum().item() == pytest.approx(1.0, abs=1e-4)
        assert Checkpoint.load(folder / "layout.pt").config.architecture == "ring"
        bundle = Bundle.open(folder / "bundle")
        assert bundle.manifest.architecture == "trunk"
        black = np.zeros((*TINY.image_size, 3), np.uint8)
        query = PhotographEncoder(bundle, threads=1).spheres.query(black, None, CameraHeight(1.5))
        expected = losses.opening_prior(checkpoint.averaged["image_encoder"]["opening_share"], 0.5)
        np.testing.assert_allclose(present(query.openings).prior, expected, rtol=1e-5)

    def test_trunk_statistics_stay_frozen(self, folder: Path) -> None:
        torch.manual_seed(SHORT.seed + 1)
        begun = stage_of(SHORT)  # Another seed: only constants are alike.
        trained = Checkpoint.load(folder / "image.pt").weights["image_encoder"]
        for name, value in begun.encoder.state_dict().items():
            if "_bn" in name:
                assert torch.equal(trained[name], value), name

    def test_run_starts_from_a_trunk_bundle(self, folder: Path) -> None:
        start = load_warm_start(folder / "bundle", "image", TINY)
        start.load_into({"image_encoder": build_image_encoder(TINY)})
        assert start.origin["name"] == "tiny-trunk"
        with pytest.raises(CheckpointError, match="was trained with trunk TrunkEncoderConfig"):
            load_warm_start(folder / "bundle", "image", TINY.with_settings({"trunk.mixer_blocks": 2}))

    def test_an_encoder_takes_the_place_of_a_bundles_own(self, folder: Path, tiny_bundle: Path, tmp_path: Path) -> None:
        origin = Bundle.open(tiny_bundle)
        notes = {"hardware": "a laptop"}
        bundle = export_into(tiny_bundle, folder, tmp_path / "out", version="2", notes=notes, last=True)
        bundle.check()
        manifest = Bundle.open(bundle.folder).manifest
        assert (manifest.name, manifest.version, manifest.architecture) == (origin.manifest.name, "2", "trunk")
        assert manifest.training["hardware"] == "a laptop"
        assert manifest.training["image"]["steps"] == 3
        assert manifest.training["layout"] == origin.manifest.training["layout"]
        assert manifest.confidence == origin.manifest.confidence
        for name in ("layout_encoder.onnx", "head.onnx", "layout_encoder.safetensors"):
            assert bundle.read(name) == origin.read(name)
        # It is the encoder that was trained, with its own classes and modes.
        assert bundle.read("image_encoder.onnx") == Bundle.open(folder / "bundle").read("image_encoder.onnx")
        assert PhotographEncoder(bundle, threads=1).spheres.predicts_structure
        with pytest.raises(CheckpointError, match="no checkpoint of stage 'image' or 'view'"):
            export_into(tiny_bundle, tmp_path, tmp_path / "other", version="2")

    def test_pretrained_weights_are_loaded_once(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        loaded: list[Trunk] = []
        monkeypatch.setattr(run, "load_pretrained", loaded.append)
        config = SHORT.with_settings({"image.pretrained": True})
        nothing = Checkpoint(stage="image", config=config, weights={})
        monkeypatch.setattr(run, "run_stage", lambda *_, **__: nothing)
        for resume, expected in ((False, 1), (True, 1)):
            data = dataclasses.replace(FEW, validation_scenes=0)
            run.train_stage("image", config, folder, device=CPU, data=data, workers=0, resume=resume)
            assert len(loaded) == expected

    @pytest.mark.slow
    def test_old_checkpoint_without_rate_factors_resumes(self, tmp_path: Path) -> None:
        """Parameter groups of older checkpoints have no factor."""
        checkpoint = run_stage(stage_of(SHORT), tmp_path, device=CPU, workers=0)
        for group in checkpoint.optimiser["param_groups"]:
            del group["factor"]
        checkpoint.save(tmp_path / "image.pt")
        longer = SHORT.with_settings({"image.steps": 3})
        assert run_stage(stage_of(longer), tmp_path, device=CPU, workers=0, resume=True).step == 3


class TestRefusals:
    @pytest.mark.parametrize("name", ["opening_weight", "ceiling_weight", "room_type_weight", "photograph_weight"])
    def test_losses_without_output_are_refused(self, name: str) -> None:
        with pytest.raises(ConfigError, match=rf"{name} is 0\.5; .* not 'ring'"):
            PRESETS["ring"].with_settings({f"image.{name}": 0.5})

    def test_end_to_end_refuses_photometric_changes(self) -> None:
        config = PRESETS["paper"].with_settings({"image.optics": 0.5})
        with pytest.raises(ConfigError, match="optics"):
            EndToEndStage(config, GeneratedSource(config))


def trained(folder: Path, init_from: Path, config: TrainConfig = SHORT_RING) -> Checkpoint:
    return train_stage("image", config, folder, device=CPU, data=FEW, workers=0, init_from=init_from)


class TestWarmStart:
    @pytest.mark.slow
    def test_manifest_records_the_ancestry(self, tiny_bundle: Path, tmp_path: Path) -> None:
        parent = Bundle.open(tiny_bundle)
        run = tmp_path / "run"
        trained(run, tiny_bundle)
        child = export_run(run, tmp_path / "child", name="child", version="2")
        entry, before = child.manifest.training["image"], parent.manifest.training["image"]
        ancestor = {"name": "tiny", "version": "test", "sha256": parent.sha256}
        totals = {"minutes_in_all": before["minutes"], "spheres_in_all": before["spheres"]}
        assert entry["begun_from"] == ancestor | totals
        batch = SHORT_RING.image.batch
        assert entry["spheres_in_all"] == before["spheres"] + entry["spheres"]
        assert entry["spheres"] == entry["steps"] * batch
        assert entry["minutes_in_all"] >= before["minutes"]
        # The layout encoder and the decoder are bit-identical to the parent's.
        for name in ("layout_encoder.safetensors", "decoder.safetensors"):
            assert child.read(name) == parent.read(name)
        assert child.manifest.training["layout"]["steps"] == 0
        # Totals of a grandchild include all ancestors.
        trained(tmp_path / "next", tmp_path / "child")
        grandchild = export_run(tmp_path / "next", tmp_path / "grandchild", name="grandchild", version="3")
        in_all = grandchild.manifest.training["image"]["spheres_in_all"]
        assert in_all == before["spheres"] + entry["spheres"] + 2 * batch

    def test_stage_starts_from_bundle_weights(self, tiny_bundle: Path) -> None:
        stage = ImageStage(RING, GeneratedSource(RING), build_layout_encoder(RING))
        start = load_warm_start(tiny_bundle, "image", RING)
        start.load_into(stage.modules)
        assert same_weights({"image_encoder": stage.encoder.state_dict()}, start.checkpoint.weights)
        assert all(value.dtype != torch.float16 for value in stage.encoder.state_dict().values())

    def test_stage_starts_from_the_shipped_bundle(self) -> None:
        trunk = PRESETS["trunk"]
        encoder = build_image_encoder(trunk)
        start = load_warm_start(default_bundle(), "image", trunk)
        start.load_into({"image_encoder": encoder})
        trained = start.checkpoint.weights["image_encoder"]
        untrained = ("to_profile.", "to_edges.")
        loaded = {key: value for key, value in encoder.state_dict().items() if not key.startswith(untrained)}
        assert all(torch.equal(value, trained[key]) for key, value in loaded.items())

    @pytest.mark.slow
    def test_run_starts_from_the_best_checkpoint_of_another(self, tiny_bundle: Path, tmp_path: Path) -> None:
        trained(tmp_path / "first", tiny_bundle)
        best = Checkpoint.load(tmp_path / "first" / "image.best.pt")
        start = load_warm_start(tmp_path / "first", "image", RING)
        assert same_weights(start.checkpoint.inference_weights, best.averaged)
        second = trained(tmp_path / "second", tmp_path / "first")
        assert second.begun_from["run"] == "first"
        assert second.begun_from["begun_from"]["name"] == "tiny"
        layouts = [Checkpoint.load(tmp_path / name / "layout.pt") for name in ("first", "second")]
        assert same_weights(layouts[0].weights, layouts[1].weights)
        again = train_stage("image", SHORT_RING, tmp_path / "second", device=CPU, data=FEW, workers=0, resume=True)
        assert again.begun_from == second.begun_from

    def test_mean_lies_between_a_run_and_its_start(self) -> None:
        start = {"bias": torch.tensor([3.0, 3.0], dtype=torch.float16), "steps": torch.tensor(2)}
        later = {"bias": torch.tensor([1.0, 3.0]), "steps": torch.tensor(4), "new": torch.tensor([5.0])}
        run = Checkpoint(stage="image", config=RING, weights={}, averaged={"image_encoder": later}, step=7)
        earlier = Checkpoint(stage="image", config=RING, weights={"image_encoder": start})
        mean = mean_with(run, earlier, 0.25)
        expected = {"bias": torch.tensor([2.5, 3.0]), "steps": torch.tensor(4), "new": torch.tensor([5.0])}
        assert same_weights(mean.inference_weights, {"image_encoder": expected})
        assert mean.step == 7
        assert same_weights(run.averaged, {"image_encoder": later})

    def test_layout_stage_starts_from_a_bundle(self, tiny_bundle: Path, tmp_path: Path) -> None:
        layout = train_stage("layout", SHORT_RING, tmp_path, device=CPU, data=FEW, workers=0, init_from=tiny_bundle)
        assert layout.begun_from["name"] == "tiny"
        assert set(layout.begun_from) == {"name", "version", "sha256", "minutes_in_all"}
        trained(tmp_path, tiny_bundle)
        assert Checkpoint.load(tmp_path / "layout.pt").step == layout.step == 2

    def test_other_networks_are_refused(self, tiny_bundle: Path, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match="was trained with ring RingConfig"):
            trained(tmp_path, tiny_bundle, SHORT_RING.with_settings({"ring.image_stem": 12}))
        with pytest.raises(CheckpointError, match="was trained with architecture ring"):
            trained(tmp_path, tiny_bundle, PRESETS["paper"])
        with pytest.raises(CheckpointError, match="no checkpoint"):
            trained(tmp_path / "run", tmp_path)
        assert not (tmp_path / "layout.pt").exists()

    @pytest.mark.slow
    def test_command_starts_from_a_bundle(self, tiny_bundle: Path, tmp_path: Path) -> None:
        words = f"lab train image --preset tiny --workers 0 --device cpu --out {tmp_path}".split()
        words += ["--from", str(tiny_bundle), "--set", "image.uses_per_sphere=2", "--set", "image.batch=4"]
        words += ["--validation-homes", "1"]
        assert main([*words, "--steps", "1"]) == 0
        config = Checkpoint.load(tmp_path / "image.pt").config
        assert (config.image.uses_per_sphere, config.image.batch) == (2, 4)
        assert main([*words, "--resume"]) == 2
        mean = ["lab", "mean", str(tmp_path), "--from", str(tiny_bundle), "--out", str(tmp_path / "mean")]
        assert main(mean) == 0
        assert Checkpoint.load(tmp_path / "mean" / "image.pt").step == 1
        assert main([*mean, "--share", "2"]) == 2
        assert main(["lab", "train", "layout", "--out", str(tmp_path), "--set", "image.batch"]) == 2
        export = ["lab", "export", "--run", str(tmp_path), "--out", str(tmp_path / "b"), "--version", "1", "--last"]
        assert main(export) == 0
        assert Bundle.open(tmp_path / "b").manifest.training["image"]["checkpoint"] == "last"


class Scores:
    """Validation with given accuracies, one per call."""

    def __init__(self, *within_1m: float, median_cm: float = 10.0) -> None:
        self.left = list(within_1m)
        self.median_cm = median_cm
        self.seen: list[dict[str, Tensor]] = []

    def __call__(self, modules: dict[str, nn.Module]) -> dict[str, float]:
        self.seen.append({key: value.clone() for key, value in modules["line"].state_dict().items()})
        self.median_cm -= 1.0
        return {"val_within_1m": self.left.pop(0), "val_median_cm": self.median_cm}


class TestBest:
    def best_of(self, folder: Path, *scores: float, **more: Any) -> Checkpoint:
        run_stage(LineStage(len(scores)), folder, device=CPU, checkpoint_minutes=0.0, validate=Scores(*scores), **more)
        return Checkpoint.load(folder / "line.best.pt", stage="line")

    def test_best_checkpoint_is_kept_beside_the_last(self, tmp_path: Path) -> None:
        assert self.best_of(tmp_path / "a", 0.5, 0.7, 0.6).step == 2
        assert Checkpoint.load(tmp_path / "a" / "line.pt").step == 3
        assert self.best_of(tmp_path / "b", 0.5, 0.7, 0.7).step == 3
        assert not list(tmp_path.rglob("*.part"))
        # A new run deletes the previous best.
        self.best_of(tmp_path / "c", 0.9)
        assert self.best_of(tmp_path / "c", 0.1, 0.2).step == 2

    def test_likelihood_ranks_checkpoints(self, tmp_path: Path) -> None:
        scores = Scores(0.5, 0.7, 0.6)
        likelihoods = iter((-1.0, -1.1, -1.2))
        run_stage(
            LineStage(3),
            tmp_path,
            device=CPU,
            checkpoint_minutes=0.0,
            validate=lambda modules: scores(modules) | {"val_nll": next(likelihoods)},
        )
        assert Checkpoint.load(tmp_path / "line.best.pt").step == 3

    def test_resumed_run_scores_the_best_checkpoint_again(self, tmp_path: Path) -> None:
        first = self.best_of(tmp_path, 0.5, 0.7, 0.6)
        # On the present scenes the kept weights score 0.3.
        again = Scores(0.3, 0.4, 0.35)
        run_stage(LineStage(5), tmp_path, device=CPU, checkpoint_minutes=0.0, validate=again, resume=True)
        assert same_weights({"line": again.seen[0]}, first.weights)
        assert Checkpoint.load(tmp_path / "line.best.pt").step == 4

    @pytest.mark.slow
    def test_export_uses_the_best_or_the_last(self, tiny_run: Path, tmp_path: Path) -> None:
        run = tmp_path / "run"
        shutil.copytree(tiny_run, run, ignore=shutil.ignore_patterns("bundle"))
        last = Checkpoint.load(run / "image.pt")
        last.step -= 3
        last.save(run / "image.best.pt")
        steps = {}
        for chosen in (False, True):
            bundle = export_run(run, tmp_path / str(chosen), name="x", version="1", last=chosen)
            entry = bundle.manifest.training["image"]
            steps[entry["checkpoint"]] = entry["steps"]
            assert entry["minutes_of_run"] == round(last.seconds / 60.0, 1)
        assert steps == {"best by validation": RING.image.steps - 3, "last": RING.image.steps}


class TestValidation:
    def test_image_validation_reports_levels(self, tmp_path: Path) -> None:
        data = TrainingData(validation_scenes=3)
        teacher = build_layout_encoder(RING)
        stage = ImageStage(RING, GeneratedSource(RING), teacher)

        def scores() -> dict[str, float]:
            validate = data.image_validation(RING, data.validation(RING), teacher, CPU, tmp_path)
            return validate(stage.modules)

        found = scores()
        names = {f"{by}{measure}" for by in ("", "profile_") for measure in ("within_1m", "median_cm")} | {"nll"}
        assert {f"val_{name}" for name in names} <= set(found)
        assert {"val_profile_within_1m_full", "val_median_cm_full"} <= set(found)
        assert all(np.isfinite(value) for value in found.values())
        assert {path.name for path in tmp_path.iterdir()} == {"validation.npz"}
        # The second validation reads the pictures from the files.
        before = [path.stat().st_mtime_ns for path in sorted(tmp_path.iterdir())]
        assert scores() == found
        assert [path.stat().st_mtime_ns for path in sorted(tmp_path.iterdir())] == before

    def test_stale_or_damaged_picture_cache_is_rebuilt(self, tmp_path: Path) -> None:
        path, numbers = tmp_path / "kept.npz", itertools.count()

        def kept(*about: bytes) -> int:
            make = lambda: np.full((1, 2, 2, 3), next(numbers), dtype=np.uint8)  # noqa: E731
            return int(cached_pictures(path, list(about), make)[0, 0, 0, 0])

        assert [kept(b"a"), kept(b"a"), kept(b"b"), kept(b"b"), kept(b"a")] == [0, 0, 1, 1, 2]
        path.write_bytes(path.read_bytes()[:100])
        assert [kept(b"a"), kept(b"a")] == [3, 3]
