"""Sessions in venues."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"


def upgrade() -> None:
    """Let a session have a venue instead of a plan."""
    with op.batch_alter_table("sessions") as table:
        table.alter_column("plan_id", existing_type=sa.String(32), nullable=True)
        table.add_column(sa.Column("venue_id", sa.String(32), nullable=True))
        table.create_foreign_key("sessions_of_venue", "venues", ["venue_id"], ["id"], ondelete="CASCADE")
        table.create_index("sessions_by_venue", ["venue_id"])
