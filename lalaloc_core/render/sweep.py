"""Layouts of many poses at once: each wall fills only the columns between the azimuths of its ends.

`profile.py` casts every ray at every wall, and in large rooms most of these pairs miss. Here the azimuths of a wall's
ends give the columns it can fill, and the nearest wall of each column wins. The cost grows with the number of columns,
plus two arctangents per wall. Distances equal those of `profile.py`, but in numpy, without gradients.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from lalaloc_core.conventions import DOOR_CODE, PASSAGE_CODE, TWO_PI, WALL_CODE, column_azimuths
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.geometry import WallTable
from lalaloc_core.render.profile import CORNER_TOLERANCE, EDGE_ON

# Pairs of pose or ray and wall that are processed at once, to bound memory.
_PAIRS = 1 << 16
# A ray through an opening restarts this far (m) beyond it, so that it does not meet the same wall again.
_BEYOND_M = 1e-3


@dataclass(frozen=True, eq=False)
class SweptLayouts:
    """Layouts of n poses in w columns each.

    Attributes:
        distance_m: (n, w) distance to the nearest wall of the pose's own room; inf outside a room.
        kind: (n, w) code in `conventions.OPENING_CLASSES` of that wall at eye height.
        row, column: (m,) rays that continue through a door or passage, row by row.
        behind_m: (m,) distance along these rays to the next wall of the room behind.
    """

    distance_m: Float[np.ndarray, "n w"]
    kind: UInt8[np.ndarray, "n w"]
    row: Int[np.ndarray, "m"]
    column: Int[np.ndarray, "m"]
    behind_m: Float[np.ndarray, "m"]


def sweep_layouts(
    position_m: Float[np.ndarray, "n 2"],
    heading: Float[np.ndarray, "n"],
    room_index: Int[np.ndarray, "n"],
    walls: WallTable,
    columns: int,
    eye_m: float | Float[np.ndarray, "m"],
) -> SweptLayouts:
    """Render the layouts of poses of a plan, or of several plans with a joined table.

    Positions are inside their rooms; `heading` is the azimuth of the centre column, radians. An opening is visible if
    its sill is below the eye and its head above; `eye_m` is one height, or that for each opening face of the table.
    """
    distance_m = np.empty((len(position_m), columns), np.float32)
    kind = np.full((len(position_m), columns), WALL_CODE, np.uint8)
    through_rows, through_columns = [np.empty(0, np.intp)], [np.empty(0, np.intp)]
    behind_m = [np.empty(0, np.float32)]
    at_eye = np.flatnonzero((walls.sill_m < eye_m) & (eye_m < walls.head_m))
    for part in _parts(room_index, walls, columns):
        rays = _Rays.cast(position_m[part], heading[part], columns)
        distance, wall = _nearest(rays, room_index[part], walls)
        distance_m[part] = distance
        row, column, number = _openings(rays, distance, wall, walls, at_eye)
        kind[row + part.start, column] = walls.opening_kind[number]
        leads_on = np.isin(walls.opening_kind[number], (DOOR_CODE, PASSAGE_CODE)) & (walls.behind[number] >= 0)
        row, column, number = row[leads_on], column[leads_on], number[leads_on]
        met_m = distance[row, column]
        seen_m = _behind(position_m[part][row], rays.along(row, column), met_m, number, walls)
        through = seen_m > met_m
        through_rows.append(row[through] + part.start)
        through_columns.append(column[through])
        behind_m.append(seen_m[through].astype(np.float32))
    rows, columns_through = np.concatenate(through_rows), np.concatenate(through_columns)
    return SweptLayouts(distance_m, kind, rows, columns_through, np.concatenate(behind_m))


def faces_met(
    position_m: Float[np.ndarray, "n 2"],
    heading: Float[np.ndarray, "n"],
    room_index: Int[np.ndarray, "n"],
    walls: WallTable,
    columns: int,
    eye_m: float,
) -> tuple[Float[np.ndarray, "n {columns}"], Int[np.ndarray, "n {columns}"]]:
    """Return the distance (m) to the wall, and the index in the table of the opening face in it, -1 for none.

    The arguments are those of `sweep_layouts`.
    """
    distance_m = np.empty((len(position_m), columns))
    face = np.full(distance_m.shape, -1)
    at_eye = np.flatnonzero((walls.sill_m < eye_m) & (eye_m < walls.head_m))
    for part in _parts(room_index, walls, columns):
        rays = _Rays.cast(position_m[part], heading[part], columns)
        distance_m[part], wall = _nearest(rays, room_index[part], walls)
        row, column, number = _openings(rays, distance_m[part], wall, walls, at_eye)
        face[row + part.start, column] = number
    return distance_m, face


def profiles_at(
    plan: FloorPlan,
    position_m: Float[np.ndarray, "n 2"],
    room_index: Int[np.ndarray, "n"],
    heading: Float[np.ndarray, "n"],
    columns: int,
    dtype: type[np.floating] = np.float64,
) -> Float[np.ndarray, "n {columns}"]:
    """Return the wall profiles (m) of poses, each within its own room.

    Positions are inside their rooms; `heading` is the azimuth of the centre column, radians.
    """
    walls = plan.wall_table
    distance_m = np.empty((len(position_m), columns), dtype)
    for part in _parts(room_index, walls, columns):
        rays = _Rays.cast(position_m[part], heading[part], columns)
        distance_m[part], _ = _nearest(rays, room_index[part], walls)
    return distance_m


@dataclass(frozen=True, eq=False)
class _Rays:
    """Rays of b poses in w columns: components of their unit vectors, stored once if all headings are equal."""

    position_m: Float[np.ndarray, "b 2"]
    heading: Float[np.ndarray, "b"]
    columns: int
    x: Float[np.ndarray, "k w"]
    y: Float[np.ndarray, "k w"]

    @classmethod
    def cast(cls, position_m: Float[np.ndarray, "b 2"], heading: Float[np.ndarray, "b"], columns: int) -> _Rays:
        distinct = heading[:1] if (heading == heading[0]).all() else heading
        azimuth = distinct[:, None] + column_azimuths(columns)[None]
        return cls(position_m, heading, columns, np.sin(azimuth), np.cos(azimuth))

    def along(self, row: Int[np.ndarray, "m"], column: Int[np.ndarray, "m"]) -> Float[np.ndarray, "m 2"]:
        """Return the (m, 2) unit vectors of rays."""
        index = column if len(self.x) == 1 else row * self.columns + column
        return np.stack([self.x.ravel()[index], self.y.ravel()[index]], axis=1)


def _parts(room_index: Int[np.ndarray, "n"], walls: WallTable, columns: int) -> Iterator[slice]:
    """Yield slices of poses of about `_PAIRS` pairs each."""
    # A rough count of pairs: the walls of the room, or the columns if they are more.
    work = np.cumsum(np.maximum(np.diff(walls.first)[room_index], columns))
    begin = 0
    while begin < len(room_index):
        past = int(work[begin - 1]) if begin else 0
        end = max(begin + 1, int(np.searchsorted(work, past + _PAIRS, side="right")))
        yield slice(begin, end)
        begin = end


def _nearest(
    rays: _Rays, room_index: Int[np.ndarray, "b"], walls: WallTable
) -> tuple[Float[np.ndarray, "b w"], Int[np.ndarray, "b w"]]:
    """Return each ray's distance (m) to the nearest wall, and the wall's index in the table, -1 for none."""
    columns, position_m = rays.columns, rays.position_m
    pose, wall = _room_wall_pairs(walls, room_index)
    start, end = walls.start_m[wall] - position_m[pose], walls.end_m[wall] - position_m[pose]
    edge = end - start
    area = start[:, 0] * edge[:, 1] - start[:, 1] * edge[:, 0]
    # Only free-standing walls are visible from both sides.
    faces = np.flatnonzero(np.where(walls.is_free[wall], np.abs(area), area) >= EDGE_ON)
    pose, wall, start, end, area = (values[faces] for values in (pose, wall, start, end, area))
    by_x, by_y = edge[faces, 0] / area, edge[faces, 1] / area
    # Azimuths decrease from the start of a wall to its end, since the room lies to its left.
    low = np.where(area[:, None] > 0.0, end, start)
    high = np.where(area[:, None] > 0.0, start, end)
    first, last = (
        np.ceil(_column_towards(point, rays.heading[pose], columns)).astype(np.intp) for point in (low, high)
    )
    filled = (last - first) % columns
    # A wall fills fewer than half of all columns; a larger number is a zero that rounding wrapped.
    filled[filled > columns // 2 + 1] = 0
    entry = np.repeat(np.arange(len(pose)), filled)
    column = (np.arange(len(entry)) - (np.cumsum(filled) - filled - first)[entry]) % columns
    ray = pose[entry] * columns + column
    index = column if len(rays.x) == 1 else ray
    inverse_m = rays.x.ravel()[index] * by_y[entry] - rays.y.ravel()[index] * by_x[entry]
    shape = (len(position_m), columns)
    nearest, met = np.zeros(shape[0] * columns), np.full(shape[0] * columns, -1, np.intp)
    np.maximum.at(nearest, ray, inverse_m)
    winner = np.flatnonzero(nearest[ray] == inverse_m)
    met[ray[winner]] = wall[entry[winner]]
    with np.errstate(divide="ignore"):
        return (1.0 / nearest).reshape(shape), met.reshape(shape)


def _column_towards(point_m: Float[np.ndarray, "k 2"], heading: Float[np.ndarray, "k"], columns: int) -> np.ndarray:
    """Return the fractional column in the direction of each point."""
    return (np.arctan2(point_m[:, 0], point_m[:, 1]) - heading) * (columns / TWO_PI) + 0.5 * (columns - 1)


def _room_wall_pairs(walls: WallTable, room_index: Int[np.ndarray, "b"]) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of a given room and a wall of it: index into `room_index`, and wall index in the table."""
    count = np.diff(walls.first)[room_index]
    entry = np.repeat(np.arange(len(room_index)), count)
    return entry, np.arange(len(entry)) - np.repeat(np.cumsum(count) - count - walls.first[room_index], count)


