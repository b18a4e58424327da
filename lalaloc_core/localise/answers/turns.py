"""Turns: photographs of one spot, the search of their place, and its answer."""

from __future__ import annotations

import itertools
import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.localise.answers.compose import compose_answer
from lalaloc_core.localise.answers.documents import Angle, FilmReading, Ground, Spot, TurnAnswer
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.localise.query.query import KnownHeading
from lalaloc_core.localise.refine import RefinementJob
from lalaloc_core.localise.search.pipeline import Localisation, LocaliseConfig, StageClock, localise_steps
from lalaloc_core.localise.sequence import Motion, SequenceJob
from lalaloc_core.localise.sequence.sequence_search import SequenceLocalisation, SequenceRefine, localise_sequence_steps
from lalaloc_core.localise.sequence.turn_localisation import (
    EXACT,
    ON_THE_SPOT,
    LinkedTurn,
    found_turns,
    judged_turn,
    localised_turn,
)
from lalaloc_core.photograph import Photograph
from lalaloc_core.photograph.film import Film

_NO_ANGLES = (
    "features have no pictures that could overlap, so the angles between them were searched: send relative_heading_deg"
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Turn:
    """Photographs of one spot, in the order in which they were taken, and what is known about them.

    Attributes:
        photographs: the photographs, or the frames of `film`.
        known: known heading of each.
        height: camera height.
        turns: headings (radians) minus that of the first photograph, if they are known well enough for one query.
        motions: motions between the photographs in `order`.
        linked: angles by overlap; None if they are stated, or for features and spheres.
        relative_headings: relative heading of each photograph as answers tell it; None where it was searched.
        film: the film; None for photographs.
    """

    photographs: Sequence[Photograph]
    known: Sequence[KnownHeading]
    height: CameraHeight
    turns: Sequence[float] | None
    motions: Sequence[Motion]
    linked: LinkedTurn | None = None
    relative_headings: Sequence[Angle | None]
    film: Film | None = None

    @classmethod
    def of_overlap(
        cls,
        photographs: Sequence[Photograph],
        known: Sequence[KnownHeading],
        height: CameraHeight,
        linked: LinkedTurn,
        film: Film | None = None,
    ) -> Turn:
        """Return a turn whose angles the overlap of its photographs tells."""
        several = len({angle.group for angle in linked.angles}) < len(photographs)
        # Of other groups, only the angles within the group are known.
        relative = [
            Angle(
                value_deg=math.degrees(angle.heading),
                std_deg=math.degrees(angle.heading_sd),
                source="assumed" if angle.is_assumed else "estimated",
            )
            if several and not angle.group
            else None
            for angle in linked.angles
        ]
        return cls(
            photographs=photographs,
            known=known,
            height=height,
            turns=linked.turns,
            motions=linked.motions,
            linked=linked,
            relative_headings=relative,
            film=film,
        )

    @classmethod
    def of_headings(
        cls,
        photographs: Sequence[Photograph],
        known: Sequence[KnownHeading],
        height: CameraHeight,
        headings: Sequence[float | None],
        std: float,
    ) -> Turn:
        """Return a turn with stated headings (radians) relative to each other, and the deviation between two."""
        relative = [None if angle is None or headings[0] is None else angle - headings[0] for angle in headings]
        given = [angle for angle in headings if angle is not None]
        is_exact = 0 < len(given) == len(headings) and std <= EXACT
        motions = [
            ON_THE_SPOT if None in (first, second) else replace(ON_THE_SPOT, turn=second - first, turn_std=std)
            for first, second in itertools.pairwise(headings)
        ]
        return cls(
            photographs=photographs,
            known=known,
            height=height,
            turns=[angle - given[0] for angle in given] if is_exact else None,
            motions=motions,
            relative_headings=[
                None
                if angle is None
                else Angle(
                    value_deg=math.degrees(wrap_angle(angle)),
                    std_deg=math.degrees(std) if index else 0.0,
                    source="given",
                )
                for index, angle in enumerate(relative)
            ],
        )

    @property
    def is_one_query(self) -> bool:
        """True unless one of the photographs is a sphere, which shows all that others could add."""
        return not any(photograph.is_sphere for photograph in self.photographs)

    @property
    def spots(self) -> list[tuple[Spot, KnownHeading]]:
        """All photographs together if their angles are known, else each by itself; with the known heading."""
        if self.is_one_query and self.turns is not None:
            return [self._joint_spot(self.turns)]
        return [(Spot(photograph), known) for photograph, known in zip(self.photographs, self.known, strict=True)]

    def query(self, encoder: PhotographEncoder, spot: Spot, known: KnownHeading) -> Query:
        """Return the query of one of the `spots`."""
        return encoder.query(
            spot.photograph, known.heading, self.height, heading_tolerance=known.tolerance, others=spot.others
        )

    def steps(
        self,
        ground: Ground,
        encoder: PhotographEncoder,
        queries: Sequence[Query],
        *,
        refine: SequenceRefine = "lpo",
        top_k: int = 5,
        config: LocaliseConfig | None = None,
        clock: StageClock | None = None,
    ) -> Generator[RefinementJob | SequenceJob | None, Any, SequenceLocalisation]:
        """Search the place, and the angles that are not known; see `search.pipeline.next_step`."""
        # One search, whose stages are those of a sequence.
        config = replace(config or LocaliseConfig(), vdr_candidates=0)
        plan, grid = ground.plan, ground.grid

        def joint_steps(query: Query) -> Generator[RefinementJob, Any, Localisation]:
            return localise_steps(
                plan, grid, encoder.layouts, query, refine=refine, top_k=top_k, config=config, clock=clock
            )

        if self.is_one_query and self.turns is not None:
            return localised_turn((yield from joint_steps(queries[0])), self.turns)
        order = range(len(queries)) if self.linked is None else self.linked.order
        ordered = [queries[index] for index in order]
        found = yield from localise_sequence_steps(
            plan, grid, encoder.layouts, ordered, self.motions, refine=refine, top_k=top_k, clock=clock
        )
        found = found if self.linked is None else self.linked.in_order(found)
        if not self.is_one_query:
            return found
        return judged_turn(found, (yield from joint_steps(self.query(encoder, *self._joint_spot(found_turns(found))))))

    def _joint_spot(self, turns: Sequence[float]) -> tuple[Spot, KnownHeading]:
        """Return all photographs as one that sees more azimuths, so that overlapping parts count once."""
        stated = (
            replace(heading, heading=heading.heading - turn)
            for heading, turn in zip(self.known, turns, strict=True)
            if heading.heading is not None
        )
        spot = Spot(self.photographs[0], list(zip(self.photographs[1:], turns[1:], strict=True)))
        return spot, next(stated, self.known[0])

    def contradictions(self, found: SequenceLocalisation) -> list[str]:
        """Return warnings about photographs that do not fit the one before, by its place or its stated angle."""
        order = range(len(self.photographs)) if self.linked is None else self.linked.order
        return [
            f"photo[{order[index + 1]}]: its place or angle contradicts photo[{order[index]}] and was ignored"
            for index in found.motions_contradicted
        ]

    @property
    def warnings(self) -> list[str]:
        """Warnings about angles that were searched."""
        if self.film is not None:
            return []
        if self.linked is not None:
            return self.linked.warnings(min(photograph.hfov.value for photograph in self.photographs))
        has_turn = any(motion.turn is not None for motion in self.motions)
        return [] if has_turn or not self.is_one_query else [_NO_ANGLES]


def compose_turn(
    turn: Turn, found: SequenceLocalisation, ground: Ground, bundle: Bundle, *, warnings: Sequence[str] = ()
) -> TurnAnswer:
    """Compose the answer about photographs of one spot; its first pose has the next step.

    `warnings` are those besides warnings about the photographs.
    """
    turns = found_turns(found)
    poses = [
        compose_answer(
            picture,
            ground,
            Spot(
                photograph,
                [(other, angle - turns[index]) for other, angle in zip(turn.photographs, turns, strict=True)],
            ),
            turn.known[index],
            bundle,
            with_step=index == 0,
            relative_heading=turn.relative_headings[index],
        )
        for index, (photograph, picture) in enumerate(zip(turn.photographs, found.pictures, strict=True))
    ]
    named = [f"photo[{index}]: {text}" for index, pose in enumerate(poses) for text in pose.view.warnings]
    share = min(ground.share(picture) for picture in found.pictures)
    changed = {
        "confidence": found.confidence(bundle.manifest, share),
        "warnings": [*turn.warnings, *turn.contradictions(found), *named, *warnings],
        "stage": found.stage,
        "camera_height_m": found.camera_height_m,
    }
    film = turn.film
    return TurnAnswer(
        **(vars(poses[0]) | changed),
        poses=poses,
        times_s=None if film is None else list(film.times_s),
        film=None if film is None else _film_reading(film),
    )


def _film_reading(film: Film) -> FilmReading:
    return FilmReading(
        frames_read=film.frames,
        frames_kept=len(film.photographs),
        dropped=[{"reason": reason, "frames": frames} for reason, frames in film.dropped.items()],
        duration_s=film.duration_s,
        turned_deg=math.degrees(film.turned),
        warnings=list(film.warnings),
    )
