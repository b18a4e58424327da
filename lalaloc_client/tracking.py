"""Sessions of tracked cameras as frozen dataclasses, and motions between photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, TypedDict

from lalaloc_client.answers import ReadView
from lalaloc_client.model import Position

Covariance3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


class SessionOptions(TypedDict, total=False):
    """Options of a session; an option that is left out or None has the default.

    Attributes:
        camera_height_m, camera_height_std_m, top_k: as in `QueryOptions`.
        near, radius_m, rooms, level: hints about the first photograph, as in `QueryOptions`; `level` in venues.
    """

    camera_height_m: float | None
    camera_height_std_m: float | None
    near: Mapping[str, float] | None
    radius_m: float | None
    rooms: Sequence[str] | None
    level: float | None
    top_k: int | None


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Measured motion since the photograph before, in the frame of the camera at that photograph.

    Attributes:
        forward_m, right_m: displacement along its heading, and to the right of it.
        turn_deg: change of the heading, clockwise seen from above.
        forward_std_m, right_std_m, turn_std_deg: standard deviations. Default: 5 % of the distance and 2 cm; 2° per
            metre and 1°.
        covariance: of all three, in m², m·° and °², instead of the standard deviations.
    """

    forward_m: float
    turn_deg: float
    right_m: float = 0.0
    forward_std_m: float | None = None
    right_std_m: float | None = None
    turn_std_deg: float | None = None
    covariance: Covariance3 | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the fields of a request."""
        return dict(vars(self))


@dataclass(frozen=True)
class Rival:
    """A possible pose of the last photograph; `floorplan_id` and `level` as in `TrackedPose`."""

    position: Position
    heading_deg: float
    room: str
    room_id: str
    probability: float
    floorplan_id: str | None = None
    level: float | None = None


@dataclass(frozen=True)
class PathPoint:
    """Pose of one photograph of a session; `number` counts from 1, `floorplan_id` and `level` as in `TrackedPose`."""

    number: int
    position: Position
    heading_deg: float
    room_id: str
    probability: float
    floorplan_id: str | None = None
    level: float | None = None


@dataclass(frozen=True)
class TrackedPose:
    """Pose of the last photograph of a session.

    Attributes:
        heading_deg: azimuth of the photograph's centre, clockwise from the plan's +y.
        covariance: of x_m, y_m and heading_deg, in m², m·° and °².
        probability: that the position is right within 1 m.
        candidates: possible poses, most probable first.
        motion_contradicted: components of the motion that the photographs contradict.
        warnings: these, and odometry that is wrong again and again.
    """

    number: int
    position: Position
    heading_deg: float
    room: str
    room_id: str
    covariance: Covariance3
    probability: float
    camera_height_m: float
    candidates: tuple[Rival, ...]
    motion_contradicted: tuple[str, ...]
    warnings: tuple[str, ...]
    timings_ms: Mapping[str, float]
    view: ReadView | None = None
    floorplan_id: str | None = None
    level: float | None = None


@dataclass(frozen=True)
class Session:
    """A session of a tracked camera.

    Attributes:
        mode: `searching`, `tracking` or `lost`.
        floorplan_id, floorplan_revision: the plan; None for a session in a venue.
        path: poses of the last 200 photographs.
        venue_id, venue_revision: the venue; None for a session in one plan.
    """

    id: str
    floorplan_id: str | None
    floorplan_revision: str | None
    expires_at: datetime
    photographs: int
    mode: str
    pose: TrackedPose | None
    path: tuple[PathPoint, ...]
    venue_id: str | None = None
    venue_revision: str | None = None
