"""Search of a venue: wait for its plans, choose those to search in full, and lay them side by side."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from functools import partial
from time import monotonic
from typing import Any

import numpy as np
from jaxtyping import Float
from sqlalchemy import Row

from lalaloc_core.errors import InvalidPoseError
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import Candidate, Hints, Query
from lalaloc_core.localise.search.pipeline import Localisation
from lalaloc_core.localise.venue.merged_plans import GAP_M, MergedPlans
from lalaloc_core.localise.venue.prototypes import share_searched
from service.capacity.admission_control import Slots
from service.errors import VenueNotReadyError, VenueUnsearchableError
from service.grids import check_height_m
from service.query.answers import Place
from service.query.queries import QueryContext
from service.schemas.query_fields import CameraFields
from service.storage.records import PlanRecord, VenueRecord
from service.venues.plan_indices import IndexSource
from service.venues.plan_list import PlanList
from service.venues.venue_hints import VenueHints
from service.venues.venue_plans import VenuePlans, not_excluded

# Interval (s) of polling while no plan of a venue is ready.
_POLL_INTERVAL_S = 0.25
# Function that reads the current rows of the plans to search.
ReadPlans = Callable[[], Awaitable[PlanList]]
# Function that returns a log factor for each row of a plan.
Favour = Callable[[Sequence[Row[Any]]], Float[np.ndarray, "p"]]


@dataclass(frozen=True, eq=False)
class SearchedPlans:
    """Plans to search in full, and the prior masses of all plans that are ready.

    Attributes:
        rows: rows of the searched plans, see `Venues.searchable_plans`.
        records: the searched plans.
        grids: their pose grids.
        merged: the searched plans side by side.
        log_mass: (p,) log masses of all plans that are ready; None if all of them are searched.
        area_share: share of their floor area that the searched plans have.
        index: indices of the searched plans among the plans that are ready.
        warnings: warnings about plans that are not searched.
        anchor: anchor of the venue.
        hints: hints about the merged plans.
    """

    rows: Sequence[Row[Any]]
    records: Sequence[PlanRecord]
    grids: Sequence[PoseGrid]
    merged: MergedPlans
    log_mass: Float[np.ndarray, "p"] | None
    area_share: float
    index: Sequence[int]
    warnings: list[str]
    anchor: Anchor | None
    hints: Hints

    def place(self, candidate: Candidate) -> Place:
        """Return the plan of a candidate, and the candidate in that plan's frame."""
        index, own_candidate = self.merged.in_own_plan(candidate)
        record = self.records[index]
        anchor, level = record.plan.anchor_within(self.anchor), self.rows[index].level
        return Place(record.id, record.revision_id, record.plan, own_candidate, anchor, level)

    def shares(self, found: Localisation) -> tuple[float, Float[np.ndarray, "m"]]:
        """Return the probability that the camera is in a searched plan, and (m,) each plan's share of it."""
        probability = self.merged.by_plan(found.posterior.pose)
        if self.log_mass is None:
            return 1.0, probability
        return share_searched(self.log_mass, np.array(self.index), probability), probability


