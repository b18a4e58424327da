"""Which of very many plans a panorama may have been taken in: an index of their prototypes.

A query goes through three stages, each of which leaves fewer pairs of a prototype and hypotheses of the heading and the
camera's height to the next one:

1. The prototypes lie in *cells* (`prototype_cells`), an inverted file. Where there are very many, those cells are
   looked into, each under those hypotheses, that cost least in their middle.
2. What lies in them is compared by codes of 25 bytes (`prototype_codes`).
3. Those that cost least by their codes are compared as they are (`prototype_costs`). What is not weighs nothing.

Prototypes that are equal are compared once, for all plans that have them: copies of a plan have equal masses. Where
there are so few pairs that all of them can be compared in the last stage, they are, and the masses are exact.
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
from lalaloc_core.localise.venue.prototype_codes import BYTES_OF_ONE, CodeScan, codes_of, tables_of
from lalaloc_core.localise.venue.prototype_costs import PrototypeCosts
from lalaloc_core.localise.venue.prototypes import ROW, Prototypes, joined

# Pairs of a prototype and hypotheses that a query compares by codes, and of these as they are.
SCANNED, COMPARED = 40_000_000, 20_000
# Candidates for the last stage, of each hypothesis: so many times its share, as one may have more of the best.
_MORE = 6
# Pairs that are compared at a time, and rows that are read at a time, to bound memory.
_BATCH_SIZE = 65_536
# A cell is told by the upper bits of a key by which prototypes are sorted, what they say by the lower ones.
_CELL_SHIFT = np.uint64(48)


@dataclass(frozen=True, eq=False, kw_only=True)
class PlanIndex:
    """Prototypes of plans by the cells that they lie in.

    Attributes:
        rows: of `prototypes.ROW`, where those of the plans are among, perhaps in a file that is mapped into memory.
        step_m: of the grids that they were taken from.
        cells: that they were sorted into.
        plans: how many plans there are.
        member: (u,) where in `rows` the prototypes are, by their cells; of those that are equal, the first one.
        plan: (n,) the plans that have each of these.
        owners: (u + 1,) where in `plan` those of each begin.
        first: (v + 1,) where the members of each cell begin.
    """

    rows: np.ndarray
    step_m: float
    cells: Cells
    plans: int
    member: Int[np.ndarray, "u"]
    plan: Int[np.ndarray, "n"]
    owners: Int[np.ndarray, "w"]
    first: Int[np.ndarray, "v"]

    @classmethod
    def of(
        cls,
        rows: np.ndarray,
        begin: Int[np.ndarray, "p"],
        count: Int[np.ndarray, "p"],
        *,
        step_m: float,
        cells: Cells,
    ) -> PlanIndex:
        """Return an index of the plans whose prototypes are `count` rows from `begin` on."""
        plan = np.repeat(np.arange(len(count), dtype=np.int32), count)
        ends = np.cumsum(count)
        member = np.arange(len(plan)) + np.repeat(begin - (ends - count), count)
        key = _keys(rows, member)
        # Stable, so that the plans' order, and nothing else, tells which of equals comes first.
        order = np.argsort(key, kind="stable")
        key = key[order]
        owners = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
        cell = (key[owners] >> _CELL_SHIFT).astype(np.intp)
        first = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=len(cells)))])
        small = np.int32 if len(rows) < 2**31 else np.int64
        owners = np.append(owners, len(plan))
        return cls(
            rows=rows,
            step_m=step_m,
            cells=cells,
            plans=len(count),
            member=member[order[owners[:-1]]].astype(small),
            plan=plan[order],
            owners=owners.astype(small),
            first=first,
        )

    @classmethod
    def of_parts(cls, parts: Sequence[Prototypes], cells: Cells) -> PlanIndex:
        """Return an index of the prototypes of some plans, which are sorted into cells here."""
        rows = joined(parts).rows.copy()
        rows["cell"] = cells.sort(rows)
        count = np.array([len(part) for part in parts])
        return cls.of(rows, np.cumsum(count) - count, count, step_m=parts[0].step_m, cells=cells)

    @property
    def nbytes(self) -> int:
        """Memory that it takes, with the codes, which large ones make for the first query; of rows in a file, none."""
        rows = 0 if isinstance(self.rows, np.memmap) else self.rows.nbytes
        places = self.member.nbytes + self.plan.nbytes + self.owners.nbytes + self.first.nbytes
        return rows + places + BYTES_OF_ONE * len(self.member)

    def prepare(self) -> None:
        """Make the codes now, which the first query would else."""
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
        """Log of each plan's mass; -inf for plans none of whose prototypes was compared as it is.

        Args:
            query: the encoded panorama.
            weights: weights of the matching cost.
            config: settings of the matching cost.
            compared: pairs that are compared as they are.
            scanned: pairs that are compared by codes; a few more, so that the last cell is compared whole.
        """
        costs = PrototypeCosts(query, self.step_m, weights, config)
        k, j = costs.shape
        few = len(self.member) * k * j <= compared
        mass, best = np.zeros(self.plans), np.inf
        for member, hypothesis, offset in self._all(k, j) if few else self._chosen(costs, compared, scanned):
            rows = self._raw[self.member[member]].view(ROW)
            cost = costs.of(rows, hypothesis, offset)
            # In units of the least cost so far, so that nothing underflows that weighs something.
            lowest = min(best, float(cost.min()))
            mass *= np.exp(-weights.temperature * (best - lowest)) if np.isfinite(best) else 1.0
            best = lowest
            weight = np.exp(rows["log_area"] - weights.temperature * (cost.astype(np.float64) - best))
            begin, count = self.owners[member], self.owners[member + 1] - self.owners[member]
            inside = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
            owner = self.plan[np.repeat(begin, count) + inside]
            mass += np.bincount(owner, np.repeat(weight, count), minlength=self.plans)
        with np.errstate(divide="ignore"):
            return np.log(mass) - weights.temperature * best

    def _all(self, k: int, j: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """All pairs: members, and the hypotheses of heading and height."""
        shape = len(self.member), k, j
        for begin in range(0, len(self.member) * k * j, _BATCH_SIZE):
            pair = np.arange(begin, min(begin + _BATCH_SIZE, len(self.member) * k * j))
            member, hypothesis, offset = np.unravel_index(pair, shape)
            yield member, hypothesis, offset

    def _chosen(
        self, costs: PrototypeCosts, compared: int, scanned: int
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """As `_all`, those pairs that cost least by their codes."""
        k, j = costs.shape
        looked_into = self._looked_into(costs, scanned)
        count = min(compared, -(-_MORE * compared // (k * j)))
        parts = []
        for family, (begin, scan) in self._scans.items():
            tables = tables_of(costs, claims_of(family)).reshape(k * j, -1)
            found, cost = scan.best(tables, looked_into[family].reshape(-1, k * j).T, count)
            turned = np.broadcast_to(np.arange(k * j)[:, None], found.shape)
            there = found >= 0
            parts.append((found[there] + begin, turned[there], cost[there]))
        member, turned, cost = (np.concatenate(of_all) for of_all in zip(*parts, strict=True))
        if len(cost) > compared:
            kept = np.argpartition(cost, compared - 1)[:compared]
            member, turned = member[kept], turned[kept]
        # In the order of memory.
        order = np.argsort(member, kind="stable")
        member, turned = member[order], turned[order]
        hypothesis, offset = np.divmod(turned, j)
        for begin in range(0, len(member), _BATCH_SIZE):
            part = slice(begin, begin + _BATCH_SIZE)
            yield member[part], hypothesis[part], offset[part]

    def _looked_into(self, costs: PrototypeCosts, scanned: int) -> dict[int, Bool[np.ndarray, "l k j"]]:
        """Which of the filled cells of each family are looked into, under which hypotheses."""
        k, j = costs.shape
        filled = self._filled
        if len(self.member) * k * j <= scanned:
            return {family: np.ones((len(cell), k, j), bool) for family, cell in filled.items()}
        by_family = self.cells.costs(costs, filled)
        cost = np.concatenate([by_family[family][cell % self._of_family].ravel() for family, cell in filled.items()])
        size = np.concatenate([np.repeat(self._size[cell], k * j) for cell in filled.values()])
        # Rounded to 16 bits, which numpy sorts twenty times as fast.
        least = float(cost.min())
        rounded = ((cost - least) * (65535.0 / max(float(cost.max()) - least, 1e-9))).astype(np.uint16)
        order = np.argsort(rounded, kind="stable")
        within = np.cumsum(size[order]) <= scanned
        looked_into = np.zeros(len(cost), bool)
        looked_into[order[: int(within.sum()) + 1]] = True
        ends = np.cumsum([len(cell) * k * j for cell in filled.values()])
        parts = np.split(looked_into, ends[:-1])
        return {family: part.reshape(-1, k, j) for family, part in zip(filled, parts, strict=True)}

    @cached_property
    def _scans(self) -> dict[int, tuple[int, CodeScan]]:
        """The codes of each family, a list for each filled cell, and the number of the first one's first member."""
        scans = {}
        for family, cell in self._filled.items():
            begin, end = int(self.first[cell[0]]), int(self.first[cell[-1] + 1])
            parts = range(begin, end, _BATCH_SIZE)
            code = np.concatenate(
                [codes_of(self._raw[self.member[at : min(at + _BATCH_SIZE, end)]].view(ROW)) for at in parts]
            )
            scans[family] = begin, CodeScan(code, np.append(self.first[cell], end) - begin)
        return scans

    @cached_property
    def _raw(self) -> np.ndarray:
        """The rows as bytes: numpy copies those an order of magnitude faster than it copies fields."""
        return _bytes_of(self.rows)

    @property
    def _of_family(self) -> int:
        return len(self.cells) // FAMILIES

    @cached_property
    def _size(self) -> Int[np.ndarray, "v"]:
        return np.diff(self.first)

    @cached_property
    def _filled(self) -> dict[int, Int[np.ndarray, "l"]]:
        """The cells of each family that have members; families that have none are left out."""
        filled = np.flatnonzero(self._size)
        family = filled // self._of_family
        return {int(one): filled[family == one] for one in np.unique(family)}


