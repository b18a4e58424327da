"""What may run in other processes than the service's own, as its callers see it: the search and the optimiser."""

from __future__ import annotations

from typing import Protocol

from lalaloc_core.localise.poses import RefinementJob, RefinementResult
from lalaloc_core.localise.sequence import SequenceJob, SequenceResult
from service.pools import PoolState
from service.query.panorama_query import PanoramaQuery, PictureRequest, SequenceQuery
from service.schemas import EarthPoint, LocaliseAnswer, LocaliseForm, ModelAnswer, SequenceAnswer
from service.storage.records import PlanRecord, VenueRecord


class LocaliserBackend(Protocol):
    """Answers queries about plans; `Localiser` documents and implements it."""

    @property
    def model(self) -> ModelAnswer: ...

    async def answer(self, record: PlanRecord, query: PanoramaQuery) -> LocaliseAnswer: ...

    async def picture(
        self, record: PlanRecord, query: PanoramaQuery, wanted: PictureRequest
    ) -> tuple[LocaliseAnswer, bytes]: ...

    async def answer_sequence(self, record: PlanRecord, query: SequenceQuery) -> SequenceAnswer: ...


class VenueLocaliserBackend(Protocol):
    """Answers queries about venues; `VenueLocaliser` documents and implements it."""

    async def answer(self, venue: VenueRecord, query: PanoramaQuery) -> LocaliseAnswer: ...

    async def answer_near(
        self, tenant: str, place: EarthPoint, within_m: float, query: PanoramaQuery
    ) -> LocaliseAnswer: ...

    async def check_hints(self, venue: VenueRecord, form: LocaliseForm) -> None: ...


class OptimiserBackend(Protocol):
    """Optimises poses; `LpoPool` documents and implements it."""

    @property
    def state(self) -> PoolState: ...

    def start(self) -> None: ...

    async def refine(self, job: RefinementJob, timeout_s: float, client: str = "") -> RefinementResult | None: ...

    async def refine_sequence(self, job: SequenceJob, timeout_s: float, client: str = "") -> SequenceResult | None: ...

    def close(self, drain_s: float = 0.0) -> None: ...
