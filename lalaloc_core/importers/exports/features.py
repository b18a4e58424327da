"""GeoJSON and IMDF."""

from __future__ import annotations

import io
import json
import math
import uuid
import zipfile
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import Anchor, LocalFrame

# Nine decimals of a degree are a tenth of a millimetre.
_DECIMALS = 9
_EPOCH = (2000, 1, 1, 0, 0, 0)
_CATEGORIES = {
    "corridor": "walkway",
    "bathroom": "restroom",
    "stairs": "stairs",
    "office": "office",
    "kitchen": "kitchen",
    "meeting": "conferenceroom",
    "storage": "storage",
    "entrance": "lobby",
}
_NAMESPACE = uuid.UUID("2f6c1d58-2d0e-5c7e-9a41-6b0f6f1e7c11")


def to_geojson(document: Mapping[str, Any], anchor: Anchor | None) -> bytes:
    """A FeatureCollection: WGS84 with an anchor, else the plan's own metres, which `units` says.

    Args:
        document: a valid plan in the native format.
        anchor: where the plan's origin lies.
    """
    features = _features(document, _Placing(anchor))
    collection: dict[str, Any] = {"type": "FeatureCollection", "name": document.get("name", "floor plan")}
    if anchor is None:
        collection["units"] = "m"
    return json.dumps(collection | {"features": features}, ensure_ascii=False).encode()


def to_imdf(document: Mapping[str, Any], anchor: Anchor | None) -> bytes:
    """An IMDF 1.0 archive of one level: units and openings, with the venue, building and level they need.

    Windows are no openings in IMDF; they carry `kind`, as other readers ignore.

    Raises:
        InvalidFloorPlanError: no anchor, without which IMDF has no coordinates.
    """
    if anchor is None:
        raise InvalidFloorPlanError("IMDF needs to know where on Earth the plan lies: give its anchor")
    placing = _Placing(anchor)
    name = str(document.get("name", "floor plan"))
    ids = {kind: str(uuid.uuid5(_NAMESPACE, f"{kind}/{name}")) for kind in ("venue", "building", "level", "footprint")}
    by_type: dict[str, list[dict[str, Any]]] = {"unit": [], "opening": []}
    for number, feature in enumerate(_features(document, placing)):
        kind = feature["properties"].pop("feature_type")
        says = feature["properties"] | {"level_id": ids["level"]}
        if kind == "unit":
            says["category"] = _CATEGORIES.get(says.get("type", ""), "room")
            says["name"] = {"en": says["name"]}
        elif kind == "opening":
            says["category"] = "pedestrian"
            says["door"] = {"type": "door"} if says["kind"] == "door" else None
        else:
            continue  # Free-standing walls: IMDF has nothing that is a line and no opening.
        key = feature.get("id") or f"{kind}-{number}"
        by_type[kind].append(
            {
                "id": str(uuid.uuid5(_NAMESPACE, f"{name}/{key}")),
                "type": "Feature",
                "feature_type": kind,
                "geometry": feature["geometry"],
                "properties": says,
            }
        )
    outline = placing.polygon([_box(document)])
    around = {"venue": {"category": "unspecified", "name": {"en": name}, "address_id": None},
              "building": {"category": "unspecified", "name": {"en": name}, "address_id": None},
              "footprint": {"category": "ground", "name": None, "building_ids": [ids["building"]]},
              "level": {"category": "unspecified", "ordinal": 0, "outdoor": False, "short_name": {"en": "0"},
                        "name": {"en": name}, "building_ids": [ids["building"]]}}  # fmt: skip
    for kind, says in around.items():
        geometry = None if kind == "building" else {"type": "Polygon", "coordinates": outline}
        by_type[kind] = [
            {"id": ids[kind], "type": "Feature", "feature_type": kind, "geometry": geometry, "properties": says}
        ]
    return _archive(by_type)


def _archive(by_type: Mapping[str, Sequence[Mapping[str, Any]]]) -> bytes:
    """The same bytes for the same plan: files carry no time."""
    files: dict[str, Any] = {"manifest.json": {"version": "1.0.0", "language": "en", "generated_by": "lalaloc"}}
    for kind, features in by_type.items():
        files[f"{kind}.geojson"] = {"type": "FeatureCollection", "features": list(features)}
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), json.dumps(content, ensure_ascii=False))
    return stream.getvalue()


class _Placing:
    """From plan metres to a file's coordinates."""

    def __init__(self, anchor: Anchor | None) -> None:
        self._frame = None if anchor is None else LocalFrame(anchor.longitude, anchor.latitude)
        turn = math.radians(0.0 if anchor is None else anchor.north_deg)
        self._east, self._north = (
            np.array([math.cos(turn), -math.sin(turn)]),
            np.array([math.sin(turn), math.cos(turn)]),
        )

    def points(self, points_m: Sequence[Sequence[float]]) -> list[list[float]]:
        array = np.asarray(points_m, dtype=float)
        if self._frame is None:
            return array.round(6).tolist()
        local = np.column_stack([array @ self._east, array @ self._north])
        return self._frame.to_earth(local).round(_DECIMALS).tolist()

    def polygon(self, rings: Sequence[Sequence[Sequence[float]]]) -> list[list[list[float]]]:
        return [self.points([*ring, ring[0]]) for ring in rings]


def _features(document: Mapping[str, Any], placing: _Placing) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for number, room in enumerate(document["rooms"]):
        says = {"feature_type": "unit", "name": room.get("name", f"room {number + 1}")}
        says |= {key: room[key] for key in ("type", "ceiling_height_m") if key in room and room[key] != "unknown"}
        says.setdefault("ceiling_height_m", document.get("ceiling_height_m"))
        rings = placing.polygon([room["polygon"], *room.get("holes", ())])
        feature = _feature("Polygon", rings, says)
        if "id" in room:
            feature["id"] = room["id"]
        found.append(feature)
        for wall in room.get("walls", ()):
            found.append(_feature("LineString", placing.points(wall), {"feature_type": "wall"}))
    for opening in document.get("openings", ()):
        says = {"feature_type": "opening"} | {
            key: opening[key] for key in ("kind", "name", "sill_m", "head_m") if key in opening
        }
        found.append(_feature("LineString", placing.points(opening["line"]), says))
    return found


def _feature(kind: str, coordinates: Any, says: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": says}


def _box(document: Mapping[str, Any]) -> list[list[float]]:
    corners = np.concatenate([np.asarray(room["polygon"], dtype=float) for room in document["rooms"]])
    (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
    return [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]
