"""Requests and answers of the GeoPose protocol, version 2, of the Open Spatial Computing Platform (OSCP).

Names are the protocol's. Other members of the protocol, and of later versions of it, are accepted and ignored: privacy
(photographs are never kept), sizes (the picture has its own), sequence numbers, rigs.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from pydantic.alias_generators import to_camel

from service.schemas.fields import Finite, HeadingDeg, ResponseModel, Share
from service.schemas.localise_answer import GeoPosePosition, Position

_Readings = list[dict[str, Any]]


class _Sent(BaseModel):
    model_config = ConfigDict(frozen=True, alias_generator=to_camel)


class OscpSensor(_Sent):
    """Sensor of the device."""

    id: str
    type: str = Field(description="`camera`, `geolocation` and so on.")


class OscpImageOrientation(_Sent):
    """Orientation of the stored picture; it must be upright, or say otherwise in its EXIF data."""

    mirrored: bool = False
    rotation: float = 0.0


class OscpCameraParam(_Sent):
    """Parameters of the camera."""

    model: str | None = Field(
        None,
        description="`EQUIRECTANGULAR`, or a camera with `modelParams`: `SIMPLE_PINHOLE` (f, cx, cy), `PINHOLE` (fx, "
        "fy, cx, cy), `SIMPLE_RADIAL` (f, cx, cy, k1), `RADIAL` (f, cx, cy, k1, k2), `OPENCV` (fx, fy, cx, cy, k1, k2, "
        "p1, p2) or `OPENCV_FISHEYE` (fx, fy, cx, cy, k1, k2, k3, k4). `UNKNOWN` or left out: as `projection=auto` of "
        "`POST /localise`.",
    )
    model_params: Annotated[list[Annotated[float, Finite]], Field(max_length=12)] | None = Field(
        None, description="Parameters of `model`, pixels of the upright picture, in the order above."
    )


class OscpCameraReading(_Sent):
    """Photograph, as in `POST /localise`."""

    timestamp: Annotated[float, Finite]
    sensor_id: str
    image_format: str = Field(
        description="Such as `JPG`; the actual format is detected from the picture. `DEPTH` is refused."
    )
    image_bytes: str = Field(min_length=1, description="JPEG, PNG, WebP or HEIC file in Base64.")
    image_orientation: OscpImageOrientation | None = None
    params: OscpCameraParam | None = None


class OscpGeolocationReading(_Sent):
    """Approximate place, as in the W3C geolocation sensor."""

    timestamp: Annotated[float, Finite] = 0.0
    latitude: Annotated[float, Finite] = Field(ge=-90, le=90)
    longitude: Annotated[float, Finite] = Field(ge=-180, le=180)
    accuracy: Annotated[float, Finite] | None = Field(None, description="Metres; 0 or null: unknown.")


class OscpSensorReadings(_Sent):
    """Sensor readings."""

    camera_readings: Annotated[list[OscpCameraReading], Field(min_length=1, max_length=1)]
    geolocation_readings: list[OscpGeolocationReading] = []
    wi_fi_readings: _Readings = []
    bluetooth_readings: _Readings = []
    accelerometer_readings: _Readings = []
    gyroscope_readings: _Readings = []
    magnetometer_readings: _Readings = []

    @property
    def unused(self) -> list[str]:
        """Names of the readings that are present but not used."""
        used = {"camera_readings", "geolocation_readings"}
        return [to_camel(name) for name in OscpSensorReadings.model_fields if name not in used and getattr(self, name)]


class OscpRequest(_Sent):
    """Query of the protocol (GeoPoseReq)."""

    id: str = Field(description="Returned in the answer.")
    timestamp: int | Annotated[float, Finite] = Field(description="Milliseconds since 1970; returned in the answer.")
    type: Literal["geopose"]
    sensors: list[OscpSensor]
    sensor_readings: OscpSensorReadings
    prior_poses: _Readings = Field([], description="Not used; the answer has a warning.")

    @property
    def camera_reading(self) -> OscpCameraReading:
        """The picture."""
        return self.sensor_readings.camera_readings[0]

    @property
    def geolocation(self) -> OscpGeolocationReading | None:
        """The latest geolocation reading."""
        return max(self.sensor_readings.geolocation_readings, key=lambda reading: reading.timestamp, default=None)


class OscpQuaternion(ResponseModel):
    """Rotation from the camera (x right, y along the photograph's centre, z up) to east, north, up."""

    x: float
    y: float
    z: float
    w: float


class OscpGeoPose(ResponseModel):
    """Pose on Earth: GeoPose Basic-Quaternion."""

    position: GeoPosePosition
    quaternion: OscpQuaternion


class OscpAccuracy(ResponseModel):
    """Accuracy of the pose: root mean square over the candidates, weighted by probability."""

    position: float = Field(description="Metres, horizontally.")
    orientation: float = Field(description="Degrees about the vertical.")


class OscpFound(ResponseModel):
    """Parts of the answer that the protocol has no members for."""

    floorplan_id: str
    level: float | None
    position: Position
    heading_deg: HeadingDeg
    room: str
    room_id: str
    confidence: Share | None
    warnings: list[str] = Field(description="Parts of the request that were not used or not followed.")


class OscpAnswer(ResponseModel):
    """Answer of the protocol (GeoPoseResp), extended by `lalaloc`."""

    id: str
    timestamp: int | float
    type: Literal["geopose"] = "geopose"
    accuracy: OscpAccuracy
    geopose: OscpGeoPose
    lalaloc: OscpFound
