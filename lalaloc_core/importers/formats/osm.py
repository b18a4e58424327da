"""OpenStreetMap: XML, and the JSON of the Overpass API, with Simple Indoor Tagging.

Rooms are closed ways or multipolygons with `indoor=room`, `corridor` or `area`; doors and windows are nodes on them or
ways along them. https://wiki.openstreetmap.org/wiki/Simple_Indoor_Tagging
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import Element

import shapely
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.json_values import is_number
from lalaloc_core.importers.common import Budget, ImportedPlan, ImportOptions
from lalaloc_core.importers.common.bounded_files import read_xml
from lalaloc_core.importers.common.geometry import check_network, polygons_of
from lalaloc_core.importers.common.import_options import to_number
from lalaloc_core.importers.common.tagged_features import Feature, import_features

_Position = tuple[float, float]
_KINDS = ("node", "way", "relation")


def read(source: bytes | Mapping[str, Any], options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read one plan per level of an OSM XML file, or of the parsed JSON of Overpass."""
    elements = _from_xml(source, budget) if isinstance(source, bytes) else source.get("elements")
    if not isinstance(elements, list) or not all(isinstance(element, Mapping) for element in elements):
        raise InvalidFloorPlanError("'elements' must be a list of objects; export the file from Overpass again")
    features = list(_features(elements, budget))
    if not any("indoor" in feature.properties for feature in features):
        raise InvalidFloorPlanError(
            "the OpenStreetMap file has no way with the tag 'indoor'; download the rooms too, for example with the "
            "Overpass query: (way[indoor]({{bbox}}); node(w);); out;"
        )
    return import_features(features, None, "osm", options, budget)


def _from_xml(content: bytes, budget: Budget) -> list[dict[str, Any]]:
    """Return the elements of OSM XML in the structure of Overpass JSON."""
    return [
        {
            "type": child.tag,
            "id": child.get("id"),
            "lat": _decimal(child, "lat"),
            "lon": _decimal(child, "lon"),
            "tags": {str(tag.get("k")): str(tag.get("v")) for tag in child.iter("tag")},
            "nodes": [node.get("ref") for node in child.iter("nd")],
            "members": [dict(member.attrib) for member in child.iter("member")],
        }
        for child in read_xml(content, budget)
        if child.tag in _KINDS
    ]


def _decimal(element: Element, key: str) -> float | None:
    text = element.get(key)
    if text is not None and math.isnan(to_number(text)):
        raise InvalidFloorPlanError(
            f"{element.tag} {str(element.get('id'))[:20]} has {key} '{text[:50]}'; it must be a number of degrees"
        )
    return None if text is None else to_number(text)


def _features(elements: Sequence[Mapping[str, Any]], budget: Budget) -> Iterator[Feature]:
    nodes = {element.get("id"): position for element in elements if (position := _position(element)) is not None}
    lines = {element.get("id"): _line(element, nodes, budget) for element in elements if element.get("type") == "way"}
    for element in elements:
        budget.spend()
        tags = element.get("tags")
        if not isinstance(tags, Mapping) or not tags:
            continue
        kind, key = element.get("type"), element.get("id")
        shape: BaseGeometry | None = None
        if kind == "node" and key in nodes:
            shape = shapely.Point(nodes[key])
        elif kind == "way":
            shape = _way_shape(lines[key], tags)
        elif kind == "relation" and tags.get("type") == "multipolygon":
            shape = _multipolygon(element, lines, budget)
        if shape is not None:
            # The tag `type` of a relation says nothing about the room.
            yield Feature(shape, {name: value for name, value in tags.items() if name != "type"}, f"{kind}/{key}")


def _position(element: Any) -> _Position | None:
    if not isinstance(element, Mapping) or not is_number(element.get("lat")) or not is_number(element.get("lon")):
        return None
    for key, limit in (("lat", 90), ("lon", 180)):
        if not abs(element[key]) <= limit:
            raise InvalidFloorPlanError(
                f"a position of the OpenStreetMap file has {key} {str(element[key])[:50]}; it must be a number from "
                f"-{limit} to {limit}"
            )
    return float(element["lon"]), float(element["lat"])


def _line(element: Mapping[str, Any], nodes: Mapping[Any, _Position], budget: Budget) -> list[_Position]:
    """Return the positions of a way: those of its nodes, else those that `out geom` adds."""
    keys, geometry = element.get("nodes"), element.get("geometry")
    points = [nodes.get(key) for key in keys if isinstance(key, str | int)] if isinstance(keys, list) else []
    if None in points or not points:
        points = [_position(point) for point in geometry] if isinstance(geometry, list) else []
    budget.spend(len(points))
    return [point for point in points if point is not None]


def _way_shape(points: list[_Position], tags: Mapping[str, Any]) -> BaseGeometry | None:
    is_line = tags.get("indoor") in ("wall", "door") or "door" in tags or "window" in tags
    if len(points) >= 4 and points[0] == points[-1] and (not is_line or tags.get("area") == "yes"):
        return shapely.Polygon(points)
    return shapely.LineString(points) if len(points) >= 2 else None


def _multipolygon(raw: Mapping[str, Any], lines: Mapping[Any, list[_Position]], budget: Budget) -> BaseGeometry | None:
    """Return the area of a relation; its rings can be divided into several ways."""
    members = raw.get("members")
    rings: dict[bool, list[shapely.LineString]] = {True: [], False: []}
    for member in members if isinstance(members, list) else []:
        if isinstance(member, Mapping) and member.get("type") == "way":
            points = lines.get(member.get("ref"), [])
            # A way can be a part of many relations.
            budget.spend(len(points))
            points = _line(member, {}, budget) if len(points) < 2 else points
            if len(points) >= 2:
                rings[member.get("role") == "inner"].append(shapely.LineString(points))
    for role in (False, True):
        check_network(rings[role])
    outer, inner = (shapely.union_all(shapely.get_parts(shapely.polygonize(rings[role]))) for role in (False, True))
    area = shapely.difference(outer, inner)
    return shapely.MultiPolygon(parts) if (parts := polygons_of(area)) else None
