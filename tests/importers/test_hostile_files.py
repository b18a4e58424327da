"""Files made to exhaust resources or to read other files are rejected quickly, with a reason."""

from __future__ import annotations

import itertools
import json
import pickle
import re
import struct
import time
from contextlib import suppress
from dataclasses import fields
from importlib import import_module
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import shapely
import svgelements
from ezdxf.filemanagement import new as new_dxf
from PIL import Image

from benchmarks.hostile_drawings import HOSTILE_PLANS, pdf
from benchmarks.hostile_files import HostilePlan, star
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import DEFAULT_LIMITS
from lalaloc_core.importers import EXPORT_FORMATS, FORMATS, ImportLimits, ImportOptions, detect_format, import_plans
from lalaloc_core.importers.common.assemble import assemble
from lalaloc_core.importers.common.geometry import check_network, polygons_of
from lalaloc_core.importers.common.import_limits import Budget
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.common.room_bounds import ROOM_BOUNDS
from lalaloc_core.importers.common.sketch import Sketch, SketchedRoom
from lalaloc_core.importers.drawing import enclosed_rooms
from lalaloc_core.importers.drawing.enclosed_rooms import enclose
from lalaloc_core.importers.formats import dxf, pdf_page
from lalaloc_core.importers.picture import lettering, wall_mask
from lalaloc_core.importers.picture.ink import read_ink
from lalaloc_core.importers.picture.occupancy import sketch_map
from tests.importers.conftest import EXTERNAL_ENTITY, FLAT, NESTED_ENTITIES, ZIP_BOMB, dxf_file, large_picture, zip_file
from tests.painted import picture_file
from tests.strategies import present

SVG = '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink">{}</svg>'


def _assert_rejected(content: bytes, message: str, **limits: object) -> None:
    with pytest.raises(InvalidFloorPlanError, match=message):
        import_plans(content, ImportOptions(metres_per_pixel=0.01), ImportLimits(**limits))  # type: ignore[arg-type]


DOCTYPE = '<!DOCTYPE svg SYSTEM "http://127.0.0.1:1/x.dtd">'
HOSTILE: dict[str, tuple[bytes, str]] = {
    "nested XML entities": (NESTED_ENTITIES, "declares entities"),
    "external XML entities": (EXTERNAL_ENTITY, "entities"),
    "external doctype": (f"{DOCTYPE}{SVG.format('')}".encode(), "refers to other files|no room"),
    "recursive use": (SVG.format('<g id="a"><use href="#a"/></g>').encode(), "refers to itself"),
    "nested elements": (SVG.format("<g>" * 500 + "</g>" * 500).encode(), "nested more than"),
    "nested JSON": (("[" * 100_000 + "]" * 100_000).encode(), "nested"),
    "too many pixels": (large_picture(100_000), "pixels|cannot be read"),
    "truncated picture": (picture_file(Image.new("L", (200, 200), 255))[:90], "cannot be read"),
}


@pytest.mark.parametrize(("content", "message"), HOSTILE.values(), ids=HOSTILE)
def test_hostile_file_is_refused(content: bytes, message: str):
    _assert_rejected(content, message)


def test_file_above_the_size_limit():
    _assert_rejected(b"{" + b" " * 200, "the limit is 100 ", max_plan_bytes=100)


def test_references_to_many_entities_are_not_searched_one_by_one():
    names = [f"e{number:04d}" for number in range(2000)]
    subset = "".join(f'<!ENTITY {name} "x">' for name in names)
    _assert_rejected(f"<!DOCTYPE svg [{subset}]>{SVG.format('&e0000;')}".encode(), "declares entities")


