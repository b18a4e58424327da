"""Layout depth from a wall profile and its back-projection, in closed form, for numpy and torch."""

from __future__ import annotations

import numpy as np
from array_api_compat import array_namespace, device
from jaxtyping import Float

from lalaloc_core.conventions import Array, column_azimuths, row_elevations, unit_rays


def layout_depth(
    profile_m: Float[Array, "b w"],
    camera_height_m: Float[Array, "b"],
    ceiling_height_m: Float[Array, "b"],
    rows: int,
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
