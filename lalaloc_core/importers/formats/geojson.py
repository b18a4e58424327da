"""GeoJSON: rooms are polygons, doors and windows are lines. IMDF archives contain the same features.

The kind of a feature is read from `feature_type` (IMDF), `indoor` (OpenStreetMap's simple indoor tagging), or the words
in `type`, `kind`, `category` and `class`. By default a polygon is a room and a line is a door.
"""

from __future__ import annotations

import json
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
from lalaloc_core.floorplan.earth import Anchor, LocalFrame, to_wgs84
from lalaloc_core.importers.common.assemble import ImportedPlan, assemble, clean_name
from lalaloc_core.importers.common.geojson_features import Projector, plan_features
from lalaloc_core.importers.common.geometry import opening_line, polygons_from_geometry
from lalaloc_core.importers.common.limits import Budget
from lalaloc_core.importers.common.options import METRES_PER_UNIT, ImportOptions, check_units
from lalaloc_core.importers.common.report import ReportBuilder
from lalaloc_core.importers.common.sketch import Level, Sketch, SketchedOpening, SketchedRoom, chosen_levels
from lalaloc_core.importers.common.vocabulary import Role, role_from_name, room_type_from_name

_FEATURE_TYPES: Mapping[str, Role] = {
    "unit": "room", "room": "room", "corridor": "room", "area": "room", "opening": "door", "door": "door",
    "window": "window", "passage": "passage", "wall": "wall", "fixture": "obstacle", "kiosk": "obstacle",
    "column": "obstacle",
}  # fmt: skip
# Feature types of IMDF that are not part of a plan, and categories of units without a floor.
_IGNORED_TYPES = {"venue", "building", "footprint", "level", "address", "section", "geofence", "anchor", "occupant",
                  "amenity"}  # fmt: skip
_NO_FLOOR = {"opentobelow", "structure", "column", "elevator", "escalator", "movingwalkway"}
_MAX_REACH_M = 5000.0


@dataclass(frozen=True)
class Feature:
    """Feature with a geometry in the file's coordinates."""

    shape: BaseGeometry
    properties: Mapping[str, Any]
    id: str | None


