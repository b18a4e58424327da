"""From an uploaded panorama to an answer: decode, encode, wait for the grid, search, refine."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from time import monotonic
from typing import TypeVar

from lalaloc_core.draw.answer import PHOTOGRAPH_SIZE, draw_answer
from lalaloc_core.draw.found import drawn_answer
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.pipeline import Localisation, StageClock, Steps, localise_steps
from lalaloc_core.localise.poses import PoseGrid, Query
from lalaloc_core.localise.sequence.search import SequenceLocalisation, localise_sequence_steps
from lalaloc_core.localise.steps import next_step
from lalaloc_core.panorama.images import Panorama
from service.errors import DeadlineExceededError, PlanFailedError, PlanNotReadyError
from service.fair_share import with_headroom
from service.grids import GridProvider, grid_height_m
from service.http.admission_control import Slots
from service.query.answers import compose, heading_warnings, locate_in, model_answer
from service.query.backends import OptimiserBackend
from service.query.camera_height import stated_height
from service.query.decoding import Decoder
from service.query.heading import KnownHeading, known_heading
from service.query.hints import hint_warnings, stated_hints
from service.query.panorama_query import PanoramaQuery, PictureRequest, QueryContext, SequenceQuery
from service.query.posterior import posterior_answer
from service.query.sequence_answers import sequence_answer
from service.schemas import LocaliseAnswer, ModelAnswer, SequenceAnswer
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
    grid: PoseGrid


class Localiser:
    """Answers queries; CPU work runs on its own few threads, never on the event loop."""

    def __init__(
        self,
        *,
        settings: Settings,
        bundle: Bundle,
        encoders: Encoders,
        grids: GridProvider,
        optimiser: OptimiserBackend,
        decoder: Decoder,
        queries: Slots,
        reads: BoundedReads,
        telemetry: Telemetry,
    ) -> None:
        self._settings = settings
        self._bundle = bundle
        self._encoders = encoders
        self._grids = grids
        self._optimiser = optimiser
        self._decoder = decoder
        self._queries = queries
        self._reads = reads
        self._telemetry = telemetry
        self._threads = Threads("localise", with_headroom(settings.cores.compute_threads))

    @property
    def model(self) -> ModelAnswer:
        """The model that answers."""
        return model_answer(self._bundle)

    async def answer(self, record: PlanRecord, query: PanoramaQuery) -> LocaliseAnswer:
        """Localise an encoded panorama in a stored plan.

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
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return (await self._answer(record, query)).answer

    async def picture(
        self, record: PlanRecord, query: PanoramaQuery, wanted: PictureRequest
    ) -> tuple[LocaliseAnswer, bytes]:
        """As `answer`, with a picture of it: encoded, PNG or SVG.

        Raises:
            DrawingFailedError: the picture could not be made.
            LaLaLocError: see `answer`.
        """
        clock = query.context.clock
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            answered = await self._answer(record, query)
            with clock.stage("draw"):
                picture = await self._draw(record, answered, query, wanted)
            self._telemetry.stage_seconds.labels("draw").observe(clock.timings_ms["draw"] / 1e3)
            return answered.answer, picture

    async def answer_sequence(self, record: PlanRecord, query: SequenceQuery) -> SequenceAnswer:
        """Localise several panoramas of one visit jointly; errors as of `answer`."""
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return await self._answer_sequence(record, query)

    async def _draw(
        self, record: PlanRecord, answered: _Answered, query: PanoramaQuery, wanted: PictureRequest
    ) -> bytes:
        context, photograph = query.context, None
        if wanted.picture != "plan":
            # Once more, as the encoder takes fewer pixels than one likes to look at.
            width, height = PHOTOGRAPH_SIZE
            size = height, width
            photograph = (await self._decoder.decode(query.content, context.deadline, context.client, size=size)).pixels

        def draw() -> str:
            model, source = self._bundle.manifest.confidence, _SOURCES[answered.answer.heading_source]
            drawn = drawn_answer(record.plan, answered.grid, answered.found, model, source)
            return draw_answer(drawn, photograph, wanted.picture, rooms=wanted.rooms)

        svg = await self.compute(context, draw)
        if wanted.pixels:
            return await self._decoder.rasterise(svg, context.deadline, context.client)
        return svg.encode()

    async def _answer(self, record: PlanRecord, query: PanoramaQuery) -> _Answered:
        form, context, clock = query.form, query.context, query.context.clock
        height, hints = stated_height(form, record), stated_hints(form, record.plan)
        # The picture first: a bad one is refused without waiting for the plan.
        with clock.stage("decode"):
            panorama = await self._decoder.decode(query.content, context.deadline, context.client)
        known = known_heading(form, record.plan.north, panorama, self._settings.panoramas.compass_tolerance_deg)
        if not hints.are_none:
            # Looking at many rooms takes a while.
            await self.compute(context, partial(hints.check, record.plan))
        encoded = await self.compute(context, lambda: self.encode([panorama], [known], height, clock))
        grid = await self._grid(record, height, context)
        steps = localise_steps(
            record.plan,
            grid,
            self._encoders,
            encoded[0],
            refine=form.refine,
            top_k=form.top_k,
            clock=clock,
            hints=hints,
        )
        found = await self.finished(steps, context)
        timings_ms = self.observe(context, found.stage)
        warnings = heading_warnings(found, known) + hint_warnings(hints, found, record.plan)
        answer = compose(
            found,
            locate=locate_in(record),
            known=known,
            warnings=warnings,
            timings_ms=timings_ms,
            bundle=self._bundle,
        )
        if form.include == "posterior":
            answer = answer.model_copy(update={"posterior": posterior_answer(record.plan, grid, found.posterior)})
        return _Answered(answer, found, grid)

    async def _answer_sequence(self, record: PlanRecord, query: SequenceQuery) -> SequenceAnswer:
        form, context, clock = query.form, query.context, query.context.clock
        height, plan, compass_deg = (
            stated_height(form, record),
            record.plan,
            self._settings.panoramas.compass_tolerance_deg,
        )
        # One after another: no query keeps more than one decoder busy.
        with clock.stage("decode"):
            panoramas = [
                await self._decoder.decode(content, context.deadline, context.client) for content in query.contents
            ]
        known = [
            known_heading(form.heading_of(index), plan.north, panorama, compass_deg)
            for index, panorama in enumerate(panoramas)
        ]
        encoded = await self.compute(context, partial(self.encode, panoramas, known, height, clock))
        grid = await self._grid(record, height, context)
        motions = form.steps(len(panoramas))
        steps = localise_sequence_steps(
            plan, grid, self._encoders, encoded, motions, refine=form.refine, top_k=form.top_k, clock=clock
        )
        step = await self.compute(context, partial(next_step, steps, None))
        while not isinstance(step, SequenceLocalisation):
            result = await self._optimiser.refine_sequence(step, self._lpo_timeout_s(context), context.client)
            step = await self.compute(context, partial(next_step, steps, result))
        timings_ms = self.observe(context, step.stage)
        alone = [
            compose(
                found,
                locate=locate_in(record),
                known=one,
                warnings=heading_warnings(found, one),
                timings_ms=timings_ms,
                bundle=self._bundle,
            )
            for one, found in zip(known, step.pictures, strict=True)
        ]
        return sequence_answer(alone, step, motions, self._bundle.manifest.confidence)

    def close(self) -> None:
        """Finish what is being computed."""
        self._threads.close()

    async def compute(self, context: QueryContext, work: Callable[[], T]) -> T:
        """Run CPU work on a thread; past the deadline it is not started, or its outcome dropped.

        Raises:
            DeadlineExceededError: there was no outcome in time.
        """

        def run() -> T:
            with self._grids.throttle.query():
                return work()

        try:
            async with asyncio.timeout(max(context.left_s, 0.0)):
                return await self._threads.run(context.client, run)
        except TimeoutError as error:
            raise DeadlineExceededError(self._settings.requests.request_deadline_s) from error

    def encode(
        self, panoramas: Sequence[Panorama], known: Sequence[KnownHeading], height: CameraHeight, clock: StageClock
    ) -> list[Query]:
        """Encode decoded panoramas, each with what is known of its heading."""
        with clock.stage("encode"):
            return [
                self._encoders.query(panorama.pixels, one.heading, height, heading_tolerance=one.tolerance)
                for panorama, one in zip(panoramas, known, strict=True)
            ]

    async def finished(self, steps: Steps, context: QueryContext) -> Localisation:
        """Run a search on the threads of the localiser, which do something else while LPO is waited for."""
        step = await self.compute(context, partial(next_step, steps, None))
        while not isinstance(step, Localisation):
            result = await self._optimiser.refine(step, self._lpo_timeout_s(context), context.client)
            step = await self.compute(context, partial(next_step, steps, result))
        return step

    def observe(self, context: QueryContext, stage: str) -> dict[str, float]:
        """Count an answer, with what its stages took: these in milliseconds, `total` among them."""
        timings_ms = context.clock.timings_ms | {"total": context.spent_s * 1e3}
        for name, duration_ms in timings_ms.items():
            self._telemetry.stage_seconds.labels(name).observe(duration_ms / 1e3)
        self._telemetry.answers.labels(stage).inc()
        return timings_ms

    def _lpo_timeout_s(self, context: QueryContext) -> float:
        return min(self._settings.lpo.deadline_s, context.left_s - _ANSWER_S)

    async def _grid(self, record: PlanRecord, height: CameraHeight, context: QueryContext) -> PoseGrid:
        """The plan's grid for a camera height, computed on demand, waited for until the deadline."""
        with context.clock.stage("grid"):
            height_m = grid_height_m(record, height.height_m, latents_alone=not self._encoders.predicts_profile)
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
                async with asyncio.timeout(max(context.left_s, 0.0)):
                    with self._queries.released(context.client):
                        return await asyncio.wrap_future(future)
            except TimeoutError as error:
                raise PlanNotReadyError(record.id, monotonic() - begin, self._grids.progress(key)) from error
