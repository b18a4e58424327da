"""Mirrors on walls: holes that show a reflected copy of the room and its furniture."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lalaloc_core.floorplan import Room
from lalaloc_core.learn.synth.homes.openings import Opening
from lalaloc_core.learn.synth.records import Row
from lalaloc_core.learn.synth.scene.render_scene import Lights, Prisms, VisibleRooms
from lalaloc_core.learn.synth.scene.scene_tables import SceneTables
from lalaloc_core.learn.synth.scene.surfaces import HouseStyle

# Probability of a large mirror by kind of room.
_CHANCE = {"bathroom": 0.4, "corridor": 0.22, "bedroom": 0.25, "living": 0.15, "dining": 0.12, "closet": 0.12}
_OTHERS = 0.05
_BARE_SHARE = 0.4
_CLEARANCE_M = 0.15
_MIN_WIDTH_M = 0.35
_DEPTH_M = 0.004


class Mirror(NamedTuple):
    """Place of a mirror: wall, start and end along it, lower and upper edge (m)."""

    wall: int
    s0_m: float
    s1_m: float
    z0_m: float
    z1_m: float


def sample_mirror(room: Room, openings: Sequence[Opening], rng: np.random.Generator, *, is_bare: bool) -> Mirror | None:
    """Draw the place of a mirror between the openings; None for no mirror."""
    chance = _CHANCE.get(room.name.split()[0], _OTHERS) * (_BARE_SHARE if is_bare else 1.0)
    if rng.random() > chance:
        return None
    lengths = np.hypot(*(room.walls_m[:, 2:] - room.walls_m[:, :2]).T)
    for wall in rng.permutation(len(lengths))[:4]:
        length = float(lengths[wall])
        widest = min(3.0, length - 2.0 * _CLEARANCE_M)
        if widest < _MIN_WIDTH_M:
            continue
        width = rng.uniform(_MIN_WIDTH_M, widest)
        start = rng.uniform(_CLEARANCE_M, length - _CLEARANCE_M - width)
        free = all(
            hole.wall != wall or start > hole.end_m + _CLEARANCE_M or start + width < hole.start_m - _CLEARANCE_M
            for hole in openings
        )
        if free:
            stands = rng.random() < 0.4
            low = rng.uniform(0.03, 0.3) if stands else rng.uniform(0.8, 1.15)
            high = min(rng.uniform(1.6, 2.3), room.ceiling_height_m - 0.1)
            return Mirror(int(wall), float(start), float(start + width), float(low), float(high))
    return None


def add_mirror(
    tables: SceneTables,
    style: HouseStyle,
    mirror: Mirror,
    *,
    room: Room,
    prisms: Iterable[Row],
    lights: Lights,
    rng: np.random.Generator,
) -> None:
    """Hang a mirror: build the reflected room behind it, with dark doors.

    The tables' first walls are those of `room`, the own one; `prisms` is its furniture, rows of `tables.prisms`. The
    brightest of its lights shines in the reflected room.
    """
    wall, s0, s1, z0, z1 = mirror
    ends, count, first, slot = tables.walls_m[wall], len(room.walls_m), len(tables.walls_m), len(tables.rooms)
    reflection, relative = Reflection(ends), Reflection(ends - np.tile(tables.camera_m, 2))
    tables.rooms.append(_reflected_room(tables.rooms[0], lights, relative))
    for edge in range(count):
        tables.add_wall(reflection.wall(tables.walls_m[edge]), slot, tables.wall_surfaces[edge])
    for decal in [decal for decal in tables.decals if decal.wall < count]:
        length = tables.wall_length_m(decal.wall)
        seen = style.gloom if decal.slot >= 0 else decal.surface
        tables.add_decal(
            first + decal.wall,
            s_m=(length - decal.s1_m, length - decal.s0_m),
            z_m=(decal.z0_m, decal.z1_m),
            surface=seen,
        )
    tables.prisms += [relative.prism(Prisms(prism)).rows for prism in prisms]
    if rng.random() < 0.6:
        border = rng.uniform(0.02, 0.08)
        frame = tables.surfaces.add_finish("wood")
        tables.add_decal(wall, s_m=(s0 - border, s1 + border), z_m=(z0 - border, z1 + border), surface=frame)
    tables.add_decal(wall, s_m=(s0, s1), z_m=(z0, z1), surface=style.handle, slot=slot, depth_m=_DEPTH_M)


def _reflected_room(own: Row, lights: Lights, relative: Reflection) -> Row:
    """Return the room with its brightest light at the reflected position."""
    room = VisibleRooms(own.copy())
    if len(lights.rows):
        brightest = lights[lights.colour.sum(axis=1).argmax()]
        room.light_m = np.append(relative.point(brightest.xy_m), brightest.z_m)
        room.light_colour = brightest.colour
    return room.rows


class Reflection:
    """Reflection in the vertical plane through a wall (x0, y0, x1, y1)."""

    def __init__(self, wall_m: Float[np.ndarray, "4"]) -> None:
        along = wall_m[2:] - wall_m[:2]
        along = along / np.hypot(*along)
        self._matrix = 2.0 * np.outer(along, along) - np.eye(2)
        self._offset = wall_m[:2] - self._matrix @ wall_m[:2]

    def point(self, point_m: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """Return the reflected point."""
        return self._matrix @ point_m + self._offset

    def wall(self, ends_m: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
        """Return the reflected wall with swapped ends, so that the room stays on its left."""
        return np.concatenate([self.point(ends_m[2:]), self.point(ends_m[:2])])

    def prism(self, prism: Prisms) -> Prisms:
        """Return the reflected prism (a single row), which casts no shadow."""
        seen = prism.copy()
        seen.centre_m = self.point(seen.centre_m)
        seen.axis = self._matrix @ seen.axis
        seen.is_opaque = 0.0
        return seen
