"""Drawing floor plans: walls, rooms, poses, and maps of how near each place is to a query by some distance.

As in the paper's figure of layout distances, colours are on a logarithmic scale: what matters is how much nearer the
right place is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float, Int
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.sampling import PoseSet

INK = "#20242c"
# Outer walls.
WALL_M = 0.12
# Gaps between rooms up to twice this are wall.
_SOLID_M = 0.7
# Colours reach this far under the walls, which are drawn over them.
_UNDER_WALLS_M = 0.03
_ARROW_M = 0.9
_CMAP = "viridis_r"


@dataclass(frozen=True, eq=False)
class Cells:
    """A plan cut into square cells.

    Attributes:
        poses: the middles of the cells that lie in rooms.
        room: the room of each cell, -1 outside, rows from below.
        extent_m: (left, right, bottom, top) of all cells.
    """

    poses: PoseSet
    room: Int[np.ndarray, "rows columns"]
    extent_m: tuple[float, float, float, float]

    @classmethod
    def of(cls, plan: FloorPlan, size_m: float) -> Cells:
        """Cut a plan."""
        x_min, y_min, x_max, y_max = plan.bounds_m
        # One empty cell all around, for the edges to grow into.
        xs = np.arange(x_min - 0.5 * size_m, x_max + size_m, size_m)
        ys = np.arange(y_min - 0.5 * size_m, y_max + size_m, size_m)
        x, y = np.meshgrid(xs, ys)
        position_m = np.stack([x.ravel(), y.ravel()], axis=1)
        room = plan.room_index_at(position_m)
        half = 0.5 * size_m
        extent_m = (float(xs[0] - half), float(xs[-1] + half), float(ys[0] - half), float(ys[-1] + half))
        return cls(PoseSet(position_m[room >= 0], room[room >= 0]), room.reshape(x.shape), extent_m)

    def in_room(self, room_index: int, values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "rows columns"]:
        """Values of `poses` in one room in their places; the room's edges grown by one cell, NaN farther outside."""
        spread = np.full(self.room.shape, np.nan)
        spread[self.room >= 0] = values
        spread[self.room != room_index] = np.nan
        for shift in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            spread = np.where(np.isnan(spread), np.roll(spread, shift, axis=(0, 1)), spread)
        return spread


def draw_plan(axes: Axes, plan: FloorPlan) -> None:
    """Walls and the names of the rooms."""
    walls = shapely.difference(_solid(plan), shapely.union_all([room.shape for room in plan.rooms]))
    axes.add_patch(PathPatch(_outline(walls), facecolor=INK, edgecolor="none", zorder=2))
    for room in plan.rooms:
        x, y = _label_place(room.shape)
        # Names may hold dollar signs.
        style = {"ha": "center", "va": "center", "fontsize": 7, "color": "white", "alpha": 0.85, "parse_math": False}
        axes.text(x, y, room.name, **style, zorder=2)
    x_min, y_min, x_max, y_max = plan.bounds_m
    axes.set_xlim(x_min - 2 * WALL_M, x_max + 2 * WALL_M)
    axes.set_ylim(y_min - 2 * WALL_M, y_max + 2 * WALL_M)
    axes.set_aspect("equal")
    axes.set_axis_off()


def draw_distances(
    figure: Figure, axes: Axes, plan: FloorPlan, cells: Cells, distance: Float[np.ndarray, "n"], label: str
) -> None:
    """Cells coloured by the distance of their poses, with a bar that tells which colour is how much."""
    low, high = max(float(distance.min()), 1e-3), float(distance.max())
    look = {"extent": cells.extent_m, "origin": "lower", "cmap": _CMAP, "norm": LogNorm(low, max(high, 1.001 * low))}
    for index, room in enumerate(plan.rooms):
        # Every room is clipped by itself: a cell in a thin wall would else show the colours of the room beyond.
        image = axes.imshow(cells.in_room(index, distance), **look)
        image.set_clip_path(_outline(room.shape.buffer(_UNDER_WALLS_M, join_style="mitre")), axes.transData)
    bar = figure.colorbar(ScalarMappable(look["norm"], _CMAP), ax=axes, shrink=0.85, pad=0.02, format="%.2g")
    bar.ax.minorticks_off()
    bar.set_ticks(list(np.geomspace(low, high, 4)))
    bar.set_label(label, fontsize=9)
    bar.ax.tick_params(labelsize=8)


def draw_camera(
    axes: Axes, position_m: tuple[float, float], heading: float, colour: str, label: str, size: float
) -> None:
    """A dot, and a line along the heading (radians)."""
    x, y = position_m
    line = ([x, x + _ARROW_M * math.sin(heading)], [y, y + _ARROW_M * math.cos(heading)])
    axes.plot(*line, color=colour, lw=0.4 * size, path_effects=halo(0.4 * size + 1.8), zorder=4)
    axes.plot(x, y, "o", color=colour, markersize=size, mec=INK, mew=1.0, label=label, zorder=5, ls="")


def halo(width: float) -> list[patheffects.AbstractPathEffect]:
    """A dark edge, so that what is drawn stands out from any colour."""
    return [patheffects.withStroke(linewidth=width, foreground=INK)]


def _label_place(shape: shapely.Polygon) -> tuple[float, float]:
    """The middle of a room, where that lies well inside, else the middle of the largest circle in it."""
    if shape.buffer(-0.3).contains(shape.centroid):
        return shape.centroid.x, shape.centroid.y
    (x, y), _ = shapely.maximum_inscribed_circle(shape, tolerance=0.05).coords
    return x, y


def _solid(plan: FloorPlan) -> shapely.Geometry:
    """Rooms and walls in one: the rooms grown, then shrunk by less. Gaps, shafts and chimneys close."""
    rooms = shapely.union_all([room.shape for room in plan.rooms])
    return rooms.buffer(_SOLID_M, join_style="mitre").buffer(WALL_M - _SOLID_M, join_style="mitre")


def _outline(shape: shapely.Geometry) -> Outline:
    """A shape of polygons, with holes or without, as matplotlib wants it."""
    rings = [ring for part in shapely.get_parts(shape) for ring in (part.exterior, *part.interiors)]
    return Outline.make_compound_path(*(Outline(np.asarray(ring.coords), closed=True) for ring in rings))
