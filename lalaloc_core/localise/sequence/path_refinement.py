"""Joint refinement from the search's side: jobs from paths, and paths from results."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.geometry import pad_walls
from lalaloc_core.localise.encode.layout_encoder import LayoutEncoder
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import Candidate
from lalaloc_core.localise.refine import RefinementResult
from lalaloc_core.localise.refine.refinement import latent_distances_at, refined_candidates, refinement_job
from lalaloc_core.localise.search.pipeline import LocaliseConfig
from lalaloc_core.localise.sequence.joint_refinement import SequenceJob, SequenceResult, motion_costs
from lalaloc_core.localise.sequence.measured_motion import FLOOR
from lalaloc_core.localise.sequence.path_posterior import Observation, Path, PictureChain
from lalaloc_core.render.sampling import PoseSet

# Paths that end closer than this (m, radians) in every picture are one.
_SAME_M, _SAME_TURN = 0.2, math.radians(5.0)


def sequence_job(
    plan: FloorPlan, grid: PoseGrid, chain: PictureChain, paths: list[Path], config: LocaliseConfig
) -> SequenceJob:
    """Return the joint job of all pictures, with the motions that each path follows."""
    parts, rolls = [], []
    for t, picture in enumerate(chain.pictures):
        starts, height_m = [path.starts[t] for path in paths], grid.camera_height_m
        parts.append(refinement_job(plan, picture.query, starts, height_m, picture.weights, config.matching))
        rolls.append(picture.query.roll[[start.hypothesis for start in starts]])
    trusted = [
        [
            not transition.floor or transition.likelihood(*pair) > FLOOR
            for transition, pair in zip(chain.transitions, itertools.pairwise(path.states), strict=True)
        ]
        for path in paths
    ]
    longest = max(part.walls_m.shape[1] for part in parts)
    walls_m = [np.stack([pad_walls(room_m, longest) for room_m in part.walls_m]) for part in parts]
    log_profile = np.stack([part.log_profile for part in parts if part.log_profile is not None], axis=1)
    first = chain.pictures[0]
    return SequenceJob(
        position_m=np.stack([part.position_m for part in parts], axis=1),
        heading=np.stack([part.heading for part in parts], axis=1),
        roll=np.stack(rolls, axis=1),
        turnable=np.array([part.optimise_heading for part in parts]),
        walls_m=np.stack(walls_m, axis=1),
        log_profile=log_profile.astype(np.float64),
        precision=np.stack([part.precision for part in parts if part.precision is not None], axis=1),
        motions=tuple(chain.motions),
        trusted=np.array(trusted, dtype=bool).reshape(len(paths), len(chain.motions)),
        motion_scale=math.sqrt(0.5 * log_profile.shape[2] / first.weights.temperature),
        height_offset=np.array([path.starts[0].height_offset for path in paths]),
        height_free=not first.query.camera_height.is_exact,
        height_stiffness=parts[0].height_stiffness,
        height_bounds=parts[0].height_bounds,
        height_apart=chain.height_apart,
    )


def refined_paths(
    plan: FloorPlan,
    encoder: LayoutEncoder,
    chain: PictureChain,
    paths: list[Path],
    result: SequenceResult,
    config: LocaliseConfig,
) -> list[Path]:
    """Return the refined paths, best first, without duplicates."""
    ends: list[list[Candidate]] = []
    for t, picture in enumerate(chain.pictures):
        starts = [path.starts[t] for path in paths]
        poses = PoseSet(result.position_m[:, t], np.array([start.room_index for start in starts]))
        hypotheses, height_m = [start.hypothesis for start in starts], picture.query.camera_height.height_m
        heading = result.heading[:, t]
        distance = latent_distances_at(plan, encoder, picture.query, poses, heading, hypotheses, height_m)
        alone = RefinementResult(
            position_m=result.position_m[:, t],
            heading=heading,
            cost=distance,
            latent_distance=distance,
            information=result.information[t],
            converged=np.ones(len(paths), bool),
            evaluations=np.zeros(len(paths), int),
            height_offset=result.height_offset + result.height_own[:, t],
        )
        ends.append(refined_candidates(plan, encoder, picture.query, starts, alone, config.matching))
    moved = [replace(path, ends=tuple(candidates[m] for candidates in ends)) for m, path in enumerate(paths)]
    log_motions = np.log(np.exp(-path_motion_costs(chain, moved)) + FLOOR)
    found = []
    # Every picture's cost includes the prior of the height, of which the shared part counts once.
    penalties = chain.pictures[0].query.camera_height.penalty(result.height_offset)
    if chain.height_apart:
        penalties = penalties + 0.5 * np.square(result.height_own / chain.height_apart).sum(axis=1)
    for path, log_motion, penalty in zip(moved, log_motions, penalties, strict=True):
        pairs = zip(chain.pictures, path.ends, strict=True)
        fits = sum(picture.weights.temperature * end.cost for picture, end in pairs)
        nll = fits - sum(end.terms["height"] for end in path.ends) + penalty - log_motion.sum()
        priors = sum(_log_prior(picture, state) for picture, state in zip(chain.pictures, path.states, strict=True))
        found.append(replace(path, refined_nll=float(nll - priors)))
    kept: list[Path] = []
    for path in sorted(found, key=lambda ended: ended.refined_nll or 0.0):
        if not any(chain.are_alike(path.ends, other.ends, _SAME_M, _SAME_TURN) for other in kept):
            kept.append(path)
    return kept


def _log_prior(picture: Observation, state: int) -> float:
    """Return the log prior of a state."""
    row, hypothesis = divmod(state, len(picture.states.heading))
    return float((picture.log_likelihood + picture.weights.temperature * picture.cost)[0, row, hypothesis])


def path_motion_costs(chain: PictureChain, paths: list[Path]) -> Float[np.ndarray, "m s"]:
    """Return half the squared residuals of every motion along some paths."""
    position_m = np.array([[end.position_m for end in path.ends] for path in paths])
    return motion_costs(chain.motions, position_m, np.array([chain.headings(path.ends) for path in paths]))
