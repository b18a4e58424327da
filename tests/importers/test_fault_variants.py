"""Variants of the traits in `test_fault_files.py`: other formats, languages, units and places."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from ezdxf.enums import TextEntityAlignment
from ezdxf.filemanagement import new as new_dxf
from ezdxf.render.forms import cube
from scipy import ndimage

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers import ImportedPlan, import_plan, import_plans
from lalaloc_core.importers.common import ReportBuilder
from lalaloc_core.importers.common.geometry import find_floor
from lalaloc_core.importers.common.plausibility import check_leaves
from lalaloc_core.importers.drawing.drawing_scale import _written_scales
from lalaloc_core.importers.drawing.scale_guess import ScaleGuess, assume_scale
from tests.importers.conftest import dxf_file, lines, shapes
from tests.importers.test_fault_files import FOLDER
from tests.importers.test_ros_maps import _map
from tests.strategies import present

_SVG = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1200 900" data-metres-per-unit="0.01">{}</svg>'


def _svg(*elements: str) -> ImportedPlan:
    return import_plan(_SVG.format("".join(elements)).encode())


def _areas(plan: ImportedPlan) -> list[float]:
    return sorted((round(shape.area, 1) for shape in shapes(plan.document)), reverse=True)


def _drawn_rooms(*layers: str) -> Any:
    """Return a drawing of rooms of 4 m x 3 m in a row, each on a layer."""
    document: Any = new_dxf("R2010", units=6)
    for number, layer in enumerate(layers):
        x = 4.2 * number
        ring = [(x, 0.0), (x + 4.0, 0.0), (x + 4.0, 3.0), (x, 3.0)]
        document.modelspace().add_lwpolyline(ring, close=True, dxfattribs={"layer": layer})
    return document


@pytest.mark.parametrize(
    ("layers", "kinds"),
    [
        (("Zimmer", "Küche", "Bäder", "Büros"), {"kitchen", "bathroom", "office"}),
        (("A-AREA-ROOM", "Cuisine", "Salles de bain", "Bureaux"), {"kitchen", "bathroom", "office"}),
        (("部屋", "台所", "浴室", "事務室"), {"kitchen", "bathroom", "office"}),
        (("Rum", "Kök", "Badrum", "Kontor"), {"kitchen", "bathroom", "office"}),
        (("Pokoje", "Kuchnia", "Łazienka", "Biuro"), {"kitchen", "bathroom", "office"}),
        (("ROOM", "Küchen"), {"kitchen"}),
        (("ROOM", "Toiletter"), {"bathroom"}),
        (("ROOM", "Sypialnie"), {"bedroom"}),
        (("ROOM", "Łazienki"), {"bathroom"}),
        (("ROOM", "03_SCHLAFEN"), {"bedroom"}),
    ],
)
def test_layers_named_by_use_are_rooms_in_other_languages(layers: tuple[str, ...], kinds: set[str]):
    plan = import_plan(dxf_file(_drawn_rooms(*layers)))
    assert _areas(plan) == [12.0] * len(layers)
    assert kinds <= {room.get("type") for room in plan.document["rooms"]}


def test_outlines_of_separate_lines_on_a_layer_of_rooms_are_rooms():
    document: Any = new_dxf("R2010", units=6)
    for x in (0.0, 4.2):
        for start, end in pairwise([(x, 0.0), (x + 4.0, 0.0), (x + 4.0, 3.0), (x, 3.0), (x, 0.0)]):
            document.modelspace().add_line(start, end, dxfattribs={"layer": "Rooms"})
    assert _areas(import_plan(dxf_file(document))) == [12.0, 12.0]


@pytest.mark.parametrize("turn_deg", [0, 2, 25])
def test_turned_shapes_of_an_svg_are_walls(turn_deg: int):
    turned = f'<g transform="rotate({turn_deg})" fill="none" stroke="#000" stroke-width="12">{{}}</g>'
    outer, inner = '<rect width="1000" height="700"/>', '<path d="M450,0 V300 M450,390 V700"/>'
    assert _areas(_svg(turned.format(outer + inner))) == [37.0, 30.1]


@pytest.mark.parametrize("schema", ["IFC4X3", "IFC4X3_ADD1", "IFC4_ADD2", "ifc4"])
def test_versions_of_ifc_schemas_are_read(schema: str):
    model = (FOLDER / "door_curtain.ifc").read_text().replace("'IFC4'", f"'{schema}'")
    plan = import_plan(model.encode())
    assert _areas(plan) == [19.2, 16.0]
    assert [len(lines(plan.document, kind)) for kind in ("door", "window")] == [1, 1]


def test_copies_titles_and_parts_of_texts_of_an_svg_are_read():
    text = '<text><tspan x="20" y="20">Bed</tspan><tspan x="50" y="20">room</tspan><tspan y="40">20 m²</tspan></text>'
    room = '<symbol id="a"><rect class="room" width="500" height="400"/></symbol><defs><g id="b">{}</g></defs>'
    named = '<rect id="room-1" x="1030" width="50" height="400"><title>Hall</title></rect>'
    copies = room.format('<use href="#a"/>'), '<use href="#b"/><use href="#b" x="515"/>', named
    plan = _svg("<style>#a rect{fill:red}</style><foreignObject>Bath</foreignObject>", *copies, text)
    assert _areas(plan) == [20.0, 20.0, 2.0]
    assert [room.get("name") for room in plan.document["rooms"]] == ["Bedroom", None, "Hall"]
    for said in ("styles of '#a rect' are not applied", "1 texts are HTML (foreignObject)"):
        assert any(said in line for line in plan.report.warnings)


def test_unused_outlines_are_reported_with_layer_and_share():
    rooms = [f'<rect id="room-{x}" x="{x}" y="0" width="500" height="400"/>' for x in (0, 515)]
    plan = _svg(*rooms, '<rect id="Spielecke" x="0" y="415" width="500" height="400"/>')
    assert _areas(plan) == [20.0, 20.0]
    (warning,) = [line for line in plan.report.warnings if "not used" in line]
    assert "1 closed outlines" in warning
    assert "33 % of the outlined area: 1 on 'Spielecke' (20.0 m²)" in warning


def test_kitchen_units_inside_a_room_are_no_rooms():
    plan = _svg(
        '<rect id="room-1" x="0" y="0" width="500" height="400"/>',
        '<rect id="kitchen" x="0" y="0" width="300" height="70"/>',
    )
    assert _areas(plan) == [20.0]


_WALLS = (
    '<g fill="#222"><rect x="0" y="0" width="1000" height="20"/><rect x="0" y="580" width="1000" height="20"/>'
    '<rect x="0" y="0" width="20" height="600"/><rect x="980" y="0" width="20" height="600"/>'
    '<rect x="490" y="0" width="20" height="600"/></g>'
)


def test_openings_painted_over_walls_of_an_svg_are_found():
    plan = _svg(
        _WALLS,
        '<rect x="100" y="0" width="150" height="20" fill="#8cf"/>',
        '<rect x="490" y="200" width="20" height="90" fill="white"/>',
        '<path d="M500,200 L580,241" fill="none" stroke="#000"/>',
        '<rect x="490" y="400" width="20" height="100" fill="#fff"/>',
    )
    assert _areas(plan) == [26.3, 26.3]
    assert [len(lines(plan.document, kind)) for kind in ("door", "window", "passage")] == [1, 1, 1]


@pytest.mark.parametrize("plot", ["M-700 -600L1500 -500L1800 1200L-400 1000Z", "M-700 -600H1500V1000H-700Z"])
@pytest.mark.parametrize(("name", "count"), [("Bed", 2), ("", 2), ("Garden", 2), ("Hall", 3)])
def test_plot_around_walls_is_no_room_unless_its_name_is(plot: str, name: str, count: int):
    rings = ("M0 0H1000V600H0Z", "M20 20H490V580H20Z", "M510 20H980V580H510Z", plot)
    walls = [f'<path class="wall" fill="none" stroke="#000" d="{ring}"/>' for ring in rings]
    plan = _svg(*walls, f'<text x="{600 if name == "Bed" else 1100}" y="300">{name}</text>')
    assert len(plan.document["rooms"]) == count
    assert any("is taken for the plot" in line for line in plan.report.unsure) == (count == 2)
    single = _svg(walls[0], walls[3], walls[1].replace("M20 20H490V580H20Z", "M490 0V600")).report
    assert any("m² without a name lies around all others" in line for line in single.warnings)


def test_floors_painted_over_the_edges_of_walls_are_no_openings():
    floors = [f'<rect x="{x}" y="10" width="485" height="580" fill="#eee"/>' for x in (10, 505)]
    plan = _svg(_WALLS, *floors)
    assert len(shapes(plan.document)) == 2
    assert "openings" not in plan.document


@pytest.mark.parametrize("x", [30, 250, 505])
def test_dark_pillars_beside_single_lines_are_no_walls(x: int):
    plan = _svg(
        '<path fill="none" stroke="#000" stroke-width="1" d="M0,0 H1000 V600 H0 Z"/>',
        '<path fill="none" stroke="#000" stroke-width="1" d="M500,0 V250 M500,340 V600"/>',
        f'<rect x="{x}" y="400" width="50" height="50" fill="#000"/>',
    )
    assert len(shapes(plan.document)) == 2
    assert sum(_areas(plan)) == pytest.approx(60.0 - 0.25, abs=0.15)


def test_chimney_and_shaft_of_outlined_walls_divide_no_room():
    document: Any = new_dxf("R2010", units=6)
    left = [(4.4, 1.6), (4.4, 2.2), (0.8, 2.2), (0.8, 1.6), (0.2, 1.6), (0.2, 0.2), (4.4, 0.2), (4.4, 0.7)]
    right = [(4.6, 0.7), (4.6, 0.2), (8.8, 0.2), (8.8, 2.2), (7.0, 2.2), (7.0, 1.6), (6.5, 1.6), (6.5, 2.2), (4.6, 2.2)]
    outer = [(0, 0), (9, 0), (9, 2.4), (0, 2.4)]
    for ring in (outer, [*left, *right, (4.6, 1.6)]):
        document.modelspace().add_lwpolyline(ring, close=True)
    plan = import_plan(dxf_file(document))
    assert _areas(plan) == [8.1, 8.0]
    assert len(plan.document["openings"]) == 1


def _box(x0: float, y0: float, x1: float, y1: float, z: float) -> np.ndarray:
    return np.array([(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)], float)


def test_gallery_over_a_neighbour_is_no_floor():
    # The upper half of a room reaches over its neighbour, 2.6 m above the floor.
    faces = [_box(0, 0, 4, 3, 0), _box(4, 0, 6, 3, 2.6), _box(0, 0, 6, 3, 5)]
    floor = present(find_floor(faces, lambda: None))
    assert sum(part.area for part in floor.parts) == pytest.approx(12.0)
    assert floor.higher_m2 == pytest.approx(6.0)


def test_steep_rows_of_seats_are_one_floor():
    faces = [_box(0, float(row), 10, row + 1.0, 0.4 * row) for row in range(8)] + [_box(0, 0, 10, 8, 9)]
    floor = present(find_floor(faces, lambda: None))
    assert sum(part.area for part in floor.parts) == pytest.approx(80.0)
    assert floor.rise_m == pytest.approx(2.8)


@pytest.mark.parametrize("turn_deg", [0.0, pytest.param(17.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("rows", [(20, 80), (60, 130)])
def test_room_behind_glass_of_a_turned_map_is_found(turn_deg: float, rows: tuple[int, int]):
    cells = np.full((260, 380), 205, np.uint8)
    cells[60:201, 60:321] = 0
    cells[62:199, 62:319] = 254
    cells[62:199, 180:182] = 0
    cells[100:118, 180:182] = 254
    cells[60 + rows[0] : 60 + rows[1], 319:321] = 205
    turned = ndimage.rotate(cells, turn_deg, order=0, cval=205, reshape=False)
    plan = import_plan(_map(turned))
    assert len(shapes(plan.document)) == 2
    assert any("never seen" in line for line in plan.report.unsure)


def _storeys(*layers: str, offset: float = 0.0) -> dict[str, ImportedPlan]:
    """Return the storeys of a drawing with a wall of 8 x 6 m, each inside the last, and a partition, on each layer.

    A layer can have a height: "WALL@3".
    """
    document: Any = new_dxf("R2010", units=6)
    for number, (layer, _, height) in enumerate(layer.partition("@") for layer in layers):
        at = {"layer": layer, "elevation": float(height or 0.0)}
        for inner in (offset * number, offset * number + 0.3):
            ring = [(inner, inner), (8.0 - inner, inner), (8.0 - inner, 6.0 - inner), (inner, 6.0 - inner)]
            document.modelspace().add_lwpolyline(ring, close=True, dxfattribs=at)
        for x in (3.0 + number, 3.2 + number):
            document.modelspace().add_lwpolyline([(x, 0.3), (x, 5.7)], dxfattribs=at)
    plans = import_plans(dxf_file(document))
    return {plan.level.name if plan.level else "": plan for plan in plans}


@pytest.mark.parametrize(
    ("layers", "names"),
    [
        (("01_EG_Wand", "04_OG_Wand"), ("EG", "OG")), (("2.OG-Wand", "1.OG-Wand"), ("1.OG", "2.OG")),
        (("Wand 4OG", "OG5-Wand"), ("4OG", "OG5")), (("A-WALL-L1", "L0-WALL"), ("L0", "L1")), (("A_²", "WALL"), ("",)),
        (("E10 Mur", "E9 Mur"), ("E9", "E10")), (("Étage 2 murs", "Étage 1 murs"), ("Étage 1", "Étage 2")),
        (("Level -1 Wall", "LEVEL-01-WALL"), ("Level -1", "LEVEL-01")), (("1.DG Wand", "1.OG Wand"), ("1.OG", "1.DG")),
        (("OG-1-Wand", "OG-2-Wand"), ("",)), (("Wand_EI30", "Wand_EI90"), ("",)), (("WALL-RC", "WALL-PB"), ("",)),
        (("1NP-ZDI", "2NP-ZDI"), ("1NP", "2NP")), (("壁1階", "壁2階"), ("1F", "2F")), (("SEINAT_1KRS",) * 2, ("",)),
        (("VEGG 2.etg", "VEGG 1.etg"), ("1.etg", "2.etg")), (("MURI_P1", "MURI_PT"), ("PT", "P1")),
        (("WALL_0", "EG-Wand", "OG-Wand"), ("EG", "OG")), (("EG-Wand", "WALL_0", "OG-Wand"), ("EG", "OG")),
        (("2_WALL", "1_WALL"), ("1", "2")), (("Walls 01", "Walls 02"), ("01", "02")), (("WALL1", "WALL2"), ("",)),
        (("WAND-0", "WAND-1"), ("0", "1")), (("Muro +3.00", "Muro -0.20"), ("-0.20", "+3.00")),
        (("WALL@0", "WALL@3"), ("+0.00", "+3.00")), (("0@2.8", "0@-0.1"), ("-0.10", "+2.80")), (("0", "0@0.9"), ("",)),
        (("OG-Wand@3", "EG-Wand@6"), ("EG", "OG")),
    ],
)  # fmt: skip
def test_words_for_storeys_count_before_numbers_of_layers(layers: tuple[str, ...], names: tuple[str, ...]):
    found = _storeys(*layers)
    assert tuple(found) == names
    assert len(names) != len(layers) or sorted(map(_areas, found.values())) == [[20.0, 18.9], [24.3, 14.6]]


@pytest.mark.parametrize(("layers", "offset"), [(("WALL1", "WALL2"), 0.0), (("WALL-1", "WALL-2"), 0.15)])
def test_walls_around_one_outline_are_said_but_leaves_of_a_wall_are_not(layers: tuple[str, str], offset: float):
    warnings = _storeys(*layers, offset=offset)[""].report.warnings
    assert any("run around the same outline" in line for line in warnings) == (not offset)


def _robot_map(*segments: list[list[int]], walls: list[list[int]]) -> bytes:
    """Return a map with cells of 5 cm; segments and walls are boxes (x, y, width, height) in cells."""

    def runs(boxes: list[list[int]]) -> list[int]:
        return [value for x, y, width, height in boxes for row in range(y, y + height) for value in (x, row, width)]

    layers = [{"type": "segment", "compressedPixels": runs(boxes)} for boxes in segments]
    layers.append({"type": "wall", "compressedPixels": runs(walls)})
    return json.dumps({"pixelSize": 5, "layers": layers}).encode()


def test_walls_of_a_robots_map_with_a_jog_have_no_passage():
    # The wall between the rooms has a jog of a cell, and the second room stops a cell before it.
    first, second = [[0, 0, 80, 10], [0, 10, 79, 70]], [[83, 0, 60, 80]]
    walls = [[80, 0, 2, 10], [79, 10, 2, 70]]
    assert "openings" not in import_plan(_robot_map(first, second, walls=walls)).document
    door = [[80, 0, 2, 10], [79, 10, 2, 30], [79, 58, 2, 22]]
    (opening,) = import_plan(_robot_map(first, second, walls=door)).document["openings"]
    assert math.dist(*opening["line"]) == pytest.approx(0.9, abs=0.11)
    plan = import_plan(_robot_map(first, second, walls=[]).replace(b'"wall"', b'"floor"'))
    assert "openings" not in plan.document
    assert "the map has no walls" in plan.report.warnings[0]


@pytest.mark.parametrize("run", [[0, 0, 0], [0, 0, -5], [0, 0, 1.5], [0, 0]])
def test_cells_of_a_robots_map_are_whole_numbers(run: list[float]):
    document = {"pixelSize": 5, "layers": [{"type": "segment", "compressedPixels": run}]}
    with pytest.raises(InvalidFloorPlanError, match="the cells of layer 0 of the map must be"):
        import_plan(json.dumps(document).encode())


def test_fixtures_belong_to_the_storey_of_their_layer():
    document: Any = new_dxf("R2010", units=6)
    stove = document.blocks.new("Herd")
    stove.add_lwpolyline([(0.0, 0.0), (0.6, 0.0), (0.6, 0.6), (0.0, 0.6)], close=True)
    for layer in ("EG-Wand", "OG-Wand"):
        for inner in (0.0, 0.3):
            ring = [(inner, inner), (5.0 - inner, inner), (5.0 - inner, 4.0 - inner), (inner, 4.0 - inner)]
            document.modelspace().add_lwpolyline(ring, close=True, dxfattribs={"layer": layer})
    document.modelspace().add_blockref("Herd", (1.0, 1.0), dxfattribs={"layer": "EG-Möbel"})
    ground, upper = import_plans(dxf_file(document))
    assert [room.get("type") for room in ground.document["rooms"]] == ["kitchen"]
    assert [room.get("type") for room in upper.document["rooms"]] == [None]


def test_dashed_walls_are_left_out_and_each_part_of_a_wall_has_its_width():
    document: Any = new_dxf("R2010", units=21, setup=True)
    space, foot = document.modelspace(), 3937 / 1200
    wide = [
        (x * foot, y * foot, w * foot, w * foot) for x, y, w in [(5, 0, 0.4), (9, 0, 0.4), (9, 6, 0.2), (0, 6, 0.2)]
    ]
    ends = [(0.0, 0.0, 0.4 * foot, 0.4 * foot), (5 * foot, 0.0, 0.0, 0.0)]
    space.add_lwpolyline([*wide, *ends], format="xyse", dxfattribs={"layer": "WALL"})
    space.add_line((0, 3 * foot), (9 * foot, 3 * foot), dxfattribs={"layer": "WALL", "linetype": "DASHED"})
    space.add_mtext("Kitchen", dxfattribs={"insert": (-0.1, 6.0 * foot), "char_height": 0.5, "attachment_point": 1})
    plan = import_plan(dxf_file(document))
    assert _areas(plan) == [round(8.7 * 5.7, 1)]
    assert [room["name"] for room in plan.document["rooms"]] == ["Kitchen"]
    assert any("a dashed line on layer 'WALL' is to be demolished" in line for line in plan.report.warnings)


def test_leaves_of_doors_contradict_a_unit():
    assert "it looks like millimetres (with units=mm it is 0.90 m)" in check_leaves([22.86] * 3, 0.0254)[0]
    assert "check the scale, or set multiply to about 0.48" in check_leaves([1.8, 1.7], 0.01)[0]
    assert check_leaves([0.9, 0.1, 0.1], 1.0) == check_leaves([], 1.0) == []


def test_guess_chooses_among_scales_that_are_written():
    written = [(0.00706, "1:20"), (0.0353, "1:100")]
    assert assume_scale(ScaleGuess(0.031, 0.09), ReportBuilder(), written) == written[1]


def test_fitted_text_is_in_the_middle_of_its_points():
    document = _drawn_rooms("Rooms", "Rooms")
    space = document.modelspace()
    space.add_text("Küche").set_placement((4.4, 1.0), (8.0, 1.0), align=TextEntityAlignment.FIT)
    space.add_text("Bad").dxf.discard("insert")
    rooms = import_plan(dxf_file(document)).document["rooms"]
    names = {round(room["polygon"][0][0]): room.get("name") for room in rooms}
    assert sorted(filter(None, names.values())) == ["Küche"]


def test_room_with_an_area_drawn_twice_in_it_stays():
    square = '<path class="room" d="M{0} {0}H{1}V{1}H{0}Z"/>'
    assert max(_areas(_svg(square.format(0, 600), square.format(50, 330), square.format(50, 330)))) > 27.0


@pytest.mark.parametrize(
    ("texts", "paper_m", "scale"),
    [
        ("Scale at A1: 1:50", 0.42, 100), ("Scale @ A1|Scale:1:50", 0.42, 100), ("1:50 auf DIN A1", 0.42, 100),
        ("1:50 @ A1 / 1:100 @ A3", 0.42, 100), ("A1: 1:50, A3: 1:100", 0.841, 50), ("1:50 @ A1/1:100 @ A3", 0.297, 141),
        ("1:100  A1.01", 0.42, 100), ("1:100 (A1)", 0.42, 200), ("1:50 @ A1", 0.25, 50), ("1:50|1:200", 0.841, None),
        ("1:50 @ A1, 1:200 @ A1", 0.841, None), ('1/4" = 1\'-0" @ ARCH D', 0.457, 96), ("3/16'' = 1' - 0''", None, 64),
        ('1/4" = 1\'-0"', None, 48), ('1/2"=1\'', None, 24), ('1 1/2" = 1\'-0"', None, None),
        ("M 1:50 im Original DIN A1", 0.42, 100), ('1/4"=1\'-0" @ 22"x34"', 0.432, 96), ("1:50 (HALF, A1)", 0.42, 100),
    ],
)  # fmt: skip
def test_scale_that_is_written_for_a_sheet_or_in_inches(texts: str, paper_m: float | None, scale: int | None):
    found = _written_scales(texts.split("|"), paper_m or math.inf)
    assert (found[0][0] if len(found) == 1 else None) == (scale and pytest.approx(scale, rel=0.01))


def test_svg_on_paper_of_another_size_than_its_scale_is_for():
    drawn = '<rect class="room" width="40" height="50"/><text x="5" y="5">1:50 @ A1</text>'
    root = '<svg xmlns="http://www.w3.org/2000/svg" width="297mm" height="420mm" viewBox="0 0 297 420">'
    assert import_plan(f"{root}{drawn}</svg>".encode()).report.metres_per_unit == pytest.approx(0.1, rel=0.01)


def test_what_a_drawing_lacks_is_named_once_with_its_number():
    document = _drawn_rooms("Rooms", "Rooms")
    space = document.modelspace()
    document.blocks.new("attached").block.dxf.xref_path = "ground.dwg"
    document.blocks.new("hollow")
    outer = document.blocks.new("outer")
    underlay = document.add_underlay_def(filename="plan.pdf", fmt="pdf")
    for place in ((0.0, 0.0), (5.0, 0.0)):
        outer.add_blockref("attached", place)
        outer.add_blockref("hollow", place)
        space.add_blockref("outer", place)
        space.add_underlay(underlay, insert=place)
    cube().scale_uniform(0.5).translate(8.6, 0.0, 0.0).render_polyface(space, dxfattribs={"layer": "COLUMN"})
    stored = f"ENTITIES\n  0\nAEC_WALL\n  5\nFF01\n330\n{space.layout_key}\n100\nAcDbEntity\n  8\nWAND\n"
    with pytest.raises(InvalidFloorPlanError, match="no lines, areas or hatches; AEC_WALL on layer 'WAND' is not read"):
        import_plan(dxf_file(new_dxf()).replace(b"ENTITIES\n", stored.encode(), 1))
    plan = import_plan(dxf_file(document).replace(b"ENTITIES\n", stored.encode(), 1))
    for line in (
        "the drawing attaches 'ground.dwg' (2 times), which is not in the file: bind it (XREF, Bind)",
        "the block 'hollow' is empty (2 times); if it is another drawing, bind it",
        "PDFUNDERLAY on layer '0' (2 times) is not read: send that PDF, or import it (PDFIMPORT)",
        "AEC_WALL on layer 'WAND' is not read: turn such objects into lines (EXPORTTOAUTOCAD)",
    ):
        assert sum(warning.startswith(line) for warning in plan.report.warnings) == 1
    assert {use.used_as for use in plan.report.layers if use.layer == "COLUMN"} == {"faces: obstacle", "ignored"}