def _bytes_of(rows: np.ndarray) -> np.ndarray:
    return rows.view(np.dtype((np.void, ROW.itemsize)))


def _keys(rows: np.ndarray, member: Int[np.ndarray, "n"]) -> UInt64[np.ndarray, "n"]:
    """Sorts prototypes by their cells, and then by a hash of all that they say (multilinear, modulo 2^64).

    Two of one cell that differ have one key by a chance of 2^-48, and would then be compared as if they were equal.
    """
    key, raw = np.empty(len(member), np.uint64), _bytes_of(rows)
    words = -(-ROW.itemsize // 8)
    # Odd numbers, as random as need be.
    factor = np.random.default_rng(0).integers(2**62, size=words, dtype=np.uint64) * np.uint64(2) + np.uint64(1)
    for begin in range(0, len(member), _BATCH_SIZE):
        part = raw[member[begin : begin + _BATCH_SIZE]]
        content = np.zeros((len(part), 8 * words), np.uint8)
        content[:, : ROW.itemsize] = part.view(np.uint8).reshape(len(part), -1)
        hashed = (content.view(np.uint64) * factor).sum(axis=1, dtype=np.uint64)
        # The upper bits of a product are the random ones; those of a sum depend on all that is below them.
        hashed = (hashed ^ hashed >> np.uint64(29)) * factor[0]
        cell = part.view(ROW)["cell"].astype(np.uint64)
        key[begin : begin + len(part)] = cell << _CELL_SHIFT | hashed >> np.uint64(64 - 48)
    return key
