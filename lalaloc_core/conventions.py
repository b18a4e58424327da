"""Axes, units and the pixel contract. Every other module relies on this page.

Plan frame: right-handed, metres, x to the right, y up on the drawing, z up from the floor.
Azimuth: clockwise from the plan's +y seen from above, so azimuth 0 looks along +y and π/2 along +x.
Heading of a panorama: the azimuth that its centre column looks along.
Inside the code angles are radians; degrees exist at the HTTP API, on the command line and in files only.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Float

# Any array that array-api-compat understands: numpy in the service, torch in training and LPO.
Array = Any

TWO_PI = 2.0 * math.pi
# A camera nearer to the floor is one whose height was given in another unit.
MIN_CAMERA_HEIGHT_M = 0.1

# What a horizontal ray meets at eye height; its place is its code, in plans, layouts, networks and search alike.
OPENING_CLASSES = ("wall", "door", "window", "passage")
WALL_CODE, DOOR_CODE, WINDOW_CODE, PASSAGE_CODE = range(len(OPENING_CLASSES))

# What a room is for; the place is the code. docs/reference/conventions.md says what each covers.
ROOM_TYPES = (
    "unknown",
    "bedroom",
    "living",
    "kitchen",
    "dining",
    "bathroom",
    "corridor",
    "entrance",
    "closet",
    "storage",
    "laundry",
    "garage",
    "stairs",
    "balcony",
    "office",
    "meeting",
)


def column_azimuths(columns: int) -> Float[np.ndarray, "columns"]:
    """Azimuth (radians, relative to the heading) of each pixel column's centre: ((j + 0.5) / W - 0.5) 2π."""
    return ((np.arange(columns) + 0.5) / columns - 0.5) * TWO_PI


def row_elevations(rows: int) -> Float[np.ndarray, "rows"]:
    """Elevation (radians, up is positive) of each pixel row's centre: (0.5 - (i + 0.5) / H) π."""
    return (0.5 - (np.arange(rows) + 0.5) / rows) * math.pi


def wrap_angle(angle: Array) -> Array:
    """The same angle (radians) in [-π, π)."""
    return (angle + math.pi) % TWO_PI - math.pi


def heading_from_degrees(degrees: float) -> float:
    """Radians in [0, 2π) of a heading in degrees."""
    return math.radians(degrees % 360.0)


def heading_to_degrees(radians: float) -> float:
    """Degrees in [0, 360) of a heading in radians."""
    degrees = math.degrees(radians) % 360.0
    return 0.0 if degrees >= 360.0 else degrees
