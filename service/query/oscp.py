"""Requests and answers of the OSCP GeoPose protocol, translated to and from this service's own."""

from __future__ import annotations

import base64
import binascii
import math

import numpy as np
import shapely

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.earth import LocalFrame
from lalaloc_core.localise.belief import HEADING_WITHIN, RIGHT_WITHIN_M
from lalaloc_core.localise.query import RADIUS_RANGE_M
from service.errors import InvalidRequestError, UnanchoredPlanError
from service.query.geopose import basic_quaternion
from service.schemas import EarthPoint, GeoPose, LocaliseAnswer
from service.schemas.oscp import OscpAccuracy, OscpAnswer, OscpFound, OscpGeolocationReading, OscpRequest

# Radius (m) for a reading without an accuracy.
UNKNOWN_ACCURACY_M = 100.0
_UNKNOWN = {"", "UNKNOWN", "UNKNOWN_CAMERA"}
_SPHERES = {"EQUIRECTANGULAR", "SPHERICAL"}
# Parameters of camera models, in the protocol's order; f is both fx and fy.
_CAMERAS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
_READING = "sensorReadings.cameraReadings.0"


def decode_picture(request: OscpRequest) -> bytes:
    """Return the picture file of a request."""
    reading, faults = request.camera_reading, list[tuple[str, str]]()
    if not any(sensor.id == reading.sensor_id and sensor.type == "camera" for sensor in request.sensors):
        faults.append((f"{_READING}.sensorId", f"is '{reading.sensor_id[:50]}', sensors has no camera with this id"))
    if reading.image_format.upper() == "DEPTH":
        faults.append((f"{_READING}.imageFormat", "is 'DEPTH', a photograph in colours is needed"))
    orientation = reading.image_orientation
    if orientation is not None and (orientation.mirrored or orientation.rotation % 360.0):
        faults.append(
            (f"{_READING}.imageOrientation", "must be neither mirrored nor rotated: send the picture upright")
        )
    try:
        content = base64.b64decode(reading.image_bytes, validate=True)
    except (binascii.Error, ValueError):
        content = b""
        faults.append((f"{_READING}.imageBytes", "is not Base64"))
    if faults:
        raise InvalidRequestError(faults)
    return content


def camera_fields(request: OscpRequest) -> dict[str, object]:
    """Return the camera of a request as fields of `LocaliseForm`."""
    params = request.camera_reading.params
    model = "" if params is None else (params.model or "").upper()
    if model in _UNKNOWN:
        return {}
    if model in _SPHERES:
        return {"projection": "equirectangular"}
    names = _CAMERAS.get(model)
    if names is None:
        known = ", ".join(sorted(_SPHERES | _CAMERAS.keys()))
        raise InvalidRequestError([(f"{_READING}.params.model", f"is '{model[:50]}'; known models: {known}")])
    assert params is not None
    values = params.model_params or []
    if len(values) != len(names):
        fault = f"has {len(values)} items, {model} needs {len(names)}: {', '.join(names)}"
        raise InvalidRequestError([(f"{_READING}.params.modelParams", fault)])
    stated = dict(zip(names, values, strict=True))
    if "f" in stated:
        stated["fx"] = stated["fy"] = stated.pop("f")
    return {"projection": "fisheye" if model == "OPENCV_FISHEYE" else "perspective", "intrinsics": stated}


def without_picture(request: OscpRequest) -> OscpRequest:
    """Return a request without its picture in Base64, which is large."""
    reading = request.camera_reading.model_copy(update={"image_bytes": ""})
    readings = request.sensor_readings.model_copy(update={"camera_readings": [reading]})
    return request.model_copy(update={"sensor_readings": readings})


def reading_place(reading: OscpGeolocationReading) -> tuple[EarthPoint, float]:
    """Return the place of a geolocation reading, and its accuracy as a radius (m)."""
    known = reading.accuracy is not None and reading.accuracy > 0.0
    radius_m = min(max(reading.accuracy or 0.0, RADIUS_RANGE_M[0]), RADIUS_RANGE_M[1]) if known else UNKNOWN_ACCURACY_M
    return EarthPoint(latitude=reading.latitude, longitude=reading.longitude), radius_m


def distance_to_plan_m(place: EarthPoint, plan: FloorPlan) -> float:
    """Return the distance (m) from a place on Earth to the nearest room of an anchored plan."""
    assert plan.anchor is not None
    ((x_m, y_m),) = plan.anchor.to_plan(np.array([[place.longitude, place.latitude]]))
    if not (math.isfinite(x_m) and math.isfinite(y_m)):
        return math.inf
    return min(float(shapely.distance(shapely.Polygon(room.polygon_m), shapely.Point(x_m, y_m))) for room in plan.rooms)


def unused_warnings(request: OscpRequest) -> list[str]:
    """Return a warning for every part of the request that the service does not use."""
    found = [f"{name} are not used" for name in request.sensor_readings.unused]
    return [*found, "priorPoses are not used"] if request.prior_poses else found


def compose_oscp_answer(request: OscpRequest, found: LocaliseAnswer, warnings: list[str]) -> OscpAnswer:
    """Translate an answer into the protocol.

    Args:
        request: the request.
        found: the service's own answer.
        warnings: warnings besides those of the answer.
    """
    if found.geopose is None:
        raise UnanchoredPlanError(found.floorplan_id, found.venue_id)
    return OscpAnswer(
        id=request.id,
        timestamp=request.timestamp,
        accuracy=_accuracy(found, found.geopose),
        geopose=basic_quaternion(found.geopose),
        lalaloc=OscpFound(
            floorplan_id=found.floorplan_id,
            level=found.level,
            position=found.position,
            heading_deg=found.heading_deg,
            room=found.room,
            room_id=found.room_id,
            confidence=found.confidence,
            warnings=[*warnings, *found.warnings],
        ),
    )


def _accuracy(found: LocaliseAnswer, answer: GeoPose) -> OscpAccuracy:
    """Combine the covariance, or else the tolerances of a right answer, with the spread of the rival candidates."""
    variance_m2 = RIGHT_WITHIN_M**2
    if found.covariance_m2 is not None:
        variance_m2 = found.covariance_m2[0][0] + found.covariance_m2[1][1]
    std_deg = math.degrees(HEADING_WITHIN) if found.heading_std_deg is None else found.heading_std_deg
    rivals = [(rival.geopose, rival.probability) for rival in found.candidates if rival.geopose and rival.probability]
    weight = sum(probability for _, probability in rivals)
    squared_m2 = squared_deg2 = 0.0
    if weight > 0.0:
        lon_lat = np.array([[pose.position.lon, pose.position.lat] for pose, _ in rivals])
        frame = LocalFrame(answer.position.lon, answer.position.lat)
        apart_m = np.linalg.norm(frame.to_local(lon_lat), axis=1)
        turned = np.array([pose.angles.yaw - answer.angles.yaw for pose, _ in rivals])
        share = np.array([probability for _, probability in rivals]) / weight
        squared_m2 = float(share @ np.square(apart_m))
        squared_deg2 = float(share @ np.square((turned + 180.0) % 360.0 - 180.0))
    return OscpAccuracy(
        position=round(math.sqrt(variance_m2 + squared_m2), 3),
        orientation=round(math.sqrt(std_deg**2 + squared_deg2), 2),
    )
