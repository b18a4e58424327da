"""Connections and transactions: SQLite with a write-ahead log, or PostgreSQL through psycopg.

Durability: a committed transaction survives the end of the process, a crash of the system and a power failure.
SQLite writes its log to the disk with every commit (`synchronous=FULL`); PostgreSQL does so by default.
"""

from __future__ import annotations

import logging
import os
import sqlite3
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from typing import Any, Literal, TypeVar

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from lalaloc_core.errors import ConfigError
from service.errors import StoreBusyError, StoreFullError, StoreUnavailableError
from service.storage.disk_reserve import LOG_BYTES, DiskReserve
from service.telemetry import LOGGER_NAME

Result = TypeVar("Result")
State = Literal["answers", "unavailable", "damaged"]
# Steps of `give_back` per call, and the pause (s) after each, longer than the interval at which SQLite polls its lock.
_MAX_STEPS, _PAUSE_S = 40, 0.12
_WRITER = "lalaloc_writer"
_SQLITE_WAIT_MS = 5000
_WRITE_AHEAD, _PRAGMA_PAUSE_S = "journal_mode=WAL", 0.02
# Time limits of the server, so that a stuck statement or lock never holds a connection for good.
_STATEMENT_MS, _LOCK_MS, _IDLE_MS = 30_000, 10_000, 60_000
# Tolerance (s) between two readings of the clock, for waiting on a lock or a corrected clock in between.
_CLOCK_SLACK_S = 10.0
# SQLSTATE of PostgreSQL for a full disk.
_DISK_FULL = "53100"
# Beginnings of the names of SQLite's errors for a damaged file, and what to do about it.
_DAMAGED = ("SQLITE_CORRUPT", "SQLITE_NOTADB")
_RESTORE = "stop the service, and restore a backup (lalaloc-service restore)"
_IS_DAMAGED = f"the database file is damaged: {_RESTORE}"
# Silence (ms) after which a connection counts as broken.
_SILENCE_MS = 5000


