"""Search of a venue: wait for its plans, choose those to search in full, and load them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from time import monotonic
from typing import Any

import numpy as np
from jaxtyping import Float
from sqlalchemy import Row

from lalaloc_core.errors import InvalidPoseError
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import HintName, Query
from service.capacity.admission_control import Slots
from service.errors import VenueNotReadyError, VenueUnsearchableError
from service.grids import check_height_m
from service.query_context import QueryContext
from service.schemas.query_fields import HeightFields
from service.storage.records import PlanRecord
from service.venues.plan_indices import IndexSource
from service.venues.plan_list import PlanList
from service.venues.venue_hints import VenueHints
from service.venues.venue_plans import ChosenPlans, VenuePlans, possible_plans

# Interval (s) of polling while no plan of a venue is ready.
_POLL_INTERVAL_S = 0.25
# Function that returns a log factor for each row of a plan.
Favour = Callable[[Sequence[Row[Any]]], Float[np.ndarray, "p"]]


@dataclass(frozen=True, eq=False)
class LoadedPlans:
    """Plans of a venue that are searched in full, and the prior masses of all plans that are ready.

    Attributes:
        rows: rows of the searched plans, see `Venues.searchable_plans`.
        log_mass: (p,) log masses of all plans that are ready; None if all of them are searched.
        area_share: share of their floor area that the searched plans have.
        numbers: numbers of the searched plans among the plans that are ready.
        hint_shares: see `VenueHints.shares`.
        warnings: warnings about plans that are not searched.
    """

    rows: Sequence[Row[Any]]
    records: Sequence[PlanRecord]
    grids: Sequence[PoseGrid]
    log_mass: Float[np.ndarray, "p"] | None
    area_share: float
    numbers: Sequence[int]
    hint_shares: Mapping[HintName, float]
    warnings: list[str]


class VenueSearch:
    """Reader of the plans of venues that a photograph is compared with."""

    def __init__(self, *, plans: VenuePlans, indices: IndexSource, encoder: PhotographEncoder, queries: Slots) -> None:
        self._plans, self._indices, self._encoder, self._queries = plans, indices, encoder, queries

    async def ready(
        self, tenant: str, venue_id: str, hints: VenueHints, context: QueryContext
    ) -> tuple[PlanList, list[str]]:
        """Wait for a plan to be ready; return the plans that are ready, and warnings about the others."""
        begin = monotonic()
        while True:
            members = await self._plans.members(tenant, venue_id)
            if members:
                hints.check(members)
            ready, failed = members.ready, members.failed
            if ready:
                break
            if failed == len(members):
                reason = f"all of its {failed} floor plans failed" if failed else "it has no floor plans"
                raise VenueUnsearchableError(venue_id, reason)
            if context.left_s <= _POLL_INTERVAL_S:
                raise VenueNotReadyError(venue_id, len(members), monotonic() - begin)
            with self._queries.released(context.client):
                await asyncio.sleep(_POLL_INTERVAL_S)
        waiting = len(members) - len(ready) - failed
        warnings = []
        if waiting:
            warnings.append(f"{waiting} of the venue's {len(members)} floor plans are preparing and were not searched")
        if failed:
            warnings.append(f"{failed} of the venue's {len(members)} floor plans failed and were not searched")
        return ready, warnings

    async def load(
        self,
        tenant: str,
        venue_id: str,
        ready: PlanList,
        queries: Sequence[Query],
        *,
        form: HeightFields,
        hints: VenueHints,
        warnings: list[str],
        context: QueryContext,
        compute: Callable[..., Any],
        favour: Favour | None = None,
    ) -> LoadedPlans:
        """Choose and load the plans to search in full: all of them if they are few, else the most probable ones.

        Each of the queries chooses plans; `favour` returns log factors by which plans are preferred in the choice
        alone.
        """
        query = max(queries, key=lambda encoded: len(encoded.roll))
        shares, warnings = hints.shares(ready), [*warnings, *hints.unplaced_warnings(ready)]
        chosen = ChosenPlans(ready, None, np.arange(len(ready)))
        if query.profile is not None and self._plans.needs_choice(ready, query):
            prior = partial(hints.log_prior, shares=shares)
            # Another query may be making the index, in the time that it has itself.
            async with context.bounded():
                chosen = await self._choose(tenant, venue_id, ready, queries, prior, compute, favour)
            if hints.rooms:
                warnings.append(
                    f"the hint rooms was applied to the {len(chosen.members)} most probable of {len(ready)} floor plans"
                )
        loaded = await self._plans.load(tenant, chosen.members)
        kept = [entry for entry in loaded if _height_is_possible(entry[1], form)]
        if len(kept) < len(loaded):
            left_out = len(loaded) - len(kept)
            warnings.append(f"{left_out} floor plans have ceilings below camera_height_m and were not searched")
        if not kept:
            if loaded:
                check_height_m(loaded[0][1], query.camera_height.height_m)
            raise VenueNotReadyError(venue_id, len(ready), 0.0)
        number_of = {row.plan_id: int(number) for row, number in zip(chosen.members, chosen.index, strict=True)}
        searched = [row for row, _, _ in kept]
        return LoadedPlans(
            rows=searched,
            records=[record for _, record, _ in kept],
            grids=[grid for _, _, grid in kept],
            log_mass=chosen.log_mass,
            area_share=sum(row.area_m2 for row in searched) / float(ready.area_m2.sum()),
            numbers=[number_of[row.plan_id] for row in searched],
            hint_shares=shares,
            warnings=warnings,
        )

    async def _choose(
        self,
        tenant: str,
        venue_id: str,
        ready: PlanList,
        queries: Sequence[Query],
        prior: Callable[[PlanList], Float[np.ndarray, "p"]],
        compute: Callable[..., Any],
        favour: Favour | None,
    ) -> ChosenPlans:
        """Return the most probable plans; `prior` returns their log prior by the hints."""
        possible = possible_plans(ready, prior(ready))
        whole_venue = venue_id if possible is ready else None
        known, plan_index = await self._indices.index(tenant, possible, compute, venue_id=whole_venue)
        manifest = self._encoder.manifest
        choosing = [(encoded, manifest.evidence_for(view=encoded.is_view)) for encoded in queries]
        preferred = None if favour is None else favour(known)
        return await compute(partial(self._plans.choose, known, plan_index, choosing, prior(known), preferred))


def _height_is_possible(record: PlanRecord, form: HeightFields) -> bool:
    if form.camera_height_m is None:
        return True
    try:
        check_height_m(record, form.camera_height_m)
    except InvalidPoseError:
        return False
    return True
