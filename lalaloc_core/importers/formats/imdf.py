"""IMDF 1.0 (Indoor Mapping Data Format): a zip archive of GeoJSON files by feature type, with a manifest."""

from __future__ import annotations

import json
import uuid
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import shapely

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.floorplan.json_values import read_json
from lalaloc_core.importers.common import Budget, ImportedPlan, ImportOptions, Level
from lalaloc_core.importers.common.bounded_files import pack
from lalaloc_core.importers.common.tagged_features import import_features, in_english
from lalaloc_core.importers.formats.geojson import file_rings, parse_features, plan_features

_FEATURE_TYPES = ("unit", "opening", "fixture", "kiosk")
_NAMESPACE = uuid.UUID("2f6c1d58-2d0e-5c7e-9a41-6b0f6f1e7c11")
_CATEGORIES = {"corridor": "walkway", "bathroom": "restroom", "stairs": "stairs", "office": "office",
               "kitchen": "kitchen", "meeting": "conferenceroom", "storage": "storage",
               "entrance": "lobby"}  # fmt: skip


def read(files: Mapping[str, bytes], options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read one plan per level of an archive, lowest first."""
    by_type = {name.rpartition("/")[2].partition(".")[0].casefold(): name for name in files}
    if "unit" not in by_type:
        found = ", ".join(sorted(files)[:10]) or "no GeoJSON at all"
        raise InvalidFloorPlanError(f"the archive has no unit.geojson, it has {found}; send IMDF or one IFC model")
    # The standard requires the type in every feature; some tools give it in the file's name only.
    features = [
        replace(feature, properties={"feature_type": kind} | dict(feature.properties))
        for kind in _FEATURE_TYPES
        if kind in by_type
        for feature in parse_features(_read_member(files, by_type[kind], budget), budget)
    ]
    levels = _levels(_read_member(files, by_type["level"], budget)) if "level" in by_type else {}
    return import_features(features, None, "imdf", options, budget, levels)


def write(document: Mapping[str, Any], anchor: Anchor | None) -> bytes:
    """Return an IMDF archive of one level with its venue, building, units and openings.

    IMDF has no windows: they are openings with the additional property `kind`, which other readers ignore.
    """
    if anchor is None:
        raise InvalidFloorPlanError("IMDF requires the place of the plan on Earth; set its anchor")
    name = str(document.get("name", "floor plan"))
    ids = {kind: str(uuid.uuid5(_NAMESPACE, f"{kind}/{name}")) for kind in ("venue", "building", "level", "footprint")}
    by_type: dict[str, list[dict[str, Any]]] = {"unit": [], "opening": []}
    for number, feature in enumerate(plan_features(document, anchor)):
        kind = feature["properties"].pop("feature_type")
        properties = feature["properties"] | {"level_id": ids["level"]}
        if kind == "unit":
            properties["category"] = _CATEGORIES.get(properties.get("type", ""), "room")
            properties["name"] = {"en": properties["name"]}
        elif kind == "opening":
            properties["category"] = "pedestrian"
            properties["door"] = {"type": "door"} if properties["kind"] == "door" else None
        else:
            continue  # IMDF has no feature type for free-standing walls.
        key = feature.get("id") or f"{kind}-{number}"
        own_id = str(uuid.uuid5(_NAMESPACE, f"{name}/{key}"))
        by_type[kind].append(_feature(kind, own_id, feature["geometry"], properties))
    x0, y0, x1, y1 = shapely.total_bounds([shapely.Polygon(room["polygon"]) for room in document["rooms"]])
    outline = file_rings([[[x0, y0], [x1, y0], [x1, y1], [x0, y1]]], anchor)
    site = {"category": "unspecified", "name": {"en": name}, "address_id": None}
    context = {"venue": site, "building": site,
               "footprint": {"category": "ground", "name": None, "building_ids": [ids["building"]]},
               "level": {"category": "unspecified", "ordinal": 0, "outdoor": False, "short_name": {"en": "0"},
                         "name": {"en": name}, "building_ids": [ids["building"]]}}  # fmt: skip
    for kind, properties in context.items():
        geometry = None if kind == "building" else {"type": "Polygon", "coordinates": outline}
        by_type[kind] = [_feature(kind, ids[kind], geometry, properties)]
    files: dict[str, Any] = {"manifest.json": {"version": "1.0.0", "language": "en", "generated_by": "lalaloc"}}
    files |= {f"{kind}.geojson": {"type": "FeatureCollection", "features": found} for kind, found in by_type.items()}
    return pack({name: json.dumps(content, ensure_ascii=False).encode() for name, content in files.items()})


def _feature(kind: str, own_id: str, geometry: Any, properties: Mapping[str, Any]) -> dict[str, Any]:
    return {"id": own_id, "type": "Feature", "feature_type": kind, "geometry": geometry, "properties": properties}


def _read_member(files: Mapping[str, bytes], name: str, budget: Budget) -> Any:
    try:
        return read_json(files[name], budget.limits.max_depth, budget.limits.max_json_values)
    except InvalidFloorPlanError as error:
        raise InvalidFloorPlanError(f"'{name[:100]}': {error.reason}") from error


def _levels(document: Any) -> dict[str, Level]:
    found: dict[str, Level] = {}
    features = document.get("features") if isinstance(document, Mapping) else None
    for feature in features if isinstance(features, list) else []:
        properties = feature.get("properties") if isinstance(feature, Mapping) else None
        if isinstance(properties, Mapping) and isinstance(feature.get("id"), str):
            ordinal = properties.get("ordinal")
            number = float(ordinal) if isinstance(ordinal, int | float) and abs(ordinal) < 1e6 else None
            name = _text(properties.get("name")) or _text(properties.get("short_name")) or f"{ordinal}"
            found[feature["id"]] = Level(name, number)
    return found


def _text(value: Any) -> str | None:
    value = in_english(value)
    return value[:200] if isinstance(value, str) and value.strip() else None
