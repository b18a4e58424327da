"""Size limits of floor plans."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M


@dataclass(frozen=True, kw_only=True)
class PlanLimits:
    """Limits of a floor plan; a plan outside them is refused with an error that names value and limit.

    Errors name the service's setting (`LALALOC_MAX_ROOMS`) if there is one; in Python, pass a `PlanLimits` instead.
    A room's vertices are those of its outline and holes, plus one per free-standing wall; `max_plan_vertices` counts
    all rooms. `max_depth` limits the nesting of objects and lists.
    """

    max_rooms: int = 10_000
    max_vertices_per_room: int = 500
    max_plan_vertices: int = 100_000
    max_openings: int = 20_000
    # Opening faces on the walls of one room, and walls that one opening can lie on.
    max_openings_per_room: int = 100
    max_walls_per_opening: int = 32
    # Opening faces on all walls, and comparisons of an opening with a wall near it.
    max_opening_faces: int = 200_000
    max_opening_pairs: int = 3_000_000
    max_extent_m: float = 1000.0
    max_area_m2: float = 200_000.0
    # Sum of the bounding boxes of the rooms, which the pose grid is computed over.
    max_bounds_area_m2: float = 500_000.0
    # Up to here a double resolves nanometres; a hundred times farther out areas and distances begin to lose metres.
    max_coordinate_m: float = 1e7
    max_depth: int = 8
    max_name_length: int = 200
    min_room_area_m2: float = 0.2
    min_ceiling_height_m: float = 1.0
    min_camera_height_m: float = MIN_CAMERA_HEIGHT_M
    max_ceiling_height_m: float = 20.0
    # Rooms that share more floor than this overlap; less is rounding of the drawing.
    overlap_tolerance_m2: float = 0.01


DEFAULT_LIMITS = PlanLimits()
# For stored plans, which were valid under earlier limits: tighter ones must not make them unreadable.
NO_LIMITS = PlanLimits(
    max_rooms=10**9,
    max_vertices_per_room=10**9,
    max_plan_vertices=10**9,
    max_openings=10**9,
    max_openings_per_room=10**9,
    max_walls_per_opening=10**9,
    max_opening_faces=10**9,
    max_opening_pairs=10**12,
    max_extent_m=math.inf,
    max_area_m2=math.inf,
    max_bounds_area_m2=math.inf,
    max_coordinate_m=math.inf,
    min_camera_height_m=0.0,
)
