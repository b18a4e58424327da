"""Albums: photographs of a plan or venue that are solved together."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"


def upgrade() -> None:
    """Add the tables, and the counter of their bytes."""
    op.create_table(
        "albums",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("tenant", sa.String(64), nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("folded_name", sa.Text, nullable=False),
        sa.Column("plan_id", sa.String(32), sa.ForeignKey("floorplans.id", ondelete="CASCADE")),
        sa.Column("venue_id", sa.String(32), sa.ForeignKey("venues.id", ondelete="CASCADE")),
        sa.Column("options", sa.Text, nullable=False),
        sa.Column("model_sha256", sa.String(64), nullable=False),
        sa.Column("revision_id", sa.String(32), nullable=False),
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("updated_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("photographs", sa.Integer, nullable=False),
        sa.Column("solved_number", sa.Integer, nullable=False),
        sa.Column("place_revision_id", sa.String(32)),
        sa.Column("place_change", sa.BigInteger, nullable=False),
        sa.Column("solution", sa.Text),
        sa.Column("failure", sa.Text),
        sa.Column("owner", sa.String(32), nullable=False),
        sa.Column("lease_until_s", sa.Double, nullable=False),
        sa.Column("lease_s", sa.Double),
        sa.Column("progress", sa.Double, nullable=False),
        sa.Column("attempts", sa.Integer, nullable=False),
        sa.Column("stored_bytes", sa.BigInteger, nullable=False, server_default="0"),
    )
    op.create_index("albums_by_tenant_and_age", "albums", ["tenant", "created_at", "id"])
    op.create_index("albums_by_age", "albums", ["expires_at"])
    op.create_index("albums_by_plan", "albums", ["plan_id"])
    op.create_index("albums_by_venue", "albums", ["venue_id"])
    op.create_table(
        "album_photographs",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("album_id", sa.String(32), sa.ForeignKey("albums.id", ondelete="CASCADE"), nullable=False),
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("revision_id", sa.String(32), nullable=False),
        sa.Column("name", sa.Text),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("facts", sa.Text, nullable=False),
        sa.Column("entry", sa.LargeBinary, nullable=False),
        sa.Column("correction", sa.Text),
        sa.Column("pin", sa.Text),
        sa.Column("stored_bytes", sa.BigInteger, nullable=False, server_default="0"),
        sa.UniqueConstraint("album_id", "sha256", name="photographs_of_album"),
    )
    op.create_index("album_photographs_by_number", "album_photographs", ["album_id", "number"])
    op.add_column("tenants", sa.Column("albums_bytes", sa.BigInteger, nullable=False, server_default="0"))
