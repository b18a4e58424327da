"""Records with named columns: rows of numbers that stack, travel and live on a device as one array."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, overload

import numpy as np
from jaxtyping import Float

Row = Float[np.ndarray, "width"]


class Column:
    """One column of records, or `width` adjacent columns that keep an axis; a view that can be assigned to.

    `index` is the position among all columns, in the order in which a class of `Records` names them.
    """

    index: int | slice

    def __init__(self, width: int | None = None) -> None:
        self.width = width

    @overload
    def __get__(self, records: None, owner: type[Records]) -> Column: ...

    @overload
    def __get__(self, records: Records, owner: type[Records]) -> Any: ...

    def __get__(self, records: Records | None, owner: type[Records]) -> Any:
        return self if records is None else records.rows[..., self.index]

    def __set__(self, records: Records, value: Any) -> None:
        records.rows[..., self.index] = value


def columns(count: int) -> list[Column]:
    """Return adjacent columns for a class of records, which names each."""
    return [Column() for _ in range(count)]


class Joined(Column):
    """Several adjacent columns under one more name."""

    def __init__(self, *columns: Column) -> None:
        super().__init__(sum(column.width or 1 for column in columns))
        self.columns = columns


@dataclass(eq=False)
class Records:
    """Rows of numbers, numpy or torch, of any leading shape; subclasses name their columns, in order."""

    WIDTH: ClassVar[int]
    rows: Any

    def __init_subclass__(cls) -> None:
        columns = [value for value in vars(cls).values() if isinstance(value, Column)]
        cls.WIDTH = 0
        for column in columns:
            if not isinstance(column, Joined):
                start, cls.WIDTH = cls.WIDTH, cls.WIDTH + (column.width or 1)
                column.index = start if column.width is None else slice(start, cls.WIDTH)
        for joined in columns:
            if isinstance(joined, Joined):
                joined.index = _together([column.index for column in joined.columns])

    def __post_init__(self) -> None:
        if self.rows.shape[-1] != self.WIDTH:
            raise ValueError(f"rows of {type(self).__name__} have {self.WIDTH} columns, not {self.rows.shape[-1]}")

    def __getitem__(self, index: Any) -> Any:
        return type(self)(self.rows[index])

    def copy(self) -> Any:
        """Return records with rows of their own (numpy)."""
        return type(self)(self.rows.copy())

    @classmethod
    def row(cls, **columns: Any) -> Row:
        """Return one row with columns by name, 0 where missing; an unknown name is a `KeyError`."""
        row, known = np.zeros(cls.WIDTH), vars(cls)
        for name, value in columns.items():
            row[known[name].index] = value
        return row

    @classmethod
    def stacked(cls, rows: list[Row]) -> Any:
        """Stack single rows to records (n, width)."""
        return cls(np.array(rows, dtype=float).reshape(-1, cls.WIDTH))


def _together(parts: list[int | slice]) -> slice:
    spans = [slice(part, part + 1) if isinstance(part, int) else part for part in parts]
    if any(first.stop != second.start for first, second in pairwise(spans)):
        raise ValueError(f"columns {spans} are joined, but are not neighbours")
    return slice(spans[0].start, spans[-1].stop)