def read(document: Any, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read one plan per level of a FeatureCollection, Feature or geometry.

    Coordinates are WGS84, or in the legacy `crs`, and become metres around their centre. With `units` they are lengths
    of a drawing.

    Raises:
        InvalidFloorPlanError: the document is invalid, or its coordinates cannot be converted.
    """
    features = parse_features(document, budget)
    units = document.get("units") if isinstance(document, Mapping) else None
    if units is not None and options.units is None:
        # `write` adds this member to plans without an anchor.
        options = replace(options, units=check_units(units))
    if options.name is None and isinstance(document.get("name"), str):
        options = replace(options, name=clean_name(document["name"]))
    return import_features(features, _crs(document), "geojson", options, budget)


def write(document: Mapping[str, Any], anchor: Anchor | None) -> bytes:
    """Return a FeatureCollection in WGS84 if the plan has an anchor, else in metres with the member `units`."""
    features = plan_features(document, Projector(anchor))
    collection: dict[str, Any] = {"type": "FeatureCollection", "name": document.get("name", "floor plan")}
    if anchor is None:
        collection["units"] = "m"
    return json.dumps(collection | {"features": features}, ensure_ascii=False).encode()


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

    Raises:
        InvalidFloorPlanError: there are no features, or their coordinates cannot be converted.
    """
    if not features:
        raise InvalidFloorPlanError(f"the {format} file has no features with a geometry; export the rooms as polygons")
    project, anchor, metres_per_unit, source = _projection(features, crs, options)
    by_level: dict[str, tuple[Level, list[Feature]]] = {}
    for feature in features:
        for key in _levels_of(feature):
            level = (levels or {}).get(key) or _level(key)
            by_level.setdefault(key, (level, []))[1].append(feature)
    by_level = _levels_with_rooms(by_level)
    plans = []
    for level, members in chosen_levels(by_level, options):
        builder = ReportBuilder()
        sketch = Sketch(level=level if len(by_level) > 1 or level.name != "0" else None, anchor=anchor)
        if anchor is not None:
            sketch.north_deg = anchor.north_deg
        sketch.name = level.name if len(by_level) > 1 else None
        for feature in members:
            _add_to_sketch(feature, project(feature.shape), sketch, options, builder)
            budget.check_time()
        plans.append(
            assemble(sketch, builder, options, format=format, metres_per_unit=metres_per_unit, scale_source=source)
        )
    return tuple(plans)


def parse_features(document: Any, budget: Budget) -> list[Feature]:
    """Return the features of a GeoJSON document that have a geometry.

    Raises:
        InvalidFloorPlanError: the document or a geometry is invalid.
    """
    return list(_features(document, budget))


def _features(document: Any, budget: Budget) -> Iterator[Feature]:
    if not isinstance(document, Mapping):
        raise InvalidFloorPlanError(f"the GeoJSON is of type {type(document).__name__}; it must be an object")
    kind = document.get("type")
    if kind == "FeatureCollection":
        features = document.get("features")
        if not isinstance(features, list):
            raise InvalidFloorPlanError(
                f"'features' of the FeatureCollection is of type {type(features).__name__}; it must be a list"
            )
        for index, feature in enumerate(features):
            yield from _feature(feature, f"feature {index}", budget)
    elif kind == "Feature":
        yield from _feature(document, "the feature", budget)
    else:
        yield from _feature({"type": "Feature", "geometry": document, "properties": {}}, "the geometry", budget)


def _feature(raw: Any, where: str, budget: Budget) -> Iterator[Feature]:
    if not isinstance(raw, Mapping) or raw.get("type") != "Feature":
        raise InvalidFloorPlanError(f"{where} is not a GeoJSON Feature; set its 'type' to 'Feature'")
    geometry = raw.get("geometry")
    if geometry is None:
        return
    budget.spend(1 + _count_numbers(geometry) // 2)
    try:
        shape = shapely.from_geojson(json.dumps(geometry, allow_nan=True))
    except (shapely.errors.ShapelyError, ValueError, TypeError) as error:
        raise InvalidFloorPlanError(f"the geometry of {where} is not a GeoJSON geometry: {error}") from error
    if shape is None or shape.is_empty:
        return
    shape = shapely.force_2d(shape)
    if not np.isfinite(shapely.get_coordinates(shape)).all():
        raise InvalidFloorPlanError(f"the geometry of {where} has coordinates that are not finite; remove it")
    given = raw.get("properties")
    properties = dict(given) if isinstance(given, Mapping) else {}
    if isinstance(raw.get("feature_type"), str):
        properties["feature_type"] = raw["feature_type"]
    identity = raw.get("id", properties.get("id"))
    yield Feature(shape, properties, str(identity)[:200] if isinstance(identity, str | int) else None)


def _count_numbers(value: Any) -> int:
    """Count the numbers in nested lists."""
    pending, count = [value], 0
    while pending:
        item = pending.pop()
        if isinstance(item, Mapping):
            pending.extend(item.values())
        elif isinstance(item, list):
            pending.extend(item)
        else:
            count += 1
    return count


def _crs(document: Any) -> str | None:
    """Return the EPSG code in the legacy member `crs` ("urn:ogc:def:crs:EPSG::25832"), None for WGS84."""
    crs = document.get("crs") if isinstance(document, Mapping) else None
    properties = crs.get("properties") if isinstance(crs, Mapping) else None
    name = properties.get("name") if isinstance(properties, Mapping) else None
    if not isinstance(name, str) or "CRS84" in name or name.endswith(":4326"):
        return None
    digits = name.rpartition(":")[2]
    if not digits.isascii() or not digits.isdigit() or len(digits) > 6:
        raise InvalidFloorPlanError(f"the crs '{name[:100]}' is not an EPSG code; export the file in WGS84")
    return f"EPSG:{digits}"


def _projection(features: Sequence[Feature], crs: str | None, options: ImportOptions) -> Any:
    """Return the function from file coordinates to metres, the anchor, metres per unit, and the source of the scale."""
    points = np.concatenate([shapely.get_coordinates(feature.shape) for feature in features])
    low, high = points.min(axis=0), points.max(axis=0)
    if options.units is not None:
        factor = METRES_PER_UNIT[options.units]
        return _scaling(factor, options), None, factor, "option units"
    if crs is not None:
        try:
            convert = _checked(lambda points: to_wgs84(crs, points))
            low, high = (convert(np.array([corner]))[0] for corner in (low, high))
        except ProjError as error:
            raise InvalidFloorPlanError(f"the crs '{crs}' cannot be used: {error}; export the file in WGS84") from error
    else:
        convert = _checked(lambda points: points)
    if not (np.abs([low, high]) <= [180.0, 90.0]).all():
        raise InvalidFloorPlanError(
            f"coordinates reach ({high[0]:g}, {high[1]:g}), outside longitude ±180 and latitude ±90; "
            "if the file is a drawing in metres, set units=m (or mm, cm, in, ft)"
        )
    # The box of a plan across the date line or around a pole is as wide as the Earth.
    is_box = 0.0 <= high[0] - low[0] <= 180.0
    longitude, latitude = 0.5 * (low + high) if is_box else _middle(convert(points))
    frame = LocalFrame(float(round(longitude, 9)), float(round(latitude, 9)))

    def project(shape: BaseGeometry) -> BaseGeometry:
        return shapely.transform(shape, lambda points: frame.to_local(convert(points)))

    reach_m = float(np.abs(frame.to_local(convert(points))).max())
    if not reach_m <= _MAX_REACH_M:
        raise InvalidFloorPlanError(
            f"the features span {2.0 * reach_m:.0f} m; the limit for a plan is {2 * _MAX_REACH_M:g} m; "
            "if the file is a drawing in metres, set units=m (or mm, cm, in, ft)"
        )
    return project, frame.anchor, 1.0, "longitude and latitude (WGS84)" if crs is None else crs


def _middle(lon_lat: Float[np.ndarray, "n 2"]) -> tuple[float, float]:
    """Return the longitude and latitude of the mean of directions from the Earth's centre."""
    longitude, latitude = np.radians(lon_lat).T
    directions = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    x, y, z = (float(direction.mean()) for direction in directions)
    return math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y)))


