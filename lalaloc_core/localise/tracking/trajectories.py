"""Odometry and trajectories in files: CSV, and the format of the TUM RGB-D benchmark.

Both have one pose per line, in the frames of REP 103: x forward, y to the left, yaw counter-clockwise from +x.
TUM: `time x y z qx qy qz qw`. CSV: a header with `time_s`, `x_m`, `y_m` and `yaw_deg`. TUM files of visual SLAM have
optical axes instead (z forward, y down), and the frame of the first camera or a level one as their world.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.errors import InvalidMotionError
from lalaloc_core.localise.tracking.walk_motion import Odometry, usual_stds

_CSV = ("time_s", "x_m", "y_m", "yaw_deg")
_TUM_VALUES = 8
# Frames of TUM poses; "auto" chooses by gravity.
Frame = Literal["auto", "optical", "rep103"]
# Cosine of the largest tilt of a camera or robot that stays upright, and the advantage of a frame that is chosen.
_UPRIGHT, _CLEARER = math.cos(math.radians(35.0)), 0.1
# Share of the way on the floor that heights vary by, at most, and the shortest way (m) that tells.
_LEVEL, _SHORTEST_M = 0.2, 0.5


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses by time: seconds, positions (m), and yaws (radians, counter-clockwise from +x); warnings about the file."""

    time_s: Float[np.ndarray, "n"]
    position_m: Float[np.ndarray, "n 2"]
    yaw: Float[np.ndarray, "n"]
    warnings: tuple[str, ...] = ()

    def at(self, time_s: float) -> tuple[Float[np.ndarray, "2"], float]:
        """Return the interpolated position and yaw at a time."""
        if not self.time_s[0] <= time_s <= self.time_s[-1]:
            raise InvalidMotionError(
                f"a photograph was taken at {time_s:g} s; the odometry is from {self.time_s[0]:g} to "
                f"{self.time_s[-1]:g} s"
            )
        position = np.array([np.interp(time_s, self.time_s, self.position_m[:, axis]) for axis in (0, 1)])
        return position, float(np.interp(time_s, self.time_s, np.unwrap(self.yaw)))

    def motion(self, first_s: float, second_s: float, mount: float = 0.0) -> Odometry:
        """Return the motion between two times, in the frame of the camera.

        `mount` is the azimuth (radians, clockwise) of the camera's heading relative to the frame's x.
        """
        (start, yaw), (end, later) = self.at(first_s), self.at(second_s)
        x, y = end - start
        # Clockwise from the camera's heading, as azimuths.
        ahead = -math.atan2(y, x) + yaw - mount
        length_m = math.hypot(x, y)
        turn = -float(wrap_angle(later - yaw))
        forward_m, right_m = length_m * math.cos(ahead), length_m * math.sin(ahead)
        return Odometry.of_stds(forward_m, right_m, turn, usual_stds(length_m))


