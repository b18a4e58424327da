"""The media type of the file that a plan was uploaded as, and the report of how it was read."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Add the columns; plans of before were JSON, and nothing was told of reading them."""
    op.add_column("revisions", sa.Column("original_media_type", sa.String(64)))
    op.add_column("revisions", sa.Column("report", sa.Text))
