"""Example flat, its spheres, and the demo."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from benchmarks.pairs import grown_stages, stage_ratios
from examples.demo import StageMissingError, check_localisation
from examples.make_examples import HEIGHT, PHONE, TURN_DEG, VIEWS, WIDTH, example_home, true_pose
from examples.truth import FOLDER, PLAN_PATH, read_poses
from lalaloc_client import Candidate, Localisation, Model, Position
from lalaloc_core.floorplan import FloorPlan

ROOT = Path(__file__).parents[1]
PLAN = FloorPlan.from_json(PLAN_PATH.read_bytes())


def test_flat_has_a_usual_size_no_warnings_and_walls_between_its_rooms() -> None:
    assert PLAN.warnings == ()
    assert 60.0 < PLAN.area_m2 < 100.0
    assert all(room.type != "unknown" for room in PLAN.rooms)
    for index, room in enumerate(PLAN.rooms):
        gaps = [room.shape.distance(neighbour.shape) for neighbour in PLAN.rooms if neighbour is not room]
        assert min(gaps) == pytest.approx(0.12), PLAN.rooms[index].name


def test_every_picture_has_its_rendered_pose_in_its_room() -> None:
    poses = read_poses()
    assert poses == [true_pose(PLAN, view) for view in VIEWS]
    pictures = {path.name for path in FOLDER.glob("*.jpg")} - {PHONE.file, *TURN_DEG}
    assert sorted(pose.file for pose in poses) == sorted(pictures)
    for pose in poses:
        (room,) = PLAN.room_index_at(np.array([[pose.x_m, pose.y_m]]))
        assert PLAN.rooms[room].name == pose.room
        with Image.open(pose.picture) as picture:
            assert picture.size == (WIDTH, HEIGHT)


def test_doors_join_two_rooms_and_windows_face_outside() -> None:
    openings = example_home().openings
    sides = {(opening.room, opening.neighbour, opening.kind) for opening in openings}
    for opening in openings:
        assert opening.end_m - opening.start_m > 0.5
        if opening.kind == "window":
            assert opening.neighbour == -1
        elif opening.neighbour >= 0:
            assert (opening.neighbour, opening.room, opening.kind) in sides
    # Both sides of the two doors that stand open.
    assert sum(opening.kind == "door_open" for opening in openings) == 4


def _localisation(**changes: Any) -> Localisation:
    position = Position(1.0, 2.0)
    localisation = Localisation(
        floorplan_id="p",
        position=position,
        heading_deg=0.0,
        room="hall",
        confidence=None,
        stage="lpo",
        covariance_m2=None,
        heading_std_deg=None,
        cost=0.1,
        latent_distance=0.1,
        camera_height_m=1.5,
        candidates=(Candidate(position, 0.0, "hall", 0.1, 0.1),),
        timings_ms={"total": 1.0},
        model=Model("m", "1", "0"),
    )
    return dataclasses.replace(localisation, **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stage": "vdr"}, "'vdr'"),
        ({"candidates": ()}, "no candidates"),
        ({"position": Position(float("nan"), 0.0)}, r"localisation\.position\.x_m"),
    ],
)
def test_incomplete_localisation_is_rejected(changes: dict[str, Any], message: str) -> None:
    check_localisation(_localisation())
    with pytest.raises(StageMissingError, match=message):
        check_localisation(_localisation(**changes))


@pytest.mark.slow
def test_demo_runs_every_stage(tiny_bundle: Path, tmp_path: Path) -> None:
    out = tmp_path / "demo.png"
    environment = {**os.environ, "LALALOC_BUNDLE": str(tiny_bundle)}
    command = [sys.executable, "-m", "examples.demo", "--out", str(out)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(".jpg") == 2 * len(VIEWS)
    with Image.open(out) as picture:
        assert picture.width > 1000


def test_stages_that_grew_since_a_release_are_named() -> None:
    stored = {"a: decode": 1.0, "a: encode": 2.0}
    assert grown_stages({"a: decode": 1.19, "a: encode": 3.0, "a: next_step": 9.0}, stored) == [
        "stage a: encode takes 50% longer"
    ]


@pytest.mark.slow
def test_stages_of_the_last_release_are_measured() -> None:
    *_, release = json.loads((ROOT / "docs/pairs.json").read_text()).values()
    assert stage_ratios(ROOT, rounds=2).keys() >= release["stages"].keys()
