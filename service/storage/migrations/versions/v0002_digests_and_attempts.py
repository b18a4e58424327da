"""Digests of grids and plans, stored warnings of plans, and lengths of leases.

Grids without a digest are dropped and computed again, because they cannot be verified. Plans without a digest are
validated when they are read, as before.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Add the columns, and drop the grids."""
    op.execute("DELETE FROM grid_chunks")
    op.execute("DELETE FROM latent_grids")
    op.add_column("latent_grids", sa.Column("sha256", sa.String(64)))
    op.add_column("revisions", sa.Column("document_sha256", sa.String(64)))
    op.add_column("revisions", sa.Column("warnings", sa.Text))
    op.add_column("grid_leases", sa.Column("length_s", sa.Double))
    op.add_column("grid_leases", sa.Column("attempts", sa.Integer, nullable=False, server_default="1"))
    op.add_column("idempotency", sa.Column("lease_s", sa.Double))
