"""Training loop, checkpoints, batch streams, and the losses of all stages."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from lalaloc_core.bundle import DECODER_WEIGHTS, IMAGE_ONNX
from lalaloc_core.conventions import TWO_PI
from lalaloc_core.errors import CheckpointError, ConfigError
from lalaloc_core.learn.export.run_export import export_run
from lalaloc_core.learn.metrics import chamfer_distance
from lalaloc_core.learn.synth.homes.plans import TEST, TRAIN, VALIDATION, home_of
from lalaloc_core.learn.training import batches, sources
from lalaloc_core.learn.training import layout_stage as layout_stage_module
from lalaloc_core.learn.training.batch_streams import LayoutBatches, SphereBatches
from lalaloc_core.learn.training.batches import Batch, load_batches, sample_rotation
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import PRESETS, ImageStageConfig, OptimiserConfig, TrainConfig, Turns
from lalaloc_core.learn.training.image_stage import ImageStage
from lalaloc_core.learn.training.layout_stage import EndToEndStage, LayoutStage
from lalaloc_core.learn.training.loop import run_stage
from lalaloc_core.learn.training.run import train_stage
from lalaloc_core.learn.training.sources import GeneratedSource
from lalaloc_core.learn.training.stages import TrainingStage, build_layout_encoder
from lalaloc_core.nets import LayoutNetwork
from lalaloc_core.nets.image_features import ImageFeatures, WallModes
from lalaloc_core.nets.layout_network import RingLayoutEncoder
from lalaloc_core.render.profile import back_project, layout_depth
from lalaloc_core.render.sampling import random_poses
from lalaloc_core.render.sweep import profiles_at
from tests.strategies import crooked_flat, seeds

CPU = torch.device("cpu")
TINY = PRESETS["tiny"]


def layout_batches(config: TrainConfig = TINY, first: int = 0) -> Iterator[Batch]:
    """Yield stage 1's batches of generated homes, made in this process."""
    return load_batches(LayoutBatches(config, GeneratedSource(config), first), 0)


def sphere_batches(config: TrainConfig = TINY, *, neighbours: bool = False) -> Iterator[Batch]:
    """Yield stage 2's batches of generated homes, made in this process."""
    return load_batches(SphereBatches(config, GeneratedSource(config), neighbours), 0)


def changed(part: str, config: TrainConfig, **settings: Any) -> TrainConfig:
    return config.with_settings({f"{part}.{name}": value for name, value in settings.items()})


def layout_stage(config: TrainConfig = TINY) -> LayoutStage:
    return LayoutStage(config, GeneratedSource(config))


def image_stage(config: TrainConfig, teacher: LayoutNetwork) -> ImageStage:
    return ImageStage(config, GeneratedSource(config), teacher)


class LineStage(TrainingStage):
    """Smallest possible stage: a line through points; batches are a function of the step."""

    name = "line"

    def __init__(self, steps: int = 12, **settings: Any) -> None:
        torch.manual_seed(3)
        self.config = dataclasses.replace(TINY, image=ImageStageConfig(steps=steps, **settings))
        self.line = nn.Sequential(nn.Linear(2, 3), nn.BatchNorm1d(3), nn.Linear(3, 1))
        self.modules: dict[str, nn.Module] = {"line": self.line}

    @property
    def settings(self) -> ImageStageConfig:
        return self.config.image

    @property
    def data(self) -> dict[str, Any]:
        return {"description": "points"}

    def batches(self, first_step: int, workers: int) -> Iterator[Batch]:
        for step in itertools.count(first_step):
            generator = torch.Generator().manual_seed(step)
            yield {"x": torch.randn(8, 2, generator=generator)}

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        x = batch["x"]
        return {"fit": (self.line(x)[:, 0] - x.sum(dim=1)).square().mean()}


