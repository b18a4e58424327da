"""Parts of pages and pictures: storeys that are drawn beside each other, and their titles."""

from __future__ import annotations

import pytest
import shapely
from ezdxf.filemanagement import new as new_dxf
from PIL import Image, ImageDraw

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers import ImportOptions, import_plan, import_plans
from lalaloc_core.importers.common.import_limits import Budget
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.common.sketch import Sketch, SketchedRoom
from lalaloc_core.importers.drawing.storeys import assemble_storeys, title_of
from lalaloc_core.importers.drawing.vector_drawing import Lettering
from tests.importers.conftest import dxf_file, shapes
from tests.painted import picture_file

SCALE = 0.02


def _storeys() -> Image.Image:
    """Return two storeys at 2 cm per pixel: two rooms of 30 m² in all beside a room of 16 m²."""
    page = Image.new("L", (800, 400), 255)
    pen = ImageDraw.Draw(page)
    for box in ((40, 60, 355, 325), (500, 60, 715, 275)):
        pen.rectangle(box, outline=0, width=10)
    pen.rectangle((190, 60, 199, 325), fill=0)
    pen.rectangle((190, 150, 199, 195), fill=255)
    return page


def test_largest_of_several_storeys_is_read_and_the_others_are_named():
    plan = import_plan(picture_file(_storeys()), ImportOptions(metres_per_pixel=SCALE))
    assert len(plan.document["rooms"]) == 2
    (warning,) = (warning for warning in plan.report.warnings if "storeys seem to be drawn" in warning)
    assert "this plan is 'Storey 1'" in warning
    crop = warning.split("m² at crop=")[2].split(";")[0]
    options = ImportOptions.from_text({"metres_per_pixel": str(SCALE), "crop": crop})
    other = import_plan(picture_file(_storeys()), options)
    (room,) = shapes(other.document)
    assert room.area == pytest.approx(15.6, abs=0.5)
    # Coordinates stay those of the whole picture.
    assert room.bounds[0] == pytest.approx(510 * SCALE, abs=0.05)


def test_every_storey_of_a_picture_is_a_level():
    options = {"metres_per_pixel": str(SCALE)}
    left, right = import_plans(picture_file(_storeys()), ImportOptions.from_text(options), building="House")
    assert (left.document["name"], right.document["name"]) == ("House – Storey 1", "House – Storey 2")
    assert left.report.levels == right.report.levels == ("Storey 1", "Storey 2")
    # The doorway of the first storey is said of it alone.
    assert [sum("taken for a passage" in line for line in plan.report.unsure) for plan in (left, right)] == [1, 0]
    chosen = import_plan(picture_file(_storeys()), ImportOptions.from_text({**options, "level": "Storey 2"}))
    assert chosen.document["rooms"] == right.document["rooms"]


@pytest.mark.parametrize(("gap_px", "count"), [(24, 2), (6, 1)])
def test_storeys_are_apart_where_no_wall_joins_them(gap_px: int, count: int):
    page = Image.new("L", (400, 500), 255)
    pen = ImageDraw.Draw(page)
    for top in (20, 240 + gap_px):
        pen.rectangle((40, top, 355, top + 220), outline=0, width=10)
    assert len(import_plans(picture_file(page), ImportOptions(metres_per_pixel=SCALE))) == count


def test_storeys_have_the_levels_of_their_titles():
    rooms = [SketchedRoom(shapely.box(0.0, y, 6.0, y + 4.0)) for y in (0.0, 6.0, 12.0)]
    texts = {"FIRST FLOOR": (-3.0, 2.0), "Ground floor": (-3.0, 8.0), "Loft": (3.0, 14.0), "Garage": (-3.0, 14.0)}
    titles = [Lettering(text, position) for text, position in texts.items()]
    sketch = Sketch(rooms=rooms)
    plans = assemble_storeys(sketch, titles, ReportBuilder("picture"), ImportOptions(), Budget(), lambda box: box)
    found = [(plan.level.name, plan.level.number) for plan in plans if plan.level is not None]
    assert sorted(found, key=str) == [("FIRST FLOOR", 1.0), ("Ground floor", 0.0), ("Storey 1", None)]


