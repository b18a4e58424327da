"""Index of the prototypes of many plans; gives every plan a probability for a photograph.

It works like an inverted file with product codes and re-ranking (IVF-PQ in faiss). A query compares *pairs* of a
prototype and a hypothesis of the heading and the camera height. Four stages, each on fewer pairs than the one before:

1. **Inverted file.** A coarse quantiser assigns each prototype to a cell (`prototype_cells`). The query computes the
   cost of every cell under every hypothesis and probes the cheapest ones.
2. **Code scan.** The pairs of the probed cells are compared by product codes of 25 bytes, with a lookup table for each
   hypothesis (`index_segment`).
3. **Exact comparison.** The cheapest pairs of the scan get their exact cost (`prototype_costs`) and are summed to the
   masses of their plans. All other pairs count as zero.
4. **Alignment.** The cheapest of these get the cost at the best pose nearby (`PrototypeAlignment`), whose sums replace
   the masses of their plans. All other masses change by the median factor.

Small indexes skip stages: if the query has at most `scanned` pairs all cells are probed, if it has at most `compared`
pairs all are compared exactly, and if it has at most `aligned` pairs all are aligned. Equal prototypes of a segment are
stored and compared once, for all plans that own them. Pairs of equal cost are kept or left out together, so copies of a
plan have equal masses.

An index never changes, so queries need no lock. `PlanIndex.updated` returns a new one that shares the segments of the
old one: plans that were added are in a new segment, plans that were removed are left out of the sums. Segments are
merged so that each has at least twice as many plans as the next (the logarithmic method of Bentley and Saxe,
*Decomposable searching problems*, 1980): a query searches few segments, and a plan is sorted again seldom.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.localise.venue.index_search import (
    DividedIndex,
    Pairs,
    Pending,
    PlanMasses,
    PlanSearch,
    Probed,
    ShardSizes,
    cheapest,
)
from lalaloc_core.localise.venue.index_segment import Segment, lookup_tables
from lalaloc_core.localise.venue.prototype_cells import Cells, claims_of
from lalaloc_core.localise.venue.prototype_costs import PrototypeAlignment

# Pairs compared at a time, to bound memory.
_BATCH_SIZE = 65_536

# Returns records that include the prototypes of some plans, each plan's first record and its number of records.
Locate = Callable[[Int[np.ndarray, "p"]], tuple[np.ndarray, Int[np.ndarray, "p"], Int[np.ndarray, "p"]]]


@dataclass(frozen=True, eq=False)
class _Part:
    """Segment of an index.

    Attributes:
        plan: (p,) number in the index of each of the segment's plans; -1 for plans that were removed.
        dead: distinct prototypes of removed plans alone, rising.
    """

    segment: Segment
    plan: Int[np.ndarray, "p"]
    dead: Int[np.ndarray, "d"]

    @property
    def plans(self) -> int:
        """Number of plans that were not removed."""
        return int((self.plan >= 0).sum())

    @property
    def cell_sizes(self) -> Int[np.ndarray, "v"]:
        """Number of distinct prototypes of each cell that plans own."""
        sizes = self.segment.cell_sizes
        if not len(self.dead):
            return sizes
        return sizes - np.bincount(self.segment.cell_of(self.dead), minlength=len(sizes))

    def renumbered(self, place: Int[np.ndarray, "p"]) -> _Part:
        """Return the part with other numbers of the index's plans; -1 for those that are removed."""
        plan = np.where(self.plan >= 0, place[self.plan], -1)
        lost = ((plan < 0) & (self.plan >= 0)).any()
        return _Part(self.segment, plan, self.segment.owned_by_none(plan >= 0) if lost else self.dead)

    def alive(self, prototype: Int[np.ndarray, "m"]) -> Bool[np.ndarray, "m"]:
        """Tell which distinct prototypes a plan owns."""
        if not len(self.dead):
            return np.ones(len(prototype), bool)
        place = np.minimum(np.searchsorted(self.dead, prototype), len(self.dead) - 1)
        return self.dead[place] != prototype


class _Batch:
    """Pairs of one segment, with the records of their prototypes."""

    def __init__(self, part: _Part, pairs: Pairs) -> None:
        self.part, self.pairs, self.rows = part, pairs, part.segment.records(pairs.prototype)