def _openings(
    rays: _Rays,
    distance_m: Float[np.ndarray, "b w"],
    wall: Int[np.ndarray, "b w"],
    walls: WallTable,
    at_eye: Int[np.ndarray, "k"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rays that meet an opening at eye height: row, column, and the opening's index in the table.

    `at_eye` holds the indices of the openings at eye height.
    """
    if not len(at_eye):
        empty = np.empty(0, np.intp)
        return empty, empty, empty
    has_opening = np.zeros(len(walls.start_m) + 1, bool)
    has_opening[walls.opening_begin[at_eye].astype(np.intp)] = True
    row, column = np.nonzero(has_opening[wall])
    wall = wall[row, column]
    edge = walls.end_m[wall] - walls.start_m[wall]
    met_m = rays.position_m[row] + distance_m[row, column][:, None] * rays.along(row, column)
    from_start = met_m - walls.start_m[wall]
    share = (from_start * edge).sum(axis=1) / np.square(edge).sum(axis=1)
    place = wall + share
    found = np.searchsorted(walls.opening_begin[at_eye], place, side="right") - 1
    number = at_eye[np.maximum(found, 0)]
    is_met = (found >= 0) & (place <= walls.opening_end[number]) & (wall == walls.opening_begin[number].astype(np.intp))
    return row[is_met], column[is_met], number[is_met]


def _behind(
    eye_m: Float[np.ndarray, "m 2"],
    direction: Float[np.ndarray, "m 2"],
    distance_m: Float[np.ndarray, "m"],
    number: Int[np.ndarray, "m"],
    walls: WallTable,
) -> Float[np.ndarray, "m"]:
    """Return the distance (m) of each ray to the wall behind an opening.

    Rays that hit the reveal or meet no wall behind the opening keep `distance_m`.
    """
    exit_m = walls.exit_m[number]
    # Inverse distance at which a ray leaves the wall's thickness; 0 if it hits the reveal.
    inverse_m = _inverse_crossings(exit_m[:, :2] - eye_m, exit_m[:, 2:] - eye_m, direction)
    through = np.flatnonzero(inverse_m > 0.0)
    seen_m = distance_m.copy()
    for begin in range(0, len(through), _PAIRS // 16):
        rays = through[begin : begin + _PAIRS // 16]
        leave_m = np.maximum(1.0 / inverse_m[rays], distance_m[rays]) + _BEYOND_M
        origin_m = eye_m[rays] + leave_m[:, None] * direction[rays]
        ray, wall = _room_wall_pairs(walls, walls.behind[number[rays]])
        from_m, to_m = walls.start_m[wall] - origin_m[ray], walls.end_m[wall] - origin_m[ray]
        crossed = _inverse_crossings(from_m, to_m, direction[rays][ray])
        further = np.maximum.reduceat(crossed, np.searchsorted(ray, np.arange(len(rays)))) if len(ray) else crossed
        meets = further > 0.0
        seen_m[rays[meets]] = leave_m[meets] + 1.0 / further[meets]
    return seen_m


def _inverse_crossings(
    start_m: Float[np.ndarray, "k 2"], end_m: Float[np.ndarray, "k 2"], direction: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, "k"]:
    """Return the inverse distance (1/m) from each ray's origin to its wall, 0 for a miss.

    `profile.inverse_crossings` has the same formula for all pairs of rays and walls; this one is for k given pairs.
    """
    edge = end_m - start_m
    area = start_m[:, 0] * edge[:, 1] - start_m[:, 1] * edge[:, 0]
    low, high = start_m - CORNER_TOLERANCE * edge, end_m + CORNER_TOLERANCE * edge
    sides = [point[:, 0] * direction[:, 1] - point[:, 1] * direction[:, 0] for point in (low, high)]
    inverse_m = direction[:, 0] * edge[:, 1] - direction[:, 1] * edge[:, 0]
    meets = (sides[0] * sides[1] <= 0.0) & (np.abs(area) >= EDGE_ON)
    return np.maximum(np.divide(inverse_m, area, out=np.zeros_like(area), where=meets), 0.0)
