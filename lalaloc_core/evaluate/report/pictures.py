"""Pictures of queries: a sphere with layouts, a plan with maps of distances, and contact sheets of many."""

from __future__ import annotations

import base64
import io
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

from lalaloc_core.draw.canvas import FOUND, TRUE, document, draw_cross, rasterise, words
from lalaloc_core.draw.heat import Cells, colour_bar, distance_map, heat_image
from lalaloc_core.draw.outline import Stroke, draw_strokes, wall_line
from lalaloc_core.draw.plan import Marker, draw_camera, extent_m, plan_part, shape_of
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.render.sweep import profiles_at

SPHERE_HEIGHT, SPHERE_WIDTH = 384, 768
TRUE_COLOUR, FOUND_COLOUR, PREDICTED_COLOUR = TRUE, FOUND, "#ffd60a"
_JPEG_QUALITY = 82
# Pixels of a map: width, header, footer and margin.
_MAP_WIDTH, _MAP_HEAD, _MAP_FOOT, _MAP_PAD = 640, 32, 84, 12


@dataclass(frozen=True, eq=False, kw_only=True)
class EncodedPicture:
    """Encoded picture: its name among the query's pictures, its kind ("jpeg" or "png"), and its alternative text."""

    name: str
    content: bytes
    kind: str
    width: int
    height: int
    alt: str

    @property
    def file_name(self) -> str:
        """Name of its file."""
        return self.name + (".jpg" if self.kind == "jpeg" else ".png")

    @property
    def data_uri(self) -> str:
        """The picture as a data URI."""
        return f"data:image/{self.kind};base64,{base64.b64encode(self.content).decode()}"


@dataclass(frozen=True, eq=False)
class DrawnMap:
    """Map of the distances of `cells.poses`, with title and scale."""

    title: str
    scale: str
    cells: Cells
    distance: Float[np.ndarray, "n"]


def draw_sphere(
    image: UInt8[np.ndarray, "h w 3"], plan: FloorPlan, camera_height_m: float, truth: Pose, found: Pose | None
) -> EncodedPicture:
    """Draw a sphere with the floor and ceiling lines of the true and the found layout."""
    height, width, _ = image.shape
    # The true lines are wider and below, so that both are visible where they coincide.
    strokes = [
        Stroke(layout_lines(plan, pose, camera_height_m, height, width), colour, line_width, edge_width)
        for pose, colour, line_width, edge_width in ((truth, TRUE_COLOUR, 5.0, 7.0), (found, FOUND_COLOUR, 2.0, 3.0))
        if pose is not None
    ]
    buffer = io.BytesIO()
    draw_strokes(image, strokes).save(buffer, "JPEG", quality=_JPEG_QUALITY, optimize=True)
    shown = "the true layout" if found is None else "the true and the found layout"
    alt = f"Sphere with the outlines of {shown} drawn over it"
    return EncodedPicture(name="sphere", content=buffer.getvalue(), kind="jpeg", width=width, height=height, alt=alt)


def layout_lines(
    plan: FloorPlan, pose: Pose, camera_height_m: float, height: int, width: int
) -> list[Float[np.ndarray, "{width} 2"]]:
    """Return the floor and ceiling lines of a pose's room, as pixels (x, y) of its sphere."""
    position_m, heading = pose.position_m[None], np.array([pose.heading])
    profile = profiles_at(plan, position_m, np.array([pose.room_index]), heading, width)[0]
    over_floor, under_ceiling = camera_height_m, float(plan.ceiling_heights_m[pose.room_index]) - camera_height_m
    return [wall_line(profile, rise_m, height) for rise_m in (-over_floor, under_ceiling)]


def draw_map(plan: FloorPlan, drawn: DrawnMap, truth: Pose, found: Pose | None) -> EncodedPicture:
    """Draw a plan with a map of distances, the true position (×) and the found pose (dot and heading)."""
    extent = extent_m(plan)
    heat = distance_map(drawn.cells, drawn.distance, drawn.scale)
    marks = [draw_cross(truth.x_m, -truth.y_m, extent / 45.0)]
    if found is not None:
        marks.append(draw_camera(Marker(x_m=found.x_m, y_m=found.y_m, heading_deg=found.heading_deg), extent))
    width, height = _MAP_WIDTH, _MAP_HEAD + round(_MAP_WIDTH / shape_of(plan)) + _MAP_FOOT
    box = (_MAP_PAD, _MAP_HEAD, width - 2 * _MAP_PAD, height - _MAP_HEAD - _MAP_FOOT)
    middle, foot = 0.5 * width, height - _MAP_FOOT + 16
    legend = "true ×" if found is None else "found ●   true ×"
    parts = [
        words(middle, 22, drawn.title, 17, anchor="middle"),
        plan_part(plan, box, "".join(marks[::-1]), heat=heat_image(heat, plan)),
        colour_bar(heat, _MAP_PAD, foot, 0.6 * width),
        words(width - _MAP_PAD, foot + 36, legend, 15, anchor="end"),
    ]
    content = rasterise(document(width, height, drawn.title, parts))
    alt = f"Floor plan coloured by {drawn.title}"
    return EncodedPicture(
        name=drawn.title.replace(" ", "-"), content=content, kind="png", width=width, height=height, alt=alt
    )


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
