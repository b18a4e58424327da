"""Features with tags, as in GeoJSON, IMDF and OpenStreetMap, and their conversion to plans.

The kind of a feature is read from `feature_type` (IMDF), `indoor` (OpenStreetMap's Simple Indoor Tagging), or the words
in `type`, `kind`, `category` and `class`. By default a polygon is a room and a line is a door.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, cast

import shapely
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.plan_words import Role, fixture_from_name, role_from_name
from lalaloc_core.floorplan.room_types import PLAN_WORDS, keys_by_word, room_types_from_name
from lalaloc_core.importers.common.assemble import ImportedPlan, assemble, assemble_levels
from lalaloc_core.importers.common.geometry import opening_line, polygons_of
from lalaloc_core.importers.common.import_limits import Budget
from lalaloc_core.importers.common.import_options import METRES_PER_UNIT, ImportOptions, to_number
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.common.map_projection import ORDERED, projection
from lalaloc_core.importers.common.opening_placement import WallLines
from lalaloc_core.importers.common.sketch import (
    ROOM_HEIGHT_M,
    Level,
    OpeningKind,
    Sketch,
    SketchedFixture,
    SketchedOpening,
    SketchedRoom,
)

# Roles by the feature types of IMDF, and by `indoor` in Simple Indoor Tagging.
_FEATURE_TYPES, _INDOOR = (cast("dict[str, Role]", keys_by_word(table)) for table in ("feature_types", "indoor"))
# Categories of units without a floor, properties of outdoor features in OpenStreetMap, and those inside buildings.
_NO_FLOOR, _OUTDOOR, _INSIDE = (
    frozenset(PLAN_WORDS["features"][key].split()) for key in ("no_floor", "outdoor", "inside")
)
# Roles of features with a tag, and of those where it is "no".
_OPENING_TAGS: Mapping[str, tuple[Role, Role]] = {
    "window": ("window", "ignored"), "door": ("door", "passage"), "entrance": ("door", "ignored"),
}  # fmt: skip
# Properties with the name of a level, and of a room.
_LEVEL_KEYS, _NAME_KEYS = (tuple(PLAN_WORDS["features"][key].split()) for key in ("level_keys", "name_keys"))
# Points of a line that can be the outline of a room.
_CORNERS = 3
# Width (m) of an opening drawn as a point without a width.
_USUAL_WIDTH_M: Mapping[OpeningKind, float] = {"door": 0.9, "window": 1.2, "passage": 1.0}
_LENGTH = re.compile(r"(\d{1,9}(?:[.,]\d{1,99})?)\s*(mm|cm|m|ft|in|'|\"|)(?:\s*(\d{1,9}(?:\.\d{1,99})?)\s*(?:in|\"))?")
_RANGE = re.compile(r"(-?\d{1,3})\s*-\s*(-?\d{1,3})")
_MAX_LEVELS = 200
# Types of a feature, and characters of them, that are read.
_MAX_TYPES, _MAX_TEXT = 10, 200
# Further levels of all features together: shafts and stairs are on all levels.
_REPEATS, _REPEATS_PER_FEATURE = 1000, 5


@dataclass(frozen=True)
class Feature:
    """Feature with a geometry in the file's coordinates."""

    shape: BaseGeometry
    properties: Mapping[str, Any]
    id: str | None


