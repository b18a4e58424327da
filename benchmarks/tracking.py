"""Accuracy and time of tracking: walks through generated homes and a large building, with noisy odometry.

A walk leads along shortest ways between random places of a furnished home, through its doors, with one photograph per
second at 1 m/s. Odometry drifts: every walk has its own error of scale and of turn per metre, besides the noise of each
motion. Every walk is followed as it is, without odometry, and carried to another place of the home. Photographs are
full spheres, or with `--view` of a narrower field of view, which is stated, and tilted as by hand.

    python -m benchmarks.tracking --walks 20
    python -m benchmarks.tracking --walks 20 --view 80 --endless 0
"""

from __future__ import annotations

import argparse
import heapq
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
import shapely
from jaxtyping import Float
from scipy.spatial import KDTree

from benchmarks.harness import argument_parser
from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.evaluate.methods.lalaloc import local_refiner
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.synthetic.generated import (
    SPLIT_NUMBERS,
    RenderedPhotograph,
    RendererCache,
    split_renderer_cache,
)
from lalaloc_core.learn.data.views import CachedSphere, ViewPhotograph, tilt_by_hand
from lalaloc_core.learn.synth.homes.buildings import building_of
from lalaloc_core.learn.synth.homes.plans import Home, home_of
from lalaloc_core.learn.synth.scene.shots import CEILING_CLEARANCE_M, Shot
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder, patch_size
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.localise.search.pipeline import Refiner, run_steps
from lalaloc_core.localise.tracking import Odometry, TrackState
from lalaloc_core.localise.tracking.tracked_plans import TrackedPlans
from lalaloc_core.localise.tracking.tracking_filter import Tracked, track_steps
from lalaloc_core.render.sampling import pose_grid

# Lattice of the ways (m), distance of walkers from walls, and of the nodes on both sides of a doorway.
_LATTICE_M, _CLEARANCE_M, _DOOR_SIDE_M = 0.2, 0.25, 0.35
_STEP_M, _GRID_STEP_M = 1.0, 0.5
_LOOK_AROUND = math.radians(15.0)


class Pose(NamedTuple):
    """True pose of a photograph."""

    position_m: Float[np.ndarray, "2"]
    heading: float
    room: int


@dataclass(frozen=True)
class Walk:
    """A walk: its home, true poses, encoded photographs and odometry; `moves[0]` leads to the second photograph."""

    plan: FloorPlan
    poses: list[Pose]
    queries: list[Query]
    moves: list[Odometry]


