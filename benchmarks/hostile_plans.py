"""Small plan files that are made to take an import worker's time or memory, and what each of them takes.

    python -m benchmarks.hostile_plans
    python -m benchmarks.hostile_plans --only roomplan --bytes 100000

Prints a Markdown table of CPU time and memory, each measured in a process of its own with the service's limits. The
exit status is 1 when a file takes longer or more than it may for its size, or ends its process.
"""

from __future__ import annotations

import io
import json
import math
import multiprocessing
import os
import random
import re
import resource
import sys
import time
import zipfile
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from PIL import Image

from benchmarks.harness import argument_parser, print_table_head, table_row
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.importers import ImportLimits, ImportOptions, import_plans
from service.settings import Settings
from service.workers.process import limit_memory

# CPU time that a file may take: the libraries of its format, and its content.
MAX_S, MAX_S_PER_100_KB = 4.0, 4.0
_LARGEST_NUMBER = 1e308
_WALL_TIMEOUT_S = 300.0
Point = tuple[float, float]


@dataclass(frozen=True)
class HostilePlan:
    """Kind of hostile files.

    Attributes:
        format: format of the file.
        title: what the file has, for the table.
        make: returns a file of about a size in bytes.
        options: options of the import.
    """

    format: str
    title: str
    make: Callable[[int], bytes]
    options: ImportOptions


def star(points: int, size: float = 20.0) -> list[Point]:
    """Return a ring whose edges all cross one another."""
    step = 2.0 * math.pi * ((points - 1) // 2) / points
    return [(size * math.cos(k * step), size * math.sin(k * step)) for k in range(points)]


def chords(count: int, size: float = 20.0) -> list[tuple[Point, Point]]:
    """Return lines across a square, a quarter of whose pairs cross."""
    rng = random.Random(count)
    return [((0.0, size * rng.random()), (size, size * rng.random())) for _ in range(count)]


def lattice(count: int, size: float = 20.0) -> list[tuple[Point, Point]]:
    """Return upright and level lines, half of whose pairs cross."""
    places = [size * k / count for k in range(count // 2)]
    return [((x, 0.0), (x, 0.5 * size)) for x in places] + [((0.0, x), (0.5 * size, x)) for x in places]


def boxes(count: int, apart: float = 1e-3, size: float = 5.0) -> list[list[Point]]:
    """Return squares that nearly coincide."""
    corners = ((0.0, 0.0), (size, 0.0), (size, size), (0.0, size))
    return [[(x + apart * k, y + apart * k) for x, y in corners] for k in range(count)]


def _rounded(points: Sequence[Point], digits: int = 3) -> list[list[float]]:
    return [[round(x, digits), round(y, digits)] for x, y in points]


def _json(document: Any) -> bytes:
    return json.dumps(document, separators=(",", ":")).encode()


def _zip(files: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return stream.getvalue()


_IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
# A floor's own frame lies on its side: its y is the scan's z.
_FLOOR = [1, 0, 0, 0, 0, 0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 1]


def _roomplan(walls: Iterable[Any] = (), floors: Iterable[Any] = (), **more: Any) -> bytes:
    return _json({"walls": list(walls), "doors": [], "windows": [], "floors": list(floors)} | more)


def _scanned_floor(points: Sequence[Point]) -> dict[str, Any]:
    return {"polygonCorners": [[*point, 0] for point in _rounded(points)], "transform": _FLOOR}


def _scanned_wall(start: Point, end: Point) -> dict[str, Any]:
    length = math.dist(start, end)
    c, s = (end[0] - start[0]) / length, (end[1] - start[1]) / length
    x, y = 0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1])
    transform = [c, 0, -s, 0, 0, 1, 0, 0, s, 0, c, 0, x, 1.25, -y, 1]
    return {"dimensions": [round(length, 3), 2.5, 0], "transform": [round(value, 3) for value in transform]}


def _huge_roomplan(_size: int) -> bytes:
    wall = {"dimensions": [_LARGEST_NUMBER, 2.5, 0], "transform": _IDENTITY}
    return _roomplan([wall, {"dimensions": [3, 2.5, 0], "transform": [_LARGEST_NUMBER] * 16}])


def _sections(size: int) -> bytes:
    count = size // 160
    sections = [{"label": "livingRoom", "center": [99, 0, 99]}] * count
    return _roomplan((), [_scanned_floor(box) for box in boxes(count, 6.0)], sections=sections)


_MAP = b"image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n"
_PGM = b"P5\n100 100\n255\n" + bytes([254]) * 10_000


def _ros(yaml: bytes, picture: bytes = _PGM) -> bytes:
    return _zip({"map.yaml": yaml, "map.pgm": picture})


def _aliases(size: int) -> bytes:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, min(size // 60, 60))]
    return _ros(_MAP + "\n".join([*lines, f"origin: *a{len(lines) - 1}", ""]).encode())


def _merges(size: int) -> bytes:
    lines = ["a0: &a0 {x: 1, y: 2}"]
    lines += [f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 10)}]}}" for k in range(1, min(size // 70, 60))]
    return _ros(_MAP + "\n".join([*lines, ""]).encode())


