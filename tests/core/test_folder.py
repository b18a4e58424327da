"""A user's own data, opening any data set, the worked example, and the out-of-distribution homes."""

from __future__ import annotations

import json
import math
import pickle
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from PIL import Image

from examples.truth import FOLDER, PLAN_PATH, read_poses
from lalaloc_core.cli import main
from lalaloc_core.errors import DatasetError, InvalidInputError
from lalaloc_core.evaluate.runs.factories import build_dataset
from lalaloc_core.evaluate.runs.predictions import RunInfo
from lalaloc_core.learn.data.dataset import Appearance, Dataset, load_scenes
from lalaloc_core.learn.data.dataset_detection import open_dataset
from lalaloc_core.learn.data.folder import HeldoutScenes, OwnData
from lalaloc_core.learn.data.structured3d import EXCLUDED_BY_PAPER, Structured3D
from lalaloc_core.learn.data.zind import Zind
from lalaloc_core.learn.dataset_names import HELDOUT_HOMES
from tests.core.questions import run_info
from tests.strategies import plan_document, rectangle

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "own_data"
HEADER = "photograph,x_m,y_m,heading_deg,camera_height_m"
POSES = f"{HEADER}\nhall.png,1,2,90,1.4\nrooms/study.png,5.5,1,-45,\n"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Write one scene with two rooms and two spheres."""
    write_scene(tmp_path, "home")
    return tmp_path


def write_scene(root: Path, name: str, poses: str = POSES, **plan: Any) -> Path:
    folder = root / name
    (folder / "rooms").mkdir(parents=True)
    document = plan_document(rectangle(3.0, 3.0), rectangle(3.0, 2.0, corner=(4.0, 0.0)), camera_height_m=1.3, **plan)
    document["rooms"][1]["ceiling_height_m"] = 2.1
    (folder / "plan.json").write_text(json.dumps(document))
    (folder / "poses.csv").write_text(poses)
    for file in ("hall.png", "rooms/study.png"):
        Image.fromarray(np.full((64, 128, 3), 200, np.uint8)).save(folder / file)
    return folder


class TestReading:
    def test_scenes_are_read_as_documented(self, root: Path) -> None:
        dataset = OwnData(root)
        assert dataset.scenes("test") == ["home"]
        assert dataset.scenes("train") == []
        assert dataset.description == f"own data ({root.name})"
        scene = dataset.load("home")
        hall, study = scene.cameras
        assert (hall.name, hall.position_m.tolist(), hall.room_index) == ("hall.png", [1.0, 2.0], 0)
        assert (hall.heading, hall.camera_height_m) == (pytest.approx(math.pi / 2), 1.4)
        assert (study.name, study.room_index) == ("rooms/study.png", 1)
        assert (study.heading, study.camera_height_m) == (pytest.approx(1.75 * math.pi), 1.3)
        assert scene.photograph(study, dataset.appearances[0]).image(64, 128).mean() == 200
        assert pickle.loads(pickle.dumps(dataset)) == dataset

    def test_spreadsheet_tables_are_read(self, tmp_path: Path) -> None:
        rows = '\ufeffheading_deg, y_m,x_m,photograph\r\n90,2,1,"hall.png"\r\n\r\n,,,\r\n'
        write_scene(tmp_path, "home", rows)
        (camera,) = OwnData(tmp_path).load("home").cameras
        assert (camera.position_m.tolist(), camera.camera_height_m) == ([1.0, 2.0], 1.3)

    def test_splits_match_the_table(self, root: Path) -> None:
        write_scene(root, "barn")
        write_scene(root, "cottage")
        (root / "splits.csv").write_text("scene,split\nhome,train\ncottage,test\nbarn,test\n")
        dataset = OwnData(root)
        assert dataset.scenes("train") == ["home"]
        assert dataset.scenes("validation") == []
        assert dataset.scenes("test") == ["barn", "cottage"]

    @pytest.mark.parametrize(
        ("lines", "reason"),
        [
            ("home,dev", "line 2, column 'split' is 'dev': it must be one of train, validation, test"),
            ("house,test", "line 2, column 'scene' is 'house': no folder of this name has a plan.json"),
            ("home,test\nhome,train", "line 3, column 'scene' is 'home': it is a duplicate of an earlier line"),
            ("", "scene 'home'.*the scene has no line in this table"),
            ("home", "line 2 has 1 cells; the header has 2"),
        ],
    )
    def test_bad_split_table_is_refused(self, root: Path, lines: str, reason: str) -> None:
        (root / "splits.csv").write_text(f"scene,split\n{lines}\n")
        with pytest.raises(DatasetError, match=reason) as caught:
            OwnData(root).scenes("test")
        assert caught.value.path == root / "splits.csv"


class TestBadFiles:
    @pytest.mark.parametrize(
        ("line", "reasons"),
        [
            ("hall.png,one,2,0,1.4", ["column 'x_m' is 'one'", "must be a number"]),
            ("hall.png,,2,0,1.4", ["column 'x_m' is ''", "must be a number"]),
            ("hall.png,1,nan,0,1.4", ["column 'y_m' is 'nan'", "between -100000 and 100000"]),
            ("hall.png,1e9,2,0,1.4", ["column 'x_m' is '1e9'", "between"]),
            ("hall.png,1,2,400,1.4", ["column 'heading_deg' is '400'", "between -360 and 360"]),
            ("hall.png,1,2,0,-1", ["column 'camera_height_m' is '-1'", "between 0 and 2.5"]),
            ("hall.png,1,2,0,0", ["column 'camera_height_m' is '0'", "the minimum is 0.1 m"]),
            ("rooms/study.png,5,1,0,2.3", ["column 'camera_height_m' is '2.3'", "below the ceiling (2.1 m)"]),
            ("hall.png,3.5,1.5,0,1.4", ["(3.5, 1.5) m is in no room", "nearest is 'room 1', 0.5 m away"]),
            ("attic.png,1,2,0,1.4", ["column 'photograph' is 'attic.png'", "the file does not exist"]),
            ("rooms,1,2,0,1.4", ["column 'photograph' is 'rooms'", "the file does not exist"]),
            (",1,2,0,1.4", ["column 'photograph' is ''", "below the scene's folder"]),
            ("../home/hall.png,1,2,0,1.4", ["column 'photograph'", "below the scene's folder"]),
            ("/etc/passwd,1,2,0,1.4", ["column 'photograph'", "below the scene's folder"]),
            ("hall.png,1,2,0,", ["column 'photograph' is 'hall.png': it is a duplicate"]),
        ],
    )
    def test_bad_cell_is_refused_or_left_out(self, tmp_path: Path, line: str, reasons: list[str]) -> None:
        folder = write_scene(tmp_path, "home", f"{HEADER}\nhall.png,2,2,0,\n{line}\n")
        photograph = line.split(",")[0]
        with pytest.raises(DatasetError) as caught:
            OwnData(tmp_path).load("home")
        error = caught.value
        assert (error.scene, error.room, error.path) == ("home", photograph or None, folder / "poses.csv")
        for reason in ("line 3", *reasons):
            assert reason in str(error)
        problems: list[DatasetError] = []
        assert len(OwnData(tmp_path).load("home", problems).cameras) == 1
        assert [str(problem) for problem in problems] == [str(error)]

    @pytest.mark.parametrize(
        ("content", "reason"),
        [
            (None, "cannot be read: No such file"),
            (b"", "line 1 is ''; it must name the columns photograph,x_m"),
            (b"photograph;x_m;y_m;heading_deg\n", "it must name the columns"),
            (b"photograph,x_m,y_m,heading_deg,height\n", "it must name the columns"),
            (b"photograph,x_m,x_m,y_m,heading_deg\n", "it must name the columns"),
            (b"photograph,x_m,y_m,heading_deg\nhall.png,1,2\n", "line 2 has 3 cells; the header has 4"),
            (b'photograph,x_m,y_m,heading_deg\n"hall.png,1,2,3\n', "line 2 is not valid CSV"),
            (b"\xff\xfe\x00", "not UTF-8"),
        ],
    )
    def test_bad_pose_table_is_refused(self, root: Path, content: bytes | None, reason: str) -> None:
        path = root / "home" / "poses.csv"
        path.unlink()
        if content is not None:
            path.write_bytes(content)
        problems: list[DatasetError] = []
        with pytest.raises(DatasetError, match=reason) as caught:
            OwnData(root).load("home", problems)
        assert (caught.value.scene, caught.value.path) == ("home", path)

    def test_bad_plan_error_names_the_room(self, tmp_path: Path) -> None:
        folder = write_scene(tmp_path, "home")
        document = json.loads((folder / "plan.json").read_text())
        document["rooms"][1]["polygon"] = [[0, 0], [2, 2], [2, 0], [0, 2]]
        (folder / "plan.json").write_text(json.dumps(document))
        with pytest.raises(DatasetError, match="crosses itself") as caught:
            OwnData(tmp_path).load("home")
        assert (caught.value.scene, caught.value.room, caught.value.path) == ("home", "room 2", folder / "plan.json")

    @pytest.mark.parametrize("name", ["house", "../home", "", "/"])
    def test_unknown_scene_name_is_refused(self, root: Path, name: str) -> None:
        with pytest.raises(DatasetError, match="unknown scene"):
            OwnData(root).load(name)

    def test_picture_of_wrong_shape_is_refused_when_read(self, root: Path) -> None:
        path = root / "home" / "hall.png"
        Image.fromarray(np.zeros((64, 64, 3), np.uint8)).save(path)
        scene = OwnData(root).load("home")
        with pytest.raises(DatasetError, match="64 x 64; a full 360° sphere is twice as wide") as caught:
            scene.photograph(scene.cameras[0], Appearance()).image(64, 128)
        assert (caught.value.scene, caught.value.room, caught.value.path) == ("home", "hall.png", path)


class TestOpening:
    def test_each_format_is_detected(self, tmp_path: Path, root: Path) -> None:
        for folder in ("s3d/scene_00017", "zind/0000", "partition"):
            (tmp_path / "sets" / folder).mkdir(parents=True)
        (tmp_path / "sets" / "zind" / "0000" / "zind_data.json").write_text("{}")
        (tmp_path / "sets" / "partition" / "zind_partition.json").write_text("{}")
        assert open_dataset(tmp_path / "sets" / "s3d") == Structured3D(tmp_path / "sets" / "s3d")
        assert open_dataset(tmp_path / "sets" / "zind") == Zind(tmp_path / "sets" / "zind")
        assert isinstance(open_dataset(tmp_path / "sets" / "partition"), Zind)
        assert isinstance(open_dataset(root), OwnData)

    def test_format_option_selects_one_of_several(self, tmp_path: Path) -> None:
        write_scene(tmp_path, "home")
        (tmp_path / "zind_partition.json").write_text("{}")
        with pytest.raises(DatasetError, match="several data sets: ZInD, own data"):
            open_dataset(tmp_path)
        assert isinstance(open_dataset(tmp_path, "zind"), Zind)
        assert isinstance(open_dataset(tmp_path, "own"), OwnData)
        with pytest.raises(DatasetError, match="no Structured3D in this folder; found: ZInD, own data"):
            open_dataset(tmp_path, "structured3d")

    def test_own_scenes_can_have_any_name(self, tmp_path: Path) -> None:
        write_scene(tmp_path, "scene_00000")
        assert isinstance(open_dataset(tmp_path), OwnData)

    @pytest.mark.parametrize(
        ("make", "reason"),
        [
            (lambda path: None, "the folder does not exist"),
            (lambda path: path.write_text(""), "this is a file"),
            (lambda path: path.mkdir(), "no data set in this folder; looked for folders 'scene_00000'"),
            (lambda path: (path / "photos").mkdir(parents=True), r"'\*/plan.json' \(own data\)"),
        ],
    )
    def test_unknown_folder_is_refused(self, tmp_path: Path, make: Any, reason: str) -> None:
        path = tmp_path / "data"
        make(path)
        with pytest.raises(DatasetError, match=reason) as caught:
            open_dataset(path)
        assert caught.value.path == path
        assert str(path) in str(caught.value)


class TestWorkedExample:
    def test_worked_example_is_a_data_set(self) -> None:
        dataset = open_dataset(EXAMPLE)
        (scene,) = load_scenes(dataset, dataset.scenes("test"))
        assert len(scene.cameras) == 2
        for camera in scene.cameras:
            assert scene.photograph(camera, dataset.appearances[0]).image(128, 256).std() > 10.0

    def test_worked_example_matches_the_example_flat(self) -> None:
        truth = {pose.file: pose for pose in read_poses()}
        (scene,) = load_scenes(OwnData(EXAMPLE), ["flat"])
        assert (EXAMPLE / "flat" / "plan.json").read_bytes() == PLAN_PATH.read_bytes()
        for camera in scene.cameras:
            true = truth[camera.name]
            assert (EXAMPLE / "flat" / camera.name).read_bytes() == (FOLDER / camera.name).read_bytes()
            assert camera.position_m.tolist() == [true.x_m, true.y_m]
            assert math.degrees(camera.heading) == pytest.approx(true.heading_deg)
            assert camera.camera_height_m == true.camera_height_m
            assert scene.plan.rooms[camera.room_index].name == true.room


class TestDocumentation:
    page = (ROOT / "docs" / "reference" / "datasets.md").read_text(encoding="utf-8")

    def test_page_lists_every_bad_scene(self) -> None:
        for split, excluded in EXCLUDED_BY_PAPER.items():
            assert f"| {split} | {', '.join(map(str, excluded))} |" in self.page

    def test_page_shows_the_actual_error(self, tmp_path: Path) -> None:
        shutil.copytree(EXAMPLE, tmp_path / "own_data")
        path = tmp_path / "own_data" / "flat" / "poses.csv"
        path.write_text(path.read_text().replace("7.1,2.2,250", "71,2.2,250"))
        with pytest.raises(DatasetError) as caught:
            open_dataset(tmp_path / "own_data").load("flat")
        assert str(caught.value).replace(str(tmp_path), "examples") in self.page

    def test_program_on_the_page_runs(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(ROOT)
        guide = (ROOT / "docs" / "how-to" / "evaluate.md").read_text(encoding="utf-8")
        (program,) = re.findall(r"```python\n(.*?)```", guide, re.DOTALL)
        exec(program, {})
        assert capsys.readouterr().out == "flat 7 ['kitchen.jpg', 'bedroom.jpg']\n"


# Out-of-distribution homes


HELDOUT = Path(__file__).parents[2] / "datasets" / "heldout"


def test_homes_are_sixty_with_four_furnished_spheres_in_their_rooms() -> None:
    homes = HeldoutScenes()
    assert isinstance(homes, Dataset)
    names = homes.scenes("test")
    assert len(names) == len(set(names)) == HELDOUT_HOMES
    assert list(homes.scenes("train")) == list(homes.scenes("validation")) == []
    for name in names:
        scene = homes.load(name)
        assert scene.plan.warnings == ()
        assert [camera.name for camera in scene.cameras] == ["0", "1", "2", "3"]
        for camera in scene.cameras:
            room = scene.plan.rooms[camera.room_index]
            assert room.shape.exterior.distance(shapely.Point(camera.position_m)) > 0.24
            assert 1.1 <= camera.camera_height_m < min(room.ceiling_height_m, 1.8 + 1e-9)
            assert list(camera.photographs) == [Appearance("full")]


def test_files_are_small_and_an_ordinary_data_set() -> None:
    assert sum(path.stat().st_size for path in HELDOUT.rglob("*")) <= 8_000_000
    assert len(open_dataset(HELDOUT).scenes("test")) == HELDOUT_HOMES
    (camera, *_) = HeldoutScenes(homes=1).load("test-00000").cameras
    picture = camera.photographs[Appearance("full")].image(512, 1024)
    assert picture.shape == (512, 1024, 3)
    assert np.std(picture) > 10


def heldout_run(**generated: Any) -> RunInfo:
    return run_info(method="oracle", generated={"generator": "heldout"} | generated)


def test_runs_name_the_homes_also_as_those_of_earlier_versions() -> None:
    assert build_dataset(heldout_run(homes=2)) == HeldoutScenes(homes=2)
    earlier = build_dataset(heldout_run(homes=2, seed=0, furniture="full"))
    assert earlier == HeldoutScenes(homes=2)
    assert earlier.scenes("test") == ["test-00000", "test-00001"]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"homes": 0}, f"homes is 0; there are {HELDOUT_HOMES}"),
        ({"homes": 61}, f"homes is 61; there are {HELDOUT_HOMES}"),
        ({"seed": 1}, "furnished ones of seed 0"),
        ({"furniture": "empty"}, "furnished ones of seed 0"),
    ],
)
def test_other_homes_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        build_dataset(heldout_run(**wrong))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--split", "validation"], "no split 'validation'"),
        (["--textures", "somewhere"], "are for --generator synth"),
        (["--furniture", "empty"], "are for --generator synth"),
        (["--data", "somewhere"], "not for --data"),
    ],
)
def test_contradictory_options_are_refused(
    options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["lab", "evaluate", "--generator", "heldout", "--method", "oracle", *options]) == 2
    assert message in capsys.readouterr().err
