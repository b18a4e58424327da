"""Localisation in a venue: choose the plans, lay them side by side, search them as one plan."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from time import monotonic
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from sqlalchemy import Row

from lalaloc_core.conventions import heading_from_degrees
from lalaloc_core.errors import InvalidPoseError
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.hints import Hints
from lalaloc_core.localise.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.pipeline import Localisation, LocaliseConfig, localise_steps
from lalaloc_core.localise.poses import Candidate, Query
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from lalaloc_core.localise.venue.prototypes import share_searched
from service.errors import NoPlanNearbyError, VenueNotReadyError, VenueUnsearchableError
from service.grids import check_height_m
from service.http.admission_control import Slots
from service.query.answers import Place, compose_answer
from service.query.decoding import Decoder
from service.query.geopose import plan_anchor
from service.query.localiser import Localiser
from service.query.photographs import Photograph, encode, view_answer
from service.query.queries import PanoramaQuery, QueryContext
from service.query.stated_camera import known_heading
from service.query.venue_hints import VenueHints
from service.query.venue_plans import VenuePlans, not_excluded, venue_height
from service.schemas import EarthPoint, LocaliseAnswer, LocaliseForm, PlanProbability
from service.settings import Settings
from service.storage.records import PlanRecord, VenueRecord

# Among many plans the right one often ranks low before refinement, so refine more candidates than in a single plan.
VENUE_CONFIG = LocaliseConfig(by_probability=True, profile_candidates=32, profile_candidates_turned=48)
# Interval (s) of polling while no plan of a venue is ready.
_POLL_INTERVAL_S = 0.25
# Plans whose probabilities differ by less than this are a tie.
_TIED = 1e-9
# Function that reads the current rows of the plans to search.
ReadPlans = Callable[[], Awaitable[Sequence[Row[Any]]]]


@dataclass(frozen=True, eq=False)
class _Searched:
    """Plans to search in full, and the prior masses of all plans that are ready.

    Attributes:
        rows: rows of the searched plans, see `Venues.searchable_plans`.
        records: the searched plans.
        merged: the searched plans side by side.
        log_mass: (p,) log masses of all plans that are ready; None if all of them are searched.
        index: indices of the searched plans among the plans that are ready.
        warnings: warnings about plans that are not searched.
        anchor: anchor of the venue.
        hints: hints about the merged plans.
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
        """Return the plan of a candidate, and the candidate in that plan's frame."""
        index, own_candidate = self.merged.in_own_plan(candidate)
        record = self.records[index]
        anchor, level = plan_anchor(record.plan, self.anchor), self.rows[index].level
        return Place(record.id, record.revision_id, record.plan, own_candidate, anchor, level)

    def shares(self, found: Localisation) -> tuple[float, Float[np.ndarray, "m"]]:
        """Return the probability that the camera is in a searched plan, and (m,) each plan's share of it."""
        probability = self.merged.by_plan(found.posterior.pose)
        if self.log_mass is None:
            return 1.0, probability
        return share_searched(self.log_mass, np.array(self.index), probability), probability


