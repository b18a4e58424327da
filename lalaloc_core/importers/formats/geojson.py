"""GeoJSON: rooms are polygons, doors and windows lines; the features of an IMDF archive are read the same way.

What a feature is, is read from `feature_type` (IMDF), `indoor` (OpenStreetMap's simple indoor tagging), or the words of
`type`, `kind`, `category` and `class`; a polygon that says nothing is a room, a line that says nothing a door.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float
from pyproj.exceptions import ProjError
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import LocalFrame, to_wgs84
from lalaloc_core.importers.model.assemble import ImportedPlan, assemble, clean_name
from lalaloc_core.importers.model.geometry import opening_line, polygons_of
from lalaloc_core.importers.model.levels import chosen_levels
from lalaloc_core.importers.model.limits import Budget
from lalaloc_core.importers.model.options import METRES_PER_UNIT, ImportOptions
from lalaloc_core.importers.model.report import ReportBuilder
from lalaloc_core.importers.model.sketch import Level, Sketch, SketchedOpening, SketchedRoom
from lalaloc_core.importers.model.words import Role, role_of, type_of_room

FORMAT = "geojson"
_FEATURE_TYPES: Mapping[str, Role] = {
    "unit": "room",
    "room": "room",
    "opening": "door",
    "fixture": "obstacle",
    "kiosk": "obstacle",
    "corridor": "room",
    "area": "room",
    "wall": "wall",
    "column": "obstacle",
    "door": "door",
    "window": "window",
    "passage": "passage",
}
# Features of an IMDF archive, and units of one, that are no floor to stand on or no part of a plan.
_NO_PLAN = {
    "venue",
    "building",
    "footprint",
    "level",
    "address",
    "section",
    "geofence",
    "anchor",
    "occupant",
    "amenity",
}
_NO_FLOOR = {"opentobelow", "structure", "column", "elevator", "escalator", "movingwalkway"}
_MAX_REACH_M = 5000.0


@dataclass(frozen=True)
class _Feature:
    shape: BaseGeometry
    says: Mapping[str, Any]
    id: str | None


def import_geojson(document: Any, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """One plan for every level of a FeatureCollection, Feature or geometry.

    Coordinates are WGS84 (or in the legacy `crs`), and become metres around their middle; with `units` they are a
    drawing's own.

    Raises:
        InvalidFloorPlanError: what is wrong, and where.
    """
    features = list(_features(document, budget))
    said = document.get("units") if isinstance(document, Mapping) else None
    if said is not None and options.units is None:
        # A foreign member that the exporter writes for plans whose place on Earth is not known.
        if said not in METRES_PER_UNIT:
            raise InvalidFloorPlanError(f"units is {str(said)[:50]!r}, known are {', '.join(METRES_PER_UNIT)}")
        options = replace(options, units=said)
    if options.name is None and isinstance(document.get("name"), str):
        options = replace(options, name=clean_name(document["name"]))
    return import_features(features, _crs(document), FORMAT, options, budget)


def import_features(
    features: Sequence[_Feature],
    crs: str | None,
    format: str,
    options: ImportOptions,
    budget: Budget,
    levels: Mapping[str, Level] | None = None,
) -> tuple[ImportedPlan, ...]:
    """One plan for every level of these features; `levels` tells what is known of each, by id."""
    if not features:
        raise InvalidFloorPlanError(f"the {format} file holds no features with a geometry")
    project, anchor, metres_per_unit, source = _projection(features, crs, options)
    by_level: dict[str, tuple[Level, list[_Feature]]] = {}
    for feature in features:
        for key in _levels_of(feature):
            level = (levels or {}).get(key) or _level(key)
            by_level.setdefault(key, (level, []))[1].append(feature)
    by_level = _with_rooms(by_level)
    plans = []
    for level, members in chosen_levels(by_level, options):
        builder = ReportBuilder()
        sketch = Sketch(level=level if len(by_level) > 1 or level.name != "0" else None, anchor=anchor)
        if anchor is not None:
            sketch.north_deg = anchor.north_deg
        sketch.name = level.name if len(by_level) > 1 else None
        for feature in members:
            _sort_in(feature, project(feature.shape), sketch, options, builder)
            budget.check_time()
        plans.append(
            assemble(sketch, builder, options, format=format, metres_per_unit=metres_per_unit, scale_source=source)
        )
    return tuple(plans)


def read_features(document: Any, budget: Budget) -> list[_Feature]:
    """The features of one GeoJSON document that have a geometry."""
    return list(_features(document, budget))


def _features(document: Any, budget: Budget) -> Iterator[_Feature]:
    if not isinstance(document, Mapping):
        raise InvalidFloorPlanError(f"GeoJSON must be an object, not {type(document).__name__}")
    kind = document.get("type")
    if kind == "FeatureCollection":
        features = document.get("features")
        if not isinstance(features, list):
            raise InvalidFloorPlanError("'features' of the FeatureCollection must be a list")
        for index, feature in enumerate(features):
            yield from _feature(feature, f"feature {index}", budget)
    elif kind == "Feature":
        yield from _feature(document, "the feature", budget)
    else:
        yield from _feature({"type": "Feature", "geometry": document, "properties": {}}, "the geometry", budget)


def _feature(raw: Any, where: str, budget: Budget) -> Iterator[_Feature]:
    if not isinstance(raw, Mapping) or raw.get("type") != "Feature":
        raise InvalidFloorPlanError(f"{where} is no GeoJSON Feature")
    geometry = raw.get("geometry")
    if geometry is None:
        return
    budget.spend(1 + _count_numbers(geometry) // 2)
    try:
        shape = shapely.from_geojson(_dumps(geometry))
    except (shapely.errors.ShapelyError, ValueError, TypeError) as error:
        raise InvalidFloorPlanError(f"the geometry of {where} cannot be read: {error}") from error
    if shape is None or shape.is_empty:
        return
    shape = shapely.force_2d(shape)
    if not np.isfinite(shapely.get_coordinates(shape)).all():
        raise InvalidFloorPlanError(f"the geometry of {where} has coordinates that are not finite")
    says = raw.get("properties")
    properties = dict(says) if isinstance(says, Mapping) else {}
    if isinstance(raw.get("feature_type"), str):
        properties["feature_type"] = raw["feature_type"]
    identity = raw.get("id", properties.get("id"))
    yield _Feature(shape, properties, str(identity)[:200] if isinstance(identity, str | int) else None)


def _dumps(geometry: Any) -> str:
    import json

    return json.dumps(geometry, allow_nan=True)


def _count_numbers(value: Any) -> int:
    """Numbers in nested lists, without recursion into what the depth check has let through only so deep."""
    waiting, count = [value], 0
    while waiting:
        item = waiting.pop()
        if isinstance(item, Mapping):
            waiting.extend(item.values())
        elif isinstance(item, list):
            waiting.extend(item)
        else:
            count += 1
    return count


def _crs(document: Any) -> str | None:
    """The code of the legacy `crs` member ("urn:ogc:def:crs:EPSG::25832"), None for WGS84."""
    crs = document.get("crs") if isinstance(document, Mapping) else None
    properties = crs.get("properties") if isinstance(crs, Mapping) else None
    name = properties.get("name") if isinstance(properties, Mapping) else None
    if not isinstance(name, str) or "CRS84" in name or name.endswith(":4326"):
        return None
    digits = name.rpartition(":")[2]
    if not digits.isascii() or not digits.isdigit() or len(digits) > 6:
        raise InvalidFloorPlanError(f"the crs '{name[:100]}' is not known; send WGS84, as GeoJSON has it")
    return f"EPSG:{digits}"


def _projection(features: Sequence[_Feature], crs: str | None, options: ImportOptions) -> Any:
    """(function from file coordinates to metres, anchor, metres per unit, where the scale was read)."""
    everything = np.concatenate([shapely.get_coordinates(feature.shape) for feature in features])
    low, high = everything.min(axis=0), everything.max(axis=0)
    if options.units is not None:
        factor = METRES_PER_UNIT[options.units]
        return _scaling(factor, options), None, factor, "option units"
    if crs is not None:
        try:
            convert = _checked(lambda points: to_wgs84(crs, points))
            low, high = (convert(np.array([corner]))[0] for corner in (low, high))
        except ProjError as error:
            raise InvalidFloorPlanError(f"the crs '{crs}' cannot be used: {error}") from error
    else:
        convert = _checked(lambda points: points)
    if not (-180.0 <= low[0] <= high[0] <= 180.0 and -90.0 <= low[1] <= high[1] <= 90.0):
        raise InvalidFloorPlanError(
            f"coordinates reach to ({high[0]:g}, {high[1]:g}), which is no longitude and latitude; "
            "where the file is a drawing in a unit of its own, say so: units=m"
        )
    frame = LocalFrame(float(round(0.5 * (low[0] + high[0]), 9)), float(round(0.5 * (low[1] + high[1]), 9)))

    def project(shape: BaseGeometry) -> BaseGeometry:
        return shapely.transform(shape, lambda points: frame.to_local(convert(points)))

    corners = frame.to_local(convert(everything[[everything[:, 0].argmin(), everything[:, 0].argmax()]]))
    if np.abs(corners).max() > _MAX_REACH_M:
        raise InvalidFloorPlanError(
            f"the features lie {2.0 * np.abs(corners).max():.0f} m apart, at most {2 * _MAX_REACH_M:g} m can be one "
            "plan; where the file is a drawing in a unit of its own, say so: units=m"
        )
    return project, frame.anchor, 1.0, "longitude and latitude (WGS84)" if crs is None else crs


def _checked(convert: Any) -> Any:
    def checked(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        converted = convert(points)
        if not np.isfinite(converted).all():
            raise InvalidFloorPlanError("coordinates lie outside what their reference system covers")
        return converted

    return checked


def _scaling(factor: float, options: ImportOptions) -> Any:
    over = -factor if options.y_axis == "down" else factor
    return lambda shape: shapely.transform(shape, lambda points: points * np.array([factor, over]))


def _levels_of(feature: _Feature) -> list[str]:
    """Ids of the levels that a feature is on; OpenStreetMap writes "0;1" for both."""
    for key in ("level_id", "level", "ordinal", "floor", "storey"):
        value = feature.says.get(key)
        if isinstance(value, str) and value.strip():
            return [part.strip()[:100] for part in value.split(";")[:20] if part.strip()] or ["0"]
        if isinstance(value, int | float) and not isinstance(value, bool):
            return [f"{value:g}"]
    return ["0"]


def _level(key: str) -> Level:
    try:
        number = float(key)
    except ValueError:
        number = math.nan
    return Level(key, number if math.isfinite(number) else None)


def _with_rooms(
    levels: dict[str, tuple[Level, list[_Feature]]],
) -> dict[str, tuple[Level, list[_Feature]]]:
    """Levels that hold a room; features without a level of their own make none beside those that have one."""
    with_rooms = {key: item for key, item in levels.items() if any(_role(feature) == "room" for feature in item[1])}
    return with_rooms or levels


def _role(feature: _Feature) -> Role:
    says = feature.says
    kind = str(says.get("feature_type") or says.get("indoor") or "").casefold()
    category = str(says.get("category") or "").casefold()
    if kind in _NO_PLAN:
        return "ignored"
    is_area = shapely.get_dimensions(feature.shape) == 2
    if kind in ("unit", "area", "room") and category in _NO_FLOOR:
        return "obstacle"
    if kind == "opening":
        return _opening_role(says, category)
    role: Role
    if kind in _FEATURE_TYPES:
        role = _FEATURE_TYPES[kind]
    elif str(says.get("door") or "no").casefold() != "no":
        role = "door"
    else:
        role = "room" if is_area else "door"
        for key in ("layer", "class", "category", "type", "kind"):
            role = role_of(str(says.get(key) or "")) or role
    return "obstacle" if role == "wall" and is_area else role


def _opening_role(says: Mapping[str, Any], category: str) -> Role:
    """IMDF's openings are doors, or ways without one (`door` is null); of windows it knows nothing."""
    said = role_of(str(says.get("kind") or category))
    if said == "door" or said == "window" or said == "passage":
        return said
    return "passage" if "door" in says and says["door"] is None else "door"


