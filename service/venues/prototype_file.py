"""Prototypes of many plans in one memory-mapped file, so that a replica need not read them from the database again.

The file is an array of rows of `prototypes.ROW`. A block is a header in place of a row, followed by the prototypes of
one pose grid:

    magic (8 bytes), id of the grid (int64), its digest (32 bytes), version of the cells (uint32),
    number of rows (uint32), CRC-32 of the rows (uint32), CRC-32 of all that (uint32), zeros

Blocks are appended and never changed. Lookups use grid ids and digests from the database, so blocks of deleted or
replaced plans are never returned. On opening, the file is truncated after its last intact block. A file that would
exceed its limit is started anew.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import struct
import tempfile
import threading
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from lalaloc_core.localise.venue.prototypes import ROW
from service.telemetry import LOGGER_NAME

_HEADER = struct.Struct("<8sq32sIII")
_CRC = struct.Struct("<I")
_MAGIC = b"LLROWS2\0"


@dataclass(frozen=True)
class BlockKey:
    """Id and digest (hexadecimal) of the pose grid of a block."""

    grid_id: int
    sha256: str


class PrototypeFile:
    """Prototype file of one process; safe to share between threads."""

    def __init__(self, path: Path | None, *, cells_version: int, limit_bytes: int) -> None:
        """Open or create a file and scan its blocks, which takes about a second per GB.

        Args:
            path: path of the file; a temporary file is used for None, or if another process has it open.
            cells_version: version of the cells; blocks of other versions are ignored.
            limit_bytes: maximum size of the file.
        """
        self._cells_version = cells_version
        self._limit = limit_bytes // ROW.itemsize
        self._lock = threading.Lock()
        self._path, self._file = path, _opened(path)
        self._places: dict[BlockKey, tuple[int, int]] = {}
        self._end = 0
        self._read()

    def find(self, keys: Iterable[BlockKey]) -> dict[BlockKey, tuple[int, int]]:
        """Return the first row in `rows` and the number of rows of each block that is in the file."""
        with self._lock:
            return {key: self._places[key] for key in keys if key in self._places}

    def add(self, blocks: Mapping[BlockKey, np.ndarray]) -> None:
        """Append prototypes that are sorted into cells; a full file is started anew.

        Prototypes that exceed the limit on their own are not added.

        Raises:
            OSError: the prototypes cannot be written; the file is unchanged.
        """
        with self._lock:
            needed = sum(len(rows) + 1 for rows in blocks.values())
            if needed > self._limit:
                return
            if self._end + needed > self._limit:
                self._begin_anew()
            parts, places, end = [], {}, self._end
            for key, rows in blocks.items():
                content = np.ascontiguousarray(rows, ROW).tobytes()
                parts += [self._header(key, len(rows), zlib.crc32(content)), content]
                places[key] = (end + 1, len(rows))
                end += 1 + len(rows)
            self._file.seek(self._end * ROW.itemsize)
            self._file.write(b"".join(parts))
            self._file.flush()
            self._places |= places
            self._end = end

    def rows(self) -> np.ndarray:
        """Return the whole file as it is now; the array stays valid when the file is started anew."""
        with self._lock:
            if not self._end:
                return np.empty(0, ROW)
            return np.memmap(self._file, ROW, "r", shape=(self._end,))

    def close(self) -> None:
        """Release the file for other processes."""
        if not self._file.closed:
            # Maps that still exist keep the file open, and would keep the lock.
            fcntl.flock(self._file, fcntl.LOCK_UN)
            self._file.close()

    def _header(self, key: BlockKey, count: int, crc: int) -> bytes:
        fields = (_MAGIC, key.grid_id, bytes.fromhex(key.sha256), self._cells_version, count, crc)
        header = _HEADER.pack(*fields)
        return (header + _CRC.pack(zlib.crc32(header))).ljust(ROW.itemsize, b"\0")

    def _read(self) -> None:
        size = os.fstat(self._file.fileno()).st_size // ROW.itemsize
        if size:
            content = np.memmap(self._file, np.uint8, "r", shape=(size * ROW.itemsize,)).data
            while (block := _block(content, self._end)) is not None:
                key, version, count = block
                if version == self._cells_version:
                    self._places[key] = (self._end + 1, count)
                self._end += 1 + count
        with contextlib.suppress(OSError):
            self._file.truncate(self._end * ROW.itemsize)

    def _begin_anew(self) -> None:
        """Replace the file by an empty one; running queries keep the mapped one until they end."""
        logging.getLogger(LOGGER_NAME).info("the prototype file is full and is started anew")
        if self._path is not None:
            with contextlib.suppress(FileNotFoundError):
                self._path.unlink()
        fresh = _opened(self._path)
        self._file.close()
        self._file, self._places, self._end = fresh, {}, 0


def _opened(path: Path | None) -> IO[bytes]:
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(path, "a+b", buffering=0)  # noqa: SIM115
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
        else:
            return file
    return tempfile.TemporaryFile(prefix="lalaloc-prototypes-", buffering=0)


def _block(content: memoryview, begin: int) -> tuple[BlockKey, int, int] | None:
    """Return key, version of the cells and number of rows of the block at a row; None without an intact block."""
    offset = begin * ROW.itemsize
    header = content[offset : offset + ROW.itemsize]
    if len(header) < ROW.itemsize:
        return None
    (crc,) = _CRC.unpack_from(header, _HEADER.size)
    magic, grid_id, digest, version, count, rows_crc = _HEADER.unpack_from(header)
    rows = content[offset + ROW.itemsize : offset + (1 + count) * ROW.itemsize]
    whole = magic == _MAGIC and crc == zlib.crc32(header[: _HEADER.size]) and len(rows) == count * ROW.itemsize
    if not whole or zlib.crc32(rows) != rows_crc:
        return None
    return BlockKey(grid_id, digest.hex()), version, count
