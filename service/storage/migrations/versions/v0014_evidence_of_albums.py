"""Evidence of photographs, by which an album that was being solved when the service died is not begun again."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"


def upgrade() -> None:
    """Add the column; earlier versions of the service, running beside, leave it empty."""
    op.add_column("album_photographs", sa.Column("evidence", sa.LargeBinary))