def stop_at(call: int) -> Mock:
    """Return a validation that simulates a crash at its n-th call."""
    return Mock(side_effect=[*({"val": 1.0} for _ in range(call - 1)), KeyboardInterrupt])


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def same_weights(first: dict[str, dict[str, Tensor]], second: dict[str, dict[str, Tensor]]) -> bool:
    return all(torch.equal(first[module][key], value) for module in second for key, value in second[module].items())


class TestLoop:
    @pytest.mark.parametrize("kind", ["adamw", pytest.param("sgd", marks=pytest.mark.slow)])
    @pytest.mark.parametrize("ema_decay", [0.0, 0.9])
    def test_resumed_run_equals_an_uninterrupted_run(self, tmp_path: Path, kind: Any, ema_decay: float) -> None:
        settings = {"optimiser": OptimiserConfig(kind=kind, learning_rate=0.05), "ema_decay": ema_decay}
        straight = run_stage(LineStage(**settings), tmp_path / "straight", device=CPU)
        folder = tmp_path / "broken"
        with pytest.raises(KeyboardInterrupt):
            run_stage(LineStage(**settings), folder, device=CPU, checkpoint_minutes=0.0, validate=stop_at(6))
        assert Checkpoint.load(folder / "line.pt").step == 5
        resumed = run_stage(LineStage(**settings), folder, device=CPU, resume=True)
        assert resumed.step == straight.step == 12
        assert same_weights(resumed.weights, straight.weights)
        assert same_weights(resumed.averaged, straight.averaged)
        assert bool(straight.averaged) == (ema_decay > 0.0)

    def test_log_has_a_row_per_value_and_continues(self, tmp_path: Path) -> None:
        first = LineStage(40)
        with pytest.raises(KeyboardInterrupt):
            run_stage(first, tmp_path, device=CPU, checkpoint_minutes=0.0, validate=stop_at(25))
        run_stage(LineStage(40), tmp_path, device=CPU, resume=True, validate=stop_at(99))
        rows = rows_of(tmp_path / "line.csv")
        assert [row["step"] for row in rows if row["name"] == "fit"] == ["20", "40"]
        assert [row["step"] for row in rows if row["name"] == "val"][-1] == "40"
        assert all(float(row["seconds"]) >= 0.0 for row in rows)

    def test_finished_run_resumes_to_itself_and_nothing_else_resumes(self, tmp_path: Path) -> None:
        done = run_stage(LineStage(), tmp_path, device=CPU)
        again = run_stage(LineStage(), tmp_path, device=CPU, resume=True)
        assert again.step == done.step
        assert same_weights(again.weights, done.weights)
        with pytest.raises(CheckpointError, match="another configuration"):
            run_stage(LineStage(batch=64), tmp_path, device=CPU, resume=True)
        with pytest.raises(CheckpointError, match="no checkpoint"):
            run_stage(LineStage(), tmp_path / "none", device=CPU, resume=True)

    def test_non_finite_loss_keeps_the_last_checkpoint(self, tmp_path: Path) -> None:
        stage = LineStage()
        healthy = stage.losses

        def losses(batch: Batch) -> dict[str, Tensor]:
            steps_done = Checkpoint.load(tmp_path / "line.pt").step if (tmp_path / "line.pt").exists() else 0
            return {"fit": healthy(batch)["fit"] * (float("nan") if steps_done == 4 else 1.0)}

        stage.losses = losses  # type: ignore[method-assign]
        with pytest.raises(FloatingPointError, match="step 4"):
            run_stage(stage, tmp_path, device=CPU, checkpoint_minutes=0.0)
        saved = Checkpoint.load(tmp_path / "line.pt")
        assert saved.step == 4
        assert all(bool(torch.isfinite(value).all()) for value in saved.weights["line"].values())

    def test_progress_bar_counts_steps(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        run_stage(LineStage(), tmp_path, device=CPU)
        last = capsys.readouterr().err.splitlines()[-1]
        assert "100%" in last
        assert "12/12" in last

    def test_progress_bar_counts_minutes_of_a_time_budget(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        run_stage(LineStage(10**9, minutes=0.01), tmp_path, device=CPU)
        last = re.split(r"[\r\n]", capsys.readouterr().err.strip())[-1]
        assert "100%" in last
        assert "0.01/0.01 min" in last
        # A longer budget continues where the first one ended.
        run_stage(LineStage(10**9, minutes=0.02), tmp_path, device=CPU, resume=True)
        first, *_, last = re.split(r"[\r\n]", capsys.readouterr().err.strip())
        assert "0.01/0.02 min" in first
        assert "0.02/0.02 min" in last

    def test_checkpoint_with_old_metric_names_resumes(self, tmp_path: Path) -> None:
        checkpoint = run_stage(LineStage(), tmp_path, device=CPU)
        checkpoint.metrics = {"val_nll": -1.0, "unfamiliar_within_1m": 0.5}
        for name in ("line.pt", "line.best.pt"):
            checkpoint.save(tmp_path / name)
        resumed = run_stage(LineStage(14), tmp_path, device=CPU, resume=True, validate=lambda _: {"val_nll": -2.0})
        assert (resumed.step, resumed.metrics) == (14, {"val_nll": -2.0})

    def test_averaged_weights_are_shipped(self, tmp_path: Path) -> None:
        plain = run_stage(LineStage(), tmp_path / "plain", device=CPU)
        averaged = run_stage(LineStage(ema_decay=0.9), tmp_path / "averaged", device=CPU)
        assert plain.inference_weights is plain.weights
        assert averaged.inference_weights is averaged.averaged
        assert not same_weights(averaged.averaged, averaged.weights)


class TestCheckpoint:
    def test_checkpoint_round_trip(self, tmp_path: Path) -> None:
        saved = run_stage(LineStage(ema_decay=0.9), tmp_path, device=CPU, validate=stop_at(99))
        loaded = Checkpoint.load(tmp_path / "line.pt", stage="line")
        assert (loaded.config, loaded.step, loaded.metrics) == (saved.config, 12, {"val": 1.0})
        assert same_weights(loaded.weights, saved.weights)
        assert same_weights(loaded.averaged, saved.averaged)
        assert loaded.optimiser["state"].keys() == saved.optimiser["state"].keys()
        assert not list(tmp_path.glob("*.part"))

    def test_checkpoint_of_another_stage_and_damaged_one_are_refused(self, tmp_path: Path) -> None:
        run_stage(LineStage(), tmp_path, device=CPU)
        with pytest.raises(CheckpointError, match="'layout' is required"):
            Checkpoint.load(tmp_path / "line.pt", stage="layout")
        content = (tmp_path / "line.pt").read_bytes()
        (tmp_path / "line.pt").write_bytes(content[: len(content) // 2])
        with pytest.raises(CheckpointError, match="cannot read"):
            Checkpoint.load(tmp_path / "line.pt")

    def test_loading_executes_no_code_and_refuses_unknown_keys(self, tmp_path: Path) -> None:
        path = tmp_path / "evil.pt"
        torch.save({"stage": "layout", "config": TINY.to_dict(), "weights": {}, "metrics": _Evil()}, path)
        with pytest.raises(CheckpointError):
            Checkpoint.load(path)
        assert not _Evil.executed
        torch.save({"stage": "layout", "config": {**TINY.to_dict(), "extra": 1}, "weights": {}}, tmp_path / "c.pt")
        with pytest.raises(CheckpointError, match="no key 'extra'"):
            Checkpoint.load(tmp_path / "c.pt")

    def test_missing_layout_checkpoint_is_reported(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match="no checkpoint"):
            train_stage("image", TINY, tmp_path, device=CPU)
        with pytest.raises(CheckpointError, match="no checkpoint"):
            export_run(tmp_path, tmp_path / "out", name="none", version="1")


class _Evil:
    """Object that runs code when it is unpickled."""

    executed = False

    def __reduce__(self) -> tuple[Callable[..., None], tuple[object, str, bool]]:
        return setattr, (_Evil, "executed", True)


class TestStreams:
    def test_splits_share_no_home(self) -> None:
        plans = [home_of(split, 0, index)[0].plan for split in (TRAIN, VALIDATION, TEST) for index in range(15)]
        outlines = {np.concatenate([room.polygon_m for room in plan.rooms]).tobytes() for plan in plans}
        assert len({TRAIN, VALIDATION, TEST}) == 3
        assert len(outlines) == len(plans)

    def test_layout_batch_holds_anchors_with_neighbours(self) -> None:
        batch = next(layout_batches())
        stage = TINY.layout
        anchors = stage.homes_per_step * stage.anchors_per_home
        size = 1 + stage.triplets.positives + stage.triplets.negatives
        shapes = {key: tuple(value.shape) for key, value in batch.items()}
        heights = dict.fromkeys(("camera_height_m", "ceiling_height_m"), (anchors, size))
        assert shapes == {"profile_m": (anchors, size, TINY.profile_columns), **heights}
        assert all(value.dtype == torch.float32 for value in batch.values())
        assert bool(torch.isfinite(batch["profile_m"]).all())
        assert bool((batch["camera_height_m"] < batch["ceiling_height_m"]).all())
        # An anchor and its neighbours have the same camera height.
        assert bool((batch["camera_height_m"] == batch["camera_height_m"][:, :1]).all())

    def test_turned_negatives_are_near_at_other_headings(self) -> None:
        batches = layout_batches(TINY.with_settings({"layout.turned_share": 0.5}))
        profile = torch.cat([next(batches)["profile_m"] for _ in range(6)]).sort(dim=2).values
        # Rotation permutes the columns, so sorted profiles of near positions are similar.
        change = (profile[:, 1:] - profile[:, :1]).abs().median(dim=2).values
        negatives = TINY.layout.triplets.positives
        far, turned = change[:, negatives : negatives + 2], change[:, negatives + 2 :]
        assert turned.median() < 0.5 * far.median()

    def test_workers_use_distinct_homes(self, monkeypatch: pytest.MonkeyPatch) -> None:
        drawn: dict[int, list[int]] = {0: [], 1: []}
        for worker in (0, 1):

            def recording(split: int, seed: int, index: int, worker: int = worker) -> Any:
                assert split == TRAIN
                drawn[worker].append(index)
                return home_of(split, seed, index)

            info = SimpleNamespace(id=worker, num_workers=2)
            monkeypatch.setattr(batches, "get_worker_info", lambda info=info: info)
            monkeypatch.setattr(sources, "home_of", recording)
            list(itertools.islice(LayoutBatches(TINY, GeneratedSource(TINY), first=100), 2))
        assert all(index >= 100 and index % 2 == worker for worker, indices in drawn.items() for index in indices)
        assert not set(drawn[0]) & set(drawn[1])

    def test_sphere_batch_holds_pictures_with_layouts(self) -> None:
        batch = next(sphere_batches())
        count, (height, width) = TINY.image.batch, TINY.image_size
        assert batch["image"].shape == (count, height, width, 4)
        assert batch["image"].dtype == torch.uint8
        assert batch["profile_m"].shape == (count, TINY.profile_columns)
        assert batch["camera_height_m"].shape == batch["ceiling_height_m"].shape == (count,)
        assert bool(torch.isfinite(batch["profile_m"]).all())
        assert bool((batch["camera_height_m"] < batch["ceiling_height_m"]).all())
        again = next(sphere_batches())
        assert all(torch.equal(batch[key], again[key]) for key in batch)

    @pytest.mark.parametrize("turns", get_args(Turns))
    @given(seed=seeds(), heading=st.floats(-7.0, 7.0), columns=st.sampled_from([16, 24, 48]))
    def test_rotated_sphere_matches_its_layout(self, turns: Turns, seed: int, heading: float, columns: int) -> None:
        rng = np.random.default_rng(seed)
        plan, width = crooked_flat(), 48
        poses = random_poses(plan, 1, rng)

        def seen(heading: float, columns: int) -> np.ndarray:
            heading_of = np.array([heading])
            return profiles_at(plan, poses.position_m, poses.room_index, heading_of, columns, np.float32)[0]

        # A picture of the wall distances contains its layout.
        image = np.repeat(seen(heading, width)[None, :, None], 3, axis=2)
        turn = sample_rotation(turns, heading, width, rng)
        shown = turn.picture(image)[0, :, 0]
        np.testing.assert_allclose(shown, turn.profile(seen(turn.heading, width)), rtol=1e-4)
        # Profiles and pictures can have different numbers of columns.
        coarse = turn.profile(seen(turn.heading, columns))
        unturned = seen(turn.heading, columns)
        np.testing.assert_array_equal(coarse[::-1] if turn.mirrored else coarse, unturned)
        quarters = turn.heading / (math.pi / 2)
        if turns != "any":
            assert abs(quarters - round(quarters)) * (math.pi / 2) <= math.pi / width + 1e-9
        if turns == "none":
            assert abs(turn.heading) <= math.pi / width + 1e-9
            assert not turn.mirrored

    @pytest.mark.parametrize(("turns", "count"), [("any", 16), ("quarters", 8), ("none", 1)])
    def test_all_rotations_and_mirrorings_occur(self, turns: Turns, count: int) -> None:
        rng = np.random.default_rng(0)
        drawn = [sample_rotation(turns, 0.0, 8, rng) for _ in range(300)]
        assert len({(round(turn.heading % TWO_PI, 6), turn.mirrored) for turn in drawn}) == count

    def test_neighbours_are_rotated_like_their_sphere(self) -> None:
        batch = next(sphere_batches(neighbours=True))
        sampling = TINY.layout.triplets
        count = sampling.positives + sampling.negatives
        assert batch["neighbour_profile_m"].shape == (TINY.image.batch, count, TINY.profile_columns)
        assert batch["neighbour_ceiling_height_m"].shape == (TINY.image.batch, count)
        assert bool((batch["neighbour_ceiling_height_m"] > batch["camera_height_m"][:, None]).all())
        # Layouts half a metre apart are similar only at the same heading and without mirroring.
        own = batch["profile_m"][:, None].log()
        positives = batch["neighbour_profile_m"][:, : sampling.positives].log()
        matched = (positives - own).abs().median(dim=2).values
        turned = (positives.roll(TINY.profile_columns // 4, dims=2) - own).abs().median(dim=2).values
        mirrored = (positives.flip(2) - own).abs().median(dim=2).values
        assert matched.median() < 0.5 * turned.median()
        assert matched.median() < 0.5 * mirrored.median()


class TestStages:
    def repeated(self, stage: TrainingStage, monkeypatch: pytest.MonkeyPatch) -> Batch:
        batch = next(stage.batches(0, 0))
        monkeypatch.setattr(stage, "batches", lambda first_step, workers: itertools.repeat(batch))
        return batch

    def total(self, stage: TrainingStage, batch: Batch) -> float:
        with torch.no_grad():
            return float(sum(stage.losses(batch).values()))

    @pytest.mark.slow
    def test_layout_loss_falls_on_unseen_layouts(self, tmp_path: Path) -> None:
        stage = layout_stage()
        unseen = next(stage.batches(1000, 0))
        before = self.total(stage, unseen)
        run_stage(stage, tmp_path, device=CPU, workers=0)
        assert self.total(stage, unseen) < 0.8 * before

    def test_layout_stage_has_the_configured_losses(self) -> None:
        batch = next(layout_batches())

        def terms(**changes: Any) -> dict[str, Tensor]:
            return layout_stage(changed("layout", TINY, **changes)).losses(batch)

        assert set(terms()) == {"log_ratio", "scale", "decode"}
        assert set(terms(scale_weight=0.0, decode_weight=0.0)) == {"log_ratio"}
        assert set(terms(decode_anchors_only=False, all_pairs=False)) == {"log_ratio", "scale", "decode"}
        assert all(term.ndim == 0 and bool(torch.isfinite(term)) for term in terms().values())

    @pytest.mark.slow
    def test_image_encoder_learns_and_teacher_stays_frozen(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        config = TINY.with_settings({"image.steps": 60, "image.optimiser.learning_rate": 5e-3})
        teacher = build_layout_encoder(config)
        before = {key: value.clone() for key, value in teacher.state_dict().items()}
        stage = image_stage(config, teacher)
        batch = self.repeated(stage, monkeypatch)
        first = self.total(stage, batch)
        run_stage(stage, tmp_path, device=CPU, workers=0)
        assert self.total(stage, batch) < first - 0.5
        assert all(torch.equal(before[key], value) for key, value in teacher.state_dict().items())
        assert all(parameter.grad is None for parameter in teacher.parameters())
        assert not teacher.training
        assert set(Checkpoint.load(tmp_path / "image.pt", stage="image").weights) == {"image_encoder"}

    def test_perfect_image_encoder_has_zero_loss(self, monkeypatch: pytest.MonkeyPatch) -> None:
        teacher = build_layout_encoder(TINY)
        assert isinstance(teacher, RingLayoutEncoder)
        stage = image_stage(TINY, teacher)
        batch = next(stage.batches(0, 0))
        profile, camera, ceiling = batch["profile_m"], batch["camera_height_m"], batch["ceiling_height_m"]
        certain = torch.zeros_like(profile)[..., None]
        perfect = ImageFeatures(
            ring=teacher.ring(profile, camera, ceiling), walls=WallModes(profile.log()[..., None], certain, certain)
        )
        monkeypatch.setattr(stage, "encoder", lambda image, height: perfect)
        assert all(abs(term.item()) < 1e-5 for term in stage.losses(batch).values())

    @pytest.mark.parametrize("architecture", ["paper", "ring"])
    @pytest.mark.parametrize(
        ("weights", "names"),
        [
            ({}, {"l2"}),
            ({"l2_weight": 0.0, "log_ratio_weight": 1.0}, {"log_ratio"}),
            ({"log_ratio_weight": 2.0}, {"l2", "log_ratio"}),
            ({"kd_weight": 1.0}, {"l2", "kd"}),
        ],
    )
    def test_image_stage_has_the_configured_losses(
        self, architecture: Any, weights: dict[str, float], names: set[str]
    ) -> None:
        config = dataclasses.replace(small_paper(), ring=TINY.ring, architecture=architecture)
        config = changed("image", config, **weights)
        stage = image_stage(config, build_layout_encoder(config))
        terms = stage.losses(next(stage.batches(0, 0)))
        assert set(terms) == names
        torch.stack(list(terms.values())).sum().backward()
        assert all(p.grad is None for p in stage.teacher.parameters())
        assert any(bool(p.grad.abs().sum() > 0) for p in stage.encoder.parameters() if p.grad is not None)

    def test_image_losses_match_the_equations(self) -> None:
        config = changed("image", small_paper(), l2_weight=0.0, log_ratio_weight=0.5, kd_weight=0.25)
        stage = image_stage(config, build_layout_encoder(config))
        batch = next(stage.batches(0, 0))
        stage.encoder.eval()
        with torch.no_grad():
            terms = stage.losses(batch)
            f = stage.encoder(batch["image"][..., :3])
        ratios, distilled = [], []
        for p in range(len(f)):
            profile = torch.cat([batch["profile_m"][p : p + 1], batch["neighbour_profile_m"][p]])
            ceiling = torch.cat([batch["ceiling_height_m"][p : p + 1], batch["neighbour_ceiling_height_m"][p]])
            camera = batch["camera_height_m"][p].expand(len(profile))
            with torch.no_grad():
                g = stage.teacher(profile, camera, ceiling)
            thinned = profile[:, :: profile.shape[1] // config.layout.cloud_columns]
            cloud = back_project(layout_depth(thinned, camera, ceiling, config.layout.cloud_rows))
            for j in range(2, len(profile)):
                latent = math.log((g[1] - f[p]).norm() / (g[j] - f[p]).norm())
                structure = math.log(
                    chamfer_distance(cloud[1:2], cloud[:1]).item()
                    / chamfer_distance(cloud[j : j + 1], cloud[:1]).item()
                )
                ratios.append((latent - structure) ** 2)
                distilled.append((latent - math.log((g[1] - g[0]).norm() / (g[j] - g[0]).norm())) ** 2)
        assert terms["log_ratio"].item() == pytest.approx(0.5 * np.mean(ratios), rel=1e-3)
        assert terms["kd"].item() == pytest.approx(0.25 * np.mean(distilled), rel=1e-3)

    def test_disabled_losses_are_not_computed(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(layout_stage_module, "chamfer_to_anchors", pytest.fail)
        stage = layout_stage(changed("layout", TINY, log_ratio_weight=0.0, scale_weight=0.0, decode_weight=1.0))
        assert set(stage.losses(next(layout_batches()))) == {"decode"}
        assert "neighbour_profile_m" not in next(image_stage(TINY, build_layout_encoder(TINY)).batches(0, 0))
        assert set(layout_stage(changed("layout", TINY, decode_weight=0.0)).modules) == {"layout_encoder"}

    def test_end_to_end_branches_have_separate_gradients(self) -> None:
        config = small_paper()
        stage = EndToEndStage(config, GeneratedSource(config))
        batch = next(stage.batches(0, 0))
        terms = stage.losses(batch)
        assert set(terms) == {"log_ratio", "decode", "l2"}
        terms["l2"].backward()
        assert all(p.grad is None for p in stage.modules["layout_encoder"].parameters())
        assert all(p.grad is not None for p in stage.modules["image_encoder"].parameters())
        stage.encoder.zero_grad(set_to_none=True)
        terms = stage.losses(batch)
        (terms["log_ratio"] + terms["decode"]).backward()
        assert all(p.grad is None for p in stage.modules["image_encoder"].parameters())
        assert all(p.grad is not None for p in stage.modules["layout_encoder"].parameters())

    def test_end_to_end_refuses_a_shared_head(self) -> None:
        with pytest.raises(ConfigError, match="'ring'"):
            EndToEndStage(TINY, GeneratedSource(TINY))

    @pytest.mark.slow
    def test_end_to_end_run_is_exported(self, tmp_path: Path) -> None:
        config = changed("image", small_paper(), steps=1)
        stage = EndToEndStage(config, GeneratedSource(config))
        run_stage(stage, tmp_path, device=CPU, workers=0)
        bundle = export_run(tmp_path, tmp_path / "bundle", name="both", version="1")
        assert {IMAGE_ONNX, DECODER_WEIGHTS} <= set(bundle.manifest.files)
        assert bundle.manifest.training["end-to-end"]["steps"] == 1
        (tmp_path / "layout.pt").write_bytes(b"")
        with pytest.raises(CheckpointError, match="both"):
            export_run(tmp_path, tmp_path / "bundle", name="both", version="1")


def small_paper() -> TrainConfig:
    """Return the `paper` architecture at small sizes."""
    sizes = {"image_depth": 18, "width": 8, "layout_height": 32, "profile_columns": 64}
    config = changed("paper", PRESETS["paper"], **sizes, image_height=64, image_width=128)
    return changed("layout.triplets", changed("image", config, batch=2), positives=1, negatives=4)
