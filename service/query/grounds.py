"""Grounds of queries: the plan or the venue that a query is about, what is stated of it, waited for and loaded."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from functools import partial
from time import monotonic
from typing import TypeVar

import numpy as np

from lalaloc_core.conventions import heading_from_degrees
from lalaloc_core.errors import InvalidHintError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise import query
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import NO_HINTS, CameraHeight, Hints, Near, Query, rooms_named
from service.capacity.admission_control import Slots
from service.capacity.threads import BoundedReads
from service.errors import PlanFailedError, PlanNotReadyError, VenueUnsearchableError
from service.grids import GridProvider, check_height_m, grid_height_m
from service.query.executor import Executor
from service.query.ground import Ground
from service.query_context import QueryContext
from service.schemas import SessionDocument
from service.schemas.query_fields import EarthPoint, HeightFields, HintFields, PlanPoint
from service.storage.records import PlanRecord, VenueRecord
from service.venues.plan_list import PlanList
from service.venues.venue_hints import VenueHints
from service.venues.venue_plans import VenuePlans, venue_height
from service.venues.venue_search import Favour, VenueSearch

# Photographs of a sequence or an album that plans are chosen by.
_CHOOSING = 8
_Item = TypeVar("_Item")


class Grounds:
    """Finder of a query's ground, which checks what the query states, waits for plans, and loads their pose grids."""

    def __init__(
        self,
        *,
        encoder: PhotographEncoder,
        grids: GridProvider,
        queries: Slots,
        reads: BoundedReads,
        executor: Executor,
        plans: VenuePlans,
        search: VenueSearch,
    ) -> None:
        self._latents_alone = not encoder.predicts_profile
        self._grids, self._queries, self._reads = grids, queries, reads
        self._plans, self.executor, self.search = plans, executor, search

    async def site(
        self,
        where: PlanRecord | VenueRecord,
        form: HeightFields,
        hinted: HintFields | SessionDocument | None = None,
        *,
        max_poses: int | None = None,
    ) -> Site:
        """Return the site of a query; `max_poses` limits the grid poses of a plan of a venue."""
        if isinstance(where, PlanRecord):
            return PlanSite(self, where, form, hinted)
        hints = VenueHints(anchor=where.anchor) if hinted is None else VenueHints.from_form(hinted, where.anchor)
        return VenueSite(self, where, form, hints, max_poses)

    async def check(self, where: PlanRecord | VenueRecord, form: HeightFields) -> None:
        """Check what a request states about a plan or a venue."""
        if isinstance(where, PlanRecord):
            stated_height(form, where)
            if isinstance(form, HintFields | SessionDocument):
                stated_hints(form, where.plan).check(where.plan)
            return
        members = await self._plans.members(where.tenant, where.id)
        if not members:
            raise VenueUnsearchableError(where.id, "it has no floor plans")
        if isinstance(form, HintFields | SessionDocument):
            VenueHints.from_form(form, where.anchor).check(members)

    async def grid(self, record: PlanRecord, height: CameraHeight, context: QueryContext) -> PoseGrid:
        """Return the plan's pose grid for a camera height; compute it on demand and wait until the deadline."""
        with context.clock.stage("grid"):
            height_m = grid_height_m(record, height.height_m, latents_alone=self._latents_alone)
            key = self._grids.key(record.revision_id, height_m)
            grid = self._grids.cache.cached(key)
            if grid is None:
                # Not on the compute threads: a database that does not answer would block them.
                grid = await self._reads.run(record.tenant, self._grids.cache.find, key)
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


class PlanSite:
    """Stored plan that a query is about.

    Attributes:
        north: azimuth of true north (radians) in the plan; None where unknown.
    """

    def __init__(
        self, grounds: Grounds, record: PlanRecord, form: HeightFields, hinted: HintFields | SessionDocument | None
    ) -> None:
        self._grounds, self._record, self.north = grounds, record, record.plan.north
        self.height = stated_height(form, record)
        self._hints = NO_HINTS if hinted is None else stated_hints(hinted, record.plan)

    async def wait(self, context: QueryContext) -> None:
        """Check the hints."""
        if not self._hints.are_none:
            # On a compute thread, because checking many rooms is slow.
            await self._grounds.executor.compute(context, partial(self._hints.check, self._record.plan))

    async def ground(self, encoded: Sequence[Query], context: QueryContext, favour: Favour | None = None) -> Ground:
        """Wait for the pose grid; `encoded` and `favour` matter for venues alone."""
        return Ground.of_plan(self._record, await self._grounds.grid(self._record, self.height, context), self._hints)


