"""Tests of tracking: motions of the belief, its state in bytes, walks photograph by photograph, and TUM odometry."""

from __future__ import annotations

import itertools
import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import psutil
import pytest
from scipy.spatial.transform import Rotation

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.errors import InvalidMotionError, InvalidStateError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import CameraHeight, KnownHeading, Query
from lalaloc_core.localise.search.pipeline import run_steps
from lalaloc_core.localise.tracking import Odometry, TrackState
from lalaloc_core.localise.tracking.track_state import StatePlan
from lalaloc_core.localise.tracking.tracked_plans import PlanOnLevel, TrackedPlans
from lalaloc_core.localise.tracking.tracking_filter import Tracked, track_steps
from lalaloc_core.localise.tracking.trajectories import Frame, read_trajectory
from lalaloc_core.localise.tracking.walk_motion import States, WalkGraph, moved
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from tests.core.questions import Walk, queries_along
from tests.strategies import l_shape, plan_of, present, rectangle

SECTORS = 16
CAMERA_M, STEP_M = 1.5, 0.5
EXACT = (0.05, 0.05, math.radians(2.0))
# From the left room through its door into the right one, and back.
WALK: Walk = [
    ((1.0, 1.0), 0, 1.6),
    ((2.0, 1.1), 0, 1.5),
    ((3.0, 1.4), 0, 1.6),
    ((4.8, 1.5), 1, 1.6),
    ((6.0, 1.6), 1, 0.4),
    ((6.3, 2.6), 1, 0.2),
]
# The rooms of the walk with a door between them, and a third one without.
RIGHT = [[4.2, 0.0], [9.2, 0.0], [9.2, 3.0], [7.0, 3.0], [7.0, 4.5], [4.2, 4.5]]
DOOR = {"kind": "door", "line": [[4.1, 1.0], [4.1, 2.0]]}
OPENINGS = {"openings": [DOOR], "opening_kinds": ["door", "window", "passage"]}
PLAN = plan_of(l_shape(4.0, 3.0, 1.2, 0.8), RIGHT, rectangle(4.0, 3.0, corner=(0.0, 3.2)), **OPENINGS)


@pytest.fixture(scope="module")
def grid(encoders: PhotographEncoder) -> PoseGrid:
    return build_grid(PLAN, encoders.layouts, step_m=STEP_M, camera_height_m=CAMERA_M)


@pytest.fixture(scope="module")
def graph(grid: PoseGrid) -> WalkGraph:
    return WalkGraph.of(grid.poses, grid.layouts(PLAN), grid.step_m)


@pytest.fixture(scope="module")
def ground(grid: PoseGrid, graph: WalkGraph) -> TrackedPlans:
    return TrackedPlans.of_plan(PLAN, grid, graph)


@pytest.fixture(scope="module")
def queries(encoders: PhotographEncoder) -> list[Query]:
    return queries_along(encoders, PLAN, WALK, CameraHeight(CAMERA_M, 0.0))


def odometry_along(walk: Walk) -> list[Odometry | None]:
    """Return the exact motion that leads to each place; None for the first."""
    found: list[Odometry | None] = [None]
    for (first, _, heading), (second, _, later) in itertools.pairwise(walk):
        x, y = np.subtract(second, first)
        sine, cosine = math.sin(heading), math.cos(heading)
        turn = float(wrap_angle(later - heading))
        found.append(Odometry.of_stds(x * sine + y * cosine, x * cosine - y * sine, turn, EXACT))
    return found


def at(grid: PoseGrid, place: tuple[float, float], heading: float) -> States:
    pose = int(np.linalg.norm(grid.poses.position_m - place, axis=1).argmin())
    sector = round(heading / (math.tau / SECTORS)) % SECTORS
    return States(np.array([pose]), np.array([sector]), np.ones(1))


