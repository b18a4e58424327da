"""Poses on Earth, of plans with an anchor."""

from __future__ import annotations

from typing import Any

import numpy as np

from lalaloc_core.floorplan import MAX_FROM_ORIGIN_M, FloorPlan
from lalaloc_core.floorplan.earth import Anchor
from service.schemas import GeoPose, GeoPoseAngles, GeoPosePosition, LocaliseAnswer, SequenceAnswer

# Nine decimals of a degree are a tenth of a millimetre.
_DECIMALS = 9


def anchor_of(plan: FloorPlan, of_venue: Anchor | None = None) -> Anchor | None:
    """Where on Earth a plan lies: its own anchor says so, else that of the venue that was asked about.

    None without either, and for a plan so far from the venue's origin that it would be drawn out.
    """
    if plan.anchor is not None or of_venue is None:
        return plan.anchor
    return of_venue if float(np.abs(plan.bounds_m).max()) <= MAX_FROM_ORIGIN_M else None


def geopose_of(
    anchor: Anchor | None, position_m: tuple[float, float], heading_deg: float, camera_height_m: float
) -> GeoPose | None:
    """A pose of the frame of a plan with an anchor on Earth; None for one without.

    The camera's own axes are x to its right, y where its centre column looks, z up: one that looks north is not turned
    at all. The standard leaves that open; AR clients of the OSCP GeoPose protocol have them so.
    """
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


def features_of(answer: SequenceAnswer) -> dict[str, Any] | None:
    """An answer as a GeoJSON FeatureCollection (RFC 7946), a Feature for each pose; None without places on Earth.

    What is said of all poses together stands beside the features.
    """
    told = answer.model_dump(mode="json", exclude={"poses"})
    features = [_feature(pose.geopose, pose.model_dump(mode="json")) for pose in answer.poses if pose.geopose]
    return {"type": "FeatureCollection", "features": features, **told} if features else None


def feature_of(answer: LocaliseAnswer) -> dict[str, Any] | None:
    """An answer as a GeoJSON Feature (RFC 7946) with the answer as its properties; None without a place on Earth."""
    if answer.geopose is None:
        return None
    return _feature(answer.geopose, answer.model_dump(mode="json"))


def _feature(geopose: GeoPose, properties: dict[str, Any]) -> dict[str, Any]:
    place = geopose.position
    geometry = {"type": "Point", "coordinates": [place.lon, place.lat, place.h]}
    return {"type": "Feature", "geometry": geometry, "properties": properties}
