"""Plans from pictures and PDF pages in five drawing styles; `benchmarks/plans.py` measures more."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from PIL import Image, ImageDraw, ImageOps

from benchmarks.plan_drawing import STYLES, DrawnPlan, Style, draw_plan
from benchmarks.plans import TABLE, Count, Plan, Score, count_found, intersection_over_union, read_plan
from lalaloc_core.draw.canvas import rasterise
from lalaloc_core.draw.plan import plan_svg
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import ImportOptions, KnownDistance, import_plan
from lalaloc_core.importers.common.import_limits import Budget, ImportLimits
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.drawing.vector_drawing import Lettering
from lalaloc_core.importers.picture.ink import find_skew
from lalaloc_core.importers.picture.sketch_picture import sketch_picture
from tests.importers.conftest import lines, names_and_types, shapes
from tests.painted import picture_file

FLAT = Path(__file__).parents[2] / "examples" / "flat.json"
# Homes whose rooms walls and doors divide: names that divide others are too small for a scan. The benchmark has more.
SEED = {"thin": 4, "thick": 1, "hatched": 0, "coloured": 3, "scanned": 2}


@pytest.fixture(scope="module")
def drawn() -> dict[Style, DrawnPlan]:
    return {style: draw_plan(style, SEED[style]) for style in STYLES}


@pytest.mark.slow
@pytest.mark.parametrize("style", STYLES)
def test_rooms_and_openings_are_found_in_every_style(drawn: dict[Style, DrawnPlan], style: Style):
    plan = drawn[style]
    score = Score()
    score.add(plan, plan.jpeg() if style == "scanned" else plan.png())
    assert score.counts["room"].matched == score.counts["room"].drawn == len(plan.rooms)
    assert score.counts["door"].f1 >= 0.8
    assert score.counts["window"].f1 >= 0.8
    assert f"| {style} | {len(plan.rooms)} | 100.0% |" in score.row(style)


def test_table_of_plans_counts_right_shapes_of_the_right_kind():
    def plan(end: float, kind: str, factor: float = 1.0) -> Plan:
        """Return two rooms and two openings, read from a document that is smaller by a factor."""
        corners = [np.array(shapely.box(x, 0, to, 3).exterior.coords) / factor for x, to in ((0, 4), (4.1, end))]
        openings = [("door", [(4.05, 1), (4.05, 1.9)]), (kind, [(1, 0), (2, 0)])]
        lines = [{"kind": name, "line": np.array(ends) / factor} for name, ends in openings]
        return Plan.of([{"rooms": [{"polygon": ring} for ring in corners], "openings": lines}], 0.01, factor)

    truth, found = plan(8.1, "window"), plan(6.1, "door", factor=2.0)
    counts = count_found(truth, found, TABLE)
    assert counts == {"room": Count(2, 2, 1), "door": Count(1, 2, 1), "window": Count(1, 0, 0)}
    row = read_plan("empty", b"", truth, "given")
    assert row["note"].startswith("refused: the file is empty")
    assert (row["read"], row["room"], row["right scale"]) == (Count(1), Count(2), Count(1))


@pytest.mark.slow
@pytest.mark.parametrize("coloured", [True, False])
def test_drawings_of_plan_svg_are_read_back(coloured: bool):
    flat = FloorPlan.from_json(FLAT.read_bytes())
    svg = plan_svg(flat)
    left, top, width, height = (float(number) for number in re.findall(r'viewBox="([^"]+)"', svg)[0].split())
    picture = Image.open(io.BytesIO(rasterise(svg)))
    content = picture_file(picture if coloured else picture.convert("LA"))
    plan = import_plan(content, ImportOptions(metres_per_pixel=width / picture.width)).document
    # The origin of a picture is its lower left corner.
    origin = np.array([left, -top - height])

    def placed(points: np.ndarray) -> np.ndarray:
        return points + origin

    found = [shapely.transform(room, placed) for room in shapes(plan)]
    shares = [max(intersection_over_union(room.shape, candidate) for candidate in found) for room in flat.rooms]
    assert min(shares) > 0.95
    for kind in ("door", "window", "passage"):
        found_lines = [shapely.transform(line, placed) for line in lines(plan, kind)]
        true = [shapely.LineString(opening.line_m) for opening in flat.openings if opening.kind == kind]
        if not coloured:
            # Without colours the entrance looks like a window in an outer wall.
            entrance = [line for line in true if line.coords[0][0] == 9.4 and kind == "door"]
            true = [line for line in true if line not in entrance]
            found_lines = [line for line in found_lines if line.centroid.x < 9.3 or line.centroid.y < 5.0]
        assert len(found_lines) == len(true)
        assert all(min(shapely.hausdorff_distance(line, near) for near in found_lines) < 0.2 for line in true)


def open_hall(gap_m: float = 2.4) -> bytes:
    """Return a picture of two rooms at 1 cm per pixel, the right one with a gap in its outer wall."""
    page = Image.new("L", (1100, 500), 255)
    pen = ImageDraw.Draw(page)
    pen.rectangle((100, 100, 1000, 400), outline=0, width=20)
    pen.line((550, 100, 550, 400), fill=0, width=16)
    # Without a symbol so wide a gap is no opening, and the room to the right stays open.
    if gap_m:
        pen.rectangle((660, 375, 660 + 100 * gap_m, 410), fill=255)
    return picture_file(page)


def hall_beside_a_photograph() -> bytes:
    """Return the closed hall, 1100 x 500 pixels, beside patches of dark tones, which look like a photograph."""
    hall = np.asarray(Image.open(io.BytesIO(open_hall(0.0))))
    patches = np.random.default_rng(0).integers(40, 140, (50, 90), np.uint8).repeat(10, axis=0).repeat(10, axis=1)
    return picture_file(np.hstack([hall, patches]))


@pytest.mark.parametrize("gap_m", [0.0, 2.4])
def test_area_without_rooms_is_reported(gap_m: float):
    plan = import_plan(open_hall(gap_m), ImportOptions(metres_per_pixel=0.01))
    warnings = [text for text in plan.report.warnings if "without a room" in text]
    assert len(plan.document["rooms"]) == (1 if gap_m else 2)
    assert bool(warnings) == bool(gap_m)
    if gap_m:
        assert re.search(r"cover only [45]\d% .* without a room are 1\d m² at \(7\.", warnings[0])
        (outline,) = plan.report.no_room
        # The drawing marks it: x from 5.6 to 9.9 m, y from 1.1 to 3.9 m.
        assert shapely.Polygon(outline).bounds == pytest.approx((5.6, 1.1, 9.9, 3.9), abs=0.2)
    else:
        assert plan.report.no_room == ()


@pytest.mark.parametrize("names", [("Kitchen", "Living room"), ("Kitchen", "north")])
def test_rooms_joined_by_a_wide_passage_are_divided_by_their_names(names: tuple[str, str]):
    page = np.full((500, 1100), 255, np.uint8)
    page[90:410, 90:1010] = 0
    page[110:390, 110:990] = 255
    page[110:150, 542:558] = page[350:390, 542:558] = 0
    places = ((3.0, 2.5), (8.0, 2.5))
    letterings = [Lettering(name, place) for name, place in zip(names, places, strict=True)]
    sketch = sketch_picture(page, 0.01, ReportBuilder(), Budget(ImportLimits()), letterings=letterings)
    is_divided = names[1] == "Living room"
    assert len(sketch.rooms) == (2 if is_divided else 1)
    assert [opening.kind for opening in sketch.openings] == ["passage"] * is_divided


@pytest.mark.parametrize("is_hatched", [False, True])
def test_furniture_at_outlined_walls_is_no_wall(is_hatched: bool):
    page = Image.new("L", (1200, 900), 255)
    pen = ImageDraw.Draw(page)
    if is_hatched:
        for x in range(-900, 1200, 14):
            pen.line((x, 900, x + 900, 0), fill=0)
        pen.rectangle((0, 0, 1199, 99), fill=255)
        pen.rectangle((0, 801, 1199, 899), fill=255)
        pen.rectangle((0, 0, 99, 899), fill=255)
        pen.rectangle((1101, 0, 1199, 899), fill=255)
        pen.rectangle((120, 120, 1080, 780), fill=255)
    for box in ((100, 100, 1100, 800), (120, 120, 1080, 780)):
        pen.rectangle(box, outline=0, width=2)
    # A hob, a basin, a shelf and a wardrobe.
    pen.rectangle((120, 300, 175, 360), outline=0)
    for x, y in ((135, 316), (160, 316), (135, 344), (160, 344)):
        pen.ellipse((x - 9, y - 9, x + 9, y + 9), outline=0)
    pen.rectangle((400, 120, 460, 165), outline=0)
    pen.ellipse((410, 128, 450, 156), outline=0)
    for x in (600, 640, 680, 720):
        pen.rectangle((x, 745, x + 40, 780), outline=0)
    pen.rectangle((1020, 500, 1080, 700), outline=0)
    pen.line((1050, 500, 1050, 700), fill=0)
    (room,) = shapes(import_plan(picture_file(page), ImportOptions(metres_per_pixel=0.01)).document)
    assert shapely.hausdorff_distance(room, shapely.box(1.2, 1.2, 10.8, 7.8)) < 0.06


def two_rooms() -> tuple[Image.Image, ImageDraw.ImageDraw]:
    """Return a picture of two rooms at 1 cm per pixel, and its pen."""
    page = Image.new("RGB", (900, 500), "white")
    pen = ImageDraw.Draw(page)
    pen.rectangle((100, 100, 800, 400), outline="black", width=20)
    pen.line((450, 100, 450, 400), fill="black", width=12)
    return page, pen


@pytest.mark.parametrize("symbol", ["leaf and arc", "leaf", "pale arc", "upright leaf"])
def test_door_with_a_half_open_leaf_or_a_pale_arc_is_a_door(symbol: str):
    page, pen = two_rooms()
    pen.rectangle((440, 200, 460, 290), fill="white")
    if "leaf" in symbol:
        pen.line((450, 200, *((540, 200) if symbol == "upright leaf" else (514, 264))), fill="black", width=4)
    if "arc" in symbol:
        pen.arc((360, 110, 540, 290), 0 if symbol == "pale arc" else 45, 90, fill=(225, 225, 225))
    (door,) = lines(import_plan(picture_file(page), ImportOptions(metres_per_pixel=0.01)).document, "door")
    assert door.length == pytest.approx(0.9, abs=0.03)


@pytest.mark.parametrize("lines_of", ["bow", "broken", "pale"])
def test_window_of_curved_or_broken_or_pale_lines_closes_its_room(lines_of: str):
    page, pen = two_rooms()
    pen.rectangle((180, 90, 380, 125), fill="white")
    for level in (103, 110, 117):
        if lines_of == "bow":
            pen.arc((280 - 145, level - 35, 280 + 145, level + 255), 226, 314, fill="black")
        elif lines_of == "pale":
            pen.line((180, level, 380, level), fill=(228, 228, 228))
        else:
            for x in range(180 + level % 5, 380, 12):
                pen.line((x, level, x + 6, level), fill="black")
    plan = import_plan(picture_file(page), ImportOptions(metres_per_pixel=0.01)).document
    (window,) = lines(plan, "window")
    assert window.length == pytest.approx(2.0, abs=0.05)
    assert len(plan["rooms"]) == 2


@pytest.mark.parametrize(("paper", "ink"), [("white", "black"), ("black", "blue"), ((20, 60, 120), (220, 235, 255))])
@pytest.mark.parametrize(("turn_deg", "size"), [(0, 1.0), (90, 0.5), (33, 1.3)])
def test_drawing_of_any_colours_direction_and_size_is_read(paper: Any, ink: Any, turn_deg: int, size: float):
    page = two_rooms()[0].convert("L").rotate(turn_deg, fillcolor=255, expand=True)
    page = ImageOps.colorize(page.resize((round(page.width * size), round(page.height * size))), ink, paper)
    found = shapes(import_plan(picture_file(page), ImportOptions(metres_per_pixel=0.01 / size)).document)
    assert sorted(room.area for room in found) == pytest.approx([8.4, 8.4], abs=0.1)


def test_dark_floor_is_a_room():
    page, pen = two_rooms()
    pen.rectangle((457, 121, 779, 379), fill=(80, 85, 90))
    found = shapes(import_plan(picture_file(page), ImportOptions(metres_per_pixel=0.01)).document)
    assert sorted(room.area for room in found) == pytest.approx([8.4, 8.4], abs=0.2)


def test_walls_that_are_paler_than_coloured_floors_are_walls():
    page, pen = two_rooms()
    pen.rectangle((100, 100, 800, 400), fill=(150, 180, 210))
    pen.rectangle((120, 120, 444, 380), fill=(120, 200, 100))
    pen.rectangle((456, 120, 780, 380), fill=(200, 100, 100))
    pen.rectangle((440, 200, 460, 290), fill=(200, 100, 100))
    pen.arc((366, 110, 546, 290), 0, 90, fill=(180, 85, 85), width=2)
    plan = import_plan(picture_file(page), ImportOptions(metres_per_pixel=0.01)).document
    assert sorted(room.area for room in shapes(plan)) == pytest.approx([3.24 * 2.6] * 2, rel=0.03)
    assert len(lines(plan, "door")) == 1


@pytest.mark.parametrize(
    ("ground", "floors", "wall"),
    [
        ("#f5f7fa", ("#99c8ff", "#ffd68a", "#ffaa96"), None),
        ("#1c1c1e", ("#3a6296", "#96783c", "#3c7d6e"), None),
        ("white", ("#19a1a1", "#7ac950", "#df5618"), "#5d6d7e"),
        ("black", ("#19a1a1", "#7ac950", "#df5618"), "#5d6d7e"),
        ("#e7f0fa", ("#b9ddfb", "#b9ddfb", "#b9ddfb"), "#5c9dde"),
    ],
)
@pytest.mark.parametrize(("turn_deg", "size"), [(0, 1.0), (3, 1.0), (0, 0.5)])
def test_map_of_a_robot_has_a_room_for_each_colour_or_each_area_between_walls(
    ground: str, floors: Sequence[str], wall: str | None, turn_deg: int, size: float
):
    page = Image.new("RGB", (1000, 900), ground)
    pen = ImageDraw.Draw(page)
    for box, floor in zip([(100, 100, 500, 499), (500, 100, 900, 499), (100, 500, 900, 800)], floors, strict=True):
        pen.rectangle(box, fill=floor)
        for y in range(box[1] + 20, box[3] - 20, 25):
            pen.line((box[0] + 20, y, box[2] - 20, y), fill="#f0f0f0", width=2)
    if wall is not None:
        pen.rectangle((100, 100, 900, 800), outline=wall, width=5)
        for line in [(500, 100, 500, 250), (500, 340, 500, 500), (100, 500, 250, 500), (340, 500, 900, 500)]:
            pen.line(line, fill=wall, width=7 if ground == "black" else 5)
    pen.rectangle((200, 600, 350, 750), fill="#ff7070")
    page = page.rotate(turn_deg, fillcolor=ground, expand=True)
    page = page.resize((round(page.width * size), round(page.height * size)))
    plan = import_plan(picture_file(page), ImportOptions(metres_per_pixel=0.01 / size))
    assert sorted(room.area for room in shapes(plan.document)) == pytest.approx([16.0, 16.0, 24.0], rel=0.08)
    assert len(lines(plan.document, "passage")) == (2 if wall is not None else 0)
    assert any("doors are unknown" in warning for warning in plan.report.warnings) == (wall is None)
    assert any("zones or carpets" in guess for guess in plan.report.unsure)


def test_symbols_across_walls_of_two_lines_cut_no_wall():
    page = Image.new("L", (900, 500), 255)
    pen = ImageDraw.Draw(page)
    for box in ((100, 100, 800, 400), (113, 113, 443, 387), (457, 113, 787, 387)):
        pen.rectangle(box, outline=0, width=3)
    for x, y in ((250, 102), (600, 398), (102, 250), (798, 180), (443, 220)):
        pen.ellipse((x - 10, y - 10, x + 10, y + 10), outline=0)
        for k in (-5, 5):
            pen.line((x - 16, y + k, x + 16, y + k) if x in (102, 443, 798) else (x + k, y - 16, x + k, y + 16), fill=0)
    assert len(import_plan(picture_file(page), ImportOptions(metres_per_pixel=0.01)).document["rooms"]) == 2


@pytest.mark.parametrize("name", ["OPENPORCH", "Roof"])
def test_area_that_thin_lines_bound_is_a_room_where_a_terrace_is_written(name: str):
    page = np.full((500, 1000), 255, np.uint8)
    page[90:410, 90:610] = 0
    page[110:390, 110:590] = 255
    page[150:350, 898:900] = page[150:152, 600:900] = page[348:350, 600:900] = 0
    letterings = [Lettering(name, (7.5, 2.5), is_ocr=True)]
    sketch = sketch_picture(page, 0.01, ReportBuilder(), Budget(ImportLimits()), letterings=letterings)
    assert len(sketch.rooms) == (2 if name == "OPENPORCH" else 1)


def test_openings_that_look_like_doors_inside_are_doors_outside():
    page = Image.new("L", (1500, 500), 255)
    pen = ImageDraw.Draw(page)
    pen.rectangle((100, 100, 1400, 400), outline=0, width=20)
    for x in (400, 700, 1000):
        pen.line((x, 100, x, 400), fill=0, width=12)
        pen.rectangle((x - 6, 200, x + 6, 290), fill=255, outline=150)
    for x in (160, 480, 800, 1100):
        pen.rectangle((x, 100, x + 150, 119), fill=255, outline=150)
        pen.rectangle((x + 12, 106, x + 138, 112), outline=150)
    pen.rectangle((1200, 381, 1290, 400), fill=255, outline=150)
    # A closet of half a metre.
    pen.line((100, 330, 400, 330), fill=0, width=10)
    plan = import_plan(picture_file(page), ImportOptions(metres_per_pixel=0.01)).document
    assert len(lines(plan, "door")) == len(lines(plan, "window")) == 4
    assert len(plan["rooms"]) == 5


def test_single_line_is_a_window_outside_and_a_passage_inside():
    page, pen = two_rooms()
    for box, ends in [((200, 95, 320, 125), (200, 110, 320, 110)), ((440, 200, 460, 290), (450, 200, 450, 290))]:
        pen.rectangle(box, fill="white")
        pen.line(ends, fill="black", width=2)
    plan = import_plan(picture_file(page), ImportOptions(metres_per_pixel=0.01))
    assert len(plan.document["rooms"]) == 2
    (window,) = lines(plan.document, "window")
    assert window.length == pytest.approx(1.2, abs=0.03)
    assert len(lines(plan.document, "passage")) == 1
    assert sum("a single line" in guess for guess in plan.report.unsure) == 2


def test_picture_is_a_draft_with_its_guesses(drawn: dict[Style, DrawnPlan]):
    plan = import_plan(drawn["thick"].png(), ImportOptions(metres_per_pixel=drawn["thick"].metres_per_pixel))
    assert plan.report.is_draft
    assert plan.report.scale_source == "option metres_per_pixel"
    assert any("ceiling height" in line for line in plan.report.unsure)
    assert any("texts of the picture were read" in line for line in plan.report.notes)


@pytest.mark.slow
def test_draft_uses_its_openings_as_far_as_they_seem_complete(drawn: dict[Style, DrawnPlan]):
    draft = import_plan(drawn["thick"].png(), ImportOptions(metres_per_pixel=drawn["thick"].metres_per_pixel))
    assert draft.plan().opening_kinds == frozenset()
    assert draft.plan().opening_trust["door"] > 0.8
    assert {entry.kind: entry.trust for entry in draft.report.opening_trust}["door"] < 1.0


@pytest.mark.parametrize("options", [ImportOptions(), ImportOptions(units="m")])
def test_picture_without_scale_gets_that_of_its_doors(drawn: dict[Style, DrawnPlan], options: ImportOptions):
    report = import_plan(drawn["thick"].png(), options).report
    assert 0.0 < report.scale_std < 0.1
    assert report.metres_per_unit == pytest.approx(drawn["thick"].metres_per_pixel, rel=3.0 * report.scale_std)
    clues = {clue.kind: clue for clue in report.scale_clues}
    assert clues["leaf"].is_used
    assert clues["leaf"].count >= 2
    assert clues["leaf"].std < clues["wall"].std
    (assumption,) = (warning for warning in report.warnings if "m per unit is assumed" in warning)
    assert "door leaves" in assumption
    assert "set known_distance" in assumption


def test_picture_without_scale_and_doors_is_rejected():
    page = Image.new("RGB", (600, 400), "white")
    ImageDraw.Draw(page).rectangle((60, 60, 540, 340), outline="black", width=12)
    with pytest.raises(InvalidFloorPlanError, match=r"the picture gives no scale, and too few doors.*known_distance"):
        import_plan(picture_file(page))


@pytest.mark.slow
def test_known_distance_sets_the_scale(drawn: dict[Style, DrawnPlan]):
    plan = drawn["thick"]
    known = KnownDistance((10.0, 10.0), (10.0, 110.0), 100.0 * plan.metres_per_pixel)
    by_distance = import_plan(plan.png(), ImportOptions(known_distance=known))
    by_pixel = import_plan(plan.png(), ImportOptions(metres_per_pixel=plan.metres_per_pixel))
    assert by_distance.document == by_pixel.document


@pytest.mark.slow
def test_scan_resolution_and_paper_scale_set_the_scale(drawn: dict[Style, DrawnPlan]):
    plan = drawn["thick"]
    # 80 pixels to a metre are 1:125 at 254 dots per inch.
    by_paper = import_plan(picture_file(plan.picture, dpi=(254, 254)), ImportOptions(scale=125.0))
    assert by_paper.report.metres_per_unit == pytest.approx(plan.metres_per_pixel, rel=1e-3)
    with pytest.raises(InvalidFloorPlanError, match="no size on paper"):
        import_plan(plan.png(), ImportOptions(scale=125.0))


@pytest.mark.parametrize("factor", [0.02, pytest.param(30.0, marks=pytest.mark.slow)])
def test_wrong_scale_is_rejected(drawn: dict[Style, DrawnPlan], factor: float):
    plan = drawn["thick"]
    options = ImportOptions(metres_per_pixel=factor * plan.metres_per_pixel)
    with pytest.raises(InvalidFloorPlanError, match="check the scale"):
        import_plan(plan.png(), options)


def test_empty_picture_is_rejected():
    with pytest.raises(InvalidFloorPlanError, match="no walls that enclose a room"):
        import_plan(picture_file(Image.new("RGB", (400, 300), "white")), ImportOptions(metres_per_pixel=0.01))


@pytest.mark.parametrize("degrees", [-6.0, 0.0, 2.5])
def test_skew_is_found(degrees: float):
    page = Image.new("L", (600, 400), 0)
    for x in (100, 300, 480):
        page.paste(255, (x, 60, x + 8, 340))
    page.paste(255, (100, 60, 488, 68))
    turned = np.asarray(page.rotate(degrees, Image.Resampling.BICUBIC)) > 128
    assert find_skew(turned) == pytest.approx(-degrees, abs=0.15)


def vector_pdf(more: str = "", layer: str = "") -> bytes:
    """Return a page with filled walls, a door and texts at 1:100, and more operators in centimetres.

    `layer` are members of a layer /L, which the operators can be on.
    """
    centimetre = 72 / 2.54
    content = f"{centimetre:.5f} 0 0 {centimetre:.5f} 28 28 cm 0 g\n{more}\n"
    for x, y, w, h in [
        (0, 0, 9.3, 0.15), (0, 5.15, 9.3, 0.15), (0, 0, 0.15, 5.3), (9.15, 0, 0.15, 5.3),
        (4.5, 0, 0.1, 1.5), (4.5, 2.4, 0.1, 2.8),
    ]:  # fmt: skip
        content += f"{x} {y} {w} {h} re f\n"
    content += "0.02 w 4.6 1.5 m 5.5 1.5 l S 5.5 1.5 m 5.5 1.997 5.097 2.4 4.6 2.4 c S\n"
    for text, x in (("Kitchen", 1.5), ("Wohnzimmer", 6.5), ("1:100", 0.2)):
        content += f"BT /F1 0.4 Tf {x} {2.5 if x > 1 else -0.6} Td ({text}) Tj ET\n"
    for line in range(8):
        content += f"7 {4 + 0.1 * line:.1f} m 8 {4 + 0.1 * line:.1f} l S\n"
    objects = [
        "<< /Type /Catalog /Pages 2 0 R /OCProperties << /OCGs [6 0 R] /D << >> >> >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        "<< /Type /Page /Parent 2 0 R /MediaBox [0 0 400 300] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> /Properties << /L 6 0 R >> >> >>",
        f"<< /Length {len(content)} >>\nstream\n{content}endstream",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        f"<< /Type /OCG /Name (Old) {layer} >>",
    ]
    out, offsets = "%PDF-1.4\n", []
    for number, body in enumerate(objects, 1):
        offsets.append(len(out))
        out += f"{number} 0 obj\n{body}\nendobj\n"
    start = len(out)
    places = "".join(f"{offset:010} 00000 n \n" for offset in offsets)
    out += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{places}"
    return f"{out}trailer << /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{start}\n%%EOF\n".encode()


@pytest.mark.parametrize("use", ["View", "Print"])
def test_layer_of_a_pdf_that_is_off_by_its_use_is_left_out(use: str):
    wall = "/OC /L BDC 2 0 0.1 5.3 re f EMC"
    assert len(import_plan(vector_pdf(wall)).document["rooms"]) == 3
    plan = import_plan(vector_pdf(wall, f"/Usage << /{use} << /{use}State /OFF >> >>"))
    assert len(plan.document["rooms"]) == 2
    assert any("switched off in the PDF were not read: 'Old'" in line for line in plan.report.notes)


@pytest.mark.parametrize(("picture", "count"), [("", 0), ("q 3 0 0 4 10 1 cm BI /W 1 /H 1 /CS /G /BPC 8 ID x EI Q", 1)])
def test_pdf_with_lines_is_read_as_a_drawing(picture: str, count: int):
    plan = import_plan(vector_pdf(picture))
    assert sum("pictures cover 8% of the page" in warning for warning in plan.report.warnings) == count
    assert plan.report.scale_source == "1:100, written in the drawing"
    (doubt,) = import_plan(vector_pdf(), ImportOptions(scale=50.0)).report.warnings
    assert doubt.startswith("the median width of the leaves of 1 doors is 0.45 m")
    assert plan.report.is_draft
    assert sorted(names_and_types(plan)) == [("Kitchen", "kitchen"), ("Wohnzimmer", "living")]
    assert sorted(room.area for room in shapes(plan.document)) == pytest.approx([4.35 * 5.0, 4.55 * 5.0], rel=5e-3)
    (door,) = lines(plan.document, "door")
    assert door.length == pytest.approx(0.9, abs=0.02)


@pytest.mark.slow
def test_scanned_pdf_is_read_as_a_picture(drawn: dict[Style, DrawnPlan]):
    plan = drawn["thick"]
    content = picture_file(plan.picture, "PDF", resolution=254.0)
    imported = import_plan(content, ImportOptions(scale=125.0))
    assert len(imported.document["rooms"]) == len(plan.rooms)
    assert "page 1 was read as a picture" in imported.report.notes
    with pytest.raises(InvalidFloorPlanError, match="page is 2; the PDF has 1 pages"):
        import_plan(content, ImportOptions(scale=125.0, page=2))
    assert "estimated" in import_plan(content).report.scale_source


@pytest.mark.slow
def test_clear_symbols_become_fixtures_and_other_shapes_are_counted():
    plan = draw_plan("thick", 2, has_symbols=True)
    draft = import_plan(plan.png(), ImportOptions(metres_per_pixel=plan.metres_per_pixel))
    fixtures = [(entry["kind"], shapely.Polygon(entry["outline"])) for entry in draft.document["fixtures"]]
    assert {kind for kind, _ in fixtures} == {"stairs", "sink", "bath", "stove", "basin", "shower"}
    for kind, outline in fixtures:
        assert any(item.kind == kind and intersection_over_union(item.outline, outline) > 0.6 for item in plan.symbols)
    assert any("fixtures are taken from their symbols" in line for line in draft.report.unsure)
    assert any("no clear symbols of fixtures" in line for line in draft.report.notes)


@pytest.mark.slow
def test_walls_that_are_unreadable_without_symbols_are_read_with_them():
    plan = draw_plan("thin", 2, has_symbols=True)
    draft = import_plan(plan.png(), ImportOptions(metres_per_pixel=plan.metres_per_pixel))
    assert len(draft.document["rooms"]) == len(plan.rooms)


def test_white_rooms_with_dark_walls_on_a_transparent_ground_are_rooms():
    picture = Image.new("RGBA", (1400, 1100))
    draw = ImageDraw.Draw(picture)
    draw.rectangle((300, 300, 1100, 800), fill="white", outline="black", width=20)
    draw.rectangle((690, 300, 709, 800), fill="black")
    draft = import_plan(picture_file(picture), ImportOptions(metres_per_pixel=0.01))
    assert sorted(room.area for room in shapes(draft.document)) == pytest.approx([17.1, 17.1], abs=0.8)
