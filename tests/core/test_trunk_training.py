"""Training of the trunk image encoder: batches, losses, learning rates, and a run from start to bundle."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lalaloc_core.cli import main
from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES
from lalaloc_core.errors import CheckpointError, ConfigError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.export.run import export_run
from lalaloc_core.learn.training import losses, run
from lalaloc_core.learn.training.batch_streams import UNKNOWN, PanoramaBatches, opening_kinds
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import OptimiserConfig, TrainConfig
from lalaloc_core.learn.training.data import TrainingData
from lalaloc_core.learn.training.end_to_end import EndToEndStage
from lalaloc_core.learn.training.image_stage import ImageStage
from lalaloc_core.learn.training.loop import run_stage
from lalaloc_core.learn.training.photographs import Photographs
from lalaloc_core.learn.training.presets import PRESETS
from lalaloc_core.learn.training.rotation import Rotation
from lalaloc_core.learn.training.sources import GeneratedSource
from lalaloc_core.learn.training.stages import build_image_encoder, build_layout_encoder, build_optimiser
from lalaloc_core.learn.training.warm_start import load_warm_start
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.nets.image_encoder import TrunkImageEncoder
from lalaloc_core.nets.trunk import Trunk

TINY = PRESETS["tiny-trunk"]
SHORT = dataclasses.replace(TINY, image=dataclasses.replace(TINY.image, steps=2))
FEW = TrainingData(validation_scenes=1)
CPU = torch.device("cpu")
WALL, DOOR, WINDOW, PASSAGE = range(len(OPENING_CLASSES))


def some_photographs() -> Photographs:
    generator = torch.Generator().manual_seed(5)
    images = torch.randint(0, 256, (3, *TINY.image_size, 3), dtype=torch.uint8, generator=generator)
    width = TINY.image_size[1]
    log_distance = torch.rand(3, width, generator=generator)
    log_distance[:, : width // 2] = torch.nan
    return Photographs(images, 0.5 * torch.rand(3, width, 2, generator=generator), log_distance)


def stage_of(config: TrainConfig = TINY, photographs: Photographs | None = None) -> ImageStage:
    torch.manual_seed(0)
    return ImageStage(config, GeneratedSource(config), build_layout_encoder(config), photographs)


@pytest.fixture(scope="module")
def batch() -> dict[str, torch.Tensor]:
    found: Any = next(iter(PanoramaBatches(TINY, GeneratedSource(TINY))))
    return found


def plan(**changes: Any) -> FloorPlan:
    """Return a square room of 4 m with a window in its northern wall."""
    document: dict[str, Any] = {
        "rooms": [{"polygon": [[0, 0], [4, 0], [4, 4], [0, 4]], "ceiling_height_m": 2.5, "type": "bedroom"}],
        "openings": [{"kind": "window", "line": [[1, 4], [3, 4]], "sill_m": 0.9, "head_m": 2.0}],
        "opening_kinds": ["door", "window", "passage"],
    }
    return FloorPlan.from_dict(document | changes)


class TestLabels:
    def test_opening_kinds_match_the_plan(self) -> None:
        kind = opening_kinds(plan(), np.array([2.0, 2.0]), 0, 0.0, 1.5, 64)
        azimuth_deg = ((np.arange(64) + 0.5) / 64 - 0.5) * 360.0
        # The window reaches one metre to either side, two metres ahead.
        expected = np.where(np.abs(azimuth_deg) < np.degrees(np.arctan(0.5)), WINDOW, WALL)
        np.testing.assert_array_equal(kind, expected)
        np.testing.assert_array_equal(opening_kinds(plan(), np.array([2.0, 2.0]), 0, 0.0, 0.8, 64), WALL)

    def test_walls_are_unknown_in_plans_without_all_openings(self) -> None:
        kind = opening_kinds(plan(opening_kinds=["window"]), np.array([2.0, 2.0]), 0, 0.0, 1.5, 64)
        assert set(kind) == {UNKNOWN, WINDOW}

    def test_batches_hold_openings_and_room_types(self, batch: dict[str, torch.Tensor]) -> None:
        kind = batch["opening_kind"]
        assert kind.shape == batch["profile_m"].shape
        assert set(kind.unique().tolist()) <= set(range(len(OPENING_CLASSES)))
        assert 0.3 < float((kind == WALL).float().mean()) < 0.95
        # All generated rooms have a type; code 0 means no type.
        assert bool(((batch["room_type"] >= 1) & (batch["room_type"] < len(ROOM_TYPES))).all())

    def test_other_architectures_have_no_class_labels(self) -> None:
        found: Any = next(iter(PanoramaBatches(PRESETS["tiny"], GeneratedSource(PRESETS["tiny"]))))
        assert not {"opening_kind", "room_type"} & set(found)

    def test_mirrored_panorama_has_mirrored_openings(self) -> None:
        kind = np.arange(8)
        assert Rotation(shift=0, heading=0.0, mirrored=True).profile(kind).tolist() == list(range(8))[::-1]


class TestLosses:
    def test_every_head_gets_a_gradient(self, batch: dict[str, torch.Tensor]) -> None:
        stage = stage_of(photographs=some_photographs())
        terms = stage.losses(batch)
        assert set(terms) == {"ring", "profile", "l2", "opening", "ceiling", "room_type", "photographs"}
        torch.stack(list(terms.values())).sum().backward()
        grown = {
            name.split(".")[0] for name, p in stage.encoder.named_parameters() if p.grad is not None and p.grad.any()
        }
        heads = {"to_ring", "to_profile", "to_openings", "to_ceiling", "to_room_type"}
        assert heads | {"trunk", "squeezes", "join", "mixer", "norm"} == grown
        assert all(p.grad is None for p in stage.teacher.parameters())

    def test_photographs_add_one_loss(self, batch: dict[str, torch.Tensor]) -> None:
        plain = dataclasses.replace(TINY, image=dataclasses.replace(TINY.image, optics=0.0, style_mixing=0.0))
        with_them = stage_of(plain, some_photographs()).losses(batch)
        without = stage_of(plain).losses(batch)
        assert with_them.keys() - without.keys() == {"photographs"}
        for name, term in without.items():
            torch.testing.assert_close(with_them[name], term, rtol=1e-4, atol=1e-5)

    def test_photograph_weights_train_their_heads(self, batch: dict[str, torch.Tensor]) -> None:
        for weight, head in (("photograph_weight", "to_openings"), ("photograph_profile_weight", "to_profile")):
            alone = {"photograph_weight": 0.0, "photograph_profile_weight": 0.0} | {weight: 1.0}
            stage = stage_of(
                dataclasses.replace(TINY, image=dataclasses.replace(TINY.image, **alone)), some_photographs()
            )
            stage.losses(batch)["photographs"].backward()
            grown = {
                n.split(".")[0] for n, p in stage.encoder.named_parameters() if p.grad is not None and p.grad.any()
            }
            assert {name for name in grown if name.startswith("to_")} == {head}

    def test_losses_fall_on_a_repeated_batch(self, batch: dict[str, torch.Tensor]) -> None:
        stage = stage_of(dataclasses.replace(TINY, image=dataclasses.replace(TINY.image, optics=0.0)))
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
        settings = OptimiserConfig(learning_rate=1e-3, trunk_factor=0.1)
        optimiser = build_optimiser(stage.modules, settings)
        assert isinstance(stage.encoder, TrunkImageEncoder)
        trunk = {id(p) for p in stage.encoder.trunk.parameters() if p.requires_grad}
        factors = {id(p): group["factor"] for group in optimiser.param_groups for p in group["params"]}
        assert {factors[id(p)] for p in stage.encoder.parameters() if id(p) in factors and id(p) not in trunk} == {1.0}
        assert {factors[key] for key in trunk} == {0.1}
        frozen = [p for p in stage.encoder.trunk.parameters() if not p.requires_grad]
        assert frozen
        assert not {id(p) for p in frozen} & factors.keys()


@pytest.fixture(scope="module")
def folder(tiny_bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train against the layout encoder of a ring, resume once, and export a bundle."""
    folder = tmp_path_factory.mktemp("run")
    run.train_image(SHORT, folder, device=CPU, data=FEW, workers=0, layout_from=tiny_bundle)
    longer = dataclasses.replace(SHORT, image=dataclasses.replace(SHORT.image, steps=3))
    run.train_image(longer, folder, device=CPU, data=FEW, workers=0, resume=True)
    export_run(folder, folder / "bundle", name="tiny-trunk", version="1", last=True)
    return folder