def _checked(convert: Any) -> Any:
    def checked(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        converted = convert(points)
        if not np.isfinite(converted).all():
            raise InvalidFloorPlanError(
                "coordinates lie outside the area of their reference system; check crs, or set units for a drawing"
            )
        return converted

    return checked


def _scaling(factor: float, options: ImportOptions) -> Any:
    y_factor = -factor if options.y_axis == "down" else factor
    return lambda shape: shapely.transform(shape, lambda points: points * np.array([factor, y_factor]))


def _levels_of(feature: Feature) -> list[str]:
    """Return the ids of a feature's levels; OpenStreetMap writes "0;1" for two levels."""
    for key in ("level_id", "level", "ordinal", "floor", "storey"):
        value = feature.properties.get(key)
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


def _levels_with_rooms(
    levels: dict[str, tuple[Level, list[Feature]]],
) -> dict[str, tuple[Level, list[Feature]]]:
    """Drop levels without a room, so that features without a level do not make one."""
    with_rooms = {key: item for key, item in levels.items() if any(_role(feature) == "room" for feature in item[1])}
    return with_rooms or levels


def _role(feature: Feature) -> Role:
    properties = feature.properties
    kind = str(properties.get("feature_type") or properties.get("indoor") or "").casefold()
    category = str(properties.get("category") or "").casefold()
    if kind in _IGNORED_TYPES:
        return "ignored"
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


def _opening_role(properties: Mapping[str, Any], category: str) -> Role:
    """Return the role of an IMDF opening: a door, or a passage if `door` is null; windows need a `kind`."""
    role = role_from_name(str(properties.get("kind") or category))
    if role == "door" or role == "window" or role == "passage":
        return role
    return "passage" if "door" in properties and properties["door"] is None else "door"


def _add_to_sketch(
    feature: Feature, shape: BaseGeometry, sketch: Sketch, options: ImportOptions, builder: ReportBuilder
) -> None:
    """Add a feature to the sketch by its role."""
    properties, role = feature.properties, _role(feature)
    layer = str(
        properties.get("feature_type")
        or properties.get("indoor")
        or properties.get("kind")
        or properties.get("type")
        or ""
    )[:100]
    name = _name(properties)
    if not options.includes_layer(layer, str(properties.get("category") or "")):
        builder.use(layer, "ignored (not in the option layers)")
        return
    if role == "room":
        parts = polygons_from_geometry(shape)
        builder.use(layer, "rooms" if parts else "ignored", max(len(parts), 1))
        kind = _room_type(properties, name)
        ceiling = _number(properties, "ceiling_height_m", "ceiling_height", "height")
        room_id = feature.id if len(parts) == 1 else None
        sketch.rooms += [SketchedRoom(part, name, kind, ceiling, room_id) for part in parts]
    elif role == "obstacle":
        parts = polygons_from_geometry(shape)
        builder.use(layer, "holes" if parts else "ignored", max(len(parts), 1))
        sketch.obstacles += parts
    elif role in ("door", "window", "passage"):
        ends = opening_line(shape)
        builder.use(layer, role if ends is not None else "ignored (a point has no width)")
        if ends is not None:
            sill, head = _number(properties, "sill_m"), _number(properties, "head_m")
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


def _name(properties: Mapping[str, Any]) -> str | None:
    """Return the name of a feature; of IMDF's names by language the English one, else the first."""
    for key in ("name", "alt_name", "label", "ref", "title"):
        value = properties.get(key)
        if isinstance(value, Mapping):
            value = value.get("en") or next(iter(value.values()), None)
        if isinstance(value, str) and value.strip():
            return value
        if isinstance(value, int) and not isinstance(value, bool):
            return str(value)
    return None


def _room_type(properties: Mapping[str, Any], name: str | None) -> str | None:
    words = [properties.get(key) for key in ("type", "room", "category", "indoor")]
    found = [room_type_from_name(str(word)) for word in words if isinstance(word, str)]
    return next((kind for kind in found if kind is not None), None) or room_type_from_name(name)


def _number(properties: Mapping[str, Any], *keys: str) -> float | None:
    for key in keys:
        value = properties.get(key)
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    return None
