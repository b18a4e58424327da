"""Floor plans in the native format."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema

from lalaloc_core.conventions import FIXTURE_KINDS, MIN_CAMERA_HEIGHT_M, OPENING_CLASSES, ROOM_TYPES

Point = Annotated[list[float], Field(min_length=2, max_length=2)]
Segment = Annotated[list[Point], Field(min_length=2, max_length=2)]
Ring = Annotated[list[Point], Field(min_length=3)]
RoomType = Annotated[str, WithJsonSchema({"type": "string", "enum": [*ROOM_TYPES]})]
KnownRoomType = Annotated[str, WithJsonSchema({"type": "string", "enum": [*ROOM_TYPES[1:]]})]
OpeningKind = Annotated[str, WithJsonSchema({"type": "string", "enum": [*OPENING_CLASSES[1:]]})]


class RoomDocument(BaseModel):
    """Room of a plan."""

    id: str | None = Field(None, description="Unique id. Default: made from the name.")
    name: str = Field("", description="Name of the room. Default: its number.")
    type: RoomType = Field("unknown", description="Use of the room. Default: by its name and fixtures.")
    types: list[KnownRoomType] | None = Field(
        None,
        max_length=len(ROOM_TYPES) - 1,
        description="Uses of a room with several, such as an open kitchen; [] for none. Default: by type, name and "
        "fixtures.",
    )
    polygon: Ring = Field(
        description="Corners [x, y] in metres, clockwise or counterclockwise; x points right and y up on the drawing."
    )
    holes: list[Ring] = Field([], description="Holes in the floor, such as columns and shafts.")
    walls: list[Segment] = Field([], description="Free-standing walls that reach the ceiling.")
    ceiling_height_m: float | None = Field(None, gt=0, description="Height of this room's ceiling over its floor.")


class OpeningDocument(BaseModel):
    """Door, window or passage; one entry serves both rooms of a wall."""

    kind: OpeningKind = Field(description="Kind; a passage has no leaf.")
    line: Segment = Field(description="Both ends, on the wall.")
    sill_m: float | None = Field(None, ge=0, description="Height of the lower edge over the floor.")
    head_m: float | None = Field(None, ge=0, description="Height of the upper edge over the floor.")
    name: str | None = Field(None, description="Name of the opening.")
    rooms: list[str] | None = Field(
        None, description="Ids of the rooms that it belongs to. Default: all rooms whose wall it lies on."
    )


class FixtureDocument(BaseModel):
    """Fixture of a room."""

    kind: Annotated[str, WithJsonSchema({"type": "string", "enum": [*FIXTURE_KINDS]})]
    outline: Ring = Field(description="Corners [x, y] in metres, seen from above.")


class ControlPoint(BaseModel):
    """Point that is known both in the plan and on Earth."""

    x: float = Field(description="Plan coordinate, metres.")
    y: float
    latitude: float = Field(ge=-90, le=90, description="WGS84, degrees.")
    longitude: float = Field(ge=-180, le=180)


class AnchorDocument(BaseModel):
    """Place of a plan on Earth: `latitude` and `longitude` of its origin, or two control points."""

    latitude: float | None = Field(None, ge=-90, le=90, description="Latitude of the plan's origin, WGS84, degrees.")
    longitude: float | None = Field(None, ge=-180, le=180, description="Longitude of the plan's origin.")
    altitude_m: float | None = Field(None, ge=-1000, le=10_000, description="Height of the floor over the ellipsoid.")
    north_deg: float | None = Field(
        None,
        ge=-360,
        le=360,
        description="Azimuth of true north in the plan, if the plan has no `north_deg` of its own.",
    )
    control_points: list[ControlPoint] | None = Field(None, min_length=2, max_length=2)


class FloorPlanDocument(BaseModel):
    """Floor plan in the native format; coordinates in metres."""

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

    name: str = Field("floor plan", description="Name of the plan.")
    ceiling_height_m: float | None = Field(
        None,
        gt=0,
        description="Ceiling height of rooms without their own. Without either, 2.5 m is assumed, with a warning.",
    )
    camera_height_m: float = Field(
        1.5, ge=MIN_CAMERA_HEIGHT_M, description="Camera height of photographs of this plan."
    )
    north_deg: float | None = Field(
        None, ge=-360, le=360, description="Azimuth of true north: degrees clockwise from the plan's +y."
    )
    anchor: AnchorDocument | None = Field(
        None, description="Place of the plan on Earth, by its origin or by two control points."
    )
    camera_height_std_m: float | None = Field(None, ge=0, le=2, description="Standard deviation of `camera_height_m`.")
    rooms: list[RoomDocument] = Field(min_length=1, description="Rooms.")
    openings: list[OpeningDocument] = Field(
        [], description="Doors, windows and passages; they can touch but not overlap."
    )
    fixtures: list[FixtureDocument] = Field([], description="Fixtures, such as toilets, stoves and stairs.")
    opening_kinds: list[OpeningKind] | None = Field(
        None,
        description="Kinds of openings that the plan shows completely. Default: the kinds that occur and are not in "
        "`opening_trust`.",
    )
    opening_trust: dict[OpeningKind, Annotated[float, Field(ge=0, le=1)]] | None = Field(
        None,
        description="Probability by kind that an opening that exists is drawn, for kinds that are not in "
        "`opening_kinds`. Default: 0, openings of the kind are not compared.",
    )
    opening_tolerance_m: float = Field(
        0.35, ge=0.01, le=1.5, description="Largest distance between an opening and the wall it belongs to."
    )
