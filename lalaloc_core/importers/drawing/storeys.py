"""Storeys of one drawing: beside each other, with their titles, or over each other, on layers that differ by name.

A picture, a page or a drawing has storeys side by side. Layers of storeys are named such as "EG-Wand" and "OG-Wand".
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import lru_cache
from itertools import combinations

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from lalaloc_core.floorplan.plan_words import Role
from lalaloc_core.floorplan.room_types import PLAN_WORDS, keys_by_word, split_words
from lalaloc_core.importers.common import Budget, ImportOptions, ReportBuilder
from lalaloc_core.importers.common.assemble import ImportedPlan, assemble, assemble_levels
from lalaloc_core.importers.common.geometry import extent_of, lines_of, polygons_of, segments_of
from lalaloc_core.importers.common.sketch import Level, Sketch, T
from lalaloc_core.importers.drawing.sketch_drawing import sketch_drawing
from lalaloc_core.importers.drawing.vector_drawing import Drawing, Lettering, joined, line_of

Box = tuple[float, float, float, float]
# Rooms farther apart (m) are of different storeys; in pictures, also those that no wall joins within the second.
_APART_M, _JOINED_M = 1.0, 0.2
# Least share of the largest storey, and least area (m²); smaller parts are outbuildings of the nearest storey.
_SHARE, _MIN_M2 = 0.3, 12.0
# Margin (m) around the rooms of a storey, for its walls and leaves outside; most storeys that a warning names.
_MARGIN_M, _MAX_NAMED = (0.5, 1.4), 6
_STOREYS = keys_by_word("storeys")
_BESIDE, _ARTICLES, _COUNTED, _JOINED = (
    frozenset(PLAN_WORDS["levels"][key].split()) for key in ("beside", "articles", "counted", "joined")
)
_WORDS = re.compile(r"[^\W_]+")
# A word of the name of a layer with a number before or after it: "2.OG", "4OG", "Level -1".
_NUMBERED = re.compile(
    r"(?<![^\W_])(?:([12]\d(?=\.|[^\W\d_])|[1-9])[. _-]{0,2})?((?:[^\W\d_]|\+)+)"
    r"(?:(?=([ ._-]?)((?:(?<=[ ._])-)?[0-2]?\d)(?![^\W_]))|(?![^\W_]))"
)
# A number of a storey with a word of another script.
_OTHER_SCRIPTS = re.compile(r"(\d{1,2}) ?(?:[階层層]|этаж)", re.IGNORECASE)
# Height of a storey: "Muro +3.00".
_HEIGHT = re.compile(r"(?:[+±]|(?<![^\s_])-)\d{1,3}[.,]\d{2}(?!\d)")
# Least height (m) of a storey.
_CEILING_M = 2.0
# Parts of names of layers, and share of a smaller storey's box that one covers.
_PARTS, _OVER = re.compile(r"[^\w+]+|_"), 0.5
# Lines nearer than this (m) are the same. Share of an outline that storeys over each other both run along, and of the
# lines of each that the other lacks; layers that are compared.
_SAME_LINE_M, _MOSTLY_ALONG, _OWN, _MOST_COMPARED = 0.05, 0.5, 0.02, 8


def assemble_storeys(
    sketch: Sketch,
    letterings: Sequence[Lettering],
    builder: ReportBuilder,
    options: ImportOptions,
    budget: Budget,
    in_file: Callable[[Box], Box],
) -> tuple[ImportedPlan, ...]:
    """Return a plan of each storey that is drawn beside others, the lowest first by their titles; most files have one.

    `letterings` are in metres. `in_file` converts a box in metres (left, lowest, right, highest) to the file's
    coordinates.
    """
    storeys = storeys_beside(sketch)
    if len(storeys) < 2:
        if options.level is not None:
            builder.warnings.append("the option 'level' was ignored: one storey was found; set crop to read a part")
        return (assemble(sketch, builder, options, budget.limits.plan),)
    levels = _levels(storeys, letterings)
    builder.levels = tuple(level.name for level in levels)
    named = _in_words(storeys, in_file, levels)

    def make(level: Level, part: tuple[Sketch, list[shapely.Polygon], list[str]]) -> ImportedPlan:
        own, no_room, said = part
        report = replace(deepcopy(builder), no_room=no_room)
        others = builder.places.keys() - set(said)
        for lines in (report.warnings, report.unsure, report.rejected_texts):
            lines[:] = [line for line in lines if line not in others]
        report.warnings.append(
            f"{named}; this plan is '{level.name}': choose another with level or crop, or import all levels as a venue"
        )
        return assemble(replace(own, level=level), report, options, budget.limits.plan)

    parts = zip(levels, _parts(sketch, builder, storeys), strict=True)
    return assemble_levels({level.name: (level, part) for level, part in parts}, options, budget, make)


def storeys_beside(sketch: Sketch) -> list[BaseGeometry]:
    """Return the rooms of each storey, the largest storey first.

    A storey's rooms are joined by their nearness or, if the sketch has them, by walls.
    """
    rooms = [room.shape for room in sketch.rooms]
    if len(rooms) < 2:
        return [shapely.union_all(rooms)]
    reach_m = 0.5 * (_APART_M if sketch.walls is None else _JOINED_M)
    drawn = [*rooms, *([] if sketch.walls is None else [sketch.walls])]
    parts = polygons_of(shapely.union_all(shapely.buffer(drawn, reach_m)))
    # Walls can be thousands of parts without a room, such as letters.
    room, part = shapely.STRtree(parts).query(rooms, predicate="intersects")
    areas = np.bincount(part, shapely.area(rooms)[room], minlength=len(parts))
    main = [parts[index] for index in np.flatnonzero(areas >= max(_SHARE * areas.max(initial=0.0), _MIN_M2))]
    if len(main) < 2:
        return [shapely.union_all(rooms)]
    storeys = map(shapely.union_all, _by_nearest(rooms, rooms, main))
    return sorted(storeys, key=lambda storey: -storey.area)


def _parts(
    sketch: Sketch, builder: ReportBuilder, storeys: Sequence[BaseGeometry]
) -> list[tuple[Sketch, list[shapely.Polygon], list[str]]]:
    """Return each storey's part of a sketch, of the areas that became no room, and of the lines about a place."""
    rooms = _by_nearest(sketch.rooms, [room.shape for room in sketch.rooms], storeys)
    openings = _by_nearest(sketch.openings, [opening.line for opening in sketch.openings], storeys)
    fixtures = _by_nearest(sketch.fixtures, [fixture.shape for fixture in sketch.fixtures], storeys)
    lost = _by_nearest(builder.no_room, builder.no_room, storeys)
    said = _by_nearest(list(builder.places), list(builder.places.values()), storeys)
    return [
        (
            replace(sketch, rooms=rooms[index], openings=openings[index], fixtures=fixtures[index]),
            lost[index],
            said[index],
        )
        for index in range(len(storeys))
    ]


