"""Draw the demo's picture: per panorama the photograph, and the plan with a heat map of latent distances.

The heat map needs the distance of every pose of the plan, which the service does not send; it is computed here with
the same networks. Colours are on a logarithmic scale: what matters is how much nearer the right place is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from PIL import Image

from examples.truth import FOLDER, TruePose
from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import heading_from_degrees
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.images import read_panorama
from lalaloc_core.localise.retrieval import latent_distances
from lalaloc_core.sampling import PoseSet
from service.settings import Settings

_CELL_M = 0.1
# Outer walls; at least a cell, as they cover the ragged edge of the cells.
_WALL_M = 0.12
# Gaps between rooms up to twice this are wall.
_SOLID_M = 0.7
_ARROW_M = 0.9
_PANEL_INCHES = (12.6, 4.3)
_DPI = 110
_INK, _TRUE, _FOUND = "#20242c", "#ffffff", "#ff3b30"
_CMAP = "viridis_r"


@dataclass(frozen=True)
class Panel:
    """One panorama: the truth, and the service's answers with and without its heading."""

    truth: TruePose
    known: dict[str, Any]
    unknown: dict[str, Any]


@dataclass(frozen=True, eq=False)
class HeatMap:
    """Latent distance of the panorama to the layout at the middle of each cell; NaN outside the rooms."""

    distance: Float[np.ndarray, "rows columns"]
    extent_m: tuple[float, float, float, float]


def draw_demo(panels: Sequence[Panel], path: Path) -> None:
    """Draw all panels below one another."""
    encoders = Encoders(Bundle.open(Settings.load().bundle))
    width, height = _PANEL_INCHES
    figure = Figure(figsize=(width, height * len(panels)), layout="constrained")
    rows = figure.subplots(len(panels), 2, width_ratios=(1.75, 1.0), squeeze=False)
    for panel, (photograph, drawing) in zip(panels, rows, strict=True):
        plan = FloorPlan.from_json((FOLDER / panel.truth.plan).read_bytes())
        _draw_photograph(photograph, panel)
        _draw_plan(figure, drawing, plan, heat_map(plan, encoders, panel.truth), panel)
    figure.savefig(path, dpi=_DPI, facecolor="white")


def heat_map(plan: FloorPlan, encoders: Encoders, truth: TruePose) -> HeatMap:
    """How far the panorama's latent is from that of every place in the plan, its heading given."""
    x_min, y_min, x_max, y_max = plan.bounds_m
    # One empty cell all around, for the edges to grow into.
    xs, ys = (
        np.arange(x_min - 0.5 * _CELL_M, x_max + _CELL_M, _CELL_M),
        np.arange(y_min - 0.5 * _CELL_M, y_max + _CELL_M, _CELL_M),
    )
    x, y = np.meshgrid(xs, ys)
    position = np.stack([x.ravel(), y.ravel()], axis=1)
    room = plan.room_index_at(position)
    poses = PoseSet(position[room >= 0], room[room >= 0])

    manifest = encoders.manifest
    panorama = read_panorama(truth.picture.read_bytes(), height=manifest.image_height, width=manifest.image_width)
    query = encoders.query(panorama, heading_from_degrees(truth.heading_deg), truth.camera_height_m)
    latents = encoders.poses(plan, poses, np.full(len(poses), query.frame_heading), truth.camera_height_m)

    distance = np.full(len(position), np.nan)
    distance[room >= 0] = latent_distances(latents, query.latents)[0]
    half = 0.5 * _CELL_M
    extent = (float(xs[0] - half), float(xs[-1] + half), float(ys[0] - half), float(ys[-1] + half))
    return HeatMap(_grown(distance.reshape(x.shape)), extent)


