"""Sessions of tracked cameras."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from service.storage.migrations import counter, owned, part_of, required

revision = "0009"
down_revision = "0008"


def upgrade() -> None:
    """Add the table, and the counter of its bytes."""
    op.create_table(
        "sessions",
        *owned(),
        part_of("floorplans", "plan_id", nullable=False),
        sa.Column("revision_id", sa.String(32), nullable=False),
        *required(sa.DateTime(timezone=True), "created_at", "expires_at"),
        sa.Column("options", sa.Text, nullable=False),
        sa.Column("photographs", sa.Integer, nullable=False),
        sa.Column("state", sa.LargeBinary),
        sa.Column("pose", sa.Text),
        sa.Column("claim", sa.String(32), nullable=False),
        sa.Column("claimed_until_s", sa.Double, nullable=False),
        sa.Column("claim_s", sa.Double),
        counter("stored_bytes"),
    )
    op.create_index("sessions_by_tenant_and_age", "sessions", ["tenant", "expires_at"])
    op.create_index("sessions_by_age", "sessions", ["expires_at"])
    op.create_index("sessions_by_plan", "sessions", ["plan_id"])
    op.add_column("tenants", counter("sessions_bytes"))
