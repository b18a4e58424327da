"""Places of plans, in their own frame and, with an anchor, on Earth, for searches by place."""

from __future__ import annotations

import json
import math

import numpy as np
import sqlalchemy as sa
from alembic import op

from lalaloc_core.floorplan.earth import Anchor

revision = "0006"
down_revision = "0005"

_COLUMNS = ("centre_x_m", "centre_y_m", "reach_m", "latitude", "longitude")
# Plans per read.
_BATCH_SIZE = 500


def upgrade() -> None:
    """Add the columns, and fill them from the plans; a plan that cannot be read has no place."""
    for name in _COLUMNS:
        op.add_column("floorplans", sa.Column(name, sa.Double))
    op.create_index("floorplans_by_place", "floorplans", ["tenant", "latitude"])
    plans = sa.table("floorplans", sa.column("id"), sa.column("revision_id"), *(sa.column(name) for name in _COLUMNS))
    revisions = sa.table("revisions", sa.column("id"), sa.column("document"))
    connection, last = op.get_bind(), ""
    while True:
        query = (
            sa.select(plans.c.id, revisions.c.document)
            .join_from(plans, revisions, plans.c.revision_id == revisions.c.id)
            .where(plans.c.id > last)
            .order_by(plans.c.id)
            .limit(_BATCH_SIZE)
        )
        rows = connection.execute(query).all()
        for row in rows:
            values = _place(row.document)
            if values is not None:
                connection.execute(plans.update().where(plans.c.id == row.id).values(**values))
        if len(rows) < _BATCH_SIZE:
            return
        last = rows[-1].id


def _place(document: str) -> dict[str, float] | None:
    try:
        plan = json.loads(document)
        corners = np.concatenate([np.array(room["polygon"], dtype=float) for room in plan["rooms"]])
        low, high = corners.min(axis=0), corners.max(axis=0)
        x_m, y_m = (0.5 * (low + high)).tolist()
        values = {"centre_x_m": x_m, "centre_y_m": y_m, "reach_m": 0.5 * math.dist(low, high)}
        if plan.get("anchor") is not None:
            anchor = Anchor(plan["anchor"]["latitude"], plan["anchor"]["longitude"], None, plan.get("north_deg") or 0.0)
            ((longitude, latitude),) = anchor.to_earth(np.array([[x_m, y_m]]))
            values |= {"latitude": float(latitude), "longitude": float(longitude)}
    except (ValueError, TypeError, KeyError):
        return None
    return values if all(math.isfinite(value) for value in values.values()) else None
