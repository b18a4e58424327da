"""Plans and venues as the service tells them, as frozen dataclasses. Units stand in the names: `_m`, `_m2`, `_deg`.

Fields that this client does not know are left out, so that a newer service can be asked; those that it knows must be
there and of the right type (`parsing.py`). What queries are answered is in `answers.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any


@dataclass(frozen=True)
class Position:
    """A point of the plan frame: x to the right, y up on the drawing."""

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
    """One room of a stored plan; `id` tells rooms of one name apart."""

    name: str
    area_m2: float
    ceiling_height_m: float
    vertices: int
    id: str | None = None
    type: str | None = None


@dataclass(frozen=True)
class Grid:
    """A plan's latent grid; the number of poses is an estimate until the plan is ready."""

    step_m: float
    poses: int


@dataclass(frozen=True)
class FloorPlan:
    """A stored floor plan.

    Attributes:
        status: `preparing`, then `ready` or `failed`.
        progress: share of its latent grid that is computed, 0 to 1.
        reason: why it failed, None unless it did.
        warnings: what is odd about it but usable.
        revision: names what was uploaded, as `Localisation.floorplan_revision` does.
        revision_number: how often the plan was uploaded up to this revision.
        created_at: when it was first uploaded; `updated_at`: when this revision was.
        etag: names this revision, for `replace_floorplan(..., if_match=...)`.
        plan: the plan itself in the native format.
        import_report: how its file was read: what was used for what, what is likely wrong, what was guessed.
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


@dataclass(frozen=True)
class FloorPlanPage:
    """One page of a listing; `next_cursor` asks for the one after it, None ends the listing."""

    floorplans: tuple[FloorPlanSummary, ...]
    next_cursor: str | None = None


@dataclass(frozen=True)
class VenueAnchor:
    """Where on Earth the origin of a venue's plans lies, WGS84; `north_deg` is the azimuth of true north in them."""

    latitude: float
    longitude: float
    altitude_m: float | None = None
    north_deg: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """As it is sent."""
        return asdict(self)


@dataclass(frozen=True)
class VenuePlan:
    """A plan of a venue.

    Attributes:
        level: number of its level, 0 for the ground.
        name: what it is called in the venue; None, when it is sent: by its own name.
        status, progress, rooms, area_m2, revision: those of the plan, as the service tells them.
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
        """As it is sent."""
        return {"floorplan_id": self.floorplan_id, "level": self.level, "name": self.name}


@dataclass(frozen=True)
class Venue:
    """A stored venue.

    Attributes:
        plans: how many floor plans it has; of these `plans_ready` can be asked about, `plans_failed` never will be.
            Listings do not tell these two.
        revision: changes with the name, the anchor and the plans that belong to it.
        etag: names this revision, for `if_match`.
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
class VenuePage:
    """One page of a listing of venues; `next_cursor` asks for the one after it, None ends the listing."""

    venues: tuple[Venue, ...]
    next_cursor: str | None = None


@dataclass(frozen=True)
class VenuePlanPage:
    """One page of the plans of a venue."""

    plans: tuple[VenuePlan, ...]
    next_cursor: str | None = None


@dataclass(frozen=True)
class PlanEvent:
    """How far a plan is at some moment.

    Attributes:
        status: `preparing`, then `ready`, `failed` or `deleted`, after which nothing comes.
        progress: share of its latent grid that is computed, 0 to 1; None of a plan that is deleted.
        revision: the current one; a plan may get another meanwhile.
        reason: why it failed.
    """

    status: str
    progress: float | None = None
    revision: str | None = None
    reason: str | None = None

    @property
    def final(self) -> bool:
        """Whether it is the last one."""
        return self.status in ("ready", "failed", "deleted")
