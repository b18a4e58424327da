"""Connections and transactions: SQLite with a write-ahead log, or PostgreSQL through psycopg.

What survives: a transaction that was answered for survives the end of the process, however it ends. On SQLite
(`synchronous=NORMAL`) a power failure or a crash of the operating system may take the last transactions back, whole;
the file stays sound. PostgreSQL keeps them too, unless it is told otherwise.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy import (
    Column,
    ColumnElement,
    Connection,
    Double,
    Engine,
    and_,
    cast,
    create_engine,
    event,
    extract,
    func,
    literal,
    or_,
)
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from lalaloc_core.errors import ConfigError
from service.errors import StoreBusyError, StoreFullError, StoreUnavailableError
from service.telemetry import LOGGER_NAME

_WRITER = "lalaloc_writer"
_SQLITE_WAIT_MS = 5000
# The server ends what takes longer, so that a stuck statement or lock never holds a connection for good.
_STATEMENT_MS, _LOCK_MS, _IDLE_MS = 30_000, 10_000, 60_000
# How far apart two looks at the clock may be, of whom one waits for a lock in between, or sets the clock right.
_CLOCK_SLACK_S = 10.0
# What PostgreSQL calls it.
_DISK_FULL = "53100"
# A server that does not answer any more counts as gone after this.
_SILENCE_MS = 5000


class Database:
    """A bounded pool of connections; safe to share between threads."""

    def __init__(self, url: str, *, connections: int = 8, wait_s: float = 2.0) -> None:
        """Prepare the pool; connects on first use.

        Args:
            connections: most connections that are open at a time.
            wait_s: longest wait for one of them to become free, and to be made.

        Raises:
            ConfigError: not the URL of an SQLite file or of PostgreSQL.
        """
        parsed = _parsed(url)
        self.is_postgresql = parsed.get_backend_name() == "postgresql"
        self._engine = create_engine(
            parsed,
            pool_size=connections,
            max_overflow=0,
            pool_timeout=wait_s,
            # After the server was away, dead connections are replaced instead of failing one request each.
            pool_pre_ping=self.is_postgresql,
            connect_args=_postgresql_arguments(parsed, wait_s) if self.is_postgresql else {},
        )
        self._path = None if self.is_postgresql else parsed.database
        # Which file that was when it was opened first.
        self._file: tuple[int, int] | None = None
        if not self.is_postgresql:
            event.listen(self._engine, "connect", _prepare_sqlite)
            event.listen(self._engine, "connect", self._note_file)
            event.listen(self._engine, "begin", _begin_sqlite)
        self.engine_for_writing: Engine = self._engine.execution_options(**{_WRITER: True})
        # What is read in one transaction belongs together; on SQLite it does so anyway.
        snapshot = {"isolation_level": "REPEATABLE READ"} if self.is_postgresql else {}
        self._engine_for_reading: Engine = self._engine.execution_options(**snapshot)
        self._answered_s = -float("inf")

    def close(self) -> None:
        """Give all connections back."""
        self._engine.dispose()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A transaction that only reads, and sees the database as it is at its first statement.

        Raises:
            StoreUnavailableError: the database cannot be reached, or did not answer in time.
            StoreBusyError: it answers, but no connection became free in time.
        """
        with self._transaction(self._engine_for_reading) as connection:
            yield connection

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """A transaction that writes; on SQLite it waits for other writers when it begins, not half-way through.

        Raises:
            StoreUnavailableError, StoreBusyError: as for `reading`.
        """
        with self._transaction(self.engine_for_writing) as connection:
            yield connection

    def now_s(self) -> ColumnElement[float]:
        """Seconds since 1970 by the one clock that all owners of leases share: that of the PostgreSQL server.

        SQLite has no other clock than that of its machine.
        """
        if self.is_postgresql:
            return cast(extract("epoch", func.clock_timestamp()), Double)
        return literal(time.time())

    def is_live(self, until_s: Column[float], length_s: Column[float]) -> ColumnElement[bool]:
        """Whether a lease holds: one that ends later than if it began now was taken by a clock that was ahead.

        Args:
            until_s: column of the moment that it ends at, by `now_s`.
            length_s: column of how long it is; where that is not known, nothing is too late.
        """
        now_s = self.now_s()
        return and_(until_s > now_s, or_(length_s.is_(None), until_s <= now_s + length_s + _CLOCK_SLACK_S))

    def answered_since(self, moment_s: float) -> bool:
        """Whether a transaction was completed after a moment (`monotonic`)."""
        return self._answered_s >= moment_s

    def insert(self, table: Any) -> Any:
        """An INSERT that knows `ON CONFLICT`; both databases have it, in the same words."""
        return postgresql.insert(table) if self.is_postgresql else sqlite.insert(table)

    def _note_file(self, _connection: Any, _record: Any) -> None:
        self._file = self._file or _identity(self._path)

    def _check_file(self) -> None:
        """Raises:
        StoreUnavailableError: the file is gone, and what is written to it with it, although SQLite would go on.
        """
        if self._file is not None and _identity(self._path) != self._file:
            logging.getLogger(LOGGER_NAME).error(
                "the file of the database is gone", extra={"fields": {"file": self._path}}
            )
            raise StoreUnavailableError(
                "the file of the database was removed or replaced, the service must be restarted"
            )

    @contextmanager
    def _transaction(self, engine: Engine) -> Iterator[Connection]:
        begin_s = time.monotonic()
        self._check_file()
        try:
            with engine.begin() as connection:
                yield connection
            self._answered_s = time.monotonic()
        except PoolTimeoutError as error:
            # Others were answered meanwhile; or it is gone, and those who asked first still wait for it.
            if self.answered_since(begin_s):
                raise StoreBusyError() from error
            raise _unavailable(error) from error
        except (OperationalError, InterfaceError) as error:
            raise _unavailable(error) from error
        except DBAPIError as error:
            if error.connection_invalidated:
                raise _unavailable(error) from error
            raise


