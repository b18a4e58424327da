"""Basic SVG elements and rasterisation: documents, text, paths, embedded pictures."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterable
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Final

import numpy as np
import resvg_py
from jaxtyping import Float, UInt8
from PIL import Image

from lalaloc_core.shown_text import printable

INK, MUTED, RULE, PAPER = "#20242c", "#5a6472", "#d5dbe1", "#ffffff"
# Predicted poses: vermilion of Okabe and Ito's palette, distinct for colour-blind readers.
FOUND = "#d55e00"
# Walls and openings: the same colours in plans, over photographs (with a dark edge) and on the page, whose style sheet
# repeats them, with lighter ones for plans on a dark ground. Readers with protanopia and deuteranopia can tell them
# apart, and the importer of pictures reads brown doors and blue windows.
ON_PAPER: Final = {"wall": "#20242c", "door": "#b5651d", "window": "#2b7fc9", "passage": "#8c939c"}
ON_PHOTOGRAPH: Final = {"wall": "#ffe14d", "door": "#e8702a", "window": "#4aa8ff", "passage": "#ffffff"}
# A length or coordinate of a drawing.
Number = int | float
Box = tuple[Number, Number, Number, Number]

FONT_FAMILY = "DejaVu Sans, Verdana, sans-serif"

_FONT_FOLDER = Path(__file__).parent / "fonts"
_FONTS = [str(path) for path in sorted(_FONT_FOLDER.glob("DejaVu*.ttf"))]
# Fonts of Chinese and Japanese characters and of Korean syllables, and characters that no bundled font has.
_EAST_ASIAN = {
    _FONT_FOLDER / "DroidSansFallback-subset.ttf": re.compile("[\u2e80-\ua4cf\uf900-\ufaff\uff00-\uffef]"),
    _FONT_FOLDER / "DroidSansFallback-korean.ttf": re.compile("[\uac00-\ud7a3]"),
}
_OTHER_SCRIPTS = re.compile(
    "[\u0700-\u07bf\u0800-\u0e7f\u0f00-\u109f\u1100-\u13ff\u1680-\u1cff\u3130-\u318f\ua4d0-\uabff\ud7a4-\ud7ff\U00010000-\U0010ffff]"
)


def document(width: Number, height: Number, title: str, parts: Iterable[str]) -> str:
    """Return an SVG document of a size in pixels."""
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
            f'viewBox="0 0 {width:.0f} {height:.0f}" font-family="{FONT_FAMILY}">',
            f"<title>{xml_text(title)}</title>",
            f'<rect width="{width:.0f}" height="{height:.0f}" fill="{PAPER}"/>',
            *parts,
            "</svg>\n",
        ]
    )


def rasterise(svg: str) -> bytes:
    """Rasterise a drawing as PNG.

    The bundled fonts cover Latin, Greek, Cyrillic, Arabic, Hebrew, Chinese, Japanese, the 2,350 common Korean syllables
    and a few more scripts, so that pictures are the same on every machine. For others, such as Thai and Devanagari, the
    system's fonts are used; without one, the characters are boxes. External references are not loaded.
    """
    # Reading a font takes as long as drawing a plan.
    east_asian = [str(path) for path, script in _EAST_ASIAN.items() if script.search(svg)]
    return resvg_py.svg_to_bytes(
        svg_string=svg,
        skip_system_fonts=_OTHER_SCRIPTS.search(svg) is None,
        font_files=[*_FONTS, *east_asian],
        sans_serif_family="DejaVu Sans",
    )


def font_runs(text: str) -> list[tuple[Path, str]]:
    """Return the parts of a text with the bundled font of each."""
    return [(path, "".join(letters)) for path, letters in groupby(text, font_file)]


def pixels(svg: str) -> Image.Image:
    """Rasterise a drawing as an RGB picture."""
    with Image.open(io.BytesIO(rasterise(svg))) as image:
        return image.convert("RGB")


def font_file(text: str) -> Path:
    """Return the bundled font that has most letters of a text."""
    plain = _FONT_FOLDER / "DejaVuSans.ttf"
    return next((path for path, script in _EAST_ASIAN.items() if script.search(text)), plain)


def xml_text(text: str) -> str:
    """Escape text for XML, and replace what XML does not allow."""
    return escape(printable(text))


def words(
    x: Number, y: Number, text: str, size: Number, *, fill: str = INK, anchor: str = "start", more: str = ""
) -> str:
    """Draw a line of text; `y` is its base line."""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" fill="{fill}" text-anchor="{anchor}" {more}>'
        f"{xml_text(text)}</text>"
    )


def shortened(text: str, characters: int) -> str:
    """Shorten text to at most `characters` characters."""
    return text if len(text) <= characters else text[: max(characters - 1, 1)] + "…"


def path(lines: Iterable[Float[np.ndarray, "_ 2"]], digits: int = 1) -> str:
    """Return lines of points as the `d` of an SVG path."""
    parts = []
    for line in lines:
        first, *others = (f"{x:.{digits}f} {y:.{digits}f}" for x, y in line.tolist())
        parts.append(f"M{first}" + "".join(f"L{point}" for point in others))
    return "".join(parts)


def image(content: bytes, kind: str, box: Box, more: str = "") -> str:
    """Embed an encoded picture, stretched to fill a box (x, y, width, height)."""
    x, y, width, height = box
    return (
        f'<image x="{x:.4f}" y="{y:.4f}" width="{width:.4f}" height="{height:.4f}" preserveAspectRatio="none" '
        f'{more} href="data:image/{kind};base64,{base64.b64encode(content).decode()}"/>'
    )


def png(values: UInt8[np.ndarray, "h w c"]) -> bytes:
    """Encode pixels as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(values).save(buffer, "PNG")
    return buffer.getvalue()
