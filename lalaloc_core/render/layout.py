"""The layout by azimuth, the distance to the wall, the opening in it, and the distance behind that opening.

In closed form, for numpy and torch. The distance is to the wall itself; doors, windows and passages are parts of it.
"""

from __future__ import annotations

from dataclasses import dataclass

from array_api_compat import array_namespace, device
from jaxtyping import Float, Int

from lalaloc_core.conventions import DOOR_CODE, PASSAGE_CODE, Array, column_azimuths
from lalaloc_core.floorplan import PlanGeometry
from lalaloc_core.render.profile import BEYOND_M, cast_rays, nearest_walls


@dataclass(frozen=True, eq=False)
class RenderedLayout:
    """Distances and opening kinds per pose and azimuth column.

    Attributes:
        distance_m: (b, w) distance to the nearest wall of the pose's room, the wall profile.
        kind: (b, w) code in `conventions.OPENING_CLASSES` of that wall at eye height.
        behind_m: (b, w) distance along the same ray through a door or passage to the next wall of the room behind;
            equals `distance_m` where no room is visible behind.
    """

    distance_m: Float[Array, "b w"]
    kind: Int[Array, "b w"]
    behind_m: Float[Array, "b w"]


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
    return RenderedLayout(distance_m, _at_opening(geometry.opening_kind, room_index, opening), behind_m)


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


def _at_opening(values: Array, room_index: Int[Array, "b"], opening: Int[Array, "b w"]) -> Int[Array, "b w"]:
    """Return the value of the opening that each ray meets, 0 (wall) for none."""
    xp = array_namespace(opening)
    if values.shape[1] == 0:
        return xp.zeros_like(opening)
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
