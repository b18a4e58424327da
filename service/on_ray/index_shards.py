"""Client of the deployments `index-0`, `index-1`, …, which hold the index of each venue in equal parts.

A plan belongs to the shard whose number is the remainder of its key. The client sends the rows of a shard's plans when
its replica does not have their index: at first, after a change, and after the replica was replaced.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import Executor
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, UInt64
from ray.serve.handle import DeploymentHandle

from lalaloc_core.localise.venue.index_search import (
    DividedIndex,
    Pairs,
    Pending,
    PlanMasses,
    PlanSearch,
    Probed,
    ShardSizes,
)
from lalaloc_core.localise.venue.prototype_cells import shipped_cells
from service.bounded_cache import BoundedCache
from service.errors import DeadlineExceededError
from service.on_ray.remote import Failure, Success, result_of
from service.settings import Settings
from service.venues.plan_list import ROW_BYTES, PlanList

_MISSED = "the plans were not searched"

Stage = Literal["scan", "compare", "align"]


class RemoteIndices:
    """`PlanIndices` that are divided between deployments."""

    def __init__(self, shards: Sequence[DeploymentHandle], settings: Settings) -> None:
        self._shards, self._deadline_s = shards, settings.requests.request_deadline_s
        self._step_m = settings.grids.grid_step_m
        self._indices: BoundedCache[bytes, tuple[PlanList, DividedIndex]] = BoundedCache(
            settings.storage.venue_cache_bytes, lambda found: _bytes(*found)
        )

    async def index(
        self,
        tenant: str,
        ready: PlanList,
        compute: Callable[[Callable[[], Any]], Awaitable[Any]],
        *,
        venue_id: str | None = None,
    ) -> tuple[PlanList, DividedIndex]:
        """See `PlanIndices.index`.

        Raises:
            LaLaLocError: raised by a shard.
            DeadlineExceededError: a shard did not answer in time.
        """
        found = self._indices.get(ready.digest)
        if found is None:
            number = ready.keys % np.uint64(len(self._shards))
            parts = [number == shard for shard in range(len(self._shards))]
            shards = [
                RemoteShard(handle, tenant, venue_id, ready.chosen(part), self._deadline_s)
                for handle, part in zip(self._shards, parts, strict=True)
                if part.any()
            ]
            kept = await asyncio.gather(*(shard.hold() for shard in shards))
            is_known = np.zeros(len(ready), bool)
            for part, own in zip((part for part in parts if part.any()), kept, strict=True):
                is_known[np.flatnonzero(part)[own]] = True
            known, place = ready.chosen(is_known), np.cumsum(is_known) - 1
            numbers = [place[part & is_known] for part in parts if part.any()]
            divided = list(zip(shards, numbers, strict=True))
            found = known, DividedIndex(shards=divided, step_m=self._step_m, cells=shipped_cells())
            self._indices.put(ready.digest, found)
        return found


class RemoteShard:
    """Shard of the index of some plans."""

    def __init__(
        self, handle: DeploymentHandle, tenant: str, venue_id: str | None, plans: PlanList, deadline_s: float
    ) -> None:
        self._handle, self._deadline_s = handle, deadline_s
        self._tenant, self._venue_id, self._plans = tenant, venue_id, plans
        self._sizes: ShardSizes | None = None

    @property
    def sizes(self) -> ShardSizes:
        """See `Shard.sizes`; known after `hold`."""
        assert self._sizes is not None
        return self._sizes

    async def hold(self) -> Bool[np.ndarray, "p"]:
        """Make the replica hold the index, and return which of the plans are in it."""
        self._sizes, keys = await asyncio.to_thread(self._hold)
        return np.isin(self._plans.keys, keys)

    def scan(
        self, search: PlanSearch, probed: Probed | None, per_hypothesis: int, count: int, helper: Executor | None
    ) -> Pending[Pairs]:
        """See `Shard.scan`; the replica has threads of its own."""
        return self._begun("scan", search, probed, per_hypothesis, count)

    def compare(self, search: PlanSearch, pairs: Pairs | None, count: int) -> Pending[tuple[Pairs, PlanMasses]]:
        """See `Shard.compare`."""
        return self._begun("compare", search, pairs, count)

    def align(self, search: PlanSearch, pairs: Pairs) -> Pending[PlanMasses]:
        """See `Shard.align`."""
        return self._begun("align", search, pairs)

    def _begun(self, stage: Stage, *arguments: Any) -> Pending[Any]:
        """Begin a stage; the call that waits for its result makes the replica hold the index if it does not."""

        def begin() -> Any:
            return self._handle.search.remote(self._plans.digest, stage, arguments)

        begun = iter([begin()])

        def result() -> Any:
            found = self._waited(lambda: next(begun, None) or begin())
            if found is None:
                self._hold()
                found = self._waited(begin)
            if found is None:
                raise DeadlineExceededError(self._deadline_s, _MISSED)
            return found

        return result

    def _hold(self) -> tuple[ShardSizes, UInt64[np.ndarray, "p"]]:
        """Make the replica hold the index; return its sizes and the keys of its plans."""
        held = self._waited(lambda: self._handle.held.remote(self._plans.digest))
        if held is None:
            held = self._waited(lambda: self._handle.hold.remote(self._tenant, self._venue_id, self._plans))
        return held

    def _waited(self, begin: Callable[[], Any]) -> Any:
        outcome: Success[Any] | Failure = result_of(begin, self._deadline_s, _MISSED)
        if isinstance(outcome, Failure):
            raise outcome.error
        return outcome.value


def _bytes(plans: PlanList, index: DividedIndex) -> int:
    return ROW_BYTES * len(plans) + sum(shard.sizes.cells.nbytes for shard, _ in index.shards)
