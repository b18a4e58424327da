"""From an uploaded panorama to an answer: decode, encode, wait for the grid, search, refine."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from time import monotonic
from typing import TypeVar

from lalaloc_core.bundle import Bundle
from lalaloc_core.draw.answer import PHOTOGRAPH_SIZE, Picture, draw_answer
from lalaloc_core.draw.found import drawn_answer
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.pipeline import Localisation, StageClock, Steps, localise_steps
from lalaloc_core.localise.poses import LatentGrid, Query
from lalaloc_core.localise.sequence.search import SequenceLocalisation, localise_sequence_steps
from lalaloc_core.localise.steps import next_step
from lalaloc_core.panorama.images import Panorama
from service.errors import DeadlineExceededError, PlanFailedError, PlanNotReadyError
from service.fair_share import with_headroom
from service.grids import GridProvider, grid_height_m
from service.http.admission_control import Slots
from service.query.answers import compose, heading_contradiction, model_answer, places_in
from service.query.camera_height import stated_height
from service.query.decoding import Decoder
from service.query.heading import KnownHeading, known_heading
from service.query.hints import hint_warnings, stated_hints
from service.query.posterior import posterior_answer
from service.query.refining import Refining
from service.query.sequence_answers import sequence_answer
from service.schemas import LocaliseAnswer, LocaliseForm, ModelAnswer, SequenceAnswer, SequenceForm
from service.settings import Settings
from service.storage.records import PlanRecord
from service.telemetry import Telemetry
from service.threads import BoundedReads, Threads

# Kept free of LPO before the request's deadline, to rank and send the answer.
_ANSWER_S = 0.25

# Where a heading came from, as pictures say it.
_SOURCES = {"given": "given", "panorama": "by the compass", "searched": "searched for"}

T = TypeVar("T")


@dataclass(frozen=True)
class _Answered:
    """An answer, and what it was made of."""

    answer: LocaliseAnswer
    found: Localisation
    grid: LatentGrid


@dataclass(frozen=True, kw_only=True)
class AskedPicture:
    """What is to be drawn of an answer.

    Attributes:
        pixels: whether it is wanted as PNG; else as SVG.
        rooms: the rooms of the plan as `lalaloc_core.draw.plan.draw_rooms` draws them.
    """

    picture: Picture
    pixels: bool
    rooms: str


class Localiser:
    """Answers queries; CPU work runs on its own few threads, never on the event loop."""

    def __init__(
        self,
        *,
        settings: Settings,
        bundle: Bundle,
        encoders: Encoders,
        grids: GridProvider,
        pool: Refining,
        decoder: Decoder,
        queries: Slots,
        reads: BoundedReads,
        telemetry: Telemetry,
    ) -> None:
        self._settings = settings
        self._bundle = bundle
        self._encoders = encoders
        self._grids = grids
        self._pool = pool
        self._decoder = decoder
        self._queries = queries
        self._reads = reads
        self._telemetry = telemetry
        self._threads = Threads("localise", with_headroom(settings.cores.compute_threads))

    @property
    def model(self) -> ModelAnswer:
        """The model that answers."""
        return model_answer(self._bundle)

    async def answer(
        self, record: PlanRecord, form: LocaliseForm, content: bytes, begin: float, clock: StageClock, client: str
    ) -> LocaliseAnswer:
        """Localise an encoded panorama in a stored plan.

        Args:
            client: whose turn it is at decoders and threads; see `service.fair_share`.
            begin: when (`monotonic`) the query was there as a whole; its deadline counts from then.
            clock: times the stages, the wait for the plan's grid included, also when they fail.

        Raises:
            InvalidPanoramaError, DecoderNotReadyError, StoppingError: see `Decoder.decode`.
            InvalidPoseError: a camera height above the ceiling.
            InvalidHintError: hints that are not of this plan, or leave nothing of it.
            PlanFailedError: the plan's grid could not be computed.
            PlanNotReadyError: the grid was not finished by the deadline.
            DeadlineExceededError: the rest was not.
            StoreUnavailableError: the grid is not in memory, and the database is away or silent.
            OverloadedError: too many queries are in work and wait for that, or grids to be computed on demand.
        """
        async with self._queries.wait_and_hold(client, begin + self._settings.request_deadline_s):
            return (await self._answer(record, form, content, begin, clock, client)).answer

    async def picture(
        self,
        record: PlanRecord,
        form: LocaliseForm,
        content: bytes,
        begin: float,
        clock: StageClock,
        client: str,
        asked: AskedPicture,
    ) -> tuple[LocaliseAnswer, bytes]:
        """As `answer`, with a picture of it: encoded, PNG or SVG.

        Raises:
            DrawingFailedError: the picture could not be made.
            LaLaLocError: see `answer`.
        """
        async with self._queries.wait_and_hold(client, begin + self._settings.request_deadline_s):
            answered = await self._answer(record, form, content, begin, clock, client)
            with clock.stage("draw"):
                picture = await self._draw(record, answered, content, begin, client, asked)
            self._telemetry.stage_seconds.labels("draw").observe(clock.timings_ms["draw"] / 1e3)
            return answered.answer, picture

    async def _draw(
        self, record: PlanRecord, answered: _Answered, content: bytes, begin: float, client: str, asked: AskedPicture
    ) -> bytes:
        deadline = begin + self._settings.request_deadline_s
        photograph = None
        if asked.picture != "plan":
            # Once more, as the encoder takes fewer pixels than one likes to look at.
            width, height = PHOTOGRAPH_SIZE
            photograph = (await self._decoder.decode(content, deadline, client, size=(height, width))).pixels

        def draw() -> str:
            model, source = self._bundle.manifest.confidence, _SOURCES[answered.answer.heading_source]
            drawn = drawn_answer(record.plan, answered.grid, answered.found, model, source)
            return draw_answer(drawn, photograph, asked.picture, rooms=asked.rooms)

        svg = await self.compute(client, draw, deadline)
        return await self._decoder.rasterise(svg, deadline, client) if asked.pixels else svg.encode()

    async def _answer(
        self, record: PlanRecord, form: LocaliseForm, content: bytes, begin: float, clock: StageClock, client: str
    ) -> _Answered:
        deadline = begin + self._settings.request_deadline_s
        height, hints = stated_height(form, record), stated_hints(form, record.plan)
        # The picture first: a bad one is refused without waiting for the plan.
        with clock.stage("decode"):
            panorama = await self._decoder.decode(content, deadline, client)
        known = known_heading(form, record.plan.north, panorama, self._settings.compass_tolerance_deg)
        if not hints.are_none:
            # Looking at many rooms takes a while.
            await self.compute(client, partial(hints.check, record.plan), deadline)
        query = await self.compute(client, lambda: self.encode(panorama, known, height, clock), deadline)
        latents_alone = not self._encoders.predicts_profile
        with clock.stage("grid"):
            grid_m = grid_height_m(record, height.height_m, latents_alone=latents_alone)
            grid = await self._grid(record, grid_m, deadline, client)
        steps = localise_steps(
            record.plan, grid, self._encoders, query, refine=form.refine, top_k=form.top_k, clock=clock, hints=hints
        )
        found = await self.finished(steps, deadline, client)
        timings_ms = clock.timings_ms | {"total": (monotonic() - begin) * 1e3}
        self.observe(timings_ms, found.stage)
        warnings = [heading_contradiction(known)] if found.heading_contradicted else []
        warnings += hint_warnings(hints, found, record.plan)
        answer = compose(found, places_in(record), known, warnings, timings_ms, self._bundle)
        if form.include == "posterior":
            answer = answer.model_copy(update={"posterior": posterior_answer(record.plan, grid, found.posterior)})
        return _Answered(answer, found, grid)

    async def answer_sequence(
        self,
        record: PlanRecord,
        form: SequenceForm,
        contents: list[bytes],
        begin: float,
        clock: StageClock,
        client: str,
    ) -> SequenceAnswer:
        """Localise several panoramas of one visit jointly; arguments and errors as of `answer`."""
        async with self._queries.wait_and_hold(client, begin + self._settings.request_deadline_s):
            return await self._answer_sequence(record, form, contents, begin, clock, client)

    async def _answer_sequence(
        self,
        record: PlanRecord,
        form: SequenceForm,
        contents: list[bytes],
        begin: float,
        clock: StageClock,
        client: str,
    ) -> SequenceAnswer:
        deadline = begin + self._settings.request_deadline_s
        height, plan, compass_deg = stated_height(form, record), record.plan, self._settings.compass_tolerance_deg
        # One after another: no query keeps more than one decoder busy.
        with clock.stage("decode"):
            panoramas = [await self._decoder.decode(content, deadline, client) for content in contents]
        known = [
            known_heading(form.heading_of(index), plan.north, panorama, compass_deg)
            for index, panorama in enumerate(panoramas)
        ]
        queries = await self.compute(client, partial(self._encode_all, panoramas, known, height, clock), deadline)
        latents_alone = not self._encoders.predicts_profile
        with clock.stage("grid"):
            grid_m = grid_height_m(record, height.height_m, latents_alone=latents_alone)
            grid = await self._grid(record, grid_m, deadline, client)
        motions = form.steps(len(contents))
        steps = localise_sequence_steps(
            plan, grid, self._encoders, queries, motions, refine=form.refine, top_k=form.top_k, clock=clock
        )
        step = await self.compute(client, partial(next_step, steps, None), deadline)
        while not isinstance(step, SequenceLocalisation):
            timeout_s = min(self._settings.lpo_deadline_s, deadline - monotonic() - _ANSWER_S)
            result = await self._pool.refine_sequence(step, timeout_s, client)
            step = await self.compute(client, partial(next_step, steps, result), deadline)
        timings_ms = clock.timings_ms | {"total": (monotonic() - begin) * 1e3}
        self.observe(timings_ms, step.stage)
        places, alone = places_in(record), []
        for one, found in zip(known, step.pictures, strict=True):
            warnings = [heading_contradiction(one)] if found.heading_contradicted else []
            alone.append(compose(found, places, one, warnings, timings_ms, self._bundle))
        return sequence_answer(alone, step, motions, self._bundle.manifest.confidence)

    def close(self) -> None:
        """Finish what is being computed."""
        self._threads.close()

    async def compute(self, client: str, work: Callable[[], T], deadline: float) -> T:
        """Run CPU work on a thread; past the deadline it is not started, or its outcome dropped."""

        def run() -> T:
            with self._grids.throttle.query():
                return work()

        try:
            async with asyncio.timeout(max(deadline - monotonic(), 0.0)):
                return await self._threads.run(client, run)
        except TimeoutError as error:
            raise DeadlineExceededError(self._settings.request_deadline_s) from error

    async def _grid(self, record: PlanRecord, height_m: float, deadline: float, client: str) -> LatentGrid:
        """The plan's grid for a camera height, computed on demand, waited for until the deadline."""
        key = self._grids.key(record.revision_id, height_m)
        grid = self._grids.cached(key)
        if grid is None:
            # Not on the threads that compute: a database that hangs would hold them up.
            grid = await self._reads.run(self._grids.find, key)
        if grid is not None:
            return grid
        own_height = height_m == record.plan.camera_height_m
        if own_height and record.failure is not None:
            raise PlanFailedError(record.id, record.failure)
        future = self._grids.compute(record, height_m)
        begin = monotonic()
        try:
            async with asyncio.timeout(max(deadline - begin, 0.0)):
                with self._queries.released(client):
                    return await asyncio.wrap_future(future)
        except TimeoutError as error:
            raise PlanNotReadyError(record.id, monotonic() - begin, self._grids.progress(key)) from error

    def encode(self, panorama: Panorama, known: KnownHeading, height: CameraHeight, clock: StageClock) -> Query:
        """Encode a decoded panorama."""
        with clock.stage("encode"):
            return self._encoders.query(panorama.pixels, known.heading, height, heading_tolerance=known.tolerance)

    def _encode_all(
        self, panoramas: list[Panorama], known: list[KnownHeading], height: CameraHeight, clock: StageClock
    ) -> list[Query]:
        with clock.stage("encode"):
            return [
                self._encoders.query(panorama.pixels, one.heading, height, heading_tolerance=one.tolerance)
                for panorama, one in zip(panoramas, known, strict=True)
            ]

    async def finished(self, steps: Steps, deadline: float, client: str) -> Localisation:
        """Run a search on the threads of the localiser, which do something else while LPO is waited for."""
        step = await self.compute(client, partial(next_step, steps, None), deadline)
        while not isinstance(step, Localisation):
            timeout_s = min(self._settings.lpo_deadline_s, deadline - monotonic() - _ANSWER_S)
            result = await self._pool.refine(step, timeout_s, client)
            step = await self.compute(client, partial(next_step, steps, result), deadline)
        return step

    def observe(self, timings_ms: dict[str, float], stage: str) -> None:
        """Count an answer, with what its stages took."""
        for name, duration_ms in timings_ms.items():
            self._telemetry.stage_seconds.labels(name).observe(duration_ms / 1e3)
        self._telemetry.answers.labels(stage).inc()