class Ways:
    """Ways through a plan that keep clear of walls and lead through doors and passages."""

    def __init__(self, plan: FloorPlan) -> None:
        floors = [room.free_floor(_CLEARANCE_M) for room in plan.rooms]
        lattice = pose_grid(plan, _LATTICE_M)
        kept = np.array(
            [shapely.contains_xy(floors[r], *p) for p, r in zip(lattice.position_m, lattice.room_index, strict=True)]
        )
        self.position_m, self.room = lattice.position_m[kept], lattice.room_index[kept]
        links: list[tuple[int, int]] = []
        for a, b in KDTree(self.position_m).query_pairs(1.5 * _LATTICE_M):
            if self.room[a] == self.room[b]:
                links.append((a, b))
        for opening in plan.openings:
            if opening.kind in ("door", "passage"):
                links += self._through(plan, np.asarray(opening.line_m))
        self._links: list[list[int]] = [[] for _ in self.position_m]
        for a, b in links:
            self._links[a].append(b)
            self._links[b].append(a)

    def _through(self, plan: FloorPlan, line_m: Float[np.ndarray, "2 2"]) -> list[tuple[int, int]]:
        """Add two nodes on the sides of an opening; return their links."""
        along = line_m[1] - line_m[0]
        normal = np.array([along[1], -along[0]]) / max(float(np.hypot(*along)), 1e-9)
        sides = line_m.mean(axis=0) + np.outer([1.0, -1.0], normal) * _DOOR_SIDE_M
        rooms = plan.room_index_at(sides)
        if (rooms < 0).any() or rooms[0] == rooms[1]:
            return []
        first, links = len(self.position_m), []
        for index, (side, room) in enumerate(zip(sides, rooms, strict=True)):
            near = np.flatnonzero((self.room == room) & (np.linalg.norm(self.position_m - side, axis=1) < 0.5))
            links += [(first + index, int(node)) for node in near]
        self.position_m = np.concatenate([self.position_m, sides])
        self.room = np.append(self.room, rooms)
        return [*links, (first, first + 1)]

    def farthest_way(self, start: int, rng: np.random.Generator) -> list[int]:
        """Return a shortest way from a node to one of the farther nodes that can be reached."""
        distance, before = {start: 0.0}, dict[int, int]()
        queue = [(0.0, start)]
        while queue:
            reached, node = heapq.heappop(queue)
            if reached > distance[node]:
                continue
            for neighbour in self._links[node]:
                length = reached + float(np.hypot(*(self.position_m[neighbour] - self.position_m[node])))
                if length < distance.get(neighbour, math.inf):
                    distance[neighbour], before[neighbour] = length, node
                    heapq.heappush(queue, (length, neighbour))
        far = [node for node, length in distance.items() if length >= 0.5 * max(distance.values())]
        way = [int(rng.choice(far))]
        while way[0] != start:
            way.insert(0, before[way[0]])
        return way

    def poses(self, count: int, rng: np.random.Generator) -> list[Pose]:
        """Return poses every metre of a walk, looking about along the way."""
        node, points = int(rng.integers(len(self.position_m))), np.empty((0, 2))
        while len(points) < 2 or np.linalg.norm(np.diff(points, axis=0), axis=1).sum() < count * _STEP_M:
            way = self.farthest_way(node, rng)
            if len(way) < 2:
                node, points = int(rng.integers(len(self.position_m))), np.empty((0, 2))
                continue
            points, node = np.concatenate([points, self.position_m[way]]), way[-1]
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        nearest, poses = KDTree(self.position_m), []
        for at in np.arange(count) * _STEP_M:
            place = np.array([np.interp(at, length, points[:, axis]) for axis in (0, 1)])
            ahead = np.array([np.interp(at + 0.4, length, points[:, axis]) for axis in (0, 1)]) - place
            heading = math.atan2(*ahead) + float(rng.normal(0.0, _LOOK_AROUND))
            poses.append(Pose(place, heading, int(self.room[nearest.query(place)[1]])))
        return poses


def odometry(poses: Sequence[Pose], rng: np.random.Generator, drift: float, turn_per_m: float) -> list[Odometry]:
    """Return the measured motions between poses, with errors of scale and turn that persist, and noise."""
    scale, bend = rng.normal(0.0, drift), rng.normal(0.0, turn_per_m)
    moves = []
    for first, second in pairwise(poses):
        step, length_m = second.position_m - first.position_m, _STEP_M
        sine, cosine = math.sin(first.heading), math.cos(first.heading)
        ahead = np.array([step @ [sine, cosine], step @ [cosine, -sine]])
        ahead = ahead * (1.0 + scale) + rng.normal(0.0, 0.5 * drift * length_m, 2)
        turn = wrap_angle(second.heading - first.heading) + bend * length_m + rng.normal(0.0, 0.5 * turn_per_m)
        stds = drift * length_m, drift * length_m, turn_per_m * length_m
        moves.append(Odometry.of_stds(float(ahead[0]), float(ahead[1]), float(turn), stds))
    return moves