def test_rooms_within_rooms_are_counted_before_they_are_compared(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(shapely, "union_all", lambda shapes: pytest.fail("compared"))
    features = [
        {
            "type": "Feature",
            "properties": {"indoor": "room"},
            "geometry": {"type": "Polygon", "coordinates": [[[0, 0], [size, 0], [size, size], [0, size], [0, 0]]]},
        }
        for size in np.linspace(10.0, 100.0, 600).tolist()
    ]
    document = {"type": "FeatureCollection", "units": "m", "features": features}
    _assert_rejected(json.dumps(document).encode(), "600 rooms lie over one another")


def _nested_uses() -> str:
    uses = [f'<use xlink:href="#g{i - 1}"/>' * 10 for i in range(1, 12)]
    groups = "".join(f'<g id="g{i}">{use}</g>' for i, use in enumerate(uses, 1))
    return f'<rect id="g0" width="1" height="1"/>{groups}'


def test_nested_uses():
    _assert_rejected(SVG.format(_nested_uses()).encode(), "entities")


@pytest.mark.parametrize(
    ("target", "hidden"),
    [
        # svgelements drops the first character of a reference, whatever it is, and finds empty ids.
        ('href="xg11"', ""),
        ('xlink:href="#none" href="#g11"', ""),
        ('href="#"', '<g id=""><use href="#g11"/></g>'),
        # Patterns are not drawn, so their ids hide no other element.
        ('href="#g11"', '<pattern><rect id="g11"/></pattern>'),
    ],
)
def test_nested_uses_with_unusual_references(target: str, hidden: str):
    drawn = f"<defs>{_nested_uses()}</defs>{hidden}<use {target}/>"
    _assert_rejected(SVG.format(drawn).encode(), "entities")


def test_zip_above_the_unpacked_limit():
    assert len(ZIP_BOMB) < 10_000
    _assert_rejected(ZIP_BOMB, "unpacks to more than", max_unpacked_bytes=1_000_000)


def test_zip_with_forged_sizes():
    content = ZIP_BOMB.replace(struct.pack("<I", 3_000_000), struct.pack("<I", 10))
    _assert_rejected(content, "damaged|unpacks|JSON", max_unpacked_bytes=1_000_000)


def test_zip_with_too_many_files_or_a_password():
    _assert_rejected(zip_file({f"{number}.geojson": b"{}" for number in range(300)}), "300 files")
    content = bytearray(zip_file({"unit.geojson": b"{}"}))
    # Set the encryption bit in the file's header and in the directory.
    content[6] |= 1
    content[content.index(b"PK\x01\x02") + 8] |= 1
    _assert_rejected(bytes(content), "encrypted")


@pytest.mark.parametrize("is_empty", [False, True])
def test_nested_blocks(is_empty: bool):
    document = new_dxf()
    lowest = document.blocks.new("B0")
    if not is_empty:
        lowest.add_line((0, 0), (1, 1))
    for level in range(1, 8):
        block = document.blocks.new(f"B{level}")
        for x in range(10):
            block.add_blockref(f"B{level - 1}", (x, 0))
    array = {} if is_empty else {"row_count": 100, "column_count": 100}
    document.modelspace().add_blockref("B7", (0, 0), dxfattribs=array)
    _assert_rejected(dxf_file(document), "more than 300000 entities" if is_empty else "entities")


def _dxf_text(*pairs: tuple[int, object]) -> bytes:
    return "".join(f"{code}\n{value}\n" for code, value in pairs).encode()


def _dxf_insert(rows: int, columns: int) -> bytes:
    """Return a drawing of 130 bytes that repeats an empty block."""
    blocks = [(0, "SECTION"), (2, "BLOCKS"), (0, "BLOCK"), (2, "A"), (0, "ENDBLK"), (0, "ENDSEC")]
    array = [(2, "A"), (10, 0), (20, 0), (70, rows), (71, columns), (44, 1), (45, 1)]
    return _dxf_text(*blocks, (0, "SECTION"), (2, "ENTITIES"), (0, "INSERT"), *array, (0, "ENDSEC"), (0, "EOF"))


@pytest.mark.parametrize(("rows", "columns"), [(10**9, 1), (1, 10**9), (40_000, 40_000)])
def test_repeated_empty_block(rows: int, columns: int):
    content = _dxf_insert(rows, columns)
    assert len(content) < 241
    _assert_rejected(content, "more than 300000 entities")


def test_time_is_checked_at_every_empty_block():
    ticks, limits = itertools.count(), ImportLimits(max_import_s=500.0)
    with pytest.raises(InvalidFloorPlanError, match="takes more than"):
        import_plans(_dxf_insert(100, 100), ImportOptions(units="m"), limits, lambda: float(next(ticks)))


def test_curves_beyond_the_stated_size_have_few_points(monkeypatch: pytest.MonkeyPatch):
    counts = []
    whole = dxf._flatten

    def counted(*arguments: Any) -> np.ndarray:
        points = whole(*arguments)
        counts.append(len(points))
        return points

    monkeypatch.setattr(dxf, "_flatten", counted)
    for radius in (1e3, 1e5, 1e7, 1e9):
        circle = [(0, "CIRCLE"), (8, "WALL"), (10, 0), (20, 0), (40, radius)]
        content = _dxf_text((0, "SECTION"), (2, "ENTITIES"), *circle, (0, "ENDSEC"), (0, "EOF"))
        with suppress(InvalidFloorPlanError):
            import_plans(content, ImportOptions(units="mm"))
    assert len(counts) == 4
    assert max(counts) <= 2 * counts[0]


def test_import_above_the_time_limit():
    ticks = itertools.count(0.0, 10.0)
    with pytest.raises(InvalidFloorPlanError, match="takes more than 30 s of CPU time"):
        import_plans(json.dumps(FLAT).encode(), clock=lambda: next(ticks) * 10.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (b"hello there", "in no known format; supported formats are native JSON, GeoJSON, OpenStreetMap"),
        (b"AC1032 dwg", "a DWG drawing, and no program that reads it is installed|could not read the DWG drawing"),
        (b'{"doors": [], "foo": 1}', "the members 'doors', 'foo', of no known format; .* RoomPlan 'walls'"),
        (b'{"image": {}, "path": {}, "robot": [1, 2]}', "vacuum robot, .*: export it as a Valetudo map"),
        (b'{"rooms": {}, "vacuum_position": {}}', "a map of a vacuum robot, which cannot be read: export it"),
        (b"GIF89a", "a GIF picture, which cannot be read: save it as PNG"),
        (b"<html></html>", "an HTML page, such as the page of a link to a file, .*: download the file itself"),
        (b"<page></page>", "XML of no known kind: save a drawing as SVG or DXF, a map as OSM or IndoorGML"),
        (b"Rar!....", "a RAR archive, which cannot be read: unpack it"),
        (b"[1, 2]", "the JSON is a list"),
        (b"ISO-10303-21; nothing", "truncated"),
        (b"ISO-10303-21; nothing END-ISO-10303-21;", "cannot be read|no IfcSpace|schema"),
        (b"  0\nSECTION\n nothing", "cannot be read|no lines"),
        (b"\xff\xd8\xff nothing", "cannot be read"),
    ],
)
def test_other_kinds_of_files_are_named(content: bytes, message: str):
    _assert_rejected(content, message)


