"""DXF and SVG: rooms, holes, free-standing walls and openings on layers that are named so."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np
import shapely
from ezdxf.filemanagement import new as new_dxf

_METRES = 6
_LAYERS = {"ROOM": 7, "COLUMN": 8, "WALL": 1, "DOOR": 3, "WINDOW": 5, "PASSAGE": 30, "ROOM-TEXT": 2}
# Of paper: 1:100.
_UNITS_PER_M, _MM_PER_M, _MARGIN_M = 100.0, 10.0, 0.5
SCALE_ATTRIBUTE = "data-metres-per-unit"
_STYLE = (
    ".Space{fill:#eef3f7;stroke:#222;stroke-width:4}.Column{fill:#888}.Wall{stroke:#222;stroke-width:8}"
    ".Door{stroke:#2a7;stroke-width:6}.Window{stroke:#26c;stroke-width:6}.Passage{stroke:#d80;stroke-width:6}"
    "text{font:24px sans-serif;text-anchor:middle}"
)


def to_dxf(document: Mapping[str, Any]) -> bytes:
    """A DXF drawing in metres. Heights and ids have no place in it."""
    drawing = new_dxf("R2010")
    drawing.header["$INSUNITS"] = _METRES
    for layer, colour in _LAYERS.items():
        drawing.layers.add(layer, color=colour)
    space = drawing.modelspace()
    for room in document["rooms"]:
        space.add_lwpolyline(room["polygon"], close=True, dxfattribs={"layer": "ROOM"})
        for hole in room.get("holes", ()):
            space.add_lwpolyline(hole, close=True, dxfattribs={"layer": "COLUMN"})
        for start, end in room.get("walls", ()):
            space.add_line(start, end, dxfattribs={"layer": "WALL"})
        if room.get("name"):
            space.add_text(room["name"], height=0.2, dxfattribs={"layer": "ROOM-TEXT"}).set_placement(_inside(room))
    for opening in document.get("openings", ()):
        start, end = opening["line"]
        space.add_line(start, end, dxfattribs={"layer": opening["kind"].upper()})
    text = io.StringIO()
    drawing.write(text)
    return text.getvalue().encode()


def to_svg(document: Mapping[str, Any]) -> bytes:
    """A SVG drawing at 1:100, a centimetre to a unit, with the classes of CubiCasa5K. Heights have no place in it."""
    corners = np.concatenate([np.asarray(room["polygon"], dtype=float) for room in document["rooms"]])
    low, high = corners.min(axis=0) - _MARGIN_M, corners.max(axis=0) + _MARGIN_M
    width, height = (float(size) for size in high - low)

    def place(points: Sequence[Sequence[float]]) -> str:
        return " ".join(f"{_UNITS_PER_M * x:.4f},{-_UNITS_PER_M * y:.4f}" for x, y in points)

    box = (_UNITS_PER_M * low[0], -_UNITS_PER_M * high[1], _UNITS_PER_M * width, _UNITS_PER_M * height)
    root = ElementTree.Element(
        "svg",
        {
            "xmlns": "http://www.w3.org/2000/svg",
            "width": f"{_MM_PER_M * width:.3f}mm",
            "height": f"{_MM_PER_M * height:.3f}mm",
            "viewBox": " ".join(f"{value:.4f}" for value in box),
            SCALE_ATTRIBUTE: repr(1.0 / _UNITS_PER_M),
        },
    )
    ElementTree.SubElement(root, "style").text = _STYLE
    for room in document["rooms"]:
        group = ElementTree.SubElement(root, "g", {"class": f"Space {str(room.get('type', '')).capitalize()}".strip()})
        shape = {"points": place(room["polygon"])}
        if room.get("name"):
            shape["data-name"] = room["name"]
        ElementTree.SubElement(group, "polygon", shape)
        for hole in room.get("holes", ()):
            ElementTree.SubElement(root, "polygon", {"class": "Column", "points": place(hole)})
        for wall in room.get("walls", ()):
            ElementTree.SubElement(root, "polyline", {"class": "Wall", "fill": "none", "points": place(wall)})
        x, y = _inside(room)
        at = {"x": f"{_UNITS_PER_M * x:.2f}", "y": f"{-_UNITS_PER_M * y:.2f}"}
        ElementTree.SubElement(root, "text", at).text = room.get("name", "")
    for opening in document.get("openings", ()):
        says = {"class": opening["kind"].capitalize(), "fill": "none", "points": place(opening["line"])}
        ElementTree.SubElement(root, "polyline", says)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _inside(room: Mapping[str, Any]) -> tuple[float, float]:
    """The middle of the largest circle in a room."""
    centre = shapely.maximum_inscribed_circle(shapely.Polygon(room["polygon"], room.get("holes")), 0.01).coords[0]
    return float(centre[0]), float(centre[1])
