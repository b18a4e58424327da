"""Table of kept answers."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from service.storage.migrations import owned, part_of

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    """Add the table."""
    op.create_table(
        "kept_answers",
        *owned(),
        part_of("floorplans", "plan_id", nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("content", sa.Text, nullable=False),
    )
    op.create_index("kept_answers_by_tenant_and_age", "kept_answers", ["tenant", "created_at"])
    op.create_index("kept_answers_by_age", "kept_answers", ["created_at"])
    op.create_index("kept_answers_by_plan", "kept_answers", ["plan_id"])
