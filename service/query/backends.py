"""Interfaces of the components that can run in other processes; the local classes document the methods."""

# ruff: noqa: D102
from __future__ import annotations

from typing import Protocol

from lalaloc_core.localise.refine import RefinementJob, RefinementResult
from lalaloc_core.localise.sequence import SequenceJob, SequenceResult
from service.pools import PoolState
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
from service.schemas import LocaliseAnswer, ModelAnswer, SequenceAnswer
from service.schemas.query_fields import HeightFields
from service.storage.records import PlanRecord, VenueRecord


class LocaliserBackend(Protocol):
    """Localisation in plans and venues: `Localiser`."""

    @property
    def model(self) -> ModelAnswer: ...

    async def localise(self, where: Where, query: PhotographQuery) -> LocaliseAnswer: ...

    async def localise_and_draw(
        self, record: PlanRecord, query: PhotographQuery, request: PictureRequest
    ) -> tuple[LocaliseAnswer, bytes]: ...

    async def localise_sequence(self, where: PlanRecord | VenueRecord, query: SequenceQuery) -> SequenceAnswer: ...

    async def track(self, where: PlanRecord | VenueRecord, query: TrackQuery) -> TrackOutcome: ...

    async def album_entry(self, where: PlanRecord | VenueRecord, query: AlbumPhotographQuery) -> AlbumEntry: ...

    async def solve_album(self, where: PlanRecord | VenueRecord, query: AlbumQuery) -> AlbumOutcome: ...

    async def check(self, where: PlanRecord | VenueRecord, form: HeightFields) -> None: ...


class OptimiserBackend(Protocol):
    """Pose refinement (LPO): `LpoPool`."""

    @property
    def state(self) -> PoolState: ...

    def start(self) -> None: ...

    async def refine(
        self, job: RefinementJob | SequenceJob, timeout_s: float, client: str = ""
    ) -> RefinementResult | SequenceResult | None: ...

    def close(self, drain_s: float = 0.0) -> None: ...
