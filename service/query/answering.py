"""Who answers queries, as routes see it: this process, or processes elsewhere."""

from __future__ import annotations

from typing import Protocol

from lalaloc_core.localise.pipeline import StageClock
from service.query.localiser import AskedPicture
from service.schemas import EarthPoint, LocaliseAnswer, LocaliseForm, ModelAnswer, SequenceAnswer, SequenceForm
from service.storage.records import PlanRecord, VenueRecord


class Answering(Protocol):
    """Answers queries about plans; `Localiser` documents and implements it."""

    @property
    def model(self) -> ModelAnswer: ...

    async def answer(
        self, record: PlanRecord, form: LocaliseForm, content: bytes, begin: float, clock: StageClock, client: str
    ) -> LocaliseAnswer: ...

    async def picture(
        self,
        record: PlanRecord,
        form: LocaliseForm,
        content: bytes,
        begin: float,
        clock: StageClock,
        client: str,
        asked: AskedPicture,
    ) -> tuple[LocaliseAnswer, bytes]: ...

    async def answer_sequence(
        self,
        record: PlanRecord,
        form: SequenceForm,
        contents: list[bytes],
        begin: float,
        clock: StageClock,
        client: str,
    ) -> SequenceAnswer: ...


class VenueAnswering(Protocol):
    """Answers queries about venues; `VenueLocaliser` documents and implements it."""

    async def answer(
        self, venue: VenueRecord, form: LocaliseForm, content: bytes, begin: float, clock: StageClock, client: str
    ) -> LocaliseAnswer: ...

    async def answer_near(
        self,
        tenant: str,
        place: EarthPoint,
        within_m: float,
        form: LocaliseForm,
        content: bytes,
        begin: float,
        clock: StageClock,
        client: str,
    ) -> LocaliseAnswer: ...

    async def check_hints(self, venue: VenueRecord, form: LocaliseForm) -> None: ...
