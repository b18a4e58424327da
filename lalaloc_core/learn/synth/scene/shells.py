"""Shell of a room: floor, ceiling with beams and lamps, walls with their windows, and what hangs on them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum

import numpy as np
import shapely

from lalaloc_core.floorplan import Room
from lalaloc_core.learn.synth.furniture.furnish import CAMERA_CLEARANCE_M, Prism, rectangle, wall_frame
from lalaloc_core.learn.synth.furniture.pieces import Finish
from lalaloc_core.learn.synth.homes.openings import Opening
from lalaloc_core.learn.synth.scene.lighting import Lighting
from lalaloc_core.learn.synth.scene.render_scene import SceneTables, VisibleRooms
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
        light = lighting.of_room_beyond(room, tables.camera_m)
        tables.rooms.append(
            VisibleRooms.row(ceiling_m=room.ceiling_height_m, floor_surface=floor, ceiling_surface=ceiling, **light)
        )
        accented = int(rng.integers(len(room.walls_m)))
        streams.begin(ScenePart.TRIM, room_index)
        first = len(tables.walls_m)
        for edge, ends in enumerate(room.walls_m):
            index = tables.add_wall(ends, slot, accent if edge == accented else wall)
            _dress_wall(tables, self._style, index, room.ceiling_height_m, rng, is_bare=self._is_bare)
        return first

    def _floor_of(self, room_index: int, room: Room, colour: Colour) -> int:
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


class ScenePart(IntEnum):
    """Parts of a scene that have streams of their own in a staged scene."""

    MOOD = 0
    ROOM = 1
    FLOOR = 2
    ACCENT = 3
    TRIM = 4
    OPENING = 5
    RADIATOR = 6
    FURNITURE = 7
    LAMPS = 8
    CAMERA = 9
    MATERIALS = 10


class Streams:
    """Random streams of one scene; with `is_staged` every part restarts its stream, see `begin`.

    Attributes:
        shapes: decides everything except materials.
        materials: separate, because shapes must not depend on the available pictures.
    """

    def __init__(self, seed: int, *, is_staged: bool) -> None:
        self._seed, self.is_staged = seed, is_staged
        self.shapes = np.random.default_rng(seed)
        self.materials = np.random.default_rng([seed, ScenePart.MATERIALS])

    def begin(self, part: ScenePart, *which: int) -> None:
        """Restart the streams for a part, so that in a staged scene it does not depend on the parts before it.

        `which` numbers the room or opening, if there are several.
        """
        if self.is_staged:
            for stream, number in ((self.shapes, ()), (self.materials, (ScenePart.MATERIALS,))):
                fresh = np.random.default_rng([self._seed, part, *which, *number])
                stream.bit_generator.state = fresh.bit_generator.state


# Boxes end so far above openings and the camera.
_ABOVE_OPENING_M, _ABOVE_CAMERA_M = 0.03, 0.25
# Slopes are stairs of so many steps, because boxes have level undersides.
_STEPS = 6
_MAX_BEAMS = 6
# Share of a box's footprint that must lie in the room: boxes outside would be seen through windows.
_INSIDE = 0.995
_KINDS = ("beams", "soffit", "tray", "slope")


def ceiling_boxes(
    room: Room, openings: Sequence[Opening], camera_height_m: float, rng: np.random.Generator
) -> list[Prism]:
    """Return boxes below a room's ceiling; none where the ceiling is too low for them."""
    top = room.ceiling_height_m
    floor_m = camera_height_m + _ABOVE_CAMERA_M
    kind = _KINDS[int(rng.choice(len(_KINDS), p=(0.35, 0.3, 0.15, 0.2)))]
    wall = int(rng.integers(len(room.walls_m)))
    if kind == "beams":
        return _beams(room, wall, max(floor_m, top - rng.uniform(0.08, 0.35)), rng)
    width = rng.uniform(0.2, 1.0)
    if kind == "slope":
        lowest = max(floor_m, _clear_m(openings, [wall]), top - rng.uniform(0.3, 1.4))
        depth = rng.uniform(0.4, 1.0) * room.area_m2**0.5 / _STEPS
        boxes = [
            _along_wall(room, wall, (step * depth, (step + 1) * depth), lowest + (top - lowest) * step / _STEPS)
            for step in range(_STEPS)
        ]
    else:
        walls = [wall] if kind == "soffit" else list(range(len(room.walls_m)))
        bottom = max(floor_m, _clear_m(openings, walls), top - rng.uniform(0.12, 0.5))
        boxes = [_along_wall(room, number, (0.0, width), bottom) for number in walls]
    return [box for box in boxes if box is not None]


