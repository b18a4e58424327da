"""Localisation of several photographs of one visit, in a plan or in the merged plans of a venue."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, TypeVar

from lalaloc_core.bundle import Bundle
from lalaloc_core.errors import InvalidPoseError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import photograph_heading
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import CameraHeight, KnownHeading, Query
from lalaloc_core.localise.search.pipeline import Localisation, LocaliseConfig, StageClock, localise_steps
from lalaloc_core.localise.sequence.sequence_search import SequenceLocalisation, localise_sequence_steps
from lalaloc_core.localise.sequence.turn_localisation import found_turns, judged_turn, localised_turn
from lalaloc_core.photograph import Photograph
from service.decoding.decoder import Decoder
from service.query.answers import Locate, compose_answer, compose_sequence_answer
from service.query.photographs import Spot, encode, view_answer
from service.query.queries import QueryContext, SequenceQuery
from service.query.search_steps import SearchSteps
from service.query.stated_pose import known_heading
from service.schemas import SequenceAnswer
from service.settings import Settings

# Photographs from one spot with known angles are one search, whose stages are those of a sequence.
_TURN_CONFIG = LocaliseConfig(vdr_candidates=0)

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class SequenceGround:
    """Places that a sequence is searched among.

    Attributes:
        plan: the plan, or the merged plans.
        grid: its pose grid.
        locate: maps candidates to places.
        share: returns the probability that a photograph is of a searched plan.
        warnings: warnings about plans that are not searched.
        turn_config: configuration of the search of photographs from one spot.
    """

    plan: FloorPlan
    grid: PoseGrid
    locate: Locate
    share: Callable[[Localisation], float] = lambda _: 1.0
    warnings: Sequence[str] = ()
    turn_config: LocaliseConfig = _TURN_CONFIG


# Finds the ground of encoded photographs.
FindGround = Callable[[Sequence[Query]], Awaitable[SequenceGround]]


class _Computer(Protocol):
    """Part of `Localiser` that runs searches."""

    async def compute(self, context: QueryContext, work: Callable[[], T]) -> T:
        """See `Localiser.compute`."""
        ...

    async def run_search(self, steps: SearchSteps[T], context: QueryContext) -> T:
        """See `Localiser.run_search`."""
        ...

    def observe(self, context: QueryContext, stage: str) -> dict[str, float]:
        """See `Localiser.observe`."""
        ...


class SequenceSearch:
    """Search of the places of several photographs of one visit."""

    def __init__(
        self,
        computer: _Computer,
        *,
        settings: Settings,
        bundle: Bundle,
        encoder: PhotographEncoder,
        decoder: Decoder,
    ) -> None:
        self._computer = computer
        self._settings = settings
        self._bundle = bundle
        self._encoder = encoder
        self._decoder = decoder

    async def views(self, query: SequenceQuery) -> list[Photograph]:
        """Decode the photographs of a query.

        Raises:
            InvalidPoseError: a height per photograph is stated, and the model compares latents of one height.
            LaLaLocError: see `Decoder.decode`.
        """
        form, context = query.form, query.context
        if form.camera_heights_m is not None and not self._encoder.predicts_profile:
            raise InvalidPoseError(
                "camera_heights_m needs a model that predicts wall profiles; this one compares latents of one height: "
                "give camera_height_m"
            )
        # Decode one photograph at a time, so that a query occupies one decoder.
        with context.clock.stage("decode"):
            return [
                await self._decoder.decode(content, form.stated_camera, context.deadline, context.client)
                for content in query.contents
            ]

    async def answer(
        self,
        query: SequenceQuery,
        views: Sequence[Photograph],
        heights: Sequence[CameraHeight],
        north: float | None,
        find_ground: FindGround,
    ) -> SequenceAnswer:
        """Search the places of decoded photographs; raises the errors of `Localiser.localise`.

        Args:
            query: the query.
            views: its photographs.
            heights: camera height of each photograph.
            north: azimuth of north (radians) in the frame of the answer, None where unknown.
            find_ground: finds the places to search.
        """
        form, context = query.form, query.context
        compass_deg = self._settings.photographs.compass_tolerance_deg
        known = [known_heading(form.heading_of(index), north, view, compass_deg) for index, view in enumerate(views)]
        # A sphere shows all that other photographs from its spot could add.
        one_query = form.motion == "turn" and not any(view.is_sphere for view in views)
        turns = form.known_turns
        if one_query and turns is not None:
            ground, joint = await self._search_turn(query, views, known, turns, heights[0], find_ground)
            found = localised_turn(joint, turns)
        else:
            ground, found = await self._search_sequence(query, views, known, heights, find_ground)
            if one_query:
                _, joint = await self._search_turn(query, views, known, found_turns(found), heights[0], ground)
                found = judged_turn(found, joint)
        timings_ms = self._computer.observe(context, found.stage)

        def compose() -> SequenceAnswer:
            shares = [ground.share(picture) for picture in found.pictures]
            photographs = _photographs(views, found, one_spot=form.motion == "turn")
            answers = [
                compose_answer(
                    picture,
                    locate=ground.locate,
                    known=heading,
                    timings_ms=timings_ms,
                    bundle=self._bundle,
                    share=share,
                    view=partial(view_answer, photograph, plan=ground.plan, grid=ground.grid),
                )
                for heading, picture, photograph, share in zip(known, found.pictures, photographs, shares, strict=True)
            ]
            motions = form.steps(len(views))
            answer = compose_sequence_answer(answers, found, motions, self._bundle.manifest, min(shares))
            return answer.model_copy(update={"warnings": [*answer.warnings, *ground.warnings]})

        return await self._computer.compute(context, compose)

    async def _search_sequence(
        self,
        query: SequenceQuery,
        views: Sequence[Photograph],
        known: Sequence[KnownHeading],
        heights: Sequence[CameraHeight],
        find_ground: FindGround,
    ) -> tuple[SequenceGround, SequenceLocalisation]:
        """Search the places of photographs that are linked by motions; return the ground, too."""
        form, context, clock = query.form, query.context, query.context.clock
        encoded: list[Query] = []
        # One at a time, so that queries of others come in between.
        with clock.stage("encode"):
            for view, heading, height in zip(views, known, heights, strict=True):
                one = partial(encode, self._encoder, [Spot(view)], [heading], height, StageClock())
                encoded += await self._computer.compute(context, one)
        ground = await find_ground(encoded)
        steps = localise_sequence_steps(
            ground.plan,
            ground.grid,
            self._encoder,
            encoded,
            form.steps(len(views)),
            refine=form.refine,
            top_k=form.top_k,
            clock=clock,
        )
        return ground, await self._computer.run_search(steps, context)

    async def _search_turn(
        self,
        query: SequenceQuery,
        views: Sequence[Photograph],
        known: Sequence[KnownHeading],
        turns: Sequence[float],
        height: CameraHeight,
        place: SequenceGround | FindGround,
    ) -> tuple[SequenceGround, Localisation]:
        """Search the place of photographs from one spot with known headings (radians) minus that of the first.

        They are one query that sees more azimuths, so that overlapping parts count once.
        """
        form, context, clock = query.form, query.context, query.context.clock
        photograph = Spot(views[0], list(zip(views[1:], turns[1:], strict=True)))
        stated = (
            replace(heading, heading=heading.heading - turn)
            for heading, turn in zip(known, turns, strict=True)
            if heading.heading is not None
        )
        first = [next(stated, known[0])]
        encode_all = partial(encode, self._encoder, [photograph], first, height, clock)
        encoded = await self._computer.compute(context, encode_all)
        ground = place if isinstance(place, SequenceGround) else await place(encoded)
        steps = localise_steps(
            ground.plan,
            ground.grid,
            self._encoder,
            encoded[0],
            refine=form.refine,
            top_k=form.top_k,
            config=ground.turn_config,
            clock=clock,
        )
        return ground, await self._computer.run_search(steps, context)


def _photographs(views: Sequence[Photograph], found: SequenceLocalisation, *, one_spot: bool) -> list[Spot]:
    """Return each photograph of a sequence, together with all others from its spot."""
    if not one_spot:
        return [Spot(view) for view in views]
    headings = [photograph_heading(picture.query, picture.candidates[0]) for picture in found.pictures]
    return [
        Spot(
            view,
            [(other, heading - headings[index]) for other, heading in zip(views, headings, strict=True)],
        )
        for index, view in enumerate(views)
    ]
