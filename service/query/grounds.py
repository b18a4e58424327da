"""Grounds of sessions: a plan, or the plans of a venue that a photograph is compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from sqlalchemy import Row

from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import NO_HINTS, Candidate, Hints, Query
from lalaloc_core.localise.tracking import TrackState
from lalaloc_core.localise.tracking.passages import PlanOnLevel
from lalaloc_core.localise.tracking.tracked_plans import LeftOut, TrackedPlans
from lalaloc_core.localise.tracking.walk_motion import WalkGraph
from service.capacity.bounded_cache import BoundedCache
from service.errors import SessionOutdatedError, VenueUnsearchableError
from service.query.answers import Place
from service.query.localiser import Localiser
from service.query.queries import TrackQuery
from service.query.stated_pose import stated_height, stated_hints
from service.schemas import SessionDocument
from service.storage.records import PlanRecord, VenueRecord
from service.venues.plan_list import PlanList
from service.venues.venue_hints import VenueHints
from service.venues.venue_plans import VenuePlans
from service.venues.venue_search import SearchedPlans, VenueSearch

# Poses of a plan whose belief is computed for every photograph; a belief has a weight for each pose and heading.
MAX_POSES = 65_536
# Memory of the links of pose grids.
_GRAPH_BYTES = 64 * 2**20
# Plans with at least this probability stay among those that are searched; log factor for plans one level from them.
_STAYS_FROM, _NEXT_LEVEL = 1e-3, 5.0
# Log factor of plans that stay, larger than any difference of log masses.
_STAYS = 1e6


@dataclass(frozen=True, eq=False)
class SessionGround:
    """Ground of a session for one photograph.

    Attributes:
        ground: the plans.
        records: the same plans as they are stored.
        levels: levels of the plans; None outside of venues.
        anchors: places of the plans on Earth.
        hints: hints about the first photograph.
        warnings: warnings about plans that are not searched.
    """

    ground: TrackedPlans
    records: Sequence[PlanRecord]
    levels: Sequence[float | None]
    anchors: Sequence[Anchor | None]
    hints: Hints
    warnings: Sequence[str] = ()

    def place(self, candidate: Candidate) -> Place:
        """Return the plan of a candidate, and the candidate in that plan's frame."""
        number, own_candidate = self.ground.in_own_plan(candidate)
        record = self.records[number]
        return Place(
            record.id, record.revision_id, record.plan, own_candidate, self.anchors[number], self.levels[number]
        )


@dataclass(frozen=True, eq=False)
class ReadyPlans:
    """Rows of the plans of a venue that are ready, hints about the photograph, and warnings about other plans."""

    rows: PlanList
    hints: VenueHints
    warnings: list[str]


