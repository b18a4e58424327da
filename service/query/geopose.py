"""Poses on Earth, of plans with an anchor."""

from __future__ import annotations

from typing import Any

import numpy as np

from lalaloc_core.floorplan import FloorPlan
from service.schemas import GeoPose, GeoPoseAngles, GeoPosePosition, LocaliseAnswer

# Nine decimals of a degree are a tenth of a millimetre.
_DECIMALS = 9


def geopose_of(
    plan: FloorPlan, position_m: tuple[float, float], heading_deg: float, camera_height_m: float
) -> GeoPose | None:
    """A pose of the plan frame on Earth; None for a plan without an anchor.

    The camera's own axes are x to its right, y where its centre column looks, z up: one that looks north is not turned
    at all. The standard leaves that open; AR clients of the OSCP GeoPose protocol have them so.
    """
    anchor = plan.anchor
    if anchor is None:
        return None
    ((longitude, latitude),) = anchor.to_earth(np.array([position_m], dtype=float))
    azimuth_deg = anchor.true_azimuth_deg(position_m, heading_deg)
    yaw_deg = round(-azimuth_deg if azimuth_deg < 180.0 else 360.0 - azimuth_deg, 4) + 0.0
    return GeoPose(
        position=GeoPosePosition(
            lat=round(float(latitude), _DECIMALS),
            lon=round(float(longitude), _DECIMALS),
            h=round((anchor.altitude_m or 0.0) + camera_height_m, 3),
        ),
        angles=GeoPoseAngles(yaw=yaw_deg, pitch=0.0, roll=0.0),
    )


def feature_of(answer: LocaliseAnswer) -> dict[str, Any] | None:
    """An answer as a GeoJSON Feature (RFC 7946) with the answer as its properties; None without a place on Earth."""
    if answer.geopose is None:
        return None
    place = answer.geopose.position
    geometry = {"type": "Point", "coordinates": [place.lon, place.lat, place.h]}
    return {"type": "Feature", "geometry": geometry, "properties": answer.model_dump(mode="json")}
