"""Homes of Sweet Home 3D, and files of other programs that are named in errors."""

from __future__ import annotations

import json
import math

import pytest

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers import ImportOptions, import_plan, import_plans
from lalaloc_core.importers.common.import_limits import ImportLimits
from tests.importers.conftest import lines, shapes, zip_file


def wall(x0: float, y0: float, x1: float, y1: float, **more: object) -> str:
    extra = " ".join(f"{key}='{value}'" for key, value in more.items())
    return f"<wall xStart='{x0}' yStart='{y0}' xEnd='{x1}' yEnd='{y1}' height='250' thickness='20' {extra}/>"


def piece(tag: str, name: str, x: float, y: float, width: float, depth: float, **more: object) -> str:
    extra = " ".join(f"{key}='{value}'" for key, value in more.items())
    return f"<{tag} name='{name}' x='{x}' y='{y}' width='{width}' depth='{depth}' height='210' {extra}/>"


WALLS = [wall(0, 0, 800, 0), wall(800, 0, 800, 400), wall(800, 400, 0, 400), wall(0, 400, 0, 0), wall(400, 0, 400, 400)]
HOME = [
    *WALLS,
    "<room name='Bad'><point x='20' y='20'/><point x='380' y='20'/><point x='380' y='380'/>",
    "<point x='20' y='380'/></room>",
    piece("doorOrWindow", "Tür", 400, 200, 90, 25, angle=math.pi / 2, catalogId="eTeks#door"),
    piece("doorOrWindow", "x", 600, 0, 120, 25, elevation=90, catalogId="y"),
    "<furnitureGroup name='g' x='0' y='0' width='1' depth='1' height='1'>",
    piece("pieceOfFurniture", "Toilet", 60, 60, 40, 70, angle=0, catalogId="eTeks#toiletUnit"),
    piece("pieceOfFurniture", "Doppelbett", 600, 250, 180, 200),
    "</furnitureGroup>",
    piece("pieceOfFurniture", "Piano", 500, 100, 150, 60),
]  # fmt: skip


def home(parts: list[str]) -> bytes:
    xml = f"<?xml version='1.0'?><home version='7000' name='Flat' wallHeight='260'>{''.join(parts)}</home>"
    models = {f"{index}/model.obj": b"v 0 0 0" for index in range(400)}
    return zip_file({"Home": b"\xac\xed\x00\x05", "Home.xml": xml} | models)


def test_home_becomes_rooms_openings_and_fixtures() -> None:
    plan = import_plan(home(HOME))
    assert plan.report.format == "sweethome3d"
    assert plan.document["ceiling_height_m"] == pytest.approx(2.6)
    assert sorted(room.area for room in shapes(plan.document)) == pytest.approx([14.44, 14.44])
    rooms = sorted(plan.document["rooms"], key=lambda room: min(x for x, _ in room["polygon"]))
    assert [(room.get("name"), room["type"]) for room in rooms] == [("Bad", "bathroom"), (None, "bedroom")]
    (door,), (window,) = lines(plan.document, "door"), lines(plan.document, "window")
    assert sorted(door.coords) == [pytest.approx((4.0, -2.45)), pytest.approx((4.0, -1.55))]
    assert window.length == pytest.approx(1.2)
    assert sorted(fixture["kind"] for fixture in plan.document["fixtures"]) == ["bed", "toilet"]
    assert any(use.used_as == "ignored" and use.layer == "pieceOfFurniture" for use in plan.report.layers)


def test_levels_of_a_home_are_plans() -> None:
    level = "<level id='{0}' name='{0}' elevation='{1}' floorThickness='12' height='250'/>"
    walls = [wall.replace("/>", f" level='{key}'/>") for key in ("EG", "OG") for wall in WALLS]
    plans = import_plans(home([level.format("EG", 0), level.format("OG", 262), *walls]))
    assert [plan.level.name for plan in plans if plan.level] == ["EG", "OG"]
    assert len(import_plan(home([level.format("EG", 0), *walls[:5]]), ImportOptions(level="EG")).document["rooms"]) == 2


def test_drawn_rooms_without_walls_and_round_walls_are_read() -> None:
    outline = "".join(f"<point x='{x}' y='{y}'/>" for x, y in ((0, 0), (500, 0), (500, 300), (0, 300)))
    (room,) = shapes(import_plan(home([f"<room name='Office'>{outline}</room>"])).document)
    assert room.area == pytest.approx(15.0)
    half_circle = [wall(0, 0, 0, 400, arcExtent=math.pi), wall(0, 0, 0, 400)]
    (room,) = shapes(import_plan(home(half_circle)).document)
    assert room.area == pytest.approx(0.5 * math.pi * 1.9**2 - 0.1 * 3.8, rel=0.01)


def test_home_without_xml_or_rooms_is_rejected() -> None:
    with pytest.raises(InvalidFloorPlanError, match=r"5\.3 or later"):
        import_plan(zip_file({"Home": b"\xac\xed"}))
    with pytest.raises(InvalidFloorPlanError, match="no walls and no rooms"):
        import_plan(home([]))


def test_bomb_of_a_home_is_bounded() -> None:
    bomb = home([f"<!--{' ' * 3_000_000}-->", *HOME])
    assert len(bomb) < 100_000
    with pytest.raises(InvalidFloorPlanError, match="max_unpacked_bytes"):
        import_plan(bomb, limits=ImportLimits(max_unpacked_bytes=1_000_000))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (json.dumps({"type": "CityJSON", "version": "1.1", "CityObjects": {}, "vertices": []}).encode(), "CityJSON"),
        (json.dumps({"id": 1, "name": "x", "floors": [{"designs": [{"walls": []}]}]}).encode(), "Floorplanner"),
        (json.dumps({"asset": {"version": "2.0"}, "meshes": []}).encode(), "glTF"),
        (b"glTF\x02\x00\x00\x00", "glTF"),
        (b"#usda 1.0\n", "USD model"),
        (b"<?xml version='1.0'?><core:CityModel xmlns:core='x'/>", "CityGML"),
        (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(100), "Revit"),
    ],
)
def test_files_of_other_programs_are_named(content: bytes, words: str) -> None:
    with pytest.raises(InvalidFloorPlanError, match=words):
        import_plan(content)


def test_usdz_says_how_to_export_json() -> None:
    with pytest.raises(InvalidFloorPlanError, match=r"USDZ.*CapturedRoom.*JSON"):
        import_plan(zip_file({"Room.usdc": b"PXR-USDC"}))
