"""Headings of photographs of a turn that overlap with no other, by the order in which they were taken.

A turn goes one way. Between two photographs that do not overlap, directly or by others, it goes on by a step: that of
the film's optical flow, or, once around in photographs, about the step of those that do overlap. The headings are those
of least squares over all steps, and overlap is exact beside them: a turn that closes spreads what the steps miss.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.photograph.overlap import Link

# Standard deviation (radians) of headings up to which a turn is read as one picture.
LIKELY_SD = math.radians(12.0)
# Standard deviation of a step that is assumed, as a share of it.
_STEP_SHARE = 0.2
# Least number of links, and their least share, that agree on the step of a turn once around; largest difference of
# their steps, as a share, and of the turn that the step makes of all photographs from a whole one.
_MIN_LINKS, _MIN_SHARE, _MAX_UNLIKE, _MAX_OPEN = 2, 0.6, 0.4, 0.25
# Standard deviations beyond which a link contradicts the steps.
_CONTRADICTED = 4.0


class Step(NamedTuple):
    """Turn (radians) from a photograph to the next one, and its standard deviation."""

    turn: float
    sd: float


def usual_steps(count: int, links: Sequence[Link]) -> list[Step] | None:
    """Return the steps of photographs that go once around, from each to the next and from the last to the first.

    None if links do not tell that the photographs go once around in about equal steps.
    """
    apart = np.array([_apart(link, count) for link in links])
    turn = np.array([link.turn for link in links])
    near = np.abs(apart) <= 2
    if near.sum() < _MIN_LINKS:
        return None
    step = turn[near] / apart[near]
    usual = float(np.median(step))
    alike = np.abs(step - usual) < _MAX_UNLIKE * abs(usual)
    if alike.sum() < max(_MIN_LINKS, _MIN_SHARE * len(step)):
        return None
    whole = math.copysign(TWO_PI, usual) / count
    if abs(usual / whole - 1.0) > _MAX_OPEN:
        return None
    return [Step(whole, _STEP_SHARE * abs(whole))] * count


def _apart(link: Link, count: int) -> int:
    """Return the steps from the first photograph of a link to the second, the shorter way around."""
    steps = link.second - link.first
    return steps if 2 * steps <= count else steps - count


def agreeing_links(links: Sequence[Link], count: int, steps: Sequence[Step]) -> list[Link]:
    """Return the links that do not contradict the steps of a turn: patterns repeat around a room."""
    turn, sd = np.array(steps).T
    reckoned, variance = (np.concatenate([[0.0], np.cumsum(values)]) for values in (turn, np.square(sd)))

    def agrees(link: Link) -> bool:
        between = abs(variance[link.second] - variance[link.first])
        if len(steps) == count:
            between = min(between, variance[-1] - between)
        missed = wrap_angle(link.turn - (reckoned[link.second] - reckoned[link.first]))
        return abs(float(missed)) < _CONTRADICTED * math.sqrt(between)

    return [link for link in links if agrees(link)]


def headings_in_order(
    group: Int[np.ndarray, "n"], heading: Float[np.ndarray, "n"], steps: Sequence[Step]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return headings of all photographs minus that of the first, and the deviations of the places of their groups.

    Args:
        group: numbers of the groups of photographs that overlap, from 0.
        heading: headings (radians) within the groups.
        steps: from each photograph to the next one, and for turns that close from the last to the first.
    """
    first = np.arange(len(steps))
    second = (first + 1) % len(group)
    turn, sd = np.array(steps).T
    placed = _placed(group, heading, np.concatenate([[0.0], np.cumsum(turn[: len(group) - 1])]))
    across = np.flatnonzero(group[first] != group[second])
    # Unknowns: what is to be added to the headings of each group but the largest.
    slope = np.zeros((len(across), int(group.max()) + 1))
    rows = np.arange(len(across))
    slope[rows, group[second[across]]] += 1.0 / sd[across]
    slope[rows, group[first[across]]] -= 1.0 / sd[across]
    missed = wrap_angle(turn - (placed[second] - placed[first]))[across] / sd[across]
    main = int(np.bincount(group).argmax())
    free = np.delete(slope, main, axis=1)
    covariance = np.linalg.inv(free.T @ free)
    added = np.insert(covariance @ (free.T @ missed), main, 0.0)
    group_sd = np.insert(np.sqrt(np.diag(covariance)), main, 0.0)
    placed = placed + added[group]
    return wrap_angle(placed - placed[0]), group_sd[group]


def _placed(
    group: Int[np.ndarray, "n"], heading: Float[np.ndarray, "n"], reckoned: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Return headings within groups, each group and each of its turns around where the steps alone lead."""
    placed = heading.copy()
    for number in range(int(group.max()) + 1):
        members = np.flatnonzero(group == number)
        offset = reckoned[members] - heading[members]
        placed[members] += offset - wrap_angle(offset - offset[0])
    return placed