def test_format_is_detected_by_content():
    assert detect_format(b'\xef\xbb\xbf {"rooms": []}') == "native"
    assert detect_format(b'{"type": "Feature"}') == "geojson"
    assert detect_format(b'<?xml version="1.0"?><!-- x --><svg/>') == "svg"
    assert detect_format(b"999\nmade by\n  0\nSECTION\n") == "dxf"
    assert detect_format(b"%PDF-1.4") == "pdf"


def test_every_format_has_a_reader_and_every_export_a_writer():
    for name, format in FORMATS.items():
        module = import_module(f"lalaloc_core.importers.formats.{name}")
        assert callable(module.read)
        assert hasattr(module, "write") == (name in EXPORT_FORMATS)
        assert format.options <= {field.name for field in fields(ImportOptions)}


def test_plans_and_options_can_be_pickled():
    (plan,) = import_plans(json.dumps(FLAT).encode())
    assert pickle.loads(pickle.dumps(plan)).document == plan.document
    assert pickle.loads(pickle.dumps(ImportOptions(scale=100.0))) == ImportOptions(scale=100.0)


def lined_up_rooms(count: int) -> Sketch:
    """Return rooms in a row, each with a column in it."""
    rooms = [SketchedRoom(shapely.box(5.0 * k, 0.0, 5.0 * k + 4.0, 4.0)) for k in range(count)]
    return Sketch(rooms=rooms, obstacles=[shapely.box(5.0 * k + 1.0, 1.0, 5.0 * k + 2.0, 2.0) for k in range(count)])