class Database:
    """Bounded pool of connections, which connects on first use; safe to share between threads.

    `wait_s` (s) limits waiting for a free connection, and making one.
    """

    def __init__(self, url: str, *, connections: int = 8, wait_s: float = 2.0) -> None:
        parsed = _parsed(url)
        self.is_postgresql = parsed.get_backend_name() == "postgresql"
        self._engine = sa.create_engine(
            parsed,
            pool_size=connections,
            max_overflow=0,
            pool_timeout=wait_s,
            # Replaces dead connections after an outage, instead of failing one request each.
            pool_pre_ping=self.is_postgresql,
            connect_args=_postgresql_arguments(parsed, wait_s) if self.is_postgresql else {},
        )
        self._path = None if self.is_postgresql else parsed.database
        self._disk = None if self._path is None else DiskReserve(self._path)
        if self._disk is not None:
            self._disk.prepare()
        # Identity of the file when it was first opened.
        self._file: tuple[int, int] | None = None
        if not self.is_postgresql:
            event.listen(self._engine, "connect", _prepare_sqlite)
            event.listen(self._engine, "connect", self._note_file)
            event.listen(self._engine, "begin", _begin_sqlite)
        self.engine_for_writing: sa.Engine = self._engine.execution_options(**{_WRITER: True})
        # Reads in one transaction see one snapshot; on SQLite they do so anyway.
        snapshot = {"isolation_level": "REPEATABLE READ"} if self.is_postgresql else {}
        self._engine_for_reading: sa.Engine = self._engine.execution_options(**snapshot)
        self._answered_s = self._failed_s = -float("inf")
        self._is_damaged = False

    @property
    def state(self) -> State:
        """Outcome of the last transaction; `damaged` stays, because only a restored file, and a restart, end it."""
        if self._is_damaged:
            return "damaged"
        return "unavailable" if self._failed_s > self._answered_s else "answers"

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()

    @contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """Run a read-only transaction, which sees the database as of its first statement."""
        with self._transaction(self._engine_for_reading) as connection:
            yield connection

    def rows(self, query: Any) -> Sequence[sa.Row[Any]]:
        """Return the rows of a query, in a transaction of its own."""
        with self.reading() as connection:
            return connection.execute(query).all()

    def row(self, query: Any) -> sa.Row[Any] | None:
        """Return the only row of a query, or None; as `rows`."""
        with self.reading() as connection:
            return connection.execute(query).one_or_none()

    def value(self, query: Any) -> Any:
        """Return the first column of the first row of a query, or None; as `rows`."""
        with self.reading() as connection:
            return connection.scalar(query)

    @contextmanager
    def writing(self, *, grows_by: int = 0) -> Iterator[sa.Connection]:
        """Run a writing transaction; on SQLite it waits for other writers when it begins, not half-way through.

        `grows_by` is about the size of the stored data; 0 for changes that store little.

        Raises:
            StoreFullError: the disk has no room for the data.
            StoreUnavailableError: the file is damaged; what another connection could still write, a restored backup
                would not have.
        """
        if self._is_damaged:
            raise StoreUnavailableError(_IS_DAMAGED)
        with self._transaction(self.engine_for_writing) as connection:
            if grows_by and self._disk is not None:
                self._disk.check(connection, grows_by)
            yield connection

    def freeing(self, work: Callable[[sa.Connection], Result]) -> Result:
        """Run a transaction that deletes data; on a full disk it uses the reserve.

        `work` is called again after a failure for lack of space.
        """
        try:
            with self.writing() as connection:
                return work(connection)
        except StoreFullError:
            if self._disk is None or not self._disk.release():
                raise
        with self.writing() as connection:
            return work(connection)

    def give_back(self, is_stopped: Callable[[], bool] = lambda: False) -> None:
        """Return free space of an SQLite file to the disk, in short transactions, and restore the reserve.

        `is_stopped` is asked before each; the rest stays for the next call.
        """
        if (disk := self._disk) is None:
            return
        with self._driver_cursor() as cursor:
            for _ in range(_MAX_STEPS):
                if is_stopped() or not disk.has_surplus(cursor):
                    break
                try:
                    disk.return_pages(cursor)
                except sqlite3.OperationalError:
                    if not disk.release():
                        raise
                # SQLite polls for its lock, so without a pause other writers would starve.
                time.sleep(_PAUSE_S)
            disk.copy_log(cursor)
        disk.restore()

    def compact(self) -> None:
        """Write an SQLite file anew without free space, in the mode that `give_back` needs; PostgreSQL does without."""
        if self.is_postgresql:
            return
        with self._driver_cursor() as cursor:
            cursor.execute("VACUUM")

    def now_s(self) -> sa.ColumnElement[float]:
        """Return the seconds since 1970 by the clock that all replicas share: PostgreSQL's, or this machine's."""
        if self.is_postgresql:
            return sa.cast(sa.extract("epoch", sa.func.clock_timestamp()), sa.Double)
        return sa.literal(time.time())

    def is_live(self, until_s: sa.Column[float], length_s: sa.Column[float]) -> sa.ColumnElement[bool]:
        """Return the condition that a lease holds; an end too far in the future comes from a clock that was ahead.

        The end is by `now_s`; where the length (s) is NULL, no end is too far.
        """
        now_s = self.now_s()
        return sa.and_(until_s > now_s, sa.or_(length_s.is_(None), until_s <= now_s + length_s + _CLOCK_SLACK_S))

    def answered_since(self, moment_s: float) -> bool:
        """Tell whether a transaction was completed after a moment (`monotonic`)."""
        return self._answered_s >= moment_s

    def insert(self, table: Any) -> Any:
        """Return an INSERT with `ON CONFLICT`, which both databases write alike."""
        return postgresql.insert(table) if self.is_postgresql else sqlite.insert(table)

    @contextmanager
    def _driver_cursor(self) -> Iterator[Any]:
        """Yield a cursor of the SQLite driver, for statements outside of transactions."""
        self._check_file()
        with closing(self._engine.raw_connection()) as raw:
            try:
                yield raw.cursor()
            except sqlite3.DatabaseError as error:
                if not isinstance(error, sqlite3.OperationalError) and not _tells_damage(error):
                    raise
                raise self._unavailable(error) from error

    def _note_file(self, _connection: Any, _record: Any) -> None:
        self._file = self._file or _identity(self._path)

    def _check_file(self) -> None:
        """Check that the database file still exists, because SQLite would go on writing to a deleted one."""
        if self._file is not None and _identity(self._path) != self._file:
            logging.getLogger(LOGGER_NAME).error("the database file is gone", extra={"fields": {"file": self._path}})
            self._failed_s = time.monotonic()
            raise StoreUnavailableError("the database file was removed or replaced: restart the service")

    @contextmanager
    def _transaction(self, engine: sa.Engine) -> Iterator[sa.Connection]:
        begin_s = time.monotonic()
        self._check_file()
        try:
            with engine.begin() as connection:
                yield connection
            self._answered_s = time.monotonic()
        except PoolTimeoutError as error:
            # Busy if the database answered another caller meanwhile; else unavailable.
            if self.answered_since(begin_s):
                raise StoreBusyError() from error
            raise self._unavailable(error) from error
        except (OperationalError, InterfaceError) as error:
            raise self._unavailable(error) from error
        except DBAPIError as error:
            if error.connection_invalidated or _tells_damage(error.orig):
                raise self._unavailable(error) from error
            raise

    def _unavailable(self, error: Exception) -> StoreUnavailableError:
        """Log a failure, and return its error."""
        cause = getattr(error, "orig", None) or error
        reason = {"reason": str(cause).strip()[:300]}
        log = logging.getLogger(LOGGER_NAME)
        if _tells_damage(cause):
            if not self._is_damaged:
                fields = {**reason, "file": self._path, "remedy": _RESTORE}
                log.error("the database file is damaged", extra={"fields": fields})
            self._is_damaged = True
            return StoreUnavailableError(_IS_DAMAGED)
        is_full = getattr(cause, "sqlite_errorname", None) == "SQLITE_FULL"
        if is_full or getattr(cause, "sqlstate", None) == _DISK_FULL:
            log.warning("database full", extra={"fields": reason})
            return StoreFullError()
        self._failed_s = time.monotonic()
        log.warning("database unavailable", extra={"fields": reason})
        return StoreUnavailableError()


