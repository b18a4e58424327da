"""Small files of drawings and building models, SVG, DXF, PDF and IFC, that are made to take time or memory."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from functools import partial

from benchmarks.hostile_files import MODELS, PICTURES, Point, boxes, chords, circle, lattice, plan, rounded, star, stars
from lalaloc_core.importers import ImportOptions

_POINTS = ImportOptions(metres_per_pixel=0.02)
_THICK = 'fill="none" stroke="#000" stroke-width=".2"'


def _svg(content: str, attributes: str = "") -> bytes:
    head = '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" data-metres-per-unit="1"'
    return f"{head} {attributes}>{content}</svg>".encode()


def _svg_lines(lines: Sequence[tuple[Point, Point]], attributes: str = "") -> bytes:
    path = "".join(f"M{a:.2f} {b:.2f}L{c:.2f} {d:.2f}" for (a, b), (c, d) in lines)
    return _svg(f'<path d="{path}" fill="none" stroke="black" {attributes}/>')


def _svg_rings(rings: Sequence[Sequence[Point]]) -> bytes:
    path = "".join("M" + "L".join(f"{x:.3f} {y:.3f}" for x, y in ring) + "z" for ring in rings)
    return _svg(f'<path d="{path}" />')


def _svg_many(rings: Sequence[Sequence[Point]], attributes: str = "", end: str = "z") -> bytes:
    path = ("M" + "L".join(f"{x:.2f} {y:.2f}" for x, y in ring) + end for ring in rings)
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


_Pairs = list[tuple[int, object]]


def _dxf_pairs(*pairs: tuple[int, object]) -> str:
    return "".join(f"{code}\n{value}\n" for code, value in pairs)


def _dxf(entities: str, before: str = "") -> bytes:
    header = _dxf_pairs((0, "SECTION"), (2, "HEADER"), (9, "$INSUNITS"), (70, 6), (0, "ENDSEC"))
    section = _dxf_pairs((0, "SECTION"), (2, "ENTITIES"))
    return (header + before + section + entities + _dxf_pairs((0, "ENDSEC"), (0, "EOF"))).encode()


def _dxf_line(start: Point, end: Point, layer: str = "0") -> str:
    (a, b), (c, d) = rounded((start, end))
    return _dxf_pairs((0, "LINE"), (8, layer), (10, a), (20, b), (11, c), (21, d))


def _dxf_ring(points: Sequence[Point], layer: str = "0") -> str:
    corners = [pair for x, y in rounded(points) for pair in ((10, x), (20, y))]
    return _dxf_pairs(
        (0, "LWPOLYLINE"), (100, "AcDbEntity"), (8, layer), (100, "AcDbPolyline"), (90, len(points)), (70, 1), *corners
    )


def _dxf_hatch(rings: Sequence[Sequence[Point]]) -> str:
    pairs: _Pairs = [(0, "HATCH"), (100, "AcDbEntity"), (8, "0"), (100, "AcDbHatch"), (10, 0), (20, 0), (30, 0)]
    pairs += [(210, 0), (220, 0), (230, 1), (2, "SOLID"), (70, 1), (71, 0), (91, len(rings))]
    for ring in rings:
        pairs += [(92, 2), (72, 0), (73, 1), (93, len(ring))]
        pairs += [pair for x, y in rounded(ring) for pair in ((10, x), (20, y))]
        pairs += [(97, 0)]
    return _dxf_pairs(*pairs, (75, 0), (76, 1), (98, 0))


def _dxf_spline(size: int) -> str:
    count = size // 30
    order = min(count - 1, 200) + 1
    pairs: _Pairs = [(0, "SPLINE"), (100, "AcDbEntity"), (8, "0"), (100, "AcDbSpline"), (70, 8), (71, order - 1)]
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
    text: _Pairs = [(0, "MTEXT"), (100, "AcDbEntity"), (8, "0"), (100, "AcDbMText"), (10, 0), (20, 0)]
    return _dxf(_dxf_pairs(*text, (1, "{\\f" * (size // 3))))


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


def _ifc_placed(parent: int, *placements: str) -> bytes:
    """Return a space whose placement is relative to another one."""
    base = (*_IFC_BASE[:6], f"IFCLOCALPLACEMENT(#{parent},#4)", *_IFC_BASE[7:])
    return _ifc(*base, "IFCPOLYLINE((#3,#3))", *placements)


def _ifc_chain(size: int) -> bytes:
    chain = [f"IFCLOCALPLACEMENT(#{14 + k},#4)" for k in range(1, size // 40)]
    return _ifc_placed(14, *chain, "IFCLOCALPLACEMENT($,#4)")


def _ifc_clippings(size: int) -> bytes:
    count = size // 60
    clipped = [f"IFCBOOLEANRESULT(.DIFFERENCE.,#{k + 1},#{13 + count})" for k in range(13, 13 + count)]
    return _ifc(*_IFC_BASE, *clipped, f"IFCCSGSOLID(#{14 + count})", "IFCBLOCK(#4,5.,5.,5.)")


def _ifc_disks(size: int) -> bytes:
    """Return a tube along a line that crosses itself."""
    points = star(max(size // 60, 5))
    places = [f"IFCCARTESIANPOINT(({x:.3f},{y:.3f},0.))" for x, y in points]
    line = ",".join(f"#{15 + k}" for k in range(len(points)))
    return _ifc(*_IFC_BASE, "IFCSWEPTDISKSOLID(#14,0.1,$,$,$)", f"IFCPOLYLINE(({line}))", *places)


_pdf_plan = partial(plan, "pdf", options=_POINTS)
DRAWINGS = (
    plan("svg", "lines that cross", lambda s: _svg_lines(chords(s // 22))),
    plan("svg", "a lattice", lambda s: _svg_lines(lattice(s // 24))),
    plan("svg", "a lattice of thick lines", lambda s: _svg_lines(lattice(s // 24, 200.0), 'stroke-width=".2"')),
    plan("svg", "lattices of thick lines", lambda s: _svg_many(lattice(s // 80, 150.0), _THICK, "")),
    plan("svg", "an outline that crosses itself", lambda s: _svg_rings([star(s // 16)])),
    plan("svg", "stars of 15 corners", lambda s: _svg_many(stars(s, 15, 16))),
    plan("svg", "subpaths that coincide", lambda s: _svg_rings(boxes(s // 50))),
    plan("svg", "outlines that coincide", lambda s: _svg_many(boxes(s // 60), 'fill="#fff" stroke="#000"')),
    plan("svg", "rooms that coincide", lambda s: _svg_many(boxes(s // 60), 'class="Room"')),
    plan("svg", "dark areas that coincide", lambda s: _svg_many(boxes(s // 60), "")),
    plan("svg", "light areas over walls", _svg_patches),
    plan("svg", "swings of doors", _svg_arcs),
    plan("svg", "style rules", _svg_styles),
    plan(
        "svg", "declarations for all", lambda s: _svg(f"<style>*{{{'a:b;' * (s // 8)}}}</style>{_SQUARE * (s // 50)}")
    ),
    plan(
        "svg",
        "a rule of one class",
        lambda s: _svg(f"<style>{',.a' * (s // 6)}{{{'a:b;' * (s // 8)}}}</style>{_SQUARE}"),
    ),
    plan("svg", "comments without an end", lambda s: _svg(f"<style>{'/*' * (s // 2)}</style>{_SQUARE}")),
    plan("svg", "a rule without a brace", lambda s: _svg(f"<style>{'a' * s}}}</style>{_SQUARE}")),
    plan(
        "svg",
        "a transform around all",
        lambda s: _svg(f'<g transform="{"rotate(7)" * (s // 18)}">{_SQUARE * (s // 50)}</g>'),
    ),
    plan("svg", "symbols of symbols", lambda _: _svg_symbols(4)),
    plan("svg", "copies of a path", lambda s: _svg_copied(f'd="M0 0{"h1" * (s // 2)}"', 30)),
    plan("svg", "copies of classes", lambda s: _svg_copied(f'class="{"a " * (s // 4)}" d="M0 0h5v5h-5z"', s // 40)),
    plan("svg", "numbers of 1e308", lambda s: _svg_many([[(0.0, 0.0), (1e300, 0.0), (5.0, 1e300)]] * 9)),
    plan("svg", "arcs of radius 1e308", lambda s: _svg('<path d="M0 0' + "A1e308 1e308 0 0 0 9 9" * (s // 22) + '"/>')),
    plan("svg", "a dash of numbers", lambda s: _svg(f'<path d="M0 0{"1" * s}"/>')),
    plan("svg", "a dot of numbers", lambda s: _svg(f'<path d="M0 0{".1" * (s // 2)}"/>')),
    plan("svg", "transforms", lambda s: _svg(f'<path transform="{"rotate(7)" * (s // 9)}" d="M0 0h5v5h-5z"/>')),
    plan("svg", "letters in a transform", lambda s: _svg(f'<path transform="{"a" * s}" d="M0 0h5v5h-5z"/>')),
    plan("svg", "spaces in a style", lambda s: _svg(f"<style>a{{{' ' * s}</style>" + _SQUARE)),
    plan("svg", "nested groups", lambda s: _svg("<g>" * 60 + "<path d='M0 0h5v5h-5z'/>" * (s // 30) + "</g>" * 60)),
    plan(
        "svg",
        "texts",
        lambda s: _svg(
            "<rect width='99' height='99' class='Room'/>" + "<text x='5' y='5'>bedroom 9 m²</text>" * (s // 40)
        ),
    ),
    plan("dxf", "lines that cross", lambda s: _dxf("".join(_dxf_line(*c) for c in chords(s // 50)))),
    plan("dxf", "a lattice", lambda s: _dxf("".join(_dxf_line(*c) for c in lattice(s // 46)))),
    plan("dxf", "a lattice of walls", lambda s: _dxf("".join(_dxf_line(*c, "WALL") for c in lattice(s // 46)))),
    plan("dxf", "an outline that crosses itself", lambda s: _dxf(_dxf_ring(star(s // 22)))),
    plan("dxf", "stars of 15 corners", lambda s: _dxf("".join(map(_dxf_ring, stars(s, 15, 24))))),
    plan("dxf", "outlines that coincide", lambda s: _dxf("".join(map(_dxf_ring, boxes(s // 130))))),
    plan("dxf", "rooms that coincide", lambda s: _dxf("".join(_dxf_ring(box, "ROOM") for box in boxes(s // 130)))),
    plan("dxf", "a hatch that crosses itself", lambda s: _dxf(_dxf_hatch([star(s // 22)]))),
    plan("dxf", "a hatch of areas that coincide", lambda s: _dxf(_dxf_hatch(boxes(s // 110)))),
    plan("dxf", "a spline of degree 200", lambda s: _dxf(_dxf_spline(s))),
    plan("dxf", "layers", _dxf_layers),
    plan("dxf", "a block in itself", _dxf_cycle),
    plan("dxf", "an array of a block", _dxf_copies),
    plan("dxf", "format codes in a text", _dxf_text),
    plan("dxf", "numbers of 1e308", lambda s: _dxf("".join(_dxf_line((0, 0), (1e308, 1e308)) for _ in range(9)))),
    _pdf_plan("lines that cross", lambda s: pdf(_pdf_lines(chords(s // 10, 700.0)))),
    _pdf_plan("a lattice", lambda s: pdf(_pdf_lines(lattice(s // 10, 700.0)))),
    _pdf_plan(
        "an outline that crosses itself",
        lambda s: pdf(b"0 0 m " + b"".join(b"%.2f %.2f l " % p for p in star(s // 8, 300.0)) + b"h f"),
    ),
    _pdf_plan("ten million packed operators", lambda s: pdf(b"0 0 m 9 9 l S " * 1_000_000 * max(s // 100_000, 1))),
    _pdf_plan("fills of the whole page", lambda s: pdf(b"0 0 800 800 re f " * 290_000)),
    _pdf_plan(
        "transparent fills",
        lambda s: pdf(b"/G gs " + b"0 0 800 800 re f " * 290_000, resources="/ExtGState<</G<</ca .3/BM/Multiply>>>>"),
    ),
    _pdf_plan("nested forms", _pdf_nested),
    _pdf_plan("page of 14,400 points", lambda s: pdf(b"0 0 m 14400 14400 l S", 14400, 14400)),
    _pdf_plan("packed operators that draw nothing", lambda s: pdf(b"q Q " * 30_000_000)),
    _pdf_plan(
        "texts",
        lambda s: pdf(
            b"BT /F 9 Tf " + b"1 0 0 1 9 9 Tm (bedroom) Tj " * 100_000 + b"ET",
            resources="/Font<</F<</Type/Font/Subtype/Type1/BaseFont/Helvetica>>>>",
        ),
    ),
    plan("ifc", "a placement in itself", lambda _: _ifc_placed(7)),
    plan("ifc", "a chain of placements", _ifc_chain),
    plan("ifc", "numbers of 1e308", lambda s: ifc_space([(0, 0), (5, 0), (5, 5), (0, 5)], "1.E308")),
    plan("ifc", "a number of 1.E400", lambda s: ifc_space([(0, 0), (5, 0), (5, 5), (0, 5)], "1.E400")),
    plan("ifc", "a space that crosses itself", lambda s: ifc_space(star(s // 50))),
    plan("ifc", "a round space", lambda s: ifc_space(circle(s // 50, 9.0))),
    plan("ifc", "clippings of clippings", _ifc_clippings),
    plan("ifc", "a tube that crosses itself", _ifc_disks),
    plan("ifc", "nested lists", lambda s: _ifc("IFCPOLYLINE(" + "(" * s + ")" * s + ")")),
)
HOSTILE_PLANS = (*MODELS, *DRAWINGS, *PICTURES)
