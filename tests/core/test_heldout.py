"""Out-of-distribution homes: sixty frozen ones that the reader of data sets reads, and the runs that name them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from lalaloc_core.cli import main
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.evaluate.runs.factories import build_dataset
from lalaloc_core.evaluate.runs.predictions import RunInfo
from lalaloc_core.learn.data.dataset import Appearance, Dataset
from lalaloc_core.learn.data.dataset_detection import open_dataset
from lalaloc_core.learn.data.folder import HeldoutScenes
from lalaloc_core.learn.dataset_names import HELDOUT_HOMES
from tests.core.questions import run_info

FOLDER = Path(__file__).parents[2] / "datasets" / "heldout"


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
    assert sum(path.stat().st_size for path in FOLDER.rglob("*")) <= 8_000_000
    assert len(open_dataset(FOLDER).scenes("test")) == HELDOUT_HOMES
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