def _grown(distance: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """The map with its edges one cell further out, under the walls, where cells are only partly in a room."""
    for shift in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        distance = np.where(np.isnan(distance), np.roll(distance, shift, axis=(0, 1)), distance)
    return distance


def _draw_photograph(axes: Axes, panel: Panel) -> None:
    with Image.open(panel.truth.picture) as picture:
        axes.imshow(np.asarray(picture.convert("RGB")))
    axes.set(xticks=[], yticks=[], frame_on=False, anchor="NW")
    axes.set_title(panel.truth.file, loc="left", fontsize=12, fontweight="bold", color=_INK)
    sentences = [_sentence("heading given", panel.truth, panel.known)]
    sentences.append(_sentence("heading not given", panel.truth, panel.unknown))
    # A label, not free text: the layout makes room for it.
    axes.set_xlabel("\n".join(sentences), loc="left", fontsize=10, color=_INK, linespacing=1.5)


def _sentence(label: str, truth: TruePose, answer: dict[str, Any]) -> str:
    x_m, y_m = answer["position"]["x_m"], answer["position"]["y_m"]
    error_m = math.hypot(x_m - truth.x_m, y_m - truth.y_m)
    turned = (answer["heading_deg"] - truth.heading_deg + 180.0) % 360.0 - 180.0
    confidence = "" if answer["confidence"] is None else f", confidence {answer['confidence']:.2f}"
    return f"{label}: {answer['room']} ({x_m:.2f}, {y_m:.2f}) m, off by {error_m:.2f} m and {turned:+.1f}°{confidence}"


def _draw_plan(figure: Figure, axes: Axes, plan: FloorPlan, heat: HeatMap, panel: Panel) -> None:
    low, high = max(float(np.nanmin(heat.distance)), 1e-3), float(np.nanmax(heat.distance))
    image = axes.imshow(heat.distance, extent=heat.extent_m, origin="lower", cmap=_CMAP, norm=LogNorm(low, high))
    image.set_clip_path(_outline(_solid(plan)), axes.transData)
    _draw_walls(axes, plan)
    _draw_room_names(axes, plan)
    for rank, candidate in enumerate(panel.known["candidates"][1:], start=2):
        _draw_candidate(axes, candidate, rank)
    truth, found = panel.truth, panel.known
    _draw_camera(axes, (truth.x_m, truth.y_m), truth.heading_deg, _TRUE, "true", 9.0)
    position = (found["position"]["x_m"], found["position"]["y_m"])
    _draw_camera(axes, position, found["heading_deg"], _FOUND, "found", 4.5)
    x_min, y_min, x_max, y_max = plan.bounds_m
    axes.set_xlim(x_min - 2 * _WALL_M, x_max + 2 * _WALL_M)
    axes.set_ylim(y_min - 2 * _WALL_M, y_max + 2 * _WALL_M)
    axes.set_axis_off()
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, 0.01), ncols=3, frameon=False, fontsize=9, handletextpad=0.3)
    bar = figure.colorbar(image, ax=axes, shrink=0.85, pad=0.02, format="%.2g")
    bar.ax.minorticks_off()
    bar.set_ticks(list(np.geomspace(low, high, 4)))
    bar.set_label("latent distance (log scale)", fontsize=9)
    bar.ax.tick_params(labelsize=8)


def _solid(plan: FloorPlan) -> shapely.Geometry:
    """Rooms and walls in one: the rooms grown, then shrunk by less. Gaps, shafts and chimneys close."""
    rooms = shapely.union_all([room.shape for room in plan.rooms])
    return rooms.buffer(_SOLID_M, join_style="mitre").buffer(_WALL_M - _SOLID_M, join_style="mitre")


def _draw_walls(axes: Axes, plan: FloorPlan) -> None:
    walls = shapely.difference(_solid(plan), shapely.union_all([room.shape for room in plan.rooms]))
    axes.add_patch(PathPatch(_outline(walls), facecolor=_INK, edgecolor="none", zorder=2))


def _outline(shape: shapely.Geometry) -> Outline:
    """A shape of polygons, with holes or without, as matplotlib wants it."""
    rings = [ring for part in shapely.get_parts(shape) for ring in (part.exterior, *part.interiors)]
    return Outline.make_compound_path(*(Outline(np.asarray(ring.coords), closed=True) for ring in rings))


def _draw_room_names(axes: Axes, plan: FloorPlan) -> None:
    for room in plan.rooms:
        (x, y), _ = shapely.maximum_inscribed_circle(room.shape, tolerance=0.05).coords
        axes.text(x, y, room.name, ha="center", va="center", fontsize=7, color="white", alpha=0.85, zorder=2)


def _draw_camera(
    axes: Axes, position_m: tuple[float, float], heading_deg: float, colour: str, label: str, size: float
) -> None:
    """A dot, and a line along the heading."""
    heading = math.radians(heading_deg)
    x, y = position_m
    line = ([x, x + _ARROW_M * math.sin(heading)], [y, y + _ARROW_M * math.cos(heading)])
    axes.plot(*line, color=colour, lw=0.4 * size, path_effects=_halo(0.4 * size + 1.8), zorder=4)
    axes.plot(x, y, "o", color=colour, markersize=size, mec=_INK, mew=1.0, label=label, zorder=5, ls="")


def _draw_candidate(axes: Axes, candidate: dict[str, Any], rank: int) -> None:
    x, y = candidate["position"]["x_m"], candidate["position"]["y_m"]
    label = "other candidates" if rank == 2 else None
    ring = {"mfc": "none", "mec": "white", "markersize": 11, "mew": 1.0}
    axes.plot(x, y, "o", ls="", path_effects=_halo(2.5), zorder=3, label=label, **ring)
    axes.text(x, y, str(rank), ha="center", va="center", fontsize=7.5, color="white", path_effects=_halo(2.0), zorder=3)


def _halo(width: float) -> list[patheffects.AbstractPathEffect]:
    """A dark edge, so that what is drawn stands out from any colour."""
    return [patheffects.withStroke(linewidth=width, foreground=_INK)]
