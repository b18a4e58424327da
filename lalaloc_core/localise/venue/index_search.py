"""Search of an index of prototypes that is divided into shards, on one machine or on several.

Each shard holds plans of its own. The stages (see `plan_index`) run on all shards at once, and after each the cheapest
pairs of all shards go on, so that a divided index finds what an undivided one does: the limits hold for all shards
together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.localise.match import MatchingConfig
from lalaloc_core.localise.query import Query
from lalaloc_core.localise.venue.index_segment import by_family
from lalaloc_core.localise.venue.prototype_cells import FAMILIES, Cells
from lalaloc_core.localise.venue.prototype_costs import PrototypeCosts

# The scan returns this multiple of each hypothesis's share, as the best pairs are spread unevenly over hypotheses.
_OVERFETCH = 6

T = TypeVar("T")
# Result that another machine may still compute; the call waits for it.
Pending = Callable[[], T]
# For each family, which of its cells are probed under which hypotheses.
Probed = Mapping[int, Bool[np.ndarray, "l q"]]


@dataclass(frozen=True, eq=False)
class PlanSearch:
    """Query, with the settings that all stages of its search share; `step_m` is the grid step (m) of the plans."""

    query: Query
    step_m: float
    weights: MatchingWeights
    config: MatchingConfig

    @cached_property
    def costs(self) -> PrototypeCosts:
        """Costs of prototypes, with their tables."""
        return PrototypeCosts(self.query, self.step_m, self.weights, self.config)

    def __reduce__(self) -> tuple[Any, ...]:
        # The costs are computed again elsewhere, as their tables are large; all headings are another query.
        return PlanSearch, (replace(self.query, searched=None), self.step_m, self.weights, self.config)


@dataclass(frozen=True, eq=False)
class ShardSizes:
    """Sizes of a shard.

    Attributes:
        prototypes: number of distinct prototypes.
        cells: (v,) number of distinct prototypes of each cell that plans own.
    """

    prototypes: int
    cells: Int[np.ndarray, "v"]


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of a distinct prototype of a shard and a hypothesis, by number.

    Attributes:
        part: (n,) segments of the shard.
        prototype: (n,) distinct prototypes of the segments.
        hypothesis: (n,) hypotheses: k j + i for heading k, height i and j heights.
        cost: (n,) costs, by codes or exact ones.
    """

    part: Int[np.ndarray, "n"]
    prototype: Int[np.ndarray, "n"]
    hypothesis: Int[np.ndarray, "n"]
    cost: Float[np.ndarray, "n"]

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.cost)

    def chosen(self, which: np.ndarray) -> Pairs:
        """Return some of the pairs, by number or by a mask."""
        return Pairs(self.part[which], self.prototype[which], self.hypothesis[which], self.cost[which])

    @classmethod
    def joined(cls, pairs: Sequence[Pairs]) -> Pairs:
        """Return all of several pairs."""
        columns = zip(*((one.part, one.prototype, one.hypothesis, one.cost) for one in pairs), strict=True)
        return cls(*map(np.concatenate, columns)) if pairs else cls(*(np.empty(0, int) for _ in range(4)))


@dataclass(frozen=True, eq=False)
class PlanMasses:
    """Log masses of those plans of a shard that have pairs: numbers of the plans, and the masses."""

    plan: Int[np.ndarray, "m"]
    log_mass: Float[np.ndarray, "m"]


@runtime_checkable
class Shard(Protocol):
    """A part of an index with plans of its own."""

    @property
    def sizes(self) -> ShardSizes:
        """The sizes of the shard."""
        ...

    def scan(
        self, search: PlanSearch, probed: Probed | None, per_hypothesis: int, count: int, helper: Executor | None
    ) -> Pending[Pairs]:
        """Return about the `count` pairs that are cheapest by their codes, and their costs by codes.

        `probed` is None to probe all cells. Each hypothesis and family contributes at most `per_hypothesis` pairs.
        """
        ...

    def compare(self, search: PlanSearch, pairs: Pairs | None, count: int) -> Pending[tuple[Pairs, PlanMasses]]:
        """Return about the `count` pairs with the lowest exact costs, and the masses of plans over all pairs.

        `pairs` is None to compare all pairs of the shard.
        """
        ...

    def align(self, search: PlanSearch, pairs: Pairs) -> Pending[PlanMasses]:
        """Return the masses of plans over pairs at the best poses nearby."""
        ...


@dataclass(frozen=True, kw_only=True)
class SearchLimits:
    """Approximate numbers of pairs in the stages; pairs of equal cost are kept together."""

    scanned: int = 40_000_000
    compared: int = 20_000
    aligned: int = 4_000