def import_features(
    features: Sequence[Feature],
    crs: str | None,
    format: str,
    options: ImportOptions,
    budget: Budget,
    levels: Mapping[str, Level] | None = None,
) -> tuple[ImportedPlan, ...]:
    """Make one plan per level.

    `crs` is the code of the features' coordinate reference system, None for WGS84, and `format` the name of the file's
    format.
    """
    if not features:
        raise InvalidFloorPlanError(f"the {format} file has no features with a geometry; export the rooms as polygons")
    _refuse_map(features, format)
    # The other formats state which number is the latitude.
    placed = projection([feature.shape for feature in features], crs if format == "geojson" else ORDERED, options)
    is_indoor = any(str(feature.properties.get("indoor")) in _INDOOR for feature in features)
    by_level: dict[str, tuple[Level, list[Feature]]] = {}
    on_any_level: list[Feature] = []
    repeats = 0
    for feature in features:
        keys = _levels_of(feature)
        if not keys and is_indoor and shapely.get_dimensions(feature.shape) == 0:
            on_any_level.append(feature)
            continue
        repeats += max(len(keys) - 1, 0)
        if repeats > _REPEATS + _REPEATS_PER_FEATURE * len(features):
            raise InvalidFloorPlanError(
                f"{len(features)} features are on several levels, {repeats} times in all; the limit for as many is "
                f"{_REPEATS + _REPEATS_PER_FEATURE * len(features)}; export a single level"
            )
        # A feature on several levels is as much work as several features.
        budget.spend(max(len(keys) - 1, 0) * (1 + shapely.count_coordinates(feature.shape)))
        for key in keys or ["0"]:
            level = (levels or {}).get(key) or _level(key)
            by_level.setdefault(key, (level, []))[1].append(feature)
    role_of = _indoor_role if is_indoor else _role
    # Features without a level do not make one.
    with_rooms = {key: item for key, item in by_level.items() if any(role_of(member) == "room" for member in item[1])}
    by_level = with_rooms or by_level

    def make(level: Level, members: Sequence[Feature]) -> ImportedPlan:
        builder = ReportBuilder(format, placed.metres_per_unit, placed.source)
        builder.warnings, builder.unsure = list(placed.warnings), list(placed.unsure)
        sketch = Sketch(level=level if len(by_level) > 1 or level.name != "0" else None, anchor=placed.anchor)
        if placed.anchor is not None:
            sketch.north_deg = placed.anchor.north_deg
        sketch.name = level.name if len(by_level) > 1 else None
        drawer = _Drawer(sketch, options, builder)
        for feature in (*members, *on_any_level):
            drawer.add(feature, role_of(feature), placed.project(feature.shape))
            budget.check_time()
        drawer.add_points()
        return assemble(sketch, builder, options, budget.limits.plan)

    return assemble_levels(by_level, options, budget, make)


def _refuse_map(features: Sequence[Feature], format: str) -> None:
    """Refuse a map of streets, whose buildings would become rooms."""
    outdoor = sum(not _OUTDOOR.isdisjoint(feature.properties) for feature in features)
    if outdoor and all(_INSIDE.isdisjoint(feature.properties) for feature in features):
        raise InvalidFloorPlanError(
            f"the {format} file is a map with {outdoor} outdoor features such as streets, not a floor plan; export the "
            "rooms, tagged with indoor=room or feature_type=unit"
        )


def _levels_of(feature: Feature) -> list[str]:
    """Return the ids of a feature's levels, none if it gives none; OpenStreetMap writes "0;1" and "0-2"."""
    found: dict[str, None] = {}
    for key in (*_LEVEL_KEYS, "repeat_on"):
        value = feature.properties.get(key)
        if found and key != "repeat_on":
            continue
        if isinstance(value, str):
            parts = (part.strip() for part in value.split(";")[:_MAX_LEVELS])
            found |= dict.fromkeys(name for part in parts for name in _level_names(part))
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found[f"{value:g}"] = None
    return list(found)[:_MAX_LEVELS]


def _level_names(text: str) -> list[str]:
    match = _RANGE.fullmatch(text)
    if match is None:
        return [text[:100]] if text else []
    low, high = sorted((int(match[1]), int(match[2])))
    return [str(number) for number in range(low, min(high, low + _MAX_LEVELS) + 1)]


def _level(key: str) -> Level:
    number = to_number(key)
    return Level(key, number if math.isfinite(number) else None)


def _role(feature: Feature) -> Role:
    properties = feature.properties
    kind = str(properties.get("feature_type") or properties.get("indoor") or "").casefold()
    category = str(properties.get("category") or "").casefold()
    is_area = shapely.get_dimensions(feature.shape) == 2
    if kind in ("unit", "area", "room") and category in _NO_FLOOR:
        return "obstacle"
    if kind == "opening":
        return _opening_role(properties, category)
    role: Role
    if kind in _FEATURE_TYPES:
        role = _FEATURE_TYPES[kind]
    elif str(properties.get("door") or "no").casefold() != "no":
        role = "door"
    else:
        role = "room" if is_area else "door"
        for key in ("layer", "class", "category", "type", "kind"):
            role = role_from_name(str(properties.get(key) or "")) or role
    return "obstacle" if role == "wall" and is_area else role