def test_obstacles_are_compared_with_the_rooms_near_them(monkeypatch: pytest.MonkeyPatch) -> None:
    compared = []
    intersects = shapely.Polygon.intersects

    def counted(first: shapely.Polygon, second: shapely.Geometry) -> bool:
        compared.append(second)
        return intersects(first, second)

    monkeypatch.setattr(shapely.Polygon, "intersects", counted)
    options = ImportOptions(ceiling_height_m=2.5)
    plan = assemble(lined_up_rooms(40), ReportBuilder("dxf", 1.0, "m"), options, DEFAULT_LIMITS)
    assert all(len(room["holes"]) == 1 for room in plan.document["rooms"])
    assert len(compared) == 40


def test_gaps_and_rooms_are_compared_with_their_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    intersection = Mock(wraps=shapely.intersection)
    monkeypatch.setattr(shapely, "intersection", intersection)
    # Square rooms with a gap of 1 m in one wall.
    bodies = []
    for x in np.arange(30) * 6.0:
        walls = shapely.box(x, 0, x + 4, 4).difference(shapely.box(x + 0.2, 0.2, x + 3.8, 3.8))
        body = walls.difference(shapely.box(x + 1.5, -1, x + 2.5, 1))
        assert isinstance(body, shapely.Polygon)
        bodies.append(body)
    found = enclose(bodies, [])
    assert (len(found.rooms), len(found.gaps)) == (30, 30)
    # Each gap is found from both sides.
    assert sum(isinstance(call.args[1], shapely.Polygon) for call in intersection.call_args_list) == 30


