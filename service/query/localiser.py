"""Localisation in stored plans and venues: each query holds a slot while it computes, not while it waits for grids."""

from __future__ import annotations

from service.capacity.admission_control import Slots
from service.capacity.fair_share import FairSemaphore
from service.capacity.threads import Threads
from service.query.album_search import AlbumSearch
from service.query.queries import (
    AlbumEntry,
    AlbumOutcome,
    AlbumPhotographQuery,
    AlbumQuery,
    PhotographQuery,
    PictureRequest,
    SequenceQuery,
    TrackOutcome,
    TrackQuery,
    Where,
)
from service.query.query_parts import QueryParts
from service.query.sequence_query import SequenceSearch
from service.query.session_query import SessionSearch
from service.query.single_query import SingleSearch
from service.schemas import LocaliseAnswer, ModelAnswer, SequenceAnswer
from service.schemas.query_fields import HeightFields
from service.storage.records import PlanRecord, VenueRecord


class Localiser:
    """Localisation of photographs in stored plans and venues."""

    def __init__(self, parts: QueryParts, queries: Slots, album_threads: Threads, permits: FairSemaphore) -> None:
        self._parts = parts
        self._albums = AlbumSearch(parts, queries, album_threads, permits)
        self._queries = queries
        self._single, self._sequences, self._sessions = SingleSearch(parts), SequenceSearch(parts), SessionSearch(parts)

    @property
    def model(self) -> ModelAnswer:
        """Name, version and digest of the model."""
        return ModelAnswer.of(self._parts.bundle)

    async def localise(self, where: Where, query: PhotographQuery) -> LocaliseAnswer:
        """Localise a photograph in a stored plan, or in plans of a venue or near a place."""
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return await self._single.answer(where, query)

    async def localise_and_draw(
        self, record: PlanRecord, query: PhotographQuery, request: PictureRequest
    ) -> tuple[LocaliseAnswer, bytes]:
        """Localise as `localise` does, and return the answer with its picture, a PNG or SVG file."""
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return await self._single.answer_and_draw(record, query, request)

    async def localise_sequence(self, where: PlanRecord | VenueRecord, query: SequenceQuery) -> SequenceAnswer:
        """Localise several photographs of one visit jointly; raises the errors of `localise`."""
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return await self._sequences.answer(where, query)

    async def track(self, where: PlanRecord | VenueRecord, query: TrackQuery) -> TrackOutcome:
        """Follow the camera of a session to its next photograph."""
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return await self._sessions.answer(where, query)

    async def album_entry(self, where: PlanRecord | VenueRecord, query: AlbumPhotographQuery) -> AlbumEntry:
        """Return what an album in a plan or venue keeps of a photograph; raises the errors of decoding."""
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return await self._albums.entry(query)

    async def solve_album(self, where: PlanRecord | VenueRecord, query: AlbumQuery) -> AlbumOutcome:
        """Pin the photographs of an album; it holds a slot until its plans are loaded."""
        return await self._albums.solve(where, query)

    async def check(self, where: PlanRecord | VenueRecord, form: HeightFields) -> None:
        """Check what a request states about a plan or a venue.

        Raises:
            InvalidHintError: the hints do not match the plan or venue.
        """
        await self._parts.grounds.check(where, form)

    def close(self) -> None:
        """Wait for the computations in progress, and stop the threads."""
        self._albums.close()
        self._parts.executor.close()
