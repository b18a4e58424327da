"""Tracking in a stored plan or venue: one photograph of a session, from its upload to the state for the next one."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import heading_from_degrees, heading_to_degrees
from lalaloc_core.errors import InvalidStateError
from lalaloc_core.localise.belief import photograph_heading
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import CameraHeight, KnownHeading, Query
from lalaloc_core.localise.search.pipeline import StageClock
from lalaloc_core.localise.tracking import TrackState
from lalaloc_core.localise.tracking.tracking_filter import Tracked, track_steps
from lalaloc_core.photograph import Photograph
from service.capacity.admission_control import Slots
from service.decoding.decoder import Decoder
from service.errors import SessionOutdatedError
from service.query.answers import Place
from service.query.geopose import geopose_at
from service.query.grounds import Grounds, SessionGround
from service.query.localiser import Localiser
from service.query.photographs import Spot, encode, read_view
from service.query.queries import TrackOutcome, TrackQuery
from service.query.stated_pose import known_heading, stated_height, stated_hints
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
from service.storage.records import PlanRecord, VenueRecord
from service.venues.venue_plans import venue_height

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
        grounds: Grounds,
    ) -> None:
        self._settings = settings
        self._bundle = bundle
        self._encoder = encoder
        self._localiser = localiser
        self._decoder = decoder
        self._queries = queries
        self._grounds = grounds

    async def check(self, place: PlanRecord | VenueRecord, document: SessionDocument) -> None:
        """Check a request for a session.

        Raises:
            InvalidPoseError: the camera height is above the ceiling.
            InvalidHintError: the hints do not match the plan or venue.
            VenueUnsearchableError: the venue has no plans.
        """
        if isinstance(place, VenueRecord):
            await self._grounds.check(place, document)
            return
        stated_height(document, place)
        stated_hints(document, place.plan).check(place.plan)

    async def track(self, place: PlanRecord | VenueRecord, query: TrackQuery) -> TrackOutcome:
        """Follow a camera to its next photograph.

        Raises:
            SessionOutdatedError: the model, or a plan of the venue, has changed since the session began.
            LaLaLocError: see `Localiser.localise` and `VenueLocaliser.localise`.
        """
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return await self._track(place, query)

    async def _track(self, place: PlanRecord | VenueRecord, query: TrackQuery) -> TrackOutcome:
        form, document, context = query.form, query.document, query.context
        clock, compute = context.clock, partial(self._localiser.compute, context)
        odometry = form.odometry
        with clock.stage("decode"):
            view = await self._decoder.decode(query.content, form.stated_camera, context.deadline, context.client)
        compass_deg = self._settings.photographs.compass_tolerance_deg
        try:
            state = None if query.state is None else TrackState.from_bytes(query.state)
            if isinstance(place, VenueRecord):
                with clock.stage("wait"):
                    ready = await self._grounds.ready(place, query)
                north = None if place.anchor is None else heading_from_degrees(place.anchor.north_deg)
                known = known_heading(form, north, view, compass_deg)
                height = venue_height(document, ready.rows)
                encoded = (await compute(self._encode(view, height, clock)))[0]
                with clock.stage("shortlist"):
                    found = await self._grounds.of_venue(place, ready, query, encoded, state)
            else:
                known = known_heading(form, place.plan.north, view, compass_deg)
                encoded = (await compute(self._encode(view, stated_height(document, place), clock)))[0]
                found = await self._grounds.of_plan(place, query)
            steps = track_steps(
                found.ground,
                self._encoder,
                state or TrackState.first(len(encoded.roll)),
                encoded,
                odometry,
                known_heading=known,
                hints=found.hints,
                top_k=document.top_k,
                clock=clock,
            )
            tracked = await self._localiser.run_search(steps, context)
        except InvalidStateError as error:
            raise SessionOutdatedError(query.session_id, str(error)) from error
        timings_ms = self._localiser.observe(context, tracked.stage)
        return TrackOutcome(tracked.state.to_bytes(), self._stored(found, tracked, view, form, timings_ms))

    def _encode(self, view: Photograph, height: CameraHeight, clock: StageClock) -> Callable[[], list[Query]]:
        return partial(encode, self._encoder, [Spot(view)], [_UNKNOWN], height, clock)

    def _stored(
        self,
        ground: SessionGround,
        found: Tracked,
        view: Photograph,
        form: PhotographForm,
        timings_ms: dict[str, float],
    ) -> StoredPose:
        """Compose the part of the answer that is stored with the session; its path is the new pose alone."""
        pose, query, best = found.pose, found.query, found.candidates[0]
        place = ground.place(best)
        scale = np.array([1.0, 1.0, math.degrees(1.0)])
        heading_deg, room = heading_to_degrees(pose.heading), place.plan.rooms[pose.room_index]
        position = Position(x_m=pose.x_m, y_m=pose.y_m)
        camera_height_m = query.camera_height.height_m * math.exp(best.height_offset)
        rivals = [
            _rival(ground.place(rival), heading_to_degrees(photograph_heading(query, rival)), probability)
            for rival, probability in zip(found.candidates, found.probability, strict=True)
        ]
        totals = {
            name: sum(timings_ms.get(part, 0.0) for part in _STAGES.get(name, (name,)))
            for name in TimingsAnswer.model_fields
        }
        answer = TrackedPoseAnswer(
            number=pose.number,
            position=position,
            heading_deg=heading_deg,
            room=room.name,
            room_id=room.id,
            floorplan_id=place.plan_id,
            level=place.level,
            covariance=(pose.covariance * np.outer(scale, scale)).tolist(),
            probability=min(pose.probability, 1.0),
            camera_height_m=camera_height_m,
            candidates=rivals,
            motion_contradicted=list(found.contradicted),
            warnings=[*_warnings(found, form), *ground.warnings],
            geopose=geopose_at(place.anchor, (pose.x_m, pose.y_m), heading_deg, camera_height_m),
            view=read_view(Spot(view)),
            timings_ms=TimingsAnswer(**totals),
            model=ModelAnswer.of(self._bundle),
        )
        point = PathPoint(**{name: getattr(answer, name) for name in PathPoint.model_fields})
        return StoredPose(mode=pose.mode, pose=answer, path=[point])


def _rival(place: Place, heading_deg: float, probability: float) -> RivalAnswer:
    room = place.plan.rooms[place.candidate.room_index]
    return RivalAnswer(
        position=Position(x_m=place.candidate.x_m, y_m=place.candidate.y_m),
        heading_deg=heading_deg,
        room=room.name,
        room_id=room.id,
        floorplan_id=place.plan_id,
        level=place.level,
        probability=min(probability, 1.0),
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
