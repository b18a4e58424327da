"""The GeoPose protocol of the Open Spatial Computing Platform (OSCP), version 2: what AR clients ask and are answered.

Names are the protocol's. Members that are not told here are the protocol's as well, or of later versions of it, and are
not read: privacy (panoramas are never kept), sizes (the picture has its own), sequence numbers, rigs.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from pydantic.alias_generators import to_camel

from service.schemas.fields import Finite, HeadingDeg, ResponseModel, Share
from service.schemas.geopose import GeoPosePosition
from service.schemas.localise_answer import Position

_Readings = list[dict[str, Any]]


class _Sent(BaseModel):
    model_config = ConfigDict(frozen=True, alias_generator=to_camel)


class OscpSensor(_Sent):
    """A sensor of the device."""

    id: str
    type: str = Field(description="`camera`, `geolocation` and so on.")


class OscpImageOrientation(_Sent):
    """How the picture lies in memory; panoramas are upright, or say otherwise in their EXIF."""

    mirrored: bool = False
    rotation: float = 0.0


class OscpCameraParam(_Sent):
    """What is known of the camera."""

    model: str | None = Field(None, description="Left out, `UNKNOWN` or `EQUIRECTANGULAR`: others are no panoramas.")


class OscpCameraReading(_Sent):
    """A picture: a full panorama, as of `POST /localise`."""

    timestamp: Annotated[float, Finite]
    sensor_id: str
    image_format: str = Field(description="`JPG`, say; the picture itself tells what it is. `DEPTH` is refused.")
    image_bytes: str = Field(min_length=1, description="The file, JPEG, PNG or WebP, in Base64.")
    image_orientation: OscpImageOrientation | None = None
    params: OscpCameraParam | None = None


class OscpGeolocationReading(_Sent):
    """A rough place, as of the W3C's geolocation sensor."""

    timestamp: Annotated[float, Finite] = 0.0
    latitude: Annotated[float, Finite] = Field(ge=-90, le=90)
    longitude: Annotated[float, Finite] = Field(ge=-180, le=180)
    accuracy: Annotated[float, Finite] | None = Field(None, description="Metres; 0 or none: not known.")


class OscpSensorReadings(_Sent):
    """What the sensors say."""

    camera_readings: Annotated[list[OscpCameraReading], Field(min_length=1, max_length=1)]
    geolocation_readings: list[OscpGeolocationReading] = []
    wi_fi_readings: _Readings = []
    bluetooth_readings: _Readings = []
    accelerometer_readings: _Readings = []
    gyroscope_readings: _Readings = []
    magnetometer_readings: _Readings = []

    @property
    def unused(self) -> list[str]:
        """Names of readings that there are, and that nothing is done with."""
        used = {"camera_readings", "geolocation_readings"}
        return [to_camel(name) for name in OscpSensorReadings.model_fields if name not in used and getattr(self, name)]


class OscpRequest(_Sent):
    """Where is this device? A GeoPoseReq of the protocol."""

    id: str = Field(description="Comes back in the answer.")
    timestamp: int | Annotated[float, Finite] = Field(description="Milliseconds since 1970; comes back in the answer.")
    type: Literal["geopose"]
    sensors: list[OscpSensor]
    sensor_readings: OscpSensorReadings
    prior_poses: _Readings = Field([], description="Not used, which the answer says.")

    @property
    def camera_reading(self) -> OscpCameraReading:
        """The picture."""
        return self.sensor_readings.camera_readings[0]

    @property
    def geolocation(self) -> OscpGeolocationReading | None:
        """The latest rough place."""
        return max(self.sensor_readings.geolocation_readings, key=lambda one: one.timestamp, default=None)


class OscpQuaternion(ResponseModel):
    """A rotation from the camera (x right, y where the panorama's centre looks, z up) to east, north, up."""

    x: float
    y: float
    z: float
    w: float


class OscpGeoPose(ResponseModel):
    """A pose on Earth: GeoPose Basic-Quaternion."""

    position: GeoPosePosition
    quaternion: OscpQuaternion


class OscpAccuracy(ResponseModel):
    """How far off the pose may be: root of the mean square over its candidates, as probable as they are."""

    position: float = Field(description="Metres, horizontally.")
    orientation: float = Field(description="Degrees about the vertical.")


class OscpFound(ResponseModel):
    """What the protocol has no place for."""

    floorplan_id: str
    level: float | None
    position: Position
    heading_deg: HeadingDeg
    room: str
    room_id: str
    confidence: Share | None
    warnings: list[str] = Field(description="What was sent and not used or not followed.")


class OscpAnswer(ResponseModel):
    """A GeoPoseResp of the protocol, with `lalaloc` beside it."""

    id: str
    timestamp: int | float
    type: Literal["geopose"] = "geopose"
    accuracy: OscpAccuracy
    geopose: OscpGeoPose
    lalaloc: OscpFound
