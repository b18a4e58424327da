"""Fixtures of plan files, and the types of rooms that follow from them."""

from __future__ import annotations

import json
from typing import Any

import pytest
import shapely
from ezdxf.filemanagement import new as new_dxf

from lalaloc_core.conventions import FIXTURE_KINDS
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.plan_words import fixture_from_name
from lalaloc_core.importers import ImportOptions, import_plan
from tests.importers.conftest import dxf_file
from tests.importers.test_roomplan import _scan, _surface


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("A$C2F_WC_Wand", "toilet"), ("Badewanne 170x75", "bath"), ("bathroom", None), ("Kitchen sink", "sink"),
        ("M_Sink Vanity-Square", "sink"), ("Waschbecken", "basin"), ("lit", None), ("Doppelbett_180", "bed"),
        ("TOILETPAN", "toilet"), ("WASHHANDBASIN", "basin"), ("トイレ", "toilet"), ("kuchenka gazowa", "stove"),
        ("washing machine", "washer"), ("table", None), ("treppe EG", "stairs"), ("Bedroom", None), ("", None),
    ],
)  # fmt: skip
def test_kind_of_a_fixture_by_name(name: str, kind: str | None) -> None:
    assert fixture_from_name(name) == kind
    assert kind is None or kind in FIXTURE_KINDS


def two_rooms_dxf(*blocks: tuple[str, str, tuple[float, float], tuple[float, float]]) -> bytes:
    """Return two rooms, 4 m x 3 m, with blocks: name, layer, size and corner."""
    drawing = new_dxf("R2010")
    space = drawing.modelspace()
    for x in (0.0, 4.1):
        space.add_lwpolyline([(x, 0), (x + 4, 0), (x + 4, 3), (x, 3)], close=True, dxfattribs={"layer": "ROOM"})
    for name, layer, (width, depth), corner in blocks:
        block = drawing.blocks.get(name) or drawing.blocks.new(name)
        block.add_lwpolyline([(0, 0), (width, 0), (width, depth), (0, depth)], close=True)
        space.add_blockref(name, corner, dxfattribs={"layer": layer})
    return dxf_file(drawing)


def kinds_and_types(document: dict[str, Any]) -> tuple[list[str], list[str | None]]:
    kinds = sorted(fixture["kind"] for fixture in document.get("fixtures", []))
    rooms = sorted(document["rooms"], key=lambda room: min(x for x, _ in room["polygon"]))
    return kinds, [room.get("type") for room in rooms]


def test_blocks_of_a_dxf_become_fixtures_and_type_their_rooms() -> None:
    toilet = ("WC_Stand", "SANITAR", (0.4, 0.6), (0.2, 0.2))
    plan = import_plan(two_rooms_dxf(toilet, ("Bett_180", "MOEBEL", (1.8, 2.0), (5.0, 0.5))))
    assert kinds_and_types(plan.document) == (["bed", "toilet"], ["bathroom", "bedroom"])
    toilet = next(fixture for fixture in plan.document["fixtures"] if fixture["kind"] == "toilet")
    assert shapely.Polygon(toilet["outline"]).bounds == pytest.approx((0.2, 0.2, 0.6, 0.8))
    assert any("bathroom (toilet)" in guess for guess in plan.report.unsure)
    assert [(use.layer, use.used_as) for use in plan.report.layers if "fixtures" in use.used_as] == [
        ("MOEBEL", "fixtures: bed"), ("SANITAR", "fixtures: toilet"),
    ]  # fmt: skip


def test_fixtures_of_several_uses_give_several_types() -> None:
    content = two_rooms_dxf(("Stove", "F", (0.6, 0.6), (0.2, 0.2)), ("Bed", "F", (1.6, 2.0), (2.0, 0.5)))
    rooms = import_plan(content).document["rooms"]
    assert [room["types"] for room in rooms if "types" in room] == [["bedroom", "kitchen"]]


def test_fixtures_of_unusual_size_are_left_out_with_a_note() -> None:
    plan = import_plan(two_rooms_dxf(("WC", "SANITAR", (3.5, 2.5), (0.2, 0.2))))
    assert kinds_and_types(plan.document) == ([], [None, None])
    assert any("toilet of 3.50 m (usual: 0.3 to 1.2 m)" in note for note in plan.report.notes)


