"""Backup and restore of SQLite files, as files that are complete or absent.

A backup is a consistent copy that SQLite makes while the service runs. PostgreSQL has `pg_dump` for this.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from datetime import datetime
from pathlib import Path

from sqlalchemy.engine import make_url

from lalaloc_core.errors import ConfigError
from lalaloc_core.files import replacing
from service.errors import StoreFullError, StoreUnavailableError
from service.storage.store import Store

_WAIT_S = 5.0
_LOG_FILES = ("-wal", "-shm")
_PAGE = "docs/how-to/operate.md#backup-and-restore"


def database_file(url: str) -> Path:
    """Return the path of an SQLite database."""
    parsed = make_url(url)
    if parsed.get_backend_name() != "sqlite" or not parsed.database:
        raise ConfigError(
            f"the database is {parsed.get_backend_name()}; these commands are for SQLite: use pg_dump and pg_restore "
            f"({_PAGE})"
        )
    return Path(parsed.database)


def back_up(database: Path, backup: Path) -> int:
    """Copy a database to a new file, also while the service uses it, and return the size (bytes) of the copy."""
    if not database.is_file():
        raise ConfigError(f"there is no database '{database}' (LALALOC_DATA_DIR, LALALOC_DATABASE_URL)")
    if backup.exists():
        raise ConfigError(f"'{backup}' exists; name a new file for the backup")
    if not backup.absolute().parent.is_dir():
        raise ConfigError(f"the folder '{backup.parent}' does not exist; create it first")
    with _file_errors(backup), replacing(backup) as part:
        part.unlink(missing_ok=True)
        # As a URI, because `connect` would create a missing file.
        with (
            closing(sqlite3.connect(_uri(database), uri=True, timeout=_WAIT_S)) as source,
            closing(sqlite3.connect(part)) as copy,
        ):
            # One step sees one state; in several steps, each write of the service would begin the copy anew.
            source.backup(copy, pages=-1)
            # A file of its own, without a log beside it.
            copy.execute("PRAGMA journal_mode=DELETE").fetchall()
            _check(copy, part)
        _sync(part)
        size = part.stat().st_size
    _sync(backup.absolute().parent)
    return size


def restore(backup: Path, database: Path) -> Path | None:
    """Replace a database by a backup while no process uses it.

    The copy is checked and migrated before it takes the database's place in one step, so that a failure leaves the
    database as it was.

    Returns:
        The file that the database was moved to; None if there was none.
    """
    if not backup.is_file():
        raise ConfigError(f"there is no file '{backup}'")
    if backup.resolve() == database.resolve():
        raise ConfigError(f"'{backup}' is the database itself; name a backup")
    with _file_errors(database):
        database.absolute().parent.mkdir(parents=True, exist_ok=True)
        if shutil.disk_usage(database.absolute().parent).free < backup.stat().st_size:
            raise StoreFullError()
        new = database.with_name(f"{database.name}-restored")
        try:
            _remove(new)
            shutil.copyfile(backup, new)
            # Of a database that was copied or moved by hand, the log has the last commits.
            if (log := Path(f"{backup}-wal")).exists():
                shutil.copyfile(log, f"{new}-wal")
            _check_kind(new, backup)
            # Opening migrates a backup of an earlier version, and refuses one of a newer version.
            Store(f"sqlite:///{new.absolute()}", connections=1).close()
            with closing(sqlite3.connect(new)) as copy:
                copy.execute("PRAGMA journal_mode=DELETE").fetchall()
                _check(copy, backup)
            _sync(new)
            with _exclusively(database):
                earlier = _put_aside(database)
                os.replace(new, database)
        finally:
            _remove(new)
        _sync(database.absolute().parent)
    return earlier


def _uri(file: Path) -> str:
    return f"{file.absolute().as_uri()}?mode=rw"


def _check_kind(copy: Path, backup: Path) -> None:
    """Check that a copy is a database of the service; opening it as one would create the tables."""
    try:
        with closing(sqlite3.connect(_uri(copy), uri=True)) as connection:
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    except sqlite3.DatabaseError as error:
        raise ConfigError(f"'{backup}' is not an SQLite file, or damaged: {error}") from error
    if "floorplans" not in tables:
        raise ConfigError(f"'{backup}' is not a backup of this service: it has no table of floor plans")


def _check(connection: sqlite3.Connection, file: Path) -> None:
    """Check the structure of a database."""
    found = [row[0] for row in connection.execute("PRAGMA quick_check(3)")]
    if found != ["ok"]:
        raise ConfigError(f"'{file}' is damaged: {'; '.join(found)[:300]}")


@contextmanager
def _exclusively(database: Path) -> Iterator[None]:
    """Keep all other processes out of a database; a missing or damaged one has none to keep out."""
    if not database.is_file():
        yield
        return
    with closing(sqlite3.connect(_uri(database), uri=True, isolation_level=None, timeout=_WAIT_S)) as connection:
        try:
            # Possible for the only user of a file; it also copies the log to the database.
            connection.execute("PRAGMA journal_mode=DELETE").fetchall()
            connection.execute("BEGIN EXCLUSIVE")
        except sqlite3.DatabaseError as error:
            if error.sqlite_errorname.startswith("SQLITE_BUSY"):
                raise StoreUnavailableError(f"a process uses '{database}': stop the service first") from error
            if error.sqlite_errorname not in ("SQLITE_NOTADB", "SQLITE_CORRUPT"):
                raise
        yield


def _put_aside(database: Path) -> Path | None:
    """Give the database a second name, so that it is never missing, and move what is left of its log to that name."""
    if not database.is_file():
        _remove(database)
        return None
    earlier = database.with_name(f"{database.name}-before-{datetime.now():%Y%m%dT%H%M%S.%f}")
    os.link(database, earlier)
    for suffix in _LOG_FILES:
        with suppress(FileNotFoundError):
            Path(f"{database}{suffix}").rename(f"{earlier}{suffix}")
    return earlier


def _remove(database: Path) -> None:
    for suffix in ("", *_LOG_FILES):
        Path(f"{database}{suffix}").unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Write a file, or the entries of a folder, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _file_errors(path: Path) -> Iterator[None]:
    """Turn errors of the disk into those of the service."""
    try:
        yield
    except sqlite3.DatabaseError as error:
        if getattr(error, "sqlite_errorname", "") == "SQLITE_FULL":
            raise StoreFullError() from error
        raise StoreUnavailableError(f"the database cannot be copied to '{path}': {error}") from error
    except OSError as error:
        raise ConfigError(f"'{path}' cannot be written: {error.strerror}") from error
