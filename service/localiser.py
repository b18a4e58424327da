"""From an uploaded panorama to an answer: decode, encode, wait for the grid, search, refine."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from time import monotonic
from typing import TypeVar

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import heading_from_degrees, heading_to_degrees
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.covariance import spread_of
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.images import read_panorama
from lalaloc_core.localise.pipeline import Localisation, StageClock, localise, panorama_heading
from lalaloc_core.localise.poses import Candidate, LatentGrid, Query
from service.errors import DeadlineExceededError, PlanFailedError, PlanNotReadyError
from service.grids import Grids, query_height_m
from service.refinement import LpoPool
from service.schemas import CandidateAnswer, LocaliseAnswer, LocaliseForm, ModelAnswer, Position, TimingsAnswer
from service.settings import Settings
from service.store import PlanRecord
from service.telemetry import Telemetry

# Kept free of LPO before the request's deadline, to rank and send the answer.
_ANSWER_S = 0.25

T = TypeVar("T")


class Localiser:
    """Answers queries; CPU work runs on its own few threads, never on the event loop."""

    def __init__(
        self,
        *,
        settings: Settings,
        bundle: Bundle,
        encoders: Encoders,
        grids: Grids,
        pool: LpoPool,
        telemetry: Telemetry,
    ) -> None:
        self._settings = settings
        self._bundle = bundle
        self._encoders = encoders
        self._grids = grids
        self._pool = pool
        self._telemetry = telemetry
        self._executor = ThreadPoolExecutor(settings.compute_threads, thread_name_prefix="localise")

    @property
    def model(self) -> ModelAnswer:
        """The model that answers."""
        return model_answer(self._bundle)

    async def answer(self, record: PlanRecord, form: LocaliseForm, content: bytes) -> LocaliseAnswer:
        """Localise an encoded panorama in a stored plan.

        Raises:
            InvalidPanoramaError: see `read_panorama`.
            InvalidPoseError: a camera height above the ceiling.
            PlanFailedError: the plan's grid could not be computed.
            PlanNotReadyError: the grid was not finished by the deadline.
            DeadlineExceededError: the rest was not.
            OverloadedError: too many grids are waiting to be computed on demand.
        """
        begin = monotonic()
        deadline = begin + self._settings.request_deadline_s
        height_m = query_height_m(record, form.camera_height_m)
        clock = StageClock()
        # The picture first: a bad one is refused without waiting for the plan.
        query = await self._compute(lambda: self._encode(content, form, height_m, clock), deadline)
        grid = await self._grid(record, height_m, deadline)
        found = await self._compute(lambda: self._search(record.plan, grid, query, form, deadline), deadline)
        timings_ms = clock.timings_ms | found.timings_ms | {"total": (monotonic() - begin) * 1e3}
        self._observe(timings_ms, found.stage)
        return self._compose(record, form, height_m, query, found, timings_ms)

    def close(self) -> None:
        """Finish what is being computed."""
        self._executor.shutdown(wait=True, cancel_futures=True)

    async def _compute(self, work: Callable[[], T], deadline: float) -> T:
        """Run CPU work on a thread; past the deadline it is not started, or its outcome dropped."""
        try:
            async with asyncio.timeout(max(deadline - monotonic(), 0.0)):
                return await asyncio.get_running_loop().run_in_executor(self._executor, work)
        except TimeoutError as error:
            raise DeadlineExceededError(self._settings.request_deadline_s) from error

    async def _grid(self, record: PlanRecord, height_m: float, deadline: float) -> LatentGrid:
        """The plan's grid for a camera height, computed on demand, waited for until the deadline."""
        key = self._grids.key(record.id, height_m)
        grid = await self._compute(lambda: self._grids.find(key), deadline)
        if grid is not None:
            return grid
        own_height = height_m == record.plan.camera_height_m
        if own_height and record.failure is not None:
            raise PlanFailedError(record.id, record.failure)
        future = self._grids.compute(key, on_demand=not own_height)
        begin = monotonic()
        try:
            async with asyncio.timeout(max(deadline - begin, 0.0)):
                return await asyncio.wrap_future(future)
        except TimeoutError as error:
            raise PlanNotReadyError(record.id, monotonic() - begin, self._grids.progress(key)) from error

    def _encode(self, content: bytes, form: LocaliseForm, height_m: float, clock: StageClock) -> Query:
        manifest = self._encoders.manifest
        with clock.stage("decode"):
            image = read_panorama(
                content,
                height=manifest.image_height,
                width=manifest.image_width,
                limits=self._settings.panorama_limits,
            )
        with clock.stage("encode"):
            heading = None if form.heading_deg is None else heading_from_degrees(form.heading_deg)
            tolerance = math.radians(form.heading_tolerance_deg)
            return self._encoders.query(image, heading, height_m, heading_tolerance=tolerance)

    def _search(
        self, plan: FloorPlan, grid: LatentGrid, query: Query, form: LocaliseForm, deadline: float
    ) -> Localisation:
        return localise(
            plan,
            grid,
            self._encoders,
            query,
            refine=form.refine,
            top_k=form.top_k,
            refiner=lambda job: self._pool.refine(
                job, min(self._settings.lpo_deadline_s, deadline - monotonic() - _ANSWER_S)
            ),
        )

    def _observe(self, timings_ms: dict[str, float], stage: str) -> None:
        for name, duration_ms in timings_ms.items():
            self._telemetry.stage_seconds.labels(name).observe(duration_ms / 1e3)
        self._telemetry.answers.labels(stage).inc()

    def _compose(
        self,
        record: PlanRecord,
        form: LocaliseForm,
        height_m: float,
        query: Query,
        found: Localisation,
        timings_ms: dict[str, float],
    ) -> LocaliseAnswer:
        model = self._bundle.manifest.confidence
        signals = asdict(found.signals[found.stage])
        answer = found.best[found.stage]
        spread = None
        if model is not None and answer.information is not None:
            spread = spread_of(answer.information, record.plan.rooms[answer.room_index], model)
        candidates = [_candidate(record.plan, query, candidate) for candidate in found.candidates]
        best = candidates[0]
        return LocaliseAnswer(
            floorplan_id=record.id,
            position=best.position,
            heading_deg=best.heading_deg,
            room=best.room,
            confidence=model and model.probability(found.stage, signals, heading_known=query.heading_known),
            covariance_m2=None if spread is None else spread.position_m2.tolist(),
            heading_std_deg=None
            if spread is None or spread.heading_std is None
            else round(math.degrees(spread.heading_std), 3),
            stage=found.stage,
            cost=best.cost,
            latent_distance=best.latent_distance,
            camera_height_m=round(height_m, 3),
            candidates=candidates,
            timings_ms=TimingsAnswer(
                **{name: round(timings_ms.get(name, 0.0), 2) for name in TimingsAnswer.model_fields}
            ),
            model=self.model,
        )


def model_answer(bundle: Bundle) -> ModelAnswer:
    """Name, version and digest of a bundle."""
    return ModelAnswer(name=bundle.manifest.name, version=bundle.manifest.version, sha256=bundle.sha256)


def _candidate(plan: FloorPlan, query: Query, candidate: Candidate) -> CandidateAnswer:
    """A candidate in the words of the API: tenths of millimetres, thousandths of degrees."""
    return CandidateAnswer(
        position=Position(x_m=round(candidate.x_m, 4), y_m=round(candidate.y_m, 4)),
        heading_deg=round(heading_to_degrees(panorama_heading(query, candidate)), 3) % 360.0,
        room=plan.rooms[candidate.room_index].name,
        cost=candidate.cost,
        latent_distance=min(max(candidate.latent_distance, 0.0), 2.0),
    )
