"""Trained variants: each differs from the paper's model in the named setting, and training is idempotent."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

from lalaloc_core.errors import BundleError, CheckpointError, ConfigError
from lalaloc_core.evaluate.reproduce import ablations
from lalaloc_core.evaluate.reproduce.ablations import ABLATIONS, BASE, BUDGETS, Budget, train_ablation
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.data import TrainingData
from lalaloc_core.learn.training.run import train_layout
from lalaloc_core.localise.bundle import DECODER_WEIGHTS, IMAGE_ONNX, MANIFEST_NAME, Bundle
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.render.sampling import TripletSampling

CPU = torch.device("cpu")
HOMES = GeneratedScenes(homes=3, shots_per_home=2)


def differences(first: dict[str, object], second: dict[str, object], path: str = "") -> set[str]:
    """Return the paths of the settings in which two configurations differ."""
    found: set[str] = set()
    for key, value in first.items():
        other = second[key]
        if isinstance(value, dict) and isinstance(other, dict):
            found |= differences(value, other, f"{path}{key}.")
        elif value != other:
            found.add(path + key)
    return found


class TestTable:
    @pytest.mark.parametrize(
        ("name", "changed"),
        [
            ("layout-log-ratio", {"layout.decode_weight"}),
            ("layout-decode", {"layout.log_ratio_weight"}),
            ("layout-resnet50", {"paper.layout_depth"}),
            ("layout-mlp", {"paper.layout_predictor"}),
            ("image-log-ratio", {"image.l2_weight", "image.log_ratio_weight"}),
            ("image-l2-log-ratio", {"image.log_ratio_weight"}),
            ("image-l2-kd", {"image.kd_weight"}),
            ("end-to-end", set()),
        ],
    )
    def test_small_variant_differs_only_in_its_setting(self, name: str, changed: set[str]) -> None:
        base, config = ABLATIONS[BASE].config["small"], ABLATIONS[name].config["small"]
        assert differences(base.to_dict(), config.to_dict()) == changed | {"name"}

    def test_full_variants_follow_the_paper(self) -> None:
        base = ABLATIONS[BASE].config["full"]
        assert (base.paper.width, base.paper.layout_depth, base.paper.image_depth) == (64, 18, 50)
        assert (base.image.batch, base.image.optimiser.learning_rate) == (64, 0.1)
        # "When trained with a variant of the log-ratio, the training routine follows that of the layout branch."
        for name in ("image-log-ratio", "image-l2-log-ratio", "image-l2-kd", "end-to-end"):
            image, layout = ABLATIONS[name].config["full"].image, ABLATIONS[name].config["full"].layout
            assert (image.batch, image.steps, image.optimiser) == (4, layout.steps, layout.optimiser)

    @pytest.mark.parametrize("budget", BUDGETS)
    def test_variants_share_networks_of_the_base(self, budget: Budget) -> None:
        for ablation in ABLATIONS.values():
            if ablation.layout_from is not None:
                teacher = ABLATIONS[ablation.layout_from].config[budget]
                assert (teacher.paper, teacher.turns) == (ablation.config[budget].paper, ablation.config[budget].turns)


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shrink every small variant so that it trains in a second."""

    def shrunk(config: TrainConfig) -> TrainConfig:
        paper = dataclasses.replace(config.paper, width=8, image_depth=18, image_height=64, image_width=128)
        triplets = TripletSampling(positives=1, negatives=3)
        return dataclasses.replace(
            config,
            paper=paper,
            layout=dataclasses.replace(config.layout, steps=3, homes_per_step=2, triplets=triplets),
            image=dataclasses.replace(config.image, steps=3, batch=2),
        )

    small = {
        name: dataclasses.replace(ablation, config={"small": shrunk(ablation.config["small"])})
        for name, ablation in ABLATIONS.items()
    }
    monkeypatch.setattr(ablations, "ABLATIONS", small)
    monkeypatch.setattr(ablations, "_VALIDATION_SCENES", 1)


def train(name: str, out: Path, *, homes: GeneratedScenes = HOMES) -> Bundle:
    return train_ablation(name, "small", homes, out, device=CPU, workers=0)


def written(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


@pytest.mark.usefixtures("brief")
class TestTraining:
    def test_image_variants_share_stage_one(self, tmp_path: Path) -> None:
        first = train("image-l2-kd", tmp_path)
        assert first.folder == tmp_path / "image-l2-kd" / "bundle"
        assert first.manifest.training["budget"] == "small"
        assert first.manifest.training["image"]["data"]["description"] == HOMES.description
        assert not (tmp_path / "image-l2-kd" / "layout.pt").exists()
        teacher = Checkpoint.load(tmp_path / BASE / "layout.pt", stage="layout")
        decoder = safetensors.torch.load(first.read(DECODER_WEIGHTS))
        bias = decoder["to_depth.bias"]
        torch.testing.assert_close(bias, teacher.inference_weights["decoder"]["to_depth.bias"])
        before = written(tmp_path)
        assert train("image-l2-kd", tmp_path).sha256 == first.sha256
        assert written(tmp_path) == before

    def test_layout_variants_answer_layouts_only(self, tmp_path: Path) -> None:
        bundle = train("layout-log-ratio", tmp_path)
        assert not {IMAGE_ONNX, DECODER_WEIGHTS} & set(bundle.manifest.files)
        encoders = Encoders(bundle, threads=1)
        columns = bundle.manifest.profile_columns
        assert encoders.layouts(np.full((2, columns), 2.0), np.full(2, 1.5), np.full(2, 2.5)).shape == (2, 128)
        with pytest.raises(BundleError, match="layout queries only"):
            encoders.query(np.zeros((64, 128, 3), dtype=np.uint8), 0.0, CameraHeight(1.5))
        # An interrupted export is repeated without training.
        before = written(tmp_path)["layout-log-ratio/layout.pt"]
        (bundle.folder / MANIFEST_NAME).unlink()
        assert train("layout-log-ratio", tmp_path).sha256 == bundle.sha256
        assert written(tmp_path)["layout-log-ratio/layout.pt"] == before

    def test_variant_resumes_on_its_own_data_set_only(self, tmp_path: Path) -> None:
        config = ablations.ABLATIONS["layout-mlp"].config["small"]
        shorter = dataclasses.replace(config, layout=dataclasses.replace(config.layout, steps=2))
        train_layout(shorter, tmp_path / "layout-mlp", device=CPU, data=TrainingData(dataset=HOMES), workers=0)
        with pytest.raises(CheckpointError, match="not on"):
            train("layout-mlp", tmp_path, homes=dataclasses.replace(HOMES, seed=1))
        resumed = train("layout-mlp", tmp_path)
        assert Checkpoint.load(tmp_path / "layout-mlp" / "layout.pt").step == 3
        assert resumed.manifest.training["layout"]["steps"] == 3
        assert resumed.manifest.layout_config["layout_predictor"] == "mlp"

    def test_unknown_variant_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="unknown variant 'layout-resnet34'"):
            train("layout-resnet34", tmp_path)
