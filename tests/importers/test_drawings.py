"""SVG and DXF drawings of real tools: classes of CubiCasa, walls only, blocks, layers in three languages."""

from __future__ import annotations

import io
import math
from itertools import pairwise
from typing import Any

import pytest
from ezdxf.filemanagement import new as new_dxf

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.plan_words import role_from_name, room_types_from_reading
from lalaloc_core.importers import ImportOptions, import_plan
from lalaloc_core.importers.common.import_limits import Budget
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.drawing.drawing_scale import scale_by_dimensions
from lalaloc_core.importers.drawing.vector_drawing import joined
from lalaloc_core.importers.formats import dxf
from tests.importers.conftest import dxf_file, lines, names_and_types, shapes

CUBICASA = b"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1000 600"><g id="Model"><g class="Floor">
<g id="Wall" class="Wall External"><polygon points="0,0 1000,0 1000,20 0,20"/>
  <g id="Window" class="Window Regular"><polygon points="100,0 250,0 250,20 100,20"/></g></g>
<g id="Wall" class="Wall"><polygon points="490,20 500,20 500,580 490,580"/>
  <g id="Door" class="Door Swing Beside"><polygon points="490,200 500,200 500,290 490,290"/>
    <g id="Panel"><path d="M490,200 L400,200 A90,90 0 0 0 490,290"/></g></g></g>
<g id="Space" class="Space Bedroom"><polygon points="20,20 490,20 490,580 20,580"/>
  <g class="SpaceDimensionsLabel"><text x="200" y="320">4.7 m x 5.6 m</text></g></g>
