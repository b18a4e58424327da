"""Layout of poses by azimuth: distance to the wall, the opening in it, the distance behind it, and derivatives.

A floor plan is an extrusion, so one 2-D ray per azimuth column against the room's wall segments determines the wall
profile, and layout depth follows from it. The code uses the array API: it runs on numpy arrays (service) and on torch
tensors (training), where the result is differentiable in position and heading almost everywhere. A ray of azimuth a
meets the wall from p to p + e, relative to the camera, at the distance

    d = (p × e) / (u × e),    u = (sin a, cos a),    v × w = v_x w_y - v_y w_x

The forward pass finds the nearest wall; the derivatives depend on that wall alone:

    ∂ log d / ∂x = -e_y / (p × e)    ∂ log d / ∂y = e_x / (p × e)    ∂ log d / ∂heading = -(u' × e) / (u × e)

with u' = (cos a, -sin a). A ray through an opening stays straight, so the wall behind has the same derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from array_api_compat import array_namespace, device
from jaxtyping import Float, Int, Shaped

from lalaloc_core.conventions import DOOR_CODE, PASSAGE_CODE, Array, column_azimuths, row_elevations, unit_rays
from lalaloc_core.floorplan import PlanGeometry

# A ray may miss both of two adjoining walls at their corner by rounding; each wall is widened by this share.
CORNER_TOLERANCE = 1e-5
# A wall whose line passes the camera nearer than this (m, times the wall's length) is edge-on and invisible.
EDGE_ON = 1e-9
# A ray through an opening restarts this far (m) beyond it, so that it does not meet the same wall again.
BEYOND_M = 1e-3
_PARALLEL = 1e-12
# Length (m) of rays that meet no wall, from poses outside every room: keeps all values finite.
_MAX_DISTANCE_M = 1e6


def cast_rays(
    origin_m: Float[Array, "b 2"], azimuth: Float[Array, "b c"], walls_m: Float[Array, "b n 4"]
) -> Float[Array, "b c"]:
    """Return the distance (m) from each origin along each azimuth to the nearest of its wall segments.

    Azimuths are radians clockwise from +y. `walls_m` has segments (x0, y0, x1, y1) of each origin; repeat a segment to
    pad. The distance is inf for a ray that meets no wall, which happens only outside a closed room.
    """
    xp = array_namespace(origin_m, azimuth, walls_m)
    return _distance(xp.max(inverse_crossings(origin_m, azimuth, walls_m).inverse_m, axis=1))


def nearest_walls(
    origin_m: Float[Array, "b 2"], azimuth: Float[Array, "b c"], walls_m: Float[Array, "b n 4"]
) -> tuple[Float[Array, "b c"], Int[Array, "b c"]]:
    """Return the distances of `cast_rays` and the index of the wall that each ray meets (any, for equal distances)."""
    xp = array_namespace(origin_m, azimuth, walls_m)
    inverse_m = inverse_crossings(origin_m, azimuth, walls_m).inverse_m
    return _distance(xp.max(inverse_m, axis=1)), xp.argmax(inverse_m, axis=1)


def _distance(inverse_m: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return the reciprocal of positive values, inf for others."""
    xp = array_namespace(inverse_m)
    meets = inverse_m > 0.0
    # Avoiding a division by zero in the unused branch keeps NaN out of the gradients.
    distance_m = 1.0 / xp.where(meets, inverse_m, xp.ones_like(inverse_m))
    return xp.where(meets, distance_m, xp.full_like(distance_m, xp.inf))


class InverseCrossings(NamedTuple):
    """Inverse distances from ray origins to walls.

    Attributes:
        inverse_m: (b, n, c) inverse distance (1/m) to every wall along every ray; 0 or less for a miss.
        edge_x, edge_y: (b, n) components of e / (p × e) for the wall from p to p + e, relative to the origin.
    """

    inverse_m: Array
    edge_x: Array
    edge_y: Array