def _by_nearest(items: Sequence[T], shapes: Sequence[BaseGeometry], storeys: Sequence[BaseGeometry]) -> list[list[T]]:
    """Return the items whose shape is nearest to each storey."""
    found: list[list[T]] = [[] for _ in storeys]
    tree = shapely.STRtree(storeys)
    for item, shape in zip(items, shapes, strict=True):
        found[int(tree.nearest(shape))].append(item)
    return found


def _levels(storeys: Sequence[BaseGeometry], letterings: Sequence[Lettering]) -> list[Level]:
    """Return the level of each storey by the title that is nearest to it; others are numbered as they are drawn."""
    # Inside of a room it is the room's name.
    rooms = shapely.union_all(storeys)
    written = [(title_of(text.text), shapely.Point(text.position)) for text in letterings]
    titles = [(title, place) for title, place in written if title is not None and not rooms.covers(place)]
    near = sorted(
        (storey.distance(place), index, number)
        for index, storey in enumerate(storeys)
        for number, (_, place) in enumerate(titles)
    )
    level_of: dict[int, Level] = {}
    taken = set[int]()
    for distance_m, index, number in near:
        if index not in level_of and number not in taken and distance_m <= extent_of([storeys[index]]):
            level_of[index] = titles[number][0]
            taken.add(number)
    drawn = _reading_order(storeys)
    named = [level_of.get(index, Level(f"Storey {drawn.index(index) + 1}")) for index in range(len(storeys))]
    counts = [sum(level.name == other.name for other in named[:index]) for index, level in enumerate(named)]
    return [
        replace(level, name=f"{level.name} ({count + 1})") if count else level
        for level, count in zip(named, counts, strict=True)
    ]