def test_groups_of_an_svg_become_fixtures() -> None:
    content = """<svg xmlns="http://www.w3.org/2000/svg" data-metres-per-unit="0.01">
      <g class="Space"><polygon id="Kitchen" points="0,0 400,0 400,300 0,300"/></g>
      <g class="Space"><polygon points="410,0 800,0 800,300 410,300"/></g>
      <g class="FixedFurniture Toilet" transform="translate(600,20)"><path d="M0,0h40v60h-40z"/><circle cx="20" cy="30" r="9"/></g>
      <g id="furniture"><rect id="bath_1" x="420" y="200" width="170" height="75"/><rect x="500" y="10" width="9" height="9"/></g>
      <g id="furniture2"><g id="furniture toilet in kitchen"><rect x="10" y="10" width="40" height="60"/></g></g>
    </svg>"""  # noqa: E501
    plan = import_plan(content.encode())
    assert kinds_and_types(plan.document) == (["bath", "toilet", "toilet"], ["kitchen", "bathroom"])
    bath = next(fixture for fixture in plan.document["fixtures"] if fixture["kind"] == "bath")
    assert shapely.Polygon(bath["outline"]).bounds == pytest.approx((4.2, -2.75, 5.9, -2.0))


def test_objects_of_a_roomplan_scan_become_fixtures() -> None:
    scan = _scan()
    box = _surface((6.0, 1.0), (7.0, 1.0), -1.4, -0.9)
    scan["objects"] = [
        {**box, "dimensions": [0.4, 0.8, 0.7], "category": {"toilet": {}}},
        {**box, "dimensions": [0.5, 0.8, 0.5], "category": {"chair": {}}},
    ]
    plan = import_plan(json.dumps(scan).encode())
    (fixture,) = plan.document["fixtures"]
    assert fixture["kind"] == "toilet"
    assert shapely.Polygon(fixture["outline"]).area == pytest.approx(0.28, abs=1e-3)
    assert [room["type"] for room in plan.document["rooms"] if "type" in room] in (
        ["living", "bathroom"], ["bathroom", "living"],
    )  # fmt: skip
    assert any(use.layer == "objects: chair" and use.used_as == "ignored" for use in plan.report.layers)


def test_features_of_equipment_become_fixtures() -> None:
    def feature(kind: str, box: tuple[float, float, float, float], **properties: str) -> dict[str, Any]:
        shape = shapely.geometry.mapping(shapely.box(*box))
        return {"type": "Feature", "properties": {"feature_type": kind, **properties}, "geometry": shape}

    features = [feature("unit", (0, 0, 4, 3)), feature("fixture", (1, 1, 1.6, 1.6), category="stove")]
    features.append(feature("fixture", (2, 1, 2.5, 2), category="counter"))
    content = json.dumps({"type": "FeatureCollection", "units": "m", "features": features})
    document = import_plan(content.encode()).document
    assert kinds_and_types(document) == (["stove"], ["kitchen"])
    assert len(document["rooms"][0]["holes"]) == 1


def test_plan_keeps_its_fixtures_in_every_unit() -> None:
    room = {"name": "hall", "polygon": [[0, 0], [400, 0], [400, 300], [0, 300]]}
    outline = [[10, 10], [50, 10], [50, 70], [10, 70]]
    document = {"units": "cm", "ceiling_height_m": 2.5, "rooms": [room]}
    plan = import_plan(json.dumps(document | {"fixtures": [{"kind": "toilet", "outline": outline}]}).encode()).plan()
    (fixture,) = FloorPlan.from_dict(plan.to_dict()).fixtures
    assert fixture.kind == "toilet"
    assert fixture.outline_m.max() == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("fixture", "fault"),
    [
        ({"kind": "piano", "outline": [[0, 0], [1, 0], [1, 1]]}, "piano"),
        ({"kind": "bed", "outline": [[0, 0], [1, 0]]}, "2 vertices"),
        ({"kind": "bed", "outline": [[0, 0], [1, 1], [1, 0], [0, 1]]}, "crosses itself"),
        ({"kind": "bed"}, "outline"), ("bed", "fixture 0"),
        ({"kind": "bed", "outline": [[0, 0], [1, 0], [1]]}, "vertex 2"),
    ],
)  # fmt: skip
def test_invalid_fixture_is_rejected(fixture: Any, fault: str) -> None:
    room = {"name": "hall", "polygon": [[0, 0], [4, 0], [4, 3], [0, 3]], "ceiling_height_m": 2.5}
    with pytest.raises(InvalidFloorPlanError, match=fault):
        FloorPlan.from_dict({"rooms": [room], "fixtures": [fixture]})


def test_option_layers_selects_fixtures() -> None:
    content = two_rooms_dxf(("WC", "SANITAR", (0.4, 0.6), (0.2, 0.2)))
    assert "fixtures" not in import_plan(content, ImportOptions(layers=("ROOM",))).document