def _sort_in(
    feature: _Feature, shape: BaseGeometry, sketch: Sketch, options: ImportOptions, builder: ReportBuilder
) -> None:
    """Put one feature where it belongs in the sketch."""
    says, role = feature.says, _role(feature)
    layer = str(says.get("feature_type") or says.get("indoor") or says.get("kind") or says.get("type") or "")[:100]
    name = _name(says)
    if not options.wants_layer(layer, str(says.get("category") or "")):
        builder.use(layer, "ignored (not among the layers asked for)")
        return
    if role == "room":
        parts = polygons_of(shape)
        builder.use(layer, "rooms" if parts else "ignored", max(len(parts), 1))
        kind = _room_type(says, name)
        ceiling = _number(says, "ceiling_height_m", "ceiling_height", "height")
        only = feature.id if len(parts) == 1 else None
        sketch.rooms += [SketchedRoom(part, name, kind, ceiling, only) for part in parts]
    elif role == "obstacle":
        parts = polygons_of(shape)
        builder.use(layer, "holes" if parts else "ignored", max(len(parts), 1))
        sketch.obstacles += parts
    elif role in ("door", "window", "passage"):
        ends = opening_line(shape)
        builder.use(layer, role if ends is not None else "ignored (a point has no width)")
        if ends is not None:
            sill, head = _number(says, "sill_m"), _number(says, "head_m")
            sketch.openings.append(SketchedOpening(role, *ends, name, sill, head))
    elif role == "wall":
        lines = [part for part in shapely.get_parts(shape) if isinstance(part, shapely.LineString)]
        pieces = [
            shapely.LineString(pair) for line in lines for pair in zip(line.coords, line.coords[1:], strict=False)
        ]
        builder.use(layer, "free-standing walls", max(len(pieces), 1))
        sketch.inner_walls += pieces
    else:
        builder.use(layer, "ignored")


def _name(says: Mapping[str, Any]) -> str | None:
    """IMDF has names by language; English goes first, then whatever there is."""
    for key in ("name", "alt_name", "label", "ref", "title"):
        value = says.get(key)
        if isinstance(value, Mapping):
            value = value.get("en") or next(iter(value.values()), None)
        if isinstance(value, str) and value.strip():
            return value
        if isinstance(value, int) and not isinstance(value, bool):
            return str(value)
    return None


def _room_type(says: Mapping[str, Any], name: str | None) -> str | None:
    words = [says.get(key) for key in ("type", "room", "category", "indoor")]
    found = [type_of_room(str(word)) for word in words if isinstance(word, str)]
    return next((kind for kind in found if kind is not None), None) or type_of_room(name)


def _number(says: Mapping[str, Any], *keys: str) -> float | None:
    for key in keys:
        value = says.get(key)
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    return None
