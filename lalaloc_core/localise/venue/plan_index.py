"""Index of the prototypes of many plans; gives every plan a probability for a panorama.

It works like an inverted file with product codes and re-ranking (IVF-PQ in faiss). A query compares *pairs* of a
prototype and a hypothesis of the heading and the camera height. Four stages, each on fewer pairs than the one before:

1. **Inverted file.** A coarse quantiser assigns each prototype to a cell (`prototype_cells`). The query computes the
   cost of every cell under every hypothesis and probes the cheapest ones.
2. **Code scan.** The pairs of the probed cells are compared by product codes of 25 bytes, with a lookup table for each
   hypothesis (`prototype_codes`).
3. **Exact comparison.** The cheapest pairs of the scan get their exact cost (`prototype_costs`) and are summed to the
   masses of their plans. All other pairs count as zero.
4. **Alignment.** The cheapest of these get the cost at the best pose nearby (`prototype_alignment`), whose sums replace
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

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.localise.bundle import MatchingWeights
from lalaloc_core.localise.matching_cost import MatchingConfig
from lalaloc_core.localise.poses import Query
from lalaloc_core.localise.venue.prototype_alignment import PrototypeAlignment
from lalaloc_core.localise.venue.prototype_cells import FAMILIES, Cells, claims_of
from lalaloc_core.localise.venue.prototype_codes import lookup_tables
from lalaloc_core.localise.venue.prototype_costs import PrototypeCosts
from lalaloc_core.localise.venue.prototypes import Prototypes, joined
from lalaloc_core.localise.venue.segment import Segment, by_family

# Default numbers of pairs per query in the code scan, in the exact comparison, and in the alignment.
SCANNED, COMPARED, ALIGNED = 40_000_000, 20_000, 4_000
# The scan returns this multiple of each hypothesis's share, as the best pairs are spread unevenly over hypotheses.
_OVERFETCH = 6
# Pairs compared at a time, to bound memory.
_BATCH_SIZE = 65_536

# Returns records that include the prototypes of some plans, each plan's first record and its number of records.
Locate = Callable[[Int[np.ndarray, "p"]], tuple[np.ndarray, Int[np.ndarray, "p"], Int[np.ndarray, "p"]]]


@dataclass(frozen=True, eq=False)
class _Part:
    """Segment of an index.

    Attributes:
        segment: the segment.
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


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of a distinct prototype of a segment, a heading hypothesis and a height hypothesis, by number."""

    part: _Part
    prototype: Int[np.ndarray, "n"]
    hypothesis: Int[np.ndarray, "n"]
    offset: Int[np.ndarray, "n"]

    def __len__(self) -> int:
        return len(self.prototype)

    def chosen(self, place: Int[np.ndarray, "m"]) -> _Pairs:
        """Return some of the pairs."""
        return _Pairs(self.part, self.prototype[place], self.hypothesis[place], self.offset[place])

    @cached_property
    def rows(self) -> np.ndarray:
        """Records of the prototypes."""
        return self.part.segment.records(self.prototype)


class _Masses:
    """Sums of the masses of p plans over pairs."""

    def __init__(self, plans: int, temperature: float) -> None:
        self._mass, self._temperature, self._lowest = np.zeros(plans), temperature, np.inf

    def add(self, pairs: _Pairs, cost: Float[np.ndarray, "n"]) -> None:
        """Add pairs with their costs."""
        part, temperature = pairs.part, self._temperature
        # Masses are relative to the lowest cost so far, so that relevant ones do not underflow.
        lowest = min(self._lowest, float(cost.min()))
        self._mass *= np.exp(-temperature * (self._lowest - lowest)) if np.isfinite(self._lowest) else 1.0
        self._lowest = lowest
        weight = np.exp(pairs.rows["log_area"] - temperature * (cost.astype(np.float64) - lowest))
        count, owner = part.segment.owners(pairs.prototype)
        plan, each = part.plan[owner], np.repeat(weight, count)
        # Removed plans can share prototypes with those that are left.
        left = plan >= 0
        if not left.all():
            plan, each = plan[left], each[left]
        self._mass += np.bincount(plan, each, minlength=len(self._mass))

    def log(self) -> Float[np.ndarray, "p"]:
        """Return the log masses; -inf for plans without pairs."""
        with np.errstate(divide="ignore"):
            return np.log(self._mass) - self._temperature * self._lowest


@dataclass(frozen=True, eq=False, kw_only=True)
class PlanIndex:
    """Index of the prototypes of some plans, in one or more segments.

    Attributes:
        step_m: grid step (m) of the plans.
        cells: the coarse quantiser.
        plan_count: number of plans, p.
        parts: the segments, the largest first.
    """

    step_m: float
    cells: Cells
    plan_count: int
    parts: tuple[_Part, ...]

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
        part = _part(rows, begin, count, np.arange(len(count)), cells)
        return cls(step_m=step_m, cells=cells, plan_count=len(count), parts=(part,))

    @classmethod
    def from_prototypes(cls, parts: Sequence[Prototypes], cells: Cells) -> PlanIndex:
        """Assign the prototypes of each plan to cells and return their index."""
        rows = joined(parts).rows.copy()
        rows["cell"] = cells.assign(rows)
        count = np.array([len(part) for part in parts])
        return cls.build(rows, np.cumsum(count) - count, count, step_m=parts[0].step_m, cells=cells)

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

    def log_masses(
        self,
        query: Query,
        weights: MatchingWeights,
        config: MatchingConfig,
        *,
        compared: int = COMPARED,
        scanned: int = SCANNED,
        aligned: int = ALIGNED,
        helper: Executor | None = None,
    ) -> Float[np.ndarray, "p"]:
        """Return the log of each plan's mass (see `prototypes`); -inf if none of its prototypes was compared exactly.

        About `compared` pairs are compared exactly and about `aligned` pairs are aligned, as pairs of equal cost are
        kept together. About `scanned` pairs are in the code scan, as the last probed cell is scanned whole; threads of
        `helper` take over half of the scan.
        """
        costs = PrototypeCosts(query, self.step_m, weights, config)
        k, j = costs.shape
        compares_all = len(self) * k * j <= compared
        pairs = self._all_pairs(k, j) if compares_all else self._best_pairs(costs, compared, scanned, helper)
        compared_masses, aligned_masses = (_Masses(self.plan_count, weights.temperature) for _ in range(2))
        alignment = PrototypeAlignment(costs)
        for batch in _cheapest_pairs(costs, pairs, aligned, compared_masses):
            aligned_masses.add(batch, alignment.pairs(batch.rows, batch.hypothesis, batch.offset).cost)
        compared_mass, aligned_mass = compared_masses.log(), aligned_masses.log()
        is_aligned = np.isfinite(aligned_mass)
        if not is_aligned.any():
            return compared_mass
        change = np.median(aligned_mass[is_aligned] - compared_mass[is_aligned])
        return np.where(is_aligned, aligned_mass, compared_mass + change)

    def _all_pairs(self, k: int, j: int) -> Iterator[_Pairs]:
        """Yield all pairs in batches."""
        for part in self.parts:
            number = np.arange(len(part.segment))
            number = number[part.alive(number)]
            for begin in range(0, len(number) * k * j, _BATCH_SIZE):
                pair = np.arange(begin, min(begin + _BATCH_SIZE, len(number) * k * j))
                place, hypothesis, offset = np.unravel_index(pair, (len(number), k, j))
                yield _Pairs(part, number[place], hypothesis, offset)

    def _best_pairs(
        self, costs: PrototypeCosts, compared: int, scanned: int, helper: Executor | None
    ) -> Iterator[_Pairs]:
        """Yield about the `compared` pairs that are cheapest by their codes, in batches."""
        k, j = costs.shape
        probed = self._probed_cells(costs, scanned)
        families = {family for part in self.parts for family in part.segment.nonempty_cells}
        tables = {family: lookup_tables(costs, claims_of(family)).reshape(k * j, -1) for family in families}
        per_hypothesis = min(compared, -(-_OVERFETCH * compared // (k * j)))
        found = []
        for part in self.parts:
            prototype, joint, cost = part.segment.search(tables, probed, per_hypothesis, helper)
            alive = part.alive(prototype)
            found.append((prototype[alive], joint[alive], cost[alive]))
        cost = np.concatenate([cost for *_, cost in found])
        highest = np.partition(cost, compared - 1)[compared - 1] if len(cost) > compared else np.inf
        for part, (prototype, joint, cost) in zip(self.parts, found, strict=True):
            prototype, joint = prototype[cost <= highest], joint[cost <= highest]
            # Rows are read fastest in the order of memory.
            order = np.argsort(prototype, kind="stable")
            found_pairs = _Pairs(part, prototype[order], *np.divmod(joint[order], j))
            for begin in range(0, len(found_pairs), _BATCH_SIZE):
                yield found_pairs.chosen(np.arange(begin, min(begin + _BATCH_SIZE, len(found_pairs))))

    def _probed_cells(self, costs: PrototypeCosts, scanned: int) -> dict[int, Bool[np.ndarray, "l q"]] | None:
        """Return for each family which of its cells are probed under which hypotheses; None for all."""
        (k, j), per_family = costs.shape, len(self.cells) // FAMILIES
        if len(self) * k * j <= scanned:
            return None
        sizes = np.sum([part.cell_sizes for part in self.parts], axis=0)
        nonempty = by_family(np.flatnonzero(sizes), per_family)
        costs_of = self.cells.costs(costs, nonempty)
        cost = np.concatenate([costs_of[family][cell % per_family].ravel() for family, cell in nonempty.items()])
        size = np.concatenate([np.repeat(sizes[cell], k * j) for cell in nonempty.values()])
        # Costs are rounded to 16 bits, which numpy sorts twenty times as fast.
        lowest = float(cost.min())
        rounded = ((cost - lowest) * (65535.0 / max(float(cost.max()) - lowest, 1e-9))).astype(np.uint16)
        order = np.argsort(rounded, kind="stable")
        fits = np.cumsum(size[order]) <= scanned
        chosen = np.zeros(len(cost), bool)
        chosen[order[: int(fits.sum()) + 1]] = True
        ends = np.cumsum([len(cell) * k * j for cell in nonempty.values()])
        # Cells without a living prototype are in no list of `nonempty`, and are not probed.
        families = {family for part in self.parts for family in part.segment.nonempty_cells}
        probed = {family: np.zeros((per_family, k * j), bool) for family in families}
        for (family, cell), part in zip(nonempty.items(), np.split(chosen, ends[:-1]), strict=True):
            probed[family][cell % per_family] = part.reshape(-1, k * j)
        return probed


def _cheapest_pairs(costs: PrototypeCosts, pairs: Iterable[_Pairs], count: int, masses: _Masses) -> list[_Pairs]:
    """Add all pairs to the masses, and return about the `count` cheapest ones, by their exact costs.

    Pairs of equal cost are kept together.
    """
    kept, total, highest = list[tuple[_Pairs, np.ndarray]](), 0, np.inf
    for batch in pairs:
        if not len(batch):
            continue
        cost = costs.pairs(batch.rows, batch.hypothesis, batch.offset)
        masses.add(batch, cost)
        kept.append((batch, cost))
        total += len(batch)
        if total > count + _BATCH_SIZE:
            highest = _highest(kept, count, highest)
            kept = [(batch.chosen(low), cost[low]) for batch, cost in kept for low in [np.flatnonzero(cost <= highest)]]
            total = sum(len(batch) for batch, _ in kept)
    highest = _highest(kept, count, highest) if kept else highest
    chosen = [batch.chosen(np.flatnonzero(cost <= highest)) for batch, cost in kept]
    return [batch for batch in chosen if len(batch)]


def _highest(pairs: Sequence[tuple[_Pairs, np.ndarray]], count: int, highest: float) -> float:
    """Return the highest cost of the `count` cheapest pairs."""
    if not count:
        return -np.inf
    cost = np.concatenate([cost for _, cost in pairs])
    return highest if len(cost) <= count else min(highest, float(np.partition(cost, count - 1)[count - 1]))


def _part(rows: np.ndarray, begin: np.ndarray, count: np.ndarray, numbers: Int[np.ndarray, "p"], cells: Cells) -> _Part:
    return _Part(Segment.build(rows, begin, count, cells), numbers, np.empty(0, np.intp))
