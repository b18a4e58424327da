"""Heat maps over a plan: probabilities (of poses, or to be found) or latent distances, in a colour-blind safe scale.

Darker is more probable or closer. Scales are logarithmic, as in the paper's figure of layout distances.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from lalaloc_core.conditions import HARDEST, Condition, parts_of
from lalaloc_core.draw.canvas import MUTED, RULE, Number, document, image, png, words, xml_text
from lalaloc_core.draw.plan import floor_path, plan_part, shape_of
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import RIGHT_WITHIN_M, ProbabilityMap
from lalaloc_core.render.sampling import PoseSet

# ColorBrewer's YlGnBu: safe for colour-blind readers, and monotonic in grey.
_COLOURS = ["#ffffe5", "#f7fcb9", "#d9f0a3", "#a6dba0", "#5cc2b0", "#2fa4c0", "#2a7ab9", "#27509b", "#132a6b"]
# Number of cells along the longer side of a plan, and the smallest cell.
_CELLS, _MIN_CELL_M = 220, 0.04
# Probabilities are smoothed by a normal distribution: its deviation in grid steps, and its reach in deviations.
_SPREAD, _REACH = 0.4, 5.0
# Fast bilinear interpolation in resvg; browsers interpolate by default.
_SMOOTH = 'image-rendering="smooth"'
# Positions less probable than the best one by more than 10^_DECADES have the lightest colour.
_DECADES = 5
_WIDTH, _PAD, _HEAD, _FOOT = 1000, 20, 40, 84
_FOUND = {
    "sphere": "a sphere is found",
    "phone": "a phone photograph is found",
    "three_phone": "three phone photographs of one spot are found",
}
# Places whose squared distance (m²) to a cell differs by less than this count about equally.
_SOFT_M2 = 1.0
_TICKS = ((0.0, "0 %"), (0.25, "25 %"), (0.5, "50 %"), (0.75, "75 %"), (1.0, "100 %"))


@dataclass(frozen=True, eq=False)
class Cells:
    """Square cells over a plan.

    `poses` are the centres of the cells that lie in rooms; `room` is that of each cell, -1 outside, lowest row first;
    `extent_m` is (left, right, bottom, top).
    """

    poses: PoseSet
    room: Int[np.ndarray, "rows columns"]
    extent_m: tuple[float, float, float, float]

    @classmethod
    def cover(cls, plan: FloorPlan, size_m: float | None = None) -> Cells:
        """Cover a plan with cells; the default size suits a drawing."""
        x_min, y_min, x_max, y_max = plan.bounds_m
        size_m = size_m or max(max(x_max - x_min, y_max - y_min) / _CELLS, _MIN_CELL_M)
        # One empty cell on each side, which `spread` fills.
        xs = np.arange(x_min - 0.5 * size_m, x_max + size_m, size_m)
        ys = np.arange(y_min - 0.5 * size_m, y_max + size_m, size_m)
        x, y = np.meshgrid(xs, ys)
        position_m = np.stack([x.ravel(), y.ravel()], axis=1)
        room = plan.room_index_at(position_m)
        half = 0.5 * size_m
        extent_m = (float(xs[0] - half), float(xs[-1] + half), float(ys[0] - half), float(ys[-1] + half))
        return cls(PoseSet(position_m[room >= 0], room[room >= 0]), room.reshape(x.shape), extent_m)

    def spread(self, values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "rows columns"]:
        """Arrange values of `poses` as a table, extended by one cell outside rooms; NaN farther outside."""
        table = np.full(self.room.shape, np.nan)
        table[self.room >= 0] = values
        return _extended(table)


@dataclass(frozen=True, eq=False)
class HeatMap:
    """Shades (0 lightest, 1) of `cells.poses`, with title and ticks of the colour bar."""

    cells: Cells
    shade: Float[np.ndarray, "n"]
    title: str
    ticks: tuple[tuple[float, str], ...]


def posterior_map(plan: FloorPlan, places: ProbabilityMap, step_m: float) -> HeatMap:
    """Return a map of probabilities relative to the most probable position.

    Each position represents a part of its room as wide as the pose grid's step.
    """
    # Loading it takes as long as a query.
    from scipy.ndimage import find_objects, gaussian_filter

    cells = Cells.cover(plan)
    left, _, bottom, _ = cells.extent_m
    size_m = (cells.extent_m[1] - left) / cells.room.shape[1]
    # In cells, from the centre of the first one.
    x, y = ((places.position_m - [left, bottom]) / size_m - 0.5).T
    density = np.zeros(cells.room.shape)
    boxes = find_objects(cells.room + 1)
    for room in np.unique(places.room_index):
        box, own = boxes[room] if room < len(boxes) else None, places.room_index == room
        # A room smaller than a cell has no box.
        if box is None:
            continue
        inside = cells.room[box] == room
        spread = _splatted(x[own] - box[1].start, y[own] - box[0].start, places.probability[own], inside.shape)
        # Smoothing must not cross walls.
        smooth = gaussian_filter(spread, _SPREAD * step_m / size_m, mode="constant", truncate=_REACH)
        density[box][inside] = smooth[inside]
    known = density[cells.room >= 0]
    with np.errstate(divide="ignore"):
        shade = np.maximum(1.0 + np.log10(known / max(float(known.max()), np.finfo(float).tiny)) / _DECADES, 0.0)
    exponents = "⁰¹²³⁴⁵"
    ticks = [(1.0, "1"), *((1.0 - k / _DECADES, f"10⁻{exponents[k]}") for k in range(1, _DECADES + 1))]
    return HeatMap(cells, shade, "probability relative to the best position", tuple(ticks))


def heat_image(heat: HeatMap, plan: FloorPlan) -> str:
    """Draw the map in metres, y pointing down, clipped to the plan's floor."""
    colours = np.full((*heat.cells.room.shape, 4), 0, np.uint8)
    shades = heat.cells.spread(np.clip(heat.shade, 0.0, 1.0))
    known = ~np.isnan(shades)
    colours[known, :3] = _colours_of(shades[known])
    colours[known, 3] = 255
    left, right, bottom, top = heat.cells.extent_m
    box = (left, -top, right - left, top - bottom)
    return (
        f'<clipPath id="lalaloc-floor"><path d="{floor_path(plan)}" clip-rule="evenodd"/></clipPath>'
        f'<g clip-path="url(#lalaloc-floor)">{image(png(colours[::-1]), "png", box, _SMOOTH)}</g>'
    )


