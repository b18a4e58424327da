"""Contact sheets: small pictures with captions on one page."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

COLUMNS, ROWS = 4, 5
PER_SHEET = COLUMNS * ROWS
# Large enough to show a door, small enough for four side by side on a screen.
PICTURE_HEIGHT, PICTURE_WIDTH = 192, 384
_TEXT_LINES, _LINE = 4, 15
_FONT_SIZE, _CHARACTERS = 12, 58
_GAP, _HEADER = 8, 26
_PAPER, _INK = "white", "#20242c"


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """Picture with the lines of its caption, cut to fit."""

    picture: Image.Image
    caption: Sequence[str]


def draw_sheet(title: str, key: Mapping[str, str], thumbnails: Sequence[Thumbnail]) -> Image.Image:
    """Draw one page.

    `key` gives the meaning of the lines by colour. The thumbnails are of one size and drawn row by row.
    """
    width, height = thumbnails[0].picture.size if thumbnails else (PICTURE_WIDTH, PICTURE_HEIGHT)
    assert all(item.picture.size == (width, height) for item in thumbnails), "pictures differ in size"
    cell_width, cell_height = width + _GAP, height + _TEXT_LINES * _LINE + _GAP
    characters = _CHARACTERS * width // PICTURE_WIDTH
    rows = -(-len(thumbnails) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * cell_width + _GAP, _HEADER + rows * cell_height + _GAP), _PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.truetype(findfont("DejaVu Sans"), _FONT_SIZE)
    x = float(_GAP)
    for text, colour in ((title, None), *((meaning, colour) for colour, meaning in key.items())):
        if colour is not None:
            draw.rectangle((x, 8, x + 18, 18), fill=colour, outline=_INK)
            x += 24
        draw.text((x, 6), text, font=font, fill=_INK)
        x += draw.textlength(text, font=font) + 24
    for index, thumbnail in enumerate(thumbnails):
        row, column = divmod(index, COLUMNS)
        left, top = _GAP + column * cell_width, _HEADER + row * cell_height
        sheet.paste(thumbnail.picture, (left, top))
        lines = [part for line in thumbnail.caption for part in textwrap.wrap(line, characters)]
        for place, line in enumerate(lines[:_TEXT_LINES]):
            draw.text((left, top + height + place * _LINE + 1), line, font=font, fill=_INK)
    return sheet