class _Masses:
    """Sums of the masses of p plans over pairs."""

    def __init__(self, plans: int, temperature: float) -> None:
        self._mass, self._temperature, self._lowest = np.zeros(plans), temperature, np.inf

    def add(self, batch: _Batch, cost: Float[np.ndarray, "n"]) -> None:
        """Add pairs with their costs."""
        part, temperature = batch.part, self._temperature
        # Masses are relative to the lowest cost so far, so that relevant ones do not underflow.
        lowest = min(self._lowest, float(cost.min()))
        self._mass *= np.exp(-temperature * (self._lowest - lowest)) if np.isfinite(self._lowest) else 1.0
        self._lowest = lowest
        weight = np.exp(batch.rows["log_area"] - temperature * (cost.astype(np.float64) - lowest))
        count, owner = part.segment.owners(batch.pairs.prototype)
        plan, each = part.plan[owner], np.repeat(weight, count)
        # Removed plans can share prototypes with those that are left.
        left = plan >= 0
        if not left.all():
            plan, each = plan[left], each[left]
        self._mass += np.bincount(plan, each, minlength=len(self._mass))

    def log(self) -> PlanMasses:
        """Return the log masses of plans with pairs."""
        plan = np.flatnonzero(self._mass)
        return PlanMasses(plan, np.log(self._mass[plan]) - self._temperature * self._lowest)


