"""Values that the store takes and returns, without rows or connections."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.localise.match import PoseGrid
from service.plan_documents import PlanDocument, PlanHead
from service.storage.grid_format import SortedPrototypes

# Tenant of all callers without API keys.
DEFAULT_TENANT = "default"
# Media type of all files that earlier versions of the service stored.
JSON = "application/json"


@dataclass(frozen=True, kw_only=True)
class GridKey:
    """Key of a pose grid: plan revision, model, grid step and camera height."""

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
    """Pose grid that is stored along with its plan, before the revision has an id."""

    model_sha256: str
    grid: PoseGrid
    prototypes: SortedPrototypes | None = None

    def key(self, revision_id: str) -> GridKey:
        """Return the grid's key for a revision."""
        return GridKey(
            revision_id=revision_id,
            model_sha256=self.model_sha256,
            step_m=self.grid.step_m,
            camera_height_mm=millimetres(self.grid.camera_height_m),
        )


@dataclass(frozen=True)
class Original:
    """Uploaded file of a plan's revision.

    Attributes:
        media_type: media type, detected from the content.
        report: import report as JSON text; None for plans of an earlier version of the service.
    """

    content: bytes
    media_type: str = JSON
    report: str | None = None


@dataclass(frozen=True)
class NewPlan:
    """Plan, or revision of one, that is stored.

    Attributes:
        document: the plan's stored form, if it is made already.
        grid: its own grid, if it is computed already.
        later_bytes: expected size of its own grid if that is computed later; there must be room for it.
        level: its level, if it is stored with its venue.
    """

    plan: FloorPlan
    original: Original
    document: PlanDocument | None = None
    grid: ComputedGrid | None = None
    later_bytes: int = 0
    level: float = 0.0


@dataclass(frozen=True, kw_only=True)
class PlanRecord(PlanHead):
    """Stored floor plan at one of its revisions.

    Attributes:
        failure: error of the last computation of its pose grid, if it failed.
    """

    tenant: str
    plan: FloorPlan
    failure: str | None


@dataclass(frozen=True, kw_only=True)
class PlanSummary:
    """Stored floor plan without its rooms, for listings; attributes as of `PlanRecord`.

    Attributes:
        anchored: True if the plan's place on Earth is known.
    """

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
    anchored: bool


@dataclass(frozen=True)
class VenueMember:
    """Plan of a venue with its level, and its name there; None for the plan's own name."""

    plan_id: str
    level: float = 0.0
    name: str | None = None


@dataclass(frozen=True, kw_only=True)
class VenueRecord:
    """Stored venue.

    Attributes:
        revision_id: id of the revision, which changes with name, anchor and plans.
        revision: number of the revision, from 1.
        anchor: anchor of plans without their own, which then share one frame.
        plans: number of plans.
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
    """Numbers of a venue's plans: all, ready for queries, and failed."""

    plans: int
    ready: int
    failed: int


@dataclass(frozen=True)
class VenueState:
    """State of a venue; an equal one shows that queries read the same rows of plans.

    Attributes:
        revision_id: revision of the venue, which changes with its members; None without a venue.
        changes: number of changes of its tenant's plans and grids.
        uncounted_bytes: stored bytes of the tenant beyond these changes; another number shows that an earlier version
            of the service, running beside, wrote plans or grids without numbers.
    """

    revision_id: str | None
    changes: int
    uncounted_bytes: int

    def shows_changes_since(self, earlier: VenueState) -> bool:
        """Tell whether the plans that changed since an earlier state are those with numbers after it."""
        return self.uncounted_bytes == earlier.uncounted_bytes and self.changes >= earlier.changes


@dataclass(frozen=True)
class VenuePlace:
    """Position in the list of a venue's plans, after this plan."""

    level: float
    plan_id: str


@dataclass(frozen=True)
class Cursor:
    """Position in a listing, after this row."""

    created_at: datetime
    id: str


@dataclass(frozen=True, kw_only=True)
class ApiKey:
    """API key, without its secret, of which only a hash is stored.

    Attributes:
        rate_per_minute: limit of requests per minute; 0 for none, None for the limit in the settings.
        last_used_at: approximate time of the last request.
        expires_at: time from which the key is rejected; None for a key without an end.
        replaces: id of the key that this one replaces.
    """

    id: str
    tenant: str
    name: str
    scopes: frozenset[str]
    rate_per_minute: int | None
    created_at: datetime
    revoked_at: datetime | None
    last_used_at: datetime | None
    expires_at: datetime | None = None
    replaces: str | None = None


# Actor of requests without a valid key or token.
ANONYMOUS = "anonymous"
# Result of an action that was carried out.
DONE = "done"


@dataclass(frozen=True, kw_only=True)
class AuditEntry:
    """Action of a caller or of an operator, or several equal ones within a minute.

    Attributes:
        actor: id of the key, `oidc:` and the subject of a token, `cli:` and the user of the command line, `anonymous`.
        tenant: tenant of the actor, or the tenant that an operator changed; empty for unknown callers.
        address: address of the client; empty on the command line.
        action: method and route, or the command.
        resource: path of the resource, or its id.
        status: HTTP status; None on the command line.
        result: `done`, or the kind of the problem.
        count: number of equal actions; above 1 for those that are counted per minute.
        detail: further facts, without secrets.
        created_at: time of the first of the actions.
    """

    actor: str
    tenant: str
    action: str
    resource: str
    address: str = ""
    status: int | None = None
    result: str = DONE
    count: int = 1
    request_id: str | None = None
    detail: str | None = None
    created_at: datetime = field(default_factory=lambda: datetime.now(UTC))


@dataclass(frozen=True, kw_only=True)
class StoredAuditEntry(AuditEntry):
    """Entry with its id."""

    id: str


@dataclass(frozen=True, kw_only=True)
class OperatorLimits:
    """Limits that the operator set for a tenant; None for the limit in the settings.

    Attributes:
        bytes_in_flight: limit of the bytes of request bodies in memory and on disk.
        cpu_share: weight of the tenant in queues: with 2.0 its CPU seconds count half. None counts as 1.0.
    """

    stored_bytes: int | None = None
    bytes_in_flight: int | None = None
    cpu_share: float | None = None


@dataclass(frozen=True)
class StoredAnswer:
    """Stored answer to a request with an idempotency key."""

    status: int
    headers: dict[str, str]
    body: bytes


@dataclass(frozen=True)
class Claimed:
    """The caller carries out the request.

    The token has 32 hexadecimal digits, the same for every attempt: an object with this id is stored once.
    """

    token: str


@dataclass(frozen=True)
class Conflict:
    """The key was used with another body."""


@dataclass(frozen=True)
class InProgress:
    """Another attempt is carrying out the request."""


Claim = StoredAnswer | Claimed | Conflict | InProgress


def millimetres(height_m: float) -> int:
    """Return a height (m) in whole millimetres, as in grid keys."""
    return round(height_m * 1000.0)
