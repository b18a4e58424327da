"""Albums: photographs of a plan or venue that are solved together."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from service.storage.migrations import counter, optional, owned, part_of, required

revision = "0013"
down_revision = "0012"


def upgrade() -> None:
    """Add the tables, and the counter of their bytes."""
    op.create_table(
        "albums",
        *owned(),
        *required(sa.Text, "name", "folded_name"),
        part_of("floorplans", "plan_id"),
        part_of("venues", "venue_id"),
        sa.Column("options", sa.Text, nullable=False),
        sa.Column("model_sha256", sa.String(64), nullable=False),
        sa.Column("revision_id", sa.String(32), nullable=False),
        sa.Column("number", sa.Integer, nullable=False),
        *required(sa.DateTime(timezone=True), "created_at", "updated_at", "expires_at"),
        *required(sa.Integer, "photographs", "solved_number"),
        sa.Column("place_revision_id", sa.String(32)),
        sa.Column("place_change", sa.BigInteger, nullable=False),
        *optional(sa.Text, "solution", "failure"),
        sa.Column("owner", sa.String(32), nullable=False),
        sa.Column("lease_until_s", sa.Double, nullable=False),
        sa.Column("lease_s", sa.Double),
        sa.Column("progress", sa.Double, nullable=False),
        sa.Column("attempts", sa.Integer, nullable=False),
        counter("stored_bytes"),
    )
    op.create_index("albums_by_tenant_and_age", "albums", ["tenant", "created_at", "id"])
    op.create_index("albums_by_age", "albums", ["expires_at"])
    op.create_index("albums_by_plan", "albums", ["plan_id"])
    op.create_index("albums_by_venue", "albums", ["venue_id"])
    op.create_table(
        "album_photographs",
        sa.Column("id", sa.String(32), primary_key=True),
        part_of("albums", "album_id", nullable=False),
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("revision_id", sa.String(32), nullable=False),
        sa.Column("name", sa.Text),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("facts", sa.Text, nullable=False),
        sa.Column("entry", sa.LargeBinary, nullable=False),
        *optional(sa.Text, "correction", "pin"),
        counter("stored_bytes"),
        sa.UniqueConstraint("album_id", "sha256", name="photographs_of_album"),
    )
    op.create_index("album_photographs_by_number", "album_photographs", ["album_id", "number"])
    op.add_column("tenants", counter("albums_bytes"))
