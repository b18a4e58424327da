"""GeoJSON: rooms are polygons, doors and windows are lines or points. IMDF archives contain the same features."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import shapely

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.floorplan.json_values import is_number
from lalaloc_core.importers.common.assemble import ImportedPlan, clean_name
from lalaloc_core.importers.common.geometry import MAX_COORDINATE, check_coordinates
from lalaloc_core.importers.common.import_limits import Budget
from lalaloc_core.importers.common.import_options import ImportOptions, check_units
from lalaloc_core.importers.common.tagged_features import Feature, import_features

# Decimals of exported degrees; the ninth is a tenth of a millimetre.
_DECIMALS = 9
# Depth of rings in the coordinates of a geometry.
_RINGS = {"Polygon": 1, "MultiPolygon": 2}


def read(document: Any, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read one plan per level of a FeatureCollection, Feature or geometry.

    Coordinates are WGS84, or in the legacy `crs`, and become metres around their centre. With `units` they are lengths
    of a drawing.
    """
    features = list(parse_features(document, budget))
    units = document.get("units") if isinstance(document, Mapping) else None
    if units is not None and options.units is None:
        # `write` adds this member to plans without an anchor.
        options = replace(options, units=check_units(units))
    if options.name is None and isinstance(document.get("name"), str):
        options = replace(options, name=clean_name(document["name"]))
    return import_features(features, _crs(document), "geojson", options, budget)


def write(document: Mapping[str, Any], anchor: Anchor | None) -> bytes:
    """Return a FeatureCollection in WGS84 if the plan has an anchor, else in metres with the member `units`."""
    features = plan_features(document, anchor)
    collection: dict[str, Any] = {"type": "FeatureCollection", "name": document.get("name", "floor plan")}
    if anchor is None:
        collection["units"] = "m"
    return json.dumps(collection | {"features": features}, ensure_ascii=False).encode()


def parse_features(document: Any, budget: Budget) -> Iterator[Feature]:
    """Yield the features of a GeoJSON document that have a geometry."""
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
        yield from _feature({"type": "Feature", "geometry": document, "properties": {}}, "the file", budget)


def _feature(raw: Any, where: str, budget: Budget) -> Iterator[Feature]:
    if not isinstance(raw, Mapping) or raw.get("type") != "Feature":
        raise InvalidFloorPlanError(f"{where} is not a GeoJSON Feature; set its 'type' to 'Feature'")
    geometry = raw.get("geometry")
    if geometry is None:
        return
    budget.spend(1 + _count_numbers(geometry, where) // 2)
    if isinstance(geometry, Mapping) and (depth := _RINGS.get(str(geometry.get("type")))):
        geometry = {**geometry, "coordinates": _closed(geometry.get("coordinates"), depth)}
    try:
        shape = shapely.from_geojson(json.dumps(geometry))
    except (shapely.errors.ShapelyError, ValueError, TypeError) as error:
        raise InvalidFloorPlanError(
            f"the geometry of {where} is not a GeoJSON geometry: it must have a known 'type', and 'coordinates' that "
            "are lists of numbers; export it again"
        ) from error
    if shape is None or shape.is_empty:
        return
    shape = shapely.force_2d(shape)
    # A position of one number has no y.
    check_coordinates(shapely.get_coordinates(shape), f"the geometry of {where}")
    given = raw.get("properties")
    properties = dict(given) if isinstance(given, Mapping) else {}
    # Shapefiles have names of ten capitals.
    properties = {str(key).casefold(): value for key, value in properties.items()} | properties
    # Some converters of OpenStreetMap data nest its tags.
    if isinstance(properties.get("tags"), Mapping):
        properties = properties["tags"] | {"id": properties.get("id", raw.get("id"))}
    if isinstance(raw.get("feature_type"), str):
        properties["feature_type"] = raw["feature_type"]
    identity = raw.get("id", properties.get("id"))
    yield Feature(shape, properties, str(identity)[:200] if isinstance(identity, str | int) else None)


def _closed(parts: Any, depth: int) -> Any:
    """Return rings, or lists of them, with their first position at the end, which some programs leave out."""
    if not isinstance(parts, list):
        return parts
    if depth:
        return [_closed(part, depth - 1) for part in parts]
    return [*parts, parts[0]] if len(parts) > 2 and parts[0] != parts[-1] else parts


def _count_numbers(value: Any, where: str) -> int:
    pending, count = [value], 0
    while pending:
        item = pending.pop()
        if isinstance(item, Mapping):
            pending.extend(item.values())
        elif isinstance(item, list):
            pending.extend(item)
        else:
            if is_number(item) and not abs(item) <= MAX_COORDINATE:
                raise InvalidFloorPlanError(
                    f"the geometry of {where} has the number {str(item)[:50]}; the limit is {MAX_COORDINATE:g} to "
                    "either side; correct it, and export the file again"
                )
            count += 1
    return count


def _crs(document: Any) -> str | None:
    """Return the code in the legacy member `crs` ("urn:ogc:def:crs:EPSG::25832"), None for WGS84."""
    crs = document.get("crs") if isinstance(document, Mapping) else None
    properties = crs.get("properties") if isinstance(crs, Mapping) else None
    name = properties.get("name") if isinstance(properties, Mapping) else None
    if not isinstance(name, str) or "CRS84" in name or name.endswith(":4326"):
        return "OGC:CRS84" if "CRS84" in str(name) else None
    digits = name.replace("/", ":").rpartition(":")[2]
    if not digits.isascii() or not digits.isdigit() or len(digits) > 6:
        raise InvalidFloorPlanError(f"the crs '{name[:100]}' is not an EPSG code; export the file in WGS84")
    return f"EPSG:{digits}"


def file_points(points_m: Sequence[Sequence[float]], anchor: Anchor | None) -> list[list[float]]:
    """Return points of a plan in the coordinates of a file: WGS84 with an anchor, else metres."""
    array = np.asarray(points_m, dtype=float)
    return (array.round(6) if anchor is None else anchor.to_earth(array).round(_DECIMALS)).tolist()


def file_rings(rings: Sequence[Sequence[Sequence[float]]], anchor: Anchor | None) -> list[list[list[float]]]:
    """Return closed rings in the coordinates of a file, see `file_points`."""
    return [file_points([*ring, ring[0]], anchor) for ring in rings]


def plan_features(document: Mapping[str, Any], anchor: Anchor | None) -> list[dict[str, Any]]:
    """Return the rooms, walls and openings of a plan as GeoJSON features with an IMDF `feature_type`."""
    found: list[dict[str, Any]] = []
    for number, room in enumerate(document["rooms"]):
        properties = {"feature_type": "unit", "name": room.get("name", f"room {number + 1}")}
        keys = ("type", "types", "ceiling_height_m")
        properties |= {key: room[key] for key in keys if key in room and room[key] != "unknown"}
        if (ceiling_m := document.get("ceiling_height_m")) is not None:
            properties.setdefault("ceiling_height_m", ceiling_m)
        rings = file_rings([room["polygon"], *room.get("holes", ())], anchor)
        feature = _to_feature("Polygon", rings, properties)
        if "id" in room:
            feature["id"] = room["id"]
        found.append(feature)
        for wall in room.get("walls", ()):
            found.append(_to_feature("LineString", file_points(wall, anchor), {"feature_type": "wall"}))
    for opening in document.get("openings", ()):
        properties = {"feature_type": "opening"} | {
            key: opening[key] for key in ("kind", "name", "sill_m", "head_m") if key in opening
        }
        found.append(_to_feature("LineString", file_points(opening["line"], anchor), properties))
    return found


def _to_feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}
