"""Drawing of the probability by place that a photograph is found."""

from __future__ import annotations

import numpy as np

from lalaloc_core.draw.canvas import document, words
from lalaloc_core.draw.heat import Cells, HeatMap, colour_bar, heat_image
from lalaloc_core.draw.plan import plan_part, shape_of
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.localisability import HARDEST, Localisability

_WIDTH, _PAD, _HEAD, _FOOT = 1000, 20, 40, 84
_TITLE = "Probability that a phone photograph is found within 1 m, heading unknown"
# Places whose squared distance (m²) to a cell differs by less than this count about equally.
_SOFT_M2 = 1.0
_TICKS = ((0.0, "0 %"), (0.25, "25 %"), (0.5, "50 %"), (0.75, "75 %"), (1.0, "100 %"))


def localisability_svg(plan: FloorPlan, found: Localisability) -> str:
    """Draw the plan with the probability of the condition that needs help most; darker is more probable."""
    heat = HeatMap(cells := Cells.cover(plan), _shades(cells, found), _TITLE, _TICKS)
    height = _HEAD + round(_WIDTH / shape_of(plan)) + _FOOT
    box = (_PAD, _HEAD, _WIDTH - 2 * _PAD, height - _HEAD - _FOOT)
    parts = [
        words(0.5 * _WIDTH, 26, plan.name, 18, anchor="middle"),
        plan_part(plan, box, "", heat=heat_image(heat, plan)),
        colour_bar(heat, _PAD, height - _FOOT + 12, 0.7 * _WIDTH),
    ]
    return document(_WIDTH, height, _TITLE, parts)


def _shades(cells: Cells, found: Localisability) -> np.ndarray:
    """Return the probability of every cell: the mean of its room's places by distance, of all without any."""
    places, value = found.places, found.found[HARDEST]
    shade = np.full(len(cells.poses), found.plan[HARDEST])
    for room in np.unique(places.room_index):
        own, inside = places.room_index == room, cells.poses.room_index == room
        offset_m = cells.poses.position_m[inside, None] - places.position_m[None, own]
        weight = 1.0 / np.square(np.square(offset_m).sum(axis=2) + _SOFT_M2)
        shade[inside] = weight @ value[own] / weight.sum(axis=1)
    return shade
