"""Drawing of the probability by place that a photograph is found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from lalaloc_core.conditions import HARDEST, Condition, parts_of
from lalaloc_core.draw.canvas import document, words
from lalaloc_core.draw.heat import Cells, HeatMap, colour_bar, heat_image
from lalaloc_core.draw.plan import plan_part, shape_of
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import RIGHT_WITHIN_M

_WIDTH, _PAD, _HEAD, _FOOT = 1000, 20, 40, 84
_FOUND = {
    "sphere": "a sphere is found",
    "phone": "a phone photograph is found",
    "three_phone": "three phone photographs of one spot are found",
}
# Places whose squared distance (m²) to a cell differs by less than this count about equally.
_SOFT_M2 = 1.0
_TICKS = ((0.0, "0 %"), (0.25, "25 %"), (0.5, "50 %"), (0.75, "75 %"), (1.0, "100 %"))


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
