"""How large a floor plan may be."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M


@dataclass(frozen=True, kw_only=True)
class PlanLimits:
    """What a floor plan may be; anything outside is refused with the value, the limit and the limit's name.

    A room's vertices are those of its outline and its holes, and one for each free-standing wall;
    `max_plan_vertices` are those of all rooms. `max_depth` is of objects and lists within each other.
    """

    max_rooms: int = 10_000
    max_vertices_per_room: int = 500
    max_plan_vertices: int = 100_000
    max_openings: int = 20_000
    # Pieces of openings on the walls of one room, and walls that one opening may lie on.
    max_openings_per_room: int = 100
    max_walls_per_opening: int = 32
    max_extent_m: float = 1000.0
    max_area_m2: float = 200_000.0
    # Sum of the boxes around the rooms: what a grid of poses looks through.
    max_bounds_area_m2: float = 2_000_000.0
    # Up to here a double tells nanometres apart; a hundred times farther out areas and distances begin to lose metres.
    max_coordinate_m: float = 1e7
    max_depth: int = 8
    max_name_length: int = 200
    min_room_area_m2: float = 0.2
    min_ceiling_height_m: float = 1.0
    min_camera_height_m: float = MIN_CAMERA_HEIGHT_M
    max_ceiling_height_m: float = 20.0
    # Two rooms that share more floor than this overlap; less is rounding of the drawing.
    overlap_tolerance_m2: float = 0.01


DEFAULT_LIMITS = PlanLimits()
# For plans that were valid under the limits of their day: tighter ones must not make them unreadable.
NO_LIMITS = PlanLimits(
    max_rooms=10**9,
    max_vertices_per_room=10**9,
    max_plan_vertices=10**9,
    max_openings=10**9,
    max_openings_per_room=10**9,
    max_walls_per_opening=10**9,
    max_extent_m=math.inf,
    max_area_m2=math.inf,
    max_bounds_area_m2=math.inf,
    max_coordinate_m=math.inf,
    min_camera_height_m=0.0,
)
