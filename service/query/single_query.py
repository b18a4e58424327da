"""Query about one photograph: photograph, ground, steps, answer."""

from __future__ import annotations

from dataclasses import dataclass

from lalaloc_core.bundle import Bundle
from lalaloc_core.draw.answer import PHOTOGRAPH_SIZE, draw_answer, drawn_answer
from lalaloc_core.localise.answers.compose import compose_answer
from lalaloc_core.localise.answers.documents import Answer, Spot
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.search.pipeline import Localisation, LocaliseConfig, localise_steps
from lalaloc_core.photograph import Photograph
from service.decoding.decoder import Decoder
from service.query.answers import localise_answer, posterior_answer
from service.query.executor import Executor, finish_with
from service.query.ground import Ground
from service.query.grounds import Grounds
from service.query.photograph_reader import PhotographReader
from service.query.queries import PhotographQuery, PictureQuery, Where
from service.schemas import LocaliseAnswer
from service.storage.records import PlanRecord


@dataclass(frozen=True, kw_only=True)
class QueryParts:
    """Parts that single photographs, sequences and sessions share."""

    bundle: Bundle
    encoder: PhotographEncoder
    decoder: Decoder
    reader: PhotographReader
    grounds: Grounds
    executor: Executor


# Among many plans the right one often ranks low before refinement, so refine more candidates than in a single plan.
VENUE_CONFIG = LocaliseConfig(by_probability=True, profile_candidates=32, profile_candidates_turned=48)


class SingleSearch:
    """Search of the place of one photograph."""

    def __init__(self, parts: QueryParts) -> None:
        self._parts = parts

    async def answer(self, where: Where, query: PhotographQuery) -> LocaliseAnswer:
        """Localise a photograph."""
        answer, _ = await self._search(where, query)
        return answer

    async def answer_and_draw(self, where: Where, query: PictureQuery) -> tuple[LocaliseAnswer, bytes]:
        """Localise a photograph in a plan and draw the answer."""
        answer, composed = await self._search(where, query)
        with query.context.clock.stage("draw"):
            picture = await self._draw(composed, query)
        self._parts.executor.observe_stage(query.context, "draw")
        return answer, picture

    async def _search(self, where: Where, query: PhotographQuery | PictureQuery) -> tuple[LocaliseAnswer, Answer]:
        """Return the answer, after and before its places were named."""
        form, context = query.form, query.context
        site = await self._parts.grounds.site(where, form, form)
        # Decode first, so that an unreadable picture is refused without waiting for plans.
        (photograph,) = await self._parts.reader.decode([query.content], form.stated_camera, context)
        heading = form.heading_deg, form.heading_tolerance_deg
        known = self._parts.reader.known_heading(*heading, site.north, photograph)
        await site.wait(context)
        spot = Spot(photograph)
        (encoded,) = await self._parts.reader.encode([spot], [known], [site.height], context)
        ground = await site.ground([encoded], context)
        steps = localise_steps(
            ground.plan,
            ground.grid,
            self._parts.encoder.layouts,
            encoded,
            refine=form.refine,
            top_k=form.top_k,
            config=None if ground.merged is None else VENUE_CONFIG,
            clock=context.clock,
            hints=ground.hints,
        )

        def compose(found: Localisation) -> tuple[LocaliseAnswer, Answer]:
            warnings = [*ground.hint_warnings(found), *ground.warnings]
            composed = compose_answer(
                found, ground, spot, known, self._parts.bundle, warnings=warnings, clock=context.clock
            )
            answer = localise_answer(composed, ground, self._parts.executor.observe(context, found.stage))
            return answer.model_copy(update=self._extras(where, query, ground, found)), composed

        return await self._parts.executor.run_search(finish_with(steps, compose), context)

    def _extras(
        self, where: Where, query: PhotographQuery | PictureQuery, ground: Ground, found: Localisation
    ) -> dict[str, object]:
        """Return fields of the answer that not every answer has."""
        if isinstance(where, PlanRecord):
            wanted = query.form.include == "posterior"
            return {"posterior": posterior_answer(ground, found.posterior)} if wanted else {}
        model = self._parts.bundle.manifest.confidence_for(view=found.query.is_view, turn=found.query.is_turn)
        confidence = found.confidence(model, ground.share(found))
        plans = ground.plan_probabilities(found, None if confidence is None else confidence.fit)
        return {"venue_id": where.id, "plans": plans[: query.form.top_k]}

    async def _draw(self, composed: Answer, query: PictureQuery) -> bytes:
        context, picture = query.context, None
        if query.picture != "plan":
            assert not isinstance(query.content, Photograph)
            # Decode again, because the encoder's input is too small for a picture.
            picture = await self._parts.decoder.picture(
                query.content,
                query.form.stated_camera,
                context,
                is_sphere=composed.evidence.photograph.is_sphere,
                max_size=PHOTOGRAPH_SIZE,
            )
        svg = await self._parts.executor.compute(
            context, lambda: draw_answer(drawn_answer(composed), picture, query.picture, rooms=query.rooms)
        )
        if query.as_png:
            return await self._parts.decoder.rasterise(svg, context)
        return svg.encode()
