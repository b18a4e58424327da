"""Plans as GeoJSON features, which GeoJSON files and IMDF archives contain."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lalaloc_core.floorplan.earth import Anchor, LocalFrame

# Decimals of exported degrees; the ninth is a tenth of a millimetre.
_DECIMALS = 9


class Projector:
    """Conversion from plan metres to the coordinates of a file: WGS84 with an anchor, else metres."""

    def __init__(self, anchor: Anchor | None) -> None:
        self._frame = None if anchor is None else LocalFrame(anchor.longitude, anchor.latitude)
        turn = math.radians(0.0 if anchor is None else anchor.north_deg)
        self._east = np.array([math.cos(turn), -math.sin(turn)])
        self._north = np.array([math.sin(turn), math.cos(turn)])

    def points(self, points_m: Sequence[Sequence[float]]) -> list[list[float]]:
        """Return points in file coordinates."""
        array = np.asarray(points_m, dtype=float)
        if self._frame is None:
            return array.round(6).tolist()
        local = np.column_stack([array @ self._east, array @ self._north])
        return self._frame.to_earth(local).round(_DECIMALS).tolist()

    def polygon(self, rings: Sequence[Sequence[Sequence[float]]]) -> list[list[list[float]]]:
        """Return closed rings in file coordinates."""
        return [self.points([*ring, ring[0]]) for ring in rings]


def plan_features(document: Mapping[str, Any], projector: Projector) -> list[dict[str, Any]]:
    """Return the rooms, walls and openings of a plan as GeoJSON features with an IMDF `feature_type`."""
    found: list[dict[str, Any]] = []
    for number, room in enumerate(document["rooms"]):
        properties = {"feature_type": "unit", "name": room.get("name", f"room {number + 1}")}
        properties |= {key: room[key] for key in ("type", "ceiling_height_m") if key in room and room[key] != "unknown"}
        properties.setdefault("ceiling_height_m", document.get("ceiling_height_m"))
        rings = projector.polygon([room["polygon"], *room.get("holes", ())])
        feature = _to_feature("Polygon", rings, properties)
        if "id" in room:
            feature["id"] = room["id"]
        found.append(feature)
        for wall in room.get("walls", ()):
            found.append(_to_feature("LineString", projector.points(wall), {"feature_type": "wall"}))
    for opening in document.get("openings", ()):
        properties = {"feature_type": "opening"} | {
            key: opening[key] for key in ("kind", "name", "sill_m", "head_m") if key in opening
        }
        found.append(_to_feature("LineString", projector.points(opening["line"]), properties))
    return found


def _to_feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}
