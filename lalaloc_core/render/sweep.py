"""What many poses of a plan see: every wall is met by the rays between its two ends, and by no others.

`render.layout` casts every ray at every wall, which for large rooms is nearly all in vain. Here the azimuths of a
wall's ends, as a pose sees them, tell the columns that it may fill, and of the walls of a column the nearest counts.
What it costs grows with the number of columns, and with that of a room's own walls only by two arctangents each. The
same picture as `render.layout` draws, for numpy alone and without gradients.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from lalaloc_core.conventions import DOOR_CODE, PASSAGE_CODE, TWO_PI, WALL_CODE, column_azimuths
from lalaloc_core.floorplan.wall_table import WallTable
from lalaloc_core.render.tolerances import BEYOND_M, CORNER_TOLERANCE, EDGE_ON

# Pairs of a pose and a wall, or of a ray and a wall, that are looked at together, to bound memory.
_PAIRS = 1 << 16


@dataclass(frozen=True, eq=False)
class SweptViews:
    """What n poses see in w columns each.

    Attributes:
        distance_m: (n, w) to the nearest wall of the pose's own room; inf where there is none, outside a room.
        kind: (n, w) codes of what that wall is there at eye height, as in `conventions.OPENING_CLASSES`.
        row, column: (m,) the rays that go on through an open door or passage, row by row.
        behind_m: (m,) how far those go on to the next wall of the room behind.
    """

    distance_m: Float[np.ndarray, "n w"]
    kind: UInt8[np.ndarray, "n w"]
    row: Int[np.ndarray, "m"]
    column: Int[np.ndarray, "m"]
    behind_m: Float[np.ndarray, "m"]


def swept_views(
    position_m: Float[np.ndarray, "n 2"],
    heading: Float[np.ndarray, "n"],
    room_index: Int[np.ndarray, "n"],
    walls: WallTable,
    columns: int,
    eye_m: float,
) -> SweptViews:
    """What poses of a plan see.

    Args:
        heading: azimuth of the centre column, radians.
        columns: number of azimuth columns.
        eye_m: height of the eye: an opening counts where its sill is below and its head above.
    """
    distance_m = np.empty((len(position_m), columns), np.float32)
    kind = np.full((len(position_m), columns), WALL_CODE, np.uint8)
    rows, at, behind_m = [np.empty(0, np.intp)], [np.empty(0, np.intp)], [np.empty(0, np.float32)]
    at_eye = np.flatnonzero((walls.sill_m < eye_m) & (eye_m < walls.head_m))
    for part in _parts(room_index, walls, columns):
        rays = _Rays.of(heading[part], columns)
        distance, wall = _nearest(position_m[part], rays, room_index[part], walls)
        distance_m[part] = distance
        row, column, number = _openings(position_m[part], rays, distance, wall, walls, at_eye)
        kind[row + part.start, column] = walls.opening_kind[number]
        leads_on = np.isin(walls.opening_kind[number], (DOOR_CODE, PASSAGE_CODE)) & (walls.behind[number] >= 0)
        row, column, number = row[leads_on], column[leads_on], number[leads_on]
        met_m = distance[row, column]
        seen_m = _behind(position_m[part][row], rays.along(row, column), met_m, number, walls)
        through = seen_m > met_m
        rows.append(row[through] + part.start)
        at.append(column[through])
        behind_m.append(seen_m[through].astype(np.float32))
    return SweptViews(distance_m, kind, np.concatenate(rows), np.concatenate(at), np.concatenate(behind_m))


def swept_profiles(
    position_m: Float[np.ndarray, "n 2"],
    heading: Float[np.ndarray, "n"],
    room_index: Int[np.ndarray, "n"],
    walls: WallTable,
    columns: int,
    dtype: type[np.floating] = np.float64,
) -> Float[np.ndarray, "n {columns}"]:
    """The distances (m) of `swept_views` alone."""
    distance_m = np.empty((len(position_m), columns), dtype)
    for part in _parts(room_index, walls, columns):
        rays = _Rays.of(heading[part], columns)
        distance_m[part], _ = _nearest(position_m[part], rays, room_index[part], walls)
    return distance_m


@dataclass(frozen=True, eq=False)
class _Rays:
    """The rays of b poses in w columns: their unit vectors' components, of one pose where all look alike."""

    heading: Float[np.ndarray, "b"]
    columns: int
    x: Float[np.ndarray, "k w"]
    y: Float[np.ndarray, "k w"]

    @classmethod
    def of(cls, heading: Float[np.ndarray, "b"], columns: int) -> _Rays:
        told = heading[:1] if (heading == heading[0]).all() else heading
        azimuth = told[:, None] + column_azimuths(columns)[None]
        return cls(heading, columns, np.sin(azimuth), np.cos(azimuth))

    def along(self, row: Int[np.ndarray, "m"], column: Int[np.ndarray, "m"]) -> Float[np.ndarray, "m 2"]:
        """Unit vectors of some of them."""
        at = column if len(self.x) == 1 else row * self.columns + column
        return np.stack([self.x.ravel()[at], self.y.ravel()[at]], axis=1)


