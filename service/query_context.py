"""Context of a query: its client, deadline and clock."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from functools import partial
from time import monotonic
from typing import Self

from lalaloc_core.localise.search.pipeline import StageClock
from service.errors import DeadlineExceededError
from service.settings import work_factor


@dataclass(frozen=True, kw_only=True, eq=False)
class QueryContext:
    """Client, deadline and clock of a query.

    Pickling keeps the elapsed time and restarts the clock, because machines do not share `monotonic`.

    Attributes:
        client: fairness group that shares decoders, threads and workers; see `service.capacity.fair_share`.
        begin, deadline: end of the upload, and time limit of the answer (`monotonic`).
        clock: durations of the stages, failed ones and the wait for the plan's grid included.
    """

    client: str
    begin: float
    deadline: float
    clock: StageClock

    @classmethod
    def starting(cls, client: str, limit_s: float, clock: StageClock | None = None, *, spent_s: float = 0.0) -> Self:
        """Return the context of a query that was complete `spent_s` (s) ago; `clock` may have timed its upload."""
        begin = monotonic() - spent_s
        return cls(client=client, begin=begin, deadline=begin + limit_s, clock=clock or StageClock())

    @property
    def limit_s(self) -> float:
        """Time limit (s) from the end of the upload."""
        return self.deadline - self.begin

    def for_photographs(self, count: int) -> Self:
        """Return the context with the deadline of a query of several photographs."""
        return replace(self, deadline=self.begin + self.limit_s * work_factor(count))

    def with_time(self, seconds: float) -> Self:
        """Return the context with a later deadline."""
        return replace(self, deadline=self.deadline + seconds)

    @property
    def spent_s(self) -> float:
        """Time (s) since the end of the upload."""
        return monotonic() - self.begin

    @property
    def left_s(self) -> float:
        """Time (s) until the deadline; negative past it."""
        return self.deadline - monotonic()

    @asynccontextmanager
    async def bounded(self) -> AsyncIterator[None]:
        """End the block at the deadline."""
        try:
            async with asyncio.timeout(max(self.left_s, 0.0)):
                yield
        except TimeoutError as error:
            raise DeadlineExceededError(self.limit_s) from error

    def __reduce__(self) -> tuple[Callable[..., QueryContext], tuple[str, float]]:
        return partial(QueryContext.starting, spent_s=self.spent_s), (self.client, self.limit_s)
