"""Storeys that are drawn over each other, on layers that differ by the name of a storey: "EG-Wand", "OG-Wand"."""

from __future__ import annotations

import re
from collections import defaultdict
from copy import deepcopy
from dataclasses import replace
from functools import lru_cache

import shapely
from shapely.geometry.base import BaseGeometry

from lalaloc_core.floorplan.room_types import keys_by_word, split_words
from lalaloc_core.importers.common import Budget, ImportOptions, ReportBuilder
from lalaloc_core.importers.common.assemble import ImportedPlan, assemble, assemble_levels
from lalaloc_core.importers.common.sketch import Level
from lalaloc_core.importers.drawing.sketch_drawing import sketch_drawing
from lalaloc_core.importers.drawing.storeys_beside import name_storeys
from lalaloc_core.importers.drawing.vector_drawing import Drawing, Stroke

_STOREYS = keys_by_word("storeys")
_PARTS = re.compile(r"[^\w+]+|_")
# Share of the smaller storey's box that the other covers.
_OVER = 0.5


def by_storey(
    drawing: Drawing, builder: ReportBuilder, options: ImportOptions, budget: Budget, *, flip_y: bool
) -> tuple[ImportedPlan, ...]:
    """Return the plans of the storeys of a vector drawing in its own units; most drawings have one."""
    drawing = drawing.scaled(builder.metres_per_unit, flip_y=flip_y)

    def make(part: Drawing, report: ReportBuilder, level: Level | None) -> ImportedPlan:
        sketch = name_storeys(sketch_drawing(part, report, budget), report, flip_y=flip_y)
        return assemble(replace(sketch, level=level), report, options, budget.limits.plan)

    def make_level(level: Level, part: Drawing) -> ImportedPlan:
        report = deepcopy(builder)
        report.notes.append(f"storey '{level.name}' by the names of layers; layers without a storey belong to all")
        return make(part, report, level)

    storeys = storeys_of(drawing)
    return assemble_levels(storeys, options, budget, make_level) if storeys else (make(drawing, builder, None),)


def storeys_of(drawing: Drawing) -> dict[str, tuple[Level, Drawing]]:
    """Return the parts of a drawing by storey; empty if its walls are of one."""
    walls: defaultdict[float, list[BaseGeometry]] = defaultdict(list)
    others: set[float] = set()
    names: dict[float, str] = {}
    for item in (*drawing.strokes, *drawing.areas):
        storey = _storey(item.layer)
        if storey is not None and item.role == "wall":
            if names.get(storey[1], "0").isdecimal():
                names[storey[1]] = storey[0]
            walls[storey[1]].append(item.line if isinstance(item, Stroke) else item.shape)
        elif storey is not None:
            others.add(storey[1])
    others |= {storey[1] for text in drawing.letterings if (storey := _storey(text.layer)) is not None}
    # Numbers count walls as well as storeys, unless other layers have the same ones.
    named = {number for number in walls if not names[number].isdecimal() or number in others}
    boxes = {number: shapely.box(*shapely.total_bounds(walls[number])) for number in named}
    if len(boxes) < 2 or not all(_is_over(first, second) for first in boxes.values() for second in boxes.values()):
        return {}

    def part(number: float) -> Drawing:
        return drawing.on_layers(lambda layer: (storey := _storey(layer)) is None or storey[1] == number)

    return {names[number]: (Level(names[number], number), part(number)) for number in boxes}


def _is_over(first: shapely.Polygon, second: shapely.Polygon) -> bool:
    return first.intersection(second).area >= _OVER * min(first.area, second.area)


@lru_cache(maxsize=1024)
def _storey(layer: str) -> tuple[str, float] | None:
    """Return the name and number of the storey that the name of a layer has; None without one."""
    parts = list(filter(None, _PARTS.split(layer)))
    for part in parts:
        word = "".join(split_words(part)) if part.isalpha() else part.casefold()
        if word in _STOREYS:
            return part, float(_STOREYS[word])
    numbers = (part for part in parts if part.isdecimal() and len(part) <= 2 and part != layer)
    return next(((part, float(part)) for part in numbers), None)
