"""Query about several photographs of one turn: photographs, ground, steps, answer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.localise.belief import photograph_heading
from lalaloc_core.localise.query import CameraHeight, KnownHeading
from lalaloc_core.localise.search.pipeline import Localisation, LocaliseConfig, localise_steps
from lalaloc_core.localise.sequence.sequence_search import SequenceLocalisation, localise_sequence_steps
from lalaloc_core.localise.sequence.turn_localisation import LinkedTurn, found_turns, judged_turn, localised_turn
from lalaloc_core.photograph import Photograph
from lalaloc_core.photograph.film import Film
from service.query.answers import compose_answer, compose_sequence_answer, film_answer, timed_poses
from service.query.ground import Ground
from service.query.grounds import Site
from service.query.queries import SequenceQuery
from service.query.query_parts import QueryParts
from service.query.single_query import VENUE_CONFIG
from service.query.spots import Spot
from service.schemas import LocaliseAnswer, SequenceAnswer, SequenceForm
from service.schemas.photographs import AssumedAngle
from service.storage.records import PlanRecord, VenueRecord


class SequenceSearch:
    """Search of the place of several photographs from one spot."""

    def __init__(self, parts: QueryParts) -> None:
        self._parts = parts

    async def answer(self, where: PlanRecord | VenueRecord, query: SequenceQuery) -> SequenceAnswer:
        """Localise photographs, or the frames of a film, together."""
        form, context = query.form, query.context
        site = await self._parts.grounds.site(where, form)
        photographs, linked, film = await self._decode(query)
        count = len(photographs)
        known = [
            self._parts.reader.known_heading(form.heading_of(index), site.north, photograph)
            for index, photograph in enumerate(photographs)
        ]
        await site.wait(context)
        # A sphere shows all that other photographs from its spot could add.
        one_query = not any(photograph.is_sphere for photograph in photographs)
        turns = form.known_turns if linked is None else linked.turns
        if one_query and turns is not None:
            ground, joint = await self._search_turn(query, photographs, known, turns, site.height, site)
            found = localised_turn(joint, turns)
        else:
            ground, found = await self._search_sequence(query, photographs, known, site, linked)
            if one_query:
                _, joint = await self._search_turn(query, photographs, known, found_turns(found), site.height, ground)
                found = judged_turn(found, joint)
        timings_ms = self._parts.executor.observe(context, found.stage)

        def compose() -> SequenceAnswer:
            answers = self._answers(form, photographs, known, found, ground, timings_ms)
            answers = _with_relative_headings(answers, form, linked)
            share = min(ground.share(picture) for picture in found.pictures)
            answer = compose_sequence_answer(answers, found, form.steps(count), self._parts.bundle.manifest, share)
            angles = _angle_warnings(photographs, form, linked) if film is None else []
            warnings = [*angles, *answer.warnings, *ground.warnings]
            extras: dict[str, object] = {"warnings": warnings}
            if isinstance(where, VenueRecord):
                extras["venue_id"] = where.id
            if film is not None:
                extras |= {"film": film_answer(film), "poses": timed_poses(answer.poses, film)}
            return answer.model_copy(update=extras)

        return await self._parts.executor.compute(context, compose)

    def _answers(
        self,
        form: SequenceForm,
        photographs: Sequence[Photograph],
        known: Sequence[KnownHeading],
        found: SequenceLocalisation,
        ground: Ground,
        timings_ms: dict[str, float],
    ) -> list[LocaliseAnswer]:
        """Return the answer for each photograph; one of them has the next step."""
        spots = _spots(photographs, found)
        return [
            compose_answer(
                picture,
                ground,
                spot,
                heading,
                timings_ms=timings_ms,
                bundle=self._parts.bundle,
                # Its angles count from the first photograph.
                with_step=index == 0,
            )
            for index, (heading, picture, spot) in enumerate(zip(known, found.pictures, spots, strict=True))
        ]

    async def _decode(self, query: SequenceQuery) -> tuple[list[Photograph], LinkedTurn | None, Film | None]:
        """Return the photographs, or the film's frames, and the angles of a turn that their overlap tells."""
        form, reader = query.form, self._parts.reader
        if query.film is not None:
            film = await reader.film(query.film, form.stated_camera, query.context)
            return list(film.photographs), LinkedTurn.of(film.angles), film
        if form.relative_heading_deg is not None:
            return await reader.decode(query.contents, form.stated_camera, query.context), None, None
        photographs, angles = await reader.decode_turn(query.contents, form.stated_camera, query.context)
        return photographs, None if angles is None else LinkedTurn.of(angles), None

    async def _search_sequence(
        self,
        query: SequenceQuery,
        photographs: Sequence[Photograph],
        known: Sequence[KnownHeading],
        site: Site,
        linked: LinkedTurn | None,
    ) -> tuple[Ground, SequenceLocalisation]:
        """Search the places of photographs that are linked by motions, or by overlap; return the ground, too."""
        form, context = query.form, query.context
        encoded = await self._parts.reader.encode(
            [Spot(photograph) for photograph in photographs], known, [site.height] * len(photographs), context
        )
        ground = await site.ground(encoded, context)
        order = range(len(encoded)) if linked is None else linked.order
        steps = localise_sequence_steps(
            ground.plan,
            ground.grid,
            self._parts.encoder,
            [encoded[index] for index in order],
            form.steps(len(photographs)) if linked is None else linked.motions,
            refine=form.refine,
            top_k=form.top_k,
            clock=context.clock,
        )
        found = await self._parts.executor.run_search(steps, context)
        return ground, found if linked is None else linked.in_order(found)

    async def _search_turn(
        self,
        query: SequenceQuery,
        photographs: Sequence[Photograph],
        known: Sequence[KnownHeading],
        turns: Sequence[float],
        height: CameraHeight,
        site_or_ground: Site | Ground,
    ) -> tuple[Ground, Localisation]:
        """Search the place of photographs from one spot with known headings (radians) minus that of the first.

        They are one query that sees more azimuths, so that overlapping parts count once.
        """
        form, context = query.form, query.context
        spot = Spot(photographs[0], list(zip(photographs[1:], turns[1:], strict=True)))
        stated = (
            replace(heading, heading=heading.heading - turn)
            for heading, turn in zip(known, turns, strict=True)
            if heading.heading is not None
        )
        encoded = await self._parts.reader.encode([spot], [next(stated, known[0])], [height], context)
        ground = site_or_ground if isinstance(site_or_ground, Ground) else await site_or_ground.ground(encoded, context)
        steps = localise_steps(
            ground.plan,
            ground.grid,
            self._parts.encoder,
            encoded[0],
            refine=form.refine,
            top_k=form.top_k,
            # One search, whose stages are those of a sequence.
            config=replace(LocaliseConfig() if ground.merged is None else VENUE_CONFIG, vdr_candidates=0),
            clock=context.clock,
        )
        return ground, await self._parts.executor.run_search(steps, context)


