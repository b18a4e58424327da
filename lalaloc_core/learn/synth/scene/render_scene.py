"""A shot's scene as arrays: walls, decals on walls, prisms, surfaces, lights, and camera settings.

Lengths are metres relative to the camera's position in the plan, so that single precision suffices; heights are
relative to the floor. The camera's own room has slot 0; rooms seen through its doors follow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.learn.synth.camera import Exposure
from lalaloc_core.learn.synth.records import Column, Joined, Records, columns
from lalaloc_core.learn.synth.scene.surfaces import Surfaces

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


class Decals(Records):
    """Rectangles on walls; later ones cover earlier ones.

    Attributes:
        surface: row of the surfaces; of a hole, the surface of its reveals.
        slot: room behind it if it is a hole, else -1.
        depth_m: depth of a hole.
    """

    wall, s0_m, s1_m, z0_m, z1_m, surface, slot, depth_m = columns(8)


class Prisms(Records):
    """Vertical boxes and elliptic cylinders.

    Attributes:
        x_m, y_m: centre; both as `centre_m`.
        axis_x, axis_y: unit vector of the first axis, both as `axis`; the second is the first turned by +90°.
        half_a_m, half_b_m: half extents along the two axes, both as `half_m`.
        z0_m, z1_m: lower and upper end above the floor, both as `z_m`.
        is_opaque: 1 for prisms that cast shadows.
    """

    x_m, y_m, axis_x, axis_y, half_a_m, half_b_m = columns(6)
    z0_m, z1_m, is_round, surface, is_opaque = columns(5)
    centre_m = Joined(x_m, y_m)
    axis = Joined(axis_x, axis_y)
    half_m = Joined(half_a_m, half_b_m)
    z_m = Joined(z0_m, z1_m)


class VisibleRooms(Records):
    """Room of the camera, then rooms seen through its doors, each with the light of its one lamp."""

    ceiling_m, floor_surface, ceiling_surface = columns(3)
    light_m = Column(3)
    light_colour = Column(3)
    ambient = Column(3)


class Lights(Records):
    """Lamps and windows of the own room.

    Attributes:
        position_m: all three coordinates; `xy_m` and `z_m` are parts of it.
        colour: colour times power.
        normal: horizontal unit normal of a window; (0, 0) for a lamp, which shines everywhere.
    """

    xy_m = Column(2)
    z_m = Column()
    position_m = Joined(xy_m, z_m)
    colour = Column(3)
    normal = Column(2)


class Sun(Records):
    """Sunlight through one window, from `s0_m` to `s1_m` along its wall; all 0 for none."""

    direction = Column(3)
    wall_start_m = Column(2)
    wall_along = Column(2)
    s0_m, s1_m, z0_m, z1_m = columns(4)
    colour = Column(3)


class Backdrop(Records):
    """The outdoors: slopes of the outline before the sky, and shifts of it and its mottle as shares of a full turn."""

    sky = Column(3)
    ground = Column(3)
    horizon, ruggedness, turn, lift = columns(4)


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneRecords:
    """Records of a scene; a batch of scenes has one more axis.

    The row of a room is its slot. `sun`, `backdrop` and `exposure` have a single row.
    """

    decals: Decals
    prisms: Prisms
    surfaces: Surfaces
    rooms: VisibleRooms
    lights: Lights
    sun: Sun
    backdrop: Backdrop
    exposure: Exposure


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderScene(SceneRecords):
    """All contents of one picture.

    Attributes:
        walls_m: segments (x0, y0, x1, y1), room interior to their left.
        wall_owner: slot of the wall's room; -1 - d for the jambs of the hole that is decal d.
        wall_surface: row of `surfaces`.
        facts: facts known from drawing.
    """

    camera_height_m: float
    heading: float
    walls_m: Float[np.ndarray, "n 4"]
    wall_owner: Int[np.ndarray, "n"]
    wall_surface: Int[np.ndarray, "n"]
    facts: frozenset[Fact] = frozenset()
