"""Expiry and rotation of keys, the scope `metrics`, and the audit log."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"

_SQLITE_TRIGGER = """
CREATE TRIGGER audit_log_append_only BEFORE UPDATE ON audit_log
BEGIN SELECT RAISE(ABORT, 'the audit log is append-only'); END
"""
_POSTGRESQL_TRIGGER = """
CREATE FUNCTION audit_log_refuse_update() RETURNS trigger LANGUAGE plpgsql
AS $$ BEGIN RAISE EXCEPTION 'the audit log is append-only'; END $$;
CREATE TRIGGER audit_log_append_only BEFORE UPDATE ON audit_log
FOR EACH ROW EXECUTE FUNCTION audit_log_refuse_update()
"""


def upgrade() -> None:
    """Add columns and table; keys that could read metrics so far, with the scope `read`, get `metrics`."""
    op.add_column("api_keys", sa.Column("expires_at", sa.DateTime(timezone=True)))
    op.add_column("api_keys", sa.Column("lifetime_s", sa.Double))
    op.add_column("api_keys", sa.Column("replaces", sa.String(32)))
    op.create_index("api_keys_by_age", "api_keys", ["created_at", "id"])
    op.execute("UPDATE api_keys SET scopes = scopes || ' metrics' WHERE ' ' || scopes || ' ' LIKE '% read %'")
    op.create_table(
        "audit_log",
        sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("actor", sa.String(300), nullable=False),
        sa.Column("tenant", sa.String(64), nullable=False),
        sa.Column("address", sa.String(64), nullable=False),
        sa.Column("action", sa.String(100), nullable=False),
        sa.Column("resource", sa.String(300), nullable=False),
        sa.Column("status", sa.Integer),
        sa.Column("result", sa.String(64), nullable=False),
        sa.Column("count", sa.Integer, nullable=False),
        sa.Column("request_id", sa.String(64)),
        sa.Column("detail", sa.Text),
    )
    op.create_index("audit_log_by_age", "audit_log", ["created_at", "id"])
    op.create_index("audit_log_by_tenant", "audit_log", ["tenant", "created_at", "id"])
    op.create_index("audit_log_by_actor", "audit_log", ["actor", "created_at", "id"])
    is_postgresql = op.get_bind().dialect.name == "postgresql"
    op.get_bind().exec_driver_sql(_POSTGRESQL_TRIGGER if is_postgresql else _SQLITE_TRIGGER)
