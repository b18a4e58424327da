"""Current schema of the tables; `migrations` creates it, and a test compares the two."""

from __future__ import annotations

from datetime import UTC, datetime

import sqlalchemy as sa
from sqlalchemy.types import TypeDecorator

from service.storage.migrations import chunk, counter, optional, owned, part_of, required

METADATA = sa.MetaData()


class UtcDateTime(TypeDecorator[datetime]):
    """Time in UTC; SQLite drops the time zone, and PostgreSQL can return another one."""

    impl = sa.DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: sa.Dialect) -> datetime | None:
        """Convert a time for the database."""
        return None if value is None else value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: sa.Dialect) -> datetime | None:
        """Convert a time from the database."""
        if value is None:
            return None
        return value.astimezone(UTC) if value.tzinfo else value.replace(tzinfo=UTC)


FLOORPLANS = sa.Table(
    "floorplans",
    METADATA,
    *owned(),
    sa.Column("name", sa.Text, nullable=False),
    # Case-folded name for searches, because databases fold cases differently.
    sa.Column("folded_name", sa.Text, nullable=False),
    # Current revision; no foreign key, because revisions already refer to their plan.
    sa.Column("revision_id", sa.String(32), nullable=False),
    *required(UtcDateTime, "created_at", "updated_at"),
    # Circle around the plan, in its own frame; NULL if an earlier version stored a plan that cannot be read.
    *optional(sa.Double, "centre_x_m", "centre_y_m", "reach_m"),
    # Centre of the circle on Earth; NULL for a plan without an anchor.
    *optional(sa.Double, "latitude", "longitude"),
    # Number of the tenant's change (`tenants.changes`) that last changed what queries of venues read of this plan; 0
    # before the first one.
    counter("changed"),
    sa.Index("floorplans_by_tenant_and_age", "tenant", "created_at", "id"),
    sa.Index("floorplans_by_place", "tenant", "latitude"),
    sa.Index("floorplans_by_revision", "revision_id"),
    sa.Index("floorplans_by_change", "tenant", "changed"),
)

REVISIONS = sa.Table(
    "revisions",
    METADATA,
    sa.Column("id", sa.String(32), primary_key=True),
    part_of("floorplans", "plan_id", nullable=False),
    sa.Column("number", sa.Integer, nullable=False),
    sa.Column("created_at", UtcDateTime, nullable=False),
    sa.Column("document", sa.Text, nullable=False),
    # NULL in rows of earlier versions of the service.
    sa.Column("document_sha256", sa.String(64)),
    sa.Column("warnings", sa.Text),
    sa.Column("original_sha256", sa.String(64), nullable=False),
    # NULL in rows of earlier versions of the service: JSON in the native format, without a report.
    sa.Column("original_media_type", sa.String(64)),
    sa.Column("report", sa.Text),
    sa.Column("room_count", sa.Integer, nullable=False),
    *required(sa.Double, "area_m2", "camera_height_m"),
    # NULL for an unknown camera height, and in rows of earlier versions of the service.
    sa.Column("camera_height_std_m", sa.Double),
    sa.Column("failure", sa.Text),
    counter("stored_bytes"),
    sa.UniqueConstraint("plan_id", "number", name="revisions_of_plan"),
)

ORIGINAL_CHUNKS = sa.Table("original_chunks", METADATA, part_of("revisions", "revision_id", primary_key=True), *chunk())

LATENT_GRIDS = sa.Table(
    "latent_grids",
    METADATA,
    sa.Column("id", sa.Integer, primary_key=True, autoincrement=True),
    part_of("revisions", "revision_id", nullable=False),
    sa.Column("model_sha256", sa.String(64), nullable=False),
    sa.Column("step_m", sa.Double, nullable=False),
    *required(sa.Integer, "camera_height_mm", "poses", "size_bytes"),
    # NULL in rows of earlier versions of the service, which do not count as stored.
    sa.Column("sha256", sa.String(64)),
    # Input of the choice among a venue's plans; NULL in rows of earlier versions of the service.
    sa.Column("prototypes", sa.LargeBinary),
    counter("stored_bytes"),
    sa.UniqueConstraint("revision_id", "model_sha256", "step_m", "camera_height_mm", name="latent_grid_key"),
)

GRID_CHUNKS = sa.Table(
    "grid_chunks",
    METADATA,
    sa.Column("grid_id", sa.Integer, sa.ForeignKey("latent_grids.id", ondelete="CASCADE"), primary_key=True),
    *chunk(),
)

