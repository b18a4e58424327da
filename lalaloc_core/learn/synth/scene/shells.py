"""Shell of a room: floor, ceiling and walls, and wall decorations that do not hide its edges."""

from __future__ import annotations

import math

import numpy as np

from lalaloc_core.floorplan import Room
from lalaloc_core.learn.synth.furniture.furnish import wall_frame
from lalaloc_core.learn.synth.scene.lighting import Lighting
from lalaloc_core.learn.synth.scene.render_scene import VisibleRooms
from lalaloc_core.learn.synth.scene.scene_tables import SceneTables
from lalaloc_core.learn.synth.scene.streams import ScenePart, Streams
from lalaloc_core.learn.synth.scene.surfaces import Colour, HouseStyle, bright, paint, pale, vivid

# Trims reach this far beyond the ends of their wall, the floor and the ceiling: no crack is seen.
_BEYOND_M = 1.0
_NEW_FLOOR_SHARE = 0.4


class Shells:
    """Builds the shells of a scene's rooms, one after the other.

    The home is pale with a plain floor if it `is_bright` (for sale); most walls have neither pictures nor switches if
    it `is_bare`.
    """

    def __init__(
        self, tables: SceneTables, style: HouseStyle, streams: Streams, *, is_bright: bool, is_bare: bool
    ) -> None:
        self._tables, self._style, self._streams = tables, style, streams
        self._is_bright, self._is_bare = is_bright, is_bare
        self._floor: int | None = None

    def add(self, slot: int, room_index: int, room: Room, lighting: Lighting) -> int:
        """Build the next room with its lamp from `lighting`; return the index of its first wall."""
        tables, streams, rng = self._tables, self._streams, self._streams.shapes
        streams.begin(ScenePart.ROOM, room_index)
        colour = pale(rng) if self._is_bright else paint(rng)
        wall = tables.surfaces.add_plain(colour) if self._is_bright else tables.surfaces.add_wall(colour)
        is_accented = rng.random() < (0.08 if self._is_bright else 0.25)
        accent = tables.surfaces.add_wall(paint(rng)) if is_accented else wall
        ceiling_colour = colour * rng.uniform(0.85, 1.1) if rng.random() < 0.2 else bright(rng)
        ceiling = tables.surfaces.add_ceiling(np.clip(ceiling_colour, 0.01, 0.92))
        floor = self._floor_of(room_index, room, colour)
        streams.begin(ScenePart.ACCENT, room_index)
        lamp = lighting.of_room_beyond(room, tables.camera_m)
        room_row = VisibleRooms.row(
            ceiling_m=room.ceiling_height_m,
            floor_surface=floor,
            ceiling_surface=ceiling,
            light_m=lamp.position_m,
            light_colour=lamp.colour,
            ambient=lamp.ambient,
        )
        tables.rooms.append(room_row)
        accented = int(rng.integers(len(room.walls_m)))
        streams.begin(ScenePart.TRIM, room_index)
        first = len(tables.walls_m)
        for edge, ends in enumerate(room.walls_m):
            index = tables.add_wall(ends, slot, accent if edge == accented else wall)
            _dress_wall(tables, self._style, index, room.ceiling_height_m, rng, is_bare=self._is_bare)
        return first

    def _floor_of(self, room_index: int, room: Room, colour: Colour) -> int:
        """Return the surface of a room's floor; many homes have one floor throughout."""
        streams = self._streams
        if streams.is_staged:
            # Rooms without a floor of their own draw the same one, so that it looks the same from every room.
            streams.begin(ScenePart.FLOOR, *([room_index] if streams.shapes.random() < _NEW_FLOOR_SHARE else []))
        elif self._floor is not None and streams.shapes.random() >= _NEW_FLOOR_SHARE:
            return self._floor
        _, along, _ = wall_frame(room, 0)
        direction = math.atan2(along[1], along[0])
        self._floor = self._tables.surfaces.add_floor(colour, direction, plain=self._is_bright)
        return self._floor


def _dress_wall(
    tables: SceneTables, style: HouseStyle, wall: int, ceiling_m: float, rng: np.random.Generator, *, is_bare: bool
) -> None:
    """Add baseboard, crown moulding, pictures and switches."""
    length = tables.wall_length_m(wall)
    start, end = -_BEYOND_M, length + _BEYOND_M
    if style.baseboard_m > 0.0:
        tables.add_decal(wall, s_m=(start, end), z_m=(-_BEYOND_M, style.baseboard_m), surface=style.trim)
    if style.crown_m > 0.0:
        tables.add_decal(
            wall, s_m=(start, end), z_m=(ceiling_m - style.crown_m, ceiling_m + _BEYOND_M), surface=style.trim
        )
    if is_bare and rng.random() < 0.8:
        return
    if length > 1.0 and rng.random() < 0.45:
        _hang_picture(tables, wall, length, rng)
    if length > 0.5 and rng.random() < 0.5:
        s, z = rng.uniform(0.1, length - 0.1), float(rng.choice([0.25, 1.1]))
        tables.add_decal(wall, s_m=(s - 0.04, s + 0.04), z_m=(z - 0.04, z + 0.04), surface=style.trim)


def _hang_picture(tables: SceneTables, wall: int, length_m: float, rng: np.random.Generator) -> None:
    """Add a picture or a screen in a dark frame to a wall that is long enough."""
    half_width, half_height = rng.uniform(0.12, 0.6), rng.uniform(0.12, 0.5)
    if 2 * half_width >= length_m - 0.2:
        return
    s = rng.uniform(half_width + 0.1, length_m - half_width - 0.1)
    z = rng.uniform(1.35, 1.7)
    s0, s1, z0, z1 = s - half_width, s + half_width, z - half_height, z + half_height
    frame = tables.surfaces.add_finish("dark")
    is_screen = rng.random() < 0.15
    picture = frame if is_screen else tables.surfaces.add("furniture", vivid(rng), scale=0.7)
    tables.add_decal(wall, s_m=(s0, s1), z_m=(z0, z1), surface=frame)
    inset = rng.uniform(0.015, 0.05)
    tables.add_decal(wall, s_m=(s0 + inset, s1 - inset), z_m=(z0 + inset, z1 - inset), surface=picture)
