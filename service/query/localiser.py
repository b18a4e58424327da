"""Localisation in stored plans and venues, in this process or another."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, Protocol, TypeVar

from lalaloc_core.localise.answers.documents import ModelAnswer
from service.capacity.admission_control import Slots
from service.capacity.fair_share import FairSemaphore
from service.capacity.threads import Threads
from service.query.album_search import AlbumSearch
from service.query.queries import (
    AlbumPhotographQuery,
    AlbumQuery,
    AnyQuery,
    PhotographQuery,
    PictureQuery,
    SequenceQuery,
    TrackQuery,
    Where,
)
from service.query.sequence_query import SequenceSearch
from service.query.session_query import SessionSearch
from service.query.single_query import QueryParts, SingleSearch
from service.schemas.query_fields import HeightFields

AnswerT = TypeVar("AnswerT")


class Localiser(Protocol):
    """Localisation of photographs in stored plans and venues."""

    model: ModelAnswer

    async def answer(self, where: Where, query: AnyQuery[AnswerT]) -> AnswerT:
        """Answer a query about a plan or venue."""
        ...

    async def check(self, where: Where, form: HeightFields) -> None:
        """Check what a request states about a plan or a venue."""
        ...


class LocalLocaliser:
    """Localisation in this process: each query holds a slot while it computes, not while it waits for grids."""

    def __init__(
        self, parts: QueryParts, queries: Slots, album_threads: Threads, turns: FairSemaphore, cores: FairSemaphore
    ) -> None:
        self.model = ModelAnswer.of(parts.bundle)
        self._parts, self._queries = parts, queries
        single, albums = SingleSearch(parts), AlbumSearch(parts, queries, album_threads, turns, cores)
        self._albums = albums
        self._searches: dict[type[AnyQuery[Any]], Callable[[Where, Any], Awaitable[Any]]] = {
            PhotographQuery: single.answer,
            PictureQuery: single.answer_and_draw,
            SequenceQuery: SequenceSearch(parts).answer,
            TrackQuery: SessionSearch(parts).answer,
            AlbumPhotographQuery: albums.entry,
            AlbumQuery: albums.solve,
        }

    async def answer(self, where: Where, query: AnyQuery[AnswerT]) -> AnswerT:
        """See `Localiser.answer`."""
        search = self._searches[type(query)]
        if isinstance(query, AlbumQuery):
            # It holds a slot only until its plans are loaded.
            return await search(where, query)
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return await search(where, query)

    async def check(self, where: Where, form: HeightFields) -> None:
        """See `Localiser.check`."""
        await self._parts.grounds.check(where, form)

    def close(self) -> None:
        """Wait for the computations in progress, and stop the threads."""
        self._albums.close()
        self._parts.executor.close()
