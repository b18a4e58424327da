"""Layout of poses by azimuth: distance to the wall, and its derivatives.

A floor plan is an extrusion, so one 2-D ray per azimuth column against the room's wall segments determines the wall
profile, and layout depth follows from it. The code uses the array API: it runs on numpy arrays (service) and on torch
tensors (training), where the result is differentiable in position and heading almost everywhere. A ray of azimuth a
meets the wall from p to p + e, relative to the camera, at the distance

    d = (p × e) / (u × e),    u = (sin a, cos a),    v × w = v_x w_y - v_y w_x

The forward pass finds the nearest wall; the derivatives depend on that wall alone:

    ∂ log d / ∂x = -e_y / (p × e)    ∂ log d / ∂y = e_x / (p × e)    ∂ log d / ∂heading = -(u' × e) / (u × e)

with u' = (cos a, -sin a).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from array_api_compat import array_namespace, device
from jaxtyping import Float, Int

from lalaloc_core.conventions import Array, column_azimuths, row_elevations, unit_rays

# A ray may miss both of two adjoining walls at their corner by rounding; each wall is widened by this share.
CORNER_TOLERANCE = 1e-5
# A wall whose line passes the camera nearer than this (m, times the wall's length) is edge-on and invisible.
EDGE_ON = 1e-9
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
    return _distance(xp.max(inverse_crossings(origin_m, azimuth, walls_m)[0], axis=1))


def nearest_walls(
    origin_m: Float[Array, "b 2"], azimuth: Float[Array, "b c"], walls_m: Float[Array, "b n 4"]
) -> tuple[Float[Array, "b c"], Int[Array, "b c"]]:
    """Return the distances of `cast_rays` and the index of the wall that each ray meets (any, for equal distances)."""
    xp = array_namespace(origin_m, azimuth, walls_m)
    inverse_m, _, _ = inverse_crossings(origin_m, azimuth, walls_m)
    return _distance(xp.max(inverse_m, axis=1)), xp.argmax(inverse_m, axis=1)


def _distance(inverse_m: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return the reciprocal of positive values, inf for others."""
    xp = array_namespace(inverse_m)
    meets = inverse_m > 0.0
    # Avoiding a division by zero in the unused branch keeps NaN out of the gradients.
    distance_m = 1.0 / xp.where(meets, inverse_m, xp.ones_like(inverse_m))
    return xp.where(meets, distance_m, xp.full_like(distance_m, xp.inf))


def inverse_crossings(
    origin_m: Float[Array, "b 2"], azimuth: Float[Array, "b c"], walls_m: Float[Array, "b n 4"]
) -> tuple[Float[Array, "b n c"], Float[Array, "b n"], Float[Array, "b n"]]:
    """Intersect every ray with every wall; see `cast_rays` for the arguments.

    Returns the inverse distance (1/m) to every wall along every ray, 0 or less for a miss; and the components of
    e / (p × e) for the wall from p to p + e, relative to the origin.

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
    return xp.where(begins * ends <= 0.0, inverse_m, xp.zeros_like(inverse_m)), by_x, by_y


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


class ProfileJacobian(NamedTuple):
    """Log wall profiles, and their derivatives (b, 3, c) by x and y (m) and by the heading (radians)."""

    log_m: Array
    by_pose: Array


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
    every_m, by_x, by_y = inverse_crossings(origin_m, azimuth, walls_m)
    wall = xp.argmax(every_m, axis=1)
    inverse_m = xp.maximum(xp.max(every_m, axis=1), 1.0 / _MAX_DISTANCE_M)
    edge_x, edge_y = xp.take_along_axis(by_x, wall, axis=1), xp.take_along_axis(by_y, wall, axis=1)
    turned = -(xp.cos(azimuth) * edge_y + xp.sin(azimuth) * edge_x) / inverse_m
    return ProfileJacobian(-xp.log(inverse_m), xp.stack([-edge_y, edge_x, turned], axis=1))


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