def _clear_m(openings: Sequence[Opening], walls: list[int]) -> float:
    """Return the height above all openings in some walls."""
    return max((opening.head_m + _ABOVE_OPENING_M for opening in openings if opening.wall in walls), default=0.0)


def _along_wall(room: Room, wall: int, reach_m: tuple[float, float], bottom_m: float) -> Prism | None:
    start, along, inwards = wall_frame(room, wall)
    length = float(np.hypot(*(room.walls_m[wall][2:] - room.walls_m[wall][:2])))
    near, far = (start + inwards * reach for reach in reach_m)
    return _box(room, shapely.Polygon([near, near + along * length, far + along * length, far]), along, bottom_m)


def _beams(room: Room, wall: int, bottom_m: float, rng: np.random.Generator) -> list[Prism]:
    _, along, inwards = wall_frame(room, wall)
    middle = np.array(room.shape.centroid.coords[0])
    reach = float(np.hypot(*np.ptp(room.polygon_m, axis=0)))
    half, spacing = rng.uniform(0.04, 0.15), rng.uniform(0.5, 1.8)
    count = min(int(reach / spacing) + 1, _MAX_BEAMS)
    finish: Finish = "wood" if rng.random() < 0.5 else "white"
    beams = []
    for number in range(count):
        centre = middle + inwards * spacing * (number - 0.5 * (count - 1))
        near, far = centre - inwards * half, centre + inwards * half
        strip = shapely.Polygon([near - along * reach, near + along * reach, far + along * reach, far - along * reach])
        parts = shapely.get_parts(strip.intersection(room.shape))
        outlines = [part.minimum_rotated_rectangle for part in parts if part.area]
        beams += [
            _box(room, outline, along, bottom_m, finish) for outline in outlines if isinstance(outline, shapely.Polygon)
        ]
    return [beam for beam in beams if beam is not None]


def _box(
    room: Room, footprint: shapely.Polygon, along: np.ndarray, bottom_m: float, finish: Finish = "paint"
) -> Prism | None:
    corners = shapely.get_coordinates(footprint)
    across = np.array([-along[1], along[0]])
    low, high = (np.array([function(corners @ along), function(corners @ across)]) for function in (np.min, np.max))
    centre = 0.5 * (low + high)
    middle = along * centre[0] + across * centre[1]
    half_a, half_b = (0.5 * (high - low)).tolist()
    # A part of a beam in an acute corner is not parallel to it.
    box = rectangle(middle, along, half_a, half_b)
    if room.ceiling_height_m - bottom_m < 0.03 or box.intersection(room.shape).area < _INSIDE * box.area:
        return None
    return Prism(middle, along, (half_a, half_b), (bottom_m, room.ceiling_height_m), finish, piece=-1)


_HALF_DEPTH_M = 0.05
_CURTAIN_FROM_WALL_M, _RADIATOR_FROM_WALL_M = 0.07, 0.06
_MIN_HALF_WIDTH_M = 0.02


