"""Segment of an index of prototypes: the inverted file of some plans, which never changes, and its code scan.

Segments hold the distinct prototypes of their plans, ordered by cell, and a code scan for each family of cells. An
index (`plan_index`) has several: plans that are added later are in segments of their own.

**Code scan** (IVF-PQ fast-scan of faiss). The cost of a prototype is a sum over its azimuths, its ceiling and its room
type. A product code quantises each part to 4 bits, and the query computes the cost of all 16 values of each part once,
in a lookup table. The approximate cost of a code is then the sum of one entry per part (asymmetric distance; Jégou et
al., *Product quantization for nearest neighbor search*, 2011). Tables of 16 entries fit a SIMD register (André et al.,
*Cache locality is not enough*, 2015): a core compares more than half a billion codes per second.

A code has 50 parts in 25 bytes: the wall's distance at each of 32 azimuths, the opening classes of each of 16 pairs of
azimuths, the ceiling, and the room type. In faiss, a table entry is the inner product of a part of the query vector
with a centroid. The centroids here are the unit vectors, so the query vector is the (negated) tables themselves.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt64

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.localise.venue.prototype_cells import FAMILIES, Cells
from lalaloc_core.localise.venue.prototype_costs import PrototypeCosts
from lalaloc_core.localise.venue.prototypes import AZIMUTHS, ROW

# Rows read at a time, to bound memory.
_BATCH_SIZE = 65_536
# Sort keys have the cell in the upper 16 bits and a hash of the row in the lower 48.
_CELL_SHIFT = np.uint64(48)
_VALUES = 16
# Boundaries of the 16 values of a distance (m), finest at typical distances in homes.
_EDGES_M = (0.6, 0.85, 1.1, 1.4, 1.7, 2.05, 2.4, 2.8, 3.2, 3.7, 4.4, 5.4, 7.0, 9.5, 15.0)
_MIN_DISTANCE_M, _MAX_DISTANCE_M = 0.35, 25.0
# Number of samples within the interval of a value; their costs are averaged.
_SAMPLES = 4
# Boundaries for ceilings (m), and the outer ends of the first and the last interval.
_CEILING_EDGES_M = (2.1, 2.2, 2.3, 2.4, 2.5, 2.6, 2.7, 2.8, 2.95, 3.1, 3.3, 3.6, 4.0, 5.0, 7.0)
_MIN_CEILING_M, _MAX_CEILING_M = 2.0, 9.0
# faiss rounds all tables in proportion to their largest entry; a limit on the ceiling's keeps the others precise.
_MAX_CEILING_COST = 0.25
_PARTS = AZIMUTHS + AZIMUTHS // 2 + 2
_CODE_BYTES = _PARTS // 2
# Bytes of a code in an inverted list, with its 64-bit number; lists are padded to blocks of 32 codes.
_BYTES_PER_CODE = _CODE_BYTES + 8
_BLOCK = 32
_CHUNK = 65_536


def product_codes(rows: np.ndarray) -> UInt8[np.ndarray, "n b"]:
    """Return the codes of prototypes (records of type `prototypes.ROW`), two parts to a byte, the first one lower."""
    # Half-precision numbers are quantised by looking up their 16 bits.
    distance, ceiling = _quantiser(np.log(_EDGES_M)), _quantiser(np.array(_CEILING_EDGES_M))
    code = np.empty((len(rows), _CODE_BYTES), np.uint8)
    openings = AZIMUTHS // 2
    for begin in range(0, len(rows), _CHUNK):
        part = rows[begin : begin + _CHUNK]
        target = code[begin : begin + _CHUNK]
        value = distance[np.ascontiguousarray(part["log_profile"]).view(np.uint16)]
        target[:, :openings] = value[:, ::2] | value[:, 1::2] << 4
        target[:, openings:-1] = part["openings"]
        room_type = np.minimum(part["room_type"], _VALUES - 1)
        target[:, -1] = ceiling[np.ascontiguousarray(part["ceiling_m"]).view(np.uint16)] | room_type << 4
    return code


class CodeScan:
    """Inverted lists of product codes; a search scans the lists that the caller probes."""

    def __init__(self, code: UInt8[np.ndarray, "n b"], begin: Int[np.ndarray, "w"]) -> None:
        """Build the faiss index.

        `begin` is the begin of each list in `code`, and the end of the last list.
        """
        # Imported late: only large venues need it, and it takes as long as several queries.
        import faiss

        dimensions = _PARTS * _VALUES
        lists = len(begin) - 1
        # The constructor needs a coarse quantiser, but callers choose the lists. The index refers to it, so keep it.
        self._quantiser = faiss.IndexFlatIP(dimensions)
        filled = faiss.IndexIVFPQ(self._quantiser, dimensions, lists, _PARTS, 4, faiss.METRIC_INNER_PRODUCT)
        filled.by_residual, filled.is_trained = False, True
        faiss.copy_array_to_vector(np.tile(np.eye(_VALUES, dtype=np.float32), (_PARTS, 1)).ravel(), filled.pq.centroids)
        number, stored = np.arange(len(code), dtype=np.int64), cast(Any, filled.invlists)
        for list_number in range(lists):
            part = slice(int(begin[list_number]), int(begin[list_number + 1]))
            entries = np.ascontiguousarray(code[part])
            stored.add_entries(list_number, len(entries), faiss.swig_ptr(number[part]), faiss.swig_ptr(entries))
        filled.ntotal = len(code)
        self._index: Any = faiss.IndexIVFPQFastScan(filled, _BLOCK)
        self._index.nprobe = lists
        # The fast-scan index has its own copy of the codes in blocks; drop the original lists to free memory.
        self._index.orig_invlists = None
        self._index.referenced_objects.clear()

    def search(
        self,
        tables: Float[np.ndarray, "q d"],
        lists: Bool[np.ndarray, "q l"],
        count: int,
        helper: Executor | None = None,
    ) -> tuple[Int[np.ndarray, "q m"], Float[np.ndarray, "q m"]]:
        """Return the numbers of the cheapest codes of each of q queries, and their costs.

        Fewer codes than `count` are filled up with the number -1 and infinite costs. `tables` holds a lookup table per
        query, the 16 values of the 50 parts (see `lookup_tables`); `lists` tells whether each list is probed for each
        query. Every second query is searched on a thread of `helper`, if there is one.
        """
        if helper is None or len(tables) < 2:
            return self._search(tables, lists, count)
        # Neighbours are similar, so that both halves probe about as many codes.
        second = helper.submit(self._search, tables[1::2], lists[1::2], count)
        code, cost = (np.empty((len(tables), count), kind) for kind in (np.int64, np.float32))
        code[::2], cost[::2] = self._search(tables[::2], lists[::2], count)
        code[1::2], cost[1::2] = second.result()
        return code, cost

    def _search(
        self, tables: Float[np.ndarray, "q d"], lists: Bool[np.ndarray, "q l"], count: int
    ) -> tuple[Int[np.ndarray, "q m"], Float[np.ndarray, "q m"]]:
        import faiss

        # Queries of several callers run on threads of their own; by default faiss takes all cores for each.
        faiss.omp_set_num_threads(1)
        number = np.where(lists, np.arange(lists.shape[1]), -1)
        queries = np.ascontiguousarray(-tables, np.float32)
        similarity, code = self._index.search_preassigned(queries, count, number, None)
        return code, np.where(code < 0, np.inf, -similarity)


def lookup_tables(costs: PrototypeCosts, claims: int) -> Float[np.ndarray, "k j p c"]:
    """Return the cost of each value of each part of a code under every heading and height.

    `claims` are the opening classes that the plans claim, as in `prototypes.ROW`.
    """
    (k, j), azimuth = costs.shape, np.arange(AZIMUTHS)
    tables = np.zeros((k, j, _PARTS, _VALUES), np.float32)
    distance = _samples(np.log((_MIN_DISTANCE_M, *_EDGES_M, _MAX_DISTANCE_M)))
    residual = (distance - costs.shifted[..., None, None]) * costs.precision[:, None, :, None, None]
    tables[:, :, azimuth] = np.log1p(np.square(residual)).mean(axis=-1) / AZIMUTHS
    if costs.compares_openings:
        # A value combines the classes of two azimuths, the first in the lower bits.
        loss, classes = costs.opening_loss(claims), len(OPENING_CLASSES)
        pair = loss[:, 1::2, :, None] + loss[:, ::2, None, :]
        tables[:, :, AZIMUTHS:-2] = pair.reshape(k, 1, AZIMUTHS // 2, classes * classes)
    ceiling_m = _samples(np.array((_MIN_CEILING_M, *_CEILING_EDGES_M, _MAX_CEILING_M))).mean(axis=-1)
    tables[:, :, -2] = np.minimum(costs.ceilings(ceiling_m), _MAX_CEILING_COST) + costs.penalty[:, None]
    tables[:, :, -1] = costs.room_types
    return tables


def _quantiser(edges: Float[np.ndarray, "e"]) -> UInt8[np.ndarray, "65536"]:
    """Return the value of every half-precision number, indexed by its 16 bits."""
    with np.errstate(invalid="ignore"):
        number = np.nan_to_num(np.arange(2**16, dtype=np.uint16).view(np.float16).astype(np.float64))
    return np.searchsorted(edges, number, side="right").astype(np.uint8)


def _samples(edges: Float[np.ndarray, "17"]) -> Float[np.ndarray, "16 s"]:
    """Return evenly spaced samples of the interval of each value."""
    share = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    return (edges[:-1, None] + np.diff(edges)[:, None] * share).astype(np.float32)


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
        return rows + lists + _BYTES_PER_CODE * len(self.row)

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
            tables: lookup tables by family, see `lookup_tables`.
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
