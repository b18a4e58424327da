"""Runs that start from trained weights, the best checkpoint, image validation, and their manifest entries."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from lalaloc_core.cli import main
from lalaloc_core.errors import CheckpointError
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.learn.export.run import export_run
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.data import TrainingData
from lalaloc_core.learn.training.image_stage import ImageStage
from lalaloc_core.learn.training.loop import run_stage
from lalaloc_core.learn.training.presets import PRESETS
from lalaloc_core.learn.training.run import train_image, train_layout
from lalaloc_core.learn.training.sources import GeneratedSource
from lalaloc_core.learn.training.stages import build_layout_encoder
from lalaloc_core.learn.training.validate import cached_pictures
from lalaloc_core.learn.training.warm_start import load_warm_start
from lalaloc_core.localise.bundle import Bundle
from tests.core.test_training import LineStage, same_weights

CPU = torch.device("cpu")
TINY = PRESETS["tiny"]
FEW = TrainingData(validation_scenes=2)
SHORT = TINY.with_settings({"image.steps": 2, "layout.steps": 2})


def trained(folder: Path, init_from: Path, config: TrainConfig = SHORT) -> Checkpoint:
    return train_image(config, folder, device=CPU, data=FEW, workers=0, init_from=init_from)


class TestWarmStart:
    def test_manifest_records_the_ancestry(self, tiny_bundle: Path, tmp_path: Path) -> None:
        parent = Bundle.open(tiny_bundle)
        run = tmp_path / "run"
        trained(run, tiny_bundle)
        child = export_run(run, tmp_path / "child", name="child", version="2")
        entry, before = child.manifest.training["image"], parent.manifest.training["image"]
        assert entry["begun_from"] == {
            "name": "tiny",
            "version": "test",
            "sha256": parent.sha256,
            "minutes_in_all": before["minutes"],
            "panoramas_in_all": before["panoramas"],
        }
        batch = SHORT.image.batch
        assert entry["panoramas_in_all"] == before["panoramas"] + entry["panoramas"]
        assert entry["panoramas"] == entry["steps"] * batch
        assert entry["minutes_in_all"] >= before["minutes"]
        # The layout encoder and the decoder are bit-identical to the parent's.
        for name in ("layout_encoder.safetensors", "decoder.safetensors"):
            assert child.read(name) == parent.read(name)
        assert child.manifest.training["layout"]["steps"] == 0
        # Totals of a grandchild include all ancestors.
        trained(tmp_path / "next", tmp_path / "child")
        grandchild = export_run(tmp_path / "next", tmp_path / "grandchild", name="grandchild", version="3")
        in_all = grandchild.manifest.training["image"]["panoramas_in_all"]
        assert in_all == before["panoramas"] + entry["panoramas"] + 2 * batch

    def test_stage_starts_from_bundle_weights(self, tiny_bundle: Path) -> None:
        stage = ImageStage(TINY, GeneratedSource(TINY), build_layout_encoder(TINY))
        start = load_warm_start(tiny_bundle, "image", TINY)
        start.load_into(stage.modules)
        assert same_weights({"image_encoder": stage.encoder.state_dict()}, start.checkpoint.weights)
        assert all(value.dtype != torch.float16 for value in stage.encoder.state_dict().values())

    def test_run_starts_from_the_best_checkpoint_of_another(self, tiny_bundle: Path, tmp_path: Path) -> None:
        trained(tmp_path / "first", tiny_bundle)
        best = Checkpoint.load(tmp_path / "first" / "image.best.pt")
        start = load_warm_start(tmp_path / "first", "image", TINY)
        assert same_weights(start.checkpoint.inference_weights, best.averaged)
        second = trained(tmp_path / "second", tmp_path / "first")
        assert second.begun_from["run"] == "first"
        assert second.begun_from["begun_from"]["name"] == "tiny"
        layouts = [Checkpoint.load(tmp_path / name / "layout.pt") for name in ("first", "second")]
        assert same_weights(layouts[0].weights, layouts[1].weights)
        again = train_image(SHORT, tmp_path / "second", device=CPU, data=FEW, workers=0, resume=True)
        assert again.begun_from == second.begun_from

    def test_layout_stage_starts_from_a_bundle(self, tiny_bundle: Path, tmp_path: Path) -> None:
        layout = train_layout(SHORT, tmp_path, device=CPU, data=FEW, workers=0, init_from=tiny_bundle)
        assert layout.begun_from["name"] == "tiny"
        assert set(layout.begun_from) == {"name", "version", "sha256", "minutes_in_all"}
        trained(tmp_path, tiny_bundle)
        assert Checkpoint.load(tmp_path / "layout.pt").step == layout.step == 2

    def test_other_networks_are_refused(self, tiny_bundle: Path, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match="was trained with ring RingConfig"):
            trained(tmp_path, tiny_bundle, SHORT.with_settings({"ring.image_stem": 12}))
        with pytest.raises(CheckpointError, match="was trained with architecture ring"):
            trained(tmp_path, tiny_bundle, PRESETS["paper"])
        assert not (tmp_path / "layout.pt").exists()

    def test_missing_initial_weights_are_refused(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match="no checkpoint"):
            trained(tmp_path / "run", tmp_path)

    def test_command_starts_from_a_bundle(self, tiny_bundle: Path, tmp_path: Path) -> None:
        words = ["train", "image", "--preset", "tiny", "--workers", "0", "--device", "cpu", "--out", str(tmp_path)]
        words += ["--from", str(tiny_bundle), "--set", "image.uses_per_panorama=2", "--set", "image.batch=4"]
        words += ["--validation-homes", "1"]
        assert main([*words, "--steps", "1"]) == 0
        config = Checkpoint.load(tmp_path / "image.pt").config
        assert (config.image.uses_per_panorama, config.image.batch) == (2, 4)
        assert main([*words, "--resume"]) == 2
        assert main(["train", "layout", "--out", str(tmp_path), "--set", "image.batch"]) == 2
        assert main(["export", "--run", str(tmp_path), "--out", str(tmp_path / "b"), "--version", "1", "--last"]) == 0
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

    def test_new_run_deletes_the_previous_best(self, tmp_path: Path) -> None:
        self.best_of(tmp_path, 0.9)
        assert self.best_of(tmp_path, 0.1, 0.2).step == 2

    def test_export_uses_the_best_or_the_last(self, tiny_bundle: Path, tmp_path: Path) -> None:
        run = tmp_path / "run"
        shutil.copytree(tiny_bundle.parent, run, ignore=shutil.ignore_patterns("bundle"))
        last = Checkpoint.load(run / "image.pt")
        last.step -= 3
        last.save(run / "image.best.pt")
        steps = {}
        for chosen in (False, True):
            bundle = export_run(run, tmp_path / str(chosen), name="x", version="1", last=chosen)
            entry = bundle.manifest.training["image"]
            steps[entry["checkpoint"]] = entry["steps"]
            assert entry["minutes_of_run"] == round(last.seconds / 60.0, 1)
        assert steps == {"best by validation": TINY.image.steps - 3, "last": TINY.image.steps}


class TestValidation:
    def test_image_validation_reports_heldout_and_levels(self, tmp_path: Path) -> None:
        data = TrainingData(
            validation_scenes=3, heldout=GeneratedScenes(homes=2, shots_per_home=2, seed=5, furniture=None)
        )
        teacher = build_layout_encoder(TINY)
        stage = ImageStage(TINY, GeneratedSource(TINY), teacher)

        def scores() -> dict[str, float]:
            validate = data.image_validation(TINY, data.validation(TINY), teacher, CPU, tmp_path)
            return validate(stage.modules)

        found = scores()
        names = {f"{by}{measure}" for by in ("", "profile_") for measure in ("within_1m", "median_cm")} | {"nll"}
        assert {f"{prefix}_{name}" for prefix in ("val", "heldout") for name in names} <= set(found)
        assert {"val_profile_within_1m_full", "val_median_cm_full"} <= set(found)
        assert all(np.isfinite(value) for value in found.values())
        assert {path.name for path in tmp_path.iterdir()} == {"validation.npz", "heldout.npz"}
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