def test_loose_ends_are_compared_with_their_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    norm = Mock(wraps=np.linalg.norm)
    monkeypatch.setattr(np.linalg, "norm", norm)
    lines = [shapely.LineString([(0, y), (3, y)]) for k in range(50) for y in (2.0 * k, 2.0 * k + 0.2)]
    joints = enclosed_rooms._joints(lines, ROOM_BOUNDS.walls)
    # A jamb at both ends of each wall, found from both of its faces.
    assert [joint.length for joint in joints] == pytest.approx([0.2] * 200)
    assert sum(call.args[0].size // 2 for call in norm.call_args_list) < 5 * 200


# Pictures, and pages that are drawn, take seconds whatever they show; so do some others.
_DRAWN, _LONG = {"picture", "pdf"}, ("mega", "noise", "a lattice of thick", "one way in many", "clippings of")


@pytest.mark.parametrize(
    "plan",
    [
        pytest.param(
            plan,
            id=f"{plan.format}, {plan.title}",
            marks=[pytest.mark.slow] if plan.format in _DRAWN or any(words in plan.title for words in _LONG) else [],
        )
        for plan in HOSTILE_PLANS
        # PDFium expands nested forms while it loads a page: only a worker's limit ends that (test_plan_files.py).
        if plan.title != "nested forms"
    ],
)
def test_small_file_takes_little_time(plan: HostilePlan):
    content = plan.make(20_000)
    begin_s = time.process_time()
    with suppress(InvalidFloorPlanError):
        import_plans(content, plan.options)
    # Of processor time, for any machine: without their limits such files took minutes.
    assert time.process_time() - begin_s < (60.0 if plan.format in _DRAWN or "mega" in plan.title else 20.0)


def test_outline_that_crosses_itself_is_refused_before_it_is_repaired(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(shapely, "make_valid", pytest.fail)
    with pytest.raises(InvalidFloorPlanError, match=r"2001 points .* crosses itself more than 2000 times"):
        polygons_of(shapely.Polygon(star(2001)))


def test_outline_that_crosses_itself_a_few_times_is_repaired():
    assert len(polygons_of(shapely.Polygon(star(5)))) == 5


def test_crossing_lines_are_refused_before_they_are_joined(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(shapely, "unary_union", pytest.fail)
    lines = [shapely.LineString([(0.1 * k, 0), (0.1 * k, 99)]) for k in range(500)]
    lines += [shapely.LineString([(0, 0.1 * k), (99, 0.1 * k)]) for k in range(500)]
    with pytest.raises(InvalidFloorPlanError, match=r"1000 lines .* cross more than 11000 times"):
        enclose([], lines)


def test_lines_that_meet_at_their_ends_do_not_cross():
    points = [(np.cos(k), np.sin(k)) for k in np.linspace(0.0, 6.0, 2000)]
    check_network([shapely.LineString([a, b]) for a, b in itertools.pairwise(points)] * 5)


@pytest.mark.parametrize("number", ["nan", "inf", "-1e308", "91"])
def test_latitude_out_of_range_is_named(number: str):
    osm = f'<osm><node id="1" lat="{number}" lon="0"/><way id="2"><nd ref="1"/><tag k="indoor" v="room"/></way></osm>'
    _assert_rejected(osm.encode(), rf"lat '?{re.escape(str(float(number)))}'?; it must be a number")


@pytest.mark.parametrize("lines", ["a: &a [1]\nb: *a", "a: {<<: {b: 1}}", "a: &a {b: 1}\nb: {<<: *a}"])
def test_yaml_that_repeats_values_is_refused(lines: str):
    yaml = f"image: a.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n{lines}\n"
    _assert_rejected(zip_file({"map.yaml": yaml, "a.pgm": b"P5\n1 1\n255\n0"}), "an alias .* or a merge key")


@pytest.mark.parametrize(
    ("title", "message"),
    [
        ("a placement in itself", "the IfcLocalPlacement #7 is relative to itself"),
        ("a number of 1.E400", "the number 1.E400; the limit is 1.E100"),
    ],
)
def test_fault_of_a_model_is_named(title: str, message: str):
    pytest.importorskip("ifcopenshell")
    _assert_rejected(_hostile("ifc", title).make(1000), message)


def _hostile(format: str, title: str) -> HostilePlan:
    return next(plan for plan in HOSTILE_PLANS if (plan.format, plan.title) == (format, title))


@pytest.mark.parametrize(
    ("title", "message"),
    [
        ("declarations for all", r"styles, classes, transforms and paths of the SVG's \d+ elements, with copies"),
        ("a rule of one class", r"style rules of the SVG repeat declarations of more than \d+ characters"),
        ("a transform around all", r"transforms count 12 times"),
        ("copies of a path", r"paths 100 times"),
        ("copies of classes", r"\d+ characters .*; the limit is \d+ for its size"),
        ("symbols of symbols", r"the file of \d+ bytes draws more than \d+ shapes, the limit for its size"),
    ],
)
def test_svg_is_refused_before_its_library_multiplies_it(monkeypatch: pytest.MonkeyPatch, title: str, message: str):
    monkeypatch.setattr(svgelements.SVG, "parse", pytest.fail)
    _assert_rejected(_hostile("svg", title).make(100_000), message)


def test_style_sheets_reach_the_library_without_what_does_not_end(monkeypatch: pytest.MonkeyPatch):
    parse = Mock(wraps=svgelements.SVG.parse)
    monkeypatch.setattr(svgelements.SVG, "parse", parse)
    style = "/* a */ .a, .b { fill: red } // line\n}}} b {} c{d:e} aaaa /* no end"
    drawing = f'<style>{style}</style><rect class="Room b" width="500" height="500"/>'
    import_plans(SVG.format(drawing).encode(), ImportOptions(metres_per_pixel=0.01))
    sheet = re.search(rb"<ns0:style>(.*)</ns0:style>", parse.call_args_list[0].args[0].getvalue())
    assert present(sheet)[1] == b".a, .b{fill: red}c{d:e}"


def test_copies_of_blocks_are_bounded_by_the_size_of_the_file(monkeypatch: pytest.MonkeyPatch):
    content = _hostile("dxf", "an array of a block").make(100_000)
    monkeypatch.setattr(dxf, "_read_drawings", pytest.fail)
    _assert_rejected(content, rf"the file of {len(content)} bytes draws more than {10_000 + len(content) // 10} shapes")


def test_packed_operators_are_counted_before_they_are_read(monkeypatch: pytest.MonkeyPatch):
    content = pdf(b"0 0 m 9 9 l S " * 30_000)
    monkeypatch.setattr(pdf_page, "_add_path", pytest.fail)
    _assert_rejected(content, rf"the file of {len(content)} bytes draws more than {10_000 + len(content) // 4} shapes")


def test_large_picture_is_read_at_a_bounded_number_of_pixels():
    ink = read_ink(np.full((6000, 4000), 255, np.uint8), 0.01)
    assert ink.mask.size <= 12_010_000
    # Its places are those of the whole picture.
    assert ink.to_plan(np.array([[0.0, ink.mask.shape[0]]]))[0] == pytest.approx([0.0, 0.0])
    assert ink.to_plan(np.array([[ink.mask.shape[1], 0.0]]))[0] == pytest.approx([40.0, 60.0], rel=1e-3)


def test_picture_without_anything_of_the_size_of_letters_is_not_searched_for_texts(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(lettering, "_boxes", pytest.fail)
    gray = np.full((2000, 2000), 255, np.uint8)
    gray[::100] = gray[:, ::100] = 0
    assert not lettering.read_texts(gray, ReportBuilder(), Budget()).drawing.letterings


def test_outlines_of_a_picture_of_noise_are_counted_before_they_are_polygons(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(shapely, "Polygon", pytest.fail)
    noise = np.where(np.random.default_rng(0).random((150, 150)) < 0.55, 0, 255).astype(np.uint8)
    # One dark area with thousands of holes.
    gray = np.kron(noise, np.ones((20, 20), np.uint8))
    ink = read_ink(gray, 0.01, straighten=False)
    walls = wall_mask.WallMask(ink.mask, 0.1, None)
    monkeypatch.setattr(wall_mask, "_MAX_OUTLINES", 1000)
    with pytest.raises(InvalidFloorPlanError, match=r"\d+ outlines; the limit is 1000"):
        wall_mask.wall_polygons(walls, ink, lambda: None)


def test_map_of_many_rooms_ends_with_the_time() -> None:
    tones = np.array([[230, 120, 110], [110, 160, 230]], np.uint8)[np.indices((60, 60)).sum(axis=0) % 2]
    board = np.pad(np.kron(tones, np.ones((8, 8, 1), np.uint8)), ((40, 40), (40, 40), (0, 0)), constant_values=255)
    # Each reading of the clock is a second: the checks within the rooms' loop count.
    budget = Budget(ImportLimits(max_import_s=100.0), itertools.count(0.0).__next__)
    with pytest.raises(InvalidFloorPlanError, match="more than 100 s of CPU time"):
        sketch_map(board, 0.5, ReportBuilder(), budget)
