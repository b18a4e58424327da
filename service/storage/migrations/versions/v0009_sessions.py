"""Sessions of tracked cameras."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"


def upgrade() -> None:
    """Add the table, and the counter of its bytes."""
    op.create_table(
        "sessions",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("tenant", sa.String(64), nullable=False),
        sa.Column("plan_id", sa.String(32), sa.ForeignKey("floorplans.id", ondelete="CASCADE"), nullable=False),
        sa.Column("revision_id", sa.String(32), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("options", sa.Text, nullable=False),
        sa.Column("photographs", sa.Integer, nullable=False),
        sa.Column("state", sa.LargeBinary),
        sa.Column("pose", sa.Text),
        sa.Column("claim", sa.String(32), nullable=False),
        sa.Column("claimed_until_s", sa.Double, nullable=False),
        sa.Column("claim_s", sa.Double),
        sa.Column("stored_bytes", sa.BigInteger, nullable=False, server_default="0"),
    )
    op.create_index("sessions_by_tenant_and_age", "sessions", ["tenant", "expires_at"])
    op.create_index("sessions_by_age", "sessions", ["expires_at"])
    op.create_index("sessions_by_plan", "sessions", ["plan_id"])
    op.add_column("tenants", sa.Column("sessions_bytes", sa.BigInteger, nullable=False, server_default="0"))
