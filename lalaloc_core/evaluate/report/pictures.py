"""Pictures of one query: its panorama with layouts, and its plan with maps of distances."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.conventions import heading_from_degrees
from lalaloc_core.draw.canvas import FOUND, TRUE, document, draw_cross, rasterise, words
from lalaloc_core.draw.heat import Cells, colour_bar, distance_map, heat_image
from lalaloc_core.draw.photograph import Stroke, draw_strokes, wall_line
from lalaloc_core.draw.plan import Marker, draw_camera, extent_m, plan_part, shape_of
from lalaloc_core.evaluate.runs.predictions import Pose
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.render.sweep import profiles_at

PANORAMA_HEIGHT, PANORAMA_WIDTH = 384, 768
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


def draw_panorama(
    image: UInt8[np.ndarray, "h w 3"], plan: FloorPlan, camera_height_m: float, truth: Pose, found: Pose | None
) -> EncodedPicture:
    """Draw a panorama with the floor and ceiling lines of the true and the found layout."""
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
    alt = f"Panorama with the outlines of {shown} drawn over it"
    return EncodedPicture(name="panorama", content=buffer.getvalue(), kind="jpeg", width=width, height=height, alt=alt)


def layout_lines(
    plan: FloorPlan, pose: Pose, camera_height_m: float, height: int, width: int
) -> list[Float[np.ndarray, "{width} 2"]]:
    """Return the floor and ceiling lines of a pose's room, as pixels (x, y) of its panorama."""
    position_m, heading = np.array([[pose.x_m, pose.y_m]]), np.array([heading_from_degrees(pose.heading_deg)])
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