def _indoor_role(feature: Feature) -> Role:
    """Return the role of a feature of OpenStreetMap's Simple Indoor Tagging."""
    properties = feature.properties
    is_area = shapely.get_dimensions(feature.shape) == 2
    if not is_area:
        for key, (yes, no) in _OPENING_TAGS.items():
            value = str(properties.get(key) or "").casefold()
            if value:
                return no if value == "no" else yes
    role: Role = _INDOOR.get(str(properties.get("indoor")), "ignored")
    if role == "room" and any(properties.get(key) in _NO_FLOOR for key in ("room", "highway")):
        return "obstacle"
    if role == "room" and not is_area:
        return "ignored"
    return "obstacle" if role == "wall" and is_area else role


def _opening_role(properties: Mapping[str, Any], category: str) -> Role:
    """Return the role of an IMDF opening: a door, or a passage if `door` is null; windows need a `kind`."""
    role = role_from_name(str(properties.get("kind") or category))
    if role == "door" or role == "window" or role == "passage":
        return role
    return "passage" if "door" in properties and properties["door"] is None else "door"


class _Drawer:
    """Features as parts of a sketch."""

    def __init__(self, sketch: Sketch, options: ImportOptions, builder: ReportBuilder) -> None:
        self._sketch, self._options, self._builder = sketch, options, builder
        # Openings that begin and end at a point on a wall, as in OpenStreetMap; their widths (m), layers, and whether
        # they can only belong to this level.
        self._points: list[tuple[SketchedOpening, float, str, bool]] = []

    def add(self, feature: Feature, role: Role, shape: BaseGeometry) -> None:
        """Add a feature by its role; openings without a direction wait for `add_points`."""
        properties, sketch, builder = feature.properties, self._sketch, self._builder
        layer = _layer(properties)
        if not self._options.includes_layer(layer, str(properties.get("category") or "")):
            builder.use(layer, "ignored (not in the option layers)")
        elif role == "room":
            self._add_rooms(feature, shape, layer)
        elif role in ("obstacle", "ignored") and (kind := _fixture(properties)) and polygons_of(shape):
            parts = polygons_of(shape)
            builder.use(layer, "fixtures", len(parts))
            sketch.fixtures += [SketchedFixture(kind, part) for part in parts]
        elif role == "obstacle":
            parts = polygons_of(shape)
            builder.use(layer, "holes" if parts else "ignored", max(len(parts), 1))
            sketch.obstacles += parts
        elif role == "door" or role == "window" or role == "passage":
            self._add_opening(feature, role, shape, layer)
        elif role == "wall":
            lines = [part for part in shapely.get_parts(shape) if isinstance(part, shapely.LineString)]
            pieces = [shapely.LineString(pair) for line in lines for pair in pairwise(line.coords)]
            builder.use(layer, "free-standing walls", max(len(pieces), 1))
            sketch.inner_walls += pieces
        else:
            builder.leave_out(layer, role)

    def _add_rooms(self, feature: Feature, shape: BaseGeometry, layer: str) -> None:
        # Some tools write the outline of a room as a line.
        area = shape if shapely.get_dimensions(shape) == 2 else shapely.build_area(shape)
        if area.is_empty and isinstance(shape, shapely.LineString) and len(shape.coords) > _CORNERS:
            area = shapely.Polygon(shape.coords)
            self._builder.notes.append(f"the open outline of '{_name(feature.properties)}' was closed")
        properties, parts = feature.properties, polygons_of(area)
        self._builder.use(layer, "rooms" if parts else "ignored", max(len(parts), 1))
        name = _name(properties)
        types = _room_types(properties, name)
        ceiling_m = _number(properties, "ceiling_height_m", "ceiling_height", "height")
        lowest_m, highest_m = ROOM_HEIGHT_M
        if ceiling_m is not None and not lowest_m <= ceiling_m <= highest_m:
            self._builder.warnings.append(
                f"the height of '{name}' is {ceiling_m:g} m and was ignored; it must be between {lowest_m:g} and "
                f"{highest_m:g} m"
            )
            ceiling_m = None
        self._sketch.rooms += [SketchedRoom(part, name, types, ceiling_m) for part in parts]

    def _add_opening(self, feature: Feature, kind: OpeningKind, shape: BaseGeometry, layer: str) -> None:
        properties, name = feature.properties, _name(feature.properties)
        sill_m, head_m = _number(properties, "sill_m"), _number(properties, "head_m")
        if head_m is None and kind != "window":
            head_m = _number(properties, "height")
        if isinstance(shape, shapely.Point):
            width_m = _number(properties, "width", "est_width")
            if width_m is None or width_m <= 0.0:
                width_m = _USUAL_WIDTH_M[kind]
                self._builder.unsure.append(f"{kind}s drawn as points without a width; {width_m:g} m is assumed")
            point = (shape.x, shape.y)
            opening = SketchedOpening(kind, point, point, name, None, head_m)
            self._points.append((opening, width_m, layer, bool(_levels_of(feature))))
            return
        ends = opening_line(shape)
        self._builder.use(layer, kind if ends is not None else "ignored (no length)")
        if ends is not None:
            self._sketch.openings.append(SketchedOpening(kind, *ends, name, sill_m, head_m))

    def add_points(self) -> None:
        """Add the openings drawn as points, each along the nearest wall."""
        if not self._points:
            return
        walls = WallLines([room.shape for room in self._sketch.rooms])
        lost = 0
        for opening, width_m, layer, has_level in self._points:
            ends = walls.line_at(shapely.Point(opening.start), width_m)
            self._builder.use(layer, opening.kind if ends is not None else "ignored (on no wall of the level)")
            if ends is not None:
                self._sketch.openings.append(replace(opening, start=ends[0], end=ends[1]))
            lost += ends is None and has_level
        if lost:
            self._builder.warnings.append(f"{lost} openings drawn as points lie on no wall and were left out")


