"""Stored bytes of rows, and their sums per tenant."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from service.storage.migrations import counter

revision = "0008"
down_revision = "0007"

# Estimated overhead of a row.
_ROW = 512
# Stored bytes of a row by table. The texts are ASCII, so that characters are bytes.
_SIZES = {
    "revisions": f"{_ROW} + length(document) + coalesce(length(warnings), 0) + coalesce(length(report), 0) + coalesce("
    "(SELECT sum(length(content)) FROM original_chunks WHERE revision_id = revisions.id), 0)",
    "latent_grids": f"{_ROW} + size_bytes + coalesce(length(prototypes), 0)",
    "kept_answers": f"{_ROW} + length(content)",
    "idempotency": f"{_ROW} + coalesce(length(headers), 0) + coalesce(length(body), 0)",
}
# Tenant and stored bytes of each row, by kind.
_KINDS = {
    "plans": "SELECT p.tenant, r.stored_bytes FROM floorplans p JOIN revisions r ON r.plan_id = p.id",
    "grids": "SELECT p.tenant, g.stored_bytes FROM floorplans p JOIN revisions r ON r.plan_id = p.id "
    "JOIN latent_grids g ON g.revision_id = r.id",
    "venues": f"SELECT tenant, {_ROW} AS stored_bytes FROM venues UNION ALL "
    f"SELECT v.tenant, {_ROW} FROM venues v JOIN venue_plans m ON m.venue_id = v.id",
    "answers": "SELECT tenant, stored_bytes FROM kept_answers",
    "idempotency": "SELECT tenant, stored_bytes FROM idempotency",
}


def upgrade() -> None:
    """Add the columns, and fill them."""
    connection = op.get_bind()
    for table, size in _SIZES.items():
        op.add_column(table, counter("stored_bytes"))
        connection.execute(sa.text(f"UPDATE {table} SET stored_bytes = {size}"))
    op.create_index("idempotency_by_tenant_and_age", "idempotency", ["tenant", "created_at"])
    for kind, rows in _KINDS.items():
        op.add_column("tenants", counter(f"{kind}_bytes"))
        connection.execute(
            sa.text(
                f"INSERT INTO tenants (tenant, {kind}_bytes) SELECT tenant, sum(stored_bytes) FROM ({rows}) AS counted "
                f"WHERE true GROUP BY tenant ON CONFLICT (tenant) DO UPDATE SET {kind}_bytes = excluded.{kind}_bytes"
            )
        )
