"""Numbers of changes, by which queries of venues find the plans that changed."""

from __future__ import annotations

from alembic import op

from service.storage.migrations import counter

revision = "0012"
down_revision = "0011"


def upgrade() -> None:
    """Add the columns; plans that did not change since have number 0."""
    for name in ("changes", "counted_bytes"):
        op.add_column("tenants", counter(name))
    op.add_column("floorplans", counter("changed"))
    op.create_index("floorplans_by_change", "floorplans", ["tenant", "changed"])
