"""Uploaded files, in memory while small and else in unnamed temporary files."""

from __future__ import annotations

import hashlib
import io
import threading
from collections.abc import Callable, Iterator
from typing import IO

_CHUNK_BYTES = 2**20


class UploadedFile:
    """Content of an uploaded file, out of memory until it is read. Thread-safe; it is pickled as `bytes`.

    Attributes:
        name: name of the file, if the client sent one.
    """

    def __init__(self, file: IO[bytes], name: str | None = None) -> None:
        self.name, self._file = name, file
        self._lock = threading.Lock()
        self._size = file.seek(0, io.SEEK_END)

    def __len__(self) -> int:
        return self._size

    def read(self) -> bytes:
        """Return the content."""
        with self._lock:
            # The end first, which empties the buffer: its bytes would be joined to the rest, a copy of the whole file
            # that keeps the interpreter's lock.
            self._file.seek(0, io.SEEK_END)
            self._file.seek(0)
            return self._file.read()

    def chunks(self, first: int = 0) -> Iterator[bytes]:
        """Return the content from byte `first` on in parts of bounded size."""
        for offset in range(first, self._size, _CHUNK_BYTES):
            with self._lock:
                self._file.seek(offset)
                chunk = self._file.read(_CHUNK_BYTES)
            yield chunk

    def sha256(self) -> str:
        """Return the digest of the content."""
        digest = hashlib.sha256()
        for chunk in self.chunks():
            digest.update(chunk)
        return digest.hexdigest()

    def close(self) -> None:
        """Delete the content."""
        with self._lock:
            self._file.close()

    def __reduce__(self) -> tuple[Callable[[bytes], bytes], tuple[bytes]]:
        return bytes, (self.read(),)
