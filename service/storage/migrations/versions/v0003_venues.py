"""Venues, and prototypes of plans beside their grids.

Prototypes of grids that were stored before are made on demand. Plans that were stored before have no deviation of their
camera height, so venues treat it as unknown.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Add the tables and the columns."""
    moment = sa.DateTime(timezone=True)
    op.create_table(
        "venues",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("tenant", sa.String(64), nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("folded_name", sa.Text, nullable=False),
        sa.Column("revision_id", sa.String(32), nullable=False),
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("latitude", sa.Double),
        sa.Column("longitude", sa.Double),
        sa.Column("altitude_m", sa.Double),
        sa.Column("north_deg", sa.Double),
        sa.Column("created_at", moment, nullable=False),
        sa.Column("updated_at", moment, nullable=False),
    )
    op.create_index("venues_by_tenant_and_age", "venues", ["tenant", "created_at", "id"])
    op.create_table(
        "venue_plans",
        sa.Column("venue_id", sa.String(32), sa.ForeignKey("venues.id", ondelete="CASCADE"), primary_key=True),
        sa.Column("plan_id", sa.String(32), sa.ForeignKey("floorplans.id", ondelete="CASCADE"), primary_key=True),
        sa.Column("level", sa.Double, nullable=False),
        sa.Column("name", sa.Text),
    )
    op.create_index("venue_plans_by_plan", "venue_plans", ["plan_id"])
    op.create_index("venue_plans_by_level", "venue_plans", ["venue_id", "level", "plan_id"])
    op.add_column("latent_grids", sa.Column("prototypes", sa.LargeBinary))
    op.add_column("revisions", sa.Column("camera_height_std_m", sa.Double))
