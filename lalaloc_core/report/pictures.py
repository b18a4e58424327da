"""The pictures of one query: its panorama with layouts drawn over it, and its plan with maps of distances."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from lalaloc_core.conventions import heading_from_degrees
from lalaloc_core.evaluation.predictions import Pose
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.render.poses import profiles_at
from lalaloc_core.report.plan import Cells, draw_camera, draw_distances, draw_plan, halo

PANORAMA_HEIGHT, PANORAMA_WIDTH = 384, 768
TRUE_COLOUR, FOUND_COLOUR, PREDICTED_COLOUR = "#35e0ff", "#ff3b30", "#ffd60a"
_EDGE = (20, 24, 30)
# Lines are drawn this much larger and scaled down, which smooths them.
_OVERSAMPLING = 3
_JPEG_QUALITY = 82
_MAP_INCHES = (4.6, 3.9)
_MAP_DPI = 110


@dataclass(frozen=True, eq=False, kw_only=True)
class Picture:
    """An encoded picture: `kind` is "jpeg" or "png", `name` what it is among a query's, `alt` says what it shows."""

    name: str
    content: bytes
    kind: str
    width: int
    height: int
    alt: str

    @property
    def file_name(self) -> str:
        """What its file is called."""
        return self.name + (".jpg" if self.kind == "jpeg" else ".png")

    @property
    def data_uri(self) -> str:
        """The picture as an address of its own."""
        return f"data:image/{self.kind};base64,{base64.b64encode(self.content).decode()}"


@dataclass(frozen=True, eq=False)
class Stroke:
    """Lines of pixels (x, y) in one colour, `width` pixels broad, on a dark edge of `edge_width`."""

    lines: Sequence[Float[np.ndarray, "n 2"]]
    colour: str
    width: float
    edge_width: float


@dataclass(frozen=True, eq=False)
class DrawnMap:
    """Distances of `cells.poses`, with the words that go with them."""

    title: str
    scale: str
    cells: Cells
    distance: Float[np.ndarray, "n"]


def draw_panorama(
    image: UInt8[np.ndarray, "h w 3"], plan: FloorPlan, camera_height_m: float, truth: Pose, found: Pose | None
) -> Picture:
    """A panorama with the wall-floor and wall-ceiling lines of the true pose's layout, and of the found one's."""
    height, width, _ = image.shape
    # The truth is broader and lies below, so that both show where they agree.
    strokes = [
        Stroke(layout_lines(plan, pose, camera_height_m, height, width), colour, line_width, edge_width)
        for pose, colour, line_width, edge_width in ((truth, TRUE_COLOUR, 5.0, 7.0), (found, FOUND_COLOUR, 2.0, 3.0))
        if pose is not None
    ]
    buffer = io.BytesIO()
    draw_strokes(image, strokes).save(buffer, "JPEG", quality=_JPEG_QUALITY, optimize=True)
    what = "the true layout" if found is None else "the true and the found layout"
    alt = f"Panorama with the outlines of {what} drawn over it"
    return Picture(name="panorama", content=buffer.getvalue(), kind="jpeg", width=width, height=height, alt=alt)


def draw_strokes(image: UInt8[np.ndarray, "h w 3"], strokes: Sequence[Stroke]) -> Image.Image:
    """A picture with lines over it, the last ones on top."""
    height, width, _ = image.shape
    large = Image.fromarray(image).resize((width * _OVERSAMPLING, height * _OVERSAMPLING), Image.Resampling.BICUBIC)
    draw = ImageDraw.Draw(large)
    for stroke in strokes:
        lines = [[tuple(point) for point in line * _OVERSAMPLING] for line in stroke.lines]
        for line_colour, line_width in ((_EDGE, stroke.edge_width), (stroke.colour, stroke.width)):
            for line in lines:
                draw.line(line, fill=line_colour, width=round(line_width * _OVERSAMPLING), joint="curve")
    return large.resize((width, height), Image.Resampling.LANCZOS)


def layout_lines(
    plan: FloorPlan, pose: Pose, camera_height_m: float, height: int, width: int
) -> list[Float[np.ndarray, "{width} 2"]]:
    """Where the floor and the ceiling of a pose's room meet its walls, as pixels (x, y) of its panorama."""
    position_m, heading = np.array([[pose.x_m, pose.y_m]]), np.array([heading_from_degrees(pose.heading_deg)])
    profile = profiles_at(plan, position_m, np.array([pose.room_index]), heading, width)[0]
    over_floor, under_ceiling = camera_height_m, float(plan.ceiling_heights_m[pose.room_index]) - camera_height_m
    return [wall_line(profile, rise_m, height) for rise_m in (-over_floor, under_ceiling)]


def wall_line(profile_m: Float[np.ndarray, "w"], rise_m: float, height: int) -> Float[np.ndarray, "w 2"]:
    """Where the walls of a profile pass a level `rise_m` above the camera, as pixels (x, y) of a panorama."""
    x = np.arange(len(profile_m)) + 0.5
    return np.stack([x, (0.5 - np.arctan2(rise_m, profile_m) / np.pi) * height], axis=1)


def draw_map(plan: FloorPlan, drawn: DrawnMap, truth: Pose, found: Pose | None) -> Picture:
    """A plan with a map of distances, the true position (×) and the found pose (dot and heading)."""
    figure = Figure(figsize=_MAP_INCHES, layout="constrained")
    axes = figure.subplots()
    draw_distances(figure, axes, plan, drawn.cells, drawn.distance, drawn.scale)
    draw_plan(axes, plan)
    axes.set_title(drawn.title, fontsize=10)
    if found is not None:
        heading = heading_from_degrees(found.heading_deg)
        draw_camera(axes, (found.x_m, found.y_m), heading, FOUND_COLOUR, "found", 6.0)
    cross = {"marker": "x", "ls": "", "markersize": 10.0, "mew": 2.5, "color": TRUE_COLOUR}
    axes.plot(truth.x_m, truth.y_m, **cross, label="true", path_effects=halo(4.5), zorder=4.5)
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, 0.0), ncols=2, frameon=False, fontsize=9, handletextpad=0.2)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_MAP_DPI, facecolor="white", pil_kwargs={"optimize": True})
    width, height = (round(inches * _MAP_DPI) for inches in figure.get_size_inches())
    alt = f"Floor plan coloured by {drawn.title}"
    return Picture(
        name=drawn.title.replace(" ", "-"), content=buffer.getvalue(), kind="png", width=width, height=height, alt=alt
    )
