"""A floor plan in the native format, as it is uploaded and told."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema

from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M, OPENING_CLASSES, ROOM_TYPES

Point = Annotated[list[float], Field(min_length=2, max_length=2)]
Segment = Annotated[list[Point], Field(min_length=2, max_length=2)]
Ring = Annotated[list[Point], Field(min_length=3)]
RoomType = Annotated[str, WithJsonSchema({"type": "string", "enum": [*ROOM_TYPES]})]
OpeningKind = Annotated[str, WithJsonSchema({"type": "string", "enum": [*OPENING_CLASSES[1:]]})]


class RoomDocument(BaseModel):
    """One room of a plan."""

    id: str | None = Field(None, description="Tells rooms of one name apart; unique, by default made from the name.")
    name: str = Field("", description="Name of the room; by default its number.")
    type: RoomType = Field("unknown", description="What the room is for.")
    polygon: Ring = Field(
        description="Corners [x, y] in metres, in either order, x to the right and y up on the drawing."
    )
    holes: list[Ring] = Field([], description="What is no floor inside the polygon, such as columns and shafts.")
    walls: list[Segment] = Field([], description="Free-standing walls up to the ceiling.")
    ceiling_height_m: float | None = Field(None, gt=0, description="Height of this room's ceiling over its floor.")


class OpeningDocument(BaseModel):
    """A door, window or passage; one entry serves both rooms of a wall."""

    kind: OpeningKind = Field(description="A passage is an opening without a leaf.")
    line: Segment = Field(description="Both ends, along the wall.")
    sill_m: float | None = Field(None, ge=0, description="Height of its lower edge over the floor.")
    head_m: float | None = Field(None, ge=0, description="Height of its upper edge over the floor.")
    name: str | None = Field(None, description="What to call it.")
    rooms: list[str] | None = Field(
        None, description="Ids of the only rooms that it belongs to; by default all whose wall it lies on."
    )


class ControlPoint(BaseModel):
    """A place that is known in the plan and on Earth."""

    x: float = Field(description="In the plan, metres.")
    y: float
    latitude: float = Field(ge=-90, le=90, description="WGS84, degrees.")
    longitude: float = Field(ge=-180, le=180)


class AnchorDocument(BaseModel):
    """Where on Earth a plan lies: `latitude` and `longitude` of its origin, or two control points."""

    latitude: float | None = Field(None, ge=-90, le=90, description="Of the plan's origin; WGS84, degrees.")
    longitude: float | None = Field(None, ge=-180, le=180, description="Of the plan's origin.")
    altitude_m: float | None = Field(None, ge=-1000, le=10_000, description="Of the floor, over the ellipsoid.")
    north_deg: float | None = Field(
        None, ge=-360, le=360, description="Azimuth of true north in the plan, where `north_deg` of the plan says none."
    )
    control_points: list[ControlPoint] | None = Field(None, min_length=2, max_length=2)


class FloorPlanDocument(BaseModel):
    """A floor plan in the native format; coordinates in metres."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "name": "Flat 3",
                "ceiling_height_m": 2.5,
                "camera_height_m": 1.5,
                "rooms": [{"name": "kitchen", "polygon": [[0, 0], [4, 0], [4, 3], [0, 3]], "ceiling_height_m": 2.5}],
            }
        }
    )

    name: str = Field("floor plan", description="What to call the plan.")
    ceiling_height_m: float | None = Field(None, gt=0, description="Ceiling of rooms without their own.")
    camera_height_m: float = Field(
        1.5, ge=MIN_CAMERA_HEIGHT_M, description="Height of the camera assumed for panoramas of this plan."
    )
    north_deg: float | None = Field(
        None, ge=-360, le=360, description="Azimuth of true north: degrees clockwise from the plan's +y."
    )
    anchor: AnchorDocument | None = Field(
        None, description="Where on Earth the plan lies: by its origin, or by two control points."
    )
    camera_height_std_m: float | None = Field(
        None, ge=0, le=2, description="How far off `camera_height_m` may be: one standard deviation."
    )
    rooms: list[RoomDocument] = Field(min_length=1, description="Closed rooms.")
    openings: list[OpeningDocument] = Field([], description="Doors, windows and passages; they may touch, not overlap.")
    opening_kinds: list[OpeningKind] | None = Field(
        None, description="The kinds that the plan shows completely; by default those that occur in it."
    )
    opening_tolerance_m: float = Field(
        0.35, ge=0.01, le=1.5, description="How far from a room's wall an opening may be drawn."
    )
