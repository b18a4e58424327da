"""Photographs with lines over them: the outline of a layout, or walls predicted by a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from lalaloc_core.draw.canvas import INK, ON_PHOTOGRAPH, Box, Number, document, image, path, pixels, png, words
from lalaloc_core.draw.outline import Outline

WALL_COLOUR = ON_PHOTOGRAPH["wall"]
# In the order of the legend.
_KINDS = ("door", "window", "passage")


@dataclass(frozen=True, eq=False)
class Stroke:
    """Lines of pixels (x, y) in one colour, `width` pixels wide, on a dark edge of `edge_width`."""

    lines: Sequence[Float[np.ndarray, "_ 2"]]
    colour: str
    width: float
    edge_width: float


def draw_strokes(photograph: UInt8[np.ndarray, "h w 3"], strokes: Sequence[Stroke]) -> Image.Image:
    """Draw lines over a photograph, the last ones on top."""
    height, width, _ = photograph.shape
    whole = image(png(photograph), "png", (0.0, 0.0, width, height), 'image-rendering="optimizeSpeed"')
    return pixels(document(width, height, "", [whole, *(_stroke(stroke) for stroke in strokes)]))


def wall_line(profile_m: Float[np.ndarray, "w"], rise_m: float, height: int) -> Float[np.ndarray, "w 2"]:
    """Return the line at `rise_m` above the camera on the walls of a profile, as pixels (x, y) of a sphere."""
    x = np.arange(len(profile_m)) + 0.5
    return np.stack([x, (0.5 - np.arctan2(rise_m, profile_m) / np.pi) * height], axis=1)


def wall_stroke(
    outline: Outline, size: tuple[int, int], colour: str = WALL_COLOUR, width: float = 2.0, edge_width: float = 3.0
) -> Stroke:
    """Return floor line, ceiling line and corners of an outline in a picture of a size (width, height)."""
    return Stroke([line * size for line in outline.edges], colour, width, edge_width)


def photograph_part(content: bytes, kind: str, outline: Outline, box: Box) -> str:
    """Draw a photograph with a layout over it as a part of a larger drawing.

    `content` is the encoded picture, of kind "jpeg" or "png", with as many pixels as the box; `box` is x, y, width and
    height.
    """
    x, y, width, height = box
    size = np.array([width, height])
    # Proportional to the width, so that lines look alike at every size.
    line = width / 480.0
    # Unscaled pixels need no smoothing, which takes a second.
    parts = [image(content, kind, (0.0, 0.0, width, height), 'image-rendering="optimizeSpeed"')]
    for opening in outline.openings:
        d, colour = path([opening.line * size]), ON_PHOTOGRAPH[opening.kind]
        parts.append(
            f'<path class="{opening.kind}" d="{d}" fill="{colour}" fill-opacity="0.18" stroke="{INK}" '
            f'stroke-width="{1.6 * line:.2f}" stroke-linejoin="round"/>'
            f'<path d="{d}" fill="none" stroke="{colour}" stroke-width="{0.9 * line:.2f}" stroke-linejoin="round"/>'
        )
    parts.append(_stroke(wall_stroke(outline, (round(width), round(height)), WALL_COLOUR, line, 1.8 * line)))
    return f'<g class="photograph" transform="translate({x:.1f} {y:.1f})">{"".join(parts)}</g>'


def photograph_key(outline: Outline, x: Number, y: Number) -> str:
    """Draw the legend of the lines in a photograph; `y` is the base line of its text."""
    kinds = sorted({opening.kind for opening in outline.openings}, key=_KINDS.index)
    parts = []
    for name, colour in (("walls of the plan", WALL_COLOUR), *((kind + "s", ON_PHOTOGRAPH[kind]) for kind in kinds)):
        parts.append(
            f'<rect x="{x:.1f}" y="{y - 13:.1f}" width="26" height="13" rx="3" fill="{colour}" stroke="{INK}"/>'
            + words(x + 36, y, name, 17)
        )
        x += 36 + 9.8 * len(name) + 34
    return "".join(parts)


def _stroke(stroke: Stroke) -> str:
    d = path([line for line in stroke.lines if len(line) > 1], 2)
    return "".join(
        f'<path class="layout" d="{d}" fill="none" stroke="{colour}" stroke-width="{width:.2f}" '
        'stroke-linejoin="round" stroke-linecap="round"/>'
        for colour, width in ((INK, stroke.edge_width), (stroke.colour, stroke.width))
    )
