"""Who optimises poses, as whoever searches sees it: worker processes of this one, or processes elsewhere."""

from __future__ import annotations

from typing import Protocol

from lalaloc_core.localise.poses import RefinementJob, RefinementResult
from lalaloc_core.localise.sequence import SequenceJob, SequenceResult
from service.pools import PoolState


class Refining(Protocol):
    """Optimises poses; `LpoPool` documents and implements it."""

    @property
    def state(self) -> PoolState: ...

    def start(self) -> None: ...

    async def refine(self, job: RefinementJob, timeout_s: float, client: str = "") -> RefinementResult | None: ...

    async def refine_sequence(self, job: SequenceJob, timeout_s: float, client: str = "") -> SequenceResult | None: ...

    def close(self, drain_s: float = 0.0) -> None: ...