def _parsed(url: str) -> URL:
    parsed = make_url(url)
    if parsed.drivername in ("postgresql", "postgres", "postgresql+psycopg"):
        return parsed.set(drivername="postgresql+psycopg")
    if parsed.get_backend_name() != "sqlite":
        raise ConfigError(f"the database must be sqlite or postgresql, not '{parsed.drivername}'")
    if not parsed.database or parsed.database == ":memory:":
        raise ConfigError("the database must be a file, SQLite in memory is not shared between connections")
    return parsed


def _postgresql_arguments(url: URL, wait_s: float) -> dict[str, Any]:
    arguments: dict[str, Any] = {
        "connect_timeout": max(round(wait_s), 2),
        "keepalives_idle": 30,
        "tcp_user_timeout": _SILENCE_MS,
        "options": f"-c statement_timeout={_STATEMENT_MS} -c lock_timeout={_LOCK_MS} "
        f"-c idle_in_transaction_session_timeout={_IDLE_MS}",
    }
    # What the URL says itself goes before.
    return {name: value for name, value in arguments.items() if name not in url.query}


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    # The driver would begin transactions on its own, and only at the first write; see `_begin_sqlite`.
    connection.isolation_level = None
    cursor = connection.cursor()
    # WAL lets readers go on while a grid is written; foreign keys are off in SQLite unless asked for.
    pragmas = (f"busy_timeout={_SQLITE_WAIT_MS}", "journal_mode=WAL", "foreign_keys=ON", "synchronous=NORMAL")
    for pragma in pragmas:
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _begin_sqlite(connection: Connection) -> None:
    # A reader that becomes a writer fails at once when another one was faster; a writer from the start waits its turn.
    writer = connection.get_execution_options().get(_WRITER, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writer else "BEGIN")


def _identity(path: str | None) -> tuple[int, int] | None:
    """Which file there is under a path, None for none."""
    try:
        found = os.stat(path or "")
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _unavailable(error: Exception) -> StoreUnavailableError:
    cause = getattr(error, "orig", None) or error
    full = getattr(cause, "sqlite_errorname", None) == "SQLITE_FULL" or getattr(cause, "sqlstate", None) == _DISK_FULL
    fields = {"reason": str(cause).strip()[:300]}
    logging.getLogger(LOGGER_NAME).warning(
        "database full" if full else "database unavailable", extra={"fields": fields}
    )
    return StoreFullError() if full else StoreUnavailableError()