def _fixture(properties: Mapping[str, Any]) -> str | None:
    """Return the kind of a piece of furniture or equipment; None for parts of the building."""
    if str(properties.get("feature_type") or "").casefold() in ("unit", "area", "room") or "indoor" in properties:
        return None
    texts = (properties.get(key) for key in ("category", "type", "kind", "class", "furniture"))
    return fixture_from_name(*(text for text in texts if isinstance(text, str)), _name(properties))


def _layer(properties: Mapping[str, Any]) -> str:
    """Return the word that a report names a feature by."""
    given = (properties.get(key) for key in ("feature_type", "indoor", "kind", "type"))
    openings = (key for key in ("door", "window", "entrance") if properties.get(key))
    return str(next((value for value in given if value), None) or next(openings, ""))[:100]


def _name(properties: Mapping[str, Any]) -> str | None:
    for key in _NAME_KEYS:
        value = in_english(properties.get(key))
        if isinstance(value, str) and value.strip():
            return value
        if isinstance(value, int) and not isinstance(value, bool):
            return str(value)
    return None


def in_english(value: Any) -> Any:
    """Return the English one of IMDF's texts by language, else the first; other values as they are."""
    return value.get("en") or next(iter(value.values()), None) if isinstance(value, Mapping) else value


def _room_types(properties: Mapping[str, Any], name: str | None) -> tuple[str, ...]:
    several = properties.get("types")
    words = [" / ".join(map(str, several[:_MAX_TYPES])) if isinstance(several, list) else several]
    words += [properties.get(key) for key in ("type", "room", "category", "indoor")]
    found = [room_types_from_name(word[:_MAX_TEXT]) for word in words if isinstance(word, str)]
    return next(filter(None, found), None) or room_types_from_name(name)


def _number(properties: Mapping[str, Any], *keys: str) -> float | None:
    """Return the first length (m) under the keys: a number, or a text such as "2.8", "90 cm" or 6'8"."""
    for key in keys:
        value = properties.get(key)
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
        match = _LENGTH.fullmatch(value.strip()) if isinstance(value, str) else None
        if match is not None:
            unit = {"'": "ft", '"': "in", "": "m"}.get(match[2], match[2])
            inches = float(match[3] or 0.0) * METRES_PER_UNIT["in"]
            return float(match[1].replace(",", ".")) * METRES_PER_UNIT[unit] + inches
    return None