def _parsed(url: str) -> URL:
    parsed = make_url(url)
    if parsed.drivername in ("postgresql", "postgres", "postgresql+psycopg"):
        return parsed.set(drivername="postgresql+psycopg")
    if parsed.get_backend_name() != "sqlite":
        raise ConfigError(
            f"the database is '{parsed.drivername}'; it must be sqlite or postgresql (LALALOC_DATABASE_URL)"
        )
    if not parsed.database or parsed.database == ":memory:":
        raise ConfigError(
            "the database is SQLite in memory, which connections do not share: name a file (LALALOC_DATABASE_URL)"
        )
    return parsed


def _postgresql_arguments(url: URL, wait_s: float) -> dict[str, Any]:
    arguments: dict[str, Any] = {
        "connect_timeout": max(round(wait_s), 2),
        "keepalives_idle": 30,
        "tcp_user_timeout": _SILENCE_MS,
        "options": f"-c statement_timeout={_STATEMENT_MS} -c lock_timeout={_LOCK_MS} "
        f"-c idle_in_transaction_session_timeout={_IDLE_MS}",
    }
    # Parameters in the URL take precedence.
    return {name: value for name, value in arguments.items() if name not in url.query}


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    # Otherwise the driver begins transactions itself, only at the first write; see `_begin_sqlite`.
    connection.isolation_level = None
    cursor = connection.cursor()
    # WAL lets readers continue while a grid is written; SQLite has foreign keys off by default. `auto_vacuum` is for
    # new files, before WAL writes their first page. Some builds overwrite deleted data by default (`secure_delete`):
    # deleting a file would then need as much space as the file.
    pragmas = (
        f"busy_timeout={_SQLITE_WAIT_MS}",
        "auto_vacuum=INCREMENTAL",
        _WRITE_AHEAD,
        f"journal_size_limit={LOG_BYTES}",
        "foreign_keys=ON",
        "synchronous=FULL",
        "secure_delete=FAST",
    )
    for pragma in pragmas:
        _set_pragma(cursor, pragma)
    cursor.close()


def _set_pragma(cursor: sqlite3.Cursor, pragma: str) -> None:
    """Set a pragma, and wait for the lock of a new file.

    While several connections switch one new file to its write-ahead log, SQLite refuses all but one at once, whatever
    `busy_timeout` is.
    """
    deadline = time.monotonic() + _SQLITE_WAIT_MS / 1000
    while True:
        try:
            cursor.execute(f"PRAGMA {pragma}")
            return
        except sqlite3.OperationalError as error:
            if error.sqlite_errorname != "SQLITE_BUSY" or pragma != _WRITE_AHEAD or time.monotonic() > deadline:
                raise
        time.sleep(_PRAGMA_PAUSE_S)


def _begin_sqlite(connection: sa.Connection) -> None:
    # A reader that becomes a writer fails if another was faster; a transaction that begins as a writer waits its turn.
    writer = connection.get_execution_options().get(_WRITER, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writer else "BEGIN")


def _identity(path: str | None) -> tuple[int, int] | None:
    """Return device and inode of a file; None without one."""
    try:
        found = os.stat(path or "")
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _tells_damage(error: BaseException | None) -> bool:
    """Return True for an error of SQLite about the file itself."""
    return (getattr(error, "sqlite_errorname", None) or "").startswith(_DAMAGED)


# Duration (s) without calls after a failure.
_OPEN_S = 1.0


class CircuitBreaker:
    """Switch that is open for a moment after the database failed; safe to share between threads."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Create a closed circuit breaker with a clock (s)."""
        self._clock = clock
        self._open_until_s = -float("inf")

    @property
    def is_open(self) -> bool:
        """True shortly after a failure of the database."""
        return self._clock() < self._open_until_s

    def trip(self) -> None:
        """Open the circuit breaker, because the database failed."""
        self._open_until_s = self._clock() + _OPEN_S
