"""Tables of a scene under construction."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lalaloc_core.learn.synth.camera import Exposure
from lalaloc_core.learn.synth.furniture.furnish import Prism
from lalaloc_core.learn.synth.records import Row
from lalaloc_core.learn.synth.scene.render_scene import (
    Backdrop,
    Decals,
    Fact,
    Lights,
    Prisms,
    RenderScene,
    Sun,
    VisibleRooms,
)
from lalaloc_core.learn.synth.scene.shots import Shot
from lalaloc_core.learn.synth.scene.surfaces import Surfaces, SurfaceTable

# Overhang of a jamb at both ends of its hole.
_JAMB_OVERLAP_M = 1e-4


class Decal(NamedTuple):
    """A rectangle on a wall, see `render_scene.Decals`."""

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
        self, shot: Shot, *, lights: Lights, sun: Sun, backdrop: Backdrop, exposure: Exposure, facts: Iterable[Fact]
    ) -> RenderScene:
        """Return the finished scene; see `RenderScene` for the other arguments."""
        return RenderScene(
            camera_height_m=shot.camera_height_m,
            heading=shot.heading,
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
