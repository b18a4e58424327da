"""How well sequences are localised: walks through generated homes, with odometry as bad as one says.

Every walk has photographs at some places of a home, each turned at random, one camera height, and furniture. Of the
motion between neighbours the distance is told with an error in proportion to it, and angles with one of their own. All
pictures are answered jointly, and each alone as well, with the same model in the same process.

    .venv/bin/python -m benchmarks.sequences --bundle models/default --sequences 30
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.evaluate.methods.lalaloc import local_refiner
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, RenderedPhotograph, renderer_cache_of
from lalaloc_core.learn.synth.homes.plans import Home
from lalaloc_core.learn.synth.homes.splits import home_of
from lalaloc_core.learn.synth.scene.shots import Shot, sample_shots
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.pipeline import Localisation, localise, panorama_heading
from lalaloc_core.localise.retrieval import build_grid
from lalaloc_core.localise.sequence import Motion
from lalaloc_core.localise.sequence.joint import refine_sequence
from lalaloc_core.localise.sequence.search import localise_sequence

# Places that a walk may go through, and how far apart neighbours on it are.
_PLACES, _STRIDE_M = 80, (0.8, 3.5)
_MIN_DISTANCE_STD_M = 0.03
_GRID_STEP_M = 0.5
_CLEARANCE_M = 0.3


@dataclass
class Tally:
    """Errors of poses by who answered."""

    errors_m: list[float]
    turned_deg: list[float]
    confidence: list[float]
    spent_s: list[float]

    def line(self, name: str) -> str:
        """What is printed."""
        errors, turned = np.array(self.errors_m), np.array(self.turned_deg)
        return (
            f"{name:34s} n = {len(errors)}: < 1 m {np.mean(errors < 1.0):.1%}, < 10 cm {np.mean(errors < 0.1):.1%}, "
            f"median {100.0 * np.median(errors):.1f} cm, heading within 2° {np.mean(turned < 2.0):.1%}, "
            f"mean confidence {np.mean(self.confidence):.3f}, {np.median(self.spent_s):.2f} s"
        )


def walk(home: Home, length: int, rng: np.random.Generator) -> list[Shot] | None:
    """Shots along a walk, with one camera height and one seed of all that is drawn; None where none was found."""
    places = sample_shots(home, _PLACES, rng, "full")
    position_m = np.stack([shot.position_m for shot in places])
    path = [int(rng.integers(_PLACES))]
    while len(path) < length:
        away_m = np.linalg.norm(position_m - position_m[path[-1]], axis=1)
        next_ones = np.setdiff1d(np.flatnonzero((away_m > _STRIDE_M[0]) & (away_m < _STRIDE_M[1])), path)
        if not len(next_ones):
            return None
        path.append(int(rng.choice(next_ones)))
    first = places[path[0]]
    lowest_m = min(home.plan.rooms[places[index].room_index].ceiling_height_m for index in path)
    height_m = min(first.camera_height_m, lowest_m - _CLEARANCE_M)
    return [replace(places[index], camera_height_m=height_m, seed=first.seed) for index in path]


def odometry(
    shots: list[Shot], rng: np.random.Generator, share: float, angle_std: float, *, directed: bool
) -> list[Motion]:
    """What is measured of the motions, with errors of the stated deviations."""
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


def note(tally: Tally, shot: Shot, found: Localisation, confidence: float | None, spent_s: float) -> None:
    """Count an answer."""
    best = found.candidates[0]
    tally.errors_m.append(float(np.linalg.norm(best.position_m - shot.position_m)))
    tally.turned_deg.append(abs(math.degrees(wrap_angle(panorama_heading(found.query, best) - shot.heading))))
    tally.confidence.append(confidence or 0.0)
    tally.spent_s.append(spent_s)


def main() -> None:
    """Print how often poses are right."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", type=Path, default=Path("models/default"))
    parser.add_argument("--sequences", type=int, default=30)
    parser.add_argument("--photographs", type=int, default=5)
    parser.add_argument("--distance-error", type=float, default=0.05, help="as a share of the distance")
    parser.add_argument("--angle-error-deg", type=float, default=2.0)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    bundle = Bundle.open(asked.bundle)
    encoders, refiner = Encoders(bundle, threads=1), local_refiner(bundle)
    model, renderers = bundle.manifest.confidence, renderer_cache_of(SPLIT_NUMBERS["test"], asked.seed, None)
    ways = {"alone": None, "distance and turn": False, "distance, turn and direction": True}
    tallies = {name: Tally([], [], [], []) for name in ways}
    index = done = 0
    while done < asked.sequences:
        home, rng = home_of(SPLIT_NUMBERS["test"], asked.seed, index)
        index += 1
        shots = walk(home, asked.photographs, rng)
        if shots is None:
            continue
        done += 1
        height = CameraHeight(shots[0].camera_height_m)
        grid = build_grid(home.plan, encoders, step_m=_GRID_STEP_M, camera_height_m=height.height_m)
        size = bundle.manifest.image_height, bundle.manifest.image_width
        queries = [encoders.query(RenderedPhotograph(shot, renderers).image(*size), None, height) for shot in shots]
        for name, directed in ways.items():
            begin = time.perf_counter()
            if directed is None:
                found = [localise(home.plan, grid, encoders, query, refiner=refiner) for query in queries]
            else:
                motions = odometry(
                    shots, rng, asked.distance_error, math.radians(asked.angle_error_deg), directed=directed
                )
                found = localise_sequence(home.plan, grid, encoders, queries, motions, refiner=refine_sequence).pictures
            spent_s = (time.perf_counter() - begin) / (1 if directed is not None else len(shots))
            for shot, one in zip(shots, found, strict=True):
                note(tallies[name], shot, one, None if model is None else one.confidence(model), spent_s)
            far = sum(error >= 1.0 for error in tallies[name].errors_m[-len(shots) :])
            print(f"  walk {done}, {home.plan.area_m2:.0f} m², {name}: {far} of {len(shots)} beyond 1 m", flush=True)
    for name, tally in tallies.items():
        print(tally.line(name))


if __name__ == "__main__":
    main()
