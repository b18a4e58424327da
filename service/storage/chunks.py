"""Large values in pieces, so that neither database nor driver ever handles one of them whole."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from sqlalchemy import Connection, Table, select

CHUNK_BYTES = 2**20


def write_chunks(connection: Connection, table: Table, owner: dict[str, Any], content: memoryview) -> None:
    """Write a value, one statement per chunk.

    Args:
        owner: name and value of the column that says whose chunks they are.
    """
    for number, first in enumerate(range(0, len(content), CHUNK_BYTES)):
        chunk = bytes(content[first : first + CHUNK_BYTES])
        connection.execute(table.insert(), {**owner, "number": number, "content": chunk})


def read_chunks(connection: Connection, table: Table, owner: dict[str, Any]) -> Iterator[bytes]:
    """The chunks of a value in their order, one statement each."""
    conditions = [table.c[name] == value for name, value in owner.items()]
    number = 0
    while True:
        query = select(table.c.content).where(*conditions, table.c.number == number)
        content = connection.scalar(query)
        if content is None:
            return
        yield content
        number += 1


def read_exactly(connection: Connection, table: Table, owner: dict[str, Any], size_bytes: int) -> bytearray | None:
    """A value of known size, put together in place; None when it does not have that size."""
    content, filled = bytearray(size_bytes), 0
    for chunk in read_chunks(connection, table, owner):
        if filled + len(chunk) > size_bytes:
            return None
        content[filled : filled + len(chunk)] = chunk
        filled += len(chunk)
    return content if filled == size_bytes else None
