"""Where on Earth a camera stood: OGC GeoPose 1.0, target Basic-YPR."""

from __future__ import annotations

from pydantic import Field

from service.schemas.fields import ResponseModel


class GeoPosePosition(ResponseModel):
    """A place, WGS84."""

    lat: float = Field(ge=-90, le=90, description="Latitude, degrees.")
    lon: float = Field(ge=-180, le=180, description="Longitude, degrees.")
    h: float = Field(
        description="Height over the ellipsoid in metres; over the plan's floor where its anchor has no `altitude_m`. "
        "By the anchor of a venue: its altitude and the camera's height over the floor, whatever the level."
    )


class GeoPoseAngles(ResponseModel):
    """Rotations about up, north and east, in degrees; a camera that looks north, level, has none."""

    yaw: float = Field(gt=-180, le=180, description="Counterclockwise from north seen from above.")
    pitch: float = Field(description="Always 0: panoramas are level.")
    roll: float = Field(description="Always 0.")


class GeoPose(ResponseModel):
    """A pose on Earth, as OGC GeoPose 1.0 (21-056r11) writes it: Basic-YPR."""

    position: GeoPosePosition
    angles: GeoPoseAngles