<g id="Space" class="Space LivingRoom"><polygon points="500,20 980,20 980,580 500,580"/></g>
<g class="FixedFurniture BaseCabinet"><polygon points="900,20 980,20 980,100 900,100"/></g></g></g></svg>"""

WALLS = b"""<svg xmlns="http://www.w3.org/2000/svg" width="210mm" height="100mm" viewBox="0 0 210 100">
<text x="5" y="95">Scale 1:100</text><g transform="translate(5 5) scale(.5)"><g id="walls" fill="none" stroke="black">
<path d="M10,10 h200 v120 h-200 z M14,14 h92 v40 h4 v-40 h96 v112 h-96 v-52 h-4 v52 h-92 z"/></g>
<path fill="none" stroke="black" d="M110,54 h20 A20,20 0 0 1 110,74"/>
<text x="50" y="80">Schlafzimmer</text><text x="160" y="80">Kitchen</text></g></svg>"""


def test_cubicasa_classes_give_rooms_and_openings():
    plan = import_plan(CUBICASA, ImportOptions(metres_per_pixel=0.01))
    assert [room["type"] for room in plan.document["rooms"]] == ["bedroom", "living"]
    assert [room.area for room in shapes(plan.document)] == pytest.approx([26.32, 26.88])
    (door,), (window,) = lines(plan.document, "door"), lines(plan.document, "window")
    # The door lies midway in its wall, the window on the inner face of the outer wall; y points up.
    assert sorted(door.coords) == [(4.95, -2.9), (4.95, -2.0)]
    assert sorted(window.coords) == [(1.0, -0.2), (2.5, -0.2)]
    used = {(use.layer, use.used_as) for use in plan.report.layers}
    assert ("FixedFurniture BaseCabinet", "ignored") in used


def test_svg_walls_enclose_rooms_and_swing_is_a_door():
    plan = import_plan(WALLS)
    assert plan.report.scale_source == "1:100, written in the drawing"
    assert sorted(names_and_types(plan)) == [("Kitchen", "kitchen"), ("Schlafzimmer", "bedroom")]
    assert sorted(room.area for room in shapes(plan.document)) == pytest.approx([4.6 * 5.6, 4.8 * 5.6], rel=1e-3)
    (door,) = lines(plan.document, "door")
    assert door.length == pytest.approx(1.0, abs=0.01)


def test_svg_without_scale_is_rejected():
    with pytest.raises(InvalidFloorPlanError, match=r"set scale \(1:100\), metres_per_pixel .* or known_distance"):
        import_plan(CUBICASA)


def test_layers_option_selects_layers():
    plan = import_plan(CUBICASA, ImportOptions(metres_per_pixel=0.01, layers=("space bedroom",)))
    assert len(plan.document["rooms"]) == 1
    assert "openings" not in plan.document


def _german_walls(insunits: int = 4):
    """Draw both faces of walls in millimetres, a door with its swing, and a window of three lines."""
    document = new_dxf(units=insunits)
    space = document.modelspace()
    faces = [
        [(0, 0), (10000, 0), (10000, 6000), (0, 6000), (0, 0)],
        [(2000, 0), (2000, 300), (300, 300), (300, 5700), (5000, 5700), (5000, 1900), (5100, 1900), (5100, 5700),
         (9700, 5700), (9700, 300), (5100, 300), (5100, 1000), (5000, 1000), (5000, 300), (3500, 300), (3500, 0)],
    ]  # fmt: skip
    for face in faces:
        for start, end in pairwise(face):
            space.add_line(start, end, dxfattribs={"layer": "WAND"})
    for y in (0, 150, 300):
        space.add_line((2000, y), (3500, y), dxfattribs={"layer": "Fenster"})
    space.add_arc((5000, 1000), 900, 90, 180, dxfattribs={"layer": "TÜREN"})
    space.add_line((5000, 1000), (4100, 1000), dxfattribs={"layer": "TÜREN"})
    space.add_text("Küche", dxfattribs={"layer": "TEXT"}).set_placement((2000, 3000))
    space.add_mtext("Wohnen\\P24.5 m²", dxfattribs={"layer": "TEXT", "insert": (7000, 3000)})
    space.add_lwpolyline([(8000, 3000), (9000, 3000), (9000, 4000)], close=True, dxfattribs={"layer": "MÖBEL"})
    return document


def test_german_wall_lines_become_rooms():
    plan = import_plan(dxf_file(_german_walls()))
    assert sorted(names_and_types(plan)) == [("Küche", "kitchen"), ("Wohnen", "living")]
    assert sorted(room.area for room in shapes(plan.document)) == pytest.approx([4.6 * 5.4, 4.7 * 5.4], rel=1e-3)
    (door,), (window,) = lines(plan.document, "door"), lines(plan.document, "window")
    assert door.length == pytest.approx(0.9, abs=0.01)
    assert window.length == pytest.approx(1.5, abs=0.01)
    used = {(use.layer, use.used_as) for use in plan.report.layers}
    assert {("WAND", "lines: wall"), ("MÖBEL", "ignored"), ("TÜREN", "door swings")} <= used


def _single_lines(leaves: str, layer: str):
    """Draw walls of single lines in millimetres, 3 rooms above a corridor, with half open doors and axes."""
    document = new_dxf(units=4)
    space = document.modelspace()
    # The upper left corner stays open by 3 cm, the wall to the right of the first room by 12 cm.
    space.add_line((30, 6000), (12000, 6000))
    space.add_line((0, 0), (0, 5970))
    space.add_line((0, 0), (12000, 0))
    space.add_line((12000, 0), (12000, 6000))
    space.add_line((4000, 2120), (4000, 6000))
    space.add_line((8000, 2000), (8000, 6000))
    for x in (0, 6000, 12000):
        space.add_line((x, -1500), (x, 7500), dxfattribs={"layer": "EJES"})
    start = 0
    for hinge, angle in ((1000, 40.0), (5000, 65.0), (9000, 90.0)):
        space.add_line((start, 2000), (hinge, 2000))
        _add_leaf(space, leaves, hinge, angle, {"layer": layer})
        start = hinge + 900
    space.add_line((start, 2000), (12000, 2000))
    return document


def _add_leaf(space: Any, leaves: str, hinge: float, angle: float, attributes: dict[str, str]) -> None:
    x, y = 900 * math.cos(math.radians(angle)), 900 * math.sin(math.radians(angle))
    tip = (hinge + x, 2000 + y)
    if leaves == "polyline":
        bulge = -math.tan(math.radians(angle) / 4)
        points = [(hinge, 2000, 0), (*tip, bulge), (hinge + 900, 2000, 0)]
        space.add_lwpolyline(points, format="xyb", dxfattribs=attributes)
        return
    if leaves == "rectangle":
        aside = (-0.045 * y, 0.045 * x)
        corners = [(hinge, 2000), tip]
        corners += [(px + aside[0], py + aside[1]) for px, py in reversed(corners)]
        space.add_lwpolyline(corners, close=True, dxfattribs=attributes)
    else:
        space.add_line((hinge, 2000), tip, dxfattribs=attributes)
    if leaves != "line alone":
        space.add_arc((hinge, 2000), 900, 0, angle, dxfattribs=attributes)


@pytest.mark.parametrize(
    ("leaves", "layer"),
    [*((leaves, layer) for leaves in ("line", "polyline", "rectangle") for layer in ("0", "PUERTAS")),
     ("line alone", "PUERTAS")],
)  # fmt: skip
def test_slanted_leaves_are_doors_and_not_walls(leaves: str, layer: str):
    plan = import_plan(dxf_file(_single_lines(leaves, layer)))
    areas = sorted(room.area for room in shapes(plan.document))
    assert areas == pytest.approx([16.0, 16.0, 16.0, 24.0], rel=0.01)
    doors = sorted(lines(plan.document, "door"), key=lambda line: line.bounds)
    assert [door.bounds[0] for door in doors] == pytest.approx([1.0, 5.0, 9.0], abs=0.01)
    assert [door.length for door in doors] == pytest.approx([0.9] * 3, abs=0.02)
    assert not lines(plan.document, "passage")
    assert "on no wall" not in " ".join(plan.report.warnings)


def test_names_of_rooms_that_are_not_enclosed_are_warned_of():
    document = new_dxf()
    space = document.modelspace()
    # The room to the right has an opening of 2.5 m, wider than a door.
    corners = [(8, 4), (8, 0), (0, 0), (0, 4), (8, 4)]
    for start, end in [*pairwise(corners[1:]), ((4, 0), (4, 4)), ((8, 0), (8, 1)), ((8, 3.5), (8, 4))]:
        space.add_line(start, end, dxfattribs={"layer": "WALL"})
    for text, x, y in (("Bedroom", 1, 2), ("Kitchen", 5, 2), ("12.5 m²", 5, 1), ("Living room", 2, -3)):
        space.add_text(text, height=0.2).set_placement((x, y))
    plan = import_plan(dxf_file(document))
    assert [room["name"] for room in plan.document["rooms"]] == ["Bedroom"]
    assert [text for text in plan.report.warnings if "is written" in text] == [
        "no room was found where 'Kitchen' is written; close its walls, or draw the room"
    ]


def test_drawing_without_rooms_names_layers_and_attempts():
    document = new_dxf()
    for x in range(5):
        document.modelspace().add_line((x, 0), (x, 9), dxfattribs={"layer": "WALL"})
    with pytest.raises(InvalidFloorPlanError, match=r"has 5 lines: wall on 'WALL' \(tried: rooms are the areas"):
        import_plan(dxf_file(document))


def test_unknown_layers_are_rejected_with_the_known_ones():
    with pytest.raises(InvalidFloorPlanError, match=r"layers is walls, but .* are empty; .*'Fenster', .*'WAND'"):
        import_plan(dxf_file(_german_walls()), ImportOptions(layers=("walls",)))


def test_dxf_without_unit_gets_the_one_of_its_door_and_area_as_an_assumption():
    report = import_plan(dxf_file(_german_walls(insunits=0))).report
    assert (report.metres_per_unit, report.scale_std) == (0.001, 0.0)
    assert report.scale_source.startswith("millimetres, estimated from 1 door leaf")
    assert any("millimetres are assumed" in warning for warning in report.warnings)
    assert len(import_plan(dxf_file(_german_walls(insunits=0)), ImportOptions(units="mm")).document["rooms"]) == 2


def test_dxf_without_unit_and_doors_is_rejected_with_the_likely_one():
    with pytest.raises(InvalidFloorPlanError, match=r"\$INSUNITS is 0.*looks like millimetres: units=mm"):
        import_plan(dxf_file(_german_walls(insunits=0)), ImportOptions(layers=("WAND",)))


def test_wrong_unit_gives_a_warning():
    with pytest.raises(InvalidFloorPlanError):
        import_plan(dxf_file(_german_walls(insunits=6)))  # A plan of ten kilometres.
    warnings = import_plan(dxf_file(_german_walls(insunits=5))).report.warnings
    assert any("room is 7" in warning and "millimetres (with units=mm it is 7." in warning for warning in warnings)


def test_binary_dxf_is_read():
    stream = io.BytesIO()
    _german_walls().write(stream, fmt="bin")
    assert len(import_plan(stream.getvalue()).document["rooms"]) == 2


def test_open_polyline_in_surveyed_coordinates_stays_open():
    document = new_dxf()
    space = document.modelspace()
    east, north = 500_000.0, 5_300_000.0
    outer = [(0, 0), (10, 0), (10, 8), (0, 8)]
    # The inner face has a gap of 4 m between its ends, less than 1e-5 of the coordinates.
    inner = [(0.2, 6.2), (0.2, 7.8), (9.8, 7.8), (9.8, 0.2), (0.2, 0.2), (0.2, 2.2)]
    for ring, close in ((outer, True), (inner, False)):
        points = [(east + x, north + y) for x, y in ring]
        space.add_lwpolyline(points, close=close, dxfattribs={"layer": "WALL"})
    drawing = joined(dxf._read_drawings(document, ImportOptions(), ReportBuilder(), Budget()).values())
    assert [stroke.line.length for stroke in drawing.strokes] == pytest.approx([1.6 + 9.6 + 7.6 + 9.6 + 2.0])
    assert [area.shape.area for area in drawing.areas] == pytest.approx([80.0])


def test_polyline_with_equal_ends_is_closed_at_any_coordinates():
    for origin in (0.0, 5_300_000.0):
        document = new_dxf()
        ring = [(0, 0), (4, 0), (4, 3), (0, 3), (0, 1e-6)]
        document.modelspace().add_lwpolyline([(origin + x, origin + y) for x, y in ring])
        drawing = joined(dxf._read_drawings(document, ImportOptions(), ReportBuilder(), Budget()).values())
        assert [area.shape.area for area in drawing.areas] == pytest.approx([12.0])


def test_french_polylines_and_blocks_in_feet():
    document = new_dxf(units=2)
    space = document.modelspace()
    door = document.blocks.new("PORTE_90")
    door.add_line((0, 0), (0, 3))
    door.add_arc((0, 0), 3, 0, 90)
    window = document.blocks.new("FENETRE")
    window.add_lwpolyline([(0, 0), (4, 0), (4, 0.5), (0, 0.5)], close=True)
    for x0, x1 in ((0, 12), (12.5, 20)):
        ring = [(x0, 0), (x1, 0), (x1, 10), (x0, 10)]
        space.add_lwpolyline(ring, close=True, dxfattribs={"layer": "PIÈCES"})
    space.add_blockref("PORTE_90", (12.25, 3), dxfattribs={"rotation": 90})
    space.add_blockref("FENETRE", (3, -0.6))
    space.add_text("Chambre 1", dxfattribs={"layer": "PIÈCES"}).set_placement((4, 4))
    plan = import_plan(dxf_file(document))
    assert plan.document["rooms"][0]["type"] == "bedroom"
    assert shapes(plan.document)[0].area == pytest.approx(120 * 0.3048**2, rel=1e-3)
    (leaf,), (pane,) = lines(plan.document, "door"), lines(plan.document, "window")
    assert leaf.length == pytest.approx(3 * 0.3048, rel=1e-3)
    assert pane.length == pytest.approx(4 * 0.3048, rel=1e-3)


@pytest.mark.parametrize(
    ("layer", "role"),
    [
        ("A-DOOR", "door"), ("TÜREN", "door"), ("Zimmertür", "door"), ("portes", "door"), ("mur porteur", "wall"),
        ("A-GLAZ", "window"), ("Dachfenster", "window"), ("Außenwände", "wall"), ("A-WALL-PATT", "wall"),
        ("STÜTZEN", "obstacle"), ("Pièces", "room"), ("MÖBEL", "ignored"), ("DOOR-DIMENSIONS", "ignored"), ("0", None),
        ("Abbruchwand", "demolished"), ("A-WALL-DEM", "demolished"), ("Wand zu entfernen", "demolished"),
        ("RÜCKBAU_WÄNDE", "demolished"), ("mur à déposer", "demolished"), ("walls to be removed", "demolished"),
        ("Rückbautür", "demolished"), ("muro a demolir", "demolished"), ("REMODEL-WALL", "wall"), ("A-WALL-E", "wall"),
        ("A-WALL-FULL-D", "demolished"), ("Стены демонтаж", "demolished"), ("VÄGG RIVS", "demolished"),
    ],
)  # fmt: skip
def test_role_of_a_layer(layer: str, role: str | None):
    assert role_from_name(layer) == role


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("lving room", "living"),
        ("kitdhen 1", "kitchen"),
        ("corrid", "corridor"),
        ("Badezimner", "bathroom"),
        ("Kitchen", "kitchen"),
        ("10.3m2", None),
        ("Elevation", None),
        ("scale 1:100", None),
        ("Grundriss", None),
    ],
)
def test_misread_name_of_a_room_is_one(text: str, kind: str | None):
    assert room_types_from_reading(text) == (() if kind is None else (kind,))


def _dimensioned_svg(unit: float, texts: tuple[str, ...]) -> bytes:
    """Draw two rooms of 4 m and 5 m by 3 m in units of 1 / `unit` m, with three chained dimensions and one in all."""
    walls = ((0, 0, 9.3, 0), (0, 3.2, 9.3, 3.2), (0, 0, 0, 3.2), (4.2, 0, 4.2, 3.2), (9.3, 0, 9.3, 3.2))
    chains = (((0.1, 4.1), 3.6), ((4.3, 9.2), 3.6), ((0, 9.3), 4.0))
    shapes = [f'<line x1="{a * unit}" y1="{b * unit}" x2="{c * unit}" y2="{d * unit}"/>' for a, b, c, d in walls]
    shapes.append(f'<line x1="0" y1="{3.6 * unit}" x2="{9.3 * unit}" y2="{3.6 * unit}"/>')
    shapes.append(f'<line x1="0" y1="{4.0 * unit}" x2="{9.3 * unit}" y2="{4.0 * unit}"/>')
    for (start, end), y in chains:
        shapes += [
            f'<line x1="{x * unit}" y1="{(y - 0.1) * unit}" x2="{x * unit}" y2="{(y + 0.1) * unit}"/>'
            for x in (start, end)
        ]
    shapes += [
        f'<text x="{0.5 * (start + end) * unit}" y="{(y - 0.05) * unit}">{text}</text>'
        for ((start, end), y), text in zip(chains, texts, strict=True)
    ]
    drawn = f'<g id="walls">{"".join(shapes[:5])}</g>{"".join(shapes[5:])}'
    head = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 900 500"><g stroke="black" stroke-width="1">'
    return f"{head}{drawn}</g></svg>".encode()


@pytest.mark.parametrize("texts", [("4.00", "4,90", "9.30 m"), ("400", "490 cm", "930"), ("4000", "4900", "9300")])
def test_dimensions_give_the_scale(texts: tuple[str, ...]):
    plan = import_plan(_dimensioned_svg(37.0, texts))
    assert plan.report.scale_source == "3 dimensions written in the drawing"
    assert plan.report.metres_per_unit == pytest.approx(1.0 / 37.0, rel=1e-3)
    assert max(room.bounds[2] for room in shapes(plan.document)) == pytest.approx(9.3, abs=0.05)


@pytest.mark.parametrize("texts", [("4.00", "5.90", "9.30"), ("12", "4.90", "9.30"), ("4.00", "4.90", "R 7")])
def test_two_dimensions_that_agree_give_a_scale_that_is_assumed(texts: tuple[str, ...]):
    report = import_plan(_dimensioned_svg(37.0, texts)).report
    assert report.metres_per_unit == pytest.approx(1.0 / 37.0, rel=0.01)
    assert report.scale_source.startswith("estimated from 2 written dimensions (±")
    assert report.scale_std > 0.005
    assert any("is assumed" in warning for warning in report.warnings)


def test_dimensions_that_disagree_give_no_scale():
    with pytest.raises(InvalidFloorPlanError, match="gives no scale"):
        import_plan(_dimensioned_svg(37.0, ("4.00", "5.90", "7.10")))


def test_whole_numbers_of_a_large_drawing_are_ambiguous():
    dimensions = [("400", [4.0]), ("490", [4.9]), ("930", [9.3])]
    assert scale_by_dimensions(dimensions, 9.3) == (pytest.approx(1.0), "3 dimensions written in the drawing")
    # 50 m in centimetres, or 5 m in millimetres.
    assert scale_by_dimensions(dimensions, 50.0) is None
    feet = [("13'-1\"", [400.0]), ("16' 4\"", [498.0]), ("30'", [914.0])]
    assert scale_by_dimensions(feet, 1000.0) == (pytest.approx(0.01, rel=5e-3), "3 dimensions written in the drawing")


def test_dimensions_of_a_dxf_give_its_unit():
    document = _german_walls(insunits=0)
    space = document.modelspace()
    for start, end in ((0, 4000), (0, 6200), (4000, 6200)):
        space.add_linear_dim(base=(0, -900), p1=(start, 0), p2=(end, 0), dimstyle="Standard").render()
    plan = import_plan(dxf_file(document))
    assert plan.report.scale_source == "3 dimensions written in the drawing"
    assert plan.report.metres_per_unit == pytest.approx(1e-3)