class VenueSearch:
    """Chooser of the plans of venues that a photograph is compared with."""

    def __init__(self, *, plans: VenuePlans, indices: IndexSource, encoder: PhotographEncoder, queries: Slots) -> None:
        self._plans = plans
        self._indices = indices
        self._encoder = encoder
        self._queries = queries

    async def ready(
        self, venue: VenueRecord, read_plans: ReadPlans, hints: VenueHints, context: QueryContext
    ) -> tuple[PlanList, list[str]]:
        """Wait for a plan to be ready; return the plans that are ready, and warnings about the others.

        Raises:
            InvalidHintError: a hint does not match the venue.
            VenueUnsearchableError: the venue has no plans, or all of them failed.
            VenueNotReadyError: no plan of the venue was ready by the deadline.
        """
        begin = monotonic()
        while True:
            members = await read_plans()
            if members:
                hints.check(members)
            ready, failed = members.ready, members.failed
            if ready:
                break
            if failed == len(members):
                raise VenueUnsearchableError(venue.id, len(members))
            if context.left_s <= _POLL_INTERVAL_S:
                raise VenueNotReadyError(venue.id, len(members), monotonic() - begin)
            with self._queries.released(context.client):
                await asyncio.sleep(_POLL_INTERVAL_S)
        waiting = len(members) - len(ready) - failed
        warnings = []
        if waiting:
            warnings.append(f"{waiting} of the venue's {len(members)} floor plans are preparing and were not searched")
        if failed:
            warnings.append(f"{failed} of the venue's {len(members)} floor plans failed and were not searched")
        return ready, warnings

    async def searched(
        self,
        venue: VenueRecord,
        ready: PlanList,
        queries: Sequence[Query],
        *,
        form: CameraFields,
        hints: VenueHints,
        warnings: list[str],
        context: QueryContext,
        compute: Callable[..., Any],
        favour: Favour | None = None,
        gap_m: float = GAP_M,
    ) -> SearchedPlans:
        """Choose the plans to search in full: all of them if they are few, otherwise the most probable ones.

        Args:
            venue: the venue.
            ready: rows of its plans that are ready.
            queries: the encoded photographs, each of which chooses plans.
            form: the stated camera height.
            hints: the hints.
            warnings: warnings so far.
            context: context of the query.
            compute: runs CPU work.
            favour: log factors by which plans are preferred in the choice alone.
            gap_m: distance between the plans in the merged frame.

        Raises:
            InvalidHintError: strict hints exclude every plan, or no searched plan has a room.
            InvalidPoseError: the camera height is above all ceilings.
            VenueNotReadyError: all plans were deleted meanwhile.
            DeadlineExceededError: the deadline passed.
        """
        query = max(queries, key=lambda one: len(one.roll))
        rows, log_mass, index = ready, None, list(range(len(ready)))
        shares, warnings = hints.shares(ready), [*warnings, *hints.unplaced_warnings(ready)]
        if query.profile is not None and self._plans.needs_choice(ready, query):
            possible = not_excluded(ready, hints.log_prior(ready, shares))
            whole_venue = venue.id if possible is ready else None
            # Another query may be making the index, in the time that it has itself.
            async with context.bounded():
                known, plan_index = await self._indices.index(venue.tenant, possible, compute, venue_id=whole_venue)
            manifest = self._encoder.manifest
            choosing = [(one, manifest.evidence_for(view=one.is_view)) for one in queries]
            log_prior = hints.log_prior(known, shares)
            preferred = None if favour is None else favour(known)
            chosen = await compute(partial(self._plans.choose, known, plan_index, choosing, log_prior, preferred))
            rows, log_mass, index = chosen.members, chosen.log_mass, chosen.index.tolist()
            if hints.rooms:
                warnings.append(
                    f"the hint rooms was applied to the {len(rows)} most probable of {len(ready)} floor plans"
                )
        loaded = await self._plans.load(venue.tenant, rows)
        kept = [entry for entry in loaded if _height_is_possible(entry[1], form)]
        if len(kept) < len(loaded):
            left_out = len(loaded) - len(kept)
            warnings = [*warnings, f"{left_out} floor plans have ceilings below camera_height_m and were not searched"]
        if not kept:
            if loaded:
                check_height_m(loaded[0][1], query.camera_height.height_m)
            raise VenueNotReadyError(venue.id, venue.plans, 0.0)
        index_of = {row.plan_id: position for row, position in zip(rows, index, strict=True)}
        searched_rows, records = [row for row, _, _ in kept], [record for _, record, _ in kept]
        plans, grids = [record.plan for record in records], [grid for _, _, grid in kept]
        merged = await compute(partial(MergedPlans.of, plans, grids, query.camera_height.height_m, gap_m))
        return SearchedPlans(
            rows=searched_rows,
            records=records,
            grids=grids,
            merged=merged,
            log_mass=log_mass,
            area_share=sum(row.area_m2 for row in searched_rows) / float(ready.area_m2.sum()),
            index=[index_of[row.plan_id] for row in searched_rows],
            warnings=warnings,
            anchor=venue.anchor,
            hints=await compute(
                partial(hints.in_merged_plans, searched_rows, plans, merged, shares, partly=log_mass is not None)
            ),
        )


def _height_is_possible(record: PlanRecord, form: CameraFields) -> bool:
    if form.camera_height_m is None:
        return True
    try:
        check_height_m(record, form.camera_height_m)
    except InvalidPoseError:
        return False
    return True