def inverse_crossings(
    origin_m: Float[Array, "b 2"], azimuth: Float[Array, "b c"], walls_m: Float[Array, "b n 4"]
) -> InverseCrossings:
    """Intersect every ray with every wall; see `cast_rays` for the arguments.

    A ray along the unit vector u meets the line from p to p + e at the distance d with 1 / d = (u × e) / (p × e), where
    v × w = v_x w_y - v_y w_x. It meets the wall itself if p and p + e lie on opposite sides of the ray. All three cross
    products are linear in u, so one matrix product computes them for all rays and walls.
    """
    xp = array_namespace(origin_m, azimuth, walls_m)
    start_x, start_y = walls_m[:, :, 0] - origin_m[:, :1], walls_m[:, :, 1] - origin_m[:, 1:]
    edge_x, edge_y = walls_m[:, :, 2] - walls_m[:, :, 0], walls_m[:, :, 3] - walls_m[:, :, 1]
    area = start_x * edge_y - start_y * edge_x
    edge_on = xp.abs(area) < EDGE_ON
    inverse_area = 1.0 / xp.where(edge_on, xp.ones_like(area), area)
    inverse_area = xp.where(edge_on, xp.zeros_like(area), inverse_area)
    by_x, by_y = edge_x * inverse_area, edge_y * inverse_area
    low, high = -CORNER_TOLERANCE, 1.0 + CORNER_TOLERANCE
    crossed_x = xp.concat([by_x, start_x + low * edge_x, start_x + high * edge_x], axis=1)
    crossed_y = xp.concat([by_y, start_y + low * edge_y, start_y + high * edge_y], axis=1)
    direction = xp.stack([xp.sin(azimuth), xp.cos(azimuth)], axis=1)
    products = xp.stack([crossed_y, -crossed_x], axis=2) @ direction
    count = walls_m.shape[1]
    inverse_m, begins, ends = products[:, :count], products[:, count : 2 * count], products[:, 2 * count :]
    return InverseCrossings(xp.where(begins * ends <= 0.0, inverse_m, xp.zeros_like(inverse_m)), by_x, by_y)


class Crossings(NamedTuple):
    """Intersections of rays with the lines through walls.

    Attributes:
        distance_m: distance along the ray; inf if it misses the wall or meets it behind its origin.
        share: position along the wall, 0 at its start and 1 at its end.
        determinant: determinant of the linear system; positive where the ray leaves a room to the wall's left.
    """

    distance_m: Array
    share: Array
    determinant: Array


def cross_walls(direction: tuple[Array, Array], start_m: tuple[Array, Array], edge_m: tuple[Array, Array]) -> Crossings:
    """Intersect rays with walls.

    All arguments are (x, y) components that broadcast against each other: the rays' unit vectors, from the rays'
    origins to the walls' starts, and from the walls' starts to their ends.
    """
    (direction_x, direction_y), (start_x, start_y), (edge_x, edge_y) = direction, start_m, edge_m
    xp = array_namespace(direction_x, start_x)
    # Solve t * direction = start + s * edge by Cramer's rule.
    determinant = direction_x * edge_y - direction_y * edge_x
    parallel = xp.abs(determinant) < _PARALLEL
    # Avoiding a division by zero in the unused branch keeps NaN out of the gradients.
    inverse = 1.0 / xp.where(parallel, xp.ones_like(determinant), determinant)
    t = (start_x * edge_y - start_y * edge_x) * inverse
    s = (start_x * direction_y - start_y * direction_x) * inverse
    hit = ~parallel & (t > 0.0) & (s >= -CORNER_TOLERANCE) & (s <= 1.0 + CORNER_TOLERANCE)
    return Crossings(xp.where(hit, t, xp.full_like(t, xp.inf)), s, determinant)


def wall_profile(
    position_m: Float[Array, "b 2"], heading: Float[Array, "b"], walls_m: Float[Array, "b n 4"], columns: int
) -> Float[Array, "b {columns}"]:
    """Return the wall profile (m) of each pose, one value per azimuth column of a sphere with that heading.

    Positions are inside the room that `walls_m` closes, segments (x0, y0, x1, y1) of each pose's own room. `heading` is
    the azimuth of the centre column, radians.
    """
    xp = array_namespace(position_m, heading, walls_m)
    relative = xp.asarray(column_azimuths(columns), dtype=position_m.dtype, device=device(position_m))
    return cast_rays(position_m, heading[:, None] + relative[None, :], walls_m)


