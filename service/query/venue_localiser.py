"""The query about a venue: in which of its plans was this panorama taken, and where?"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from time import monotonic
from typing import Any

import numpy as np
from jaxtyping import Float
from sqlalchemy import Row

from lalaloc_core.conventions import heading_from_degrees
from lalaloc_core.errors import InvalidPoseError
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.hints import Hints
from lalaloc_core.localise.pipeline import Localisation, LocaliseConfig, localise_steps
from lalaloc_core.localise.poses import Candidate, PoseGrid, Query
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from lalaloc_core.localise.venue.prototypes import share_searched
from service.errors import NoPlanNearbyError, VenueNotReadyError, VenueUnsearchableError
from service.grids import check_height_m
from service.http.admission_control import Slots
from service.query.answers import Place, compose, heading_warnings
from service.query.decoding import Decoder
from service.query.geopose import anchor_of
from service.query.heading import known_heading
from service.query.localiser import Localiser
from service.query.panorama_query import PanoramaQuery, QueryContext
from service.query.venue_hints import VenueHints
from service.query.venue_plans import VenuePlans, not_excluded, venue_height
from service.schemas import EarthPoint, LocaliseAnswer, LocaliseForm, PlanProbability
from service.settings import Settings
from service.storage.records import PlanRecord, VenueRecord

# The right one of many plans is often not the first by its grid, so more candidates than in a single plan are refined.
VENUE_CONFIG = LocaliseConfig(by_probability=True, profile_candidates=32, profile_candidates_turned=48)
# How often a venue is looked at none of whose plans is ready.
_POLL_INTERVAL_S = 0.25
# Tells the plans that are asked about, as they are at the moment.
Members = Callable[[], Awaitable[Sequence[Row[Any]]]]


@dataclass(frozen=True, eq=False)
class _Searched:
    """The plans that are searched in full, and how probable those chosen and those left out seemed before.

    Attributes:
        rows: as `Venues.searched` tells them.
        log_mass: of all plans that could be asked about; None where all of them are searched.
        index: which of those the searched ones are.
        warnings: what was left out.
        anchor: of the venue.
        hints: about the plans as they lie side by side.
    """

    rows: Sequence[Row[Any]]
    records: Sequence[PlanRecord]
    merged: MergedPlans
    log_mass: Float[np.ndarray, "p"] | None
    index: Sequence[int]
    warnings: list[str]
    anchor: Anchor | None
    hints: Hints

    def place(self, candidate: Candidate) -> Place:
        """Where a candidate is."""
        number, own = self.merged.in_own_plan(candidate)
        record = self.records[number]
        anchor, level = anchor_of(record.plan, self.anchor), self.rows[number].level
        return Place(record.id, record.revision_id, record.plan, own, anchor, level)

    def shares(self, found: Localisation) -> tuple[float, Float[np.ndarray, "m"]]:
        """How probable it is that the plan is among those searched, and each of these, given that it is."""
        probability = self.merged.by_plan(found.posterior.pose)
        if self.log_mass is None:
            return 1.0, probability
        return share_searched(self.log_mass, np.array(self.index), probability), probability


class VenueLocaliser:
    """Answers queries about venues, on the threads and worker processes of queries about single plans."""

    def __init__(
        self,
        *,
        settings: Settings,
        bundle: Bundle,
        encoders: Encoders,
        plans: VenuePlans,
        localiser: Localiser,
        decoder: Decoder,
        queries: Slots,
    ) -> None:
        self._settings = settings
        self._bundle = bundle
        self._encoders = encoders
        self._plans = plans
        self._localiser = localiser
        self._decoder = decoder
        self._queries = queries

    async def answer(self, venue: VenueRecord, query: PanoramaQuery) -> LocaliseAnswer:
        """Localise an encoded panorama in the plans of a venue.

        Raises:
            VenueUnsearchableError: the venue has no plan that is ready or will be.
            VenueNotReadyError: none of its plans was ready by the deadline.
            LaLaLocError: see `Localiser.answer`.
        """
        return await self._answer(venue, query, partial(self._plans.members, venue.id))

    async def check_hints(self, venue: VenueRecord, form: LocaliseForm) -> None:
        """Raises:
        InvalidHintError: what the form says of the place cannot be of the venue.
        """
        VenueHints.of(form, venue.anchor).check(await self._plans.members(venue.id))

    async def answer_near(
        self, tenant: str, place: EarthPoint, within_m: float, query: PanoramaQuery
    ) -> LocaliseAnswer:
        """As `answer`, in all plans of a tenant with an anchor that lie so near a place on Earth.

        Raises:
            NoPlanNearbyError: there are none.
            LaLaLocError: see `answer`.
        """
        members = await self._plans.near(tenant, place, within_m)
        if not members:
            raise NoPlanNearbyError(str(place), within_m)
        now = datetime.now(UTC)
        of_place = VenueRecord(
            id=f"near {place}",
            tenant=tenant,
            revision_id="",
            revision=1,
            name="",
            anchor=None,
            plans=len(members),
            created_at=now,
            updated_at=now,
        )
        return await self._answer(of_place, query, partial(self._plans.near, tenant, place, within_m))

    async def _answer(self, venue: VenueRecord, query: PanoramaQuery, members: Members) -> LocaliseAnswer:
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return await self._answer_in_slot(venue, query, members)

    async def _answer_in_slot(self, venue: VenueRecord, query: PanoramaQuery, members: Members) -> LocaliseAnswer:
        form, context, clock = query.form, query.context, query.context.clock
        hints = VenueHints.of(form, venue.anchor)
        with clock.stage("decode"):
            panorama = await self._decoder.decode(query.content, context.deadline, context.client)
        north = None if venue.anchor is None else heading_from_degrees(venue.anchor.north_deg)
        known = known_heading(form, north, panorama, self._settings.panoramas.compass_tolerance_deg)
        with clock.stage("wait"):
            ready, warnings = await self._ready(venue, members, hints, context)
        height = venue_height(form, ready)
        compute = partial(self._localiser.compute, context)
        encoded = (await compute(lambda: self._localiser.encode([panorama], [known], height, clock)))[0]
        with clock.stage("shortlist"):
            searched = await self._searched(
                venue, ready, encoded, form=form, hints=hints, warnings=warnings, compute=compute
            )
        merged = searched.merged
        steps = localise_steps(
            merged.plan,
            merged.grid,
            self._encoders,
            encoded,
            refine=form.refine,
            top_k=form.top_k,
            config=VENUE_CONFIG,
            clock=clock,
            hints=searched.hints,
        )
        found = await self._localiser.finished(steps, context)
        timings_ms = self._localiser.observe(context, found.stage)
        warnings = [
            *heading_warnings(found, known),
            *hints.warnings(searched.hints, found, searched.rows, merged),
            *searched.warnings,
        ]
        share, probability = searched.shares(found)
        answer = compose(
            found,
            locate=searched.place,
            known=known,
            warnings=warnings,
            timings_ms=timings_ms,
            bundle=self._bundle,
            share=share,
        )
        plans = self._plan_probabilities(searched.rows, found, share, probability)
        return answer.model_copy(update={"venue_id": venue.id, "plans": plans[: form.top_k]})

    async def _ready(
        self, venue: VenueRecord, tell: Members, hints: VenueHints, context: QueryContext
    ) -> tuple[Sequence[Row[Any]], list[str]]:
        """The plans that can be asked about, waited for while there is none, and what is to be said of the others."""
        begin = monotonic()
        while True:
            members = await tell()
            if members:
                hints.check(members)
            ready = [row for row in members if row.grid_id is not None]
            failed = [row for row in members if row.grid_id is None and row.failure is not None]
            if ready:
                break
            if len(failed) == len(members):
                raise VenueUnsearchableError(venue.id, len(members))
            if context.left_s <= _POLL_INTERVAL_S:
                raise VenueNotReadyError(venue.id, len(members), monotonic() - begin)
            with self._queries.released(context.client):
                await asyncio.sleep(_POLL_INTERVAL_S)
        waiting = len(members) - len(ready) - len(failed)
        warnings = []
        if waiting:
            warnings.append(f"{waiting} of the venue's {len(members)} floor plans are preparing and were not searched")
        if failed:
            warnings.append(f"{len(failed)} of the venue's {len(members)} floor plans failed and were not searched")
        return ready, warnings

    async def _searched(
        self,
        venue: VenueRecord,
        ready: Sequence[Row[Any]],
        query: Query,
        *,
        form: LocaliseForm,
        hints: VenueHints,
        warnings: list[str],
        compute: Callable[..., Any],
    ) -> _Searched:
        """The plans that are searched in full: all of few, the most probable ones of many."""
        rows, log_mass, index = ready, None, list(range(len(ready)))
        shares, warnings = hints.shares(ready), [*warnings, *hints.unplaced(ready)]
        if query.profile is not None and self._plans.needs_choice(ready, query):
            possible = not_excluded(ready, hints.log_prior(ready, shares))
            known, plan_index = await self._plans.index(possible, compute)
            weights, log_prior = self._encoders.manifest.evidence, hints.log_prior(known, shares)
            chosen = await compute(partial(self._plans.choose, known, plan_index, query, weights, log_prior))
            rows, log_mass, index = chosen.members, chosen.log_mass, chosen.index.tolist()
            if hints.rooms:
                told = f"rooms was looked for in the {len(rows)} most probable ones of {len(ready)} floor plans"
                warnings.append(told)
        loaded = await self._plans.load(venue.tenant, rows)
        kept = [one for one in loaded if _may_stand(one[1], form)]
        if len(kept) < len(loaded):
            left_out = len(loaded) - len(kept)
            warnings = [*warnings, f"{left_out} floor plans have ceilings below camera_height_m and were not searched"]
        if not kept:
            if loaded:
                check_height_m(loaded[0][1], query.camera_height.height_m)
            raise VenueNotReadyError(venue.id, venue.plans, 0.0)
        place = {row.plan_id: number for row, number in zip(rows, index, strict=True)}
        merged = await compute(partial(_laid_out, kept, query))
        searched_rows, plans = [row for row, _, _ in kept], [record.plan for _, record, _ in kept]
        return _Searched(
            rows=searched_rows,
            records=[record for _, record, _ in kept],
            merged=merged,
            log_mass=log_mass,
            index=[place[row.plan_id] for row, _, _ in kept],
            warnings=warnings,
            anchor=venue.anchor,
            hints=await compute(
                partial(hints.among, searched_rows, plans, merged, shares, partly=log_mass is not None)
            ),
        )

    def _plan_probabilities(
        self, rows: Sequence[Row[Any]], found: Localisation, share: float, probability: Float[np.ndarray, "m"]
    ) -> list[PlanProbability]:
        """The plans that were searched, the most probable first.

        Args:
            share, probability: see `_Searched.shares`.
        """
        model = self._bundle.manifest.confidence
        fits = None if model is None else found.fit_probability(model)
        return [
            PlanProbability(
                floorplan_id=row.plan_id,
                level=row.level,
                name=row.name,
                probability=None if fits is None else min(fits * share * of_plan, 1.0),
            )
            for of_plan, row in sorted(zip(probability.tolist(), rows, strict=True), key=lambda one: -one[0])
        ]


def _may_stand(record: PlanRecord, form: LocaliseForm) -> bool:
    """Whether the camera height of a request is possible in a plan."""
    if form.camera_height_m is None:
        return True
    try:
        check_height_m(record, form.camera_height_m)
    except InvalidPoseError:
        return False
    return True


def _laid_out(loaded: Sequence[tuple[Row[Any], PlanRecord, PoseGrid]], query: Query) -> MergedPlans:
    plans, grids = [record.plan for _, record, _ in loaded], [grid for _, _, grid in loaded]
    return MergedPlans.of(plans, grids, query.camera_height.height_m)
