"""A query once it was uploaded: what it asks, and the circumstances in which it is answered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic
from typing import Self

from lalaloc_core.draw.answer import Picture
from lalaloc_core.localise.pipeline import StageClock
from service.schemas import LocaliseForm, SequenceForm


@dataclass(frozen=True, kw_only=True, eq=False)
class QueryContext:
    """What holds for every stage of answering a query.

    Pickled, it tells how long the query has been there, as clocks of machines differ, and begins to time it anew.

    Attributes:
        client: who asks: with whom decoders, threads and workers are shared; see `service.fair_share`.
        begin: when (`monotonic`) the query was there as a whole.
        deadline: until when (`monotonic`) it has to be answered.
        clock: times the stages, the wait for a plan's grid included, also when they fail.
    """

    client: str
    begin: float
    deadline: float
    clock: StageClock

    @classmethod
    def starting(cls, client: str, limit_s: float, clock: StageClock | None = None, *, spent_s: float = 0.0) -> Self:
        """The context of a query that is there now.

        Args:
            limit_s: how long answering it may take.
            spent_s: how long it has been there already.
        """
        begin = monotonic() - spent_s
        return cls(client=client, begin=begin, deadline=begin + limit_s, clock=clock or StageClock())

    @property
    def spent_s(self) -> float:
        """How long the query has been there."""
        return monotonic() - self.begin

    @property
    def left_s(self) -> float:
        """How much time is left; negative past the deadline."""
        return self.deadline - monotonic()

    def __reduce__(self) -> tuple[Callable[..., QueryContext], tuple[str, float, float]]:
        return _received, (self.client, self.deadline - self.begin, self.spent_s)


def _received(client: str, limit_s: float, spent_s: float) -> QueryContext:
    return QueryContext.starting(client, limit_s, spent_s=spent_s)


@dataclass(frozen=True, eq=False)
class PanoramaQuery:
    """Where was this panorama taken?

    Attributes:
        content: the picture, encoded.
    """

    form: LocaliseForm
    content: bytes
    context: QueryContext


@dataclass(frozen=True, kw_only=True)
class PictureRequest:
    """What is to be drawn of an answer.

    Attributes:
        pixels: whether it is wanted as PNG; else as SVG.
        rooms: the rooms of the plan as `lalaloc_core.draw.plan.draw_rooms` draws them.
    """

    picture: Picture
    pixels: bool
    rooms: str


@dataclass(frozen=True, eq=False)
class SequenceQuery:
    """Where were these panoramas taken, on one visit?

    Attributes:
        contents: the pictures, encoded, in the order in which they were taken.
    """

    form: SequenceForm
    contents: list[bytes]
    context: QueryContext
