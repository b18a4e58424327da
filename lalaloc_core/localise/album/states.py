"""States of an album's photographs: poses with headings, as overlap and compasses change their evidence."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.localise.album.evidence import Arrays, log_sums
from lalaloc_core.localise.belief import or_misread, suppress

# Deviation (radians) of a turn by overlap, and probability that it is wrong.
_TURN_SD, _WRONG_TURN = math.radians(4.0), 0.02
# Of headings by a compass, indoors, and the probability that one is wrong; least number that tells a common bias.
_COMPASS_SD, _WRONG_COMPASS, _MIN_COMPASSES = math.radians(15.0), 0.1, 3
# Deviation (radians) of the bias from the plan's north, if that is known.
_NORTH_SD = math.radians(20.0)
_HEADINGS = 128
# Distinct places of a room, and their distance (m).
_MODES, _SEPARATION_M = 3, 1.0


@dataclass(frozen=True, eq=False)
class States:
    """States of one photograph: m poses with headings that are kept of all.

    Attributes:
        pose: (m,) number of the pose in the grid.
        room: (m,) number of its room.
        heading: (m,) azimuth of the photograph's centre, radians.
        log: (m,) log likelihood, over that of poses of other homes (`evidence.single_evidence`).
        rooms: (r,) the same of each room, over its poses and all headings.
        photographs: number of photographs whose evidence these sum up.
    """

    pose: Int[np.ndarray, "m"]
    position_m: Float[np.ndarray, "m 2"]
    room: Int[np.ndarray, "m"]
    heading: Float[np.ndarray, "m"]
    log: Float[np.ndarray, "m"]
    rooms: Float[np.ndarray, "r"]
    photographs: int = 1

    @classmethod
    def of(cls, arrays: Arrays, headings: int) -> States:
        """Return the states of `evidence.single_evidence`, for a number of headings around the horizon."""
        return cls(
            pose=arrays["pose"],
            position_m=arrays["position_m"].astype(float),
            room=arrays["room"],
            heading=arrays["hypothesis"] * (TWO_PI / headings),
            log=arrays["log_likelihood"].astype(float),
            rooms=arrays["rooms"].astype(float),
        )

    def evidence(self, misread: float) -> Float[np.ndarray, "r"]:
        """Return the log likelihood of every room for one of the photographs, which is misread with a probability.

        Each photograph of a spot has the evidence of all, which counts once for all of them.
        """
        return or_misread(self.rooms / self.photographs, misread)

    def changed(self, log: Float[np.ndarray, "m"], photographs: int | None = None) -> States:
        """Return the states with another log likelihood; that of rooms changes with that of the states kept of each."""
        before, after = (log_sums(each, self.room, len(self.rooms)) for each in (self.log, log))
        known = np.isfinite(before)
        rooms = self.rooms.copy()
        rooms[known] += after[known] - before[known]
        return replace(self, log=log, rooms=rooms, photographs=photographs or self.photographs)

    def modes(self, room: int) -> tuple[Int[np.ndarray, "k"], Float[np.ndarray, "k"]]:
        """Return distinct states of a room, best first, and their shares of its probability."""
        rows = np.flatnonzero(self.room == room)
        if not len(rows):
            return rows, np.zeros(0)
        kept = suppress(
            self.position_m[rows], -self.log[rows], separation_m=_SEPARATION_M, limit=_MODES, heading=self.heading[rows]
        )
        chosen = rows[kept]
        share = np.exp(self.log[chosen] - self.log[chosen[0]])
        return chosen, share / share.sum()

    @property
    def heading_log(self) -> Float[np.ndarray, "h"]:
        """Log probability of every heading, by columns of the horizon."""
        column = np.rint(self.heading / TWO_PI * _HEADINGS).astype(int) % _HEADINGS
        best = np.full(_HEADINGS, self.log.min(initial=0.0))
        np.maximum.at(best, column, self.log)
        return best - np.logaddexp.reduce(best)


def turned_together(states: Sequence[States], turns: Mapping[tuple[int, int], float], poses: int) -> list[States]:
    """Return states with the evidence of photographs from the same spot, whose turns (radians) are known.

    A state counts by the best state of the other photograph at its pose with the heading that the turn tells.
    """
    found, photographs = [state.log.copy() for state in states], [state.photographs for state in states]
    step = TWO_PI / _HEADINGS
    spread = -0.5 * np.square(np.arange(-2, 3) * step / _TURN_SD)
    linked: defaultdict[int, list[tuple[int, float]]] = defaultdict(list)
    for (first, second), turn in turns.items():
        linked[second].append((first, turn))
        linked[first].append((second, -turn))
    # One large table at a time, as many photographs can be of one spot.
    for other, owns in linked.items():
        column = np.rint(states[other].heading / step).astype(int)
        table = np.full((poses, _HEADINGS), float(states[other].log.min(initial=0.0)))
        for apart, penalty in zip(range(-2, 3), spread, strict=True):
            np.maximum.at(table, (states[other].pose, (column + apart) % _HEADINGS), states[other].log + penalty)
        for own, change in owns:
            wanted = np.rint((states[own].heading + change) / step).astype(int) % _HEADINGS
            seen = table[states[own].pose, wanted]
            # With a wrong turn, the other photograph can be anywhere.
            found[own] += np.logaddexp(seen + math.log1p(-_WRONG_TURN), math.log(_WRONG_TURN))
            photographs[own] += 1
    return [state.changed(log, count) for state, log, count in zip(states, found, photographs, strict=True)]


def by_compass(
    states: Sequence[States], compass: Sequence[float | None], north: float | None
) -> tuple[list[States], float | None]:
    """Return states with the evidence of compass headings, and the azimuth of the compass's north in the plan.

    `compass` has the headings (radians) of the photographs clockwise from true north, all with one unknown bias, and
    `north` is the azimuth of true north in the plan; None where unknown. The compass's is None if too few have one.
    """
    known = [number for number, heading in enumerate(compass) if heading is not None]
    if len(known) < (_MIN_COMPASSES if north is None else 1):
        return list(states), None
    bias = np.arange(_HEADINGS) * (TWO_PI / _HEADINGS)
    total = np.zeros(_HEADINGS)
    if north is not None:
        total -= 0.5 * np.square(wrap_angle(bias - north) / _NORTH_SD)
    off = wrap_angle(bias[:, None] - bias[None, :])
    kernel = (1.0 - _WRONG_COMPASS) * np.exp(-0.5 * np.square(off / _COMPASS_SD)) + _WRONG_COMPASS / _HEADINGS
    for number in known:
        shift = round((compass[number] or 0.0) / TWO_PI * _HEADINGS)
        likely = kernel @ np.exp(states[number].heading_log)
        total += np.log(np.roll(likely, -shift))
    best = float(bias[int(total.argmax())])
    found, usual = list(states), (1.0 - _WRONG_COMPASS) * _COMPASS_SD / math.sqrt(TWO_PI) + _WRONG_COMPASS
    for number in known:
        missed = wrap_angle(states[number].heading - (compass[number] or 0.0) - best)
        fits = (1.0 - _WRONG_COMPASS) * np.exp(-0.5 * np.square(missed / _COMPASS_SD)) + _WRONG_COMPASS
        # Over any heading, as likelihoods are over those of other homes.
        found[number] = states[number].changed(states[number].log + np.log(fits / usual))
    return found, best