def layout_depth(
    profile_m: Float[Array, "b w"], camera_height_m: Float[Array, "b"], ceiling_height_m: Float[Array, "b"], rows: int
) -> Float[Array, "b {rows} w"]:
    """Return the range (m) along each pixel's ray to the nearest of wall, floor and ceiling.

    `range = min(wall / cos e, camera / -sin e below the horizon, (ceiling - camera) / sin e above it)`. Heights are
    over the floor, the ceiling's above the camera's. The image's `rows` cover elevation +90° to -90°.
    """
    xp = array_namespace(profile_m, camera_height_m, ceiling_height_m)
    elevation = row_elevations(rows)
    like = {"dtype": profile_m.dtype, "device": device(profile_m)}
    inverse_cosine = xp.asarray(1.0 / np.cos(elevation), **like)
    inverse_sine = xp.asarray(1.0 / np.abs(np.sin(elevation)), **like)
    above = xp.asarray(elevation > 0.0, device=device(profile_m))
    clearance = xp.where(above[None, :], (ceiling_height_m - camera_height_m)[:, None], camera_height_m[:, None])
    horizontal = clearance * inverse_sine[None, :]
    return xp.minimum(profile_m[:, None, :] * inverse_cosine[None, :, None], horizontal[:, :, None])


def back_project(depth_m: Float[Array, "b h w"]) -> Float[Array, "b h*w 3"]:
    """Return each depth image as a point cloud (m) in the camera frame: x right, y forward (centre column), z up."""
    xp = array_namespace(depth_m)
    batch, rows, columns = depth_m.shape
    azimuth, elevation = column_azimuths(columns)[None, :], row_elevations(rows)[:, None]
    rays = xp.asarray(unit_rays(azimuth, elevation), dtype=depth_m.dtype, device=device(depth_m))
    return xp.reshape(depth_m[..., None] * rays[None], (batch, rows * columns, 3))


@dataclass(frozen=True, eq=False)
class RenderedLayout:
    """Distances and opening kinds per pose and azimuth column.

    Attributes:
        distance_m: (b, w) distance to the nearest wall of the pose's room, the wall profile.
        kind: (b, w) code in `conventions.OPENING_CLASSES` of that wall at eye height.
        behind_m: (b, w) distance along the same ray through a door or passage to the next wall of the room behind;
            equals `distance_m` where no room is visible behind.
        sill_m, head_m: (b, w) heights of that opening above the floor, infinite where unknown; 0 for walls.
    """

    distance_m: Float[Array, "b w"]
    kind: Int[Array, "b w"]
    behind_m: Float[Array, "b w"]
    sill_m: Float[Array, "b w"]
    head_m: Float[Array, "b w"]


def render_layout(
    position_m: Float[Array, "b 2"],
    heading: Float[Array, "b"],
    room_index: Int[Array, "b"],
    geometry: PlanGeometry,
    columns: int,
    camera_height_m: Float[Array, "b"] | float,
) -> RenderedLayout:
    """Render the layout of each pose, one value per azimuth column of a sphere with that heading.

    The distances are differentiable in position and heading almost everywhere. Positions are inside their rooms; use
    double precision far from the plan's origin. `heading` is the azimuth of the centre column, radians. An opening is
    visible if its sill is below the camera and its head above.
    """
    xp = array_namespace(position_m, heading)
    like_positions = {"dtype": position_m.dtype, "device": device(position_m)}
    geometry = geometry.like(position_m)
    azimuth = heading[:, None] + xp.asarray(column_azimuths(columns), **like_positions)[None, :]
    walls_m = geometry.walls_m[room_index]
    distance_m, wall = nearest_walls(position_m, azimuth, walls_m)
    # Padding repeats the first wall.
    wall = xp.where(wall < geometry.wall_count[room_index][:, None], wall, xp.zeros_like(wall))
    eye_m = xp.asarray(camera_height_m, **like_positions) + xp.zeros_like(heading)
    opening = _opening_met(position_m, azimuth, distance_m, wall, room_index, geometry, eye_m)
    behind_m = _look_through(position_m, azimuth, distance_m, opening, room_index, geometry)
    kind, sill_m, head_m = (
        _at_opening(values, room_index, opening) for values in (geometry.opening_kind, geometry.sill_m, geometry.head_m)
    )
    return RenderedLayout(distance_m, kind, behind_m, sill_m, head_m)


