"""Numbers of changes, by which queries of venues find the plans that changed."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"


def upgrade() -> None:
    """Add the columns; plans that did not change since have number 0."""
    for name in ("changes", "counted_bytes"):
        op.add_column("tenants", sa.Column(name, sa.BigInteger, nullable=False, server_default="0"))
    op.add_column("floorplans", sa.Column("changed", sa.BigInteger, nullable=False, server_default="0"))
    op.create_index("floorplans_by_change", "floorplans", ["tenant", "changed"])
