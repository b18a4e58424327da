"""Which of very many plans a panorama may have been taken in: an inverted file of their prototypes.

Prototypes are sorted into cells (`prototype_cells`). A query compares the *cells* under all hypotheses of the heading
and the camera's height, and then, from the best triple of a cell and two hypotheses on, the prototypes that lie in it,
each under these hypotheses alone, until it has compared so many pairs. What is not compared weighs nothing. Prototypes
that are equal lie in one cell, and a cell is compared whole or not at all: copies of a plan have equal masses.

Where there are no more pairs than that, all of them are compared, and the masses are exact.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.bundle import EvidenceModel
from lalaloc_core.localise.evidence import EvidenceConfig
from lalaloc_core.localise.poses import Query
from lalaloc_core.localise.prototype_cells import FAMILIES, Cells
from lalaloc_core.localise.prototype_costs import PrototypeCosts
from lalaloc_core.localise.prototypes import ROW, Prototypes, joined

# Pairs of a prototype and hypotheses that a query compares.
COMPARED = 150_000
# Pairs that are compared at a time, to bound memory; those of one cell are not divided between two queries.
_AT_ONCE = 65_536


@dataclass(frozen=True, eq=False)
class PlanIndex:
    """Prototypes of plans by the cells that they lie in.

    Attributes:
        rows: of `prototypes.ROW`, where those of the plans are among, perhaps in a file that is mapped into memory.
        step_m: of the grids that they were taken from.
        cells: that they were sorted into.
        plans: how many plans there are.
        member: (n,) where in `rows` the prototypes are, by their cells.
        plan: (n,) which plan each of these is of.
        first: (v + 1,) where the members of each cell begin.
    """

    rows: np.ndarray
    step_m: float
    cells: Cells
    plans: int
    member: Int[np.ndarray, "n"]
    plan: Int[np.ndarray, "n"]
    first: Int[np.ndarray, "w"]

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
        """An index of the plans whose prototypes are `count` rows from `begin` on."""
        total = int(count.sum())
        plan = np.repeat(np.arange(len(count), dtype=np.int32), count)
        ends = np.cumsum(count)
        member = np.arange(total) + np.repeat(begin - (ends - count), count)
        cell = np.asarray(rows["cell"])[member]
        # Stable, so that the plans' order, and nothing else, tells which of equals comes first.
        order = np.argsort(cell, kind="stable")
        first = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=len(cells)))])
        small = np.int32 if len(rows) < 2**31 else np.int64
        return cls(rows, step_m, cells, len(count), member[order].astype(small), plan[order], first)

    @classmethod
    def of_parts(cls, parts: Sequence[Prototypes], cells: Cells) -> PlanIndex:
        """An index of the prototypes of some plans, which are sorted into cells here."""
        rows = joined(parts).rows.copy()
        rows["cell"] = cells.sort(rows)
        count = np.array([len(part) for part in parts])
        return cls.of(rows, np.cumsum(count) - count, count, step_m=parts[0].step_m, cells=cells)

    @property
    def nbytes(self) -> int:
        """Memory that the index takes; of rows in a file, none."""
        rows = 0 if isinstance(self.rows, np.memmap) else self.rows.nbytes
        return rows + self.member.nbytes + self.plan.nbytes + self.first.nbytes

    def log_masses(
        self, query: Query, weights: EvidenceModel, config: EvidenceConfig, *, compared: int = COMPARED
    ) -> Float[np.ndarray, "p"]:
        """Log of each plan's mass; -inf for plans none of whose prototypes was compared.

        Args:
            compared: pairs that are compared; a few more, so that the last cell is compared whole.
        """
        costs = PrototypeCosts(query, self.step_m, weights, config)
        cell, hypothesis, offset = self._triples(costs, compared)
        size, mass, best = self._size[cell], np.zeros(self.plans), np.inf
        for part in _batches(size):
            repeats = size[part]
            inside = np.arange(int(repeats.sum())) - np.repeat(np.cumsum(repeats) - repeats, repeats)
            where = np.repeat(self.first[cell[part]], repeats) + inside
            rows = self._raw[self.member[where]].view(ROW)
            cost = costs.of(rows, np.repeat(hypothesis[part], repeats), np.repeat(offset[part], repeats))
            # In units of the least cost so far, so that nothing underflows that weighs something.
            lowest = min(best, float(cost.min()))
            mass *= np.exp(-weights.temperature * (best - lowest)) if np.isfinite(best) else 1.0
            best = lowest
            weight = np.exp(rows["log_area"] - weights.temperature * (cost.astype(np.float64) - best))
            mass += np.bincount(self.plan[where], weight, minlength=self.plans)
        with np.errstate(divide="ignore"):
            return np.log(mass) - weights.temperature * best

    def _triples(
        self, costs: PrototypeCosts, compared: int
    ) -> tuple[Int[np.ndarray, "t"], Int[np.ndarray, "t"], Int[np.ndarray, "t"]]:
        """The cells whose members are compared, with the hypotheses that they are compared under."""
        k, j = costs.shape
        if len(self.member) * k * j <= compared:
            shape = len(self._filled), k, j
            cell, hypothesis, offset = np.unravel_index(np.arange(len(self._filled) * k * j), shape)
            return self._filled[cell], hypothesis, offset
        return self._best_triples(costs, compared)

    def _best_triples(self, costs: PrototypeCosts, compared: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        family, within = np.divmod(self._filled, len(self.cells) // FAMILIES)
        by_family = self.cells.costs(costs, np.unique(family).tolist())
        by_cell = np.concatenate([cost[within[family == number]] for number, cost in by_family.items()])
        size = np.repeat(self._size[self._filled], costs.shape[0] * costs.shape[1])
        flat = by_cell.ravel()
        # No more triples than pairs are needed, and usually far fewer: a cell of many plans has many members.
        kept = min(len(flat), max(64, 8 * compared // max(1, int(size.mean()))))
        order = np.argpartition(flat, kept - 1)[:kept]
        order = order[np.argsort(flat[order], kind="stable")]
        within = np.cumsum(size[order]) <= compared
        order = order[: max(1, int(within.sum()) + 1)]
        cell, hypothesis, offset = np.unravel_index(order, by_cell.shape)
        return self._filled[cell], hypothesis, offset

    @cached_property
    def _raw(self) -> np.ndarray:
        """The rows as bytes: numpy copies those an order of magnitude faster than it copies fields."""
        return self.rows.view(np.dtype((np.void, ROW.itemsize)))

    @cached_property
    def _size(self) -> Int[np.ndarray, "v"]:
        return np.diff(self.first)

    @cached_property
    def _filled(self) -> Int[np.ndarray, "u"]:
        """The cells that have members."""
        return np.flatnonzero(self._size)


def _batches(size: Int[np.ndarray, "t"]) -> Iterator[slice]:
    """Triples that are taken together, up to so many pairs but for the last triple."""
    batch = (np.cumsum(size) - size) // _AT_ONCE
    edges = np.flatnonzero(np.diff(batch, prepend=-1, append=batch[-1] + 1))
    for begin, end in itertools.pairwise(edges.tolist()):
        yield slice(begin, end)