class TestMotion:
    def test_belief_moves_by_odometry(self, grid: PoseGrid, graph: WalkGraph) -> None:
        start = at(grid, (1.0, 1.0), math.pi / 2)
        ahead = Odometry.of_stds(1.5, -0.5, math.pi / 2, EXACT)
        belief = moved(graph, start, SECTORS, ahead)
        pose, sector = np.unravel_index(int(belief.argmax()), belief.shape)
        # The start looks along +x, so its right is along -y.
        expected = grid.poses.position_m[start.pose[0]] + [1.5, 0.5]
        assert np.linalg.norm(grid.poses.position_m[pose] - expected) < STEP_M
        assert sector == SECTORS // 2

    @pytest.mark.parametrize(
        ("place", "ahead", "room", "is_open"),
        [((3.5, 1.5), 1.0, 1, True), ((2.0, 2.5), 1.2, 2, False)],
        ids=["door", "wall"],
    )
    def test_walls_stop_and_doors_do_not(
        self, grid: PoseGrid, graph: WalkGraph, place: tuple[float, float], ahead: float, room: int, is_open: bool
    ) -> None:
        heading = 0.0 if room == 2 else math.pi / 2
        belief = moved(graph, at(grid, place, heading), SECTORS, Odometry.of_stds(ahead, 0.0, 0.0, EXACT))
        crossed = belief[grid.poses.room_index == room].sum()
        assert crossed > 0.3 if is_open else crossed < 0.03

    def test_without_odometry_the_belief_stays_within_reach(self, grid: PoseGrid, graph: WalkGraph) -> None:
        belief = moved(graph, at(grid, (1.0, 1.0), 0.0), SECTORS, None)
        assert belief.sum() == pytest.approx(1.0)
        assert belief[grid.poses.room_index == 2].sum() == 0.0
        assert np.count_nonzero(belief.sum(axis=1)) > 10

    @pytest.mark.parametrize(
        ("values", "message"),
        [
            ({"forward_m": math.nan}, "forward_m is nan; it must be a finite number"),
            ({"forward_m": 1000.0}, "the motion is 1000 m long; the limit is 50 m"),
            ({"turn": 20.0}, "the turn is 1145.92°; the limit is 720° either way"),
            ({"covariance": np.diag([1.0, -1.0, 1.0])}, "a variance must not be negative"),
            ({"covariance": np.full((3, 3), math.inf)}, "3 rows of 3 finite numbers"),
            ({"covariance": np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])}, "positive semidefinite"),
            (
                {"covariance": np.array([[1.0, 0.5, 0.0], [0.2, 1.0, 0.0], [0.0, 0.0, 1.0]])},
                "differ .* by 0.3; send rows",
            ),
            ({"covariance": np.diag([1e4, 1.0, 1.0])}, "the deviation of forward_m is 100 m; the limit is 50 m"),
        ],
    )
    def test_impossible_odometry_is_refused(self, values: dict[str, Any], message: str) -> None:
        usual: dict[str, Any] = {"forward_m": 1.0, "right_m": 0.0, "turn": 0.0, "covariance": np.eye(3)}
        with pytest.raises(InvalidMotionError, match=message):
            Odometry(**(usual | values))

    def test_negative_deviation_is_refused(self) -> None:
        with pytest.raises(InvalidMotionError, match="right_std_m is -1"):
            Odometry.of_stds(1.0, 0.0, 0.0, (0.1, -1.0, 0.1))


def follow(
    ground: TrackedPlans, encoders: PhotographEncoder, queries: list[Query], moves: list[Odometry | None]
) -> list[Tracked]:
    """Follow a walk, with the state in bytes between photographs."""
    state, found = TrackState.first(len(queries[0].roll)), []
    for query, move in zip(queries, moves, strict=True):
        found.append(run_steps(track_steps(ground, encoders.layouts, state, query, move), lambda _job: None))
        state = TrackState.from_bytes(found[-1].state.to_bytes())
    return found