@dataclass(frozen=True, eq=False, kw_only=True)
class PlanIndex:
    """Index of the prototypes of some plans, in one or more segments.

    Attributes:
        step_m: grid step (m) of the plans.
        parts: the segments, the largest first.
    """

    step_m: float
    cells: Cells
    plan_count: int
    parts: tuple[_Part, ...]

    @classmethod
    def build(
        cls, rows: np.ndarray, begin: Int[np.ndarray, "p"], count: Int[np.ndarray, "p"], *, step_m: float, cells: Cells
    ) -> PlanIndex:
        """Return the index of plans whose prototypes are in `rows`.

        `rows` are records of type `prototypes.ROW` with the cells that `cells`, the coarse quantiser, assigned; `begin`
        and `count` are the number of each plan's first record and the number of its records.
        """
        part = _part(rows, begin, count, np.arange(len(count)), cells)
        return cls(step_m=step_m, cells=cells, plan_count=len(count), parts=(part,))

    def updated(self, place: Int[np.ndarray, "p"], added: Int[np.ndarray, "a"], locate: Locate) -> PlanIndex:
        """Return the index of other plans, of which most are in this one.

        Args:
            place: number in the new index of each plan of this one; -1 for plans that are removed.
            added: numbers in the new index of plans that are not in this one.
            locate: returns the prototypes of plans by their numbers in the new index.
        """
        plans, parts, fresh = int((place >= 0).sum()) + len(added), list[_Part](), [added]
        for part in (part.renumbered(place) for part in self.parts):
            # A segment that lost most of its plans is no longer worth its memory.
            if 2 * part.plans >= len(part.plan):
                parts.append(part)
            else:
                fresh.append(part.plan[part.plan >= 0])
        while parts and parts[-1].plans < 2 * sum(map(len, fresh)):
            plan = parts.pop().plan
            fresh.append(plan[plan >= 0])
        numbers = np.sort(np.concatenate(fresh)).astype(np.intp)
        if len(numbers):
            parts.append(_part(*locate(numbers), numbers, self.cells))
        return PlanIndex(step_m=self.step_m, cells=self.cells, plan_count=plans, parts=tuple(parts))

    def __len__(self) -> int:
        """Return the number of distinct prototypes of each segment, added up."""
        return sum(len(part.segment) for part in self.parts)

    @property
    def nbytes(self) -> int:
        """Bytes in memory, including the product codes; memory-mapped rows count as 0."""
        return sum(part.segment.nbytes + part.plan.nbytes + part.dead.nbytes for part in self.parts)

    def prepare(self) -> None:
        """Compute the product codes now; otherwise the first query that needs them does."""
        for part in self.parts:
            part.segment.prepare()

    @property
    def sizes(self) -> ShardSizes:
        """The sizes of the index."""
        return ShardSizes(len(self), np.sum([part.cell_sizes for part in self.parts], axis=0))

    @property
    def whole(self) -> DividedIndex:
        """The index to search, with this one as its only shard."""
        return DividedIndex(shards=[(self, np.arange(self.plan_count))], step_m=self.step_m, cells=self.cells)

    def scan(
        self, search: PlanSearch, probed: Probed | None, per_hypothesis: int, count: int, helper: Executor | None = None
    ) -> Pending[Pairs]:
        """See `Shard.scan`; threads of `helper` take over half of it."""

        def scanned() -> Pairs:
            k, j = search.costs.shape
            families = {family for part in self.parts for family in part.segment.nonempty_cells}
            tables = {family: lookup_tables(search.costs, claims_of(family)).reshape(k * j, -1) for family in families}
            found = []
            for number, part in enumerate(self.parts):
                prototype, hypothesis, cost = part.segment.search(tables, probed, per_hypothesis, helper)
                pairs = Pairs(np.full(len(cost), number), prototype, hypothesis, cost)
                found.append(pairs.chosen(part.alive(prototype)))
            return Pairs.joined(cheapest(found, count))

        return scanned

    def compare(self, search: PlanSearch, pairs: Pairs | None, count: int) -> Pending[tuple[Pairs, PlanMasses]]:
        """See `Shard.compare`."""

        def compared() -> tuple[Pairs, PlanMasses]:
            k, j = search.costs.shape
            masses, kept, total = _Masses(self.plan_count, search.costs.temperature), list[Pairs](), 0
            for batch in self._all_pairs(k * j) if pairs is None else self._batches(pairs):
                cost = search.costs.pairs(batch.rows, *np.divmod(batch.pairs.hypothesis, j))
                masses.add(batch, cost)
                kept.append(replace(batch.pairs, cost=cost))
                total += len(cost)
                if total > count + _BATCH_SIZE:
                    kept = cheapest(kept, count)
                    total = sum(map(len, kept))
            return Pairs.joined(cheapest(kept, count) if kept else kept), masses.log()

        return compared

    def align(self, search: PlanSearch, pairs: Pairs) -> Pending[PlanMasses]:
        """See `Shard.align`."""

        def aligned() -> PlanMasses:
            masses, alignment = _Masses(self.plan_count, search.costs.temperature), PrototypeAlignment(search.costs)
            _, j = search.costs.shape
            for batch in self._batches(pairs):
                cost, _ = alignment.pairs(batch.rows, *np.divmod(batch.pairs.hypothesis, j))
                masses.add(batch, cost)
            return masses.log()

        return aligned

    def _batches(self, pairs: Pairs) -> Iterator[_Batch]:
        """Yield pairs in batches of one segment each."""
        for number, part in enumerate(self.parts):
            own = pairs.chosen(pairs.part == number)
            # Rows are read fastest in the order of memory.
            own = own.chosen(np.argsort(own.prototype, kind="stable"))
            for begin in range(0, len(own), _BATCH_SIZE):
                yield _Batch(part, own.chosen(np.arange(begin, min(begin + _BATCH_SIZE, len(own)))))

    def _all_pairs(self, hypotheses: int) -> Iterator[_Batch]:
        """Yield all pairs with some number of hypotheses in batches."""
        for number, part in enumerate(self.parts):
            prototype = np.arange(len(part.segment))
            prototype = prototype[part.alive(prototype)]
            for begin in range(0, len(prototype) * hypotheses, _BATCH_SIZE):
                place, hypothesis = np.divmod(
                    np.arange(begin, min(begin + _BATCH_SIZE, len(prototype) * hypotheses)), hypotheses
                )
                yield _Batch(
                    part, Pairs(np.full(len(place), number), prototype[place], hypothesis, np.zeros(len(place)))
                )


def _part(rows: np.ndarray, begin: np.ndarray, count: np.ndarray, numbers: Int[np.ndarray, "p"], cells: Cells) -> _Part:
    return _Part(Segment.build(rows, begin, count, cells), numbers, np.empty(0, np.intp))
