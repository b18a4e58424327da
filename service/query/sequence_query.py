"""Query about several photographs of one turn: photographs, ground, steps, answer."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lalaloc_core.localise.answers.turns import Turn, compose_turn
from lalaloc_core.photograph import Photograph
from lalaloc_core.photograph.film import Film
from lalaloc_core.photograph.turn_angles import TurnAngles
from service.query.answers import sequence_answer
from service.query.grounds import Site
from service.query.queries import SequenceQuery
from service.query.single_query import VENUE_CONFIG, QueryParts
from service.schemas import SequenceAnswer
from service.storage.records import PlanRecord, VenueRecord


class SequenceSearch:
    """Search of the place of several photographs from one spot."""

    def __init__(self, parts: QueryParts) -> None:
        self._parts = parts

    async def answer(self, where: PlanRecord | VenueRecord, query: SequenceQuery) -> SequenceAnswer:
        """Localise photographs, or the frames of a film, together."""
        form, context, executor = query.form, query.context, self._parts.executor
        site = await self._parts.grounds.site(where, form)
        photographs, angles, film = await self._decode(query)
        await site.wait(context)
        turn = self._turn(query, photographs, angles, film, site)
        spots, known = zip(*turn.spots, strict=True)
        queries = await self._parts.reader.encode(spots, known, [turn.height] * len(spots), context)
        ground = await site.ground(queries, context)
        steps = turn.steps(
            ground,
            self._parts.encoder,
            queries,
            refine=form.refine,
            top_k=form.top_k,
            config=None if ground.merged is None else VENUE_CONFIG,
            clock=context.clock,
        )
        found = await executor.run_search(steps, context)

        def compose() -> SequenceAnswer:
            composed = compose_turn(
                turn, found, ground, self._parts.bundle, warnings=ground.warnings, clock=context.clock
            )
            venue_id = where.id if isinstance(where, VenueRecord) else None
            return sequence_answer(composed, ground, executor.observe(context, found.stage), venue_id)

        return await executor.compute(context, compose)

    async def _decode(self, query: SequenceQuery) -> tuple[list[Photograph], Sequence[TurnAngles] | None, Film | None]:
        """Return the photographs, or the film's frames, and the angles of a turn that their overlap tells."""
        form, reader = query.form, self._parts.reader
        if query.film is not None:
            film = await reader.film(query.film, form.stated_camera, query.context)
            return list(film.photographs), film.angles, film
        if form.relative_heading_deg is not None:
            return await reader.decode(query.contents, form.stated_camera, query.context), None, None
        photographs, angles = await reader.decode_turn(query.contents, form.stated_camera, query.context)
        return photographs, angles, None

    def _turn(
        self,
        query: SequenceQuery,
        photographs: list[Photograph],
        angles: Sequence[TurnAngles] | None,
        film: Film | None,
        site: Site,
    ) -> Turn:
        """Return the photographs with what the request and their overlap tell about their headings."""
        form = query.form
        known = [
            self._parts.reader.known_heading(heading_deg, form.heading_tolerance_deg, site.north, photograph)
            for heading_deg, photograph in zip(form.headings_deg or [None] * len(photographs), photographs, strict=True)
        ]
        if angles is not None:
            return Turn.of_overlap(photographs, known, site.height, angles, film)
        given_deg = form.relative_heading_deg or [None] * len(photographs)
        headings = [None if angle is None else math.radians(angle) for angle in given_deg]
        return Turn.of_headings(photographs, known, site.height, headings, math.radians(form.relative_heading_std_deg))
