"""Current schema of the tables; `migrations` creates it, and a test compares the two."""

from __future__ import annotations

from datetime import UTC, datetime

from sqlalchemy import (
    BigInteger,
    Column,
    DateTime,
    Dialect,
    Double,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    UniqueConstraint,
)
from sqlalchemy.types import TypeDecorator

from service.storage.migrations import chunk, counter, optional, owned, part_of, required

METADATA = MetaData()


class UtcDateTime(TypeDecorator[datetime]):
    """Time in UTC; SQLite drops the time zone, and PostgreSQL can return another one."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Convert a time for the database."""
        return None if value is None else value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Convert a time from the database."""
        if value is None:
            return None
        return value.astimezone(UTC) if value.tzinfo else value.replace(tzinfo=UTC)


FLOORPLANS = Table(
    "floorplans",
    METADATA,
    *owned(),
    Column("name", Text, nullable=False),
    # Case-folded name for searches, because databases fold cases differently.
    Column("folded_name", Text, nullable=False),
    # Current revision; no foreign key, because revisions already refer to their plan.
    Column("revision_id", String(32), nullable=False),
    *required(UtcDateTime, "created_at", "updated_at"),
    # Circle around the plan, in its own frame; NULL if an earlier version stored a plan that cannot be read.
    *optional(Double, "centre_x_m", "centre_y_m", "reach_m"),
    # Centre of the circle on Earth; NULL for a plan without an anchor.
    *optional(Double, "latitude", "longitude"),
    # Number of the tenant's change (`tenants.changes`) that last changed what queries of venues read of this plan; 0
    # before the first one.
    counter("changed"),
    Index("floorplans_by_tenant_and_age", "tenant", "created_at", "id"),
    Index("floorplans_by_place", "tenant", "latitude"),
    Index("floorplans_by_revision", "revision_id"),
    Index("floorplans_by_change", "tenant", "changed"),
)

REVISIONS = Table(
    "revisions",
    METADATA,
    Column("id", String(32), primary_key=True),
    part_of("floorplans", "plan_id", nullable=False),
    Column("number", Integer, nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
    Column("document", Text, nullable=False),
    # NULL in rows of earlier versions of the service.
    Column("document_sha256", String(64)),
    Column("warnings", Text),
    Column("original_sha256", String(64), nullable=False),
    # NULL in rows of earlier versions of the service: JSON in the native format, without a report.
    Column("original_media_type", String(64)),
    Column("report", Text),
    Column("room_count", Integer, nullable=False),
    *required(Double, "area_m2", "camera_height_m"),
    # NULL for an unknown camera height, and in rows of earlier versions of the service.
    Column("camera_height_std_m", Double),
    Column("failure", Text),
    counter("stored_bytes"),
    UniqueConstraint("plan_id", "number", name="revisions_of_plan"),
)

ORIGINAL_CHUNKS = Table("original_chunks", METADATA, part_of("revisions", "revision_id", primary_key=True), *chunk())

LATENT_GRIDS = Table(
    "latent_grids",
    METADATA,
    Column("id", Integer, primary_key=True, autoincrement=True),
    part_of("revisions", "revision_id", nullable=False),
    Column("model_sha256", String(64), nullable=False),
    Column("step_m", Double, nullable=False),
    *required(Integer, "camera_height_mm", "poses", "size_bytes"),
    # NULL in rows of earlier versions of the service, which do not count as stored.
    Column("sha256", String(64)),
    # Input of the choice among a venue's plans; NULL in rows of earlier versions of the service.
    Column("prototypes", LargeBinary),
    counter("stored_bytes"),
    UniqueConstraint("revision_id", "model_sha256", "step_m", "camera_height_mm", name="latent_grid_key"),
)

GRID_CHUNKS = Table(
    "grid_chunks",
    METADATA,
    Column("grid_id", Integer, ForeignKey("latent_grids.id", ondelete="CASCADE"), primary_key=True),
    *chunk(),
)

GRID_LEASES = Table(
    "grid_leases",
    METADATA,
    part_of("revisions", "revision_id", primary_key=True),
    Column("model_sha256", String(64), primary_key=True),
    Column("step_m", Double, primary_key=True),
    Column("camera_height_mm", Integer, primary_key=True, autoincrement=False),
    Column("owner", String(32), nullable=False),
    # Seconds since 1970 by `Database.now_s`, the clock that all owners share.
    Column("lease_until_s", Double, nullable=False),
    # NULL in rows of earlier versions of the service.
    Column("length_s", Double),
    Column("progress", Double, nullable=False),
    # Number of attempts since the grid was last finished or abandoned.
    Column("attempts", Integer, nullable=False, server_default="1"),
)

VENUES = Table(
    "venues",
    METADATA,
    *owned(),
    *required(Text, "name", "folded_name"),
    Column("revision_id", String(32), nullable=False),
    Column("number", Integer, nullable=False),
    # Anchor; all columns are NULL without one, and `altitude_m` is optional.
    *optional(Double, "latitude", "longitude", "altitude_m", "north_deg"),
    *required(UtcDateTime, "created_at", "updated_at"),
    Index("venues_by_tenant_and_age", "tenant", "created_at", "id"),
)

VENUE_PLANS = Table(
    "venue_plans",
    METADATA,
    part_of("venues", "venue_id", primary_key=True),
    part_of("floorplans", "plan_id", primary_key=True),
    Column("level", Double, nullable=False),
    Column("name", Text),
    Index("venue_plans_by_plan", "plan_id"),
    Index("venue_plans_by_level", "venue_id", "level", "plan_id"),
)

TENANTS = Table(
    "tenants",
    METADATA,
    Column("tenant", String(64), primary_key=True),
    # Limits set by the operator; NULL for the limit in the settings.
    *optional(BigInteger, "max_stored_bytes", "max_bytes_in_flight"),
    # Weight of the tenant's CPU seconds in queues; NULL counts as 1.
    Column("cpu_share", Double),
    # Counters of stored bytes by kind, see `stored_bytes.py`.
    *(
        counter(f"{kind}_bytes")
        for kind in ("plans", "grids", "venues", "answers", "sessions", "albums", "idempotency")
    ),
    # Number of changes of plans, grids and venues, and the stored bytes that these changes added. Earlier versions of
    # the service, running beside, count their bytes alone.
    counter("changes"),
    counter("counted_bytes"),
)

API_KEYS = Table(
    "api_keys",
    METADATA,
    *owned(),
    Column("name", Text, nullable=False),
    Column("hash", String(64), nullable=False, unique=True),
    Column("scopes", Text, nullable=False),
    Column("rate_per_minute", Integer),
    Column("created_at", UtcDateTime, nullable=False),
    *optional(UtcDateTime, "revoked_at", "last_used_at", "expires_at"),
    # Lifetime that a successor inherits; rotation shortens `expires_at`.
    Column("lifetime_s", Double),
    Column("replaces", String(32)),
    Index("api_keys_by_age", "created_at", "id"),
)

# Append-only: a trigger refuses updates. No foreign keys, because entries outlive the rows that they are about.
AUDIT_LOG = Table(
    "audit_log",
    METADATA,
    Column("id", String(32), primary_key=True),
    Column("created_at", UtcDateTime, nullable=False),
    Column("actor", String(300), nullable=False),
    # Tenant of the actor, or for operators the tenant that they changed; empty for unknown callers.
    *required(String(64), "tenant", "address"),
    Column("action", String(100), nullable=False),
    Column("resource", String(300), nullable=False),
    Column("status", Integer),
    Column("result", String(64), nullable=False),
    Column("count", Integer, nullable=False),
    Column("request_id", String(64)),
    Column("detail", Text),
    Index("audit_log_by_age", "created_at", "id"),
    Index("audit_log_by_tenant", "tenant", "created_at", "id"),
    Index("audit_log_by_actor", "actor", "created_at", "id"),
)

KEPT_ANSWERS = Table(
    "kept_answers",
    METADATA,
    *owned(),
    part_of("floorplans", "plan_id", nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
    Column("content", Text, nullable=False),
    counter("stored_bytes"),
    Index("kept_answers_by_tenant_and_age", "tenant", "created_at"),
    Index("kept_answers_by_age", "created_at"),
    Index("kept_answers_by_plan", "plan_id"),
)

SESSIONS = Table(
    "sessions",
    METADATA,
    *owned(),
    # Either a plan or a venue, and the revision at which the session began.
    part_of("floorplans", "plan_id"),
    part_of("venues", "venue_id"),
    Column("revision_id", String(32), nullable=False),
    *required(UtcDateTime, "created_at", "expires_at"),
    # The request that began the session, as JSON.
    Column("options", Text, nullable=False),
    Column("photographs", Integer, nullable=False),
    # State and last pose; NULL before the first photograph.
    Column("state", LargeBinary),
    Column("pose", Text),
    # Claim of the photograph that is computed: seconds since 1970 by `Database.now_s`, 0 without one.
    Column("claim", String(32), nullable=False),
    Column("claimed_until_s", Double, nullable=False),
    Column("claim_s", Double),
    counter("stored_bytes"),
    Index("sessions_by_tenant_and_age", "tenant", "expires_at"),
    Index("sessions_by_age", "expires_at"),
    Index("sessions_by_plan", "plan_id"),
    Index("sessions_by_venue", "venue_id"),
)

ALBUMS = Table(
    "albums",
    METADATA,
    *owned(),
    *required(Text, "name", "folded_name"),
    # Either a plan or a venue.
    part_of("floorplans", "plan_id"),
    part_of("venues", "venue_id"),
    # The request that created the album, as JSON.
    Column("options", Text, nullable=False),
    Column("model_sha256", String(64), nullable=False),
    # Revision, which changes with the photographs and their corrections.
    Column("revision_id", String(32), nullable=False),
    Column("number", Integer, nullable=False),
    *required(UtcDateTime, "created_at", "updated_at", "expires_at"),
    Column("photographs", Integer, nullable=False),
    # State that was solved last: number of the album's revision (0: none), revision of the plan or venue, and the
    # highest number of a change of the venue's plans (`floorplans.changed`).
    Column("solved_number", Integer, nullable=False),
    Column("place_revision_id", String(32)),
    Column("place_change", BigInteger, nullable=False),
    # Common part of the solution as JSON, or the reason why there is none.
    *optional(Text, "solution", "failure"),
    # Lease of the replica that solves it: seconds since 1970 by `Database.now_s`, 0 without one.
    Column("owner", String(32), nullable=False),
    Column("lease_until_s", Double, nullable=False),
    Column("lease_s", Double),
    Column("progress", Double, nullable=False),
    # Number of attempts since it was last solved or changed.
    Column("attempts", Integer, nullable=False),
    counter("stored_bytes"),
    Index("albums_by_tenant_and_age", "tenant", "created_at", "id"),
    Index("albums_by_age", "expires_at"),
    Index("albums_by_plan", "plan_id"),
    Index("albums_by_venue", "venue_id"),
)

ALBUM_PHOTOGRAPHS = Table(
    "album_photographs",
    METADATA,
    Column("id", String(32), primary_key=True),
    part_of("albums", "album_id", nullable=False),
    # Position in the album, in the order of uploads.
    Column("number", Integer, nullable=False),
    Column("sha256", String(64), nullable=False),
    # Revision, which changes with the correction.
    Column("revision_id", String(32), nullable=False),
    Column("name", Text),
    Column("created_at", UtcDateTime, nullable=False),
    # Size, time and camera as JSON.
    Column("facts", Text, nullable=False),
    # Features; pictures are not stored.
    Column("entry", LargeBinary, nullable=False),
    *optional(Text, "correction", "pin"),
    # What an attempt to solve the album found about it, until one ends.
    Column("evidence", LargeBinary),
    counter("stored_bytes"),
    UniqueConstraint("album_id", "sha256", name="photographs_of_album"),
    Index("album_photographs_by_number", "album_id", "number"),
)

IDEMPOTENCY = Table(
    "idempotency",
    METADATA,
    Column("tenant", String(64), primary_key=True),
    Column("route", String(64), primary_key=True),
    Column("key", String(255), primary_key=True),
    Column("body_sha256", String(64), nullable=False),
    Column("token", String(32), nullable=False),
    Column("lease_until_s", Double, nullable=False),
    # NULL in rows of earlier versions of the service.
    Column("lease_s", Double),
    Column("created_at", UtcDateTime, nullable=False),
    Column("status", Integer),
    Column("headers", Text),
    Column("body", LargeBinary),
    counter("stored_bytes"),
    Index("idempotency_by_age", "created_at"),
    Index("idempotency_by_tenant_and_age", "tenant", "created_at"),
)
