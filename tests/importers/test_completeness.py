"""Tests of the trust in a plan's openings, and of its report."""

from __future__ import annotations

import json
from typing import Any

import pytest

from lalaloc_core.floorplan.opening_trust import estimate_trust
from lalaloc_core.importers import import_plan
from lalaloc_core.importers.common.plausibility import check_document

SIDE_M = 4.0


def row_of_rooms(doors: int, windows: int, kind: str = "door", rooms: int = 6) -> dict[str, Any]:
    """Return a row of rooms along a corridor, of which some have an entry and some a window."""
    step_m = SIDE_M + 0.1
    squares = [[i * step_m, i * step_m + SIDE_M] for i in range(rooms)]
    outlines = [[[x0, 0], [x1, 0], [x1, SIDE_M], [x0, SIDE_M]] for x0, x1 in squares]
    length_m = squares[-1][1]
    outlines.append([[0, SIDE_M + 0.1], [length_m, SIDE_M + 0.1], [length_m, SIDE_M + 1.5], [0, SIDE_M + 1.5]])
    openings = [{"kind": kind, "line": [[x0 + 1, 4.05], [x0 + 1.9, 4.05]]} for x0, _ in squares[:doors]]
    openings += [{"kind": "window", "line": [[x0 + 1, 0], [x0 + 2, 0]]} for x0, _ in squares[:windows]]
    types = ["living"] * rooms + ["corridor"]
    rooms_of_row = [{"polygon": outline, "type": kind} for outline, kind in zip(outlines, types, strict=True)]
    return {"ceiling_height_m": 2.5, "rooms": rooms_of_row, "openings": openings}


def trust_of(document: dict[str, Any]) -> dict[str, float]:
    return {entry.kind: entry.trust for entry in estimate_trust(document, 0.95)}


def test_plan_with_an_entry_and_a_window_in_every_room_is_trusted() -> None:
    trust = trust_of(row_of_rooms(6, 6))
    assert 0.9 <= trust["door"] < 1.0
    assert 0.9 <= trust["window"] < 1.0
    assert 0.5 <= trust["passage"] < trust["door"]


def test_trust_falls_with_the_rooms_that_no_opening_reaches() -> None:
    by_doors = [trust_of(row_of_rooms(doors, 6))["door"] for doors in (6, 4, 2, 0)]
    by_windows = [trust_of(row_of_rooms(6, windows))["window"] for windows in (6, 4, 2, 0)]
    assert by_doors == sorted(by_doors, reverse=True)
    assert by_windows == sorted(by_windows, reverse=True)
    assert by_doors[2] < 0.5
    assert by_windows[2] < 0.6
    assert by_doors[3] == 0.0
    assert by_windows[3] < 0.1


def test_passages_without_doors_are_trusted_less() -> None:
    trust = trust_of(row_of_rooms(6, 6, kind="passage"))
    assert trust["door"] == 0.0
    assert 0.4 < trust["passage"] < 0.7


@pytest.mark.parametrize(("x0", "x1", "unreached"), [(3.1, 4.1, 2), (4.0, 5.0, 1)])
def test_room_beside_whose_corner_a_door_ends_is_named(x0: float, x1: float, unreached: int) -> None:
    document = row_of_rooms(0, 0, rooms=2)
    document["openings"] = [{"kind": "door", "line": [[x0, 4.05], [x1, 4.05]]}]
    assert f"no door or passage reaches 'room {unreached}'" in check_document(document)


def test_rooms_without_an_outer_wall_need_no_window() -> None:
    document = row_of_rooms(6, 6)
    middle = {"polygon": [[4.2, -4.1], [8.0, -4.1], [8.0, -0.1], [4.2, -0.1]], "type": "living"}
    around = [[[0, -8], [12, -8], [12, -4.2], [0, -4.2]], [[0, -4.1], [4.1, -4.1], [4.1, -0.1], [0, -0.1]]]
    around.append([[8.1, -4.1], [12, -4.1], [12, -0.1], [8.1, -0.1]])
    document["rooms"] += [middle, *({"polygon": outline, "type": "corridor"} for outline in around)]
    (reason,) = [entry.reason for entry in estimate_trust(document, 0.95) if entry.kind == "window"]
    assert not reason.startswith("6 of 7")


@pytest.mark.parametrize("doors", [6, 1])
def test_import_writes_the_trust_and_reports_its_reason(doors: int) -> None:
    document = row_of_rooms(doors, 6)
    shapes = [("unit", "Polygon", [[*room["polygon"], room["polygon"][0]]]) for room in document["rooms"]]
    shapes += [(opening["kind"], "LineString", opening["line"]) for opening in document["openings"]]
    features = [
        {
            "type": "Feature",
            "properties": {"feature_type": role},
            "geometry": {"type": kind, "coordinates": coordinates},
        }
        for role, kind, coordinates in shapes
    ]
    content = json.dumps({"type": "FeatureCollection", "units": "m", "features": features}).encode()
    plan = import_plan(content)
    entry = next(entry for entry in plan.report.opening_trust if entry.kind == "door")
    assert plan.plan().opening_trust["door"] == entry.trust == plan.document["opening_trust"]["door"]
    assert entry.reason == f"{doors + 1} of 7 rooms are reached by a door or passage"
    doubts = [guess for guess in plan.report.unsure if "of doors are taken to be drawn" in guess]
    assert len(doubts) == (1 if doors < 6 else 0)
    assert all(entry.reason in doubt and "opening_trust" in doubt for doubt in doubts)
