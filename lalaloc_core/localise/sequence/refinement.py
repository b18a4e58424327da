"""Joint refinement from the search's side: jobs from paths, and paths from results."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.geometry import pad_walls
from lalaloc_core.localise.belief import photograph_heading
from lalaloc_core.localise.encode.layout_encoder import LayoutEncoder
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import Candidate
from lalaloc_core.localise.refine import RefinementJob, RefinementResult
from lalaloc_core.localise.refine.refinement import refined_candidates, refinement_job
from lalaloc_core.localise.search.pipeline import LocaliseConfig
from lalaloc_core.localise.sequence.joint import SequenceJob, SequenceResult, motion_costs
from lalaloc_core.localise.sequence.motion import FLOOR, Motion, Transition
from lalaloc_core.localise.sequence.paths import Observation, Path
from lalaloc_core.render.sampling import PoseSet

# Paths that end closer than this (m, radians) in every picture are one.
_SAME_M, _SAME_TURN = 0.2, math.radians(5.0)
# Deviation of the log of a carried camera's height from one picture to another.
_HEIGHT_APART = 0.05


def are_alike(
    pictures: Sequence[Observation],
    path: Sequence[Candidate],
    other: Sequence[Candidate],
    within_m: float,
    within_angle: float,
) -> bool:
    """Return whether two paths have about the same places and headings in every picture."""
    for picture, first, second in zip(pictures, path, other, strict=True):
        apart_m = np.linalg.norm(first.position_m - second.position_m)
        turned = wrap_angle(photograph_heading(picture.query, first) - photograph_heading(picture.query, second))
        if apart_m >= within_m or abs(turned) > within_angle:
            return False
    return True


def job_parts(
    plan: FloorPlan,
    grid: PoseGrid,
    pictures: list[Observation],
    paths: list[Path],
    config: LocaliseConfig,
) -> list[RefinementJob]:
    """Return the refinement job of every picture alone."""
    return [
        refinement_job(
            plan,
            picture.query,
            [path.starts[t] for path in paths],
            grid.camera_height_m,
            picture.weights,
            config.matching,
        )
        for t, picture in enumerate(pictures)
    ]


def sequence_job(
    parts: list[RefinementJob],
    pictures: list[Observation],
    paths: list[Path],
    transitions: list[Transition],
    motions: Sequence[Motion],
) -> SequenceJob:
    """Return the joint job of all pictures, with the motions that each path follows."""
    hypotheses = [[path.starts[t].hypothesis for path in paths] for t in range(len(pictures))]
    rolls = [picture.query.roll[numbers] for picture, numbers in zip(pictures, hypotheses, strict=True)]
    trusted = [
        [
            not transition.floor or transition.likelihood(*pair) > FLOOR
            for transition, pair in zip(transitions, itertools.pairwise(path.states), strict=True)
        ]
        for path in paths
    ]
    longest = max(part.walls_m.shape[1] for part in parts)
    walls_m = [np.stack([pad_walls(room_m, longest) for room_m in part.walls_m]) for part in parts]
    log_profile = np.stack([part.log_profile for part in parts if part.log_profile is not None], axis=1)
    height = pictures[0].query.camera_height
    return SequenceJob(
        position_m=np.stack([part.position_m for part in parts], axis=1),
        heading=np.stack([part.heading for part in parts], axis=1),
        roll=np.stack(rolls, axis=1),
        turnable=np.array([part.optimise_heading for part in parts]),
        walls_m=np.stack(walls_m, axis=1),
        log_profile=log_profile.astype(np.float64),
        precision=np.stack([part.precision for part in parts if part.precision is not None], axis=1),
        motions=tuple(motions),
        trusted=np.array(trusted, dtype=bool).reshape(len(paths), len(motions)),
        motion_scale=math.sqrt(0.5 * log_profile.shape[2] / pictures[0].weights.temperature),
        height_offset=np.array([path.starts[0].height_offset for path in paths]),
        height_free=not height.is_exact,
        height_stiffness=parts[0].height_stiffness,
        height_bounds=parts[0].height_bounds,
        height_apart=height_apart(pictures),
    )


def height_apart(pictures: Sequence[Observation]) -> float:
    """Return the deviation of log heights between pictures; 0 if their heights are exact or stated one by one."""
    heights = {picture.query.camera_height for picture in pictures}
    return _HEIGHT_APART if len(heights) == 1 and not pictures[0].query.camera_height.is_exact else 0.0


def ended_paths(
    plan: FloorPlan,
    encoder: LayoutEncoder,
    pictures: list[Observation],
    motions: Sequence[Motion],
    paths: list[Path],
    result: SequenceResult,
    config: LocaliseConfig,
) -> list[Path]:
    """Return the refined paths, best first, without duplicates."""
    ends: list[list[Candidate]] = []
    for t, picture in enumerate(pictures):
        starts = [path.starts[t] for path in paths]
        poses = PoseSet(result.position_m[:, t], np.array([start.room_index for start in starts]))
        height_m = picture.query.camera_height.height_m
        latents, _ = encoder.poses(plan, poses, result.heading[:, t], height_m)
        targets = picture.query.latents[[start.hypothesis for start in starts]]
        distance = np.linalg.norm(latents - targets, axis=1)
        alone = RefinementResult(
            position_m=result.position_m[:, t],
            heading=result.heading[:, t],
            cost=distance,
            latent_distance=distance,
            information=result.information[t],
            converged=np.ones(len(paths), bool),
            evaluations=np.zeros(len(paths), int),
            height_offset=result.height_offset + result.height_own[:, t],
        )
        ends.append(refined_candidates(plan, encoder, picture.query, starts, alone, config.matching))
    moved = [replace(path, ends=tuple(candidates[m] for candidates in ends)) for m, path in enumerate(paths)]
    log_motions = np.log(np.exp(-path_motion_costs(pictures, motions, moved)) + FLOOR)
    found = []
    # Every picture's cost includes the prior of the height, of which the shared part counts once.
    apart, penalties = height_apart(pictures), pictures[0].query.camera_height.penalty(result.height_offset)
    if apart:
        penalties = penalties + 0.5 * np.square(result.height_own / apart).sum(axis=1)
    for path, log_motion, penalty in zip(moved, log_motions, penalties, strict=True):
        fits = sum(picture.weights.temperature * end.cost for picture, end in zip(pictures, path.ends, strict=True))
        nll = fits - sum(end.terms["height"] for end in path.ends) + penalty - log_motion.sum()
        priors = sum(_log_prior(picture, state) for picture, state in zip(pictures, path.states, strict=True))
        found.append(replace(path, refined_nll=float(nll - priors)))
    kept: list[Path] = []
    for path in sorted(found, key=lambda ended: ended.refined_nll or 0.0):
        if not any(are_alike(pictures, path.ends, other.ends, _SAME_M, _SAME_TURN) for other in kept):
            kept.append(path)
    return kept


def _log_prior(picture: Observation, state: int) -> float:
    """Return the log prior of a state."""
    row, hypothesis = divmod(state, len(picture.states.heading))
    return float((picture.log_likelihood + picture.weights.temperature * picture.cost)[0, row, hypothesis])


def path_motion_costs(
    pictures: Sequence[Observation], motions: Sequence[Motion], paths: Sequence[Path]
) -> Float[np.ndarray, "m s"]:
    """Return half the squared residuals of every motion along some paths."""
    position_m = np.array([[end.position_m for end in path.ends] for path in paths])
    queries = [picture.query for picture in pictures]
    headings = [[photograph_heading(*pair) for pair in zip(queries, path.ends, strict=True)] for path in paths]
    return motion_costs(motions, position_m, np.array(headings))