class TestFilter:
    def test_walk_is_followed_through_a_door(
        self, ground: TrackedPlans, encoders: PhotographEncoder, queries: list[Query]
    ) -> None:
        found = follow(ground, encoders, queries, odometry_along(WALK))
        for (place, room, heading), answer in list(zip(WALK, found, strict=True))[1:]:
            assert answer.pose.room_index == room
            assert np.linalg.norm(answer.pose.position_m - place) < STEP_M
            assert abs(wrap_angle(answer.pose.heading - heading)) < math.radians(15.0)
        last = found[-1]
        assert last.state.suspected == ()
        assert np.linalg.eigvalsh(last.pose.covariance).min() > 0.0

    def test_camera_carried_elsewhere_is_found_again(
        self, ground: TrackedPlans, encoders: PhotographEncoder, queries: list[Query]
    ) -> None:
        still = Odometry.of_stds(0.0, 0.0, 0.0, EXACT)
        carried = [*queries[:3], *queries[5:], *queries[5:], *queries[5:]]
        found = follow(ground, encoders, carried, [*odometry_along(WALK)[:3], still, still, still])
        assert np.linalg.norm(found[-1].pose.position_m - WALK[-1][0]) < STEP_M

    @pytest.mark.parametrize(("off_deg", "right"), [(0.0, True), (25.0, True), (80.0, False)])
    def test_known_heading_is_right_within_its_tolerance(
        self, ground: TrackedPlans, encoders: PhotographEncoder, queries: list[Query], off_deg: float, right: bool
    ) -> None:
        state, heading = TrackState.first(len(queries[0].roll)), WALK[0][2]
        beliefs = []
        for error in (0.0, math.radians(off_deg)):
            known = KnownHeading(heading + error, math.radians(30.0), "given")
            steps = track_steps(ground, encoders.layouts, state, queries[0], None, known_heading=known)
            belief = run_steps(steps, lambda _job: None).state.belief
            beliefs.append(belief.weight[belief.sector == round(heading / (math.tau / state.sectors))].sum())
        # As probable as with the exact heading; far less probable beyond the tolerance.
        assert (beliefs[1] > 0.5 * beliefs[0]) == right

    def test_other_grid_is_refused(
        self, ground: TrackedPlans, encoders: PhotographEncoder, queries: list[Query]
    ) -> None:
        other = (StatePlan("", len(ground.grid.poses) + 1),)
        state = replace(TrackState.first(len(queries[0].roll)), plans=other)
        with pytest.raises(InvalidStateError, match="begin a new session"):
            run_steps(track_steps(ground, encoders.layouts, state, queries[0], None), lambda _job: None)


def building(encoders: PhotographEncoder, plans: Sequence[FloorPlan]) -> TrackedPlans:
    """Return the ground of a building with one plan per level."""
    grids = [build_grid(plan, encoders.layouts, step_m=STEP_M, camera_height_m=CAMERA_M) for plan in plans]
    graphs = [WalkGraph.of(grid.poses, grid.layouts(plan), STEP_M) for plan, grid in zip(plans, grids, strict=True)]
    entries = [PlanOnLevel(plan, float(level)) for level, plan in enumerate(plans)]
    levels, keys = [entry.level for entry in entries], [f"plan {level}" for level in range(len(plans))]
    return TrackedPlans.of_levels(MergedPlans.of(plans, grids, CAMERA_M), entries, graphs, keys, levels)


def level_of(*polygons: list[list[float]], stairs: str | None) -> FloorPlan:
    """Return a level whose last room is called and typed by `stairs`, with doors from there to the first room."""
    document = plan_of(*polygons).to_dict()
    if stairs is not None:
        document["rooms"][-1] |= {"name": stairs, "type": "stairs" if stairs == "stairs" else "unknown"}
    door = {"kind": "door", "line": [[4.1, 0.5], [4.1, 1.5]]}
    return FloorPlan.from_dict(document | {"openings": [door], "opening_kinds": ["door", "window", "passage"]})