def _spots(photographs: Sequence[Photograph], found: SequenceLocalisation) -> list[Spot]:
    """Return each photograph, together with all others from its spot."""
    headings = [photograph_heading(picture.query, picture.candidates[0]) for picture in found.pictures]
    return [
        Spot(
            photograph,
            [(other, heading - headings[index]) for other, heading in zip(photographs, headings, strict=True)],
        )
        for index, photograph in enumerate(photographs)
    ]


def _with_relative_headings(
    answers: Sequence[LocaliseAnswer], form: SequenceForm, linked: LinkedTurn | None
) -> list[LocaliseAnswer]:
    """Return the answers with the relative headings that the request states, or that the overlap tells."""
    angles: list[AssumedAngle | None] = [None] * len(answers)
    if linked is not None and len({angle.group for angle in linked.angles}) < len(answers):
        # Of other groups, only the angles within the group are known.
        angles = [
            None
            if angle.group
            else AssumedAngle(
                value_deg=math.degrees(angle.heading),
                std_deg=math.degrees(angle.heading_sd),
                source="assumed" if angle.is_assumed else "estimated",
            )
            for angle in linked.angles
        ]
    elif form.relative_heading_deg is not None and form.relative_heading_deg[0] is not None:
        first_deg, std_deg = form.relative_heading_deg[0], form.relative_heading_std_deg
        angles = [
            None
            if given_deg is None
            else AssumedAngle(
                value_deg=math.degrees(wrap_angle(math.radians(given_deg - first_deg))),
                std_deg=std_deg if index else 0.0,
                source="given",
            )
            for index, given_deg in enumerate(form.relative_heading_deg)
        ]
    return [
        answer.model_copy(update={"view": answer.view.model_copy(update={"relative_heading": angle})})
        if answer.view is not None
        else answer
        for answer, angle in zip(answers, angles, strict=True)
    ]


def _angle_warnings(photographs: Sequence[Photograph], form: SequenceForm, linked: LinkedTurn | None) -> list[str]:
    """Return warnings about angles of a turn that were searched."""
    if form.relative_heading_deg is not None:
        return []
    if linked is not None:
        return linked.warnings(min(photograph.hfov.value for photograph in photographs))
    if any(photograph.is_sphere for photograph in photographs):
        return []
    return [
        "features have no pictures that could overlap, so the angles between them were searched: send "
        "relative_heading_deg"
    ]
