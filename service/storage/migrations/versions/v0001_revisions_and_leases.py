"""First schema with revisions, migrated from the first version of the service.

That version had `floorplans`, `originals` and `latent_grids` or `latent_grids_2`. Plans keep their ids and get one
revision each. Grids are dropped and computed again.
"""

from __future__ import annotations

import hashlib
import uuid

import sqlalchemy as sa
from alembic import op

from service.storage.migrations import chunk, optional, owned, part_of, required

revision = "0001"
down_revision = None

_CHUNK_BYTES = 2**20
_MOMENT = sa.DateTime(timezone=True)
# Columns that move to the first revision of a plan as they are.
_MOVED = ("created_at", "document", "room_count", "area_m2", "camera_height_m")
_OLD_PLANS = sa.table("old_floorplans", sa.column("created_at", _MOMENT), *map(sa.column, ("id", "name", *_MOVED[1:])))
_OLD_ORIGINALS = sa.table("old_originals", sa.column("plan_id", sa.String), sa.column("content", sa.LargeBinary))


def upgrade() -> None:
    """Create the tables, and move the data of the first version into them."""
    connection = op.get_bind()
    before = set(sa.inspect(connection).get_table_names())
    old = "floorplans" in before
    if old:
        for name in sorted(before & {"latent_grids", "latent_grids_2"}):
            op.drop_table(name)
        op.drop_index("floorplans_by_age", "floorplans")
        op.rename_table("originals", "old_originals")
        op.rename_table("floorplans", "old_floorplans")
    tables = _create()
    if old:
        _take_over(connection, tables)
        op.drop_table("old_originals")
        op.drop_table("old_floorplans")


def _create() -> dict[str, sa.Table]:
    made = [
        op.create_table(
            "floorplans",
            *owned(),
            *required(sa.Text, "name", "folded_name"),
            sa.Column("revision_id", sa.String(32), nullable=False),
            *required(_MOMENT, "created_at", "updated_at"),
        ),
        op.create_table(
            "revisions",
            sa.Column("id", sa.String(32), primary_key=True),
            part_of("floorplans", "plan_id", nullable=False),
            sa.Column("number", sa.Integer, nullable=False),
            sa.Column("created_at", _MOMENT, nullable=False),
            sa.Column("document", sa.Text, nullable=False),
            sa.Column("original_sha256", sa.String(64), nullable=False),
            sa.Column("room_count", sa.Integer, nullable=False),
            *required(sa.Double, "area_m2", "camera_height_m"),
            sa.Column("failure", sa.Text),
            sa.UniqueConstraint("plan_id", "number", name="revisions_of_plan"),
        ),
        op.create_table("original_chunks", part_of("revisions", "revision_id", primary_key=True), *chunk()),
        op.create_table(
            "latent_grids",
            sa.Column("id", sa.Integer, primary_key=True, autoincrement=True),
            part_of("revisions", "revision_id", nullable=False),
            sa.Column("model_sha256", sa.String(64), nullable=False),
            sa.Column("step_m", sa.Double, nullable=False),
            *required(sa.Integer, "camera_height_mm", "poses", "size_bytes"),
            sa.UniqueConstraint("revision_id", "model_sha256", "step_m", "camera_height_mm", name="latent_grid_key"),
        ),
        op.create_table(
            "grid_chunks",
            sa.Column("grid_id", sa.Integer, sa.ForeignKey("latent_grids.id", ondelete="CASCADE"), primary_key=True),
            *chunk(),
        ),
        op.create_table(
            "grid_leases",
            part_of("revisions", "revision_id", primary_key=True),
            sa.Column("model_sha256", sa.String(64), primary_key=True),
            sa.Column("step_m", sa.Double, primary_key=True),
            sa.Column("camera_height_mm", sa.Integer, primary_key=True, autoincrement=False),
            sa.Column("owner", sa.String(32), nullable=False),
            *required(sa.Double, "lease_until_s", "progress"),
        ),
        op.create_table(
            "api_keys",
            *owned(),
            sa.Column("name", sa.Text, nullable=False),
            sa.Column("hash", sa.String(64), nullable=False, unique=True),
            sa.Column("scopes", sa.Text, nullable=False),
            sa.Column("rate_per_minute", sa.Integer),
            sa.Column("created_at", _MOMENT, nullable=False),
            *optional(_MOMENT, "revoked_at", "last_used_at"),
        ),
        op.create_table(
            "idempotency",
            sa.Column("tenant", sa.String(64), primary_key=True),
            sa.Column("route", sa.String(64), primary_key=True),
            sa.Column("key", sa.String(255), primary_key=True),
            sa.Column("body_sha256", sa.String(64), nullable=False),
            sa.Column("token", sa.String(32), nullable=False),
            sa.Column("lease_until_s", sa.Double, nullable=False),
            sa.Column("created_at", _MOMENT, nullable=False),
            sa.Column("status", sa.Integer),
            sa.Column("headers", sa.Text),
            sa.Column("body", sa.LargeBinary),
        ),
    ]
    op.create_index("floorplans_by_tenant_and_age", "floorplans", ["tenant", "created_at", "id"])
    op.create_index("floorplans_by_revision", "floorplans", ["revision_id"])
    op.create_index("idempotency_by_age", "idempotency", ["created_at"])
    return {table.name: table for table in made}


def _take_over(connection: sa.Connection, tables: dict[str, sa.Table]) -> None:
    # One plan at a time, so that memory does not grow with their number.
    for plan_id in connection.scalars(sa.select(_OLD_PLANS.c.id)).all():
        plan = connection.execute(sa.select(_OLD_PLANS).where(_OLD_PLANS.c.id == plan_id)).one()
        content = connection.scalar(sa.select(_OLD_ORIGINALS.c.content).where(_OLD_ORIGINALS.c.plan_id == plan_id))
        original, revision = content or b"", uuid.uuid4().hex
        connection.execute(
            tables["floorplans"].insert(),
            {
                "id": plan.id,
                "tenant": "default",
                "name": plan.name,
                "folded_name": plan.name.casefold(),
                "revision_id": revision,
                "created_at": plan.created_at,
                "updated_at": plan.created_at,
            },
        )
        connection.execute(
            tables["revisions"].insert(),
            {
                "id": revision,
                "plan_id": plan.id,
                "number": 1,
                "original_sha256": hashlib.sha256(original).hexdigest(),
                **{name: getattr(plan, name) for name in _MOVED},
            },
        )
        for number, first in enumerate(range(0, len(original), _CHUNK_BYTES)):
            part = {"number": number, "content": original[first : first + _CHUNK_BYTES]}
            connection.execute(tables["original_chunks"].insert(), {"revision_id": revision, **part})