def title_of(text: str) -> Level | None:
    """Return the level that a text is the title of, such as "FIRST FLOOR", "2. Obergeschoss" or "Level 2"."""
    words = ["".join(split_words(word)) if word.isalpha() else word.casefold() for word in _WORDS.findall(text)]
    known = [float(_STOREYS[word]) for word in words if word in _STOREYS]
    digits = [float(word) for word in words if word.isdecimal() and len(word) == 1]
    is_title = len(known) + len(digits) + sum(word in _BESIDE | _ARTICLES for word in words) >= len(words)
    if not is_title or not (known or (digits and len(words) > 1)) or len(digits) > 1:
        return None
    return Level(" ".join(text.split()), _counted(known[0] if known else None, *digits))


def _counted(number: float | None, digit: float = 0.0) -> float:
    """Return the number of a storey that a digit counts: "1. UG" is -1, and "1. DG" lies over "DG"."""
    if not number or not digit:
        return digit if number is None else number
    return math.copysign(digit, number) if abs(number) == 1.0 else number + 0.1 * digit


def _reading_order(storeys: Sequence[BaseGeometry]) -> list[int]:
    """Return the numbers of the storeys in rows from the top to the bottom, each from the left to the right."""
    rows: list[list[int]] = []
    for index in sorted(range(len(storeys)), key=lambda index: -storeys[index].bounds[3]):
        _, y0, _, y1 = storeys[index].bounds
        # A storey whose middle is beside the first one of a row belongs to the row.
        if rows and 0.5 * (y0 + y1) > storeys[rows[-1][0]].bounds[1]:
            rows[-1].append(index)
        else:
            rows.append([index])
    return [index for row in rows for index in sorted(row, key=lambda index: storeys[index].bounds[0])]


def _in_words(storeys: Sequence[BaseGeometry], in_file: Callable[[Box], Box], levels: Sequence[Level] = ()) -> str:
    """Return the number of storeys, and the area and `crop` of each."""
    names: Mapping[int, str] = {index: f"'{level.name}' of " for index, level in enumerate(levels)}
    apart_m = min(first.distance(second) for first, second in combinations(storeys, 2))
    margin_m = float(np.clip(0.5 * apart_m, *_MARGIN_M))
    listed = "; ".join(
        f"{names.get(index, '')}{storey.area:.0f} m² at "
        f"crop={','.join(f'{number:.0f}' for number in in_file(storey.buffer(margin_m).bounds))}"
        for index, storey in enumerate(storeys[:_MAX_NAMED])
    )
    return f"{len(storeys)} storeys seem to be drawn side by side, {listed}"