class TestRuns:
    def test_run_is_validated_resumed_and_served(self, folder: Path) -> None:
        checkpoint = Checkpoint.load(folder / "image.pt", stage="image")
        assert checkpoint.step == 3
        assert 0.0 <= checkpoint.metrics["val_opening_accuracy"] <= 1.0
        assert checkpoint.metrics["val_log_error"] > 0.0
        counted = checkpoint.weights["image_encoder"]
        assert int(counted["counted"]) == 3
        assert counted["opening_share"].sum().item() == pytest.approx(1.0, abs=1e-4)
        bundle = Bundle.open(folder / "bundle")
        query = Encoders(bundle, threads=1).query(np.zeros((*TINY.image_size, 3), np.uint8), None, CameraHeight(1.5))
        assert query.openings is not None
        expected = losses.opening_prior(checkpoint.averaged["image_encoder"]["opening_share"], 0.5)
        np.testing.assert_allclose(query.openings.prior, expected, rtol=1e-5)

    def test_trunk_uses_a_ring_layout_encoder(self, folder: Path) -> None:
        assert Checkpoint.load(folder / "layout.pt").config.architecture == "ring"
        assert Bundle.open(folder / "bundle").manifest.architecture == "trunk"

    def test_trunk_statistics_stay_frozen(self, folder: Path) -> None:
        torch.manual_seed(SHORT.seed + 1)
        begun = stage_of(SHORT)  # Another seed: only constants are alike.
        trained = Checkpoint.load(folder / "image.pt").weights["image_encoder"]
        for name, value in begun.encoder.state_dict().items():
            if "_bn" in name:
                assert torch.equal(trained[name], value), name

    def test_starting_from_a_ring_image_encoder_is_refused(self, tiny_bundle: Path, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match="was trained with architecture ring"):
            run.train_image(SHORT, tmp_path, device=CPU, data=FEW, workers=0, init_from=tiny_bundle)

    def test_run_starts_from_a_trunk_bundle(self, folder: Path) -> None:
        start = load_warm_start(folder / "bundle", "image", TINY)
        encoder = build_image_encoder(TINY)
        start.load_into({"image_encoder": encoder})
        assert start.origin["name"] == "tiny-trunk"
        with pytest.raises(CheckpointError, match="was trained with trunk TrunkEncoderConfig"):
            load_warm_start(folder / "bundle", "image", TINY.with_settings({"trunk.mixer_blocks": 2}))

    def test_pretrained_weights_are_loaded_once(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        loaded: list[Trunk] = []
        monkeypatch.setattr(run, "load_pretrained", loaded.append)
        config = SHORT.with_settings({"image.pretrained": True})
        nothing = Checkpoint(stage="image", config=config, weights={})
        monkeypatch.setattr(run, "run_stage", lambda *_, **__: nothing)
        for resume, expected in ((False, 1), (True, 1)):
            run.train_image(
                config, folder, device=CPU, data=dataclasses.replace(FEW, validation_scenes=0), workers=0, resume=resume
            )
            assert len(loaded) == expected

    def test_old_checkpoint_without_rate_factors_resumes(self, tmp_path: Path) -> None:
        """Parameter groups of older checkpoints have no factor."""
        stage = stage_of(SHORT)
        checkpoint = run_stage(stage, tmp_path, device=CPU, workers=0)
        for group in checkpoint.optimiser["param_groups"]:
            del group["factor"]
        checkpoint.save(tmp_path / "image.pt")
        longer = dataclasses.replace(SHORT, image=dataclasses.replace(SHORT.image, steps=3))
        assert run_stage(stage_of(longer), tmp_path, device=CPU, workers=0, resume=True).step == 3


class TestRefusals:
    @pytest.mark.parametrize("name", ["opening_weight", "ceiling_weight", "room_type_weight", "photograph_weight"])
    def test_losses_without_output_are_refused(self, name: str) -> None:
        with pytest.raises(ConfigError, match=rf"{name} is 0\.5; .* not 'ring'"):
            PRESETS["ring"].with_settings({f"image.{name}": 0.5})

    @pytest.mark.parametrize(
        ("key", "value"), [("optics", 1.5), ("opening_balance", -0.1), ("photographs_per_batch", 0)]
    )
    def test_values_out_of_range_are_refused(self, key: str, value: float) -> None:
        with pytest.raises(ConfigError, match=key):
            TINY.with_settings({f"image.{key}": value})

    def test_end_to_end_refuses_photometric_changes(self) -> None:
        config = PRESETS["paper"].with_settings({"image.optics": 0.5})
        with pytest.raises(ConfigError, match="optics"):
            EndToEndStage(config, GeneratedSource(config))

    @pytest.mark.parametrize("option", ["--photographs", "--teacher", "--layout-from"])
    def test_image_stage_options_are_refused_elsewhere(
        self, option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        words = ["train", "layout", "--preset", "tiny-trunk", "--out", str(tmp_path), option, str(tmp_path)]
        assert main(words) == 2
        assert option in capsys.readouterr().err