def add_window(tables: SceneTables, style: HouseStyle, wall: int, window: Opening, rng: np.random.Generator) -> None:
    """Add frame, panes and bars of a window, sometimes with a blind or a sheer curtain."""
    s0, s1, z0, z1 = window.start_m, window.end_m, window.sill_m, window.head_m
    border = rng.uniform(0.04, 0.09)
    tables.add_decal(wall, s_m=(s0 - 0.03, s1 + 0.03), z_m=(z0 - 0.03, z1 + 0.03), surface=style.trim)
    # The leaf of a French window has a broad rail at its foot.
    rail = rng.uniform(0.1, 0.35) if z0 < 0.1 and rng.random() < 0.5 else border
    tables.add_decal(wall, s_m=(s0 + border, s1 - border), z_m=(z0 + rail, z1 - border), surface=style.outdoors)
    sashes = max(1, round((s1 - s0) / rng.uniform(0.6, 1.4)))
    for k in range(1, sashes):
        s = s0 + (s1 - s0) * k / sashes
        tables.add_decal(wall, s_m=(s - 0.6 * border, s + 0.6 * border), z_m=(z0, z1), surface=style.trim)
    if rng.random() < 0.2:
        z = rng.uniform(0.4, 0.7) * (z1 - z0) + z0
        tables.add_decal(wall, s_m=(s0, s1), z_m=(z - 0.02, z + 0.02), surface=style.trim)
    if rng.random() < 0.15:
        # A roller blind.
        blind = tables.surfaces.add("furniture", bright(rng), glow=rng.uniform(0.4, 1.2))
        tables.add_decal(wall, s_m=(s0, s1), z_m=(z1 - rng.uniform(0.2, 0.9) * (z1 - z0), z1), surface=blind)
    elif rng.random() < 0.08:
        # A sheer curtain before the whole window.
        sheer = tables.surfaces.add("furniture", bright(rng), scale=rng.uniform(1.0, 3.0), glow=rng.uniform(0.3, 1.0))
        bottom = 0.04 if rng.random() < 0.6 else z0 - 0.05
        tables.add_decal(wall, s_m=(s0 - 0.15, s1 + 0.15), z_m=(bottom, z1 + 0.1), surface=sheer)


def add_curtains(tables: SceneTables, room: Room, window: Opening, rng: np.random.Generator, *, is_bare: bool) -> None:
    """Add curtains on both sides of a window, rarely in a bare home."""
    if rng.random() >= (0.1 if is_bare else 0.45):
        return
    cloth = tables.surfaces.add("furniture", np.clip(paint(rng), 0.03, 0.85), scale=rng.uniform(1.5, 4.0))
    width, top = rng.uniform(0.15, 0.6), min(window.head_m + 0.15, room.ceiling_height_m - 0.01)
    bottom = 0.03 if rng.random() < 0.7 else max(0.03, window.sill_m - 0.1)
    for s in (window.start_m, window.end_m):
        place_m = s, _CURTAIN_FROM_WALL_M
        _hang(tables, room, window.wall, place_m, half_m=0.5 * width, z_m=(bottom, top), surface=cloth)


def add_radiator(tables: SceneTables, style: HouseStyle, room: Room, window: Opening, rng: np.random.Generator) -> None:
    """Add a radiator below some windows."""
    if window.sill_m > 0.45 and rng.random() < 0.35:
        place_m = 0.5 * (window.start_m + window.end_m), _RADIATOR_FROM_WALL_M
        half_m, z_m = 0.4 * (window.end_m - window.start_m), (0.1, min(0.7, window.sill_m - 0.05))
        _hang(tables, room, window.wall, place_m, half_m=half_m, z_m=z_m, surface=style.trim)


def _hang(
    tables: SceneTables,
    room: Room,
    wall: int,
    place_m: tuple[float, float],
    *,
    half_m: float,
    z_m: tuple[float, float],
    surface: int,
) -> None:
    """Add a flat box at a place along a wall and before it, if it stays in the room and off the camera.

    It is narrower at the wall's end.
    """
    (at_m, from_wall_m), (start, along, inwards) = place_m, wall_frame(room, wall)
    length = float(np.hypot(*(room.walls_m[wall, 2:] - room.walls_m[wall, :2])))
    half_m = min(half_m, at_m, length - at_m)
    if half_m <= _MIN_HALF_WIDTH_M:
        return
    centre = start + along * at_m + inwards * from_wall_m
    footprint = rectangle(centre, along, half_m, _HALF_DEPTH_M)
    is_clear = shapely.distance(footprint, shapely.Point(tables.camera_m)) > CAMERA_CLEARANCE_M
    if is_clear and room.shape.contains(footprint):
        tables.add_box(centre, along, half_m=(half_m, _HALF_DEPTH_M), z_m=z_m, surface=surface)