STAIRS = rectangle(2.0, 3.6, corner=(4.2, 0.0))
LOWER, UPPER = l_shape(4.0, 3.0, 1.2, 0.8), l_shape(4.0, 8.0, 1.5, 3.0)
# In the room and on the stairs of the lower level, on the stairs and in the room of the upper one.
CLIMB: list[tuple[int, Walk]] = [
    (0, [((1.0, 1.0), 0, 1.6), ((3.0, 1.2), 0, 1.5), ((5.0, 1.2), 1, 0.2)]),
    (1, [((5.2, 2.6), 1, 3.0), ((3.2, 1.0), 0, 4.7), ((1.6, 2.0), 0, 5.5), ((1.5, 3.5), 0, 0.1)]),
]


class TestLevels:
    @pytest.mark.parametrize("stairs", ["stairs", "Lift 2", None])
    def test_camera_is_followed_to_another_level(self, encoders: PhotographEncoder, stairs: str | None) -> None:
        plans = [level_of(LOWER, STAIRS, stairs=stairs), level_of(UPPER, STAIRS, stairs=stairs)]
        height = CameraHeight(CAMERA_M, 0.0)
        queries = [query for level, walk in CLIMB for query in queries_along(encoders, plans[level], walk, height)]
        walk = [pose for _, part in CLIMB for pose in part]
        found = follow(building(encoders, plans), encoders, queries, odometry_along(walk))
        levels = [level for level, part in CLIMB for _ in part]
        # The photographs on the stairs of both levels are alike.
        for index in (1, 2, 5, 6):
            (place, room, _), answer = walk[index], found[index]
            assert (answer.pose.plan, answer.pose.room_index) == (levels[index], room)
            assert np.linalg.norm(answer.pose.position_m - place) < STEP_M
            assert answer.contradicted == ()
        assert found[-1].pose.mode == "tracking"
        kept = found[-1].state
        assert max(kept.by_plan, key=kept.by_plan.__getitem__) == "plan 1"

    def test_stairs_are_taken_rather_than_walls(self, encoders: PhotographEncoder) -> None:
        levels = [level_of(outline, STAIRS, stairs="stairs") for outline in (LOWER, UPPER)]
        ground = building(encoders, levels)
        moves = Odometry.of_stds(0.5, 0.0, 0.0, EXACT)
        arrived = []
        for place in ((1.0, 1.0), (5.0, 1.2)):
            start = at(ground.grid, tuple(np.add(place, ground.merged.shift_m[0])), 0.0)
            belief = ground.moved(start, SECTORS, moves)
            arrived.append(belief[ground.graph.first[1] :].sum())
        assert arrived[0] == 0.0
        assert arrived[1] == pytest.approx(0.1, abs=0.02)

    def test_levels_without_stairs_are_joined_everywhere(self, encoders: PhotographEncoder) -> None:
        ground = building(encoders, [level_of(LOWER, STAIRS, stairs=name) for name in (None, None, "stairs")])
        start = at(ground.grid, tuple(np.add((1.0, 1.0), ground.merged.shift_m[0])), 0.0)
        belief = ground.moved(start, SECTORS, None)
        arrived = np.add.reduceat(belief.sum(axis=1), ground.graph.first[:-1])
        assert arrived[1] == pytest.approx(0.01)
        assert arrived[2] == 0.0

    def test_right_plan_of_similar_ones_is_found(self, encoders: PhotographEncoder) -> None:
        # The plans differ in their second rooms alone.
        others = [rectangle(2.0, depth, corner=(4.2, 0.0)) for depth in (2.4, 3.6, 4.8)]
        plans = [level_of(LOWER, other, stairs=None) for other in others]
        ground = building(encoders, plans)
        walk: Walk = [((1.0, 1.0), 0, 1.6), ((3.0, 1.2), 0, 1.5), ((5.0, 1.2), 1, 0.2), ((5.0, 1.7), 1, 0.1)]
        queries = queries_along(encoders, plans[1], walk, CameraHeight(CAMERA_M, 0.0))
        found = follow(ground, encoders, queries, odometry_along(walk))
        assert found[0].pose.probability < 0.6
        assert [answer.pose.plan for answer in found[2:]] == [1, 1]
        assert found[-1].pose.probability > 0.6

    def test_belief_keeps_its_plans_when_the_ground_changes(self, encoders: PhotographEncoder) -> None:
        plans = [level_of(LOWER, STAIRS, stairs="stairs"), level_of(UPPER, STAIRS, stairs="stairs")]
        query = queries_along(encoders, plans[1], CLIMB[1][1][2:3], CameraHeight(CAMERA_M, 0.0))
        ground = building(encoders, plans)
        state = follow(ground, encoders, query, [None])[0].state
        turned = building(encoders, plans[::-1])
        turned = replace(turned, keys=ground.keys[::-1])
        again = turned.left(turned.entered(state))
        assert again.by_plan == pytest.approx(state.by_plan)
        assert present(again.pose).position_m == pytest.approx(present(state.pose).position_m)
        alone = replace(TrackedPlans.of_plan(plans[0], ground.grid), keys=("another",))
        assert alone.entered(state).pose is None
        assert not len(alone.entered(state).belief.pose)


