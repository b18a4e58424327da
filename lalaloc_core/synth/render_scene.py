"""One shot's scene as plain arrays: walls, decals on walls, prisms, surfaces, lights, and how the camera exposes.

Lengths are metres relative to the camera's position in the plan (so that single precision suffices); heights are
relative to the floor. The camera's own room has slot 0; rooms seen through its doors follow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

Fact = Literal[
    "open_door",
    "wide_opening",
    "wall_stub",
    "corridor",
    "closet",
    "near_wall",
    "threshold",
    "counter",
    "sun_patch",
    "nadir_patch",
    "mirror",
    "bare_bright",
    "large_room",
]

# Columns of the tables below.
DECAL_WALL, DECAL_S0, DECAL_S1, DECAL_Z0, DECAL_Z1, DECAL_SURFACE, DECAL_SLOT, DECAL_DEPTH = range(8)
PRISM_X, PRISM_Y, PRISM_AX, PRISM_AY, PRISM_A, PRISM_B, PRISM_Z0, PRISM_Z1, PRISM_ROUND, PRISM_SURFACE, PRISM_OPAQUE = (
    range(11)
)
LIGHT_XYZ, LIGHT_RGB, LIGHT_NORMAL = slice(0, 3), slice(3, 6), slice(6, 8)
SLOT_CEILING, SLOT_FLOOR_SURFACE, SLOT_CEILING_SURFACE = range(3)
SLOT_LIGHT_XYZ, SLOT_LIGHT_RGB, SLOT_AMBIENT = slice(3, 6), slice(6, 9), slice(9, 12)


@dataclass(frozen=True, eq=False)
class RenderScene:
    """Everything that one picture is made of.

    Attributes:
        camera_height_m: of the camera over the floor.
        heading: azimuth of the centre column, radians.
        walls_m: segments (x0, y0, x1, y1), room interior to their left.
        wall_owner: slot of the room that a wall belongs to; -1 - d for the jambs of the hole that is decal d.
        wall_surface: row of `surfaces`.
        decals: rectangles on walls, later ones cover earlier ones: wall, start and end along it, z-range, surface,
            slot of the room behind it if it is a hole (else -1), depth of the hole (m).
        prisms: boxes and elliptic cylinders: centre, first axis, half extents, z-range, whether round, surface, whether
            it casts shadows.
        surfaces: see `surfaces`.
        slots: per room: ceiling height, floor and ceiling surface, position and colour of a lamp, ambient light.
        lights: lamps and windows of the own room: position, colour times power, horizontal normal of a window (0, 0
            for a lamp, which shines everywhere).
        sun: sunlight through one window: direction to the sun (3), window's wall (4: point, unit vector along),
            window rectangle (s0, s1, z0, z1), colour (3).
        backdrop: the outdoors: sky (3), ground (3), horizon slope, ruggedness, two phases.
        exposure: see `exposure`.
        facts: what was drawn of what is worth knowing about a picture; `facts` knows more.
    """

    camera_height_m: float
    heading: float
    walls_m: Float[np.ndarray, "n 4"]
    wall_owner: Int[np.ndarray, "n"]
    wall_surface: Int[np.ndarray, "n"]
    decals: Float[np.ndarray, "d 8"]
    prisms: Float[np.ndarray, "p 11"]
    surfaces: Float[np.ndarray, "s 12"]
    slots: Float[np.ndarray, "r 12"]
    lights: Float[np.ndarray, "l 8"]
    sun: Float[np.ndarray, "14"]
    backdrop: Float[np.ndarray, "10"]
    exposure: Float[np.ndarray, "24"]
    facts: frozenset[Fact] = frozenset()