class VenueLocaliser:
    """Answers queries about venues, on the threads and worker processes of `Localiser`."""

    def __init__(
        self,
        *,
        settings: Settings,
        bundle: Bundle,
        encoder: PhotographEncoder,
        plans: VenuePlans,
        localiser: Localiser,
        decoder: Decoder,
        queries: Slots,
    ) -> None:
        self._settings = settings
        self._bundle = bundle
        self._encoder = encoder
        self._plans = plans
        self._localiser = localiser
        self._decoder = decoder
        self._queries = queries

    async def localise(self, venue: VenueRecord, query: PanoramaQuery) -> LocaliseAnswer:
        """Localise a photograph in the plans of a venue.

        Raises:
            VenueUnsearchableError: the venue has no plans, or all of them failed.
            VenueNotReadyError: no plan of the venue was ready by the deadline.
            LaLaLocError: see `Localiser.localise`.
        """
        return await self._localise(venue, query, partial(self._plans.members, venue.tenant, venue.id))

    async def localise_near(
        self, tenant: str, place: EarthPoint, within_m: float, query: PanoramaQuery
    ) -> LocaliseAnswer:
        """Localise a photograph in the tenant's anchored plans within `within_m` of a place on Earth.

        Raises:
            NoPlanNearbyError: no such plan exists.
            LaLaLocError: see `localise`.
        """
        rows = await self._plans.near(tenant, place, within_m)
        if not rows:
            raise NoPlanNearbyError(str(place), within_m)
        now = datetime.now(UTC)
        venue = VenueRecord(
            id=f"near {place}",
            tenant=tenant,
            revision_id="",
            revision=1,
            name="",
            anchor=None,
            plans=len(rows),
            created_at=now,
            updated_at=now,
        )
        return await self._localise(venue, query, partial(self._plans.near, tenant, place, within_m))

    async def check_hints(self, venue: VenueRecord, form: LocaliseForm) -> None:
        """Check the form's hints against the venue's plans.

        Raises:
            InvalidHintError: a hint does not match the venue.
        """
        VenueHints.from_form(form, venue.anchor).check(await self._plans.members(venue.tenant, venue.id))

    async def _localise(self, venue: VenueRecord, query: PanoramaQuery, read_plans: ReadPlans) -> LocaliseAnswer:
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return await self._localise_in_slot(venue, query, read_plans)

    async def _localise_in_slot(
        self, venue: VenueRecord, query: PanoramaQuery, read_plans: ReadPlans
    ) -> LocaliseAnswer:
        form, context, clock = query.form, query.context, query.context.clock
        hints = VenueHints.from_form(form, venue.anchor)
        with clock.stage("decode"):
            view = await self._decoder.decode(query.content, form.stated_view, context.deadline, context.client)
        north = None if venue.anchor is None else heading_from_degrees(venue.anchor.north_deg)
        known = known_heading(form, north, view, self._settings.panoramas.compass_tolerance_deg)
        with clock.stage("wait"):
            ready, warnings = await self._ready(venue, read_plans, hints, context)
        height = venue_height(form, ready)
        compute = partial(self._localiser.compute, context)
        photograph = Photograph(view)
        encoded = (await compute(partial(encode, self._encoder, [photograph], [known], height, clock)))[0]
        with clock.stage("shortlist"):
            searched = await self._searched(
                venue, ready, encoded, form=form, hints=hints, warnings=warnings, compute=compute
            )
        steps = localise_steps(
            searched.merged.plan,
            searched.merged.grid,
            self._encoder.networks,
            encoded,
            refine=form.refine,
            top_k=form.top_k,
            config=VENUE_CONFIG,
            clock=clock,
            hints=searched.hints,
        )
        found = await self._localiser.run_search(steps, context)
        timings_ms = self._localiser.observe(context, found.stage)
        hint_warnings = hints.warnings(searched.hints, found, searched.rows, searched.merged)
        share, probability = searched.shares(found)
        answer = compose_answer(
            found,
            locate=searched.place,
            known=known,
            warnings=[*hint_warnings, *searched.warnings],
            timings_ms=timings_ms,
            bundle=self._bundle,
            share=share,
            view=partial(view_answer, photograph, plan=searched.merged.plan, grid=searched.merged.grid),
        )
        plans = self._plan_probabilities(searched, found, share, probability)
        return answer.model_copy(update={"venue_id": venue.id, "plans": plans[: form.top_k]})

    async def _ready(
        self, venue: VenueRecord, read_plans: ReadPlans, hints: VenueHints, context: QueryContext
    ) -> tuple[Sequence[Row[Any]], list[str]]:
        """Wait for a plan to be ready; return the plans that are ready, and warnings about the others."""
        begin = monotonic()
        while True:
            members = await read_plans()
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
        """Choose the plans to search in full: all of them if they are few, otherwise the most probable ones."""
        rows, log_mass, index = ready, None, list(range(len(ready)))
        shares, warnings = hints.shares(ready), [*warnings, *hints.unplaced_warnings(ready)]
        if query.profile is not None and self._plans.needs_choice(ready, query):
            possible = not_excluded(ready, hints.log_prior(ready, shares))
            known, plan_index = await self._plans.index(venue.tenant, possible, compute)
            weights = self._encoder.networks.manifest.evidence_for(view=query.is_view)
            log_prior = hints.log_prior(known, shares)
            chosen = await compute(partial(self._plans.choose, known, plan_index, query, weights, log_prior))
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
        merged = await compute(partial(MergedPlans.of, plans, grids, query.camera_height.height_m))
        return _Searched(
            rows=searched_rows,
            records=records,
            merged=merged,
            log_mass=log_mass,
            index=[index_of[row.plan_id] for row in searched_rows],
            warnings=warnings,
            anchor=venue.anchor,
            hints=await compute(
                partial(hints.in_merged_plans, searched_rows, plans, merged, shares, partly=log_mass is not None)
            ),
        )

    def _plan_probabilities(
        self, searched: _Searched, found: Localisation, share: float, probability: Float[np.ndarray, "m"]
    ) -> list[PlanProbability]:
        """Return the searched plans, most probable first; `_Searched.shares` gives `share` and `probability`."""
        confidence = found.confidence(self._bundle.manifest.confidence_for(view=found.query.is_view), share)
        return [
            PlanProbability(
                floorplan_id=searched.rows[number].plan_id,
                level=searched.rows[number].level,
                name=searched.rows[number].name,
                probability=None if confidence is None else min(confidence.fit * float(probability[number]), 1.0),
            )
            for number in _by_probability(probability, np.array(searched.index))
        ]


def _by_probability(probability: Float[np.ndarray, "m"], index: Int[np.ndarray, "m"]) -> list[int]:
    """Return the order of falling probability; copies of a plan, equal up to rounding, are ordered by `index`."""
    order = np.argsort(-probability, kind="stable")
    tie = np.concatenate([[0], np.cumsum(-np.diff(probability[order]) >= _TIED)])
    return order[np.lexsort((index[order], tie))].tolist()


def _height_is_possible(record: PlanRecord, form: LocaliseForm) -> bool:
    if form.camera_height_m is None:
        return True
    try:
        check_height_m(record, form.camera_height_m)
    except InvalidPoseError:
        return False
    return True
