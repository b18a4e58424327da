"""`lalaloc_core.LaLaLoc` and `read_plan`, with the shipped model and the example flat."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageDraw

import lalaloc_core
from lalaloc_core import LaLaLoc, Odometry, StatedCamera, read_plan
from lalaloc_core.errors import InvalidFloorPlanError, InvalidInputError, InvalidPhotographError, InvalidPoseError
from lalaloc_core.importers import import_plan
from lalaloc_core.localise.answers.documents import Position
from lalaloc_core.localise.answers.pinned import read_pins
from tests.core.filmed import encode, needs_ffmpeg, turn
from tests.core.taken import EXAMPLES, jpeg

KITCHEN = EXAMPLES / "kitchen.jpg"
TRUTH = {pose["file"]: pose for pose in json.loads((EXAMPLES / "poses.json").read_text())}
PHONE = StatedCamera(hfov_deg=53.0)


@pytest.fixture(scope="module")
def model() -> LaLaLoc:
    return LaLaLoc()


@pytest.fixture(scope="module")
def plan() -> lalaloc_core.FloorPlan:
    return read_plan(EXAMPLES / "flat.json")


def off_m(position: Position, file: str) -> float:
    return math.hypot(position.x_m - TRUTH[file]["x_m"], position.y_m - TRUTH[file]["y_m"])


@pytest.mark.parametrize(
    "given",
    [str, Path, Path.read_bytes, Image.open, lambda path: np.asarray(Image.open(path))],
    ids=["text", "path", "bytes", "picture", "array"],
)
def test_photographs_go_in_as_they_are(
    model: LaLaLoc, plan: lalaloc_core.FloorPlan, given: Callable[[Path], object]
) -> None:
    answer = model.localise(plan, given(KITCHEN))  # type: ignore[arg-type]
    assert off_m(answer.position, "kitchen.jpg") < 0.1
    assert (answer.room, answer.heading_source, answer.stage) == ("kitchen", "searched", "lpo")
    assert (answer.confidence or 0.0) > 0.99


def test_answer_is_plain_data(model: LaLaLoc, plan: lalaloc_core.FloorPlan) -> None:
    answer = model.localise(plan, KITCHEN, heading_deg=250.0, camera_height_m=1.5)
    document = json.loads(json.dumps(answer.document()))
    assert document["position"] == {"x_m": answer.position.x_m, "y_m": answer.position.y_m}
    assert document["heading_source"] == "given"
    assert document["candidates"][0]["room_id"] == answer.room_id
    assert document["view"]["projection"] == "equirectangular"
    assert "evidence" not in document


def test_plans_go_in_as_they_are(model: LaLaLoc, tmp_path: Path) -> None:
    file = EXAMPLES / "flat.json"
    plans = [str(file), file, file.read_bytes(), import_plan(file.read_bytes())]
    assert {model.localise(plan, KITCHEN).room for plan in plans} == {"kitchen"}
    assert read_plan(file).name == read_plan(file.read_bytes()).name
    picture = Image.new("RGB", (1200, 800), "white")
    for box in ((50, 50, 610, 750), (590, 50, 1150, 750)):
        ImageDraw.Draw(picture).rectangle(box, outline="black", width=20)
    assert len(read_plan(picture, metres_per_pixel=0.01).rooms) == 2
    assert len(read_plan(np.asarray(picture), metres_per_pixel=0.01).rooms) == 2
    with pytest.raises(InvalidFloorPlanError, match="cannot be read"):
        read_plan(tmp_path / "gone.dxf")


def test_errors_name_the_photograph_and_the_height(
    model: LaLaLoc, plan: lalaloc_core.FloorPlan, tmp_path: Path
) -> None:
    with pytest.raises(InvalidPhotographError, match=r"flat.json': the photograph is"):
        model.localise(plan, EXAMPLES / "flat.json")
    with pytest.raises(InvalidPhotographError, match=r"gone.jpg' cannot be read"):
        model.localise(plan, tmp_path / "gone.jpg")
    with pytest.raises(InvalidPoseError, match=r"camera_height_m is 3; it must be at least 0.1"):
        model.localise(plan, KITCHEN, camera_height_m=3.0)


def test_contradicted_heading_is_searched(model: LaLaLoc, plan: lalaloc_core.FloorPlan) -> None:
    answer = model.localise(plan, KITCHEN, heading_deg=30.0)
    assert answer.heading_source == "searched"
    assert answer.warnings[0].startswith("heading_deg is 30, which the photograph contradicts")


def test_photographs_of_a_turn_are_one_answer(model: LaLaLoc, plan: lalaloc_core.FloorPlan) -> None:
    answer = model.localise_turn(plan, [jpeg(frame) for frame in turn()[:48:4]], camera=PHONE)
    assert off_m(answer.position, "living_room.jpg") < 0.5
    assert len(answer.poses) == 12
    angles = [pose.view.relative_heading.value_deg % 360.0 for pose in answer.poses if pose.view.relative_heading]
    assert angles == pytest.approx([24.0 * index for index in range(12)], abs=2.0)
    assert [pose["view"]["next_step"] for pose in answer.document()["poses"][1:]] == [None] * 11
    with pytest.raises(InvalidInputError, match="the turn has 1 photographs; a turn has 2 to 100"):
        model.localise_turn(plan, [KITCHEN])


@pytest.mark.slow
@needs_ffmpeg
def test_film_is_a_turn(model: LaLaLoc, plan: lalaloc_core.FloorPlan, tmp_path: Path) -> None:
    answer = model.localise_turn(plan, encode(turn()[:46], tmp_path / "turn.mp4"), camera=PHONE)
    assert answer.film is not None
    assert answer.film.frames_read == 46
    assert [pose["time_s"] for pose in answer.document()["poses"]] == answer.times_s


def test_folder_is_pinned_together(model: LaLaLoc, plan: lalaloc_core.FloorPlan, tmp_path: Path) -> None:
    for name in ("kitchen", "bedroom"):
        shutil.copy(EXAMPLES / f"{name}.jpg", tmp_path)
    shutil.copy(KITCHEN, tmp_path / "copy.jpg")
    (tmp_path / "broken.jpg").write_bytes(b"no picture")
    done: list[tuple[str, int, int]] = []
    pinned = model.pin(plan, tmp_path, progress=lambda *step: done.append(step))
    rooms = {photograph.name: photograph.pin and photograph.pin.pose for photograph in pinned.photographs}
    assert rooms["broken.jpg"] is None
    found = {name: pose.room for name, pose in rooms.items() if pose}
    assert found == {"bedroom.jpg": "bedroom", "copy.jpg": "kitchen", "kitchen.jpg": "kitchen"}
    notes = [note.partition(":")[0] for note in pinned.notes]
    assert notes[:2] == ["'broken.jpg' is set aside", "copies of other files, which have the same pin"]
    assert ("read", 4, 4) in done
    assert ("pin", 2, 2) in done
    document = pinned.document()
    assert document["counts"]["set_aside"] == 1
    (tmp_path / "pins.json").write_text(json.dumps(document))
    assert pinned.moved_since(read_pins(tmp_path / "pins.json")) == [
        "no pin moved by more than 0.5 m or changed its room"
    ]


def test_camera_is_tracked(model: LaLaLoc, plan: lalaloc_core.FloorPlan) -> None:
    track = model.track(plan)
    first = track.add(KITCHEN)
    with pytest.raises(InvalidPhotographError):
        track.add(b"no picture")
    second = track.add(KITCHEN, Odometry.of_stds(0.0, 0.0, 0.0, (0.02, 0.02, 0.02)))
    found = [(answer.number, answer.room, answer.mode) for answer in track.answers]
    assert found == [(1, "kitchen", "tracking"), (2, "kitchen", "tracking")]
    assert off_m(second.position, "kitchen.jpg") < 0.1
    assert second.probability >= first.probability - 0.01
    assert json.loads(json.dumps(track.document()))[1]["motion_contradicted"] == []


def test_import_is_cheap_and_names_are_loaded_when_used() -> None:
    code = (
        "import sys, lalaloc_core; print(sorted({'numpy', 'onnxruntime', 'torch', 'PIL'} & sys.modules.keys())); "
        "lalaloc_core.LaLaLoc; print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:2] == ["[]", "False"]
    assert all(getattr(lalaloc_core, name) for name in lalaloc_core.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Localiser'"):
        lalaloc_core.Localiser  # noqa: B018