class TestState:
    def test_size_does_not_grow(self, ground: TrackedPlans, encoders: PhotographEncoder, queries: list[Query]) -> None:
        state = follow(ground, encoders, queries[:1], [None])[0].state
        many = np.random.default_rng(0).integers(0, 100, 4096)
        full = replace(state, belief=States(many, many % state.sectors, np.full(4096, 1 / 4096)))
        assert len(full.to_bytes()) < 100_000
        again = TrackState.from_bytes(full.to_bytes())
        np.testing.assert_array_equal(again.belief.pose, full.belief.pose)
        np.testing.assert_allclose(again.belief.weight, full.belief.weight)
        np.testing.assert_allclose(present(again.pose).covariance, present(state.pose).covariance)

    def test_other_number_of_sectors_keeps_the_belief(self) -> None:
        belief = States(np.array([3, 3, 7]), np.array([0, 15, 4]), np.array([0.2, 0.3, 0.5]))
        state = replace(replace(TrackState.first(16), plans=(StatePlan("", 10),)), belief=belief)
        assert state.with_sectors(16) is state
        for sectors in (8, 32, 48):
            other = state.with_sectors(sectors)
            assert other.sectors == sectors
            assert other.belief.weight.sum() == pytest.approx(1.0)
            assert other.belief.weight[other.belief.pose == 7].sum() == pytest.approx(0.5)
            of_seven = other.belief.pose == 7
            heading = np.exp(1j * math.tau / sectors * other.belief.sector[of_seven]) @ other.belief.weight[of_seven]
            assert np.angle(heading) == pytest.approx(math.pi / 2)

    @pytest.mark.slow
    def test_session_of_10_000_photographs_does_not_grow(
        self, ground: TrackedPlans, encoders: PhotographEncoder, queries: list[Query]
    ) -> None:
        there = [*range(len(WALK)), *range(len(WALK) - 2, 0, -1)]
        order = [there[index % len(there)] for index in range(10_000)]
        moves = odometry_along([WALK[index] for index in order])
        content, sizes, before = TrackState.first(len(queries[0].roll)).to_bytes(), list[int](), 0
        for number, (index, move) in enumerate(zip(order, moves, strict=True)):
            state = TrackState.from_bytes(content)
            steps = track_steps(ground, encoders.layouts, state, queries[index], move)
            content = run_steps(steps, lambda _job: None).state.to_bytes()
            sizes.append(len(content))
            if number == 500:
                before = psutil.Process().memory_info().rss
        assert psutil.Process().memory_info().rss - before < 32 * 2**20
        assert max(sizes) < 100_000
        assert max(sizes[500:]) < max(sizes[:500]) + 2000
        assert np.linalg.norm(present(TrackState.from_bytes(content).pose).position_m - WALK[order[-1]][0]) < STEP_M

    @pytest.mark.parametrize("damage", ["cut", "flipped", "version", "number"])
    def test_damaged_state_is_refused(self, damage: str) -> None:
        belief = States(np.array([9]), np.array([3]), np.ones(1))
        state = replace(TrackState.first(4), plans=(StatePlan("", 10),), belief=belief)
        content = state.to_bytes()
        if damage == "number":
            content = replace(state, plans=(StatePlan("", 9),)).to_bytes()
        elif damage == "cut":
            content = content[:12]
        elif damage == "version":
            content = content[:4] + struct.pack("<H", 9) + content[6:]
        else:
            body = bytearray(zlib.decompress(content[10:]))
            body[-1] ^= 1
            content = content[:10] + zlib.compress(bytes(body))
        with pytest.raises(InvalidStateError):
            TrackState.from_bytes(content)