def _noise(side: int, values: int = 2) -> bytes:
    rng = random.Random(side)
    return bytes(255 * rng.randrange(values) // (values - 1) for _ in range(side * side))


def _png(gray: Image.Image) -> bytes:
    stream = io.BytesIO()
    gray.save(stream, "PNG", optimize=True)
    return stream.getvalue()


def _tiled(pattern: Image.Image, width: int, height: int) -> Image.Image:
    """Return a picture that repeats a pattern, which takes few bytes."""
    row = Image.new("L", (width, pattern.height))
    for x in range(0, width, pattern.width):
        row.paste(pattern, (x, 0))
    whole = Image.new("L", (width, height))
    for y in range(0, height, pattern.height):
        whole.paste(row, (0, y))
    return whole


def _checkerboard(cell: int, width: int = 6000, height: int = 6000) -> Image.Image:
    pattern = Image.new("L", (2 * cell, 2 * cell), 255)
    for x, y in ((0, 0), (cell, cell)):
        pattern.paste(0, (x, y, x + cell, y + cell))
    return _tiled(pattern, width, height)


def _grid(pitch: int, line: int, width: int = 6000, height: int = 6000) -> Image.Image:
    pattern = Image.new("L", (pitch, pitch), 255)
    pattern.paste(0, (0, 0, line, pitch))
    pattern.paste(0, (0, 0, pitch, line))
    return _tiled(pattern, width, height)


def _osm(ways: Sequence[Sequence[Point]], more: str = "", tags: str = '<tag k="indoor" v="room"/>') -> bytes:
    lines, number = ["<osm>"], 0
    for way in ways:
        refs = []
        for x, y in way:
            number += 1
            lines.append(f'<node id="{number}" lat="{y * 1e-5:.8f}" lon="{x * 1e-5:.8f}"/>')
            refs.append(f'<nd ref="{number}"/>')
        lines.append(f'<way id="{number}">{"".join([*refs, refs[0]])}{tags}</way>')
    return "\n".join([*lines, more, "</osm>"]).encode()


def _multipolygons(size: int) -> bytes:
    points = size // 400
    relation = f'<member type="way" ref="{points}" role="outer"/><tag k="type" v="multipolygon"/>'
    relations = [f'<relation id="{k}">{relation}<tag k="indoor" v="room"/></relation>' for k in range(size // 200)]
    ring = [(20 * math.cos(2 * math.pi * k / points), 20 * math.sin(2 * math.pi * k / points)) for k in range(points)]
    return _osm([ring], "".join(relations))


def _geojson(rings: Sequence[Sequence[Point]], **properties: Any) -> bytes:
    features = []
    for ring in rings:
        geometry = {"type": "Polygon", "coordinates": [_rounded([*ring, ring[0]])]}
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    return _json({"type": "FeatureCollection", "units": "m", "features": features})


def _geojson_holes(size: int) -> bytes:
    holes = [_rounded([*box, box[0]]) for box in boxes(size // 60, 1e-3, 1.0)]
    outer = [[-9, -9], [99, -9], [99, 99], [-9, 99], [-9, -9]]
    return _json({"type": "Polygon", "coordinates": [outer, *holes], "units": "m"})


def _geojson_lines(size: int) -> bytes:
    lines = [{"type": "LineString", "coordinates": _rounded(chord, 2)} for chord in chords(size // 110)]
    features = [{"type": "Feature", "properties": {"kind": "door"}, "geometry": line} for line in lines]
    (box,) = boxes(1, size=20.0)
    room = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [[*box, box[0]]]}}
    return _json({"type": "FeatureCollection", "units": "m", "features": [room, *features]})


def _native(rings: Sequence[Sequence[Point]], openings: Sequence[Any] = ()) -> bytes:
    rooms = [{"polygon": _rounded(ring)} for ring in rings]
    doors = [{"kind": "door", "line": _rounded(line)} for line in openings]
    return _json({"ceiling_height_m": 2.5, "rooms": rooms, "openings": doors})


_GML = "http://www.opengis.net/gml/3.2"


def _indoorgml(faces: Sequence[Sequence[tuple[float, float, float]]]) -> bytes:
    rings = []
    for face in faces:
        positions = " ".join(f"{value:.3f}" for point in [*face, face[0]] for value in point)
        rings.append(
            f"<gml:exterior><gml:LinearRing><gml:posList>{positions}</gml:posList></gml:LinearRing></gml:exterior>"
        )
    return (
        f'<IndoorFeatures xmlns:gml="{_GML}"><CellSpace gml:id="a"><cellSpaceGeometry>{"".join(rings)}'
        "</cellSpaceGeometry></CellSpace></IndoorFeatures>"
    ).encode()


def _stacked(size: int) -> bytes:
    return _indoorgml([[(x, y, 0.0) for x, y in box] for box in boxes(size // 180)])


def _svg(content: str, attributes: str = "") -> bytes:
    head = '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" data-metres-per-unit="1"'
    return f"{head} {attributes}>{content}</svg>".encode()


def _svg_lines(lines: Sequence[tuple[Point, Point]], attributes: str = "") -> bytes:
    path = "".join(f"M{a:.2f} {b:.2f}L{c:.2f} {d:.2f}" for (a, b), (c, d) in lines)
    return _svg(f'<path d="{path}" fill="none" stroke="black" {attributes}/>')


def _svg_rings(rings: Sequence[Sequence[Point]], attributes: str = "") -> bytes:
    path = "".join("M" + "L".join(f"{x:.3f} {y:.3f}" for x, y in ring) + "z" for ring in rings)
    return _svg(f'<path d="{path}" {attributes}/>')


def _svg_many(rings: Sequence[Sequence[Point]], attributes: str = "") -> bytes:
    path = ("M" + "L".join(f"{x:.2f} {y:.2f}" for x, y in ring) + "z" for ring in rings)
    return _svg("".join(f'<path {attributes} d="{line}"/>' for line in path))


def _svg_patches(size: int) -> bytes:
    """Return dark walls under light areas that all cross them."""
    count = size // 130
    walls = "".join(f'<rect x="0" y="{0.4 * k:.1f}" width="30" height=".2"/>' for k in range(count))
    light = "".join(f'<rect x="{0.1 * k:.1f}" y="0" width=".05" height="999" fill="#fff"/>' for k in range(count))
    return _svg(walls + light)


def _svg_arcs(size: int) -> bytes:
    """Return swings of doors and gaps that they could close."""
    count = size // 90
    arcs = "".join(f'<path fill="none" stroke="#000" d="M{k % 30} 1a.9 .9 0 0 1 .9 .9"/>' for k in range(count))
    walls = "".join(f'<rect x="{k % 40}.1" y="{k // 40}" width=".4" height=".2"/>' for k in range(count // 2))
    return _svg(arcs + walls)


def _svg_styles(size: int) -> bytes:
    rules = "".join(f".a{k} .b{k},#c{k}{{fill:red}}" for k in range(size // 60))
    return _svg(f"<style>{rules}</style>" + '<path class="a1 a2 a3" d="M0 0h5v5h-5z"/>' * (size // 90))


_SQUARE = '<path d="M0 0h5v5h-5z"/>'


def _svg_symbols(levels: int) -> bytes:
    """Return a symbol of ten symbols of ten symbols."""
    groups = (f'<g id="a{k + 1}">' + f'<use href="#a{k}"/>' * 10 + "</g>" for k in range(levels))
    symbols = '<path id="a0" d="M0 0h5v5h-5z"/>' + "".join(groups)
    return _svg(f'<defs>{symbols}</defs><use href="#a{levels}"/>')


def _svg_copied(attributes: str, copies: int) -> bytes:
    return _svg(f'<defs><path id="a" {attributes}/></defs>' + '<use href="#a"/>' * copies)


def _dxf_pairs(*pairs: tuple[int, object]) -> str:
    return "".join(f"{code}\n{value}\n" for code, value in pairs)


def _dxf(entities: str, before: str = "") -> bytes:
    header = _dxf_pairs((0, "SECTION"), (2, "HEADER"), (9, "$INSUNITS"), (70, 6), (0, "ENDSEC"))
    section = _dxf_pairs((0, "SECTION"), (2, "ENTITIES"))
    return (header + before + section + entities + _dxf_pairs((0, "ENDSEC"), (0, "EOF"))).encode()


def _dxf_line(start: Point, end: Point, layer: str = "0") -> str:
    (a, b), (c, d) = _rounded((start, end))
    return _dxf_pairs((0, "LINE"), (8, layer), (10, a), (20, b), (11, c), (21, d))


def _dxf_ring(points: Sequence[Point], layer: str = "0") -> str:
    corners = [pair for x, y in _rounded(points) for pair in ((10, x), (20, y))]
    return _dxf_pairs(
        (0, "LWPOLYLINE"), (100, "AcDbEntity"), (8, layer), (100, "AcDbPolyline"), (90, len(points)), (70, 1), *corners
    )


def _dxf_hatch(rings: Sequence[Sequence[Point]]) -> str:
    pairs: list[tuple[int, object]] = [
        (0, "HATCH"),
        (100, "AcDbEntity"),
        (8, "0"),
        (100, "AcDbHatch"),
        (10, 0),
        (20, 0),
        (30, 0),
    ]
    pairs += [(210, 0), (220, 0), (230, 1), (2, "SOLID"), (70, 1), (71, 0), (91, len(rings))]
    for ring in rings:
        pairs += [(92, 2), (72, 0), (73, 1), (93, len(ring))]
        pairs += [pair for x, y in _rounded(ring) for pair in ((10, x), (20, y))]
        pairs += [(97, 0)]
    return _dxf_pairs(*pairs, (75, 0), (76, 1), (98, 0))


def _dxf_spline(size: int) -> str:
    count = size // 30
    pairs: list[tuple[int, object]] = [
        (0, "SPLINE"),
        (100, "AcDbEntity"),
        (8, "0"),
        (100, "AcDbSpline"),
        (70, 8),
        (71, min(count - 1, 200)),
    ]
    order = min(count - 1, 200) + 1
    pairs += [(72, count + order), (73, count), (74, 0)]
    pairs += [(40, k) for k in range(count + order)]
    for k in range(count):
        pairs += [(10, k % 97), (20, k % 89), (30, 0)]
    return _dxf_pairs(*pairs)


def _dxf_layers(size: int) -> bytes:
    lines = "".join(_dxf_line((0, 0.01 * k), (5, 0.01 * k), f"layer {k} door wall room") for k in range(size // 90))
    return _dxf(lines)


def _dxf_cycle(_size: int) -> bytes:
    block = [(0, "SECTION"), (2, "BLOCKS"), (0, "BLOCK"), (2, "A"), (0, "INSERT"), (2, "A"), (10, 0), (20, 0)]
    insert = _dxf_pairs((0, "INSERT"), (8, "0"), (2, "A"), (10, 0), (20, 0))
    return _dxf(insert, _dxf_pairs(*block, (0, "ENDBLK"), (0, "ENDSEC")))


def _dxf_copies(size: int) -> bytes:
    """Return an array of a block, whose number of copies is two numbers in the file."""
    side = math.isqrt(size // 2)
    block = [(0, "SECTION"), (2, "BLOCKS"), (0, "BLOCK"), (2, "A"), (10, 0), (20, 0)]
    insert = _dxf_pairs((0, "INSERT"), (8, "0"), (2, "A"), (10, 0), (20, 0), (70, side), (71, side), (44, 1), (45, 1))
    return _dxf(insert, _dxf_pairs(*block) + _dxf_line((0, 0), (5, 5)) + _dxf_pairs((0, "ENDBLK"), (0, "ENDSEC")))


def _dxf_text(size: int) -> bytes:
    return _dxf(
        _dxf_pairs(
            (0, "MTEXT"), (100, "AcDbEntity"), (8, "0"), (100, "AcDbMText"), (10, 0), (20, 0), (1, "{\\f" * (size // 3))
        )
    )


def pdf(content: bytes, width: float = 800.0, height: float = 800.0, resources: str = "", more: str = "") -> bytes:
    """Return a page with a compressed content stream; `more` are objects from number 5 on."""
    packed = zlib.compress(content, 9)
    objects = [
        b"<</Type/Catalog/Pages 2 0 R>>",
        b"<</Type/Pages/Kids[3 0 R]/Count 1>>",
        f"<</Type/Page/Parent 2 0 R/MediaBox[0 0 {width:g} {height:g}]/Contents 4 0 R".encode(),
        f"<</Length {len(packed)}/Filter/FlateDecode>>stream\n".encode() + packed + b"\nendstream",
    ]
    objects[2] += f"/Resources<<{resources}>>>>".encode()
    body = b"%PDF-1.4\n" + b"".join(b"%d 0 obj\n" % k + part + b"\nendobj\n" for k, part in enumerate(objects, 1))
    return body + more.encode("latin-1") + b"trailer<</Root 1 0 R>>\n%%EOF"


def _pdf_lines(lines: Sequence[tuple[Point, Point]]) -> bytes:
    return b"".join(b"%.2f %.2f m %.2f %.2f l S\n" % (*a, *b) for a, b in lines)


def _pdf_form(level: int, name: str, content: str) -> str:
    resources = f"/Resources<</XObject<</F {level + 1} 0 R>>>>" if level < 20 else ""
    stream = f"<</Type/XObject/Subtype/Form/BBox[0 0 800 800]{resources}/Length {len(content)}>>stream\n{content}\n"
    return f"{level} 0 obj{stream}endstream endobj\n"


def _pdf_nested(_size: int) -> bytes:
    forms = "".join(_pdf_form(k, "F", "/F Do " * 10 if k < 20 else "0 0 m 9 9 l S") for k in range(5, 21))
    return pdf(b"/F Do " * 10, resources="/XObject<</F 5 0 R>>", more=forms)


def _ifc(*lines: str) -> bytes:
    head = "ISO-10303-21;HEADER;FILE_DESCRIPTION((''),'2;1');FILE_NAME('','',(''),(''),'','','');"
    text = "\n".join(f"#{number}={line};" for number, line in enumerate(lines, 1))
    return f"{head}FILE_SCHEMA(('IFC4'));ENDSEC;DATA;\n{text}\nENDSEC;END-ISO-10303-21;".encode()


_IFC_BASE: tuple[str, ...] = (
    "IFCSIUNIT(*,.LENGTHUNIT.,$,.METRE.)",
    "IFCUNITASSIGNMENT((#1))",
    "IFCCARTESIANPOINT((0.,0.,0.))",
    "IFCAXIS2PLACEMENT3D(#3,$,$)",
    "IFCGEOMETRICREPRESENTATIONCONTEXT($,'Model',3,1.E-5,#4,$)",
    "IFCPROJECT('0YvctVUKr0kugbFTf53O9L',$,'p',$,$,$,$,(#5),#2)",
    "IFCLOCALPLACEMENT($,#4)",
    "IFCBUILDINGSTOREY('1YvctVUKr0kugbFTf53O9L',$,'s',$,$,#7,$,$,.ELEMENT.,0.)",
    "IFCSPACE('2YvctVUKr0kugbFTf53O9L',$,'r',$,$,#7,#12,$,.ELEMENT.,$,$)",
    "IFCRELAGGREGATES('3YvctVUKr0kugbFTf53O9L',$,$,$,#8,(#9))",
    "IFCSHAPEREPRESENTATION(#5,'Body','SweptSolid',(#13))",
    "IFCPRODUCTDEFINITIONSHAPE($,$,(#11))",
)


def ifc_space(profile: Sequence[Point], height: float | str = 2.5, *more: str) -> bytes:
    """Return a model of one space, an extruded outline."""
    first = 19 + len(more)
    points = [f"IFCCARTESIANPOINT(({x:.4f},{y:.4f}))" for x, y in profile]
    references = ",".join(f"#{first + k}" for k in [*range(len(points)), 0])
    solid = (
        f"IFCEXTRUDEDAREASOLID(#14,#4,#15,{height})",
        "IFCARBITRARYCLOSEDPROFILEDEF(.AREA.,$,#16)",
        "IFCDIRECTION((0.,0.,1.))",
        f"IFCPOLYLINE(({references}))",
        "IFCDIRECTION((1.,0.,0.))",
        "IFCDIRECTION((0.,1.,0.))",
    )
    return _ifc(*_IFC_BASE, *solid, *more, *points)


def _ifc_placements(_size: int) -> bytes:
    lines: list[str] = list(_IFC_BASE)
    lines[6] = "IFCLOCALPLACEMENT(#7,#4)"
    return _ifc(*lines, "IFCPOLYLINE((#3,#3))")


def _ifc_chain(size: int) -> bytes:
    count = size // 40
    lines: list[str] = list(_IFC_BASE)
    lines[6] = "IFCLOCALPLACEMENT(#14,#4)"
    chain = [f"IFCLOCALPLACEMENT(#{14 + k},#4)" for k in range(1, count)]
    return _ifc(*lines, "IFCPOLYLINE((#3,#3))", *chain, "IFCLOCALPLACEMENT($,#4)")


def _ifc_clippings(size: int) -> bytes:
    count = size // 60
    lines: list[str] = list(_IFC_BASE)
    clipped = [f"IFCBOOLEANRESULT(.DIFFERENCE.,#{k + 1},#{13 + count})" for k in range(13, 13 + count)]
    lines += clipped
    lines += [f"IFCCSGSOLID(#{14 + count})", "IFCBLOCK(#4,5.,5.,5.)"]
    return _ifc(*lines)


def _ifc_disks(size: int) -> bytes:
    """Return a tube along a line that crosses itself."""
    points = star(max(size // 60, 5))
    places = [f"IFCCARTESIANPOINT(({x:.3f},{y:.3f},0.))" for x, y in points]
    line = ",".join(f"#{15 + k}" for k in range(len(points)))
    return _ifc(*_IFC_BASE, "IFCSWEPTDISKSOLID(#14,0.1,$,$,$)", f"IFCPOLYLINE(({line}))", *places)


_NONE, _DRAFT = ImportOptions(), ImportOptions(metres_per_pixel=0.01)
_POINTS = ImportOptions(metres_per_pixel=0.02)


def _stars(size: int, points: int, bytes_each: int) -> list[list[Point]]:
    """Return stars beside one another."""
    count = max(size // (bytes_each * points), 1)
    shape = star(points, 2.0)
    return [[(x + 5.0 * (k % 30), y + 5.0 * (k // 30)) for x, y in shape] for k in range(count)]


def _plan(format: str, title: str, make: Callable[[int], bytes], options: ImportOptions = _NONE) -> HostilePlan:
    return HostilePlan(format, title, make, options)


HOSTILE_PLANS: tuple[HostilePlan, ...] = (
    _plan("roomplan", "numbers of 1e308", _huge_roomplan),
    _plan("roomplan", "a floor that crosses itself", lambda s: _roomplan((), [_scanned_floor(star(s // 18))])),
    _plan("roomplan", "stars of 15 corners", lambda s: _roomplan((), map(_scanned_floor, _stars(s, 15, 24)))),
    _plan("roomplan", "walls that cross", lambda s: _roomplan([_scanned_wall(*c) for c in chords(s // 120)])),
    _plan("roomplan", "a lattice of walls", lambda s: _roomplan([_scanned_wall(*c) for c in lattice(s // 120)])),
    _plan("roomplan", "floors that coincide", lambda s: _roomplan((), map(_scanned_floor, boxes(s // 140)))),
    _plan("roomplan", "sections of no room", _sections),
    _plan("ros", "nested aliases", _aliases),
    _plan("ros", "nested merge keys", _merges),
    _plan("ros", "nested lists", lambda s: _ros(_MAP + b"a: " + b"[" * min(s, 60_000))),
    _plan("ros", "nested blocks", lambda s: _ros(_MAP + b"a:\n " + b"- " * min(s // 2, 30_000))),
    _plan("ros", "a number in base 60", lambda s: _ros(_MAP[:17] + b"resolution: 1" + b":1" * min(s // 2, 30_000))),
    _plan("ros", "keys", lambda s: _ros(_MAP + b"".join(b"a%d: {b: [1, 2]}\n" % k for k in range(2800)))),
    _plan(
        "ros", "noise", lambda s: _ros(_MAP, b"P5\n%d %d\n255\n" % ((side := math.isqrt(s * 8),) * 2) + _noise(side))
    ),
    _plan(
        "ros",
        "checkerboard of 36 megapixels",
        lambda _: _zip({"map.yaml": _MAP.replace(b"pgm", b"png"), "map.png": _png(_checkerboard(20))}),
    ),
    _plan(
        "ros", "empty map of 36 megapixels", lambda s: _ros(_MAP, b"P5\n6000 6000\n255\n" + bytes([254]) * 36_000_000)
    ),
    _plan("osm", "latitude nan", lambda s: _osm([boxes(1)[0]]).replace(b'lat="0.00000000"', b'lat="nan"')),
    _plan("osm", "longitude 1e308", lambda s: _osm([boxes(1)[0]]).replace(b'lon="0.00000000"', b'lon="1e308"')),
    _plan("osm", "a room that crosses itself", lambda s: _osm([star(s // 75)])),
    _plan("osm", "stars of 15 corners", lambda s: _osm(_stars(s, 15, 75))),
    _plan("osm", "one way in many multipolygons", _multipolygons),
    _plan("osm", "rooms that coincide", lambda s: _osm(boxes(s // 400, 0.1))),
    _plan("geojson", "numbers of 1e308", lambda s: _geojson([[(0.0, 0.0), (_LARGEST_NUMBER, 0.0), (0.0, 5.0)]])),
    _plan("geojson", "a room that crosses itself", lambda s: _geojson([star(s // 16)])),
    _plan("geojson", "stars of 15 corners", lambda s: _geojson(_stars(s, 15, 20))),
    _plan("geojson", "rooms that coincide", lambda s: _geojson(boxes(s // 150))),
    _plan("geojson", "columns that coincide", lambda s: _geojson([star(5, 9.0), *boxes(s // 170)], kind="column")),
    _plan("geojson", "holes that coincide", _geojson_holes),
    _plan("geojson", "doors that cross", _geojson_lines),
    _plan("geojson", "200 levels", lambda s: _geojson(boxes(s // 200, 6.0), level=";".join(map(str, range(200))))),
    _plan("native", "a room that crosses itself", lambda s: _native([star(s // 16)])),
    _plan("native", "stars of 15 corners", lambda s: _native(_stars(s, 15, 20))),
    _plan("native", "rooms that coincide", lambda s: _native(boxes(s // 60))),
    _plan("native", "doors that cross", lambda s: _native(boxes(1, size=20.0), chords(s // 60))),
    _plan("indoorgml", "a cell that crosses itself", lambda s: _indoorgml([[(x, y, 0.0) for x, y in star(s // 20)]])),
    _plan("indoorgml", "faces that coincide", _stacked),
    _plan(
        "indoorgml", "numbers of 1e308", lambda s: _indoorgml([[(0.0, 0.0, 0.0), (1e308, 0.0, 0.0), (0.0, 5.0, 0.0)]])
    ),
    _plan("svg", "lines that cross", lambda s: _svg_lines(chords(s // 22))),
    _plan("svg", "a lattice", lambda s: _svg_lines(lattice(s // 24))),
    _plan("svg", "a lattice of thick lines", lambda s: _svg_lines(lattice(s // 24, 200.0), 'stroke-width=".2"')),
    _plan(
        "svg",
        "lattices of thick lines",
        lambda s: _svg(
            "".join(
                f'<path fill="none" stroke="#000" stroke-width=".2" d="M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}"/>'
                for (a, b), (c, d) in lattice(s // 80, 150.0)
            )
        ),
    ),
    _plan("svg", "an outline that crosses itself", lambda s: _svg_rings([star(s // 16)])),
    _plan("svg", "stars of 15 corners", lambda s: _svg_many(_stars(s, 15, 16))),
    _plan("svg", "subpaths that coincide", lambda s: _svg_rings(boxes(s // 50))),
    _plan("svg", "outlines that coincide", lambda s: _svg_many(boxes(s // 60), 'fill="#fff" stroke="#000"')),
    _plan("svg", "rooms that coincide", lambda s: _svg_many(boxes(s // 60), 'class="Room"')),
    _plan("svg", "dark areas that coincide", lambda s: _svg_many(boxes(s // 60), "")),
    _plan("svg", "light areas over walls", _svg_patches),
    _plan("svg", "swings of doors", _svg_arcs),
    _plan("svg", "style rules", _svg_styles),
    _plan(
        "svg", "declarations for all", lambda s: _svg(f"<style>*{{{'a:b;' * (s // 8)}}}</style>{_SQUARE * (s // 50)}")
    ),
    _plan(
        "svg",
        "a rule of one class",
        lambda s: _svg(f"<style>{',.a' * (s // 6)}{{{'a:b;' * (s // 8)}}}</style>{_SQUARE}"),
    ),
    _plan("svg", "comments without an end", lambda s: _svg(f"<style>{'/*' * (s // 2)}</style>{_SQUARE}")),
    _plan("svg", "a rule without a brace", lambda s: _svg(f"<style>{'a' * s}}}</style>{_SQUARE}")),
    _plan(
        "svg",
        "a transform around all",
        lambda s: _svg(f'<g transform="{"rotate(7)" * (s // 18)}">{_SQUARE * (s // 50)}</g>'),
    ),
    _plan("svg", "symbols of symbols", lambda _: _svg_symbols(4)),
    _plan("svg", "copies of a path", lambda s: _svg_copied(f'd="M0 0{"h1" * (s // 2)}"', 30)),
    _plan("svg", "copies of classes", lambda s: _svg_copied(f'class="{"a " * (s // 4)}" d="M0 0h5v5h-5z"', s // 40)),
    _plan("svg", "numbers of 1e308", lambda s: _svg_many([[(0.0, 0.0), (1e300, 0.0), (5.0, 1e300)]] * 9)),
    _plan(
        "svg", "arcs of radius 1e308", lambda s: _svg('<path d="M0 0' + "A1e308 1e308 0 0 0 9 9" * (s // 22) + '"/>')
    ),
    _plan("svg", "a dash of numbers", lambda s: _svg(f'<path d="M0 0{"1" * s}"/>')),
    _plan("svg", "a dot of numbers", lambda s: _svg(f'<path d="M0 0{".1" * (s // 2)}"/>')),
    _plan("svg", "transforms", lambda s: _svg(f'<path transform="{"rotate(7)" * (s // 9)}" d="M0 0h5v5h-5z"/>')),
    _plan("svg", "letters in a transform", lambda s: _svg(f'<path transform="{"a" * s}" d="M0 0h5v5h-5z"/>')),
    _plan("svg", "spaces in a style", lambda s: _svg(f"<style>a{{{' ' * s}</style>" + '<path d="M0 0h5v5h-5z"/>')),
    _plan("svg", "nested groups", lambda s: _svg("<g>" * 60 + "<path d='M0 0h5v5h-5z'/>" * (s // 30) + "</g>" * 60)),
    _plan(
        "svg",
        "texts",
        lambda s: _svg(
            "<rect width='99' height='99' class='Room'/>" + "<text x='5' y='5'>bedroom 9 m²</text>" * (s // 40)
        ),
    ),
    _plan("dxf", "lines that cross", lambda s: _dxf("".join(_dxf_line(*c) for c in chords(s // 50)))),
    _plan("dxf", "a lattice", lambda s: _dxf("".join(_dxf_line(*c) for c in lattice(s // 46)))),
    _plan("dxf", "a lattice of walls", lambda s: _dxf("".join(_dxf_line(*c, "WALL") for c in lattice(s // 46)))),
    _plan("dxf", "an outline that crosses itself", lambda s: _dxf(_dxf_ring(star(s // 22)))),
    _plan("dxf", "stars of 15 corners", lambda s: _dxf("".join(map(_dxf_ring, _stars(s, 15, 24))))),
    _plan("dxf", "outlines that coincide", lambda s: _dxf("".join(map(_dxf_ring, boxes(s // 130))))),
    _plan("dxf", "rooms that coincide", lambda s: _dxf("".join(_dxf_ring(box, "ROOM") for box in boxes(s // 130)))),
    _plan("dxf", "a hatch that crosses itself", lambda s: _dxf(_dxf_hatch([star(s // 22)]))),
    _plan("dxf", "a hatch of areas that coincide", lambda s: _dxf(_dxf_hatch(boxes(s // 110)))),
    _plan("dxf", "a spline of degree 200", lambda s: _dxf(_dxf_spline(s))),
    _plan("dxf", "layers", _dxf_layers),
    _plan("dxf", "a block in itself", _dxf_cycle),
    _plan("dxf", "an array of a block", _dxf_copies),
    _plan("dxf", "format codes in a text", _dxf_text),
    _plan("dxf", "numbers of 1e308", lambda s: _dxf("".join(_dxf_line((0, 0), (1e308, 1e308)) for _ in range(9)))),
    _plan("pdf", "lines that cross", lambda s: pdf(_pdf_lines(chords(s // 10, 700.0))), _POINTS),
    _plan("pdf", "a lattice", lambda s: pdf(_pdf_lines(lattice(s // 10, 700.0))), _POINTS),
    _plan(
        "pdf",
        "an outline that crosses itself",
        lambda s: pdf(b"0 0 m " + b"".join(b"%.2f %.2f l " % p for p in star(s // 8, 300.0)) + b"h f"),
        _POINTS,
    ),
    _plan(
        "pdf",
        "ten million packed operators",
        lambda s: pdf(b"0 0 m 9 9 l S " * 1_000_000 * max(s // 100_000, 1)),
        _POINTS,
    ),
    _plan("pdf", "fills of the whole page", lambda s: pdf(b"0 0 800 800 re f " * 290_000), _POINTS),
    _plan(
        "pdf",
        "transparent fills",
        lambda s: pdf(b"/G gs " + b"0 0 800 800 re f " * 290_000, resources="/ExtGState<</G<</ca .3/BM/Multiply>>>>"),
        _POINTS,
    ),
    _plan("pdf", "nested forms", _pdf_nested, _POINTS),
    _plan("pdf", "page of 14,400 points", lambda s: pdf(b"0 0 m 14400 14400 l S", 14400, 14400), _POINTS),
    _plan("pdf", "packed operators that draw nothing", lambda s: pdf(b"q Q " * 30_000_000), _POINTS),
    _plan(
        "pdf",
        "texts",
        lambda s: pdf(
            b"BT /F 9 Tf " + b"1 0 0 1 9 9 Tm (bedroom) Tj " * 100_000 + b"ET",
            resources="/Font<</F<</Type/Font/Subtype/Type1/BaseFont/Helvetica>>>>",
        ),
        _POINTS,
    ),
    _plan("ifc", "a placement in itself", _ifc_placements),
    _plan("ifc", "a chain of placements", _ifc_chain),
    _plan("ifc", "numbers of 1e308", lambda s: ifc_space([(0, 0), (5, 0), (5, 5), (0, 5)], "1.E308")),
    _plan("ifc", "a number of 1.E400", lambda s: ifc_space([(0, 0), (5, 0), (5, 5), (0, 5)], "1.E400")),
    _plan("ifc", "a space that crosses itself", lambda s: ifc_space(star(s // 50))),
    _plan(
        "ifc",
        "a round space",
        lambda s: ifc_space(
            [(9 * math.cos(6.28 * k / (s // 50)), 9 * math.sin(6.28 * k / (s // 50))) for k in range(s // 50)]
        ),
    ),
    _plan("ifc", "clippings of clippings", _ifc_clippings),
    _plan("ifc", "a tube that crosses itself", _ifc_disks),
    _plan("ifc", "nested lists", lambda s: _ifc("IFCPOLYLINE(" + "(" * s + ")" * s + ")")),
    _plan("picture", "white, 36 megapixels", lambda s: _png(Image.new("L", (6000, 6000), 255)), _DRAFT),
    _plan("picture", "checkerboard of 20 pixels", lambda s: _png(_checkerboard(20)), _DRAFT),
    _plan("picture", "checkerboard of 8 pixels", lambda s: _png(_checkerboard(8)), _DRAFT),
    _plan("picture", "lattice of 100 pixels", lambda s: _png(_grid(100, 20)), _DRAFT),
    _plan("picture", "lattice of 300 pixels", lambda s: _png(_grid(300, 20)), _DRAFT),
    _plan("picture", "lattice of two lines", lambda s: _png(_grid(60, 3)), _DRAFT),
    _plan(
        "picture",
        "noise",
        lambda s: _png(Image.frombytes("L", ((side := math.isqrt(8 * s)), side), _noise(side))),
        _DRAFT,
    ),
    _plan(
        "picture",
        "coarse noise",
        lambda s: _png(Image.frombytes("L", (300, 300), _noise(300)).resize((6000, 6000), 0)),
        _DRAFT,
    ),
)


def _measure_here(number: int, size: int, pipe: Connection) -> None:
    plan, settings = HOSTILE_PLANS[number], Settings()
    content = plan.make(size)
    resource.setrlimit(resource.RLIMIT_CPU, (120, 121))
    os.environ["OPENCV_FOR_THREADS_NUM"] = "1"
    begin_s = time.process_time()
    limit_memory(settings.imports.memory_bytes)
    pipe.send(len(content))
    try:
        plans = import_plans(content, plan.options, ImportLimits())
        outcome = f"{sum(len(plan.document['rooms']) for plan in plans)} rooms"
    except InvalidInputError as error:
        outcome = str(error)
    except MemoryError:
        outcome = "MemoryError"
    except Exception as error:
        outcome = f"FAULT {type(error).__name__}: {error}"
    used_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    pipe.send((time.process_time() - begin_s, used_mb, outcome))


def measure(number: int, size: int) -> tuple[int, float, float, str]:
    """Import a file in a process of its own; return its bytes, CPU time (s), memory (MB) and the result in words."""
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_measure_here, args=(number, size, theirs))
    process.start()
    theirs.close()
    begin_s = time.monotonic()
    bytes_sent = 0
    try:
        bytes_sent = ours.recv()
        if not ours.poll(_WALL_TIMEOUT_S):
            process.kill()
            raise EOFError
        seconds, memory_mb, outcome = ours.recv()
    except EOFError:
        process.join()
        seconds, memory_mb = time.monotonic() - begin_s, math.nan
        outcome = f"process ended with {process.exitcode}"
    process.join()
    return bytes_sent, seconds, memory_mb, outcome


def main() -> int:
    """Measure all files; return 1 when one takes too long."""
    parser = argument_parser(__doc__)
    parser.add_argument("--only", default="", help="measure the files whose 'format, content' match this expression")
    parser.add_argument("--bytes", type=int, default=100_000, help="approximate size of a file")
    options = parser.parse_args()
    print_table_head("format", "content", "bytes", "CPU", "memory", "result")
    failed = False
    for number, plan in enumerate(HOSTILE_PLANS):
        if not re.search(options.only, f"{plan.format}, {plan.title}"):
            continue
        size, seconds, memory_mb, outcome = measure(number, options.bytes)
        is_slow = seconds > MAX_S + MAX_S_PER_100_KB * size / 1e5
        failed |= is_slow or outcome.startswith(("FAULT", "process"))
        shown = f"{'SLOW ' * is_slow}{outcome[:150]}"
        print(
            table_row(plan.format, plan.title, f"{size:,}", f"{seconds:.1f} s", f"{memory_mb:.0f} MB", shown),
            flush=True,
        )
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
