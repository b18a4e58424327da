"""Table of tenants, with the limits that the operator sets."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"


def upgrade() -> None:
    """Add the table; a tenant without a row has the limits in the settings."""
    op.create_table(
        "tenants",
        sa.Column("tenant", sa.String(64), primary_key=True),
        sa.Column("max_stored_bytes", sa.BigInteger),
        sa.Column("max_bytes_in_flight", sa.BigInteger),
        sa.Column("cpu_share", sa.Double),
    )
