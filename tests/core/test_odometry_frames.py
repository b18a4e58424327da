"""TUM odometry in the frames of robots and of visual SLAM."""

from __future__ import annotations

import math
from typing import get_args

import numpy as np
import pytest

from lalaloc_core.errors import InvalidMotionError
from lalaloc_core.localise.tracking.trajectories import Frame, read_trajectory

# Azimuths (radians, clockwise) and places (m, to the right and forward of the first pose) of a walk.
TURNS = np.radians([0.0, -40.0, -90.0, -100.0, 30.0])
PLACES = np.array([[0.0, 0.0], [0.5, 2.0], [-1.0, 4.0], [-3.0, 3.5], [-3.0, 6.0]])
# Columns are right, forward and up of the camera in the axes of the body, or of the first camera in those of the world.
REP103 = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
OPTICAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def quaternion(matrix: np.ndarray) -> tuple[float, ...]:
    """Return (x, y, z, w) of a rotation, by the eigenvector of its largest eigenvalue (Bar-Itzhack)."""
    symmetric = 0.5 * (matrix + matrix.T) - 0.5 * np.trace(matrix) * np.eye(3)
    skew = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2.0
    whole = np.block([[symmetric, skew[:, None]], [skew[None], np.array([[0.5 * np.trace(matrix)]])]])
    return tuple(np.linalg.eigh(whole)[1][:, -1])


def tum(body: np.ndarray, world: np.ndarray, turns: np.ndarray = TURNS, places: np.ndarray = PLACES) -> str:
    """Return TUM lines of the walk, for axes of the body and of the world."""
    lines = []
    for time_s, (turn, (x, y)) in enumerate(zip(turns, places, strict=True)):
        level = np.array(
            [[math.cos(turn), math.sin(turn), 0.0], [-math.sin(turn), math.cos(turn), 0.0], [0.0, 0.0, 1.0]]
        )
        values = [*(world @ [x, y, 0.02 * time_s]), *quaternion(world @ level @ body.T)]
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
