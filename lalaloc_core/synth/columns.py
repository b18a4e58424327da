"""Tables whose columns have names: rows of numbers that stack, travel and lie on a device as one array."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, overload

import numpy as np
from jaxtyping import Float


class Column:
    """One column of a table, or `width` neighbouring ones, which keep an axis; a view, which may be assigned to."""

    def __init__(self, start: int, width: int | None = None) -> None:
        self.index = start if width is None else slice(start, start + width)

    @overload
    def __get__(self, table: None, owner: type[Table]) -> Column: ...

    @overload
    def __get__(self, table: Table, owner: type[Table]) -> Any: ...

    def __get__(self, table: Table | None, owner: type[Table]) -> Any:
        return self if table is None else table.rows[..., self.index]

    def __set__(self, table: Table, value: Any) -> None:
        table.rows[..., self.index] = value


@dataclass(eq=False)
class Table:
    """Rows of numbers, numpy or torch, of any leading shape; subclasses name their columns."""

    WIDTH: ClassVar[int]
    rows: Any

    def __post_init__(self) -> None:
        if self.rows.shape[-1] != self.WIDTH:
            raise ValueError(f"rows of {type(self).__name__} have {self.WIDTH} columns, not {self.rows.shape[-1]}")

    def __getitem__(self, index: Any) -> Any:
        """A table of the rows at an index into the leading axes."""
        return type(self)(self.rows[index])

    def copy(self) -> Any:
        """A table of rows of its own (numpy)."""
        return type(self)(self.rows.copy())

    @classmethod
    def row(cls, **columns: Any) -> Float[np.ndarray, "width"]:
        """One row with columns by name, 0 where they are not given; an unknown name is a `KeyError`."""
        row, known = np.zeros(cls.WIDTH), vars(cls)
        for name, value in columns.items():
            row[known[name].index] = value
        return row

    @classmethod
    def stacked(cls, rows: list[Float[np.ndarray, "width"]]) -> Any:
        """A table (n, width) of single rows."""
        return cls(np.array(rows, dtype=float).reshape(-1, cls.WIDTH))
