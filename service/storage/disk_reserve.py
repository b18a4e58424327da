"""Disk space of an SQLite file: a reserve for deletions, and the return of free space to the disk.

A deletion writes before it frees anything. Its reserve is a file, not a minimum of free space, because other programs
can use free space up. A deletion that fails for lack of space releases the reserve and is repeated. Data is stored only
while the reserve is whole, so no upload takes the released space; SQLite has one writer at a time.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

from sqlalchemy import Connection

from lalaloc_core.errors import ConfigError
from service.errors import StoreFullError

# Size of the write-ahead log that is kept for further transactions.
LOG_BYTES = 8 * 2**20
# Deleting writes about 0.3 % of the deleted bytes.
_RESERVE_BYTES = 4 * 2**20
# Free space below which SQLite may fail to open a file.
_LITTLE_BYTES = 2**20
# Pages returned per transaction, so that other writers wait for milliseconds.
_STEP_PAGES = 256
# Free pages that are kept for further uploads.
_KEPT_PAGES = 1024
_INCREMENTAL = 2


class DiskReserve:
    """Reserve beside an SQLite file, for all processes that use the file."""

    def __init__(self, database: str) -> None:
        """Name the reserve of a database; `restore` creates it."""
        self._database = Path(database)
        self._folder = self._database.absolute().parent
        self._file = Path(f"{database}-reserve")
        self._log = Path(f"{database}-wal")

    def prepare(self) -> None:
        """Prepare to open the database: release the reserve if the disk is too full for it."""
        if _size(self._database) == 0 and (lost := _size(self._log)) > 0:
            raise ConfigError(
                f"'{self._database}' is missing or empty, but '{self._log.name}' beside it has {lost} bytes of its "
                "data; restore the database file, or move both away to begin without data"
            )
        with suppress(OSError):
            if self._free_bytes() < _LITTLE_BYTES:
                self.release()

    def check(self, connection: Connection, growth: int) -> None:
        """Check in a writing transaction that the disk has room for data, in the log and then in the database."""
        free_pages = connection.exec_driver_sql("PRAGMA freelist_count").scalar_one()
        page_bytes = connection.exec_driver_sql("PRAGMA page_size").scalar_one()
        needed = max(growth - _size(self._log), 0) + max(growth - free_pages * page_bytes, 0)
        if not self.restore() or self._free_bytes() < needed:
            raise StoreFullError()

    def release(self) -> bool:
        """Free the space of the reserve; False if it is in use already."""
        if _size(self._file) == 0:
            return False
        os.truncate(self._file, 0)
        return True

    def restore(self) -> bool:
        """Allocate the reserve unless it is whole; False if the disk has no room for it."""
        if _size(self._file) >= _RESERVE_BYTES:
            return True
        try:
            if self._free_bytes() < _RESERVE_BYTES:
                return False
            with self._file.open("wb") as file:
                # Written, because not every system can allocate a file.
                file.write(bytes(_RESERVE_BYTES))
        except OSError:
            with suppress(OSError):
                self.release()
            return False
        return True

    def has_surplus(self, cursor: Any) -> bool:
        """Tell whether the database has free pages to return; files of earlier versions keep theirs."""
        mode, free = (cursor.execute(f"PRAGMA {name}").fetchone()[0] for name in ("auto_vacuum", "freelist_count"))
        return mode == _INCREMENTAL and free > _KEPT_PAGES

    def return_pages(self, cursor: Any) -> None:
        """Return some free pages; the file shrinks when the log is next copied to it."""
        # As a script, because `execute` would end after the first page.
        cursor.executescript(f"PRAGMA incremental_vacuum({_STEP_PAGES})")

    def copy_log(self, cursor: Any) -> None:
        """Copy the log to the database, as far as readers and writers allow without waiting for them."""
        if _size(self._log) > 0:
            cursor.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()

    def _free_bytes(self) -> int:
        return shutil.disk_usage(self._folder).free


def _size(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:
        return 0