def _parts(room_index: Int[np.ndarray, "n"], walls: WallTable, columns: int) -> Iterator[slice]:
    """Slices of poses that fit into memory, and into a processor's cache, at once."""
    # Of rays those that are filled twice and more count as well, if roughly.
    work = np.cumsum(np.maximum(np.diff(walls.first)[room_index], columns))
    begin = 0
    while begin < len(room_index):
        past = int(work[begin - 1]) if begin else 0
        end = max(begin + 1, int(np.searchsorted(work, past + _PAIRS, side="right")))
        yield slice(begin, end)
        begin = end


def _nearest(
    position_m: Float[np.ndarray, "b 2"], rays: _Rays, room_index: Int[np.ndarray, "b"], walls: WallTable
) -> tuple[Float[np.ndarray, "b w"], Int[np.ndarray, "b w"]]:
    """Distance (m) along every ray to the nearest wall, and that wall's number in the table; -1 where there is none."""
    columns = rays.columns
    pose, wall = _each_with(walls, room_index)
    start, end = walls.start_m[wall] - position_m[pose], walls.end_m[wall] - position_m[pose]
    edge = end - start
    area = start[:, 0] * edge[:, 1] - start[:, 1] * edge[:, 0]
    # Only free-standing walls have a back that can be seen.
    faces = np.flatnonzero(np.where(walls.is_free[wall], np.abs(area), area) >= EDGE_ON)
    pose, wall, start, end, area = (one[faces] for one in (pose, wall, start, end, area))
    by_x, by_y = edge[faces, 0] / area, edge[faces, 1] / area
    # Azimuths fall from the start of a wall to its end, as the room lies to its left.
    low = np.where(area[:, None] > 0.0, end, start)
    high = np.where(area[:, None] > 0.0, start, end)
    first, last = (np.ceil(_column_of(one, rays.heading[pose], columns)).astype(np.intp) for one in (low, high))
    filled = (last - first) % columns
    # Fewer than half of all columns; more are none at all, but for rounding.
    filled[filled > columns // 2 + 1] = 0
    entry = np.repeat(np.arange(len(pose)), filled)
    column = (np.arange(len(entry)) - (np.cumsum(filled) - filled - first)[entry]) % columns
    ray = pose[entry] * columns + column
    at = column if len(rays.x) == 1 else ray
    inverse_m = rays.x.ravel()[at] * by_y[entry] - rays.y.ravel()[at] * by_x[entry]
    shape = (len(position_m), columns)
    nearest, met = np.zeros(shape[0] * columns), np.full(shape[0] * columns, -1, np.intp)
    np.maximum.at(nearest, ray, inverse_m)
    is_it = np.flatnonzero(nearest[ray] == inverse_m)
    met[ray[is_it]] = wall[entry[is_it]]
    with np.errstate(divide="ignore"):
        return (1.0 / nearest).reshape(shape), met.reshape(shape)


def _column_of(point_m: Float[np.ndarray, "k 2"], heading: Float[np.ndarray, "k"], columns: int) -> np.ndarray:
    """The column, with its fraction, in whose direction a point lies."""
    return (np.arctan2(point_m[:, 0], point_m[:, 1]) - heading) * (columns / TWO_PI) + 0.5 * (columns - 1)


def _each_with(walls: WallTable, room_index: Int[np.ndarray, "b"]) -> tuple[np.ndarray, np.ndarray]:
    """Every wall of every given room: which of them it is of, and its number in the table."""
    count = np.diff(walls.first)[room_index]
    of = np.repeat(np.arange(len(room_index)), count)
    return of, np.arange(len(of)) - np.repeat(np.cumsum(count) - count - walls.first[room_index], count)


def _openings(
    position_m: Float[np.ndarray, "b 2"],
    rays: _Rays,
    distance_m: Float[np.ndarray, "b w"],
    wall: Int[np.ndarray, "b w"],
    walls: WallTable,
    at_eye: Int[np.ndarray, "k"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The rays that meet an opening at eye height: row, column, and the opening's number in the table.

    Args:
        at_eye: numbers of the openings at eye height.
    """
    if not len(at_eye):
        none = np.empty(0, np.intp)
        return none, none, none
    has_opening = np.zeros(len(walls.start_m) + 1, bool)
    has_opening[walls.opening_begin[at_eye].astype(np.intp)] = True
    row, column = np.nonzero(has_opening[wall])
    wall = wall[row, column]
    edge = walls.end_m[wall] - walls.start_m[wall]
    met_m = position_m[row] + distance_m[row, column][:, None] * rays.along(row, column)
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
    """How far rays that meet openings go on; as far as the wall where they meet the reveal, or nothing behind."""
    exit_m = walls.exit_m[number]
    # Where the ray leaves the wall's thickness; one that does not meets the reveal.
    inverse_m = _inverse_crossings(exit_m[:, :2] - eye_m, exit_m[:, 2:] - eye_m, direction)
    through = np.flatnonzero(inverse_m > 0.0)
    seen_m = distance_m.copy()
    for begin in range(0, len(through), _PAIRS // 16):
        rays = through[begin : begin + _PAIRS // 16]
        leave_m = np.maximum(1.0 / inverse_m[rays], distance_m[rays]) + BEYOND_M
        origin_m = eye_m[rays] + leave_m[:, None] * direction[rays]
        ray, wall = _each_with(walls, walls.behind[number[rays]])
        from_m, to_m = walls.start_m[wall] - origin_m[ray], walls.end_m[wall] - origin_m[ray]
        crossed = _inverse_crossings(from_m, to_m, direction[rays][ray])
        further = np.maximum.reduceat(crossed, np.searchsorted(ray, np.arange(len(rays)))) if len(ray) else crossed
        meets = further > 0.0
        seen_m[rays[meets]] = leave_m[meets] + 1.0 / further[meets]
    return seen_m


def _inverse_crossings(
    start_m: Float[np.ndarray, "k 2"], end_m: Float[np.ndarray, "k 2"], direction: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, "k"]:
    """Inverse distances (1/m) along one ray each to one wall each, counted from the ray's origin; 0 where it misses.

    The formula of `profile.inverse_crossings`, which takes all rays with all walls in one product of matrices: for
    pairs, of which there is one in hundreds, that would be nearly all in vain.
    """
    edge = end_m - start_m
    area = start_m[:, 0] * edge[:, 1] - start_m[:, 1] * edge[:, 0]
    low, high = start_m - CORNER_TOLERANCE * edge, end_m + CORNER_TOLERANCE * edge
    sides = [one[:, 0] * direction[:, 1] - one[:, 1] * direction[:, 0] for one in (low, high)]
    inverse_m = direction[:, 0] * edge[:, 1] - direction[:, 1] * edge[:, 0]
    meets = (sides[0] * sides[1] <= 0.0) & (np.abs(area) >= EDGE_ON)
    return np.maximum(np.divide(inverse_m, area, out=np.zeros_like(area), where=meets), 0.0)
