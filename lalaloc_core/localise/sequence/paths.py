"""Posterior over paths, and over the places of every picture.

As in `localise.belief.posterior`, refinement finds the depth of a path's minimum. The states around a path are its
*basin*. The probability of a refined path follows from its negative log likelihood, with all basins as wide as that of
the likeliest path on the grid; all other paths gain the median.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.localise.belief import HEADING_SEPARATION, Posterior, posterior_from_weights
from lalaloc_core.localise.query import Candidate, Query
from lalaloc_core.localise.sequence.chain import Marginals, forward_backward
from lalaloc_core.localise.sequence.motion import States, Transition
from lalaloc_core.render.sampling import PoseSet

# States below this probability are left out.
_NEGLIGIBLE = 1e-9


@dataclass(frozen=True, eq=False)
class Observation:
    """One picture of the chain.

    Attributes:
        weights: of its matching cost.
        index: (n,) numbers of the grid poses that are its states, under each of k hypotheses.
        cost: (j, n, k) matching cost by height, pose and hypothesis.
        log_likelihood: (j, n, k) log likelihood with the prior of the state.
        doubted: whether a heading was given that the picture contradicts.
    """

    query: Query
    weights: MatchingWeights
    index: np.ndarray
    states: States
    cost: Float[np.ndarray, "j n k"]
    log_likelihood: Float[np.ndarray, "j n k"]
    doubted: bool


@dataclass(frozen=True, eq=False)
class Path:
    """One path: a state of each picture on the grid, and its refined pose.

    Attributes:
        states: row-major numbers of the states.
        starts: the states as candidates.
        nll: negative log likelihood on the grid.
        ends: the refined candidates.
        refined_nll: negative log likelihood after refinement; None without.
    """

    states: tuple[int, ...]
    starts: tuple[Candidate, ...]
    nll: float
    ends: tuple[Candidate, ...]
    refined_nll: float | None = None


@dataclass(frozen=True, eq=False)
class PathPosterior:
    """Probability of each path, and the posterior of every picture."""

    path: Float[np.ndarray, "m"]
    pictures: list[Posterior]


@dataclass(frozen=True, eq=False)
class _Basin:
    """States around a path: their numbers by picture, and the marginals of the chain among them."""

    kept: list[np.ndarray]
    marginals: Marginals


def path_posterior(
    pictures: Sequence[Observation],
    transitions: Sequence[Transition],
    paths: Sequence[Path],
    *,
    poses: PoseSet,
    log_heights: Float[np.ndarray, "j"],
    whole: Marginals,
    candidates: Sequence[Sequence[Candidate]],
    separation_m: float,
) -> PathPosterior:
    """Return the posterior over paths.

    `log_heights` is the log prior of the heights, `whole` the marginals of the chain over all states, and
    `separation_m` the radius of a basin. `candidates` are, for each picture, those whose probability is wanted, the
    answer first.
    """
    basins = [_basin(pictures, transitions, log_heights, path, separation_m) for path in paths]
    log_mass = np.array([basin.marginals.log_evidence for basin in basins])
    on_grid = np.exp(log_mass - whole.log_evidence)
    left = max(1.0 - float(on_grid.sum()), 0.0)
    with np.errstate(divide="ignore"):
        log_rest = whole.log_evidence + np.log(left)
    if paths[0].refined_nll is not None:
        nll = np.array([path.refined_nll for path in paths], dtype=float)
        likeliest = int(nll.argmin())
        gains = np.array([path.nll for path in paths]) - nll
        log_mass = log_mass[likeliest] + paths[likeliest].nll - nll
        log_rest += float(np.median(gains))
    highest = max(float(log_mass.max()), float(log_rest))
    mass, rest = np.exp(log_mass - highest), float(np.exp(log_rest - highest))
    total = float(mass.sum()) + rest
    mass, rest = mass / total, rest / total
    found = []
    for t, picture in enumerate(pictures):
        weight = whole.state[t].copy()
        for basin, share in zip(basins, on_grid, strict=True):
            weight[basin.kept[t]] -= share * basin.marginals.state[t]
        weight = np.maximum(weight, 0.0)
        weight *= rest / max(float(weight.sum()), _NEGLIGIBLE)
        parts = [_weighted(picture, weight, None)]
        for path, basin, share in zip(paths, basins, mass, strict=True):
            inside = np.zeros_like(weight)
            inside[basin.kept[t]] = share * basin.marginals.state[t]
            moved = None if path.refined_nll is None else (path.starts[t], path.ends[t])
            parts.append(_weighted(picture, inside, moved))
        position, heading, value, pose = (np.concatenate(values) for values in zip(*parts, strict=True))
        found.append(
            posterior_from_weights(
                picture.query,
                candidates[t],
                pose=pose,
                position=position,
                heading=heading,
                weight=value,
                poses=len(poses),
            )
        )
    return PathPosterior(mass, found)


def _weighted(
    picture: Observation, weight: Float[np.ndarray, "n k"], moved: tuple[Candidate, Candidate] | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return places, headings, weights and grid poses of the probable states, moved and turned by refinement."""
    row, hypothesis = np.nonzero(weight > _NEGLIGIBLE)
    position = picture.states.position_m[row].copy()
    heading = picture.states.heading[hypothesis].copy()
    if moved is not None:
        start, end = moved
        position += end.position_m - start.position_m
        # The refined heading is far more accurate than a sector.
        heading[:] = picture.query.roll[end.hypothesis] + end.frame_heading
    return position, heading, weight[row, hypothesis], picture.index[row]


def _basin(
    pictures: Sequence[Observation],
    transitions: Sequence[Transition],
    log_heights: Float[np.ndarray, "j"],
    path: Path,
    separation_m: float,
) -> _Basin:
    """Return the states around a path at about its headings."""
    kept, inside = [], []
    for picture, start in zip(pictures, path.starts, strict=True):
        near = np.linalg.norm(picture.states.position_m - start.position_m, axis=1) < separation_m
        rows = np.flatnonzero(near)
        heading = picture.query.roll[start.hypothesis] + start.frame_heading
        turned = np.abs(wrap_angle(picture.states.heading - heading)) > HEADING_SEPARATION
        likelihood = picture.log_likelihood[:, rows].copy()
        likelihood[:, :, turned] = -np.inf
        kept.append(rows)
        inside.append(likelihood)
    among = [transition.among(*pair) for transition, pair in zip(transitions, itertools.pairwise(kept), strict=True)]
    return _Basin(kept, forward_backward(inside, among, log_heights))
