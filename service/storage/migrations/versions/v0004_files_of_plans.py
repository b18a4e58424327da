"""Media type of a plan's uploaded file, and the report of its import."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Add the columns; earlier plans were JSON and have no report."""
    op.add_column("revisions", sa.Column("original_media_type", sa.String(64)))
    op.add_column("revisions", sa.Column("report", sa.Text))