def colour_bar(heat: HeatMap, x: Number, y: Number, width: Number) -> str:
    """Draw the colour bar with title and ticks, about 62 pixels high; `y` is its upper edge."""
    stops = "".join(
        f'<stop offset="{index / (len(_COLOURS) - 1):.4f}" stop-color="{colour}"/>'
        for index, colour in enumerate(_COLOURS)
    )
    parts = [
        f'<linearGradient id="lalaloc-scale">{stops}</linearGradient>',
        words(x, y + 14, heat.title, 15, fill=MUTED),
        f'<rect x="{x:.1f}" y="{y + 24:.1f}" width="{width:.1f}" height="14" fill="url(#lalaloc-scale)" '
        f'stroke="{RULE}"/>',
    ]
    for shade, label in heat.ticks:
        place = x + shade * width
        anchor = "start" if shade < 0.05 else "end" if shade > 0.95 else "middle"
        parts.append(
            f'<path d="M{place:.1f} {y + 38:.1f}v5" stroke="{MUTED}"/>'
            f'<text x="{place:.1f}" y="{y + 58:.1f}" font-size="14" fill="{MUTED}" text-anchor="{anchor}">'
            f"{xml_text(label)}</text>"
        )
    return "".join(parts)


def _colours_of(shade: Float[np.ndarray, "n"]) -> UInt8[np.ndarray, "n 3"]:
    anchors = np.array([[int(colour[k : k + 2], 16) for k in (1, 3, 5)] for colour in _COLOURS], float)
    place = np.linspace(0.0, 1.0, len(anchors))
    return np.stack([np.interp(shade, place, anchors[:, k]) for k in range(3)], axis=1).round().astype(np.uint8)


def _splatted(
    x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"], value: Float[np.ndarray, "n"], shape: tuple[int, int]
) -> Float[np.ndarray, "rows columns"]:
    """Distribute each value bilinearly among the four cells around its position."""
    spread = np.zeros(shape)
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    to_right, up = x - column, y - row
    for rows, columns, share in (
        (row, column, (1.0 - up) * (1.0 - to_right)),
        (row, column + 1, (1.0 - up) * to_right),
        (row + 1, column, up * (1.0 - to_right)),
        (row + 1, column + 1, up * to_right),
    ):
        np.add.at(spread, (np.clip(rows, 0, shape[0] - 1), np.clip(columns, 0, shape[1] - 1)), share * value)
    return spread


def _extended(table: Float[np.ndarray, "r c"]) -> Float[np.ndarray, "r c"]:
    """Replace each NaN by the mean of its known neighbours."""
    padded = np.pad(table, 1, constant_values=np.nan)
    neighbours = np.stack([padded[1:-1, :-2], padded[1:-1, 2:], padded[:-2, 1:-1], padded[2:, 1:-1]])
    known = ~np.isnan(neighbours)
    count = known.sum(axis=0)
    mean = np.where(count > 0, np.where(known, neighbours, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)
    return np.where(np.isnan(table), mean, table)


def localisability_svg(plan: FloorPlan, report: Mapping[str, Any], condition: Condition = HARDEST) -> str:
    """Draw the plan with the probability of a condition, from the report on the plan; darker is more probable."""
    photograph, heading = parts_of(condition)
    within_m = max(RIGHT_WITHIN_M, report["spacing_m"])
    title = f"Probability that {_FOUND[photograph]} within {within_m:g} m, heading {heading}"
    heat = HeatMap(cells := Cells.cover(plan), _shades(plan, cells, report, condition), title, _TICKS)
    height = _HEAD + round(_WIDTH / shape_of(plan)) + _FOOT
    box = (_PAD, _HEAD, _WIDTH - 2 * _PAD, height - _HEAD - _FOOT)
    parts = [
        words(0.5 * _WIDTH, 26, plan.name, 18, anchor="middle"),
        plan_part(plan, box, "", heat=heat_image(heat, plan)),
        colour_bar(heat, _PAD, height - _FOOT + 12, 0.7 * _WIDTH),
    ]
    return document(_WIDTH, height, title, parts)


def _shades(plan: FloorPlan, cells: Cells, report: Mapping[str, Any], condition: Condition) -> Float[np.ndarray, "n"]:
    """Return the probability of every cell: the mean of its room's places by distance, of all without any."""
    number = {room.id: index for index, room in enumerate(plan.rooms)}
    position_m = np.array([(place["x_m"], place["y_m"]) for place in report["places"]])
    value = np.array([place["probability"][condition] for place in report["places"]])
    room_index = np.array([number[place["room"]] for place in report["places"]])
    shade = np.full(len(cells.poses), report["probability"][condition])
    for room in np.unique(room_index):
        own, inside = room_index == room, cells.poses.room_index == room
        offset_m = cells.poses.position_m[inside, None] - position_m[None, own]
        weight = 1.0 / np.square(np.square(offset_m).sum(axis=2) + _SOFT_M2)
        shade[inside] = weight @ value[own] / weight.sum(axis=1)
    return shade
