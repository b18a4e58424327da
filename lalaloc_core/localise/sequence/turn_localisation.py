"""Photographs from one spot: one query that sees what all of them show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.localise.belief import RIGHT_WITHIN_M, Posterior, photograph_heading
from lalaloc_core.localise.search.pipeline import Localisation
from lalaloc_core.localise.sequence.sequence_search import SequenceLocalisation


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
