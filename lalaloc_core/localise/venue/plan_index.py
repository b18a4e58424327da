"""Index of the prototypes of many plans; gives every plan a probability for a panorama.

It works like an inverted file with product codes and re-ranking (IVF-PQ in faiss). A query compares *pairs* of a
prototype and a hypothesis of the heading and the camera height. Three stages, each on fewer pairs than the one before:

1. **Inverted file.** A coarse quantiser assigns each prototype to a cell (`prototype_cells`). The query computes the
   cost of every cell under every hypothesis and probes the cheapest ones.
2. **Code scan.** The pairs of the probed cells are compared by product codes of 25 bytes, with a lookup table for each
   hypothesis (`prototype_codes`).
3. **Exact comparison.** The cheapest pairs of the scan get their exact cost (`prototype_costs`) and are summed to the
   masses of their plans. All other pairs count as zero.

Small indexes skip stages: if the query has at most `scanned` pairs all cells are probed, and if it has at most
`compared` pairs all are compared exactly, so that the masses are exact. Equal prototypes are stored and compared once,
for all plans that own them, so copies of a plan have equal masses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64

from lalaloc_core.localise.bundle import MatchingWeights
from lalaloc_core.localise.matching_cost import MatchingConfig
from lalaloc_core.localise.poses import Query
from lalaloc_core.localise.venue.prototype_cells import FAMILIES, Cells, claims_of
from lalaloc_core.localise.venue.prototype_codes import BYTES_PER_CODE, CodeScan, lookup_tables, product_codes
from lalaloc_core.localise.venue.prototype_costs import PrototypeCosts
from lalaloc_core.localise.venue.prototypes import ROW, Prototypes, joined

# Default numbers of pairs per query in the code scan and in the exact comparison.
SCANNED, COMPARED = 40_000_000, 20_000
# The scan returns this multiple of each hypothesis's share, as the best pairs are spread unevenly over hypotheses.
_OVERFETCH = 6
# Pairs compared, and rows read, at a time, to bound memory.
_BATCH_SIZE = 65_536
# Sort keys have the cell in the upper 16 bits and a hash of the row in the lower 48.
_CELL_SHIFT = np.uint64(48)


@dataclass(frozen=True, eq=False, kw_only=True)
class PlanIndex:
    """Inverted file of the u distinct ones among the n prototypes of some plans.

    Attributes:
        rows: records of type `prototypes.ROW` that include the plans' prototypes; can be a memory-mapped file.
        plan_count: number of plans, p.
        row: (u,) number in `rows` of each distinct prototype, ordered by cell.
        owner: (n,) plans that own the distinct prototypes, grouped by prototype.
        owner_begin: (u + 1,) where the group of each distinct prototype begins in `owner`.
        cell_begin: (v + 1,) where the inverted list of each of v cells begins in `row`.
    """

    rows: np.ndarray
    step_m: float
    cells: Cells
    plan_count: int
    row: Int[np.ndarray, "u"]
    owner: Int[np.ndarray, "n"]
    owner_begin: Int[np.ndarray, "w"]
    cell_begin: Int[np.ndarray, "v"]

    @classmethod
    def build(
        cls,
        rows: np.ndarray,
        begin: Int[np.ndarray, "p"],
        count: Int[np.ndarray, "p"],
        *,
        step_m: float,
        cells: Cells,
    ) -> PlanIndex:
        """Return the index of plans whose prototypes are in `rows`.

        `rows` are records of type `prototypes.ROW` with the cells that `cells`, the coarse quantiser, assigned; `begin`
        and `count` are the number of each plan's first record and the number of its records.
        """
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
            step_m=step_m,
            cells=cells,
            plan_count=len(count),
            row=row[order[owner_begin[:-1]]].astype(smallest_type),
            owner=owner[order],
            owner_begin=owner_begin.astype(smallest_type),
            cell_begin=cell_begin,
        )

    @classmethod
    def from_prototypes(cls, parts: Sequence[Prototypes], cells: Cells) -> PlanIndex:
        """Assign the prototypes of each plan to cells and return their index."""
        rows = joined(parts).rows.copy()
        rows["cell"] = cells.assign(rows)
        count = np.array([len(part) for part in parts])
        return cls.build(rows, np.cumsum(count) - count, count, step_m=parts[0].step_m, cells=cells)

    @property
    def nbytes(self) -> int:
        """Bytes in memory, including the product codes; memory-mapped rows count as 0."""
        rows = 0 if isinstance(self.rows, np.memmap) else self.rows.nbytes
        lists = self.row.nbytes + self.owner.nbytes + self.owner_begin.nbytes + self.cell_begin.nbytes
        return rows + lists + BYTES_PER_CODE * len(self.row)

    def prepare(self) -> None:
        """Compute the product codes now; otherwise the first query that needs them does."""
        _ = self._scans

    def log_masses(
        self,
        query: Query,
        weights: MatchingWeights,
        config: MatchingConfig,
        *,
        compared: int = COMPARED,
        scanned: int = SCANNED,
    ) -> Float[np.ndarray, "p"]:
        """Return the log of each plan's mass (see `prototypes`); -inf if none of its prototypes was compared exactly.

        At most `compared` pairs are compared exactly. About `scanned` pairs are in the code scan, as the last probed
        cell is scanned whole.
        """
        costs = PrototypeCosts(query, self.step_m, weights, config)
        k, j = costs.shape
        compares_all = len(self.row) * k * j <= compared
        pairs = self._all_pairs(k, j) if compares_all else self._best_pairs(costs, compared, scanned)
        mass, lowest = np.zeros(self.plan_count), np.inf
        for prototype, hypothesis, offset in pairs:
            rows = self._raw[self.row[prototype]].view(ROW)
            cost = costs.pairs(rows, hypothesis, offset)
            # Masses are relative to the lowest cost so far, so that relevant ones do not underflow.
            new_lowest = min(lowest, float(cost.min()))
            mass *= np.exp(-weights.temperature * (lowest - new_lowest)) if np.isfinite(lowest) else 1.0
            lowest = new_lowest
            weight = np.exp(rows["log_area"] - weights.temperature * (cost.astype(np.float64) - lowest))
            begin, count = self.owner_begin[prototype], self.owner_begin[prototype + 1] - self.owner_begin[prototype]
            within = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
            owner = self.owner[np.repeat(begin, count) + within]
            mass += np.bincount(owner, np.repeat(weight, count), minlength=self.plan_count)
        with np.errstate(divide="ignore"):
            return np.log(mass) - weights.temperature * lowest

    def _all_pairs(self, k: int, j: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield all pairs in batches: distinct prototypes, heading hypotheses and height hypotheses, by number."""
        shape = len(self.row), k, j
        for begin in range(0, len(self.row) * k * j, _BATCH_SIZE):
            pair = np.arange(begin, min(begin + _BATCH_SIZE, len(self.row) * k * j))
            prototype, hypothesis, offset = np.unravel_index(pair, shape)
            yield prototype, hypothesis, offset

    def _best_pairs(
        self, costs: PrototypeCosts, compared: int, scanned: int
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield the `compared` pairs that are cheapest by their codes, in batches as `_all_pairs` does."""
        k, j = costs.shape
        probed = self._probed_cells(costs, scanned)
        per_hypothesis = min(compared, -(-_OVERFETCH * compared // (k * j)))
        parts = []
        for family, (first, scan) in self._scans.items():
            tables = lookup_tables(costs, claims_of(family)).reshape(k * j, -1)
            number, cost = scan.search(tables, probed[family].reshape(-1, k * j).T, per_hypothesis)
            joint = np.broadcast_to(np.arange(k * j)[:, None], number.shape)
            is_found = number >= 0
            parts.append((number[is_found] + first, joint[is_found], cost[is_found]))
        prototype, joint, cost = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        if len(cost) > compared:
            kept = np.argpartition(cost, compared - 1)[:compared]
            prototype, joint = prototype[kept], joint[kept]
        # Rows are read fastest in the order of memory.
        order = np.argsort(prototype, kind="stable")
        prototype, joint = prototype[order], joint[order]
        hypothesis, offset = np.divmod(joint, j)
        for begin in range(0, len(prototype), _BATCH_SIZE):
            part = slice(begin, begin + _BATCH_SIZE)
            yield prototype[part], hypothesis[part], offset[part]

    def _probed_cells(self, costs: PrototypeCosts, scanned: int) -> dict[int, Bool[np.ndarray, "l k j"]]:
        """Return for each family which of its l non-empty cells are probed under which hypotheses."""
        k, j = costs.shape
        nonempty = self._nonempty_cells
        if len(self.row) * k * j <= scanned:
            return {family: np.ones((len(cell), k, j), bool) for family, cell in nonempty.items()}
        by_family = self.cells.costs(costs, nonempty)
        cost = np.concatenate(
            [by_family[family][cell % self._cells_per_family].ravel() for family, cell in nonempty.items()]
        )
        size = np.concatenate([np.repeat(self._cell_sizes[cell], k * j) for cell in nonempty.values()])
        # Costs are rounded to 16 bits, which numpy sorts twenty times as fast.
        lowest = float(cost.min())
        rounded = ((cost - lowest) * (65535.0 / max(float(cost.max()) - lowest, 1e-9))).astype(np.uint16)
        order = np.argsort(rounded, kind="stable")
        fits = np.cumsum(size[order]) <= scanned
        probed = np.zeros(len(cost), bool)
        probed[order[: int(fits.sum()) + 1]] = True
        ends = np.cumsum([len(cell) * k * j for cell in nonempty.values()])
        parts = np.split(probed, ends[:-1])
        return {family: part.reshape(-1, k, j) for family, part in zip(nonempty, parts, strict=True)}

    @cached_property
    def _scans(self) -> dict[int, tuple[int, CodeScan]]:
        """Code scan of each family, with a list for each non-empty cell, and the family's first distinct prototype."""
        scans = {}
        for family, cell in self._nonempty_cells.items():
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
    def _cells_per_family(self) -> int:
        return len(self.cells) // FAMILIES

    @cached_property
    def _cell_sizes(self) -> Int[np.ndarray, "v"]:
        return np.diff(self.cell_begin)

    @cached_property
    def _nonempty_cells(self) -> dict[int, Int[np.ndarray, "l"]]:
        """Cells with prototypes, by family; families without prototypes are left out."""
        cell = np.flatnonzero(self._cell_sizes)
        family = cell // self._cells_per_family
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
