"""Wall profile: the horizontal distance from the camera to the nearest wall of its room, in closed form.

A floor plan is an extrusion, so all that a camera sees of the bare layout follows from casting one ray per
azimuth column against the room's wall segments in 2-D. The code is written against the array API: the same
lines run on numpy arrays (service) and on torch tensors (training and LPO), where the result is differentiable
in position and heading almost everywhere.
"""

from __future__ import annotations

from typing import NamedTuple

from array_api_compat import array_namespace, device
from jaxtyping import Float, Int

from lalaloc_core.conventions import Array, column_azimuths

# A ray may miss both of two adjoining walls at their common corner by rounding; widen each wall by this share.
_CORNER_TOLERANCE = 1e-5
_PARALLEL = 1e-12


def cast_rays(
    origin_m: Float[Array, "b 2"], azimuth: Float[Array, "b c"], walls_m: Float[Array, "b n 4"]
) -> Float[Array, "b c"]:
    """Distance (m) from each origin along each azimuth (radians) to the nearest of its wall segments.

    Args:
        origin_m: ray origins in the plan frame.
        azimuth: directions, clockwise from +y.
        walls_m: per origin, segments (x0, y0, x1, y1); repeat a segment to pad.

    Returns:
        distances; inf where a ray hits nothing, which happens only outside a closed room.
    """
    xp = array_namespace(origin_m, azimuth, walls_m)
    return xp.min(_crossings(origin_m, azimuth, walls_m), axis=2)


def nearest_walls(
    origin_m: Float[Array, "b 2"], azimuth: Float[Array, "b c"], walls_m: Float[Array, "b n 4"]
) -> tuple[Float[Array, "b c"], Int[Array, "b c"]]:
    """As `cast_rays`, with the index of the wall that each ray meets; of walls at one distance, any."""
    xp = array_namespace(origin_m, azimuth, walls_m)
    crossings = _crossings(origin_m, azimuth, walls_m)
    return xp.min(crossings, axis=2), xp.argmin(crossings, axis=2)


def _crossings(
    origin_m: Float[Array, "b 2"], azimuth: Float[Array, "b c"], walls_m: Float[Array, "b n 4"]
) -> Float[Array, "b c n"]:
    """Distance (m) along every ray to every wall; inf where it misses it."""
    xp = array_namespace(origin_m, azimuth, walls_m)
    direction_x = xp.sin(azimuth)[:, :, None]
    direction_y = xp.cos(azimuth)[:, :, None]
    start_x = walls_m[:, None, :, 0] - origin_m[:, 0][:, None, None]
    start_y = walls_m[:, None, :, 1] - origin_m[:, 1][:, None, None]
    edge_x = walls_m[:, None, :, 2] - walls_m[:, None, :, 0]
    edge_y = walls_m[:, None, :, 3] - walls_m[:, None, :, 1]
    return cross_walls((direction_x, direction_y), (start_x, start_y), (edge_x, edge_y)).distance_m


class Crossings(NamedTuple):
    """Where rays cross the lines through walls.

    Attributes:
        distance_m: along the ray; inf where it misses the wall itself, or meets it behind its origin.
        share: how far along the wall, 0 at its start and 1 at its end.
        determinant: of the linear system that was solved; positive where the ray leaves a room to the wall's left.
    """

    distance_m: Array
    share: Array
    determinant: Array


def cross_walls(direction: tuple[Array, Array], start_m: tuple[Array, Array], edge_m: tuple[Array, Array]) -> Crossings:
    """Cross rays with walls; all arguments are (x, y) components, of shapes that broadcast against each other.

    Args:
        direction: unit vectors of the rays.
        start_m: from the ray's origin to the wall's start.
        edge_m: from the wall's start to its end.
    """
    (direction_x, direction_y), (start_x, start_y), (edge_x, edge_y) = direction, start_m, edge_m
    xp = array_namespace(direction_x, start_x)
    # Solve t * direction = start + s * edge by Cramer's rule.
    determinant = direction_x * edge_y - direction_y * edge_x
    parallel = xp.abs(determinant) < _PARALLEL
    # Not dividing by zero in the unused branch keeps NaN out of the gradients.
    inverse = 1.0 / xp.where(parallel, xp.ones_like(determinant), determinant)
    t = (start_x * edge_y - start_y * edge_x) * inverse
    s = (start_x * direction_y - start_y * direction_x) * inverse
    hit = ~parallel & (t > 0.0) & (s >= -_CORNER_TOLERANCE) & (s <= 1.0 + _CORNER_TOLERANCE)
    return Crossings(xp.where(hit, t, xp.full_like(t, xp.inf)), s, determinant)


def wall_profile(
    position_m: Float[Array, "b 2"],
    heading: Float[Array, "b"],
    walls_m: Float[Array, "b n 4"],
    columns: int,
) -> Float[Array, "b {columns}"]:
    """Wall profile (m) of each pose, one value per azimuth column of a panorama with that heading.

    Args:
        position_m: camera positions, inside the room that `walls_m` closes.
        heading: azimuth of the centre column, radians.
        walls_m: wall segments of each pose's own room.
        columns: number of azimuth columns.
    """
    xp = array_namespace(position_m, heading, walls_m)
    relative = xp.asarray(column_azimuths(columns), dtype=position_m.dtype, device=device(position_m))
    return cast_rays(position_m, heading[:, None] + relative[None, :], walls_m)
