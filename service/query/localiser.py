"""Localisation in a stored plan: decode, encode, get the pose grid, search, refine, compose the answer."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from time import monotonic
from typing import TypeVar

from lalaloc_core.bundle import Bundle
from lalaloc_core.draw.answer import PHOTOGRAPH_SIZE, draw_answer, drawn_answer
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.localise.refine import RefinementJob
from lalaloc_core.localise.search.pipeline import Localisation, localise_steps
from lalaloc_core.localise.sequence import SequenceJob
from lalaloc_core.photograph import Photograph
from service.capacity.admission_control import Slots
from service.capacity.fair_share import FairSemaphore, with_headroom
from service.capacity.threads import BoundedReads, Threads
from service.decoding.decoder import Decoder
from service.errors import PlanFailedError, PlanNotReadyError
from service.grids import GridProvider, grid_height_m
from service.query.answers import compose_answer, locate_in, posterior_answer
from service.query.photographs import Spot, encode, view_answer
from service.query.queries import OptimiserBackend, PhotographQuery, PictureRequest, QueryContext, SequenceQuery
from service.query.search_steps import SearchSteps, StepRunner, completed
from service.query.sequences import SequenceGround, SequenceSearch
from service.query.stated_pose import hint_warnings, known_heading, stated_height, stated_heights, stated_hints
from service.schemas import LocaliseAnswer, ModelAnswer, SequenceAnswer
from service.settings import Settings, work_factor
from service.storage.records import PlanRecord
from service.telemetry import Telemetry

# LPO stops this long (s) before the request's deadline; ranking and sending the answer need the rest.
_RESERVED_S = 0.25

# Names of the heading's sources in pictures.
_SOURCES = {"given": "given", "panorama": "from the compass", "searched": "estimated"}

T = TypeVar("T")


@dataclass(frozen=True)
class _Outcome:
    """An answer, and the photograph, search result and pose grid behind it."""

    answer: LocaliseAnswer
    view: Photograph
    found: Localisation
    grid: PoseGrid


class Localiser:
    """Answers queries about plans; CPU work runs on its own threads, never on the event loop."""

    def __init__(
        self,
        *,
        settings: Settings,
        bundle: Bundle,
        encoder: PhotographEncoder,
        grids: GridProvider,
        optimiser: OptimiserBackend,
        decoder: Decoder,
        queries: Slots,
        reads: BoundedReads,
        telemetry: Telemetry,
        permits: FairSemaphore,
    ) -> None:
        self._settings = settings
        self._bundle = bundle
        self._encoder = encoder
        self._grids = grids
        self._optimiser = optimiser
        self._decoder = decoder
        self._queries = queries
        self._reads = reads
        self._telemetry = telemetry
        self._steps = StepRunner(optimiser, telemetry)
        self._threads = Threads(
            "localise", with_headroom(settings.cores.compute_threads), telemetry.cpu_accounts, permits
        )
        self.sequences = SequenceSearch(self, settings=settings, bundle=bundle, encoder=encoder, decoder=decoder)

    @property
    def model(self) -> ModelAnswer:
        """Name, version and digest of the model."""
        return ModelAnswer.of(self._bundle)

    async def localise(self, record: PlanRecord, query: PhotographQuery) -> LocaliseAnswer:
        """Localise a photograph in a stored plan.

        Raises:
            InvalidPhotographError, DecoderNotReadyError, StoppingError: see `Decoder.decode`.
            InvalidPoseError: the camera height is above the ceiling.
            InvalidHintError: the hints do not match the plan, or exclude all of it.
            PlanFailedError: the plan's pose grid could not be computed.
            PlanNotReadyError: the pose grid was not ready by the deadline.
            DeadlineExceededError: another step missed the deadline.
            StoreUnavailableError: the pose grid is not in memory, and the database cannot be reached.
            OverloadedError: too many queries are in progress, or too many pose grids are computed on demand.
        """
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return (await self._localise(record, query)).answer

    async def localise_and_draw(
        self, record: PlanRecord, query: PhotographQuery, request: PictureRequest
    ) -> tuple[LocaliseAnswer, bytes]:
        """Localise as `localise` does, and return the answer with its picture, a PNG or SVG file.

        Raises:
            DrawingFailedError: the picture could not be made.
            LaLaLocError: see `localise`.
        """
        clock = query.context.clock
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            outcome = await self._localise(record, query)
            with clock.stage("draw"):
                picture = await self._draw(record, outcome, query, request)
            self._telemetry.stage_seconds.labels("draw").observe(clock.timings_ms["draw"] / 1e3)
            return outcome.answer, picture

    async def localise_sequence(self, record: PlanRecord, query: SequenceQuery) -> SequenceAnswer:
        """Localise several photographs of one visit jointly; raises the errors of `localise`."""
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return await self._localise_sequence(record, query)

    def close(self) -> None:
        """Wait for the computations in progress, and stop the threads."""
        self._threads.close()

    async def _localise(self, record: PlanRecord, query: PhotographQuery) -> _Outcome:
        form, context, clock = query.form, query.context, query.context.clock
        height, hints = stated_height(form, record), stated_hints(form, record.plan)
        # Decode first, so that an unreadable picture is refused without waiting for the plan.
        with clock.stage("decode"):
            view = await self._decoder.decode(query.content, form.stated_camera, context.deadline, context.client)
        known = known_heading(form, record.plan.north, view, self._settings.photographs.compass_tolerance_deg)
        if not hints.are_none:
            # On a compute thread, because checking many rooms is slow.
            await self.compute(context, partial(hints.check, record.plan))
        photograph = Spot(view)
        encoded = await self.compute(context, partial(encode, self._encoder, [photograph], [known], height, clock))
        grid = await self.grid(record, height, context)
        steps = localise_steps(
            record.plan,
            grid,
            self._encoder,
            encoded[0],
            refine=form.refine,
            top_k=form.top_k,
            clock=clock,
            hints=hints,
        )

        def compose(found: Localisation) -> _Outcome:
            answer = compose_answer(
                found,
                locate=locate_in(record),
                known=known,
                warnings=hint_warnings(hints, found, record.plan),
                timings_ms=self.observe(context, found.stage),
                bundle=self._bundle,
                view=partial(view_answer, photograph, plan=record.plan, grid=grid),
            )
            if form.include == "posterior":
                answer = answer.model_copy(update={"posterior": posterior_answer(record.plan, grid, found.posterior)})
            return _Outcome(answer, view, found, grid)

        return await self.run_search(completed(steps, compose), context)

    async def _localise_sequence(self, record: PlanRecord, query: SequenceQuery) -> SequenceAnswer:
        plan, heights = record.plan, stated_heights(query.form, record, len(query.contents))

        async def ground(_: Sequence[Query]) -> SequenceGround:
            grid = await self.grid(record, heights[0], query.context)
            return SequenceGround(plan, grid, locate_in(record))

        return await self.sequences.answer(query, await self.sequences.views(query), heights, plan.north, ground)

    async def grid(self, record: PlanRecord, height: CameraHeight, context: QueryContext) -> PoseGrid:
        """Return the plan's pose grid for a camera height; compute it on demand and wait until the deadline."""
        with context.clock.stage("grid"):
            height_m = grid_height_m(record, height.height_m, latents_alone=not self._encoder.predicts_profile)
            key = self._grids.key(record.revision_id, height_m)
            grid = self._grids.cached(key)
            if grid is None:
                # Not on the compute threads: a database that does not answer would block them.
                grid = await self._reads.run(record.tenant, self._grids.find, key)
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

    async def _draw(
        self, record: PlanRecord, outcome: _Outcome, query: PhotographQuery, request: PictureRequest
    ) -> bytes:
        context, photograph, view = query.context, None, outcome.view
        if request.picture != "plan":
            assert not isinstance(query.content, Photograph)
            # Decode again, because the encoder's input is too small for a picture.
            photograph = await self._decoder.picture(
                query.content,
                query.form.stated_camera,
                context.deadline,
                context.client,
                is_sphere=view.is_sphere,
                max_size=PHOTOGRAPH_SIZE,
            )

        def draw() -> str:
            model = self._bundle.manifest.confidence_for(view=outcome.found.query.is_view)
            source = _SOURCES[outcome.answer.heading_source]
            drawn = drawn_answer(record.plan, outcome.grid, outcome.found, model, source, photograph=view)
            return draw_answer(drawn, photograph, request.picture, rooms=request.rooms)

        svg = await self.compute(context, draw)
        if request.as_png:
            return await self._decoder.rasterise(svg, context.deadline, context.client)
        return svg.encode()

    # `VenueLocaliser` uses the following methods as well.

    async def compute(self, context: QueryContext, work: Callable[[], T]) -> T:
        """Run CPU work on a compute thread.

        After the query's deadline, waiting work is not started, and the result of running work is dropped.

        Raises:
            DeadlineExceededError: the deadline passed.
        """
        async with context.bounded():
            return await self._threads.run(context.client, work)

    async def run_search(self, steps: SearchSteps[T], context: QueryContext) -> T:
        """Run a search on the compute threads; it holds none in its pauses (None) and while a worker refines poses."""
        lpo_timeout_s = partial(self._lpo_timeout_s, context)
        step = await self.compute(context, partial(self._steps.next, steps, None, lpo_timeout_s))
        while step is None or isinstance(step, RefinementJob | SequenceJob):
            result = None
            if step is not None:
                photographs = step.heading.shape[1] if isinstance(step, SequenceJob) else 1
                result = await self._optimiser.refine(step, self._lpo_timeout_s(context, photographs), context.client)
            step = await self.compute(context, partial(self._steps.next, steps, result, lpo_timeout_s))
        return step

    def _lpo_timeout_s(self, context: QueryContext, photographs: int = 1) -> float:
        return min(self._settings.lpo.deadline_s * work_factor(photographs), context.left_s - _RESERVED_S)

    def observe(self, context: QueryContext, stage: str) -> dict[str, float]:
        """Record an answer in the metrics; return the duration (ms) of each stage, and their `total`."""
        timings_ms = context.clock.timings_ms | {"total": context.spent_s * 1e3}
        for name, duration_ms in timings_ms.items():
            self._telemetry.stage_seconds.labels(name).observe(duration_ms / 1e3)
        self._telemetry.answers.labels(stage).inc()
        return timings_ms
