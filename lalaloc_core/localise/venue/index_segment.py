"""Segment of an index of prototypes: the inverted file of some plans, which never changes.

Segments hold the distinct prototypes of their plans, ordered by cell, and a code scan for each family of cells. An
index (`plan_index`) has several: plans that are added later are in segments of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64

from lalaloc_core.localise.venue.prototype_cells import FAMILIES, Cells
from lalaloc_core.localise.venue.prototype_codes import BYTES_PER_CODE, CodeScan, product_codes
from lalaloc_core.localise.venue.prototypes import ROW

# Rows read at a time, to bound memory.
_BATCH_SIZE = 65_536
# Sort keys have the cell in the upper 16 bits and a hash of the row in the lower 48.
_CELL_SHIFT = np.uint64(48)


@dataclass(frozen=True, eq=False, kw_only=True)
class Segment:
    """Inverted file of the u distinct ones among the n prototypes of p plans.

    Attributes:
        rows: records of type `prototypes.ROW` that include the plans' prototypes; can be a memory-mapped file.
        cells: the coarse quantiser that assigned the prototypes to v cells.
        plan_count: number of plans, p.
        row: (u,) number in `rows` of each distinct prototype, ordered by cell.
        owner: (n,) plans that own the distinct prototypes, grouped by prototype.
        owner_begin: (u + 1,) where the group of each distinct prototype begins in `owner`.
        cell_begin: (v + 1,) where the inverted list of each cell begins in `row`.
    """

    rows: np.ndarray
    cells: Cells
    plan_count: int
    row: Int[np.ndarray, "u"]
    owner: Int[np.ndarray, "n"]
    owner_begin: Int[np.ndarray, "w"]
    cell_begin: Int[np.ndarray, "v"]

    @classmethod
    def build(cls, rows: np.ndarray, begin: Int[np.ndarray, "p"], count: Int[np.ndarray, "p"], cells: Cells) -> Segment:
        """Return the segment of plans whose prototypes are in `rows`; see `PlanIndex.build`."""
        owner = np.repeat(np.arange(len(count), dtype=np.int32), count)
        ends = np.cumsum(count)
        row = np.arange(len(owner)) + np.repeat(begin - (ends - count), count)
        key = _sort_keys(rows, row)
        # A stable sort keeps equal prototypes in the order of their plans.
        order = np.argsort(key, kind="stable")
        key = key[order]
        owner_begin = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
        cell = (key[owner_begin] >> _CELL_SHIFT).astype(np.intp)
        cell_begin = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=len(cells)))])
        smallest_type = np.int32 if len(rows) < 2**31 else np.int64
        owner_begin = np.append(owner_begin, len(owner))
        return cls(
            rows=rows,
            cells=cells,
            plan_count=len(count),
            row=row[order[owner_begin[:-1]]].astype(smallest_type),
            owner=owner[order],
            owner_begin=owner_begin.astype(smallest_type),
            cell_begin=cell_begin,
        )

    def __len__(self) -> int:
        """Return the number of distinct prototypes."""
        return len(self.row)

    @property
    def nbytes(self) -> int:
        """Bytes in memory, including the product codes; memory-mapped rows count as 0."""
        rows = 0 if isinstance(self.rows, np.memmap) else self.rows.nbytes
        lists = self.row.nbytes + self.owner.nbytes + self.owner_begin.nbytes + self.cell_begin.nbytes
        return rows + lists + BYTES_PER_CODE * len(self.row)

    @cached_property
    def cell_sizes(self) -> Int[np.ndarray, "v"]:
        """Number of distinct prototypes of each cell."""
        return np.diff(self.cell_begin)

    def prepare(self) -> None:
        """Compute the product codes now; otherwise the first search does."""
        _ = self._scans

    def records(self, prototype: Int[np.ndarray, "m"]) -> np.ndarray:
        """Return the rows of distinct prototypes."""
        return self._raw[self.row[prototype]].view(ROW)

    def owners(self, prototype: Int[np.ndarray, "m"]) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "e"]]:
        """Return the number of owners of distinct prototypes, and the owners of all of them, concatenated."""
        begin, count = self.owner_begin[prototype], self.owner_begin[prototype + 1] - self.owner_begin[prototype]
        within = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
        return count, self.owner[np.repeat(begin, count) + within]

    def owned_by_none(self, kept: Bool[np.ndarray, "p"]) -> Int[np.ndarray, "d"]:
        """Return the distinct prototypes without an owner among the plans that are kept, rising."""
        lost = np.flatnonzero(~kept[self.owner])
        prototype = np.unique(np.searchsorted(self.owner_begin, lost, side="right") - 1)
        count, owner = self.owners(prototype)
        place = np.repeat(np.arange(len(prototype)), count)
        return prototype[np.bincount(place, kept[owner], minlength=len(prototype)) == 0]

    def cell_of(self, prototype: Int[np.ndarray, "m"]) -> Int[np.ndarray, "m"]:
        """Return the cells of distinct prototypes."""
        return np.searchsorted(self.cell_begin, prototype, side="right") - 1

    def search(
        self,
        tables: Mapping[int, Float[np.ndarray, "q d"]],
        probed: Mapping[int, Bool[np.ndarray, "l q"]] | None,
        count: int,
        helper: Executor | None = None,
    ) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"], Float[np.ndarray, "m"]]:
        """Return the cheapest distinct prototypes of each of q queries by their codes: numbers, queries and costs.

        Args:
            tables: lookup tables by family, see `prototype_codes`.
            probed: tells which cells of each family are probed for each query; families left out are not. None probes
                all.
            count: maximum number of prototypes per query and family.
            helper: threads that take over a part; None: the caller's does all.
        """
        parts = [(np.empty(0, np.intp), np.empty(0, np.intp), np.empty(0, np.float32))]
        for family, (first, scan) in self._scans.items():
            if probed is not None and family not in probed:
                continue
            cell, queries = self.nonempty_cells[family] % self.cells_per_family, len(tables[family])
            lists = np.ones((queries, len(cell)), bool) if probed is None else probed[family][cell].T
            number, cost = scan.search(tables[family], lists, count, helper)
            query = np.broadcast_to(np.arange(queries)[:, None], number.shape)
            is_found = number >= 0
            parts.append((number[is_found] + first, query[is_found], cost[is_found]))
        number, query, cost = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return number, query, cost

    @cached_property
    def _scans(self) -> dict[int, tuple[int, CodeScan]]:
        """Code scan of each family, with a list for each non-empty cell, and the family's first distinct prototype."""
        scans = {}
        for family, cell in self.nonempty_cells.items():
            first, end = int(self.cell_begin[cell[0]]), int(self.cell_begin[cell[-1] + 1])
            batches = (self.row[begin : min(begin + _BATCH_SIZE, end)] for begin in range(first, end, _BATCH_SIZE))
            code = np.concatenate([product_codes(self._raw[row].view(ROW)) for row in batches])
            scans[family] = first, CodeScan(code, np.append(self.cell_begin[cell], end) - first)
        return scans

    @cached_property
    def _raw(self) -> np.ndarray:
        """The rows as bytes, which numpy copies ten times as fast as records."""
        return _as_bytes(self.rows)

    @property
    def cells_per_family(self) -> int:
        """Number of cells of a family."""
        return len(self.cells) // FAMILIES

    @cached_property
    def nonempty_cells(self) -> dict[int, np.ndarray]:
        """Cells with prototypes, by family; families without prototypes are left out."""
        return by_family(np.flatnonzero(self.cell_sizes), self.cells_per_family)