def _opening_met(
    position_m: Float[Array, "b 2"],
    azimuth: Float[Array, "b w"],
    distance_m: Float[Array, "b w"],
    wall: Int[Array, "b w"],
    room_index: Int[Array, "b"],
    geometry: PlanGeometry,
    eye_m: Float[Array, "b"],
) -> Int[Array, "b w"]:
    """Return the index of the opening that each ray meets at eye height, -1 for none."""
    xp = array_namespace(position_m, azimuth)
    if geometry.opening_wall.shape[1] == 0:
        return xp.full_like(wall, -1)
    met_m = geometry.walls_m[room_index[:, None], wall]
    edge_x, edge_y = met_m[..., 2] - met_m[..., 0], met_m[..., 3] - met_m[..., 1]
    from_x = position_m[:, 0][:, None] + distance_m * xp.sin(azimuth) - met_m[..., 0]
    from_y = position_m[:, 1][:, None] + distance_m * xp.cos(azimuth) - met_m[..., 1]
    share = ((from_x * edge_x + from_y * edge_y) / (edge_x**2 + edge_y**2))[:, :, None]
    begin, end = geometry.opening_share[room_index][:, None, :, 0], geometry.opening_share[room_index][:, None, :, 1]
    at_eye = (geometry.sill_m[room_index] < eye_m[:, None]) & (eye_m[:, None] < geometry.head_m[room_index])
    met = (geometry.opening_wall[room_index][:, None, :] == wall[:, :, None]) & (share >= begin) & (share <= end)
    met = met & at_eye[:, None, :]
    number = xp.broadcast_to(xp.arange(met.shape[2], device=device(position_m)), met.shape)
    return xp.max(xp.where(met, number, xp.full_like(number, -1)), axis=2)


def _at_opening(
    values: Shaped[Array, "r m"], room_index: Int[Array, "b"], opening: Int[Array, "b w"]
) -> Shaped[Array, "b w"]:
    """Return the value of the opening that each ray meets, 0 (wall) for none."""
    xp = array_namespace(opening)
    if values.shape[1] == 0:
        return xp.zeros(opening.shape, dtype=values.dtype, device=device(values))
    found = values[room_index[:, None], xp.where(opening < 0, xp.zeros_like(opening), opening)]
    return xp.where(opening < 0, xp.zeros_like(found), found)


def _look_through(
    position_m: Float[Array, "b 2"],
    azimuth: Float[Array, "b w"],
    distance_m: Float[Array, "b w"],
    opening: Int[Array, "b w"],
    room_index: Int[Array, "b"],
    geometry: PlanGeometry,
) -> Float[Array, "b w"]:
    """Return distances through doors and passages; only rays that meet one are cast again."""
    xp = array_namespace(position_m, azimuth)
    kind = _at_opening(geometry.opening_kind, room_index, opening)
    row, column = xp.nonzero((kind == DOOR_CODE) | (kind == PASSAGE_CODE))
    if row.shape[0] == 0:
        return distance_m
    room, number = room_index[row], opening[row, column]
    behind = geometry.behind[room, number]
    is_room = behind >= 0
    row, column, room, number, behind = row[is_room], column[is_room], room[is_room], number[is_room], behind[is_room]
    eye_m, ray, wall_m = position_m[row], azimuth[row, column][:, None], distance_m[row, column]
    # Distance at which the ray leaves the wall's thickness; a ray that hits the reveal never does.
    exit_m = cast_rays(eye_m, ray, geometry.exit_m[room, number][:, None, :])[:, 0]
    is_through = xp.isfinite(exit_m)
    # Replacing infinite distances before arithmetic keeps NaN out of the gradients.
    leave_m = xp.maximum(xp.where(is_through, exit_m, wall_m), wall_m) + BEYOND_M
    direction = xp.concat([xp.sin(ray), xp.cos(ray)], axis=1)
    further_m = cast_rays(eye_m + leave_m[:, None] * direction, ray, geometry.walls_m[behind])[:, 0]
    is_through = is_through & xp.isfinite(further_m)
    seen_m = xp.where(is_through, leave_m + xp.where(is_through, further_m, xp.zeros_like(further_m)), wall_m)
    behind_m = distance_m + 0.0
    behind_m[row, column] = seen_m
    return behind_m


