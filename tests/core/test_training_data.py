"""Training from a data set on disk: sampling, order, and files that cannot be used."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import json
import logging
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from lalaloc_core.cli import main
from lalaloc_core.errors import CheckpointError, DatasetError
from lalaloc_core.learn.data.folder import OwnData
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.learn.training.batch_streams import LayoutBatches, SphereBatches
from lalaloc_core.learn.training.batches import Batch, load_batches
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import PRESETS
from lalaloc_core.learn.training.run import train_stage
from lalaloc_core.learn.training.sources import SceneSource
from lalaloc_core.learn.training.training_data import TrainingData
from lalaloc_core.learn.training.validate import ImageValidation, LayoutValidation
from lalaloc_core.render.sampling import random_poses
from lalaloc_core.render.sweep import profiles_at
from tests.strategies import crooked_flat, present

CPU = torch.device("cpu")
SCENES, CAMERAS, HEADING_DEG = 5, 3, 30.0
# Small batches without rotation, so that samples can be identified.
CONFIG = PRESETS["tiny"].with_settings(
    {"turns": "none", "layout.homes_per_step": 2, "layout.anchors_per_home": 1, "layout.steps": 2}
    | {"image.batch": 4, "image.shots_per_home": 1, "image.steps": 2}
)


@pytest.fixture
def data(tmp_path: Path) -> OwnData:
    """Write scenes 0 to 4 for training and one for validation; sphere k of scene s has grey 40 s + 10 k."""
    root = tmp_path / "data"
    plan = crooked_flat()
    with_split = [(f"scene {number}", "train") for number in range(SCENES)] + [("scene v", "validation")]
    for number, (name, _) in enumerate(with_split):
        folder = root / name
        folder.mkdir(parents=True)
        (folder / "plan.json").write_text(json.dumps(plan.to_dict()), encoding="utf-8")
        poses = random_poses(plan, CAMERAS, np.random.default_rng(number), 0.3)
        with (folder / "poses.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["photograph", "x_m", "y_m", "heading_deg", "camera_height_m"])
            for k, (x, y) in enumerate(poses.position_m):
                writer.writerow([f"{k}.png", x, y, HEADING_DEG, 1.2 + 0.1 * k])
                Image.new("RGB", (128, 64), (40 * number + 10 * k,) * 3).save(folder / f"{k}.png")
    (root / "splits.csv").write_text("\n".join(["scene,split", *map(",".join, with_split)]) + "\n", encoding="utf-8")
    return OwnData(root)


def spheres(source: SceneSource, *, neighbours: bool = False) -> Iterator[Batch]:
    return load_batches(SphereBatches(source.config, source, neighbours), 0)


def greys(batches: Iterator[Batch], count: int) -> list[int]:
    return torch.cat([batch["image"][:, 0, 0, 0] for batch in itertools.islice(batches, count)]).tolist()


class TestDrawing:
    def test_sphere_has_its_layout_at_its_heading(self, data: OwnData) -> None:
        batch = next(spheres(SceneSource(CONFIG, data)))
        # "none" rotates the pictures to heading 0 by whole pixels of 1/64 turn.
        pixel = 2.0 * math.pi / CONFIG.image_size[1]
        heading = math.radians(HEADING_DEG) % pixel
        heading -= pixel * (heading > pixel / 2)
        for grey, profile, height in zip(
            batch["image"][:, 0, 0, 0].tolist(), batch["profile_m"].numpy(), batch["camera_height_m"], strict=True
        ):
            scene = data.load(f"scene {grey // 40}")
            camera = scene.cameras[grey % 40 // 10]
            place, room = np.asarray(camera.position_m)[None], np.array([camera.room_index])
            columns = CONFIG.profile_columns
            expected = profiles_at(scene.plan, place, room, np.array([heading]), columns, np.float32)[0]
            np.testing.assert_allclose(profile, expected, rtol=1e-4)
            assert height.item() == pytest.approx(camera.camera_height_m)

    def test_epochs_visit_every_scene_in_new_orders(self, data: OwnData) -> None:
        config = CONFIG.with_settings({"image.batch": SCENES})
        scenes = np.array(greys(spheres(SceneSource(config, data)), 6)).reshape(6, SCENES) // 40
        assert all(sorted(epoch) == list(range(SCENES)) for epoch in scenes.tolist())
        assert len({tuple(epoch) for epoch in scenes.tolist()}) > 3

    def test_seed_determines_the_samples(self, data: OwnData) -> None:
        first, again = (greys(spheres(SceneSource(CONFIG, data)), 5) for _ in range(2))
        different = greys(spheres(SceneSource(dataclasses.replace(CONFIG, seed=1), data)), 5)
        assert first == again != different

    def test_samples_do_not_depend_on_the_worker(self, data: OwnData) -> None:
        alone = SceneSource(CONFIG, data)
        shared = [SceneSource(CONFIG, data) for _ in range(2)]
        for visit in range(12):
            mine, theirs = alone.samples(visit, 32, 64), shared[visit % 2].samples(visit, 32, 64)
            assert [np.asarray(view.image).tobytes() for view in mine] == [
                np.asarray(view.image).tobytes() for view in theirs
            ]

    def test_layout_anchors_are_camera_poses(self, data: OwnData) -> None:
        batch = next(load_batches(LayoutBatches(CONFIG, SceneSource(CONFIG, data)), 0))
        cameras = [camera for name in data.scenes("train") for camera in data.load(name).cameras]
        plan = crooked_flat()
        places = np.stack([camera.position_m for camera in cameras])
        rooms = np.array([camera.room_index for camera in cameras])
        profiles = profiles_at(plan, places, rooms, np.zeros(len(cameras)), CONFIG.profile_columns, np.float32)
        for anchor, heights in zip(batch["profile_m"][:, 0].numpy(), batch["camera_height_m"], strict=True):
            distance = np.abs(profiles - anchor).max(axis=1)
            assert distance.min() < 1e-4
            assert heights.tolist() == pytest.approx(
                [cameras[int(distance.argmin())].camera_height_m] * len(heights), rel=1e-6
            )

    def test_generated_scenes_serve_as_a_data_set(self) -> None:
        levels = GeneratedScenes(homes=1, shots_per_home=1, furniture=None)
        views = SceneSource(CONFIG, levels).samples(0, 32, 64)
        assert [np.shape(np.asarray(view.image)) for view in views] == [(32, 64, 3)]


class TestBadFiles:
    def damaged(self, data: OwnData) -> set[str]:
        """Damage a picture and a plan; return the file names for the errors."""
        (data.root / "scene 1" / "2.png").write_bytes(b"no picture")
        (data.root / "scene 3" / "plan.json").write_text("{}", encoding="utf-8")
        return {"2.png", "plan.json"}

    def test_bad_file_ends_training(self, data: OwnData) -> None:
        named = self.damaged(data)
        with pytest.raises(DatasetError) as raised:
            greys(spheres(SceneSource(CONFIG, data)), 40)
        assert present(raised.value.path).name in named

    def test_skipped_files_are_logged_once(self, data: OwnData, caplog: pytest.LogCaptureFixture) -> None:
        named = self.damaged(data)
        with caplog.at_level(logging.WARNING):
            drawn = set(greys(spheres(SceneSource(CONFIG, data, skip_bad=True)), 60))
        good = {40 * scene + 10 * camera for scene in range(SCENES) for camera in range(CAMERAS)}
        assert drawn == good - {60} - {120, 130, 140}
        messages = [record.getMessage() for record in caplog.records]
        assert len(messages) == 2
        assert all(sum(name in message for message in messages) == 1 for name in named)
        assert ["number 1" in messages[0], "number 2" in messages[1]] == [True, True]

    def test_data_set_without_usable_or_training_scenes_is_refused(self, data: OwnData, tmp_path: Path) -> None:
        for number in range(SCENES):
            (data.root / f"scene {number}" / "plan.json").write_text("{}", encoding="utf-8")
        for stream in (LayoutBatches, SphereBatches):
            with pytest.raises(DatasetError, match="in a row"):
                next(load_batches(stream(CONFIG, SceneSource(CONFIG, data, skip_bad=True)), 0))
        with pytest.raises(DatasetError, match="no training scenes"):
            SceneSource(CONFIG, OwnData(tmp_path / "empty"))

    @pytest.mark.slow
    def test_worker_errors_keep_their_attributes(self, data: OwnData) -> None:
        (data.root / "scene 3" / "plan.json").write_text("{}", encoding="utf-8")
        with pytest.raises(DatasetError) as raised:
            for _ in itertools.islice(load_batches(LayoutBatches(CONFIG, SceneSource(CONFIG, data)), 1), 10):
                pass
        assert raised.value.path == data.root / "scene 3" / "plan.json"
        assert raised.value.scene == "scene 3"


class TestRuns:
    @pytest.mark.slow
    def test_resuming_on_other_data_is_refused(self, data: OwnData) -> None:
        folder = data.root.parent / "run"
        trained = train_stage("layout", CONFIG, folder, device=CPU, data=TrainingData(dataset=data), workers=0)
        expected = {"description": data.description, "scenes": SCENES}
        assert Checkpoint.load(folder / "layout.pt").data == trained.data == expected
        assert {"val_within_1m", "val_median_cm"} <= set(trained.metrics)
        with pytest.raises(CheckpointError, match="homes generated while training"):
            train_stage("layout", CONFIG, folder, device=CPU, workers=0, resume=True)

    def test_command_exits_with_2_at_a_bad_file(self, data: OwnData, capsys: pytest.CaptureFixture[str]) -> None:
        words = ["lab", "train", "layout", "--preset", "tiny", "--steps", "3", "--workers", "0", "--device", "cpu"]
        # The decoder takes most of the time.
        words += ["--set", "layout.decode_weight=0", "--data", str(data.root), "--out", str(data.root.parent / "run")]
        assert main(words) == 0
        (data.root / "scene 3" / "plan.json").write_text("{}", encoding="utf-8")
        assert main(words) == 2
        assert "plan.json" in capsys.readouterr().err
        assert main([*words, "--skip-bad"]) == 0


class TestValidation:
    def test_generated_and_stored_scenes_are_validated(self, data: OwnData) -> None:
        for training in (TrainingData(validation_scenes=2), TrainingData(dataset=data)):
            scenes = training.validation(CONFIG)
            modules: dict[str, torch.nn.Module] = {"layout_encoder": PerfectLayouts()}
            scores = LayoutValidation(CONFIG, scenes, CPU)(modules)
            # The error of an encoder that keeps the whole profile comes only from the grid step.
            assert scores["val_within_1m"] >= 0.75
            assert scores["val_median_cm"] >= scores["val_oracle_median_cm"]

    def test_unreadable_photographs_are_not_validated(self, data: OwnData) -> None:
        (data.root / "scene v" / "1.png").write_bytes(b"no picture")
        scenes = TrainingData(dataset=data).validation(CONFIG)
        with pytest.raises(DatasetError, match=r"1\.png"):
            ImageValidation(CONFIG, scenes, None, CPU)
        problems: list[DatasetError] = []
        validation = ImageValidation(CONFIG, scenes, None, CPU, problems=problems)
        assert [problem.room for problem in problems] == ["1.png"]
        assert len(validation.images) == len(validation.queries) == CAMERAS - 1

    def test_validation_covers_several_furniture_levels(self) -> None:
        validation = ImageValidation(CONFIG, TrainingData(validation_scenes=3).validation(CONFIG), None, CPU)
        assert set(validation.levels) <= {"empty", "simple", "full"}
        assert len(set(validation.levels)) > 1


class PerfectLayouts(torch.nn.Module):
    def forward(self, profile_m: torch.Tensor, camera_m: torch.Tensor, ceiling_m: torch.Tensor) -> torch.Tensor:
        return torch.cat([profile_m, camera_m[:, None], ceiling_m[:, None]], dim=1)
