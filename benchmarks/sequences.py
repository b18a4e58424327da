"""Accuracy of sequences: walks through generated homes with noisy odometry.

Every walk has photographs at some places of a furnished home, each turned at random, at one camera height. Distances
between neighbours have an error proportional to the distance, angles a constant one. All photographs are localised
jointly, and each alone, with the same model in the same process.

    python -m benchmarks.sequences --bundle models/default --sequences 30
"""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.harness import argument_parser
from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.evaluate.methods.lalaloc import local_refiner
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, RenderedPhotograph, split_renderer_cache
from lalaloc_core.learn.synth.homes.plans import Home, home_of
from lalaloc_core.learn.synth.scene.shots import Shot, sample_shots
from lalaloc_core.localise.belief import photograph_heading
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.localise.search.pipeline import Localisation, localise
from lalaloc_core.localise.sequence import Motion
from lalaloc_core.localise.sequence.joint_refinement import refine_sequence
from lalaloc_core.localise.sequence.sequence_search import localise_sequence

# Places that a walk chooses from, and the distance between its neighbours.
_PLACES, _STRIDE_M = 80, (0.8, 3.5)
_MIN_DISTANCE_STD_M = 0.03
_GRID_STEP_M = 0.5
_CLEARANCE_M = 0.3


@dataclass
class Tally:
    """Errors, confidences and times of one way to localise."""

    errors_m: list[float]
    heading_errors_deg: list[float]
    confidence: list[float]
    spent_s: list[float]

    def line(self, name: str) -> str:
        """Return the summary of the errors."""
        errors, turned = np.array(self.errors_m), np.array(self.heading_errors_deg)
        return (
            f"{name:34s} n = {len(errors)}: < 1 m {np.mean(errors < 1.0):.1%}, < 10 cm {np.mean(errors < 0.1):.1%}, "
            f"median {100.0 * np.median(errors):.1f} cm, heading within 2° {np.mean(turned < 2.0):.1%}, "
            f"mean confidence {np.mean(self.confidence):.3f}, {np.median(self.spent_s):.2f} s"
        )


def walk(home: Home, length: int, rng: np.random.Generator) -> list[Shot] | None:
    """Return shots along a walk, with one camera height and one seed of the furniture; None where there is no walk."""
    places = sample_shots(home, _PLACES, rng, "full")
    position_m = np.stack([shot.position_m for shot in places])
    path = [int(rng.integers(_PLACES))]
    while len(path) < length:
        away_m = np.linalg.norm(position_m - position_m[path[-1]], axis=1)
        reachable = np.setdiff1d(np.flatnonzero((away_m > _STRIDE_M[0]) & (away_m < _STRIDE_M[1])), path)
        if not len(reachable):
            return None
        path.append(int(rng.choice(reachable)))
    first = places[path[0]]
    lowest_m = min(home.plan.rooms[places[index].room_index].ceiling_height_m for index in path)
    height_m = min(first.camera_height_m, lowest_m - _CLEARANCE_M)
    return [replace(places[index], camera_height_m=height_m, seed=first.seed) for index in path]


def odometry(
    shots: list[Shot], rng: np.random.Generator, share: float, angle_std: float, *, directed: bool
) -> list[Motion]:
    """Return the measured motions between shots, with errors of the stated standard deviations."""
    motions = []
    for first, second in itertools.pairwise(shots):
        moved = second.position_m - first.position_m
        length_m = float(np.hypot(*moved))
        std_m = max(share * length_m, _MIN_DISTANCE_STD_M)
        turn, direction = rng.normal(0.0, angle_std, 2)
        motion = Motion(
            distance_m=max(length_m + rng.normal(0.0, std_m), 0.0),
            distance_std_m=std_m,
            turn=float(wrap_angle(second.heading - first.heading + turn)),
            turn_std=angle_std,
        )
        if directed:
            azimuth = float(wrap_angle(math.atan2(*moved) - first.heading + direction))
            motion = replace(motion, direction=azimuth, direction_std=angle_std)
        motions.append(motion)
    return motions


def note(tally: Tally, shot: Shot, answer: Localisation, confidence: float | None, spent_s: float) -> None:
    """Add an answer to the tally."""
    best = answer.candidates[0]
    tally.errors_m.append(float(np.linalg.norm(best.position_m - shot.position_m)))
    tally.heading_errors_deg.append(
        abs(math.degrees(wrap_angle(photograph_heading(answer.query, best) - shot.heading)))
    )
    tally.confidence.append(confidence or 0.0)
    tally.spent_s.append(spent_s)


def main() -> None:
    """Print the accuracy of each way to localise."""
    parser = argument_parser(__doc__)
    parser.add_argument("--bundle", type=Path, default=Path("models/default"))
    parser.add_argument("--sequences", type=int, default=30)
    parser.add_argument("--photographs", type=int, default=5)
    parser.add_argument(
        "--distance-error", type=float, default=0.05, help="standard deviation as a share of the distance"
    )
    parser.add_argument("--angle-error-deg", type=float, default=2.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    bundle = Bundle.open(options.bundle)
    encoders, refiner = PhotographEncoder(bundle, threads=1), local_refiner(bundle)
    renderers = split_renderer_cache(SPLIT_NUMBERS["test"], options.seed, None)
    ways = {"alone": None, "distance and turn": False, "distance, turn and direction": True}
    tallies = {name: Tally([], [], [], []) for name in ways}
    index = done = 0
    while done < options.sequences:
        home, rng = home_of(SPLIT_NUMBERS["test"], options.seed, index)
        index += 1
        shots = walk(home, options.photographs, rng)
        if shots is None:
            continue
        done += 1
        height = CameraHeight(shots[0].camera_height_m)
        grid = build_grid(home.plan, encoders, step_m=_GRID_STEP_M, camera_height_m=height.height_m)
        size = bundle.manifest.image_height, bundle.manifest.image_width
        queries = [
            encoders.spheres.query(RenderedPhotograph(shot, renderers).image(*size), None, height) for shot in shots
        ]
        for name, directed in ways.items():
            begin = time.perf_counter()
            if directed is None:
                answers = [localise(home.plan, grid, encoders, query, refiner=refiner) for query in queries]
            else:
                motions = odometry(
                    shots, rng, options.distance_error, math.radians(options.angle_error_deg), directed=directed
                )
                answers = localise_sequence(
                    home.plan, grid, encoders, queries, motions, refiner=refine_sequence
                ).pictures
            spent_s = (time.perf_counter() - begin) / (1 if directed is not None else len(shots))
            for shot, answer in zip(shots, answers, strict=True):
                confidence = answer.confidence(bundle.manifest.confidence_for(view=False))
                note(tallies[name], shot, answer, None if confidence is None else confidence.position, spent_s)
            far = sum(error >= 1.0 for error in tallies[name].errors_m[-len(shots) :])
            print(f"  walk {done}, {home.plan.area_m2:.0f} m², {name}: {far} of {len(shots)} beyond 1 m", flush=True)
    for name, tally in tallies.items():
        print(tally.line(name))


if __name__ == "__main__":
    main()
