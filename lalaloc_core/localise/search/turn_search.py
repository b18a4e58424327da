"""Search of a turn: photographs of one spot are one query, once their headings relative to each other are known.

Headings that are not known are searched first, over the places p of the grid. With c_i(p, h) the matching cost of
photograph i under heading h, T the temperature, and r the first photograph of a group whose relative headings are
known up to a deviation,

    log P(p) = Σ_groups log Σ_{h_r} Π_{i in group} (ε + (1 - ε) / n_i Σ_{h_i} exp(-T c_i(p, h_i)) w(h_i - h_r - a_i)),

where w is a Gaussian about the stated or measured relative heading a_i with a floor, as one can be wrong, ε the share
of misread photographs, and n_i the mean of the sum over places and headings. The headings that are most probable at the
best place make one query of all photographs, which is searched as any other.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from lalaloc_core.bundle import Manifest
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import area_shares, or_misread
from lalaloc_core.localise.encode.layout_encoder import LayoutEncoder
from lalaloc_core.localise.match import MatchingConfig, MatchingCost, PlaceCost, PoseGrid
from lalaloc_core.localise.match.cost_terms import latent_distances
from lalaloc_core.localise.query import NO_HINTS, Candidate, Query
from lalaloc_core.localise.search.pipeline import Localisation, SearchStage
from lalaloc_core.photograph.overlap import LIKELY_SD

# Number of places whose headings are searched, and of pairs of a place and a heading of all photographs. They are the
# best by every n-th azimuth, n = `_STRIDE`, of so many photographs of the turn; near a known place there are `_NEAR`.
_MAX_PLACES, _MAX_PAIRS, _STRIDE, _MAX_CHOOSING, _NEAR = 2048, 2**18, 4, 8, 16
# Likelihood of a relative heading that is wrong, in units of that of an exact one, and the number of its standard
# deviations beyond which it is said to be.
_FLOOR, _CONTRADICTED = 1e-4, 4.0


class RelativeHeading(NamedTuple):
    """Heading (radians) of a photograph minus that of the first of its group, and its standard deviation."""

    group: int
    heading: float
    sd: float


class SearchedTurn(NamedTuple):
    """Headings (radians) minus that of the first photograph, and the photographs whose relative heading is wrong."""

    headings: list[float]
    contradicted: tuple[int, ...] = ()


@dataclass(frozen=True)
class TurnLocalisation:
    """Localisation of photographs of one spot.

    Attributes:
        joint: localisation of all as one query; of the sphere alone, if one of them is a full sphere.
        headings: heading (radians) of each photograph minus that of the query.
        contradicted: numbers of the photographs whose stated or measured relative heading is wrong.
    """

    joint: Localisation
    headings: Sequence[float]
    contradicted: tuple[int, ...] = ()

    @property
    def pictures(self) -> list[Localisation]:
        """Localisation of each photograph."""
        query = self.joint.query
        return [replace(self.joint, query=replace(query, roll=query.roll + heading)) for heading in self.headings]

    @property
    def turns(self) -> list[float]:
        """Headings (radians) minus that of the first photograph."""
        return [float(wrap_angle(heading - self.headings[0])) for heading in self.headings]

    @property
    def stage(self) -> SearchStage:
        """Last stage of the search."""
        return self.joint.stage

    def confidence(self, manifest: Manifest, share: float = 1.0) -> float | None:
        """Return the probability that the place is right; `share` is that of the plans that were searched."""
        query = self.joint.query
        found = self.joint.confidence(manifest.confidence_for(view=query.is_view, turn=query.is_turn), share)
        return None if found is None else found.position


def searched_turn(
    plan: FloorPlan,
    grid: PoseGrid,
    encoder: LayoutEncoder,
    queries: Sequence[Query],
    relative: Sequence[RelativeHeading],
    matching: MatchingConfig,
    place: Candidate | None = None,
) -> Generator[None, Any, SearchedTurn]:
    """Search relative headings of photographs of one spot, near their place if it is known; yields None in pauses."""

    def log_likelihood(query: Query, index: np.ndarray, stride: int = 1) -> Float[np.ndarray, "p k"]:
        """Return the log likelihood of some poses under each hypothesis, by every so many azimuths."""
        weights = encoder.manifest.evidence_for(view=query.is_view)
        if matching.compares_profiles(query):
            layouts, reach_m = grid.layouts(plan).rows(index), matching.grid_reach * grid.step_m
            cost, _ = MatchingCost(plan, query, reach_m, weights, matching, stride=stride).costs(layouts)
        else:
            cost = latent_distances(grid.known_latents[index], query.latents)
        found = -weights.temperature * cost.T.astype(np.float64)
        places = PlaceCost.of(plan, query, NO_HINTS, 1.0, grid.poses.position_m[index], grid.poses.room_index[index])
        return found if places is None else found - places.of_poses(np.arange(len(index)))

    pairs = _MAX_PAIRS // sum(len(query.roll) for query in queries)
    index, most = np.arange(len(grid.poses)), max(min(_MAX_PLACES, pairs), 1)
    if place is not None:
        index = np.flatnonzero(grid.poses.room_index == place.room_index)
        distance_m = np.linalg.norm(grid.poses.position_m[index] - place.position_m, axis=1)
        index = np.sort(index[distance_m.argsort()[:_NEAR]])
    elif len(index) > most:
        total = np.zeros(len(index))
        for number in np.linspace(0, len(queries) - 1, min(len(queries), _MAX_CHOOSING)).round().astype(int):
            total += log_likelihood(queries[number], index, stride=_STRIDE).max(axis=1)
            yield None
        index = np.sort(np.argpartition(-total, most)[:most])
    seen = []
    for query in queries:
        seen.append(log_likelihood(query, index))
        yield None
    heading = [query.roll + query.frame_heading for query in queries]
    prior = area_shares(grid.poses, plan.areas_m2)[index]
    return _most_probable(seen, heading, relative, prior, encoder.manifest.album.misread)


def _most_probable(
    seen: Sequence[Float[np.ndarray, "p _"]],
    heading: Sequence[Float[np.ndarray, "_"]],
    relative: Sequence[RelativeHeading],
    prior: Float[np.ndarray, "p"],
    misread: float,
) -> SearchedTurn:
    """Return the most probable headings at the most probable place.

    `seen` has the log likelihood by place and hypothesis of each photograph, `heading` the headings of its hypotheses,
    and `misread` is the probability that one of them fits all places alike.
    """

    def bounded(log: Float[np.ndarray, "p k"]) -> Float[np.ndarray, "p k"]:
        usual = np.logaddexp.reduce((log + prior[:, None]).ravel()) - np.logaddexp.reduce(prior)
        return or_misread(log - usual + math.log(log.shape[1]), misread)

    first = {angle.group: number for number, angle in reversed(list(enumerate(relative)))}
    groups = {group: bounded(seen[number]) for group, number in first.items()}
    linked = {}
    for number, angle in enumerate(relative):
        reference = first[angle.group]
        if number != reference:
            off = wrap_angle(heading[number][:, None] - heading[reference] - angle.heading)
            linked[number] = np.exp(-0.5 * np.square(off / _deviation(angle, heading[number]))) + _FLOOR
            best = seen[number].max(axis=1, keepdims=True)
            groups[angle.group] += bounded(np.log(np.exp(seen[number] - best) @ linked[number]) + best)
    total = prior + sum(np.logaddexp.reduce(log_likelihood, axis=1) for log_likelihood in groups.values())
    place = int(total.argmax())
    references = {group: _peak(found[place], heading[first[group]]) for group, found in groups.items()}
    headings, contradicted = [], []
    for number, angle in enumerate(relative):
        column, reference = references[angle.group]
        if number not in linked:
            headings.append(reference)
            continue
        _, own = _peak(seen[number][place] + np.log(linked[number][:, column]), heading[number])
        off = float(wrap_angle(own - reference - angle.heading))
        is_wrong = abs(off) > _CONTRADICTED * _deviation(angle, heading[number])
        # Hypotheses are steps apart; an angle that is known better stays as it is.
        headings.append(reference + angle.heading if angle.sd <= LIKELY_SD and not is_wrong else own)
        contradicted += [number] if is_wrong else []
    return SearchedTurn([float(wrap_angle(each - headings[0])) for each in headings], tuple(contradicted))


def _peak(log_likelihood: Float[np.ndarray, "k"], heading: Float[np.ndarray, "k"]) -> tuple[int, float]:
    """Return the best hypothesis, and the heading at the vertex of the parabola through it and its neighbours."""
    best, count = int(log_likelihood.argmax()), len(heading)
    if count < 3:
        return best, float(heading[best])
    before, at, after = (log_likelihood[(best + step) % count] for step in (-1, 0, 1))
    curvature = before - 2.0 * at + after
    shift = 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0
    return best, float(heading[best] + shift * (heading[1] - heading[0]))


def _deviation(angle: RelativeHeading, heading: Float[np.ndarray, "_"]) -> float:
    """Return the deviation of a relative heading, with that of hypotheses from the photograph's own heading."""
    step = float(heading[1] - heading[0]) if len(heading) > 1 else 0.0
    return math.hypot(angle.sd, 0.5 * step) or math.radians(0.01)
