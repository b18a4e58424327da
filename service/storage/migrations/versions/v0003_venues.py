"""Venues, and prototypes of plans beside their grids.

Prototypes of grids that were stored before are made on demand. Plans that were stored before have no deviation of their
camera height, so venues treat it as unknown.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from service.storage.migrations import optional, owned, part_of, required

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Add the tables and the columns."""
    op.create_table(
        "venues",
        *owned(),
        *required(sa.Text, "name", "folded_name"),
        sa.Column("revision_id", sa.String(32), nullable=False),
        sa.Column("number", sa.Integer, nullable=False),
        *optional(sa.Double, "latitude", "longitude", "altitude_m", "north_deg"),
        *required(sa.DateTime(timezone=True), "created_at", "updated_at"),
    )
    op.create_index("venues_by_tenant_and_age", "venues", ["tenant", "created_at", "id"])
    op.create_table(
        "venue_plans",
        part_of("venues", "venue_id", primary_key=True),
        part_of("floorplans", "plan_id", primary_key=True),
        sa.Column("level", sa.Double, nullable=False),
        sa.Column("name", sa.Text),
    )
    op.create_index("venue_plans_by_plan", "venue_plans", ["plan_id"])
    op.create_index("venue_plans_by_level", "venue_plans", ["venue_id", "level", "plan_id"])
    op.add_column("latent_grids", sa.Column("prototypes", sa.LargeBinary))
    op.add_column("revisions", sa.Column("camera_height_std_m", sa.Double))
