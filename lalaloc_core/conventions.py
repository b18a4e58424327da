"""Axes, units and pixel coordinates used by all other modules.

Plan frame: right-handed, metres, x to the right, y up on the drawing, z up from the floor.
Azimuth: clockwise from the plan's +y seen from above; azimuth 0 is +y and π/2 is +x.
Heading of a photograph: azimuth of its centre column.
Angles are radians inside the code; degrees are used only in the HTTP API, on the command line and in files.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Float

# Arrays that array-api-compat supports: numpy in the service, torch in training and LPO.
Array = Any

TWO_PI = 2.0 * math.pi
# A lower camera height was probably given in another unit.
MIN_CAMERA_HEIGHT_M = 0.1

# Classes of the surface that a horizontal ray hits at eye height; the index is the code in plans, layouts, networks
# and search.
OPENING_CLASSES = ("wall", "door", "window", "passage")
WALL_CODE, DOOR_CODE, WINDOW_CODE, PASSAGE_CODE = range(len(OPENING_CLASSES))

# Kinds of fixtures in plans.
FIXTURE_KINDS = (
    "toilet", "bath", "shower", "basin", "sink", "stove", "fridge", "washer", "bed", "sofa", "stairs",
)  # fmt: skip

# Room types; the index is the code. docs/reference/plan-format.md describes each.
ROOM_TYPES = (
    "unknown", "bedroom", "living", "kitchen", "dining", "bathroom", "corridor", "entrance", "closet", "storage",
    "laundry", "garage", "stairs", "balcony", "office", "meeting",
)  # fmt: skip


def column_azimuths(columns: int) -> Float[np.ndarray, "columns"]:
    """Return the azimuth (radians, relative to the heading) of column centres: ((j + 0.5) / W - 0.5) 2π."""
    return ((np.arange(columns) + 0.5) / columns - 0.5) * TWO_PI


def row_elevations(rows: int) -> Float[np.ndarray, "rows"]:
    """Return the elevation (radians, up is positive) of row centres: (0.5 - (i + 0.5) / H) π."""
    return (0.5 - (np.arange(rows) + 0.5) / rows) * math.pi


def unit_rays(azimuth: Float[np.ndarray, "*#n"], elevation: Float[np.ndarray, "*#n"]) -> Float[np.ndarray, "*n 3"]:
    """Return unit vectors (right, forward, up) in the directions of azimuths and elevations (radians)."""
    level = np.cos(elevation)
    rays = np.broadcast_arrays(level * np.sin(azimuth), level * np.cos(azimuth), np.sin(elevation))
    return np.stack(rays, axis=-1)


def wrap_angle(angle: Array) -> Array:
    """Wrap an angle (radians) to [-π, π)."""
    return (angle + math.pi) % TWO_PI - math.pi


def heading_from_degrees(degrees: float) -> float:
    """Convert a heading in degrees to radians in [0, 2π)."""
    return math.radians(degrees % 360.0)


def heading_to_degrees(radians: float) -> float:
    """Convert a heading in radians to degrees in [0, 360)."""
    degrees = math.degrees(radians) % 360.0
    return 0.0 if degrees >= 360.0 else degrees
