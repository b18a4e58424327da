"""The wall profile and its derivatives by position and heading, in closed form.

A ray of azimuth a meets the wall from p to p + e, relative to the camera, at the distance

    d = (p × e) / (u × e),    u = (sin a, cos a),    v × w = v_x w_y - v_y w_x

The forward pass finds the nearest wall; the derivatives depend on that wall alone:

    ∂ log d / ∂x = -e_y / (p × e)    ∂ log d / ∂y = e_x / (p × e)    ∂ log d / ∂heading = -(u' × e) / (u × e)

with u' = (cos a, -sin a). A ray through an opening stays straight, so the wall behind has the same derivatives.
"""

from __future__ import annotations

from typing import NamedTuple

from array_api_compat import array_namespace, device
from jaxtyping import Float

from lalaloc_core.conventions import Array, column_azimuths
from lalaloc_core.render.profile import inverse_crossings

# Length (m) of rays that meet no wall, from poses outside every room: keeps all values finite.
_MAX_DISTANCE_M = 1e6


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