def walk_through(
    home: Home,
    count: int,
    rng: np.random.Generator,
    encoder: PhotographEncoder,
    renderers: RendererCache,
    field_deg: float | None,
) -> Walk:
    """Walk through a home, and photograph and encode the way; without a field of view, as full spheres."""
    poses = Ways(home.plan).poses(count, rng)
    lowest_m = min(home.plan.rooms[pose.room].ceiling_height_m for pose in poses)
    height_m = float(min(rng.uniform(1.3, 1.7), lowest_m - CEILING_CLEARANCE_M))
    seed = int(rng.integers(1 << 62))
    manifest, queries = encoder.manifest, []
    height = CameraHeight(height_m)
    for pose in poses:
        shot = Shot(
            home=home,
            position_m=pose.position_m,
            room_index=pose.room,
            heading=pose.heading,
            camera_height_m=height_m,
            furniture="full",
            seed=seed,
        )
        photograph = RenderedPhotograph(shot, renderers)
        if field_deg is None:
            image = photograph.image(manifest.image_height, manifest.image_width)
            queries.append(encoder.spheres.query(image, None, height))
            continue
        pitch, roll = tilt_by_hand(rng)
        view = ViewPhotograph(sphere=CachedSphere(photograph), azimuth=0.0, field_deg=field_deg, pitch=pitch, roll=roll)
        queries.append(encoder.query(view.open(patch_size(manifest)), None, height))
    return Walk(home.plan, poses, queries, odometry(poses, rng, 0.05, math.radians(2.0)))


class Follower:
    """Follows walks through one plan."""

    def __init__(self, plan: FloorPlan, encoders: PhotographEncoder, refiner: Refiner) -> None:
        self._encoders, self._refiner = encoders, refiner
        grid = build_grid(plan, encoders, step_m=_GRID_STEP_M, camera_height_m=1.5, latents=False)
        self._ground = TrackedPlans.of_plan(plan, grid)
        self.milliseconds: list[float] = []

    def follow(
        self,
        walk: Walk,
        order: Sequence[int],
        *,
        odometry: bool = True,
        shift_m: Float[np.ndarray, "2"] | None = None,
        keep: int = 0,
    ) -> list[tuple[float, Tracked]]:
        """Follow photographs of a walk; return the error (m) and the answer of each, or of the last `keep`.

        Odometry tells nothing of jumps in the order. `shift_m` is the translation of the walk's home into the plan.
        """
        state = TrackState.first(len(walk.queries[0].roll))
        found, still = list[tuple[float, Tracked]](), Odometry.of_stds(0.0, 0.0, 0.0, (0.05, 0.05, 0.03))
        for place, index in enumerate(order):
            move = still if place == 0 or order[place - 1] != index - 1 else walk.moves[index - 1]
            begin = time.perf_counter()
            answer = run_steps(
                track_steps(self._ground, self._encoders, state, walk.queries[index], move if odometry else None),
                self._refiner,
            )
            # As between two requests.
            state = TrackState.from_bytes(answer.state.to_bytes())
            self.milliseconds.append(1e3 * (time.perf_counter() - begin))
            away_m = answer.pose.position_m - walk.poses[index].position_m - (0.0 if shift_m is None else shift_m)
            found = [*found, (float(np.linalg.norm(away_m)), answer)][-keep:]
        return found


def _share(walks: list[list[float]], first: int, last: int | None = None) -> str:
    errors = np.concatenate([np.array(errors[first:last]) for errors in walks])
    return f"{100.0 * np.mean(errors < 1.0):.1f} % of {len(errors)}"


def _summary(name: str, walks: list[list[float]]) -> None:
    later = np.concatenate([np.array(errors[4:]) for errors in walks])
    print(
        f"{name:12s} within 1 m at the 3rd {_share(walks, 2, 3)}, at the 5th {_share(walks, 4, 5)}, from the 5th "
        f"{_share(walks, 4)}, from the 15th {_share(walks, 14)}; median {100.0 * np.median(later):.1f} cm",
        flush=True,
    )