# TUM odometry in the frames of robots and of visual SLAM


# Azimuths (radians, clockwise) and places (m, to the right and forward of the first pose) of a walk.
TURNS = np.radians([0.0, -40.0, -90.0, -100.0, 30.0])
PLACES = np.array([[0.0, 0.0], [0.5, 2.0], [-1.0, 4.0], [-3.0, 3.5], [-3.0, 6.0]])
# Columns are right, forward and up of the camera in the axes of the body, or of the first camera in those of the world.
REP103 = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
OPTICAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def tum(body: np.ndarray, world: np.ndarray, turns: np.ndarray = TURNS, places: np.ndarray = PLACES) -> str:
    """Return TUM lines of the walk, for axes of the body and of the world."""
    lines = []
    for time_s, (turn, (x, y)) in enumerate(zip(turns, places, strict=True)):
        # Azimuths are clockwise, angles of scipy counterclockwise.
        level = Rotation.from_euler("z", -turn).as_matrix()
        # TUM states x, y, z, w, as scipy does.
        values = [*(world @ [x, y, 0.02 * time_s]), *Rotation.from_matrix(world @ level @ body.T).as_quat()]
        lines.append(" ".join(f"{value:.9f}" for value in (float(time_s), *values)))
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("body", "world", "frame", "is_named"),
    [
        (REP103, REP103, "rep103", False),
        (OPTICAL, OPTICAL, "optical", True),
        (OPTICAL, REP103, "optical", True),
        (OPTICAL, np.eye(3), "optical", True),
    ],
    ids=["robot", "first camera", "level world of a robot", "level world"],
)
def test_frames_are_recognised(body: np.ndarray, world: np.ndarray, frame: str, *, is_named: bool) -> None:
    text = tum(body, world)
    for stated in ("auto", frame):
        path = read_trajectory(text, stated)  # pyright: ignore[reportArgumentType]
        assert bool(path.warnings) == (is_named and stated == "auto")
        for step in range(1, len(TURNS)):
            motion = path.motion(step - 1.0, float(step))
            right, ahead = PLACES[step] - PLACES[step - 1]
            before = TURNS[step - 1]
            forward_m = ahead * math.cos(before) + right * math.sin(before)
            assert motion.forward_m == pytest.approx(forward_m, abs=1e-6)
            assert motion.right_m == pytest.approx(right * math.cos(before) - ahead * math.sin(before), abs=1e-6)
            assert math.remainder(motion.turn - TURNS[step] + before, math.tau) == pytest.approx(0.0, abs=1e-6)


def test_straight_ways_tell_the_frame_by_their_heights() -> None:
    turns, places = np.zeros(3), np.array([[0.0, 0.0], [0.0, 2.0], [0.0, 5.0]])
    for body, is_optical in ((REP103, False), (OPTICAL, True)):
        path = read_trajectory(tum(body, body, turns, places))
        assert bool(path.warnings) == is_optical
        assert path.motion(0.0, 2.0).forward_m == pytest.approx(5.0, abs=1e-6)


def test_poses_that_are_upright_in_no_frame_are_refused() -> None:
    lying = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    text = tum(lying, REP103)
    for frame in get_args(Frame):
        with pytest.raises(InvalidMotionError, match=r"lean by up to \d+° .*; the limit is 35°: .*--odometry-frame"):
            read_trajectory(text, frame)
    with pytest.raises(InvalidMotionError, match="has no rotation"):
        read_trajectory("0 0 0 0 0 0 0 0\n1 1 0 0 0 0 0 0")