class ProfileJacobian(NamedTuple):
    """Log wall profiles and their derivatives.

    Attributes:
        by_pose: (b, 3, c) derivatives by x and y (m) and by the heading (radians).
        wall: (b, c) index of the wall that each ray meets.
    """

    log_m: Array
    by_pose: Array
    wall: Array


def log_profile_gradient(
    position_m: Float[Array, "b 2"], heading: Float[Array, "b"], walls_m: Float[Array, "b n 4"], columns: int
) -> ProfileJacobian:
    """Return `log(wall_profile(...))` with its derivatives, at little more than the cost of the profile.

    Positions are inside the room that `walls_m` closes, segments (x0, y0, x1, y1) of each pose's own room; repeat a
    segment to pad. `heading` is the azimuth of the centre column, radians.
    """
    xp = array_namespace(position_m, heading, walls_m)
    relative = xp.asarray(column_azimuths(columns), dtype=position_m.dtype, device=device(position_m))
    return log_distance_gradient(position_m, heading[:, None] + relative[None, :], walls_m)


def log_distance_gradient(
    origin_m: Float[Array, "b 2"], azimuth: Float[Array, "b c"], walls_m: Float[Array, "b n 4"]
) -> ProfileJacobian:
    """Return log distances and derivatives along any azimuths (radians); see `log_profile_gradient`."""
    xp = array_namespace(origin_m, azimuth, walls_m)
    crossings = inverse_crossings(origin_m, azimuth, walls_m)
    wall = xp.argmax(crossings.inverse_m, axis=1)
    inverse_m = xp.maximum(xp.max(crossings.inverse_m, axis=1), 1.0 / _MAX_DISTANCE_M)
    edge_x = xp.take_along_axis(crossings.edge_x, wall, axis=1)
    edge_y = xp.take_along_axis(crossings.edge_y, wall, axis=1)
    turned = -(xp.cos(azimuth) * edge_y + xp.sin(azimuth) * edge_x) / inverse_m
    return ProfileJacobian(-xp.log(inverse_m), xp.stack([-edge_y, edge_x, turned], axis=1), wall)


def free_travel_m(
    position_m: Float[Array, "b 2"], direction: Float[Array, "b 2"], walls_m: Float[Array, "b n 4"], margin_m: float
) -> Float[Array, "b"]:
    """Return how far poses can move in a direction until they are `margin_m` from the wall ahead; at least 0.

    The margin is at right angles to the wall: along the direction, repeated slanted steps would end on the wall.
    """
    xp = array_namespace(position_m, direction, walls_m)
    azimuth = xp.atan2(direction[:, 0], direction[:, 1])[:, None]
    ahead = log_distance_gradient(position_m, azimuth, walls_m)
    distance_m = xp.exp(ahead.log_m[:, 0])
    # The gradient of the distance is one over the cosine between the direction and the wall's normal.
    steepness = distance_m * xp.linalg.vector_norm(ahead.by_pose[:, :2, 0], axis=1)
    return xp.maximum(distance_m - margin_m * steepness, 0.0)
