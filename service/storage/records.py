"""What the store takes and answers: plain values, no rows and no connections."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.localise.poses import PoseGrid
from service.storage.grid_format import SortedPrototypes

# Whose plans are whose without API keys.
DEFAULT_TENANT = "default"
# What earlier versions of the service stored was all of this type.
JSON = "application/json"


@dataclass(frozen=True, kw_only=True)
class GridKey:
    """Which latent grid: of one revision of a plan, for one model, grid step and camera height."""

    revision_id: str
    model_sha256: str
    step_m: float
    camera_height_mm: int

    @property
    def camera_height_m(self) -> float:
        """The camera height in metres."""
        return self.camera_height_mm / 1000.0


@dataclass(frozen=True, kw_only=True)
class ComputedGrid:
    """A grid that is stored along with its plan; the revision it belongs to is only made then."""

    model_sha256: str
    grid: PoseGrid
    prototypes: SortedPrototypes | None = None

    def key(self, revision_id: str) -> GridKey:
        """Its key, once the revision is known."""
        return GridKey(
            revision_id=revision_id,
            model_sha256=self.model_sha256,
            step_m=self.grid.step_m,
            camera_height_mm=millimetres(self.grid.camera_height_m),
        )


@dataclass(frozen=True)
class Original:
    """The file that a revision of a plan was uploaded as.

    Attributes:
        media_type: by its content.
        report: what was told of reading it, as JSON text; None for plans of an earlier version of the service.
    """

    content: bytes
    media_type: str = JSON
    report: str | None = None


@dataclass(frozen=True, kw_only=True)
class PlanRecord:
    """A stored floor plan at one of its revisions.

    Attributes:
        revision_id: names plan and revision; it never stands for anything else.
        revision: number of the revision, from 1.
        created_at: when the plan was first stored.
        updated_at: when the revision was.
        failure: why its latent grid could not be computed last time, None when that did not happen.
        report: what was told of reading the file that it was uploaded as, as JSON text; None for plans of an earlier
            version of the service.
    """

    id: str
    tenant: str
    revision_id: str
    revision: int
    created_at: datetime
    updated_at: datetime
    plan: FloorPlan
    failure: str | None
    report: str | None = None


@dataclass(frozen=True, kw_only=True)
class PlanSummary:
    """A stored floor plan without its rooms; what `PlanRecord` says, and what listings need."""

    id: str
    revision_id: str
    revision: int
    created_at: datetime
    updated_at: datetime
    name: str
    room_count: int
    area_m2: float
    camera_height_m: float
    failure: str | None


@dataclass(frozen=True)
class VenueMember:
    """A plan of a venue: its level, and what it is called there, None for the plan's own name."""

    plan_id: str
    level: float = 0.0
    name: str | None = None


@dataclass(frozen=True, kw_only=True)
class VenueRecord:
    """A stored venue.

    Attributes:
        revision_id: changes with its name, its anchor and its plans.
        anchor: of its plans that have none, which are then drawn in one frame.
        revision: number of the revision, from 1.
        plans: how many it has.
        created_at: when the venue was first stored.
        updated_at: when the revision was.
    """

    id: str
    tenant: str
    revision_id: str
    revision: int
    name: str
    anchor: Anchor | None
    plans: int
    created_at: datetime
    updated_at: datetime


@dataclass(frozen=True)
class VenueCounts:
    """How many plans a venue has, and how many of them can be asked about, or never will."""

    plans: int
    ready: int
    failed: int


@dataclass(frozen=True)
class VenueState:
    """What changes whenever a query about a venue would be told something else of its plans.

    Plans come and go with the venue's revision, and a plan that is replaced makes the sum of the revisions' numbers
    greater; where nothing of that happened, grids can only have come or gone.

    Attributes:
        revision_id: of the venue; None where there is no venue.
        plans, ready, failed: how many there are.
        revisions: the sum of the numbers of the plans' revisions.
        grids: the sum of the ids of the grids of those that are ready.
    """

    revision_id: str | None
    plans: int
    ready: int
    failed: int
    revisions: int
    grids: int


@dataclass(frozen=True)
class VenuePlace:
    """A place in the list of a venue's plans: after this one."""

    level: float
    plan_id: str


@dataclass(frozen=True)
class Cursor:
    """A place in a listing: after this plan."""

    created_at: datetime
    id: str


@dataclass(frozen=True, kw_only=True)
class ApiKey:
    """An API key; what the caller presents is not stored, only its hash.

    Attributes:
        scopes: what it is good for.
        rate_per_minute: requests that it may send; 0 for any number, None for as many as the settings say.
    """

    id: str
    tenant: str
    name: str
    scopes: frozenset[str]
    rate_per_minute: int | None
    created_at: datetime
    revoked_at: datetime | None
    last_used_at: datetime | None


@dataclass(frozen=True)
class StoredAnswer:
    """What a request with an idempotency key was answered with."""

    status: int
    headers: dict[str, str]
    body: bytes


@dataclass(frozen=True)
class Claimed:
    """The request is to be carried out.

    Attributes:
        token: 32 hexadecimal digits that stay the same when the request is taken over from an attempt that failed or
            whose process died half-way: what is made under this id is made once.
    """

    token: str


@dataclass(frozen=True)
class Conflict:
    """The key was used with another body."""


@dataclass(frozen=True)
class InProgress:
    """The same request is being carried out at this moment."""


Claim = StoredAnswer | Claimed | Conflict | InProgress


def millimetres(height_m: float) -> int:
    """A height (m) in whole millimetres, as keys have it."""
    return round(height_m * 1000.0)