class VenueSite:
    """Plans of a venue that a query is about.

    Attributes:
        north: azimuth of true north (radians) in the venue's frame; None where unknown.
    """

    def __init__(
        self, grounds: Grounds, where: VenueRecord, form: HeightFields, hints: VenueHints, max_poses: int | None
    ) -> None:
        self._grounds, self._where, self.id = grounds, where, where.id
        self._form, self._hints, self._max_poses = form, hints, max_poses
        self._warnings: list[str] = []
        self.north = None if where.anchor is None else heading_from_degrees(where.anchor.north_deg)
        self.ready = PlanList()

    @property
    def height(self) -> CameraHeight:
        """The stated camera height, else the one that the plans share, else an unknown one; after `wait`."""
        return venue_height(self._form, self.ready)

    async def wait(self, context: QueryContext) -> None:
        """Wait for a plan to be ready."""
        with context.clock.stage("wait"):
            search, where = self._grounds.search, self._where
            ready, warnings = await search.ready(where.tenant, where.id, self._hints, context)
        if self._max_poses is not None:
            small = ready.chosen(ready.poses <= self._max_poses)
            if len(small) < len(ready):
                large = f"{len(ready) - len(small)} floor plans have more than {self._max_poses} grid poses"
                if not small:
                    raise VenueUnsearchableError(self._where.id, large)
                ready, warnings = small, [*warnings, f"{large} and were not searched"]
        self.ready, self._warnings = ready, warnings

    async def ground(self, encoded: Sequence[Query], context: QueryContext, favour: Favour | None = None) -> Ground:
        """Choose and load the plans to search, and lay them side by side.

        `favour` returns log factors by which plans are preferred in the choice alone. See `VenueSearch.load` for the
        errors.
        """
        choosing = spread(encoded)
        with context.clock.stage("shortlist"):
            loaded = await self._grounds.search.load(
                self._where.tenant,
                self._where.id,
                self.ready,
                choosing,
                form=self._form,
                hints=self._hints,
                warnings=self._warnings,
                context=context,
                compute=partial(self._grounds.executor.compute, context),
                favour=favour,
            )
            # As `VenueSearch.load`: the photograph whose search compares most.
            height_m = max(choosing, key=lambda query: len(query.roll)).camera_height.height_m
            merge = partial(Ground.of_venue, loaded, self._hints, height_m)
            return await self._grounds.executor.compute(context, merge)


Site = PlanSite | VenueSite


def spread(photographs: Sequence[_Item]) -> list[_Item]:
    """Return photographs at even intervals, few enough to choose plans by each."""
    index = np.unique(np.linspace(0, len(photographs) - 1, _CHOOSING).round().astype(int))
    return [photographs[int(number)] for number in index]


def stated_height(form: HeightFields, record: PlanRecord) -> CameraHeight:
    """Return the camera height in the request, else the plan's, else an unknown one."""
    if form.camera_height_m is not None:
        check_height_m(record, form.camera_height_m)
    return query.stated_height(record.plan, form.camera_height_m, form.camera_height_std_m)


def stated_hints(form: HintFields | SessionDocument, plan: FloorPlan) -> Hints:
    """Return the hints of a request, before `Hints.check`."""
    near = None
    if form.near is not None and form.radius_m is not None:
        near = _near_in_plan(form.near, form.radius_m, plan)
    rooms = None if form.rooms is None else rooms_named(plan, form.rooms)
    return Hints(near=near, rooms=rooms, strict=isinstance(form, HintFields) and form.strict)


def _near_in_plan(point: PlanPoint | EarthPoint, radius_m: float, plan: FloorPlan) -> Near:
    if isinstance(point, PlanPoint):
        return Near(point.x_m, point.y_m, radius_m)
    if plan.anchor is None:
        raise InvalidHintError(
            "near", f"{point} cannot be placed, because the plan has no anchor: give x_m and y_m, or add an anchor"
        )
    ((x_m, y_m),) = plan.anchor.to_plan(np.array([[point.longitude, point.latitude]]))
    return Near(float(x_m), float(y_m), radius_m, str(point))
