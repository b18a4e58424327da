"""A shot's scene as arrays: walls, decals on walls, prisms, surfaces, lights, and camera settings; and its tables.

Lengths are metres relative to the camera's position in the plan, so that single precision suffices; heights are
relative to the floor. The camera's own room has slot 0; rooms seen through its doors follow.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.learn.synth.camera import Exposure
from lalaloc_core.learn.synth.furniture.furnish import Prism
from lalaloc_core.learn.synth.records import Column, Joined, Records, Row, columns
from lalaloc_core.learn.synth.scene.surfaces import Surfaces, SurfaceTable

# Overhang of a jamb at both ends of its hole.
_JAMB_OVERLAP_M = 1e-4

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


class Decal(NamedTuple):
    """A rectangle on a wall, see `Decals`."""

    wall: int
    s0_m: float
    s1_m: float
    z0_m: float
    z1_m: float
    surface: int
    slot: int = -1
    depth_m: float = 0.0


class SceneTables:
    """Tables of one scene, see `RenderScene`; the own room's walls come first, and later decals cover earlier ones."""

    def __init__(self, camera_m: Float[np.ndarray, "2"], surfaces: SurfaceTable) -> None:
        self.camera_m = camera_m
        self.surfaces = surfaces
        self.walls_m: list[Float[np.ndarray, "4"]] = []
        self.wall_surfaces: list[int] = []
        self._wall_owners: list[int] = []
        self.decals: list[Decal] = []
        self.prisms: list[Row] = []
        self.rooms: list[Row] = []

    def add_wall(self, ends_m: Float[np.ndarray, "4"], owner: int, surface: int) -> int:
        """Add a wall with its row of `RenderScene.wall_owner`; return its index."""
        self.walls_m.append(ends_m)
        self._wall_owners.append(owner)
        self.wall_surfaces.append(surface)
        return len(self.walls_m) - 1

    def wall_length_m(self, wall: int) -> float:
        """Return the length of a wall."""
        ends = self.walls_m[wall]
        return float(np.hypot(*(ends[2:] - ends[:2])))

    def add_decal(
        self,
        wall: int,
        *,
        s_m: tuple[float, float],
        z_m: tuple[float, float],
        surface: int,
        slot: int = -1,
        depth_m: float = 0.0,
    ) -> None:
        """Add a rectangle on a wall; with a `slot` it is a hole of some depth that shows that room."""
        self.decals.append(Decal(wall, *s_m, *z_m, surface, slot, depth_m))

    def add_prism(self, prism: Prism, surface: int, *, opaque: bool = True) -> None:
        """Add a box or cylinder with a surface of its finish; an `opaque` one casts shadows."""
        self.add_box(
            prism.centre_m, prism.axis, prism.half_m, prism.z_m, surface, is_round=prism.is_round, opaque=opaque
        )

    def add_box(
        self,
        centre_m: Float[np.ndarray, "2"],
        axis: Float[np.ndarray, "2"],
        half_m: tuple[float, float],
        z_m: tuple[float, float],
        surface: int,
        *,
        is_round: bool = False,
        opaque: bool = True,
    ) -> None:
        """Add a box or cylinder; centre in the plan frame, half extents along `axis` and across it."""
        row = Prisms.row(
            centre_m=centre_m - self.camera_m,
            axis=axis,
            half_m=half_m,
            z_m=z_m,
            is_round=is_round,
            surface=surface,
            is_opaque=opaque,
        )
        self.prisms.append(row)

    def add_pieces(self, prisms: Iterable[Prism]) -> None:
        """Add furniture; the parts of a piece with the same finish share a surface."""
        known: dict[tuple[int, str], int] = {}
        for prism in prisms:
            key = (prism.piece, prism.finish)
            if key not in known:
                known[key] = self.surfaces.add_finish(prism.finish)
            self.add_prism(prism, known[key], opaque=prism.finish != "glow")

    def add_jambs(self) -> None:
        """Add the reveals of every hole: walls from one room to the next."""
        for index, hole in enumerate(self.decals):
            if hole.slot < 0:
                continue
            ends = self.walls_m[hole.wall]
            along = (ends[2:] - ends[:2]) / np.hypot(*(ends[2:] - ends[:2]))
            outward = np.array([along[1], -along[0]])
            for s in (hole.s0_m, hole.s1_m):
                near = ends[:2] + along * s
                # A small overlap into the room closes gaps from rounding.
                back, front = near - outward * _JAMB_OVERLAP_M, near + outward * (hole.depth_m + _JAMB_OVERLAP_M)
                self.add_wall(np.concatenate([back, front]), -1 - index, hole.surface)

    def to_scene(
        self,
        camera_height_m: float,
        heading: float,
        *,
        lights: Lights,
        sun: Sun,
        backdrop: Backdrop,
        exposure: Exposure,
        facts: Iterable[Fact],
    ) -> RenderScene:
        """Return the finished scene; see `RenderScene` for the arguments."""
        return RenderScene(
            camera_height_m=camera_height_m,
            heading=heading,
            walls_m=np.array(self.walls_m) - np.tile(self.camera_m, 2),
            wall_owner=np.array(self._wall_owners),
            wall_surface=np.array(self.wall_surfaces),
            decals=Decals.stacked([Decals.row(**decal._asdict()) for decal in self.decals]),
            prisms=Prisms.stacked(self.prisms),
            surfaces=Surfaces.stacked(self.surfaces.rows),
            rooms=VisibleRooms.stacked(self.rooms),
            lights=lights,
            sun=sun,
            backdrop=backdrop,
            exposure=exposure,
            facts=frozenset(facts),
        )