class Grounds:
    """Makes the grounds of sessions; links of pose grids stay in memory."""

    def __init__(self, localiser: Localiser, plans: VenuePlans, search: VenueSearch) -> None:
        self._localiser = localiser
        self._plans = plans
        self._search = search
        self._graphs = BoundedCache[str, WalkGraph](_GRAPH_BYTES, lambda graph: graph.nbytes)

    async def check(self, venue: VenueRecord, document: SessionDocument) -> None:
        """Check a request for a session in a venue.

        Raises:
            InvalidHintError: the hints do not match the venue.
            VenueUnsearchableError: the venue has no plans.
        """
        members = await self._plans.members(venue.tenant, venue.id)
        if not members:
            raise VenueUnsearchableError(venue.id, 0)
        VenueHints.from_form(document, venue.anchor).check(members)

    async def of_plan(self, record: PlanRecord, query: TrackQuery) -> SessionGround:
        """Return the ground of a session in one plan."""
        compute = partial(self._localiser.compute, query.context)
        grid = await self._localiser.grid(record, stated_height(query.document, record), query.context)
        graph = await compute(partial(self._graph, record, grid))
        hints = NO_HINTS if query.state is not None else stated_hints(query.document, record.plan)
        ground = TrackedPlans.of_plan(record.plan, grid, graph)
        return SessionGround(ground, [record], [None], [record.plan.anchor], hints)

    async def ready(self, venue: VenueRecord, query: TrackQuery) -> ReadyPlans:
        """Wait for a plan of a venue to be ready.

        Raises:
            VenueUnsearchableError: no plan can be searched.
            LaLaLocError: see `VenueSearch.ready`.
        """
        hints = VenueHints(anchor=venue.anchor)
        if query.state is None:
            hints = VenueHints.from_form(query.document, venue.anchor)
        members = partial(self._plans.members, venue.tenant, venue.id)
        rows, warnings = await self._search.ready(venue, members, hints, query.context)
        small = rows.chosen(rows.poses <= MAX_POSES)
        if len(small) < len(rows):
            large = f"{len(rows) - len(small)} floor plans have more than {MAX_POSES} grid poses"
            if not small:
                raise VenueUnsearchableError(venue.id, len(rows), large)
            warnings = [*warnings, f"{large} and were not searched"]
        return ReadyPlans(small, hints, warnings)

    async def of_venue(
        self, venue: VenueRecord, ready: ReadyPlans, query: TrackQuery, encoded: Query, state: TrackState | None
    ) -> SessionGround:
        """Return the ground of a session in a venue: all plans, or the probable ones among many.

        Raises:
            SessionOutdatedError: a plan with a share of the belief was replaced.
            LaLaLocError: see `VenueSearch.searched`.
        """
        by_plan = {} if state is None else state.by_plan
        if not by_plan.keys() <= {row.revision_id for row in ready.rows}:
            raise SessionOutdatedError(query.session_id, f"a floor plan of venue '{venue.id}' was replaced")
        levels = [row.level for row in ready.rows]
        compute = partial(self._localiser.compute, query.context)
        searched = await self._search.searched(
            venue,
            ready.rows,
            [encoded],
            form=query.document,
            hints=ready.hints,
            warnings=ready.warnings,
            context=query.context,
            compute=compute,
            favour=partial(_favour, by_plan, levels),
        )
        anchors = [record.plan.anchor_within(venue.anchor) for record in searched.records]
        return await compute(partial(self._levels, searched, anchors, levels))

    def _levels(
        self, searched: SearchedPlans, anchors: Sequence[Anchor | None], levels: Sequence[float]
    ) -> SessionGround:
        entries = [
            PlanOnLevel(record.plan, row.level, anchor)
            for record, row, anchor in zip(searched.records, searched.rows, anchors, strict=True)
        ]
        graphs = [self._graph(record, grid) for record, grid in zip(searched.records, searched.grids, strict=True)]
        left_out = None
        if searched.log_mass is not None:
            left_out = LeftOut(searched.area_share, searched.log_mass, np.array(searched.index))
        keys = [row.revision_id for row in searched.rows]
        ground = TrackedPlans.of_levels(searched.merged, entries, graphs, keys, levels, left_out)
        return SessionGround(
            ground, searched.records, [row.level for row in searched.rows], anchors, searched.hints, searched.warnings
        )

    def _graph(self, record: PlanRecord, grid: PoseGrid) -> WalkGraph:
        """Return the links of a plan's pose grid."""
        return self._graphs.get_or_make(
            record.revision_id, lambda: WalkGraph.of(grid.poses, grid.layouts(record.plan), grid.step_m)
        )


def _favour(by_plan: dict[str, float], levels: Sequence[float], rows: Sequence[Row[Any]]) -> Float[np.ndarray, "p"]:
    """Return the log factors by which a session prefers plans: those of its belief, and those one level from them."""
    share = np.array([by_plan.get(row.revision_id, 0.0) for row in rows])
    storey = np.searchsorted(np.unique(levels), [row.level for row in rows])
    kept = share >= _STAYS_FROM
    beside = np.isin(storey, [storey[kept] - 1, storey[kept] + 1])
    return np.where(kept, _STAYS * (1.0 + share), np.where(beside, _NEXT_LEVEL, 0.0))