def by_storey(
    drawings: Mapping[float, Drawing], builder: ReportBuilder, options: ImportOptions, budget: Budget, *, flip_y: bool
) -> tuple[ImportedPlan, ...]:
    """Return the plans of the storeys of vector drawings by height, in their own units; most files have one."""
    unit = builder.metres_per_unit
    scaled = {height * unit: drawings[height].scaled(unit, flip_y=flip_y) for height in sorted(drawings)}
    drawing = joined(scaled.values())

    def in_units(box: Box) -> Box:
        x0, y0, x1, y1 = (number / unit for number in box)
        return (x0, -y1, x1, -y0) if flip_y else (x0, y0, x1, y1)

    def make(part: Drawing, report: ReportBuilder, level: Level | None) -> ImportedPlan:
        sketch = sketch_drawing(part, report, budget)
        # They can also be buildings of one site.
        if len(beside := storeys_beside(sketch)) > 1:
            report.warnings.append(f"{_in_words(beside, in_units)}; they were read as one: set crop to read one")
        return assemble(replace(sketch, level=level), report, options, budget.limits.plan)

    def make_level(level: Level, part: Drawing) -> ImportedPlan:
        report = deepcopy(builder)
        numbers = {other.number for other, _ in storeys.values()} - {level.number}
        others = {layer for layer, _ in builder.uses if (found := _storey(layer)) and found[1] in numbers}
        report.uses = Counter({use: count for use, count in builder.uses.items() if use[0] not in others})
        report.warnings = [line for line in builder.warnings if not any(f"'{x[:50]}'" in line for x in others)]
        is_by_height = len(by_height) == len(storeys)
        told_by = "the heights of its lines" if is_by_height else "the names of layers; others belong to all"
        report.notes.append(f"storey '{level.name}' by {told_by}")
        return make(part, report, level)

    roles = {item.role for item in drawing.lines}
    main = "wall" if "wall" in roles else "room" if "room" in roles else None
    by_height = _by_height(scaled, main)
    # Layers name storeys better than heights, which divide what is on other layers.
    storeys = storeys_of(drawing, main, builder if not by_height else ReportBuilder()) or by_height
    if len(storeys) == len(by_height):
        levels = sorted((level for level, _ in storeys.values()), key=lambda level: level.number or 0.0)
        parts = (part for _, part in by_height.values())
        storeys = {level.name: (level, part) for level, part in zip(levels, parts, strict=True)}
    return assemble_levels(storeys, options, budget, make_level) if storeys else (make(drawing, builder, None),)


def storeys_of(drawing: Drawing, main: Role | None, builder: ReportBuilder) -> dict[str, tuple[Level, Drawing]]:
    """Return the parts of a drawing by storey; empty if its walls, the lines of the role `main`, are of one.

    Layers of walls named by words for storeys are over each other. Numbers can count walls as well: they are storeys if
    their walls run around the same outline. Other layers give a warning then.
    """
    walls: defaultdict[float | str, list[BaseGeometry]] = defaultdict(list)
    names: dict[float | str, str] = {}
    for item in (item for item in drawing.lines if item.role == main):
        name, number = _storey(item.layer) or (item.layer, item.layer)
        if names.get(number, "0").isdecimal():
            names[number] = name
        walls[number].append(line_of(item))
    largest = sorted(walls, key=lambda key: -shapely.length(walls[key]).sum())[:_MOST_COMPARED]
    around = {key for a, b in combinations(largest, 2) if _are_over_each_other(walls[a], walls[b]) for key in (a, b)}
    by_word = {key for key in walls if main and not names[key].isdecimal()}
    storeys = [key for key in walls if isinstance(key, float) and key in around | by_word]
    boxes = {number: shapely.box(*shapely.total_bounds(walls[number])) for number in storeys}
    if len(boxes) < 2 or not _overlap([*boxes.values()]):
        if around:
            layers = " and ".join(f"'{names[key]}'" for key in walls if key in around)
            builder.warnings.append(
                f"lines on the layers {layers} run around the same outline, and were read as one storey; if they are "
                "of several, set layers to those of one"
            )
        return {}

    def part(number: float) -> Drawing:
        def is_wanted(layer: str) -> bool:
            name, own = _storey(layer) or ("", number)
            # A number that no walls have counts something else.
            return own == number or (name.isdecimal() and own not in boxes)

        return drawing.on_layers(is_wanted)

    return {names[number]: (Level(names[number], number), part(number)) for number in boxes}


