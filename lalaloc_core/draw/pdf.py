"""Drawings as pages of a PDF: a picture of each under its invisible text, which can be selected and found.

Pictures look the same on every machine, whatever script a name is in. PDFium lays the text over them.
"""

from __future__ import annotations

import ctypes
import io
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import pypdfium2
import pypdfium2.raw as pdfium
from defusedxml.ElementTree import fromstring
from jaxtyping import Float

from lalaloc_core.draw.canvas import font_runs, pixels
from lalaloc_core.photograph.picture_files import jpeg

_POINTS_PER_INCH = 72.0
_LANGUAGE = "en"
# Width of a space in DejaVu Sans, as a share of the font's size.
_SPACE = 0.318
_STEP = re.compile(r"(translate|scale|rotate)\(([^)]*)\)")


@dataclass(frozen=True)
class DrawnText:
    """A line of text in a drawing: its base line begins at (x, y), in pixels; `angle` (radians) turns it clockwise."""

    text: str
    x: float
    y: float
    size: float
    anchor: str
    angle: float


def draw_pdf(pages: Iterable[str], dpi: int) -> bytes:
    """Return SVG drawings as pages of a PDF, whose text can be selected."""
    document = pypdfium2.PdfDocument.new()
    try:
        layer = _TextLayer(document)
        for svg in pages:
            picture = pixels(svg)
            scale = _POINTS_PER_INCH / dpi
            width, height = scale * picture.width, scale * picture.height
            page = document.new_page(width, height)
            image = pypdfium2.PdfImage.new(document)
            image.load_jpeg(io.BytesIO(jpeg(np.asarray(picture))), inline=True)
            image.set_matrix(pypdfium2.PdfMatrix().scale(width, height))
            page.insert_obj(image)
            for text in _texts(fromstring(svg), np.eye(3), "start"):
                layer.insert(page, text, scale, height)
            page.gen_content()
            page.close()
        pdfium.FPDFCatalog_SetLanguage(document, _wide(_LANGUAGE))
        content = io.BytesIO()
        document.save(content)
    finally:
        document.close()
    return content.getvalue()


def _texts(element: Element, frame: Float[np.ndarray, "3 3"], anchor: str) -> Iterator[DrawnText]:
    for kind, values in _STEP.findall(element.get("transform", "")):
        frame = frame @ _matrix(kind, [float(value) for value in re.split(r"[\s,]+", values.strip())])
    anchor = element.get("text-anchor", anchor)
    if element.tag.endswith("}text"):
        x, y, size = (float(element.get(name, value)) for name, value in (("x", 0), ("y", 0), ("font-size", 16)))
        yield _placed(element.text or "", x, y, size, frame, anchor)
        for line in element:
            size = float(line.get("font-size", size))
            y += size * float(line.get("dy", "0em").removesuffix("em"))
            yield _placed(line.text or "", float(line.get("x", x)), y, size, frame, anchor)
        return
    for child in element:
        yield from _texts(child, frame, anchor)


def _placed(text: str, x: float, y: float, size: float, frame: Float[np.ndarray, "3 3"], anchor: str) -> DrawnText:
    right, down, _ = frame @ (x, y, 1.0)
    scale, angle = np.hypot(frame[0, 0], frame[1, 0]), np.arctan2(frame[1, 0], frame[0, 0])
    return DrawnText(text, float(right), float(down), float(scale) * size, anchor, float(angle))


def _matrix(kind: str, values: list[float]) -> Float[np.ndarray, "3 3"]:
    first, second = (values[0], values[-1])
    if kind == "translate":
        return np.array([[1.0, 0.0, first], [0.0, 1.0, second], [0.0, 0.0, 1.0]])
    if kind == "scale":
        return np.diag([first, second, 1.0])
    sine, cosine = np.sin(np.radians(first)), np.cos(np.radians(first))
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _wide(text: str) -> ctypes.Array[ctypes.c_ushort]:
    content = (text + "\0").encode("utf-16-le")
    return (ctypes.c_ushort * (len(content) // 2)).from_buffer_copy(content)


class _TextLayer:
    """Invisible text in the fonts of the drawings, which are embedded once, if they are used."""

    def __init__(self, document: pypdfium2.PdfDocument) -> None:
        self._document = document
        self._fonts: dict[Path, pdfium.FPDF_FONT] = {}

    def insert(self, page: pypdfium2.PdfPage, text: DrawnText, scale: float, height: float) -> None:
        """Insert a text; `scale` is points per pixel, `height` that of the page in points."""
        parts, width = list[tuple[pypdfium2.PdfObject, float]](), 0.0
        for path, run in font_runs(text.text):
            raw = pdfium.FPDFPageObj_CreateTextObj(self._document, self._font(path), scale * text.size)
            pdfium.FPDFText_SetText(raw, _wide(run))
            pdfium.FPDFTextObj_SetTextRenderMode(raw, pdfium.FPDF_TEXTRENDERMODE_INVISIBLE)
            part = pypdfium2.PdfObject(raw, pdf=self._document)
            # Objects outside a page have no bounds.
            page.insert_obj(part)
            parts.append((part, width))
            # Bounds are those of the ink, without the spaces at the end.
            spaces = len(run) - len(run.rstrip(" "))
            width += part.get_bounds()[2] + scale * text.size * _SPACE * spaces
        begin = -{"middle": 0.5, "end": 1.0}.get(text.anchor, 0.0) * width
        for part, left in parts:
            matrix = pypdfium2.PdfMatrix().translate(begin + left, 0.0).rotate(np.degrees(text.angle))
            part.transform(matrix.translate(scale * text.x, height - scale * text.y))

    def _font(self, path: Path) -> pdfium.FPDF_FONT:
        if path not in self._fonts:
            content = path.read_bytes()
            array = (ctypes.c_ubyte * len(content)).from_buffer_copy(content)
            font = pdfium.FPDFText_LoadFont(self._document, array, len(content), pdfium.FPDF_FONT_TRUETYPE, True)
            self._fonts[path] = font
        return self._fonts[path]
