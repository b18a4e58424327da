"""Brings the schema up to date when the service starts; replicas that start together take turns."""

from __future__ import annotations

from pathlib import Path

from alembic.migration import MigrationContext
from alembic.operations import Operations
from alembic.script import ScriptDirectory
from sqlalchemy import text

from service.storage.database import Database

_SCRIPTS = Path(__file__).parent / "migrations"
# Any number, but always the same one; it must differ from the other advisory locks, see `plans`.
_LOCK = 5_210_001


def migrate(database: Database) -> None:
    """Run the steps that the database has not seen, all in one transaction.

    Raises:
        CommandError, RevisionError: the database was last used by a newer version of the service.
        SQLAlchemyError: a step failed; the database is as it was.
    """
    script = ScriptDirectory(str(_SCRIPTS))
    head = script.get_current_head()
    assert head is not None
    with database.engine_for_writing.begin() as connection:
        # On SQLite the transaction itself is the lock: it was begun as a writer's.
        if database.is_postgresql:
            connection.execute(text("SET LOCAL statement_timeout = 0"))
            connection.execute(text("SET LOCAL lock_timeout = '60s'"))
            connection.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _LOCK})
        context = MigrationContext.configure(connection)
        current = context.get_current_revision()
        steps = reversed(list(script.iterate_revisions(head, current or "base")))
        with Operations.context(context):
            for step in steps:
                step.module.upgrade()
                context.stamp(script, step.revision)
