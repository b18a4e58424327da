"""Drawings of generated homes as files: SVG, DXF and PDF, in five styles, with words of twelve languages."""

from __future__ import annotations

import ctypes
import io
import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pypdfium2
import pypdfium2.raw as pdfium
import shapely
from ezdxf.filemanagement import new as new_dxf
from shapely.geometry.base import BaseGeometry

from benchmarks.plan_drawing import Model, OpeningSymbol, door_leaves, hatch_lines
from lalaloc_core.draw.canvas import font_file

FileStyle = Literal["outlined", "filled", "hatched", "furnished", "painted over"]
FILE_STYLES: tuple[FileStyle, ...] = get_args(FileStyle)
FileFormat = Literal["svg", "dxf", "pdf"]
FILE_FORMATS: tuple[FileFormat, ...] = get_args(FileFormat)
Layer = Literal["wall", "door", "window", "furniture", "room"]

# Kinds of rooms, and words by language.
_KINDS = ("bedroom", "kitchen", "bathroom", "living room", "corridor", "closet", "storage", "study", "dining room")
_WORDS = tomllib.loads(Path(__file__).with_name("drawn_words.toml").read_text(encoding="utf-8"))
LANGUAGES = tuple(_WORDS)
_LAYERS: tuple[Layer, ...] = get_args(Layer)
# Length on paper at 1:100, points per metre, and pens (m).
_PAPER_MM, _POINTS = 10.0, 72.0 / 2.54
_THICK_PEN, _THIN_PEN, _TEXT_M, _HATCH_M = 0.025, 0.012, 0.2, 0.1
_SHADES = ("#faf0dc", "#e2f0fa", "#e8f6e4", "#fae8ee")


@dataclass(frozen=True)
class Mark:
    """Polygon or line of a drawing, with its fill and its pen (m); an arc: centre, radius, start and end (°)."""

    layer: Layer
    shape: BaseGeometry
    fill: str | None = None
    pen_m: float = 0.0
    arc: tuple[tuple[float, float], float, float, float] | None = None


@dataclass(frozen=True)
class HomeDrawing:
    """Marks in the order of drawing and names with their places, in metres from the lower left corner of the sheet."""

    size_m: tuple[float, float]
    language: str
    marks: list[Mark] = field(default_factory=list)
    names: list[tuple[str, float, float]] = field(default_factory=list)

    def layer(self, layer: Layer) -> str:
        """Return the name of a layer in the drawing's language."""
        return _WORDS[self.language]["layers"].split(",")[_LAYERS.index(layer)]


def draw_file(format: FileFormat, drawing: HomeDrawing) -> tuple[bytes, dict[str, str]]:
    """Return the file of a drawing, and the import options with what a user knows of its scale."""
    if format == "dxf":
        return dxf(drawing), {}
    return svg(drawing).encode() if format == "svg" else pdf(drawing), {"scale": "1:100"}


def draw_home(model: Model, style: FileStyle, language: str, rng: np.random.Generator) -> HomeDrawing:
    drawing = HomeDrawing(model.size_m, language)
    words: dict[str, str] = dict(zip(_KINDS, _WORDS[language]["rooms"].split(","), strict=True))
    for room, name in zip(model.rooms, model.names, strict=True):
        kind = next((kind for kind in _KINDS if name.startswith(kind)), None)
        place = shapely.maximum_inscribed_circle(room, 0.05).coords[0]
        drawing.names.append((words[kind] + name[len(kind) :] if kind else name, place[0], place[1]))
    if style == "furnished":
        _furnish(drawing, model, rng)
    if style == "painted over":
        walls = shapely.union_all([model.walls, *(opening.cut for opening in model.openings)]).buffer(0.002)
    else:
        walls = model.walls
    parts = [part for part in shapely.get_parts(walls) if part.area > 1e-3]
    solid = style in ("filled", "painted over", "furnished")
    tone = "#505050" if style == "furnished" else "#000000"
    for part in parts:
        drawing.marks.append(Mark("wall", part, tone if solid else None, 0.0 if solid else _THICK_PEN))
    if style == "hatched":
        drawing.marks.extend(
            Mark("wall", line, None, _THIN_PEN)
            for line in hatch_lines(walls, model.size_m, _HATCH_M)
            if line.length > 0.01
        )
    for opening in model.openings:
        drawing.marks.extend(_opening(opening, painted=style == "painted over"))
    return drawing


