"""Tracking in a stored plan: one photograph of a session, from its upload to the state for the next one."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from lalaloc_core.conventions import heading_to_degrees
from lalaloc_core.errors import InvalidStateError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.hints import NO_HINTS
from lalaloc_core.localise.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.poses import PoseGrid
from lalaloc_core.localise.ranking import panorama_heading
from lalaloc_core.localise.stated_camera import KnownHeading
from lalaloc_core.localise.tracking import TrackState
from lalaloc_core.localise.tracking.filter import Tracked, track_steps
from lalaloc_core.localise.tracking.motion import WalkGraph
from lalaloc_core.photograph import View
from service.bounded_cache import BoundedCache
from service.errors import SessionOutdatedError
from service.http.admission_control import Slots
from service.query.decoding import Decoder
from service.query.geopose import geopose_at
from service.query.localiser import Localiser
from service.query.photographs import Photograph, encode, read_view
from service.query.queries import TrackOutcome, TrackQuery
from service.query.stated_camera import known_heading, stated_height, stated_hints
from service.schemas import (
    ModelAnswer,
    PathPoint,
    PhotographForm,
    Position,
    RivalAnswer,
    SessionDocument,
    StoredPose,
    TimingsAnswer,
    TrackedPoseAnswer,
)
from service.settings import Settings
from service.storage.records import PlanRecord

# Memory of the links of pose grids.
_GRAPH_BYTES = 64 * 2**20
_UNKNOWN = KnownHeading(None, 0.0, "searched")
# Stages of tracking that answers report as a stage of a single query.
_STAGES = {"retrieve": ("predict", "retrieve"), "lpo": ("lpo", "rank")}


class SessionTracker:
    """Follows the cameras of sessions; CPU work runs on the threads of the localiser."""

    def __init__(
        self,
        *,
        settings: Settings,
        bundle: Bundle,
        encoder: PhotographEncoder,
        localiser: Localiser,
        decoder: Decoder,
        queries: Slots,
    ) -> None:
        self._settings = settings
        self._bundle = bundle
        self._encoder = encoder
        self._localiser = localiser
        self._decoder = decoder
        self._queries = queries
        self._graphs = BoundedCache[str, WalkGraph](_GRAPH_BYTES, lambda graph: graph.nbytes)

    async def check(self, record: PlanRecord, document: SessionDocument) -> None:
        """Check a request for a session.

        Raises:
            InvalidPoseError: the camera height is above the ceiling.
            InvalidHintError: the hints do not match the plan.
        """
        stated_height(document, record)
        stated_hints(document, record.plan).check(record.plan)

    async def track(self, record: PlanRecord, query: TrackQuery) -> TrackOutcome:
        """Follow a camera to its next photograph.

        Raises:
            SessionOutdatedError: the model has changed since the session began.
            LaLaLocError: see `Localiser.localise`.
        """
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return await self._track(record, query)

    async def _track(self, record: PlanRecord, query: TrackQuery) -> TrackOutcome:
        form, document, context = query.form, query.document, query.context
        clock, compute = context.clock, partial(self._localiser.compute, context)
        odometry, height = form.odometry, stated_height(document, record)
        with clock.stage("decode"):
            view = await self._decoder.decode(query.content, form.stated_view, context.deadline, context.client)
        known = known_heading(form, record.plan.north, view, self._settings.panoramas.compass_tolerance_deg)
        encoded = (await compute(partial(encode, self._encoder, [Photograph(view)], [_UNKNOWN], height, clock)))[0]
        grid = await self._localiser.grid(record, height, context)
        graph = await compute(partial(self._graph, record, grid))
        try:
            state = TrackState.first(len(grid.poses), len(encoded.roll))
            if query.state is not None:
                state = TrackState.from_bytes(query.state)
            steps = track_steps(
                record.plan,
                grid,
                graph,
                self._encoder.networks,
                state,
                encoded,
                odometry,
                known_heading=known,
                hints=stated_hints(document, record.plan) if query.state is None else NO_HINTS,
                top_k=document.top_k,
                clock=clock,
            )
            found = await self._localiser.run_search(steps, context)
        except InvalidStateError as error:
            raise SessionOutdatedError(query.session_id, str(error)) from error
        timings_ms = self._localiser.observe(context, found.stage)
        return TrackOutcome(found.state.to_bytes(), self._stored(record, found, view, form, timings_ms))

    def _graph(self, record: PlanRecord, grid: PoseGrid) -> WalkGraph:
        """Return the links of a plan's pose grid."""
        return self._graphs.get_or_make(
            record.revision_id, lambda: WalkGraph.of(grid.poses, grid.layouts(record.plan), grid.step_m)
        )

    def _stored(
        self, record: PlanRecord, found: Tracked, view: View, form: PhotographForm, timings_ms: dict[str, float]
    ) -> StoredPose:
        """Compose the part of the answer that is stored with the session."""
        plan, pose, query = record.plan, found.pose, found.query
        scale = np.array([1.0, 1.0, math.degrees(1.0)])
        heading_deg, room = heading_to_degrees(pose.heading), plan.rooms[pose.room_index]
        camera_height_m = query.camera_height.height_m * math.exp(found.candidates[0].height_offset)
        rivals = [
            RivalAnswer(
                position=Position(x_m=rival.x_m, y_m=rival.y_m),
                heading_deg=heading_to_degrees(panorama_heading(query, rival)),
                room=plan.rooms[rival.room_index].name,
                room_id=plan.rooms[rival.room_index].id,
                probability=min(probability, 1.0),
            )
            for rival, probability in zip(found.candidates, found.probability, strict=True)
        ]
        totals = {
            name: sum(timings_ms.get(part, 0.0) for part in _STAGES.get(name, (name,)))
            for name in TimingsAnswer.model_fields
        }
        answer = TrackedPoseAnswer(
            number=pose.number,
            position=Position(x_m=pose.x_m, y_m=pose.y_m),
            heading_deg=heading_deg,
            room=room.name,
            room_id=room.id,
            covariance=(pose.covariance * np.outer(scale, scale)).tolist(),
            probability=min(pose.probability, 1.0),
            camera_height_m=camera_height_m,
            candidates=rivals,
            motion_contradicted=list(found.contradicted),
            warnings=_warnings(found, form),
            geopose=geopose_at(plan.anchor, (pose.x_m, pose.y_m), heading_deg, camera_height_m),
            view=read_view(Photograph(view)),
            timings_ms=TimingsAnswer(**totals),
            model=ModelAnswer.of(self._bundle),
        )
        return StoredPose(mode=pose.mode, pose=answer, path=[_point(row, plan) for row in found.state.path])


def _point(row: np.ndarray, plan: FloorPlan) -> PathPoint:
    number, x_m, y_m, heading, room, probability = row.tolist()
    return PathPoint(
        number=int(number),
        position=Position(x_m=x_m, y_m=y_m),
        heading_deg=heading_to_degrees(heading),
        room_id=plan.rooms[int(room)].id,
        probability=min(max(probability, 0.0), 1.0),
    )


def _warnings(found: Tracked, form: PhotographForm) -> list[str]:
    """Return a warning for each contradicted component of the motion, and for odometry that is wrong repeatedly."""
    warnings = [
        f"{name} is {getattr(form, name) or 0.0:g}, which the photographs contradict by more than 4 standard deviations"
        for name in found.contradicted
    ]
    return warnings + [
        f"{name} contradicts at least 3 of the last 8 photographs: check its sign, unit and standard deviation"
        for name in found.state.suspected
    ]
