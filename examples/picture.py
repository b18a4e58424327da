"""Picture of the demo: the service's picture of every localisation, with its error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from examples.truth import TruePose
from lalaloc_client import Localisation
from lalaloc_core.draw.canvas import MUTED, document, image, pixels, words

# Size of a panel: width of its picture, height of its heading, and gap between panels.
_WIDTH, _HEAD, _GAP = 1000, 96, 30
_COLUMNS = 2
_JPEG_QUALITY = 88


@dataclass(frozen=True)
class Panel:
    """Results for one photograph with and without its heading; `picture` is the PNG of `known`."""

    truth: TruePose
    known: Localisation
    unknown: Localisation
    picture: bytes
    size: tuple[int, int]


def draw_demo(panels: Sequence[Panel], path: Path) -> None:
    """Draw all panels in two columns."""
    height = max(_WIDTH * panel.size[1] / panel.size[0] for panel in panels)
    row_height, rows = _HEAD + height + _GAP, -(-len(panels) // _COLUMNS)
    parts = []
    for index, panel in enumerate(panels):
        row, column = divmod(index, _COLUMNS)
        parts.append(_panel(panel, _GAP + column * (_WIDTH + _GAP), row * row_height))
    whole = document(_COLUMNS * (_WIDTH + _GAP) + _GAP, rows * row_height, "LaLaLoc", parts)
    drawn: Image.Image = pixels(whole)
    # PNG ignores the quality.
    drawn.save(path, quality=_JPEG_QUALITY)


def _panel(panel: Panel, x: float, y: float) -> str:
    box = (x, y + _HEAD, _WIDTH, _WIDTH * panel.size[1] / panel.size[0])
    sentences = (
        _sentence("heading given", panel.truth, panel.known),
        _sentence("heading not given", panel.truth, panel.unknown),
    )
    return "".join(
        [
            words(x + 24, y + 40, panel.truth.file, 26, more='font-weight="bold"'),
            *(words(x + 24, y + 68 + 24 * line, text, 17, fill=MUTED) for line, text in enumerate(sentences)),
            image(panel.picture, "png", box, 'image-rendering="smooth"'),
        ]
    )


def _sentence(label: str, truth: TruePose, localisation: Localisation) -> str:
    x_m, y_m = localisation.position.x_m, localisation.position.y_m
    error_m = math.hypot(x_m - truth.x_m, y_m - truth.y_m)
    turn_deg = (localisation.heading_deg - truth.heading_deg + 180.0) % 360.0 - 180.0
    confidence = "" if localisation.confidence is None else f", confidence {localisation.confidence:.2f}"
    return (
        f"{label}: {localisation.room} ({x_m:.2f}, {y_m:.2f}) m, error {error_m:.2f} m and {turn_deg:+.1f}°{confidence}"
    )
