"""Poses on Earth, for plans with an anchor."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lalaloc_core.floorplan.earth import Anchor
from service.schemas import GeoPose, GeoPoseAngles, GeoPosePosition, LocaliseAnswer, SequenceAnswer
from service.schemas.sessions import TrackedPoseAnswer

# Nine decimals of a degree are a tenth of a millimetre.
_DECIMALS = 9


def geopose_at(
    anchor: Anchor | None, position_m: tuple[float, float], heading_deg: float, camera_height_m: float
) -> GeoPose | None:
    """Return a pose of the plan's frame on Earth; None without an anchor.

    The camera's axes are x to its right, y towards its centre column and z up, so the angles of a camera that looks
    north are zero. The standard leaves the axes open.
    """
    if anchor is None:
        return None
    ((longitude, latitude),) = anchor.to_earth(np.array([position_m], dtype=float))
    # Rounded first: a yaw of -180° is written as 180°.
    azimuth_deg = round(anchor.true_azimuth_deg(position_m, heading_deg), 4)
    yaw_deg = round(-azimuth_deg if azimuth_deg < 180.0 else 360.0 - azimuth_deg, 4) + 0.0
    return GeoPose(
        position=GeoPosePosition(
            lat=round(float(latitude), _DECIMALS),
            lon=round(float(longitude), _DECIMALS),
            h=round((anchor.altitude_m or 0.0) + camera_height_m, 3),
        ),
        angles=GeoPoseAngles(yaw=yaw_deg, pitch=0.0, roll=0.0),
    )


def geopose_document(answer: LocaliseAnswer | TrackedPoseAnswer) -> dict[str, Any] | None:
    """Return the pose of an answer as a document of OGC GeoPose 1.0, Basic-Quaternion; None without a geopose."""
    return None if answer.geopose is None else _basic_quaternion(answer.geopose)


def geopose_documents(answer: SequenceAnswer) -> list[dict[str, Any]] | None:
    """Return the poses of a sequence in order, each as by `geopose_document`; None unless all have one."""
    geoposes = [pose.geopose for pose in answer.poses if pose.geopose is not None]
    if len(geoposes) < len(answer.poses):
        return None
    return [_basic_quaternion(geopose) for geopose in geoposes]


def geojson_feature(answer: LocaliseAnswer) -> dict[str, Any] | None:
    """Return an answer as a GeoJSON Feature (RFC 7946) with the answer as properties; None without a geopose."""
    if answer.geopose is None:
        return None
    return _feature(answer.geopose, answer.model_dump(mode="json"))


def geojson_features(answer: SequenceAnswer) -> dict[str, Any] | None:
    """Return an answer as a GeoJSON FeatureCollection (RFC 7946), one Feature for each pose; None without geoposes.

    Fields about the whole sequence stand beside `features`.
    """
    common = answer.model_dump(mode="json", exclude={"poses"})
    features = [_feature(pose.geopose, pose.model_dump(mode="json")) for pose in answer.poses if pose.geopose]
    return {"type": "FeatureCollection", "features": features, **common} if features else None


def _basic_quaternion(geopose: GeoPose) -> dict[str, Any]:
    """Return a pose as Basic-Quaternion of OGC GeoPose 1.0: the rotation of Basic-YPR about up as a quaternion."""
    half = 0.5 * math.radians(geopose.angles.yaw)
    quaternion = {"x": 0.0, "y": 0.0, "z": round(math.sin(half), 9) + 0.0, "w": round(math.cos(half), 9) + 0.0}
    return {"position": geopose.position.model_dump(mode="json"), "quaternion": quaternion}


def _feature(geopose: GeoPose, properties: dict[str, Any]) -> dict[str, Any]:
    place = geopose.position
    geometry = {"type": "Point", "coordinates": [place.lon, place.lat, place.h]}
    return {"type": "Feature", "geometry": geometry, "properties": properties}