def _opening(opening: OpeningSymbol, *, painted: bool) -> list[Mark]:
    """Return the symbol of an opening; `painted` hides the wall below it."""
    marks = [Mark("window" if opening.kind == "window" else "door", opening.shape, "#ffffff")] if painted else []
    if opening.kind == "window":
        line = shapely.LineString([opening.start, opening.end])
        return [*marks, Mark("window", opening.shape, None, _THIN_PEN), Mark("window", line, None, _THIN_PEN)]
    if opening.kind != "door":
        return marks
    for hinge, direction, inward, radius in door_leaves(opening):
        tip = hinge + radius * inward
        angles = sorted(math.degrees(math.atan2(v[1], v[0])) for v in (direction, inward))
        first, last = angles if angles[1] - angles[0] <= 180.0 else (angles[1], angles[0] + 360.0)
        turns = np.radians(np.linspace(first, last, 25))
        points = hinge + radius * np.column_stack([np.cos(turns), np.sin(turns)])
        marks.append(Mark("door", shapely.LineString([hinge, tip]), None, _THIN_PEN))
        arc = ((float(hinge[0]), float(hinge[1])), radius, first, last)
        marks.append(Mark("door", shapely.LineString(points), None, _THIN_PEN, arc))
    return marks


def _furnish(drawing: HomeDrawing, model: Model, rng: np.random.Generator) -> None:
    swings = [opening.shape.buffer(math.dist(opening.start, opening.end)) for opening in model.openings]
    for number, room in enumerate(model.rooms):
        drawing.marks.append(Mark("furniture", room, _SHADES[number % len(_SHADES)]))
        x0, y0, x1, y1 = room.bounds
        taken: list[BaseGeometry] = list(swings)
        for _ in range(8):
            width, depth = rng.permutation([rng.uniform(0.5, 2.0), rng.uniform(0.4, 0.9)])
            x, y = rng.uniform(x0, x1), rng.choice([y0 + 0.06, y1 - 0.06 - depth])
            piece = shapely.box(x, y, x + width, y + depth)
            if room.buffer(-0.05).contains(piece) and not any(piece.intersects(area) for area in taken):
                taken.append(piece.buffer(0.15))
                drawing.marks.append(Mark("furniture", piece, "#ffffff", _THIN_PEN))
                inner = piece.buffer(-0.08, join_style="mitre")
                drawing.marks.append(Mark("furniture", inner, None, _THIN_PEN))


def svg(drawing: HomeDrawing) -> str:
    """Return a drawing as SVG at 1:100, in groups that are named in its language."""
    width, height = drawing.size_m
    millimetres = f'width="{_PAPER_MM * width:.2f}mm" height="{_PAPER_MM * height:.2f}mm"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {millimetres} viewBox="0 0 {100 * width:.3f} {100 * height:.3f}">'
    parts = [f'{head}<rect width="100%" height="100%" fill="#ffffff"/><g id="{escape(drawing.layer("wall"))}0">']
    layer = ""
    for mark in drawing.marks:
        if mark.layer != layer:
            parts.append(f'</g><g id="{escape(drawing.layer(mark.layer))}{"" if layer == "" else len(parts)}">')
            layer = mark.layer
        pen = f'stroke="#000000" stroke-width="{100 * mark.pen_m:.2f}"' if mark.pen_m else ""
        parts.append(f'<path d="{_svg_path(mark, height)}" fill="{mark.fill or "none"}" fill-rule="evenodd" {pen}/>')
    parts.append(f'</g><g id="{escape(drawing.layer("room"))}" font-size="{100 * _TEXT_M}" text-anchor="middle">')
    parts += [
        f'<text x="{100 * x:.2f}" y="{100 * (height - y):.2f}">{escape(name)}</text>' for name, x, y in drawing.names
    ]
    return "".join([*parts, "</g></svg>"])


def _svg_path(mark: Mark, height_m: float) -> str:
    if mark.arc is not None:
        (x, y), radius, first, last = mark.arc
        ends = [(x + radius * math.cos(math.radians(a)), y + radius * math.sin(math.radians(a))) for a in (first, last)]
        (x0, y0), (x1, y1) = [(100 * px, 100 * (height_m - py)) for px, py in ends]
        return f"M{x0:.3f} {y0:.3f}A{100 * radius:.3f} {100 * radius:.3f} 0 0 0 {x1:.3f} {y1:.3f}"
    text = ""
    for ring, is_closed in _rings(mark.shape):
        points = [f"{100 * x:.3f} {100 * (height_m - y):.3f}" for x, y in ring]
        text += "M" + "L".join(points) + ("Z" if is_closed else "")
    return text


def _rings(shape: BaseGeometry) -> list[tuple[Sequence[tuple[float, ...]], bool]]:
    if isinstance(shape, shapely.Polygon):
        return [(ring.coords[:-1], True) for ring in (shape.exterior, *shape.interiors)]
    return [(shape.coords[:], False)]


