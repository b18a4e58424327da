"""Openings of data sets: round trips, and warnings about unreadable ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.drawn_openings import DrawnOpening, opening_entries
from lalaloc_core.learn.data.structured3d_annotation import read_annotation
from lalaloc_core.learn.data.structured3d_writer import build_annotation
from lalaloc_core.learn.data.zind import Zind
from lalaloc_core.learn.synth.homes.plans import generate_home
from tests.strategies import crooked_flat
from tests.zind_home import FLOOR, PANORAMAS, write_home


def faces_of(plan: FloorPlan) -> list[tuple[int, int, int, str]]:
    """Return the positions of openings; passages count as doors, because Structured3D has no passages."""
    kinds = {"passage": "door"}
    return sorted(
        (face.room, face.wall, face.behind, kinds.get(kind := plan.openings[face.opening].kind, kind))
        for face in plan.opening_faces
    )


@pytest.mark.parametrize("seed", [0, 4, 9])
def test_structured3d_openings_round_trip(seed: int, tmp_path: Path) -> None:
    home = generate_home(np.random.default_rng(seed))
    path = tmp_path / "annotation_3d.json"
    path.write_text(json.dumps(build_annotation(home.plan, home.openings)))
    plan = read_annotation(path, "scene").plan
    assert faces_of(plan) == faces_of(home.plan)
    assert plan.opening_kinds == {"door", "window"}
    assert plan.warnings == ()
    assert [room.type for room in plan.rooms if room.type != "storage"] == [
        room.type for room in home.plan.rooms if room.type not in ("storage", "closet")
    ]
    heights = sorted((round(o.sill_m or 0.0, 6), round(o.head_m or 0.0, 6)) for o in plan.openings)
    assert heights == sorted((round(o.sill_m or 0.0, 6), round(o.head_m or 0.0, 6)) for o in home.plan.openings)


def test_unreadable_door_is_a_warning(tmp_path: Path) -> None:
    home = generate_home(np.random.default_rng(0))
    annotation = build_annotation(home.plan, home.openings)
    doors = [semantic for semantic in annotation["semantics"] if semantic["type"] == "door"]
    doors[0]["planeID"] = [10**6]
    doors[1]["planeID"] = []
    path = tmp_path / "annotation_3d.json"
    path.write_text(json.dumps(annotation))
    plan = read_annotation(path, "scene").plan
    assert len(plan.rooms) == len(home.plan.rooms)
    assert len(plan.openings) == len(home.plan.openings) - 2
    assert f"door {doors[0]['ID']} is left out: 'planeLineMatrix' has no entry 1000000" in plan.warnings[0]
    assert f"door {doors[1]['ID']} is left out: it has 0 corners" in plan.warnings[1]


@pytest.fixture
def zind(tmp_path: Path) -> Path:
    """Write a ZInD home with a door between two rooms, drawn in both, and a window in the first."""
    write_home(tmp_path / "0000", crooked_flat(), PANORAMAS, np.random.default_rng(0))
    path = tmp_path / "0000" / "zind_data.json"
    document = json.loads(path.read_text())
    merger = document["merger"][FLOOR]

    def between(room: int, wall: int, begin: float, end: float) -> list[list[float]]:
        """Return a piece of a room's wall in the frame of the room's panorama."""
        (partial,) = merger[f"complete_room_{room + 1:02d}"].values()
        layout = next(iter(partial.values()))["layout_complete"]
        start, stop = (np.array(layout["vertices"][(wall + k) % len(layout["vertices"])]) for k in (0, 1))
        return [(start + share * (stop - start)).tolist() for share in (begin, end)]

    def layout_of(room: int) -> dict[str, list]:
        (partial,) = merger[f"complete_room_{room + 1:02d}"].values()
        return next(iter(partial.values()))["layout_complete"]

    # The right wall of the first room is 2.2 m long, the left wall of the second 2.5 m, both from y = 0.
    layout_of(0)["doors"] = [*between(0, 1, 0.5 / 2.2, 1.4 / 2.2), [-1.0, 0.35]]
    layout_of(1)["doors"] = [*between(1, 3, 1.1 / 2.5, 2.0 / 2.5), [-1.0, 0.35]]
    layout_of(0)["windows"] = [*between(0, 0, 0.2, 0.5), [-0.4, 0.4]]
    path.write_text(json.dumps(document))
    return tmp_path


def test_zind_openings_are_in_the_plan_once(zind: Path) -> None:
    plan = Zind(zind).load(f"0000/{FLOOR}").plan
    assert [opening.kind for opening in plan.openings] == ["door", "window"]
    assert sorted((face.room, face.wall, face.behind) for face in plan.opening_faces) == [
        (0, 0, -1),
        (0, 1, 1),
        (1, 3, 0),
    ]
    np.testing.assert_allclose(np.sort(plan.openings[0].line_m[:, 1]), [0.5, 1.4], atol=1e-9)
    assert plan.openings[1].sill_m == pytest.approx(0.9)
    assert plan.openings[1].head_m == pytest.approx(2.1)
    assert plan.opening_kinds == {"door", "window", "passage"}
    assert plan.warnings == ()


def test_damaged_zind_lists_are_warnings(zind: Path) -> None:
    path = zind / "0000" / "zind_data.json"
    document = json.loads(path.read_text())
    (partial,) = document["merger"][FLOOR]["complete_room_01"].values()
    layout = next(iter(partial.values()))["layout_complete"]
    layout["doors"], layout["windows"] = [[0, 0]], [[0, 0], [1, "x"], [0, 1]]
    path.write_text(json.dumps(document))
    plan = Zind(zind).load(f"0000/{FLOOR}").plan
    assert [opening.kind for opening in plan.openings] == ["door"]
    assert any("'doors' is left out; it is not a list of triples" in warning for warning in plan.warnings)
    assert any("an entry of 'windows' is left out" in warning for warning in plan.warnings)


def test_first_of_overlapping_openings_is_kept() -> None:
    def drawn(y0: float, y1: float, x: float = 0.0) -> DrawnOpening:
        return DrawnOpening(kind="door", line_m=np.array([[x, y0], [x, y1]]))

    entries, warnings = opening_entries([drawn(0, 1), drawn(0.1, 0.9, 0.2), drawn(0.8, 2), drawn(3, 3.01)], {})
    assert [entry["line"] for entry in entries] == [[[0.0, 0.0], [0.0, 1.0]]]
    assert [warning.split(" is left out")[1][:20] for warning in warnings] == [
        ": it overlaps anothe",
        ": the minimum is 0.0",
    ]
