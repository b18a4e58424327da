"""Table of kept answers."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    """Add the table."""
    op.create_table(
        "kept_answers",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("tenant", sa.String(64), nullable=False),
        sa.Column("plan_id", sa.String(32), sa.ForeignKey("floorplans.id", ondelete="CASCADE"), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("content", sa.Text, nullable=False),
    )
    op.create_index("kept_answers_by_tenant_and_age", "kept_answers", ["tenant", "created_at"])
    op.create_index("kept_answers_by_age", "kept_answers", ["created_at"])
    op.create_index("kept_answers_by_plan", "kept_answers", ["plan_id"])