@dataclass(frozen=True, eq=False, kw_only=True)
class DividedIndex:
    """Index of p plans in one or more shards.

    Attributes:
        shards: the shards, each with the numbers of its plans among all p plans.
        step_m: grid step (m) of the plans.
        cells: the coarse quantiser of all shards.
    """

    shards: Sequence[tuple[Shard, Int[np.ndarray, "_"]]]
    step_m: float
    cells: Cells

    def log_masses(
        self,
        query: Query,
        weights: MatchingWeights,
        config: MatchingConfig,
        limits: SearchLimits | None = None,
        *,
        helper: Executor | None = None,
    ) -> Float[np.ndarray, "p"]:
        """Return the log of each plan's mass (see `prototypes`); -inf if none of its prototypes was compared exactly.

        Threads of `helper` take over half of the scan.
        """
        limits, search = limits or SearchLimits(), PlanSearch(query, self.step_m, weights, config)
        shards, sizes = [shard for shard, _ in self.shards], [shard.sizes for shard, _ in self.shards]
        hypotheses = int(np.prod(search.costs.shape))
        found: Sequence[Pairs | None] = [None] * len(shards)
        if sum(size.prototypes for size in sizes) * hypotheses > limits.compared:
            probed = _probed_cells(search.costs, self.cells, sizes, limits.scanned)
            per_hypothesis = min(limits.compared, -(-_OVERFETCH * limits.compared // hypotheses))
            scans = [shard.scan(search, probed, per_hypothesis, limits.compared, helper) for shard in shards]
            found = cheapest([scanned() for scanned in scans], limits.compared)
        comparisons = [shard.compare(search, pairs, limits.aligned) for shard, pairs in zip(shards, found, strict=True)]
        compared = [comparison() for comparison in comparisons]
        chosen = cheapest([pairs for pairs, _ in compared], limits.aligned)
        alignments = [shard.align(search, pairs) for shard, pairs in zip(shards, chosen, strict=True)]
        compared_mass = self._of_all([masses for _, masses in compared])
        aligned_mass = self._of_all([alignment() for alignment in alignments])
        is_aligned = np.isfinite(aligned_mass)
        if not is_aligned.any():
            return compared_mass
        change = np.median(aligned_mass[is_aligned] - compared_mass[is_aligned])
        return np.where(is_aligned, aligned_mass, compared_mass + change)

    def _of_all(self, masses: Sequence[PlanMasses]) -> Float[np.ndarray, "p"]:
        """Return the log masses of all plans, -inf for those without pairs."""
        log_mass = np.full(sum(len(numbers) for _, numbers in self.shards), -np.inf)
        for (_, numbers), own in zip(self.shards, masses, strict=True):
            log_mass[numbers[own.plan]] = own.log_mass
        return log_mass


def cheapest(groups: Sequence[Pairs], count: int) -> list[Pairs]:
    """Return those of each group that are among about the `count` cheapest of all; equal costs are kept together."""
    cost = np.concatenate([pairs.cost for pairs in groups])
    if len(cost) <= count:
        return list(groups)
    highest = np.partition(cost, count - 1)[count - 1] if count else -np.inf
    return [pairs.chosen(pairs.cost <= highest) for pairs in groups]


def _probed_cells(costs: PrototypeCosts, cells: Cells, sizes: Sequence[ShardSizes], scanned: int) -> Probed | None:
    """Return for each family which of its cells are probed under which hypotheses; None for all."""
    (k, j), per_family = costs.shape, len(cells) // FAMILIES
    if sum(size.prototypes for size in sizes) * k * j <= scanned:
        return None
    counts = np.sum([size.cells for size in sizes], axis=0)
    nonempty = by_family(np.flatnonzero(counts), per_family)
    costs_of = cells.costs(costs, nonempty)
    cost = np.concatenate([costs_of[family][cell % per_family].ravel() for family, cell in nonempty.items()])
    size = np.concatenate([np.repeat(counts[cell], k * j) for cell in nonempty.values()])
    # Costs are rounded to 16 bits, which numpy sorts twenty times as fast.
    lowest = float(cost.min())
    rounded = ((cost - lowest) * (65535.0 / max(float(cost.max()) - lowest, 1e-9))).astype(np.uint16)
    order = np.argsort(rounded, kind="stable")
    fits = np.cumsum(size[order]) <= scanned
    chosen = np.zeros(len(cost), bool)
    chosen[order[: int(fits.sum()) + 1]] = True
    ends = np.cumsum([len(cell) * k * j for cell in nonempty.values()])
    probed = {family: np.zeros((per_family, k * j), bool) for family in nonempty}
    for (family, cell), part in zip(nonempty.items(), np.split(chosen, ends[:-1]), strict=True):
        probed[family][cell % per_family] = part.reshape(-1, k * j)
    return probed
