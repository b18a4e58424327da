"""Which of many plans a panorama was taken in: a first look at a few poses of each.

The *prototypes* of a plan are one pose of its latent grid for every square of two grid steps and every room, with the
wall profile at 32 azimuths and the floor that it stands for. They are compared with the panorama as all poses are, by
walls alone, and give every plan a probability; the plans that have most of it are then searched in full.

    mass(plan) = sum over its prototypes and the hypotheses of  floor · exp(-T walls)

What the plans left out would have weighed is estimated (`share_searched`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.bundle import EvidenceModel
from lalaloc_core.localise.evidence import EvidenceConfig, precisions
from lalaloc_core.localise.poses import LatentGrid, Query

AZIMUTHS = 32
# Prototypes are so many grid steps apart.
_STEPS = 2
# Camera heights whose logs are nearer than this are not told apart by prototypes, whose distances are farther off.
_OFFSETS_APART = 0.2
# Poses that are compared at a time, few enough to stay in the processor's cache.
_CHUNK = 4096
# Of so many factors, none above the limit, the product is taken before the logarithm.
_FACTORS, _MAX_FACTOR = 8, 1e4
# A plan that weighs nothing in the posterior counts as this improbable, in logs: posteriors leave out what is less.
_NEGLIGIBLE = -12.0
# Plans whose log masses are nearer than this are alike in all their prototypes.
_ALIKE = 1e-4


@dataclass(frozen=True, eq=False)
class Prototypes:
    """Prototypes of one plan, or of several, one after the other.

    Attributes:
        log_profile: (n, a) log wall profiles (m) in half precision, at 32 azimuths unless there are fewer.
        log_area: (n,) log of the floor (m²) that each stands for.
        step_m: of the grid that they were taken from.
    """

    log_profile: Float[np.ndarray, "n a"]
    log_area: Float[np.ndarray, "n"]
    step_m: float

    def __len__(self) -> int:
        return len(self.log_area)

    @property
    def nbytes(self) -> int:
        """Memory that the arrays take."""
        return self.log_profile.nbytes + self.log_area.nbytes


def prototypes_of(grid: LatentGrid) -> Prototypes:
    """The prototypes of a plan."""
    cell = np.floor(grid.poses.position_m / (_STEPS * grid.step_m)).astype(np.int64)
    key = np.column_stack([grid.poses.room_index, cell])
    _, first, count = np.unique(key, axis=0, return_index=True, return_counts=True)
    log_profile = np.log(grid.profile_m[first][:, _azimuths(grid.profile_m.shape[1])])
    log_area = np.log(count * grid.step_m**2)
    return Prototypes(log_profile.astype(np.float16), log_area.astype(np.float32), grid.step_m)


def joined(parts: Sequence[Prototypes]) -> Prototypes:
    """Prototypes of several plans, one after the other."""
    return Prototypes(
        np.concatenate([part.log_profile for part in parts]),
        np.concatenate([part.log_area for part in parts]),
        parts[0].step_m,
    )


def log_masses(
    prototypes: Prototypes, first: Int[np.ndarray, "p"], query: Query, weights: EvidenceModel, config: EvidenceConfig
) -> Float[np.ndarray, "p"]:
    """Log of each plan's mass.

    Args:
        first: where the prototypes of each plan begin.
    """
    assert query.profile is not None
    compared = _azimuths(query.profile.log_m.shape[1])
    # Hypotheses between two azimuths of the prototypes tell nothing new.
    every = max(1, len(query.roll) // len(compared))
    centre = query.profile.log_m[::every, compared].astype(np.float32)
    reach_m = config.grid_reach * _STEPS * prototypes.step_m
    precision = precisions(query, reach_m, config)[::every, compared].astype(np.float32)
    offsets = _offsets(query)
    penalty = query.camera_height.penalty(offsets)
    mass = np.empty(len(prototypes), np.float32)
    for begin in range(0, len(prototypes), _CHUNK):
        log_profile = prototypes.log_profile[begin : begin + _CHUNK].astype(np.float32)
        total = np.full(len(log_profile), -np.inf, np.float32)
        for hypothesis in range(len(centre)):
            for offset, dear in zip(offsets, penalty, strict=True):
                walls = _walls(log_profile, centre[hypothesis] + np.float32(offset), precision[hypothesis])
                np.logaddexp(total, -weights.temperature * walls - dear, out=total)
        mass[begin : begin + _CHUNK] = total
    return np.logaddexp.reduceat(mass + prototypes.log_area, first)


def most_probable(
    log_mass: Float[np.ndarray, "p"], poses: Int[np.ndarray, "p"], *, most_plans: int, most_poses: int
) -> Int[np.ndarray, "m"]:
    """The plans that are to be searched in full, the most probable first: at least one.

    Args:
        poses: of the grid of each plan.
        most_poses: how many the grids of all of them may have.
    """
    order = np.argsort(-log_mass, kind="stable")[:most_plans]
    within = np.cumsum(poses[order]) <= most_poses
    return order[: max(int(within.sum()), 1)]


def share_searched(
    log_mass: Float[np.ndarray, "p"], searched: Int[np.ndarray, "m"], probability: Float[np.ndarray, "m"]
) -> float:
    """How much of the posterior over all plans those have that were searched.

    A full search changes what a plan weighs. Those left out are taken to change as most of those searched did: by the
    median of their ratios, which is that of wrong plans. But what is left out of equal plans changes as those of them
    do that were searched.

    Args:
        probability: of each plan that was searched, given that it is one of them.
    """
    left_out = np.delete(log_mass, searched)
    if not len(left_out):
        return 1.0
    log_probability = np.log(np.maximum(probability, np.exp(_NEGLIGIBLE)))
    change = log_probability - log_mass[searched]
    # The most probable plans are searched, so only the least of them can have equals that are not.
    least = log_mass[searched].min() + _ALIKE
    equals = change[log_mass[searched] <= least]
    expected = left_out + np.where(left_out >= least - 2 * _ALIKE, np.median(equals), np.median(change))
    return float(1.0 / (1.0 + np.exp(np.logaddexp.reduce(expected))))


def _azimuths(columns: int) -> Int[np.ndarray, "a"]:
    """The columns of a wall profile that prototypes have."""
    count = min(AZIMUTHS, columns)
    return np.arange(count) * columns // count


def _offsets(query: Query) -> Float[np.ndarray, "j"]:
    """The logs of true over stated camera height that are tried."""
    tried = query.camera_height.offsets
    reach = float(tried[-1] - tried[0])
    if reach <= _OFFSETS_APART:
        return np.array([0.5 * (tried[0] + tried[-1])])
    return np.linspace(tried[0], tried[-1], int(np.ceil(reach / _OFFSETS_APART)) + 1)


def _walls(
    log_profile: Float[np.ndarray, "n a"], centre: Float[np.ndarray, "a"], precision: Float[np.ndarray, "a"]
) -> Float[np.ndarray, "n"]:
    """Mean log of 1 + r² by azimuth, as in `evidence`."""
    factor = log_profile - centre
    factor *= precision
    np.square(factor, out=factor)
    factor += 1.0
    np.minimum(factor, _MAX_FACTOR, out=factor)
    azimuths = factor.shape[1]
    width = -(-azimuths // _FACTORS)
    product = factor[:, :width].copy()
    for begin in range(width, azimuths, width):
        part = factor[:, begin : begin + width]
        product[:, : part.shape[1]] *= part
    return np.log(product).sum(axis=1) / azimuths
