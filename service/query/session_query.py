"""Query about the next photograph of a session: photograph, ground, steps, and the state for the one after."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from sqlalchemy import Row

from lalaloc_core.errors import InvalidStateError
from lalaloc_core.localise.answers.compose import compose_tracked
from lalaloc_core.localise.answers.documents import Spot
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query.query import UNKNOWN_HEADING
from lalaloc_core.localise.tracking import TrackState
from lalaloc_core.localise.tracking.tracked_plans import PlanOnLevel, TrackedPlans
from lalaloc_core.localise.tracking.tracking_filter import Tracked, track_steps
from lalaloc_core.localise.tracking.walk_motion import WalkGraph
from service.bounded_cache import BoundedCache
from service.errors import SessionOutdatedError
from service.query.geopose import geopose_at
from service.query.ground import Ground
from service.query.grounds import VenueSite
from service.query.queries import TrackOutcome, TrackQuery
from service.query.single_query import QueryParts
from service.schemas import PathPoint, PhotographForm, StoredPose, TimingsAnswer, TrackedPoseAnswer
from service.storage.records import PlanRecord, VenueRecord

# Poses of a plan whose belief is computed for every photograph; a belief has a weight for each pose and heading.
MAX_POSES = 65_536
# Memory of the links of pose grids.
_GRAPH_BYTES = 64 * 2**20
# Plans with at least this probability stay among those that are searched; log factor for plans one level from them.
_STAYS_FROM, _NEXT_LEVEL = 1e-3, 5.0
# Log factor of plans that stay, larger than any difference of log masses.
_STAYS = 1e6
_RIVAL_FIELDS = ("position", "heading_deg", "room", "room_id", "probability")
# Stages of tracking that answers report as a stage of a single query.
_STAGES = {"retrieve": ("predict", "retrieve"), "lpo": ("lpo", "rank")}


class SessionSearch:
    """Search of the places of a session's camera; links of pose grids stay in memory."""

    def __init__(self, parts: QueryParts) -> None:
        self._parts = parts
        self._graphs = BoundedCache[str, WalkGraph](_GRAPH_BYTES, lambda graph: graph.nbytes)

    async def answer(self, where: PlanRecord | VenueRecord, query: TrackQuery) -> TrackOutcome:
        """Follow a camera to its next photograph."""
        form, document, context = query.form, query.document, query.context
        (photograph,) = await self._parts.reader.decode([query.content], form.stated_camera, context)
        try:
            state = None if query.state is None else TrackState.from_bytes(query.state)
            # Hints are the prior of the first photograph.
            hinted = document if state is None else None
            site = await self._parts.grounds.site(where, document, hinted, max_poses=MAX_POSES)
            heading = form.heading_deg, form.heading_tolerance_deg
            known = self._parts.reader.known_heading(*heading, site.north, photograph)
            await site.wait(context)
            (encoded,) = await self._parts.reader.encode([Spot(photograph)], [UNKNOWN_HEADING], [site.height], context)
            favour = None
            if isinstance(site, VenueSite):
                favour = _favour_of(site, {} if state is None else state.by_plan, query.session_id)
            ground = await site.ground([encoded], context, favour)
            levels = [row.level for row in site.ready] if isinstance(site, VenueSite) else []
            steps = track_steps(
                await self._parts.executor.compute(context, partial(self._track_ground, ground, levels)),
                self._parts.encoder.layouts,
                state or TrackState.first(len(encoded.roll)),
                encoded,
                form.odometry,
                known_heading=known,
                hints=ground.hints,
                top_k=document.top_k,
                clock=context.clock,
            )
            tracked = await self._parts.executor.run_search(steps, context)
        except InvalidStateError as error:
            raise SessionOutdatedError(query.session_id, str(error)) from error
        timings_ms = self._parts.executor.observe(context, tracked.stage)
        # An answer that is not sure looks at its photograph again.
        stored = partial(self._stored, ground, tracked, Spot(photograph), form, timings_ms)
        return TrackOutcome(tracked.state.to_bytes(), await self._parts.executor.compute(context, stored))

    def _track_ground(self, ground: Ground, levels: Sequence[float]) -> TrackedPlans:
        """Return a ground with the ways through its plans; `levels` are those of all plans of the venue."""
        if ground.merged is None or ground.venue_plans is None:
            return TrackedPlans.of_plan(ground.plan, ground.grid, self._graph(ground.records[0], ground.grid))
        loaded = ground.venue_plans
        plans = [
            PlanOnLevel(record.plan, row.level, anchor)
            for record, row, anchor in zip(loaded.records, loaded.rows, ground.anchors, strict=True)
        ]
        graphs = [self._graph(record, grid) for record, grid in zip(loaded.records, loaded.grids, strict=True)]
        keys = [row.revision_id for row in loaded.rows]
        return TrackedPlans.of_levels(ground.merged, plans, graphs, keys, levels, ground.left_out)

    def _graph(self, record: PlanRecord, grid: PoseGrid) -> WalkGraph:
        return self._graphs.get_or_make(
            record.revision_id, lambda: WalkGraph.of(grid.poses, grid.layouts(record.plan), grid.step_m)
        )

    def _stored(
        self, ground: Ground, found: Tracked, spot: Spot, form: PhotographForm, timings_ms: dict[str, float]
    ) -> StoredPose:
        """Compose the part of the answer that is stored with the session; its path is the new pose alone."""
        composed = compose_tracked(
            found, ground, spot, self._parts.bundle, odometry=form.odometry, warnings=ground.warnings
        )
        fields = composed.document()
        place = ground.place(found.candidates[0])
        fields["candidates"] = [
            {name: pose[name] for name in _RIVAL_FIELDS} | {"floorplan_id": rival.plan_id, "level": rival.level}
            for pose, rival in zip(fields["candidates"], map(ground.place, found.candidates), strict=True)
        ]
        position = (composed.position.x_m, composed.position.y_m)
        fields |= {
            "floorplan_id": place.plan_id,
            "level": place.level,
            "geopose": geopose_at(place.anchor, position, composed.heading_deg, composed.camera_height_m),
            "timings_ms": {
                name: sum(timings_ms.get(part, 0.0) for part in _STAGES.get(name, (name,)))
                for name in TimingsAnswer.model_fields
            },
        }
        mode = fields.pop("mode")
        answer = TrackedPoseAnswer.model_validate(fields)
        point = PathPoint(**{name: getattr(answer, name) for name in PathPoint.model_fields})
        return StoredPose(mode=mode, pose=answer, path=[point])


def _favour_of(
    site: VenueSite, by_plan: Mapping[str, float], session_id: str
) -> Callable[[Sequence[Row[Any]]], Float[np.ndarray, "p"]]:
    """Return a function of the log factors by which a session prefers plans."""
    if not by_plan.keys() <= {row.revision_id for row in site.ready}:
        raise SessionOutdatedError(session_id, f"a floor plan of venue '{site.id}' was replaced")
    levels = np.unique([row.level for row in site.ready])

    def favour(rows: Sequence[Row[Any]]) -> Float[np.ndarray, "p"]:
        share = np.array([by_plan.get(row.revision_id, 0.0) for row in rows])
        storey = np.searchsorted(levels, [row.level for row in rows])
        kept = share >= _STAYS_FROM
        beside = np.isin(storey, [storey[kept] - 1, storey[kept] + 1])
        return np.where(kept, _STAYS * (1.0 + share), np.where(beside, _NEXT_LEVEL, 0.0))

    return favour
