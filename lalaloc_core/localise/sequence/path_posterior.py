"""Chain of pictures with the paths through it: the posterior over paths, and over the places of every picture.

As in `localise.belief.posterior`, refinement finds the depth of a path's minimum. The states around a path are its
*basin*. The probability of a refined path follows from its negative log likelihood, with all basins as wide as that of
the likeliest path on the grid; all other paths gain the median.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.localise.belief import HEADING_SEPARATION, Posterior, WeightedPlaces, photograph_heading
from lalaloc_core.localise.query import Candidate, Query
from lalaloc_core.localise.sequence.chain_inference import Marginals, forward_backward
from lalaloc_core.localise.sequence.measured_motion import Motion, States, Transition

# States below this probability are left out.
_NEGLIGIBLE = 1e-9
# Deviation of the log of a carried camera's height from one picture to another.
_HEIGHT_APART = 0.05


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
class PictureChain:
    """Pictures in the order in which they were taken, and the motions between neighbours.

    `log_heights` is the log prior of the heights that are tried.
    """

    pictures: list[Observation]
    motions: Sequence[Motion]
    transitions: list[Transition]
    log_heights: Float[np.ndarray, "j"]

    @cached_property
    def marginals(self) -> Marginals:
        """Marginals of the chain over all states."""
        likelihoods = [picture.log_likelihood for picture in self.pictures]
        return forward_backward(likelihoods, self.transitions, self.log_heights)

    @property
    def height_apart(self) -> float:
        """Deviation of log heights between pictures; 0 if their heights are exact or stated one by one."""
        heights = {picture.query.camera_height for picture in self.pictures}
        return _HEIGHT_APART if len(heights) == 1 and not self.pictures[0].query.camera_height.is_exact else 0.0

    def headings(self, path: Sequence[Candidate]) -> Float[np.ndarray, "t"]:
        """Return the headings (radians) of all pictures along a path."""
        pairs = zip(self.pictures, path, strict=True)
        return np.array([photograph_heading(picture.query, pose) for picture, pose in pairs])

    def are_alike(
        self, path: Sequence[Candidate], other: Sequence[Candidate], within_m: float, within_angle: float
    ) -> bool:
        """Return whether two paths have about the same places and headings in every picture."""
        pairs = zip(path, other, strict=True)
        apart_m = [np.linalg.norm(first.position_m - second.position_m) for first, second in pairs]
        turned = np.abs(wrap_angle(self.headings(path) - self.headings(other)))
        return bool(max(apart_m) < within_m and turned.max() <= within_angle)

    def basin(self, path: Path, separation_m: float) -> tuple[list[np.ndarray], Marginals]:
        """Return the states around a path at about its headings: their numbers by picture, and their marginals."""
        kept, inside = [], []
        for picture, start in zip(self.pictures, path.starts, strict=True):
            near = np.linalg.norm(picture.states.position_m - start.position_m, axis=1) < separation_m
            rows = np.flatnonzero(near)
            heading = picture.query.roll[start.hypothesis] + start.frame_heading
            turned = np.abs(wrap_angle(picture.states.heading - heading)) > HEADING_SEPARATION
            likelihood = picture.log_likelihood[:, rows].copy()
            likelihood[:, :, turned] = -np.inf
            kept.append(rows)
            inside.append(likelihood)
        pairs = zip(self.transitions, itertools.pairwise(kept), strict=True)
        return kept, forward_backward(inside, [transition.among(*pair) for transition, pair in pairs], self.log_heights)

    def posterior(
        self, paths: Sequence[Path], candidates: Sequence[Sequence[Candidate]], *, poses: int, separation_m: float
    ) -> tuple[Float[np.ndarray, "m"], list[Posterior]]:
        """Return the probability of each path, and the posterior of every picture.

        `candidates` are, for each picture, those whose probability is wanted, the answer first; `poses` is the number
        of grid poses, and `separation_m` the radius of a basin.
        """
        whole, basins = self.marginals, [self.basin(path, separation_m) for path in paths]
        log_mass = np.array([marginals.log_evidence for _, marginals in basins])
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
        for t, picture in enumerate(self.pictures):
            weight = whole.state[t].copy()
            for (kept, marginals), share in zip(basins, on_grid, strict=True):
                weight[kept[t]] -= share * marginals.state[t]
            weight = np.maximum(weight, 0.0)
            weight *= rest / max(float(weight.sum()), _NEGLIGIBLE)
            parts = [_weighted(picture, weight, None)]
            for path, (kept, marginals), share in zip(paths, basins, mass, strict=True):
                inside = np.zeros_like(weight)
                inside[kept[t]] = share * marginals.state[t]
                moved = None if path.refined_nll is None else (path.starts[t], path.ends[t])
                parts.append(_weighted(picture, inside, moved))
            pose, position, heading, value = (np.concatenate(values) for values in zip(*parts, strict=True))
            found.append(WeightedPlaces(picture.query, pose, position, heading, value, poses).posterior(candidates[t]))
        return mass, found


def _weighted(
    picture: Observation, weight: Float[np.ndarray, "n k"], moved: tuple[Candidate, Candidate] | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return grid poses, places, headings and weights of the probable states, moved and turned by refinement."""
    row, hypothesis = np.nonzero(weight > _NEGLIGIBLE)
    position = picture.states.position_m[row].copy()
    heading = picture.states.heading[hypothesis].copy()
    if moved is not None:
        start, end = moved
        position += end.position_m - start.position_m
        # The refined heading is far more accurate than a sector.
        heading[:] = picture.query.roll[end.hypothesis] + end.frame_heading
    return picture.index[row], position, heading, weight[row, hypothesis]
