"""Spheres in metric plans by others: reading of rooms and houses, as annotations, as targets, and the short table."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from lalaloc_core.bundle import default_bundle
from lalaloc_core.cli import main
from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES
from lalaloc_core.errors import ConfigError, DatasetError
from lalaloc_core.learn.data.annotated import GALLERY_ROOMS
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M
from lalaloc_core.learn.data.dataset_detection import open_dataset
from lalaloc_core.learn.data.posed_spheres import PosedSpheres, annotated
from lalaloc_core.learn.training.batch_streams import UNKNOWN
from lalaloc_core.learn.training.photograph_targets import load_photographs
from lalaloc_core.render.profile import wall_profile
from tests.core.test_annotated import annotation

WALL, DOOR, WINDOW, _ = range(len(OPENING_CLASSES))
# An L-shaped kitchen, and a camera that looks east in it; a window in the arm that it does not see.
POLYGON = [[0.0, 0.0], [5.0, 0.0], [5.0, 2.0], [2.0, 2.0], [2.0, 6.0], [0.0, 6.0]]
CAMERA = [4.0, 1.0, 1.2]
HEADING = 0.5 * np.pi


def write_room(folder: Path, seed: int) -> None:
    door, window = [[5.0, 0.5], [5.0, 1.5]], [[0.5, 6.0], [1.5, 6.0]]
    openings = [{"kind": "door", "line": door}, {"kind": "window", "line": window}]
    room = {
        "seed": seed,
        "kind": "kitchen",
        "polygon": POLYGON,
        "height": 2.4,
        "camera": CAMERA,
        "heading": HEADING,
        "openings": openings,
        "objects": [],
    }
    (folder / f"{seed}.json").write_text(json.dumps(room))
    Image.new("RGB", (256, 128), (seed % 256, 0, 0)).save(folder / f"{seed}.jpg")


@pytest.fixture
def rooms(tmp_path: Path) -> Path:
    folder = tmp_path / "rooms"
    folder.mkdir()
    for seed in (2003, 2004, 2005):
        write_room(folder, seed)
    return folder


@pytest.fixture
def house(tmp_path: Path) -> Path:
    folder = tmp_path / "house"
    folder.mkdir()
    plan = {"rooms": [{"id": "hall", "polygon": POLYGON, "ceiling_height_m": 2.4, "type": "corridor"}]}
    (folder / "plan_floor1.json").write_text(json.dumps(plan))
    view = {"file": "1.png", "plan": "plan_floor1.json", "room": "hall", "x_m": 1.0, "y_m": 3.0, "heading_deg": 90.0}
    (folder / "views.json").write_text(json.dumps([view | {"camera_height_m": 1.2}]))
    Image.new("RGB", (256, 128)).save(folder / "1.png")
    return folder


class TestReading:
    def test_every_fifth_seed_validates_and_the_others_train(self, rooms: Path) -> None:
        dataset = PosedSpheres(rooms)
        scenes = [list(dataset.scenes(split)) for split in ("train", "validation", "test")]
        assert scenes == [["2003", "2004"], ["2005"], []]
        assert isinstance(open_dataset(rooms), PosedSpheres)

    def test_house_validates_only(self, house: Path) -> None:
        dataset = PosedSpheres(house)
        assert not dataset.scenes("train")
        (name,) = dataset.scenes("validation")
        (camera,) = dataset.load(name).cameras
        assert (camera.position_m.tolist(), camera.heading) == ([1.0, 3.0], pytest.approx(HEADING))
        # Not even without labels, by a teacher.
        with pytest.raises(DatasetError, match="its photographs only validate"):
            load_photographs([house], [default_bundle()], 32, 64)

    def test_annotation_is_in_the_frame_of_the_photograph(self, rooms: Path) -> None:
        (found,) = annotated(PosedSpheres(rooms), "validation")
        walls = np.array([[*a, *b] for a, b in zip(POLYGON, POLYGON[1:] + POLYGON[:1], strict=True)])
        true_m = wall_profile(np.array([CAMERA[:2]]), np.array([HEADING]), walls[None], 256)[0]
        np.testing.assert_allclose(found.profile_m(0, 256), true_m * CAMERA_HEIGHT_M / CAMERA[2], rtol=1e-6)
        assert found.outlines[0].ceiling_height_m == pytest.approx(2.4 * CAMERA_HEIGHT_M / CAMERA[2])
        classes = found.classes(256)
        # The door is straight ahead, and no ray reaches the window.
        assert classes[128] == DOOR
        assert WINDOW not in classes
        assert np.mean(classes == DOOR) == pytest.approx(2.0 * np.arctan(0.5) / (2.0 * np.pi), abs=0.01)

    def test_faulty_room_is_named(self, rooms: Path) -> None:
        (rooms / "2005.json").write_text("{}")
        with pytest.raises(DatasetError, match=r"2005.*not a scene with poses"):
            PosedSpheres(rooms).load("2005")


class TestGalleries:
    def test_rooms_are_asked_for_among_similar_ones(self, rooms: Path) -> None:
        dataset = open_dataset(rooms, "annotated")
        (validating,) = dataset.scenes("validation")
        assert validating == "2005-0"
        assert "2005-0" not in dataset.scenes("train")
        assert not dataset.scenes("test")
        scene = dataset.load("2005-0")
        assert len(scene.plan.rooms) == GALLERY_ROOMS
        assert scene.plan.room_index_at(scene.cameras[0].position_m[None])[0] == scene.cameras[0].room_index


class TestTargets:
    def test_rooms_that_validate_are_not_trained_on(self, rooms: Path) -> None:
        found = load_photographs([rooms], [], 32, 64)
        assert len(found.images) == 2
        assert found.room_type.tolist() == [ROOM_TYPES.index("kitchen")] * 2
        assert bool((found.openings[:, 32, DOOR - 1] == 1.0).all())

    def test_folders_have_their_shares(self, rooms: Path, tmp_path: Path) -> None:
        real = tmp_path / "real"
        real.mkdir()
        (real / "hall.json").write_text(json.dumps(annotation("hall", room_type="")))
        Image.new("RGB", (256, 128), (0, 0, 255)).save(real / "hall.png")
        found = load_photographs([rooms, real], [], 32, 64, (0.9, 0.1))
        torch.testing.assert_close(found.weight, torch.tensor([0.45, 0.45, 0.1]))
        drawn = found.draw(400, 64, torch.Generator().manual_seed(0))
        assert 0.05 < float((drawn.room_type == UNKNOWN).float().mean()) < 0.16
        with pytest.raises(ConfigError, match="photograph_shares has 1 values for 2 folders"):
            load_photographs([rooms, real], [], 32, 64, (1.0,))

    def test_annotated_photographs_need_no_teacher_in_another_folder(self, rooms: Path, tmp_path: Path) -> None:
        real, unlabelled = tmp_path / "real", tmp_path / "unlabelled"
        for folder in (real, unlabelled):
            folder.mkdir()
            Image.new("RGB", (256, 128)).save(folder / "hall.png")
        (real / "hall.json").write_text(json.dumps(annotation("hall")))
        assert len(load_photographs([rooms, real, unlabelled], [], 32, 64).images) == 3


@pytest.mark.slow
def test_run_is_kept_with_its_short_table(
    rooms: Path, house: Path, tiny_view_bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    real, run, kept = tmp_path / "real", tmp_path / "run", tmp_path / "kept"
    (real / "annotated").mkdir(parents=True)
    house.rename(real / "rendered_house")
    (real / "annotated" / "hall.json").write_text(json.dumps(annotation("hall")))
    Image.new("RGB", (256, 128), (90, 80, 70)).save(real / "annotated" / "hall.png")
    train = ["lab", "train", "view", "preset=tiny-trunk", "steps=2", "workers=0", "validation_homes=1"]
    assert main([*train, f"out={run}", f"photographs={rooms}"]) == 0
    short = ["lab", "short", f"real={real}", f"rooms={rooms}", f"bundle={tiny_view_bundle}"]
    for number in (1, 2):
        assert main([*short, f"run={run}", f"out={kept}", "--note", f"data=rooms {number}"]) == 0
    figures = json.loads("{" + capsys.readouterr().out.rpartition("\n{")[2])
    assert set(figures) >= {"annotated view 80: shape", "house view 67: openings", "rooms spheres: absolute"}
    header, *lines = (kept / "runs.csv").read_text().splitlines()
    assert header.startswith("run,stage,hours,steps,minutes_in_all,spheres_in_all,data,annotated spheres: shape")
    assert [line.split(",")[6] for line in lines] == ["rooms 1", "rooms 2"]
    # The next run starts where this one ended.
    assert main([*train, f"out={tmp_path / 'again'}", f"from={kept}"]) == 0
    assert (kept / "view.pt").stat().st_size < 0.6 * (run / "view.pt").stat().st_size