def by_family(cell: Int[np.ndarray, "l"], per_family: int) -> dict[int, np.ndarray]:
    """Return cells by family, of the families that have any."""
    family = cell // per_family
    return {int(number): cell[family == number] for number in np.unique(family)}


def _as_bytes(rows: np.ndarray) -> np.ndarray:
    return rows.view(np.dtype((np.void, ROW.itemsize)))


def _sort_keys(rows: np.ndarray, row: Int[np.ndarray, "n"]) -> UInt64[np.ndarray, "n"]:
    """Return keys that sort prototypes by cell, then by a hash of the record (multilinear, modulo 2^64).

    Different prototypes of one cell share a key with a chance of 2^-48; they would be compared as if they were equal.
    """
    key, raw = np.empty(len(row), np.uint64), _as_bytes(rows)
    words = -(-ROW.itemsize // 8)
    # Multilinear hashing needs odd random factors; a fixed seed keeps the order of prototypes the same.
    factor = np.random.default_rng(0).integers(2**62, size=words, dtype=np.uint64) * np.uint64(2) + np.uint64(1)
    for begin in range(0, len(row), _BATCH_SIZE):
        part = raw[row[begin : begin + _BATCH_SIZE]]
        content = np.zeros((len(part), 8 * words), np.uint8)
        content[:, : ROW.itemsize] = part.view(np.uint8).reshape(len(part), -1)
        hashed = (content.view(np.uint64) * factor).sum(axis=1, dtype=np.uint64)
        # The upper bits of a product are well mixed, so multiply once more before keeping 48 of them.
        hashed = (hashed ^ hashed >> np.uint64(29)) * factor[0]
        cell = part.view(ROW)["cell"].astype(np.uint64)
        key[begin : begin + len(part)] = cell << _CELL_SHIFT | hashed >> np.uint64(64 - 48)
    return key
