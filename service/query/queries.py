"""Queries as they are after the upload, and the interfaces of the components that may run in other processes."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from time import monotonic
from typing import Protocol, Self

from lalaloc_core.draw.answer import Picture
from lalaloc_core.localise.refine import RefinementJob, RefinementResult
from lalaloc_core.localise.search.pipeline import StageClock
from lalaloc_core.localise.sequence import SequenceJob, SequenceResult
from lalaloc_core.photograph import Photograph
from service.errors import DeadlineExceededError
from service.pools import PoolState
from service.schemas import (
    EarthPoint,
    LocaliseAnswer,
    LocaliseForm,
    ModelAnswer,
    PhotographForm,
    SequenceAnswer,
    SequenceForm,
    SessionDocument,
    StoredPose,
)
from service.settings import work_factor
from service.storage.records import PlanRecord, VenueRecord
from service.uploaded_file import UploadedFile

# Photograph of a query: a file, or a photograph that was encoded on its device (`localise.encode.features`).
Content = bytes | UploadedFile | Photograph


@dataclass(frozen=True, kw_only=True, eq=False)
class QueryContext:
    """Client, deadline and clock of a query.

    Pickling keeps the elapsed time and restarts the clock, because machines do not share `monotonic`.

    Attributes:
        client: fairness group that shares decoders, threads and workers; see `service.capacity.fair_share`.
        begin: end of the upload (`monotonic`).
        deadline: time limit of the answer (`monotonic`).
        clock: durations of the stages, failed ones and the wait for the plan's grid included.
    """

    client: str
    begin: float
    deadline: float
    clock: StageClock

    @classmethod
    def starting(cls, client: str, limit_s: float, clock: StageClock | None = None, *, spent_s: float = 0.0) -> Self:
        """Return the context of a query that is complete now.

        Args:
            client: see the attribute.
            limit_s: time limit (s) from the end of the upload.
            clock: the clock that timed the upload; None for a new one.
            spent_s: time (s) since the end of the upload.
        """
        begin = monotonic() - spent_s
        return cls(client=client, begin=begin, deadline=begin + limit_s, clock=clock or StageClock())

    @property
    def limit_s(self) -> float:
        """Time limit (s) from the end of the upload."""
        return self.deadline - self.begin

    def for_photographs(self, count: int) -> Self:
        """Return the context with the deadline of a query of several photographs."""
        return replace(self, deadline=self.begin + self.limit_s * work_factor(count))

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
        """End the block at the deadline.

        Raises:
            DeadlineExceededError: the deadline passed.
        """
        try:
            async with asyncio.timeout(max(self.left_s, 0.0)):
                yield
        except TimeoutError as error:
            raise DeadlineExceededError(self.limit_s) from error

    def __reduce__(self) -> tuple[Callable[..., QueryContext], tuple[str, float, float]]:
        return _received, (self.client, self.deadline - self.begin, self.spent_s)


def _received(client: str, limit_s: float, spent_s: float) -> QueryContext:
    return QueryContext.starting(client, limit_s, spent_s=spent_s)


@dataclass(frozen=True, eq=False)
class PhotographQuery:
    """Query about one panorama.

    Attributes:
        form: the validated form fields.
        content: the uploaded picture file, or what was read of its features.
        context: client, deadline and clock.
    """

    form: LocaliseForm
    content: Content
    context: QueryContext


@dataclass(frozen=True, eq=False)
class SequenceQuery:
    """Query about several panoramas of one visit.

    Attributes:
        form: the validated form fields.
        contents: the uploaded picture files, or what was read of their features, in the order in which they were taken.
        context: client, deadline and clock.
    """

    form: SequenceForm
    contents: Sequence[Content]
    context: QueryContext


@dataclass(frozen=True, eq=False)
class TrackQuery:
    """Photograph of a session.

    Attributes:
        session_id: id of the session.
        document: the request that began the session.
        state: state after the photographs before; None for the first.
        form: the validated form fields.
        content: the uploaded picture file, or what was read of its features.
        context: client, deadline and clock.
    """

    session_id: str
    document: SessionDocument
    state: bytes | None
    form: PhotographForm
    content: Content
    context: QueryContext


@dataclass(frozen=True)
class TrackOutcome:
    """State of a session after a photograph, and the stored part of its answer."""

    state: bytes
    stored: StoredPose


@dataclass(frozen=True, kw_only=True)
class PictureRequest:
    """Requested drawing of an answer.

    Attributes:
        picture: plan, photograph or both.
        as_png: PNG; else SVG.
        rooms: the plan's rooms as drawn by `lalaloc_core.draw.plan.draw_rooms`.
    """

    picture: Picture
    as_png: bool
    rooms: str


class LocaliserBackend(Protocol):
    """Localisation in one plan; `Localiser` implements and documents it."""

    @property
    def model(self) -> ModelAnswer:
        """See `Localiser.model`."""
        ...

    async def localise(self, record: PlanRecord, query: PhotographQuery) -> LocaliseAnswer:
        """See `Localiser.localise`."""
        ...

    async def localise_and_draw(
        self, record: PlanRecord, query: PhotographQuery, request: PictureRequest
    ) -> tuple[LocaliseAnswer, bytes]:
        """See `Localiser.localise_and_draw`."""
        ...

    async def localise_sequence(self, record: PlanRecord, query: SequenceQuery) -> SequenceAnswer:
        """See `Localiser.localise_sequence`."""
        ...


class VenueLocaliserBackend(Protocol):
    """Localisation in a venue; `VenueLocaliser` implements and documents it."""

    async def localise(self, venue: VenueRecord, query: PhotographQuery) -> LocaliseAnswer:
        """See `VenueLocaliser.localise`."""
        ...

    async def localise_sequence(self, venue: VenueRecord, query: SequenceQuery) -> SequenceAnswer:
        """See `VenueLocaliser.localise_sequence`."""
        ...

    async def localise_near(
        self, tenant: str, place: EarthPoint, within_m: float, query: PhotographQuery
    ) -> LocaliseAnswer:
        """See `VenueLocaliser.localise_near`."""
        ...

    async def check_hints(self, venue: VenueRecord, form: LocaliseForm) -> None:
        """See `VenueLocaliser.check_hints`."""
        ...


class TrackerBackend(Protocol):
    """Tracking in one plan or venue; `SessionTracker` implements and documents it."""

    async def check(self, place: PlanRecord | VenueRecord, document: SessionDocument) -> None:
        """See `SessionTracker.check`."""
        ...

    async def track(self, place: PlanRecord | VenueRecord, query: TrackQuery) -> TrackOutcome:
        """See `SessionTracker.track`."""
        ...


class OptimiserBackend(Protocol):
    """Pose refinement (LPO); `LpoPool` implements and documents it."""

    @property
    def state(self) -> PoolState:
        """See `LpoPool.state`."""
        ...

    def start(self) -> None:
        """See `LpoPool.start`."""
        ...

    async def refine(
        self, job: RefinementJob | SequenceJob, timeout_s: float, client: str = ""
    ) -> RefinementResult | SequenceResult | None:
        """See `LpoPool.refine`."""
        ...

    def close(self, drain_s: float = 0.0) -> None:
        """See `LpoPool.close`."""
        ...
