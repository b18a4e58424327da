"""Turns: photographs of one spot, the search of their place, and its answer."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.localise.answers.compose import compose_answer
from lalaloc_core.localise.answers.documents import DroppedFrames, FilmAnswer, Ground, Spot, TurnAnswer
from lalaloc_core.localise.answers.views import AssumedAngle
from lalaloc_core.localise.belief.confidence import CONFIDENT
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.localise.query.query import KnownHeading
from lalaloc_core.localise.refine import RefinementJob
from lalaloc_core.localise.search.pipeline import LocaliseConfig, Refine, StageClock, localise_steps
from lalaloc_core.localise.search.turn_search import RelativeHeading, SearchedTurn, TurnLocalisation, searched_turn
from lalaloc_core.photograph import Photograph
from lalaloc_core.photograph.film import Film
from lalaloc_core.photograph.overlap import LIKELY_SD
from lalaloc_core.photograph.turn_angles import TurnAngles

# Standard deviation up to which relative headings are exact: the networks predict by columns of 2.8°.
_EXACT = math.radians(5.0)
_NO_ANGLES = (
    "features have no pictures that could overlap, so the angles between them were searched: send relative_heading_deg"
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Turn:
    """Photographs of one spot, in the order in which they were taken, and what is known about them.

    Attributes:
        photographs: the photographs, or the frames of `film`.
        turns: headings (radians) minus that of the first photograph, if they are known well enough for one query.
        relative: relative headings of the photographs, in groups.
        overlap: angles by overlap; None if they are stated, or for features and spheres.
        relative_headings: relative heading of each photograph as answers tell it; None where it was searched.
    """

    photographs: Sequence[Photograph]
    known: Sequence[KnownHeading]
    height: CameraHeight
    turns: Sequence[float] | None
    relative: Sequence[RelativeHeading]
    overlap: Sequence[TurnAngles] | None = None
    relative_headings: Sequence[AssumedAngle | None]
    film: Film | None = None

    @classmethod
    def of_overlap(
        cls,
        photographs: Sequence[Photograph],
        known: Sequence[KnownHeading],
        height: CameraHeight,
        overlap: Sequence[TurnAngles],
        film: Film | None = None,
    ) -> Turn:
        """Return a turn whose angles the overlap of its photographs tells."""
        is_one = not any(angle.group or angle.heading_sd > LIKELY_SD for angle in overlap)
        several = len({angle.group for angle in overlap}) < len(photographs)
        # Of other groups, only the angles within the group are known.
        told = [
            AssumedAngle(
                value_deg=math.degrees(angle.heading),
                std_deg=math.degrees(angle.heading_sd),
                source="assumed" if angle.is_assumed else "estimated",
            )
            if several and not angle.group
            else None
            for angle in overlap
        ]
        return cls(
            photographs=photographs,
            known=known,
            height=height,
            turns=[angle.heading for angle in overlap] if is_one else None,
            relative=[RelativeHeading(angle.group, angle.heading, angle.heading_sd) for angle in overlap],
            overlap=overlap,
            relative_headings=told,
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
        given = [angle for angle in headings if angle is not None]
        # A photograph without a heading is a group of its own.
        relative = [
            RelativeHeading(index + 1, 0.0, 0.0) if angle is None else RelativeHeading(0, angle - given[0], std)
            for index, angle in enumerate(headings)
        ]
        is_exact = 0 < len(given) == len(headings) and std <= _EXACT
        told = [None if angle is None or headings[0] is None else angle - headings[0] for angle in headings]
        return cls(
            photographs=photographs,
            known=known,
            height=height,
            turns=[angle - given[0] for angle in given] if is_exact else None,
            relative=relative,
            relative_headings=[
                None
                if angle is None
                else AssumedAngle(
                    value_deg=math.degrees(wrap_angle(angle)),
                    std_deg=math.degrees(std) if index else 0.0,
                    source="given",
                )
                for index, angle in enumerate(told)
            ],
        )

    @property
    def sphere(self) -> int | None:
        """Number of the first full sphere, which shows all that the others could add; None if there is none."""
        return next((index for index, photograph in enumerate(self.photographs) if photograph.is_sphere), None)

    @property
    def spots(self) -> list[tuple[Spot, KnownHeading]]:
        """All photographs together if their angles are known, else each by itself; with the known heading."""
        if self.sphere is None and self.turns is not None:
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
        refine: Refine = "lpo",
        top_k: int = 5,
        config: LocaliseConfig | None = None,
        clock: StageClock | None = None,
    ) -> Generator[RefinementJob | None, Any, TurnLocalisation]:
        """Search the angles that are not known, then the place; see `search.pipeline.next_step`."""
        config = replace(config or LocaliseConfig(), vdr_candidates=0)
        parts, sphere = (ground.plan, ground.grid, encoder.layouts), self.sphere
        query, searched = queries[sphere or 0], SearchedTurn(list(self.turns or ()))
        search = partial(searched_turn, *parts, queries, self.relative, config.matching)
        if sphere is None and self.turns is None:
            searched = yield from search()
            query = self.query(encoder, *self._joint_spot(searched.headings))
        found = yield from localise_steps(*parts, query, refine=refine, top_k=top_k, config=config, clock=clock)
        if sphere is not None:
            # The sphere alone tells the place, so the headings of the others are searched there.
            searched = yield from search(place=found.candidates[0])
        reference = searched.headings[sphere or 0]
        return TurnLocalisation(found, [angle - reference for angle in searched.headings], searched.contradicted)

    def _joint_spot(self, turns: Sequence[float]) -> tuple[Spot, KnownHeading]:
        """Return all photographs as one that sees more azimuths, so that overlapping parts count once."""
        stated = (
            replace(heading, heading=heading.heading - turn)
            for heading, turn in zip(self.known, turns, strict=True)
            if heading.heading is not None
        )
        spot = Spot(self.photographs[0], list(zip(self.photographs[1:], turns[1:], strict=True)))
        return spot, next(stated, self.known[0])

    @property
    def warnings(self) -> list[str]:
        """Warnings about angles that are assumed or had to be searched."""
        if self.film is not None:
            return []
        if self.overlap is not None:
            return overlap_warnings(self.overlap, min(photograph.hfov.value for photograph in self.photographs))
        is_told = any(angle is not None for angle in self.relative_headings)
        return [] if is_told or self.sphere is not None else [_NO_ANGLES]


def overlap_warnings(angles: Sequence[TurnAngles], hfov: float) -> list[str]:
    """Return a warning about angles that are assumed or had to be searched, for a field of view (radians)."""
    groups: dict[int, list[int]] = {}
    for index, angle in enumerate(angles):
        groups.setdefault(angle.group, []).append(index)
    remedy = (
        "send them in the order in which they were taken, turn by at most half the field of view, "
        f"{math.degrees(0.5 * hfov):.0f}°, from one photograph to the next, or state the relative headings"
    )
    if len(groups) > 1:
        names = "; ".join(", ".join(f"photo[{index}]" for index in groups[group]) for group in sorted(groups))
        return [
            f"the photographs overlap only within {len(groups)} groups ({names}), so the angles between these were "
            f"searched: {remedy}"
        ]
    assumed = [index for index, angle in enumerate(angles) if angle.is_assumed]
    if not assumed:
        return []
    names = ", ".join(f"photo[{index}]" for index in assumed)
    sd_deg = math.degrees(max(angles[index].heading_sd for index in assumed))
    return [
        f"nothing links {names} to most others, as on plain walls, so their angles were assumed by their order, within "
        f"± {2.0 * sd_deg:.0f}°, as of one turn in equal steps: {remedy}"
    ]


def compose_turn(
    turn: Turn,
    found: TurnLocalisation,
    ground: Ground,
    bundle: Bundle,
    *,
    warnings: Sequence[str] = (),
    clock: StageClock | None = None,
) -> TurnAnswer:
    """Compose the answer about photographs of one spot; its first pose has the next step, a stage of `clock`.

    `warnings` are those besides warnings about the photographs.
    """
    turns = found.turns
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
            clock=clock,
        )
        for index, (photograph, picture) in enumerate(zip(turn.photographs, found.pictures, strict=True))
    ]
    film, told = turn.film, [(text, index) for index, pose in enumerate(poses) for text in pose.view.warnings]
    # Frames of a film have most warnings in common.
    told = told if film is None else [*{text: (text, index) for text, index in reversed(told)}.values()][::-1]
    named = [f"photo[{index}]: {text}" for text, index in told]
    contradicted = [
        f"photo[{index}]: its relative heading contradicts the other photographs and was ignored"
        for index in found.contradicted
    ]
    lying = found.pictures[0].query.warnings if (poses[0].confidence or 0.0) < CONFIDENT else ()
    fields: dict[str, Any] = vars(poses[0]) | {"warnings": [*turn.warnings, *contradicted, *named, *warnings, *lying]}
    return TurnAnswer(
        **fields,
        poses=poses,
        times_s=None if film is None else list(film.times_s),
        film=None if film is None else _film_reading(film),
    )


def _film_reading(film: Film) -> FilmAnswer:
    return FilmAnswer(
        frames_read=film.frames,
        frames_kept=len(film.photographs),
        dropped=[DroppedFrames(reason=reason, frames=frames) for reason, frames in film.dropped.items()],
        duration_s=film.duration_s,
        turned_deg=math.degrees(film.turned),
        warnings=list(film.warnings),
    )
