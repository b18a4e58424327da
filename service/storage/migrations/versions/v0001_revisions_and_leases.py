"""First schema with revisions, migrated from the first version of the service.

That version had `floorplans`, `originals` and `latent_grids` or `latent_grids_2`. Plans keep their ids and get one
revision each. Grids are dropped and computed again.
"""

from __future__ import annotations

import hashlib
import uuid

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None

_CHUNK_BYTES = 2**20
_MOMENT = sa.DateTime(timezone=True)
_OLD_PLANS = sa.table(
    "old_floorplans",
    sa.column("id", sa.String),
    sa.column("created_at", _MOMENT),
    sa.column("name", sa.Text),
    sa.column("document", sa.Text),
    sa.column("room_count", sa.Integer),
    sa.column("area_m2", sa.Double),
    sa.column("camera_height_m", sa.Double),
)
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
            sa.Column("id", sa.String(32), primary_key=True),
            sa.Column("tenant", sa.String(64), nullable=False),
            sa.Column("name", sa.Text, nullable=False),
            sa.Column("folded_name", sa.Text, nullable=False),
            sa.Column("revision_id", sa.String(32), nullable=False),
            sa.Column("created_at", _MOMENT, nullable=False),
            sa.Column("updated_at", _MOMENT, nullable=False),
        ),
        op.create_table(
            "revisions",
            sa.Column("id", sa.String(32), primary_key=True),
            sa.Column("plan_id", sa.String(32), sa.ForeignKey("floorplans.id", ondelete="CASCADE"), nullable=False),
            sa.Column("number", sa.Integer, nullable=False),
            sa.Column("created_at", _MOMENT, nullable=False),
            sa.Column("document", sa.Text, nullable=False),
            sa.Column("original_sha256", sa.String(64), nullable=False),
            sa.Column("room_count", sa.Integer, nullable=False),
            sa.Column("area_m2", sa.Double, nullable=False),
            sa.Column("camera_height_m", sa.Double, nullable=False),
            sa.Column("failure", sa.Text),
            sa.UniqueConstraint("plan_id", "number", name="revisions_of_plan"),
        ),
        op.create_table(
            "original_chunks",
            _of_revision(primary_key=True),
            sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
            sa.Column("content", sa.LargeBinary, nullable=False),
        ),
        op.create_table(
            "latent_grids",
            sa.Column("id", sa.Integer, primary_key=True, autoincrement=True),
            _of_revision(),
            sa.Column("model_sha256", sa.String(64), nullable=False),
            sa.Column("step_m", sa.Double, nullable=False),
            sa.Column("camera_height_mm", sa.Integer, nullable=False),
            sa.Column("poses", sa.Integer, nullable=False),
            sa.Column("size_bytes", sa.Integer, nullable=False),
            sa.UniqueConstraint("revision_id", "model_sha256", "step_m", "camera_height_mm", name="latent_grid_key"),
        ),
        op.create_table(
            "grid_chunks",
            sa.Column("grid_id", sa.Integer, sa.ForeignKey("latent_grids.id", ondelete="CASCADE"), primary_key=True),
            sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
            sa.Column("content", sa.LargeBinary, nullable=False),
        ),
        op.create_table(
            "grid_leases",
            _of_revision(primary_key=True),
            sa.Column("model_sha256", sa.String(64), primary_key=True),
            sa.Column("step_m", sa.Double, primary_key=True),
            sa.Column("camera_height_mm", sa.Integer, primary_key=True, autoincrement=False),
            sa.Column("owner", sa.String(32), nullable=False),
            sa.Column("lease_until_s", sa.Double, nullable=False),
            sa.Column("progress", sa.Double, nullable=False),
        ),
        op.create_table(
            "api_keys",
            sa.Column("id", sa.String(32), primary_key=True),
            sa.Column("tenant", sa.String(64), nullable=False),
            sa.Column("name", sa.Text, nullable=False),
            sa.Column("hash", sa.String(64), nullable=False, unique=True),
            sa.Column("scopes", sa.Text, nullable=False),
            sa.Column("rate_per_minute", sa.Integer),
            sa.Column("created_at", _MOMENT, nullable=False),
            sa.Column("revoked_at", _MOMENT),
            sa.Column("last_used_at", _MOMENT),
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


def _of_revision(*, primary_key: bool = False) -> sa.Column[str]:
    owner = sa.ForeignKey("revisions.id", ondelete="CASCADE")
    return sa.Column("revision_id", sa.String(32), owner, primary_key=primary_key, nullable=False)


def _take_over(connection: sa.Connection, tables: dict[str, sa.Table]) -> None:
    # One plan at a time, so that memory does not grow with their number.
    for plan_id in connection.scalars(sa.select(_OLD_PLANS.c.id)).all():
        plan = connection.execute(sa.select(_OLD_PLANS).where(_OLD_PLANS.c.id == plan_id)).one()
        content = connection.scalar(sa.select(_OLD_ORIGINALS.c.content).where(_OLD_ORIGINALS.c.plan_id == plan_id))
        original = content or b""
        revision_id = uuid.uuid4().hex
        connection.execute(
            tables["floorplans"].insert(),
            {
                "id": plan.id,
                "tenant": "default",
                "name": plan.name,
                "folded_name": plan.name.casefold(),
                "revision_id": revision_id,
                "created_at": plan.created_at,
                "updated_at": plan.created_at,
            },
        )
        connection.execute(
            tables["revisions"].insert(),
            {
                "id": revision_id,
                "plan_id": plan.id,
                "number": 1,
                "created_at": plan.created_at,
                "document": plan.document,
                "original_sha256": hashlib.sha256(original).hexdigest(),
                "room_count": plan.room_count,
                "area_m2": plan.area_m2,
                "camera_height_m": plan.camera_height_m,
            },
        )
        for number, first in enumerate(range(0, len(original), _CHUNK_BYTES)):
            chunk = {"number": number, "content": original[first : first + _CHUNK_BYTES]}
            connection.execute(tables["original_chunks"].insert(), {"revision_id": revision_id, **chunk})
