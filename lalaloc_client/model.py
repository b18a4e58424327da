"""Plans, venues and layouts as frozen dataclasses. Units are in the names: `_m`, `_m2`, `_deg`.

Answers may have more fields, so that the client works with newer services; the fields here are checked (`parsing.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any


@dataclass(frozen=True)
class Position:
    """A point in the plan frame: x to the right, y up on the drawing."""

    x_m: float
    y_m: float


@dataclass(frozen=True)
class Bounds:
    """Smallest axis-parallel box around a plan."""

    x_min_m: float
    y_min_m: float
    x_max_m: float
    y_max_m: float


@dataclass(frozen=True)
class Room:
    """One room of a stored plan; `id` is unique, the name need not be."""

    name: str
    area_m2: float
    ceiling_height_m: float
    vertices: int
    id: str | None = None
    type: str | None = None
    types: tuple[str, ...] = ()


@dataclass(frozen=True)
class Grid:
    """A plan's pose grid; the number of poses is an estimate until the plan is ready."""

    step_m: float
    poses: int


@dataclass(frozen=True)
class FloorPlan:
    """A stored floor plan.

    Attributes:
        status: `preparing`, then `ready` or `failed`.
        progress: computed share of its pose grid, 0 to 1.
        warnings: oddities that do not prevent its use.
        revision: id of the uploaded revision, as in `Localisation.floorplan_revision`.
        revision_number: number of uploads up to this revision.
        etag: entity tag of this revision, for `replace_floorplan(..., if_match=...)`.
        import_report: interpretation of its file, with guesses and likely errors.
    """

    id: str
    name: str
    status: str
    progress: float
    rooms: tuple[Room, ...]
    area_m2: float
    bounds: Bounds
    camera_height_m: float
    grid: Grid
    created_at: datetime
    warnings: tuple[str, ...] = ()
    reason: str | None = None
    revision: str | None = None
    revision_number: int | None = None
    updated_at: datetime | None = None
    etag: str | None = None
    plan: Mapping[str, Any] | None = None
    import_report: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class FloorPlanSummary:
    """A stored floor plan in a listing; `rooms` is their number."""

    id: str
    name: str
    status: str
    progress: float
    rooms: int
    area_m2: float
    created_at: datetime
    revision: str | None = None
    updated_at: datetime | None = None
    revision_number: int | None = None


@dataclass(frozen=True)
class VenueAnchor:
    """Location of the origin of a venue's plans on Earth, WGS84; `north_deg` is the azimuth of true north in them."""

    latitude: float
    longitude: float
    altitude_m: float | None = None
    north_deg: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON document of the API."""
        return asdict(self)


@dataclass(frozen=True)
class VenuePlan:
    """A plan of a venue.

    Attributes:
        level: number of its level, 0 for the ground floor.
        name: its name in the venue. Default when sent: the plan's own name.
    """

    floorplan_id: str
    level: float = 0.0
    name: str | None = None
    status: str | None = None
    progress: float | None = None
    rooms: int | None = None
    area_m2: float | None = None
    revision: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON document of the API."""
        return {"floorplan_id": self.floorplan_id, "level": self.level, "name": self.name}


@dataclass(frozen=True)
class Venue:
    """A stored venue.

    Attributes:
        revision: id that changes with the name, the anchor and the set of plans.
        plans_ready: number of plans that can be searched; None in listings.
        plans_failed: number of plans that could not be prepared; None in listings.
        etag: entity tag of this revision, for `if_match`.
    """

    id: str
    revision: str
    name: str
    plans: int
    created_at: datetime
    updated_at: datetime
    anchor: VenueAnchor | None = None
    revision_number: int | None = None
    plans_ready: int | None = None
    plans_failed: int | None = None
    etag: str | None = None


@dataclass(frozen=True)
class ImportStep:
    """Step of an import that begins or goes on.

    Attributes:
        step: what the service does, such as "reading texts".
        done: levels of the file that are done; None for a step that is not about one level of several.
    """

    step: str
    done: int | None = None
    total: int | None = None


@dataclass(frozen=True)
class PlanEvent:
    """Progress of a plan at one moment.

    Attributes:
        status: `preparing`, then `ready`, `failed` or `deleted`, which is the last event.
        progress: computed share of its pose grid, 0 to 1; None after deletion.
    """

    status: str
    progress: float | None = None
    revision: str | None = None
    reason: str | None = None

    @property
    def final(self) -> bool:
        """True for the last event."""
        return self.status in ("ready", "failed", "deleted")


@dataclass(frozen=True)
class OpeningPiece:
    """A piece of a wall that is an opening.

    Attributes:
        start: start of the piece as a share of the wall, 0 to 1.
        end: end of the piece as a share of the wall, 0 to 1.
        sill_m: height of the lower edge over the floor, None if unknown.
        head_m: height of the upper edge over the floor, None if unknown.
    """

    kind: str
    wall: int
    start: float
    end: float
    sill_m: float | None = None
    head_m: float | None = None


@dataclass(frozen=True)
class RoomLayout:
    """A room for rendering; `walls_m` has (x0, y0, x1, y1) of each wall, with the room to its left."""

    id: str
    name: str
    ceiling_height_m: float
    polygon: tuple[tuple[float, float], ...]
    holes: tuple[tuple[tuple[float, float], ...], ...]
    walls_m: tuple[tuple[float, float, float, float], ...]
    openings: tuple[OpeningPiece, ...]


# Probability that a photograph is found, by its kind: `sphere`, `phone` or `three_phone`, and `_known_heading` or
# `_unknown_heading`.
Probabilities = Mapping[str, float]


@dataclass(frozen=True)
class RatedRoom:
    """Room with the probability that photographs taken in it are found; None if it was not predicted."""

    id: str
    name: str
    probability: Probabilities | None


@dataclass(frozen=True)
class RatedPlace:
    """Place with the probability that photographs taken there are found; `room` is the id of its room."""

    x_m: float
    y_m: float
    room: str
    probability: Probabilities


@dataclass(frozen=True)
class ConfusedRooms:
    """Ids of two rooms, and the share of photographs of either that are answered in the other."""

    rooms: tuple[str, str]
    condition: str
    share: float


@dataclass(frozen=True)
class Localisability:
    """Prediction of the photographs of a plan that will be found.

    Attributes:
        spacing_m: distance of the poses that are compared; an answer within 1 m, or within this distance if it is
            longer, counts as found.
        confused: pairs of rooms, the most confused first.
        gains: increase of the probability of phone photographs with unknown heading by remedy: `heading`,
            `three_photographs`, `sphere`, `room_hint`, and `doors`, which is that of the openings of the plan.
        advice: sentences about confused rooms and what helps most.
    """

    floorplan_id: str
    revision: str
    spacing_m: float
    probability: Probabilities
    rooms: tuple[RatedRoom, ...]
    places: tuple[RatedPlace, ...]
    confused: tuple[ConfusedRooms, ...]
    gains: Mapping[str, float | None]
    advice: tuple[str, ...]
    coarse: bool = False


@dataclass(frozen=True)
class Layout:
    """Walls and openings of a plan's revision, room by room."""

    floorplan_id: str
    revision: str
    rooms: tuple[RoomLayout, ...]
