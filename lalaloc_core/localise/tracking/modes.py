"""States that a photograph was compared with, and the modes of the belief among them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.localise.belief import (
    HEADING_SEPARATION,
    Posterior,
    photograph_heading,
    posterior_from_weights,
    suppress,
)
from lalaloc_core.localise.match import PoseGrid, grid_candidate
from lalaloc_core.localise.query import Candidate, Query
from lalaloc_core.localise.search.pipeline import LocaliseConfig

# Modes that are refined while the belief is spread, and while one mode holds nearly all of it.
_MODES, _FEW_MODES, _SETTLED = 12, 3, 0.98


class Compared(NamedTuple):
    """States that a photograph was compared with: their costs, height offsets, and weights.

    `rest` is the weight of all other states, and `outlier` the likelihood of an outlier, relative to the best pose.
    """

    pose: Int[np.ndarray, "m"]
    sector: Int[np.ndarray, "m"]
    cost: Float[np.ndarray, "m"]
    offset: Float[np.ndarray, "m"]
    weight: Float[np.ndarray, "m"]
    rest: float
    outlier: float

    def only(self, kept: np.ndarray) -> Compared:
        """Return some of the states; the others join the rest."""
        rest = self.rest + float(self.weight[~kept].sum())
        pose, sector, cost, offset, weight = (part[kept] for part in self[:5])
        return Compared(pose, sector, cost, offset, weight, rest, self.outlier)


def sector_of(query: Query, hypothesis: Int[np.ndarray, "m"]) -> Int[np.ndarray, "m"]:
    """Return the nearest sector of the belief to hypotheses of the query."""
    sectors = len(query.roll)
    return np.rint((query.roll + query.frame_heading) / (TWO_PI / sectors)).astype(int)[hypothesis] % sectors


def hypothesis_of(query: Query) -> Int[np.ndarray, "k"]:
    """Return the hypothesis of each sector."""
    found = np.empty(len(query.roll), int)
    found[sector_of(query, np.arange(len(query.roll)))] = np.arange(len(query.roll))
    return found


def relative_likelihood(modes: list[Candidate], temperature: float, outlier: float) -> Float[np.ndarray, "r"]:
    """Return the likelihood of the photograph at some modes, relative to the best of them."""
    cost = np.array([mode.cost for mode in modes])
    return np.exp(-temperature * (cost - cost.min())) + outlier


def modes_of(grid: PoseGrid, query: Query, compared: Compared, config: LocaliseConfig) -> list[Candidate]:
    """Return the modes of the belief, the most probable first."""
    hypothesis = hypothesis_of(query)[compared.sector]
    kept = suppress(
        grid.poses.position_m[compared.pose],
        -np.log(np.maximum(compared.weight, 1e-30)),
        separation_m=config.separation_m,
        limit=_MODES,
        heading=query.roll[hypothesis],
    )
    near = np.linalg.norm(grid.poses.position_m[compared.pose] - grid.poses.position_m[compared.pose[kept[0]]], axis=1)
    if compared.weight[near < config.separation_m].sum() > _SETTLED:
        kept = kept[:_FEW_MODES]
    return [
        grid_candidate(
            grid,
            int(compared.pose[index]),
            query,
            int(hypothesis[index]),
            cost=float(compared.cost[index]),
            height_offset=float(compared.offset[index]),
        )
        for index in kept
    ]


def _of_mode(
    position_m: Float[np.ndarray, "m 2"],
    heading: Float[np.ndarray, "m"],
    mode: Candidate,
    query: Query,
    radius_m: float,
) -> np.ndarray:
    """Return which states belong to a mode."""
    near = np.linalg.norm(position_m - mode.position_m, axis=1) < radius_m
    return near & (np.abs(wrap_angle(heading - photograph_heading(query, mode))) <= HEADING_SEPARATION)


def share_alone(
    grid: PoseGrid, query: Query, compared: Compared, mode: Candidate, temperature: float, radius_m: float
) -> float:
    """Return the probability of a mode by the photograph alone, without the photographs before it."""
    value = np.exp(-temperature * (compared.cost - compared.cost.min()))
    heading = query.roll[hypothesis_of(query)[compared.sector]] + query.frame_heading
    member = _of_mode(grid.poses.position_m[compared.pose], heading, mode, query, radius_m)
    return float(value[member].sum() / value.sum())


def regained(
    grid: PoseGrid,
    query: Query,
    compared: Compared,
    starts: list[Candidate],
    ends: list[Candidate],
    temperature: float,
    radius_m: float,
) -> Compared:
    """Return the states with the modes weighed by the gains of their refinement."""
    before, after = (relative_likelihood(modes, temperature, compared.outlier) for modes in (starts, ends))
    gains = after / before
    gains = gains / np.median(gains)
    position = grid.poses.position_m[compared.pose]
    heading = query.roll[hypothesis_of(query)[compared.sector]] + query.frame_heading
    factor, free = np.ones(len(position)), np.ones(len(position), bool)
    for start, gain in zip(starts, gains, strict=True):
        member = free & _of_mode(position, heading, start, query, radius_m)
        factor[member] = gain
        free &= ~member
    weight = compared.weight * factor
    total = float(weight.sum()) + compared.rest
    return compared._replace(weight=weight / total, rest=compared.rest / total)


def ranked_modes(
    grid: PoseGrid,
    query: Query,
    compared: Compared,
    starts: list[Candidate],
    ends: list[Candidate],
    config: LocaliseConfig,
    top_k: int,
) -> tuple[list[Candidate], Posterior]:
    """Return the refined modes by falling probability, and the posterior at their places."""
    hypothesis = hypothesis_of(query)[compared.sector]
    position = grid.poses.position_m[compared.pose].copy()
    heading = query.roll[hypothesis] + query.frame_heading
    member = [_of_mode(position, heading, start, query, config.separation_m) for start in starts]
    mass = np.zeros(len(starts))
    free = np.ones(len(position), bool)
    for index, (start, end) in enumerate(zip(starts, ends, strict=True)):
        own = member[index] & free
        free &= ~own
        mass[index] = compared.weight[own].sum()
        position[own] += end.position_m - start.position_m
        # The refined heading is far more accurate than a sector.
        heading[own] = photograph_heading(query, end)
    order = np.argsort(-mass, kind="stable")
    kept = suppress(
        np.stack([ends[index].position_m for index in order]),
        np.arange(len(order), dtype=float),
        separation_m=config.separation_m,
        limit=top_k,
        heading=np.array([photograph_heading(query, ends[index]) for index in order]),
    )
    candidates = [ends[order[index]] for index in kept]
    posterior = posterior_from_weights(
        query,
        candidates,
        pose=compared.pose,
        position=position,
        heading=heading,
        weight=compared.weight,
        poses=len(grid.poses),
    )
    return candidates, posterior