def main() -> None:
    """Print the figures."""
    parser = argument_parser(__doc__)
    parser.add_argument("--bundle", type=Path, default=Path("models/default"))
    parser.add_argument("--walks", type=int, default=20)
    parser.add_argument("--photographs", type=int, default=18)
    parser.add_argument("--view", type=float, metavar="DEG", help="field of view; default: full spheres")
    parser.add_argument("--split", choices=sorted(SPLIT_NUMBERS), default="test")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--office-m2", type=float, default=2000.0, help="floor area of the large building; 0: none")
    parser.add_argument("--endless", type=int, default=10_000, help="photographs of the session that must not grow")
    options = parser.parse_args()
    bundle, split = Bundle.open(options.bundle), SPLIT_NUMBERS[options.split]
    encoder, refiner = PhotographEncoder(bundle, threads=1), local_refiner(bundle)
    encoders = encoder
    renderers = split_renderer_cache(split, options.seed, None)
    ways: dict[str, list[list[float]]] = {"odometry": [], "none": []}
    again, spent, walk = list[int](), list[float](), None
    for index in range(options.walks):
        home, rng = home_of(split, options.seed, index)
        walk = walk_through(home, options.photographs, rng, encoder, renderers, options.view)
        follower = Follower(walk.plan, encoders, refiner)
        order = list(range(len(walk.poses)))
        ways["odometry"].append([error for error, _ in follower.follow(walk, order)])
        ways["none"].append([error for error, _ in follower.follow(walk, order, odometry=False)])
        # Carried from the end to the begin of the walk, which odometry does not tell.
        half = len(order) // 2
        carried = follower.follow(walk, order[half:] + order[:half])[len(order) - half :]
        again.append(next((place for place, (error, _) in enumerate(carried, 1) if error < 1.0), len(carried) + 1))
        spent += follower.milliseconds
        errors = " ".join(f"{error:.2f}" for error in ways["odometry"][-1])
        print(f"  walk {index + 1}, {walk.plan.area_m2:.0f} m²: {errors}", flush=True)
    for name, found in ways.items():
        _summary(name, found)
    print(f"carried elsewhere: right again after {np.median(again):.0f} photographs in the median, worst {max(again)}")
    _times("homes", spent)
    if options.office_m2:
        _office(options.office_m2, split, options, encoder, refiner, renderers)
    if walk is not None and options.endless:
        _endless(walk, options.endless, Follower(walk.plan, encoders, refiner))


def _times(name: str, spent: list[float]) -> None:
    print(
        f"time per photograph, {name}: median {np.median(spent):.0f} ms, 95 % below {np.percentile(spent, 95):.0f} ms"
    )


def _office(
    area_m2: float,
    split: int,
    options: argparse.Namespace,
    encoder: PhotographEncoder,
    refiner: Refiner,
    renderers: RendererCache,
) -> None:
    """Print the figures of walks through homes of a large building, searched in all of it."""
    building = building_of(split, options.seed, area_m2)
    follower, errors = Follower(building.plan, encoder, refiner), []
    for index, (home, shift_m) in enumerate(zip(building.homes, building.shift_m, strict=True)):
        rng = np.random.default_rng([split, options.seed, index, 9])
        walk = walk_through(home, options.photographs, rng, encoder, renderers, options.view)
        errors.append([error for error, _ in follower.follow(walk, range(options.photographs), shift_m=shift_m)])
    _summary("building", errors)
    _times(f"{building.plan.area_m2:.0f} m²", follower.milliseconds)


def _endless(walk: Walk, count: int, follower: Follower) -> None:
    """Print memory and time of a long session, which walks to and fro."""
    there = list(range(len(walk.poses)))
    process = psutil.Process()
    follower.follow(walk, there)
    before, follower.milliseconds = process.memory_info().rss, []
    size = follower.follow(walk, [there[index % len(there)] for index in range(count)], keep=1)[-1][1]
    grown = (process.memory_info().rss - before) / 2**20
    tenth = max(count // 10, 1)
    first, last = (np.median(part) for part in (follower.milliseconds[:tenth], follower.milliseconds[-tenth:]))
    print(
        f"{count} photographs: memory grew by {grown:.1f} MiB, the state has {len(size.state.to_bytes())} bytes, "
        f"time {first:.0f} ms at first and {last:.0f} ms at last"
    )


if __name__ == "__main__":
    main()
