"""Files that are written whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PART_SUFFIX = ".part"


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` to write to, which takes its place at the end; after an error nothing changes.

    A process that is killed meanwhile leaves the previous file, and the part that it had written beside it.
    """
    part = path.with_name(path.name + PART_SUFFIX)
    try:
        yield part
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def atomic_write(path: Path, content: str | bytes) -> None:
    """Write a file, text as UTF-8, so that a crash leaves the previous one."""
    with replacing(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
