"""Photographs from one spot: one query that sees what all of them show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.localise.belief import RIGHT_WITHIN_M, Posterior, photograph_heading
from lalaloc_core.localise.search.pipeline import Localisation
from lalaloc_core.localise.sequence.measured_motion import Motion
from lalaloc_core.localise.sequence.sequence_search import SequenceLocalisation
from lalaloc_core.photograph.overlap import LIKELY_SD
from lalaloc_core.photograph.turn_angles import TurnAngles

# Phones move about the person who turns.
ON_THE_SPOT = Motion(distance_m=0.0, distance_std_m=0.15)
# Standard deviation up to which relative headings are exact: the networks predict by columns of 2.8°.
EXACT = math.radians(5.0)


@dataclass(frozen=True)
class LinkedTurn:
    """Photographs of one spot in groups that overlap.

    Attributes:
        angles: angles of each photograph.
        order: numbers of the photographs, group by group.
    """

    angles: Sequence[TurnAngles]
    order: tuple[int, ...]

    @classmethod
    def of(cls, angles: Sequence[TurnAngles]) -> LinkedTurn:
        """Return the groups of photographs by their angles."""
        return cls(angles, tuple(sorted(range(len(angles)), key=lambda index: (angles[index].group, index))))

    @property
    def turns(self) -> list[float] | None:
        """Headings (radians) minus that of the first photograph; None unless all are likely enough to be one query."""
        if any(angle.group or angle.heading_sd > LIKELY_SD for angle in self.angles):
            return None
        return [angle.heading for angle in self.angles]

    @property
    def motions(self) -> list[Motion]:
        """Motions between successive photographs in `order`, with turns within groups."""
        pairs = zip(self.order, self.order[1:], strict=False)
        return [self._motion(self.angles[first], self.angles[second]) for first, second in pairs]

    @staticmethod
    def _motion(first: TurnAngles, second: TurnAngles) -> Motion:
        if first.group != second.group:
            return ON_THE_SPOT
        turn = float(wrap_angle(second.heading - first.heading))
        return replace(ON_THE_SPOT, turn=turn, turn_std=math.hypot(first.heading_sd, second.heading_sd))

    def in_order(self, found: SequenceLocalisation) -> SequenceLocalisation:
        """Return a localisation of the photographs in `order` as one in the order in which they were taken."""
        pictures = dict(zip(self.order, found.pictures, strict=True))
        return replace(found, pictures=[pictures[index] for index in range(len(pictures))])

    def warnings(self, hfov: float) -> list[str]:
        """Return a warning about angles that are assumed or had to be searched, for a field of view (radians)."""
        groups: dict[int, list[int]] = {}
        for index in self.order:
            groups.setdefault(self.angles[index].group, []).append(index)
        remedy = (
            f"turn by at most half the field of view, {math.degrees(0.5 * hfov):.0f}°, from one photograph to the "
            "next, or state the relative headings"
        )
        if len(groups) > 1:
            names = "; ".join(", ".join(f"photo[{index}]" for index in group) for group in groups.values())
            return [
                f"the photographs overlap only within {len(groups)} groups ({names}), so the angles between these were "
                f"searched: {remedy}"
            ]
        assumed = [index for index, angle in enumerate(self.angles) if angle.is_assumed]
        if not assumed:
            return []
        names = ", ".join(f"photo[{index}]" for index in assumed)
        sd_deg = math.degrees(max(self.angles[index].heading_sd for index in assumed))
        return [
            f"nothing links {names} to most others, as on plain walls, so their angles were assumed by their order, "
            f"within ± {2.0 * sd_deg:.0f}°, as of one turn in equal steps: {remedy}"
        ]


def localised_turn(found: Localisation, turns: Sequence[float]) -> SequenceLocalisation:
    """Return the localisation of photographs from one spot, which were one query, as one of each photograph.

    `turns` are their headings (radians) minus that of the query.
    """
    pictures = [replace(found, query=replace(found.query, roll=found.query.roll + turn)) for turn in turns]
    assert found.stage != "vdr"
    return SequenceLocalisation(pictures, found.posterior.position, found.stage, timings_ms=found.timings_ms)


def found_turns(found: SequenceLocalisation) -> list[float]:
    """Return the headings (radians) of the photographs of a sequence minus that of the first."""
    headings = [photograph_heading(picture.query, picture.candidates[0]) for picture in found.pictures]
    return [float(wrap_angle(heading - headings[0])) for heading in headings]


def judged_turn(found: SequenceLocalisation, joint: Localisation) -> SequenceLocalisation:
    """Return a turn whose angles were searched, with the confidence of one query of all its photographs.

    A view by itself fits many places, so the confidence of each view says little about all of them. `joint` is the
    localisation of the photographs as one query with the angles that were found (`found_turns`).
    """
    pictures = [
        replace(
            picture,
            query=replace(picture.query, is_turn=True),
            posterior=_judged(picture, joint.posterior),
            signals={picture.stage: joint.signals[joint.stage]},
            linked_fit=0.0,
        )
        for picture in found.pictures
    ]
    return replace(found, pictures=pictures, path_probability=min(picture.posterior.position for picture in pictures))


def _judged(picture: Localisation, joint: Posterior) -> Posterior:
    """Return the joint probabilities of a photograph's candidates."""
    support, left, shares = joint.support, joint.support.weight.copy(), []
    for candidate in picture.candidates:
        near = np.linalg.norm(support.position_m - candidate.position_m, axis=1) < RIGHT_WITHIN_M
        shares.append(float(left[near].sum()))
        left[near] = 0.0
    # Where the position is right, the heading is as sure as the sequence makes it.
    heading = shares[0] * picture.posterior.heading / max(picture.posterior.position, picture.posterior.heading, 1e-9)
    return replace(joint, position=shares[0], candidate=tuple(shares), heading=heading)