def dxf(drawing: HomeDrawing) -> bytes:
    """Return a drawing as DXF in metres, on layers that are named in its language; fills are solid hatches."""
    document = new_dxf("R2010")
    document.header["$INSUNITS"] = 6
    space = document.modelspace()
    for mark in drawing.marks:
        attributes = {"layer": drawing.layer(mark.layer)}
        if mark.arc is not None:
            centre, radius, first, last = mark.arc
            space.add_arc(centre, radius, first, last, dxfattribs=attributes)
            continue
        if mark.fill is not None and mark.fill not in ("#ffffff", *_SHADES):
            hatch = space.add_hatch(color=7, dxfattribs=attributes)
            for ring, _ in _rings(mark.shape):
                hatch.paths.add_polyline_path(ring, is_closed=True)
        if mark.pen_m:
            for ring, is_closed in _rings(mark.shape):
                space.add_lwpolyline(ring, close=is_closed, dxfattribs=attributes)
    for name, x, y in drawing.names:
        space.add_text(name, height=_TEXT_M, dxfattribs={"layer": drawing.layer("room"), "insert": (x, y)})
    stream = io.StringIO()
    document.write(stream)
    return stream.getvalue().encode()


def pdf(drawing: HomeDrawing) -> bytes:
    """Return a drawing as a page of a PDF at 1:100, with text."""
    document = pypdfium2.PdfDocument.new()
    page = document.new_page(*(_POINTS * size for size in drawing.size_m))
    for mark in drawing.marks:
        pdfium.FPDFPage_InsertObject(page.raw, _pdf_path(mark))
    content = font_file("あ" if drawing.language == "Japanese" else "a").read_bytes()
    data = (ctypes.c_ubyte * len(content)).from_buffer_copy(content)
    font = pdfium.FPDFText_LoadFont(document.raw, data, len(content), pdfium.FPDF_FONT_TRUETYPE, True)
    for name, x, y in drawing.names:
        text = pdfium.FPDFPageObj_CreateTextObj(document.raw, font, _POINTS * _TEXT_M)
        letters = (name + "\0").encode("utf-16-le")
        pdfium.FPDFText_SetText(text, ctypes.cast(ctypes.c_char_p(letters), ctypes.POINTER(ctypes.c_ushort)))
        pdfium.FPDFPageObj_Transform(text, 1, 0, 0, 1, _POINTS * (x - 0.3 * _TEXT_M * len(name)), _POINTS * y)
        pdfium.FPDFPage_InsertObject(page.raw, text)
    pdfium.FPDFPage_GenerateContent(page.raw)
    stream = io.BytesIO()
    document.save(stream)
    return stream.getvalue()


def _pdf_path(mark: Mark) -> Any:
    rings = _rings(mark.shape)
    (x, y), *_ = rings[0][0]
    path = pdfium.FPDFPageObj_CreateNewPath(_POINTS * x, _POINTS * y)
    if mark.arc is not None:
        (cx, cy), radius, first, last = mark.arc
        a, b = math.radians(first), math.radians(last)
        k = 4.0 / 3.0 * math.tan(0.25 * (b - a)) * radius
        ends = [(cx + radius * math.cos(t), cy + radius * math.sin(t)) for t in (a, b)]
        tangents = [(-k * math.sin(t), k * math.cos(t)) for t in (a, b)]
        points = [
            (ends[0][0] + tangents[0][0], ends[0][1] + tangents[0][1]),
            (ends[1][0] - tangents[1][0], ends[1][1] - tangents[1][1]),
            ends[1],
        ]
        pdfium.FPDFPath_BezierTo(path, *(_POINTS * value for point in points for value in point))
    else:
        for number, (ring, is_closed) in enumerate(rings):
            if number:
                pdfium.FPDFPath_MoveTo(path, _POINTS * ring[0][0], _POINTS * ring[0][1])
            for px, py in ring[1:]:
                pdfium.FPDFPath_LineTo(path, _POINTS * px, _POINTS * py)
            if is_closed:
                pdfium.FPDFPath_Close(path)
    if mark.fill is not None:
        red, green, blue = (int(mark.fill[index : index + 2], 16) for index in (1, 3, 5))
        pdfium.FPDFPageObj_SetFillColor(path, red, green, blue, 255)
    pdfium.FPDFPageObj_SetStrokeColor(path, 0, 0, 0, 255)
    pdfium.FPDFPageObj_SetStrokeWidth(path, _POINTS * mark.pen_m)
    fill = pdfium.FPDF_FILLMODE_NONE if mark.fill is None else pdfium.FPDF_FILLMODE_ALTERNATE
    pdfium.FPDFPath_SetDrawMode(path, fill, mark.pen_m > 0.0)
    return path