@pytest.mark.parametrize(("text", "number"), [
    ("Second Floor", 2), ("1st floor", 1), ("Level 2", 2), ("2. Obergeschoss", 2), ("1. UG", -1), ("EG", 0), ("4OG", 4),
    ("Lower level", -1), ("Living room", None), ("950 SF", None), ("2", None), ("First aid", None), ("12 m", None),
])  # fmt: skip
def test_titles_of_storeys(text: str, number: int | None):
    level = title_of(text)
    assert (None if level is None else level.number) == number


def test_crop_of_a_scanned_page_is_in_points_from_its_lower_left_corner():
    scan = picture_file(_storeys(), "PDF", resolution=72.0)
    plan = import_plan(scan, ImportOptions(metres_per_pixel=SCALE, crop=(780.0, 370.0, 450.0, 90.0)))
    assert len(plan.document["rooms"]) == 1
    assert shapes(plan.document)[0].area == pytest.approx(15.6, abs=0.5)


def test_crop_cuts_the_lines_of_a_drawing():
    rooms = '<path d="M0 0H500V400H0z"/><path d="M900 0H1300V300H900z"/><path d="M-50 -60H1500"/>'
    svg = f'<svg xmlns="http://www.w3.org/2000/svg"><g stroke="black" fill="none" id="wall">{rooms}</g></svg>'
    options = ImportOptions(metres_per_pixel=0.01, crop=(850.0, -20.0, 1400.0, 350.0))
    (room,) = shapes(import_plan(svg.encode(), options).document)
    assert room.area == pytest.approx(12.0, abs=0.2)


@pytest.mark.parametrize(("gap", "count"), [(40, 1), (0, 0)])
def test_storeys_of_lines_are_apart_where_no_wall_joins_them(gap: int, count: int):
    walls = "".join(f'<path d="M0 {y}h600v400h-600z M30 {y + 30}h540v340h-540z"/>' for y in (0, 400 + gap))
    svg = f'<svg xmlns="http://www.w3.org/2000/svg"><g stroke="black" fill="none">{walls}</g></svg>'
    warnings = import_plan(svg.encode(), ImportOptions(metres_per_pixel=0.01)).report.warnings
    assert sum("2 storeys seem to be drawn side by side" in warning for warning in warnings) == count


@pytest.mark.parametrize("format", ["svg", "dxf"])
def test_storeys_of_a_vector_drawing_are_named_with_their_crop(format: str):
    storeys = [(0.0, 0.0, 5.0, 4.0), (9.0, 0.0, 13.0, 3.5)]
    if format == "svg":
        rooms = "".join(f'<rect x="{x0}" y="{y0}" width="{x1 - x0}" height="{y1 - y0}"/>' for x0, y0, x1, y1 in storeys)
        content = f'<svg xmlns="http://www.w3.org/2000/svg"><g id="rooms">{rooms}</g></svg>'.encode()
        options = {"metres_per_pixel": "1"}
    else:
        document = new_dxf("R2010", units=6)
        for box in storeys:
            points = list(shapely.box(*box).exterior.coords)[:-1]
            document.modelspace().add_lwpolyline(points, close=True, dxfattribs={"layer": "ROOM"})
        content, options = dxf_file(document), {}
    plan = import_plan(content, ImportOptions.from_text(options))
    (warning,) = (warning for warning in plan.report.warnings if "storeys seem to be drawn" in warning)
    assert "they were read as one" in warning
    crop = warning.split("m² at crop=")[2].split(";")[0]
    (room,) = shapes(import_plan(content, ImportOptions.from_text({**options, "crop": crop})).document)
    assert room.area == pytest.approx(14.0, abs=0.1)


@pytest.mark.parametrize(("crop", "message"), [
    ("1,2,3", "crop has 3 numbers"), ("5,5,5,9", "two opposite corners"), ("0,0,20,20", "has at least 64 x 64"),
    ("900,0,1200,300", "has at least 64 x 64"), ("a,0,1,1", "must be a number"),
])  # fmt: skip
def test_invalid_crop_is_rejected(crop: str, message: str):
    with pytest.raises(InvalidFloorPlanError, match=message):
        import_plan(picture_file(_storeys()), ImportOptions.from_text({"crop": crop, "metres_per_pixel": str(SCALE)}))