def _by_height(drawings: Mapping[float, Drawing], main: Role | None) -> dict[str, tuple[Level, Drawing]]:
    """Return the parts of drawings in metres, by their heights from the lowest, by storey; empty if walls are of one.

    A storey is higher than the last by a ceiling, and has other lines or texts: not the upper edges of walls alone.
    """
    walls = {height: [line_of(item) for item in part.lines if item.role == main] for height, part in drawings.items()}
    trees = {height: shapely.STRtree(lines_of(segments_of(lines))) for height, lines in walls.items()}
    lengths = {height: shapely.length(lines).sum() for height, lines in walls.items()}
    floors: list[float] = []
    for height in (height for height in drawings if lengths[height] > _SHARE * max(lengths.values())):
        if not floors or (
            height - floors[-1] >= _CEILING_M
            and (drawings[height].letterings or not _is_copy(trees[height], trees[floors[-1]]))
        ):
            floors.append(height)
    if len(floors) < 2 or not _overlap([shapely.box(*shapely.total_bounds(walls[floor])) for floor in floors]):
        return {}
    parts: dict[float, list[Drawing]] = {floor: [] for floor in floors}
    for height, part in drawings.items():
        parts[max([floors[0], *(floor for floor in floors if floor <= height)])].append(part)
    levels = {floor: Level(f"{floor:+.2f}", floor, floor) for floor in floors}
    return {level.name: (level, joined(parts[floor])) for floor, level in levels.items()}


def _overlap(boxes: Sequence[shapely.Polygon]) -> bool:
    return all(a.intersection(b).area >= _OVER * min(a.area, b.area) for a, b in combinations(boxes, 2))


def _are_over_each_other(first: Sequence[BaseGeometry], second: Sequence[BaseGeometry]) -> bool:
    """Return whether the lines of both run around most of the same outline, and both have others as well."""
    hulls = shapely.convex_hull([shapely.GeometryCollection(group) for group in (first, second)])
    small, large = sorted(hulls, key=shapely.area)
    along = small.boundary.intersection(large.boundary.buffer(_SAME_LINE_M))
    least = _MOSTLY_ALONG * small.length
    if not small.area or along.length < least:
        return False
    trees = [shapely.STRtree(lines_of(segments_of(shapely.get_parts(group).tolist()))) for group in (first, second)]
    for tree, other in (trees, trees[::-1]):
        near = tree.geometries[tree.query(along, predicate="dwithin", distance=_SAME_LINE_M)]
        along = along.intersection(shapely.union_all(near).buffer(_SAME_LINE_M))
        if _is_copy(tree, other):
            return False
    return along.length >= least


def _is_copy(tree: shapely.STRtree, other: shapely.STRtree) -> bool:
    """Return whether nearly all pieces of lines run along others."""
    middles = shapely.line_interpolate_point(tree.geometries, 0.5, normalized=True)
    shared = np.unique(other.query(middles, predicate="dwithin", distance=_SAME_LINE_M)[0])
    lengths = shapely.length(tree.geometries)
    return bool(lengths[shared].sum() > (1.0 - _OWN) * lengths.sum())


@lru_cache(maxsize=1024)
def _storey(layer: str) -> tuple[str, float] | None:
    """Return the name and number of the storey that the name of a layer has; None without one."""
    layer = _OTHER_SCRIPTS.sub(r" \1F ", unicodedata.normalize("NFKC", layer))
    for found in _NUMBERED.finditer(layer):
        before, letters, gap, after = found.groups("")
        word = letters.casefold() if "+" in letters else "".join(split_words(letters))
        is_joined = bool(after) and not gap
        # "OG-2" can be the second wall.
        digit = float(before or ("" if gap == "-" else after) or 0) if word in _COUNTED else 0.0
        whole = found[0] if before else layer[found.start() : max(found.end(), found.end(4))]
        for key in (word, found[0].casefold(), f"{word}{after}" if is_joined else word):
            if key in _STOREYS:
                return whole if digit or key != word else letters, _counted(float(_STOREYS[key]), abs(digit))
        if (after or before) and (word in _BESIDE or (is_joined and word in _JOINED)):
            return layer[found.start() : max(found.end(), found.end(4))], float(after or before)
    if (height := _HEIGHT.search(layer)) is not None:
        return height[0], float(height[0].replace(",", ".").replace("±", ""))
    numbers = (part for part in _PARTS.split(layer) if part.isdecimal() and len(part) <= 2 and part != layer)
    return next(((part, float(part)) for part in numbers), None)