GRID_LEASES = sa.Table(
    "grid_leases",
    METADATA,
    part_of("revisions", "revision_id", primary_key=True),
    sa.Column("model_sha256", sa.String(64), primary_key=True),
    sa.Column("step_m", sa.Double, primary_key=True),
    sa.Column("camera_height_mm", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("owner", sa.String(32), nullable=False),
    # Seconds since 1970 by `Database.now_s`, the clock that all owners share.
    sa.Column("lease_until_s", sa.Double, nullable=False),
    # NULL in rows of earlier versions of the service.
    sa.Column("length_s", sa.Double),
    sa.Column("progress", sa.Double, nullable=False),
    # Number of attempts since the grid was last finished or abandoned.
    sa.Column("attempts", sa.Integer, nullable=False, server_default="1"),
)

VENUES = sa.Table(
    "venues",
    METADATA,
    *owned(),
    *required(sa.Text, "name", "folded_name"),
    sa.Column("revision_id", sa.String(32), nullable=False),
    sa.Column("number", sa.Integer, nullable=False),
    # Anchor; all columns are NULL without one, and `altitude_m` is optional.
    *optional(sa.Double, "latitude", "longitude", "altitude_m", "north_deg"),
    *required(UtcDateTime, "created_at", "updated_at"),
    sa.Index("venues_by_tenant_and_age", "tenant", "created_at", "id"),
)

VENUE_PLANS = sa.Table(
    "venue_plans",
    METADATA,
    part_of("venues", "venue_id", primary_key=True),
    part_of("floorplans", "plan_id", primary_key=True),
    sa.Column("level", sa.Double, nullable=False),
    sa.Column("name", sa.Text),
    sa.Index("venue_plans_by_plan", "plan_id"),
    sa.Index("venue_plans_by_level", "venue_id", "level", "plan_id"),
)

TENANTS = sa.Table(
    "tenants",
    METADATA,
    sa.Column("tenant", sa.String(64), primary_key=True),
    # Limits set by the operator; NULL for the limit in the settings.
    *optional(sa.BigInteger, "max_stored_bytes", "max_bytes_in_flight"),
    # Weight of the tenant's CPU seconds in queues; NULL counts as 1.
    sa.Column("cpu_share", sa.Double),
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

API_KEYS = sa.Table(
    "api_keys",
    METADATA,
    *owned(),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("hash", sa.String(64), nullable=False, unique=True),
    sa.Column("scopes", sa.Text, nullable=False),
    sa.Column("rate_per_minute", sa.Integer),
    sa.Column("created_at", UtcDateTime, nullable=False),
    *optional(UtcDateTime, "revoked_at", "last_used_at", "expires_at"),
    # Lifetime that a successor inherits; rotation shortens `expires_at`.
    sa.Column("lifetime_s", sa.Double),
    sa.Column("replaces", sa.String(32)),
    sa.Index("api_keys_by_age", "created_at", "id"),
)

# Append-only: a trigger refuses updates. No foreign keys, because entries outlive the rows that they are about.
AUDIT_LOG = sa.Table(
    "audit_log",
    METADATA,
    sa.Column("id", sa.String(32), primary_key=True),
    sa.Column("created_at", UtcDateTime, nullable=False),
    sa.Column("actor", sa.String(300), nullable=False),
    # Tenant of the actor, or for operators the tenant that they changed; empty for unknown callers.
    *required(sa.String(64), "tenant", "address"),
    sa.Column("action", sa.String(100), nullable=False),
    sa.Column("resource", sa.String(300), nullable=False),
    sa.Column("status", sa.Integer),
    sa.Column("result", sa.String(64), nullable=False),
    sa.Column("count", sa.Integer, nullable=False),
    sa.Column("request_id", sa.String(64)),
    sa.Column("detail", sa.Text),
    sa.Index("audit_log_by_age", "created_at", "id"),
    sa.Index("audit_log_by_tenant", "tenant", "created_at", "id"),
    sa.Index("audit_log_by_actor", "actor", "created_at", "id"),
)

KEPT_ANSWERS = sa.Table(
    "kept_answers",
    METADATA,
    *owned(),
    part_of("floorplans", "plan_id", nullable=False),
    sa.Column("created_at", UtcDateTime, nullable=False),
    sa.Column("content", sa.Text, nullable=False),
    counter("stored_bytes"),
    sa.Index("kept_answers_by_tenant_and_age", "tenant", "created_at"),
    sa.Index("kept_answers_by_age", "created_at"),
    sa.Index("kept_answers_by_plan", "plan_id"),
)

SESSIONS = sa.Table(
    "sessions",
    METADATA,
    *owned(),
    # Either a plan or a venue, and the revision at which the session began.
    part_of("floorplans", "plan_id"),
    part_of("venues", "venue_id"),
    sa.Column("revision_id", sa.String(32), nullable=False),
    *required(UtcDateTime, "created_at", "expires_at"),
    # The request that began the session, as JSON.
    sa.Column("options", sa.Text, nullable=False),
    sa.Column("photographs", sa.Integer, nullable=False),
    # State and last pose; NULL before the first photograph.
    sa.Column("state", sa.LargeBinary),
    sa.Column("pose", sa.Text),
    # Claim of the photograph that is computed: seconds since 1970 by `Database.now_s`, 0 without one.
    sa.Column("claim", sa.String(32), nullable=False),
    sa.Column("claimed_until_s", sa.Double, nullable=False),
    sa.Column("claim_s", sa.Double),
    counter("stored_bytes"),
    sa.Index("sessions_by_tenant_and_age", "tenant", "expires_at"),
    sa.Index("sessions_by_age", "expires_at"),
    sa.Index("sessions_by_plan", "plan_id"),
    sa.Index("sessions_by_venue", "venue_id"),
)

ALBUMS = sa.Table(
    "albums",
    METADATA,
    *owned(),
    *required(sa.Text, "name", "folded_name"),
    # Either a plan or a venue.
    part_of("floorplans", "plan_id"),
    part_of("venues", "venue_id"),
    # The request that created the album, as JSON.
    sa.Column("options", sa.Text, nullable=False),
    sa.Column("model_sha256", sa.String(64), nullable=False),
    # Revision, which changes with the photographs and their corrections.
    sa.Column("revision_id", sa.String(32), nullable=False),
    sa.Column("number", sa.Integer, nullable=False),
    *required(UtcDateTime, "created_at", "updated_at", "expires_at"),
    sa.Column("photographs", sa.Integer, nullable=False),
    # State that was solved last: number of the album's revision (0: none), revision of the plan or venue, and the
    # highest number of a change of the venue's plans (`floorplans.changed`).
    sa.Column("solved_number", sa.Integer, nullable=False),
    sa.Column("place_revision_id", sa.String(32)),
    sa.Column("place_change", sa.BigInteger, nullable=False),
    # Common part of the solution as JSON, or the reason why there is none.
    *optional(sa.Text, "solution", "failure"),
    # Lease of the replica that solves it: seconds since 1970 by `Database.now_s`, 0 without one.
    sa.Column("owner", sa.String(32), nullable=False),
    sa.Column("lease_until_s", sa.Double, nullable=False),
    sa.Column("lease_s", sa.Double),
    sa.Column("progress", sa.Double, nullable=False),
    # Number of attempts since it was last solved or changed.
    sa.Column("attempts", sa.Integer, nullable=False),
    counter("stored_bytes"),
    sa.Index("albums_by_tenant_and_age", "tenant", "created_at", "id"),
    sa.Index("albums_by_age", "expires_at"),
    sa.Index("albums_by_plan", "plan_id"),
    sa.Index("albums_by_venue", "venue_id"),
)

ALBUM_PHOTOGRAPHS = sa.Table(
    "album_photographs",
    METADATA,
    sa.Column("id", sa.String(32), primary_key=True),
    part_of("albums", "album_id", nullable=False),
    # Position in the album, in the order of uploads.
    sa.Column("number", sa.Integer, nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False),
    # Revision, which changes with the correction.
    sa.Column("revision_id", sa.String(32), nullable=False),
    sa.Column("name", sa.Text),
    sa.Column("created_at", UtcDateTime, nullable=False),
    # Size, time and camera as JSON.
    sa.Column("facts", sa.Text, nullable=False),
    # Features; pictures are not stored.
    sa.Column("entry", sa.LargeBinary, nullable=False),
    *optional(sa.Text, "correction", "pin"),
    # What an attempt to solve the album found about it, until one ends.
    sa.Column("evidence", sa.LargeBinary),
    counter("stored_bytes"),
    sa.UniqueConstraint("album_id", "sha256", name="photographs_of_album"),
    sa.Index("album_photographs_by_number", "album_id", "number"),
)

IDEMPOTENCY = sa.Table(
    "idempotency",
    METADATA,
    sa.Column("tenant", sa.String(64), primary_key=True),
    sa.Column("route", sa.String(64), primary_key=True),
    sa.Column("key", sa.String(255), primary_key=True),
    sa.Column("body_sha256", sa.String(64), nullable=False),
    sa.Column("token", sa.String(32), nullable=False),
    sa.Column("lease_until_s", sa.Double, nullable=False),
    # NULL in rows of earlier versions of the service.
    sa.Column("lease_s", sa.Double),
    sa.Column("created_at", UtcDateTime, nullable=False),
    sa.Column("status", sa.Integer),
    sa.Column("headers", sa.Text),
    sa.Column("body", sa.LargeBinary),
    counter("stored_bytes"),
    sa.Index("idempotency_by_age", "created_at"),
    sa.Index("idempotency_by_tenant_and_age", "tenant", "created_at"),
)