def read_trajectory(text: str, frame: Frame = "auto") -> Trajectory:
    """Read a CSV or TUM file; `frame` is that of TUM poses."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    is_csv = bool(lines) and "," in lines[0]
    rows = _csv_rows(lines) if is_csv else [_tum_row(line, n) for n, line in enumerate(lines, 1)]
    if len(rows) < 2:
        raise InvalidMotionError(f"the odometry has {len(rows)} poses; it needs at least 2")
    values = np.array(rows, dtype=float)
    if not np.isfinite(values).all():
        raise InvalidMotionError("the odometry has values that are not finite")
    if not (np.diff(values[:, 0]) > 0.0).all():
        row = int(np.argmin(np.diff(values[:, 0]))) + 2
        raise InvalidMotionError(f"pose {row} of the odometry is not later than the one before: sort it by time")
    return Trajectory(values[:, 0], values[:, 1:3], values[:, 3]) if is_csv else _placed(values, frame)


def _placed(values: Float[np.ndarray, "n 8"], frame: Frame) -> Trajectory:
    """Return the poses of a TUM file on the floor."""
    position_m, axes = values[:, 1:4], _rotations(values[:, 4:])
    ways = {
        # Up of the body along up of the world, coordinates of the floor (x, y), and forward of the body.
        "rep103": (axes[:, 2, 2], (0, 1), (1.0, 1.0), axes[:, :, 0]),
        "optical": (axes[:, 1, 1], (2, 0), (1.0, -1.0), axes[:, :, 2]),
        "optical in a level world": (-axes[:, 2, 1], (0, 1), (1.0, 1.0), axes[:, :, 2]),
    }
    upright = {name: float(np.min(way[0])) for name, way in ways.items() if frame in ("auto", name.split()[0])}
    if frame == "auto":
        upright = {name: share - _rise(position_m, ways[name][1]) for name, share in upright.items()}
    # Where a frame is as likely as that of REP 103, such as on a straight way, it is not chosen.
    name = max(upright, key=lambda name: upright[name] + (_CLEARER if name == "rep103" else 0.0))
    if float(np.min(ways[name][0])) < _UPRIGHT:
        tilt_deg = math.degrees(math.acos(max(-1.0, min(1.0, float(np.min(ways[name][0]))))))
        raise InvalidMotionError(
            f"the poses of the odometry lean by up to {tilt_deg:.0f}° in the frame '{name}'; the limit is 35°: check "
            "the quaternions (qx qy qz qw) and --odometry-frame (rep103: x forward, z up; optical: z forward, y down)"
        )
    _, floor, signs, forward = ways[name]
    ahead = forward[:, floor] * signs
    text = "the odometry was taken for one of optical axes (z forward, y down); state --odometry-frame to be sure"
    warnings = (text,) if frame == "auto" and name != "rep103" else ()
    return Trajectory(values[:, 0], position_m[:, floor] * signs, np.arctan2(ahead[:, 1], ahead[:, 0]), warnings)


def _rise(position_m: Float[np.ndarray, "n 3"], floor: tuple[int, int]) -> float:
    """Return 1 if the poses rise more than people and robots do on the way between them, else 0."""
    extent = np.ptp(position_m, axis=0)
    length_m = float(np.hypot(*extent[list(floor)]))
    rise_m = float(extent[3 - sum(floor)])
    return float(rise_m > max(_LEVEL * length_m, _SHORTEST_M))


def _rotations(quaternions: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    """Return rotations from the body to the world; columns are the axes of the body."""
    # Imported late: few walks come with a file of odometry.
    from scipy.spatial.transform import Rotation

    if not (np.linalg.norm(quaternions, axis=1) > 0.5).all():
        raise InvalidMotionError("a pose of the odometry has no rotation: qx qy qz qw must have the length 1")
    return Rotation.from_quat(quaternions).as_matrix()


def tum_line(time_s: float, position_m: tuple[float, float], z_m: float, heading: float) -> str:
    """Return a pose of the plan frame as a line of a TUM file; `heading` is an azimuth (radians)."""
    yaw = 0.5 * math.pi - heading
    x, y = position_m
    return f"{time_s:.6f} {x:.4f} {y:.4f} {z_m:.4f} 0 0 {math.sin(0.5 * yaw):.7f} {math.cos(0.5 * yaw):.7f}"


def _csv_rows(lines: list[str]) -> list[list[float]]:
    reader = csv.DictReader(io.StringIO("\n".join(lines)))
    if missing := [name for name in _CSV if name not in (reader.fieldnames or [])]:
        raise InvalidMotionError(f"the odometry has no column {missing[0]}; it needs {', '.join(_CSV)}")
    rows = []
    for number, row in enumerate(reader, 1):
        time_s, x, y, yaw_deg = (_number(row[name], number) for name in _CSV)
        rows.append([time_s, x, y, math.radians(yaw_deg)])
    return rows


def _tum_row(line: str, number: int) -> list[float]:
    values = [_number(word, number) for word in line.split()]
    if len(values) != _TUM_VALUES:
        raise InvalidMotionError(
            f"pose {number} of the odometry has {len(values)} values; TUM lines have {_TUM_VALUES}"
        )
    return values


def _number(text: str | None, number: int) -> float:
    try:
        return float(text or "")
    except ValueError as error:
        raise InvalidMotionError(f"pose {number} of the odometry has '{text}', which is not a number") from error
