"""Localisation in a venue: choose the plans, lay them side by side, search them as one plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import heading_from_degrees
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import Query
from lalaloc_core.localise.search.pipeline import Localisation, LocaliseConfig, localise_steps
from lalaloc_core.localise.sequence import Motion
from lalaloc_core.localise.venue.merged_plans import GAP_M
from service.capacity.admission_control import Slots
from service.decoding.decoder import Decoder
from service.errors import NoPlanNearbyError
from service.query.answers import compose_answer
from service.query.localiser import Localiser
from service.query.photographs import Spot, encode, view_answer
from service.query.queries import PhotographQuery, SequenceQuery
from service.query.search_steps import completed
from service.query.sequences import SequenceGround
from service.query.stated_pose import heights_of, known_heading
from service.schemas import EarthPoint, LocaliseAnswer, LocaliseForm, PlanProbability, SequenceAnswer
from service.settings import Settings
from service.storage.records import VenueRecord
from service.venues.venue_hints import VenueHints
from service.venues.venue_plans import VenuePlans, venue_height
from service.venues.venue_search import ReadPlans, SearchedPlans, VenueSearch

# Among many plans the right one often ranks low before refinement, so refine more candidates than in a single plan.
VENUE_CONFIG = LocaliseConfig(by_probability=True, profile_candidates=32, profile_candidates_turned=48)
# Plans whose probabilities differ by less than this are a tie.
_TIED = 1e-9
# Photographs of a sequence that plans are chosen by, and the deviations of a motion that are possible.
_CHOOSING, _REACH_STD = 8, 5.0


class VenueLocaliser:
    """Answers queries about venues, on the threads and worker processes of `Localiser`."""

    def __init__(
        self,
        *,
        settings: Settings,
        bundle: Bundle,
        encoder: PhotographEncoder,
        plans: VenuePlans,
        search: VenueSearch,
        localiser: Localiser,
        decoder: Decoder,
        queries: Slots,
    ) -> None:
        self._settings = settings
        self._bundle = bundle
        self._encoder = encoder
        self._plans = plans
        self._search = search
        self._localiser = localiser
        self._decoder = decoder
        self._queries = queries

    async def localise(self, venue: VenueRecord, query: PhotographQuery) -> LocaliseAnswer:
        """Localise a photograph in the plans of a venue.

        Raises:
            VenueUnsearchableError: the venue has no plans, or all of them failed.
            VenueNotReadyError: no plan of the venue was ready by the deadline.
            LaLaLocError: see `Localiser.localise`.
        """
        return await self._localise(venue, query, partial(self._plans.members, venue.tenant, venue.id))

    async def localise_sequence(self, venue: VenueRecord, query: SequenceQuery) -> SequenceAnswer:
        """Localise several photographs of one visit jointly in the plans of a venue; raises as `localise` does."""
        form, context, count = query.form, query.context, len(query.contents)
        hints = VenueHints(anchor=venue.anchor)
        read_plans = partial(self._plans.members, venue.tenant, venue.id)
        async with self._queries.wait_and_hold(context.client, context.deadline):
            # Decode first, so that an unreadable picture is refused without waiting for the plans.
            views = await self._localiser.sequences.views(query)
            with context.clock.stage("wait"):
                ready, warnings = await self._search.ready(venue, read_plans, hints, context)

            async def ground(encoded: Sequence[Query]) -> SequenceGround:
                with context.clock.stage("shortlist"):
                    searched = await self._search.searched(
                        venue,
                        ready,
                        _spread(encoded),
                        form=form,
                        hints=hints,
                        warnings=warnings,
                        context=context,
                        compute=partial(self._localiser.compute, context),
                        # Measured motions must not lead from one plan to its neighbour.
                        gap_m=GAP_M + max(map(_reach_m, form.steps(count))),
                    )
                return SequenceGround(
                    plan=searched.merged.plan,
                    grid=searched.merged.grid,
                    locate=searched.place,
                    share=lambda found: searched.shares(found)[0],
                    warnings=searched.warnings,
                    turn_config=replace(VENUE_CONFIG, vdr_candidates=0),
                )

            north = None if venue.anchor is None else heading_from_degrees(venue.anchor.north_deg)
            heights = heights_of(form, venue_height(form, ready), count)
            answer = await self._localiser.sequences.answer(query, views, heights, north, ground)
        return answer.model_copy(update={"venue_id": venue.id})

    async def localise_near(
        self, tenant: str, place: EarthPoint, within_m: float, query: PhotographQuery
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

    async def _localise(self, venue: VenueRecord, query: PhotographQuery, read_plans: ReadPlans) -> LocaliseAnswer:
        async with self._queries.wait_and_hold(query.context.client, query.context.deadline):
            return await self._localise_in_slot(venue, query, read_plans)

    async def _localise_in_slot(
        self, venue: VenueRecord, query: PhotographQuery, read_plans: ReadPlans
    ) -> LocaliseAnswer:
        form, context, clock = query.form, query.context, query.context.clock
        hints = VenueHints.from_form(form, venue.anchor)
        with clock.stage("decode"):
            view = await self._decoder.decode(query.content, form.stated_camera, context.deadline, context.client)
        north = None if venue.anchor is None else heading_from_degrees(venue.anchor.north_deg)
        known = known_heading(form, north, view, self._settings.photographs.compass_tolerance_deg)
        with clock.stage("wait"):
            ready, warnings = await self._search.ready(venue, read_plans, hints, context)
        height = venue_height(form, ready)
        compute = partial(self._localiser.compute, context)
        photograph = Spot(view)
        encoded = (await compute(partial(encode, self._encoder, [photograph], [known], height, clock)))[0]
        with clock.stage("shortlist"):
            searched = await self._search.searched(
                venue, ready, [encoded], form=form, hints=hints, warnings=warnings, context=context, compute=compute
            )
        steps = localise_steps(
            searched.merged.plan,
            searched.merged.grid,
            self._encoder,
            encoded,
            refine=form.refine,
            top_k=form.top_k,
            config=VENUE_CONFIG,
            clock=clock,
            hints=searched.hints,
        )

        def compose(found: Localisation) -> LocaliseAnswer:
            hint_warnings = hints.warnings(searched.hints, found, searched.rows, searched.merged)
            share, probability = searched.shares(found)
            answer = compose_answer(
                found,
                locate=searched.place,
                known=known,
                warnings=[*hint_warnings, *searched.warnings],
                timings_ms=self._localiser.observe(context, found.stage),
                bundle=self._bundle,
                share=share,
                view=partial(view_answer, photograph, plan=searched.merged.plan, grid=searched.merged.grid),
            )
            plans = self._plan_probabilities(searched, found, share, probability)
            return answer.model_copy(update={"venue_id": venue.id, "plans": plans[: form.top_k]})

        return await self._localiser.run_search(completed(steps, compose), context)

    def _plan_probabilities(
        self, searched: SearchedPlans, found: Localisation, share: float, probability: Float[np.ndarray, "m"]
    ) -> list[PlanProbability]:
        """Return the searched plans, most probable first; `SearchedPlans.shares` gives `share` and `probability`."""
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


def _reach_m(motion: Motion) -> float:
    """Return the distance that a measured motion hardly exceeds."""
    return 0.0 if motion.distance_m is None else motion.distance_m + _REACH_STD * motion.distance_std_m


def _spread(encoded: Sequence[Query]) -> list[Query]:
    """Return photographs at even intervals, few enough to choose plans by each."""
    index = np.unique(np.linspace(0, len(encoded) - 1, _CHOOSING).round().astype(int))
    return [encoded[int(k)] for k in index]


def _by_probability(probability: Float[np.ndarray, "m"], index: Int[np.ndarray, "m"]) -> list[int]:
    """Return the order of falling probability; copies of a plan, equal up to rounding, are ordered by `index`."""
    order = np.argsort(-probability, kind="stable")
    tie = np.concatenate([[0], np.cumsum(-np.diff(probability[order]) >= _TIED)])
    return order[np.lexsort((index[order], tie))].tolist()
