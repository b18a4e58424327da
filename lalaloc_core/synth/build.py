"""Building a shot's scene: dressing the walls, hanging doors and curtains, furnishing, lighting."""

from __future__ import annotations

import math

import numpy as np
import shapely

from lalaloc_core.floorplan import Room
from lalaloc_core.synth.exposure import draw_exposure, draw_staged_exposure
from lalaloc_core.synth.furniture import CAMERA_CLEARANCE_M, FurnitureLevel, Prism, furnish, rectangle, wall_frame
from lalaloc_core.synth.leaves import boards, hang_leaves
from lalaloc_core.synth.lighting import (
    Lighting,
    draw_backdrop,
    light_room,
    relit,
)
from lalaloc_core.synth.materials import MaterialLibrary
from lalaloc_core.synth.mirrors import Reflection, draw_mirror
from lalaloc_core.synth.openings import Opening
from lalaloc_core.synth.scene import LIGHT_RGB, LIGHT_XYZ, SLOT_AMBIENT, SLOT_LIGHT_RGB, SLOT_LIGHT_XYZ, Fact, Scene
from lalaloc_core.synth.shots import Shot
from lalaloc_core.synth.surfaces import SurfaceTable, bright, paint, pale, vivid, wood_tone

_DEFAULT_WALL_DEPTH_M = 0.12
_MIRROR_DEPTH_M = 0.004

# Parts of a staged scene that draw from streams of their own.
_MOOD, _ROOM, _FLOOR, _ACCENT, _TRIM, _OPENING, _RADIATOR, _FURNITURE, _LAMPS, _CAMERA, _MATERIALS = range(11)


def build_scene(shot: Shot, materials: MaterialLibrary) -> Scene:
    """The scene that a shot sees, everything that is random about it drawn from the shot's seed."""
    scene = _Builder(shot, materials, np.random.default_rng(shot.seed)).build()
    return scene if shot.lighting is None else relit(scene, shot.lighting)


class _Builder:
    """Collects the tables of one scene."""

    def __init__(self, shot: Shot, materials: MaterialLibrary, rng: np.random.Generator) -> None:
        home, room_index = shot.home, shot.room_index
        self.shot, self.home, self.rng = shot, home, rng
        self.level: FurnitureLevel = shot.furniture
        self.is_staged = shot.lighting is not None
        # Homes for sale: bare, pale, in daylight.
        self.is_bright = self.level == "empty" and not self.is_staged and rng.random() < 0.6
        self.position = shot.position_m
        self.room = home.plan.rooms[room_index]
        self.openings = [opening for opening in home.openings if opening.room == room_index]
        see_through = [o.neighbour for o in self.openings if o.kind in ("door_open", "opening") and o.neighbour >= 0]
        self.slot_rooms = [room_index, *dict.fromkeys(see_through)]
        # Materials have a stream of their own: shapes must not depend on what pictures there are.
        self.table_rng = np.random.default_rng([shot.seed, _MATERIALS])
        self.table = SurfaceTable(materials, materials.mean_colours, self.table_rng)
        self.walls: list[np.ndarray] = []
        self.owner: list[int] = []
        self.wall_surface: list[int] = []
        self.decals: list[tuple[float, ...]] = []
        self.prisms: list[tuple[float, ...]] = []
        self.slots: list[list[float]] = []
        self.facts: set[Fact] = set()
        # One house style: all doors and trims look alike.
        self.trim = self.table.add_plain(bright(rng) if rng.random() < 0.7 else wood_tone(rng))
        colour = self._door_colour()
        plain = rng.random() < 0.6
        self.door = self.table.add_plain(colour) if plain else self.table.add("furniture", colour, scale=0.8)
        self.door_panel = self.table.add_plain(np.clip(colour * rng.uniform(0.75, 1.15), 0.01, 0.92))
        self.handle = self.table.add_finish("metal")
        self.outdoors = self.table.add_outdoors(math.exp(rng.uniform(0.3, 2.3)))
        # What lies behind the doors of rooms that are seen through doors, and behind panes.
        self.gloom = self.table.add_plain(paint(rng) * math.exp(rng.uniform(math.log(0.08), 0.0)))
        self.doors_are_glazed = rng.random() < 0.12
        self.baseboard_m = rng.uniform(0.04, 0.14) if rng.random() < 0.8 else 0.0
        self.crown_m = rng.uniform(0.03, 0.12) if rng.random() < 0.2 else 0.0
        self.floor_surface = -1

    def build(self) -> Scene:
        self._begin(_MOOD)
        lighting = Lighting(self.rng, neutral=self.is_staged, bright=self.is_bright)
        in_room: list[tuple[float, ...]] = []
        for slot, room_index in enumerate(self.slot_rooms):
            self._add_room(slot, room_index, lighting)
            if slot == 0:
                in_room = list(self.prisms)
        self._begin(_LAMPS, self.shot.room_index)
        lights, lamps, sun = light_room(self.room, self.openings, self.position, lighting, self.rng)
        for prism in lamps:
            self._add_prism(prism, opaque=False)
        if not self.is_staged:
            self._add_mirror(in_room + self.prisms[len(self.prisms) - len(lamps) :], lights)
        self._add_jambs()
        if self.is_bright and any(opening.kind == "window" for opening in self.openings):
            self.facts.add("bare_bright")
        self._begin(_CAMERA, self.shot.room_index)
        return Scene(
            camera_height_m=self.shot.camera_height_m,
            heading=self.shot.heading,
            walls_m=np.array(self.walls) - np.tile(self.position, 2),
            wall_owner=np.array(self.owner),
            wall_surface=np.array(self.wall_surface),
            decals=np.array(self.decals, dtype=float).reshape(-1, 8),
            prisms=np.array(self.prisms, dtype=float).reshape(-1, 11),
            surfaces=np.array(self.table.rows),
            slots=np.array(self.slots),
            lights=lights,
            sun=sun,
            backdrop=draw_backdrop(self.rng),
            exposure=draw_staged_exposure(self.rng)
            if self.is_staged
            else draw_exposure(self.rng, bright=self.is_bright),
            facts=frozenset(self.facts),
        )

    def _begin(self, part: int, *which: int) -> None:
        """In a staged scene what a part draws must not depend on what was drawn before it: furniture, for one."""
        if self.is_staged:
            for stream, number in ((self.rng, ()), (self.table_rng, (_MATERIALS,))):
                fresh = np.random.default_rng([self.shot.seed, part, *which, *number])
                stream.bit_generator.state = fresh.bit_generator.state

    def _door_colour(self) -> np.ndarray:
        kind = self.rng.random()
        if kind < 0.55:
            return bright(self.rng)
        return wood_tone(self.rng) if kind < 0.9 else vivid(self.rng)

    def _add_room(self, slot: int, room_index: int, lighting: Lighting) -> None:
        rng, room = self.rng, self.home.plan.rooms[room_index]
        self._begin(_ROOM, room_index)
        colour = pale(rng) if self.is_bright else paint(rng)
        wall = self.table.add_plain(colour) if self.is_bright else self.table.add_wall(colour)
        accent = self.table.add_wall(paint(rng)) if rng.random() < (0.08 if self.is_bright else 0.25) else wall
        ceiling_colour = colour * rng.uniform(0.85, 1.1) if rng.random() < 0.2 else bright(rng)
        ceiling = self.table.add_ceiling(np.clip(ceiling_colour, 0.01, 0.92))
        if self._has_new_floor(room_index):
            _, along, _ = wall_frame(room, 0)
            self.floor_surface = self.table.add_floor(colour, math.atan2(along[1], along[0]), plain=self.is_bright)
        self._begin(_ACCENT, room_index)
        self.slots.append(
            [room.ceiling_height_m, self.floor_surface, ceiling, *lighting.of_room_beyond(room, self.position)]
        )
        accented = int(rng.integers(len(room.walls_m)))
        first = len(self.walls)
        self._begin(_TRIM, room_index)
        for edge, ends in enumerate(room.walls_m):
            self.walls.append(ends)
            self.owner.append(slot)
            self.wall_surface.append(accent if edge == accented else wall)
            self._add_wall_trim(first + edge, ends, room)
        openings = [opening for opening in self.home.openings if opening.room == room_index]
        for opening in openings:
            self._begin(_OPENING, self.home.openings.index(opening))
            self._add_opening(first + opening.wall, room, opening, is_own=slot == 0)
        level: FurnitureLevel = self.level if slot == 0 or self.level == "empty" else "simple"
        camera = self.position if slot == 0 else None
        self._begin(_FURNITURE, room_index)
        # The empty rooms of a staged home are bare; others keep what is built in.
        fitted = not (self.is_staged and level == "empty")
        pieces = furnish(room, openings, level, rng, camera, fitted=fitted)
        if slot == 0:
            self.facts |= {prism.label for prism in pieces if prism.label}
        self._add_pieces(pieces)

    def _has_new_floor(self, room_index: int) -> bool:
        """Whether a floor begins here; many homes have one floor throughout."""
        if not self.is_staged:
            return self.floor_surface < 0 or self.rng.random() < 0.4
        # Every room draws its floor, those without one of their own all the same: so it looks alike from any room.
        self._begin(_FLOOR, *([room_index] if self.rng.random() < 0.4 else []))
        return True

    def _add_pieces(self, prisms: list[Prism]) -> None:
        known: dict[tuple[int, str], int] = {}
        for prism in prisms:
            key = (prism.piece, prism.finish)
            if key not in known:
                known[key] = self.table.add_finish(prism.finish)
            self._add_prism(prism, opaque=prism.finish != "glow", surface=known[key])

    def _add_prism(self, prism: Prism, *, opaque: bool = True, surface: int | None = None) -> None:
        row = self.table.add_finish(prism.finish) if surface is None else surface
        x, y = self.position
        values = (
            *(prism.x - x, prism.y - y, prism.axis_x, prism.axis_y, prism.half_a, prism.half_b, prism.z0, prism.z1),
            *(prism.round, row, opaque),
        )
        self.prisms.append(tuple(float(value) for value in values))

    def _decal(
        self, wall: int, s0: float, s1: float, z0: float, z1: float, surface: int, slot: int = -1, depth: float = 0.0
    ) -> None:
        self.decals.append((wall, s0, s1, z0, z1, surface, slot, depth))

    def _add_wall_trim(self, wall: int, ends: np.ndarray, room: Room) -> None:
        """Baseboard, crown moulding, pictures and switches."""
        rng, ceiling = self.rng, room.ceiling_height_m
        length = float(np.hypot(*(ends[2:] - ends[:2])))
        if self.baseboard_m > 0.0:
            self._decal(wall, -1.0, length + 1.0, -1.0, self.baseboard_m, self.trim)
        if self.crown_m > 0.0:
            self._decal(wall, -1.0, length + 1.0, ceiling - self.crown_m, ceiling + 1.0, self.trim)
        if self.level == "empty" and rng.random() < 0.8:
            return
        if length > 1.0 and rng.random() < 0.45:
            half_width, half_height = rng.uniform(0.12, 0.6), rng.uniform(0.12, 0.5)
            if 2 * half_width < length - 0.2:
                s = rng.uniform(half_width + 0.1, length - half_width - 0.1)
                z = rng.uniform(1.35, 1.7)
                frame = self.table.add_finish("dark")
                is_screen = rng.random() < 0.15
                picture = frame if is_screen else self.table.add("furniture", vivid(rng), scale=0.7)
                self._decal(wall, s - half_width, s + half_width, z - half_height, z + half_height, frame)
                inset = rng.uniform(0.015, 0.05)
                self._decal(
                    wall,
                    s - half_width + inset,
                    s + half_width - inset,
                    z - half_height + inset,
                    z + half_height - inset,
                    picture,
                )
        if length > 0.5 and rng.random() < 0.5:
            s, z = rng.uniform(0.1, length - 0.1), float(rng.choice([0.25, 1.1]))
            self._decal(wall, s - 0.04, s + 0.04, z - 0.04, z + 0.04, self.trim)

    def _add_opening(self, wall: int, room: Room, opening: Opening, is_own: bool) -> None:
        s0, s1, z0, z1 = opening.start_m, opening.end_m, opening.sill_m, opening.head_m
        if opening.kind == "window":
            self._add_window(wall, s0, s1, z0, z1)
            if is_own:
                self._add_curtains(room, opening)
            return
        framed = opening.kind != "opening" or (z1 < room.ceiling_height_m - 0.15 and self.rng.random() < 0.3)
        if framed:
            border = self.rng.uniform(0.04, 0.1)
            self._decal(wall, s0 - border, s1 + border, 0.0, z1 + border, self.trim)
        see_through = is_own and opening.kind in ("door_open", "opening") and opening.neighbour >= 0
        if see_through:
            slot = self.slot_rooms.index(opening.neighbour)
            depth = self._hole_depth(opening)
            surface = self.trim if framed else self.wall_surface[wall]
            self._decal(wall, s0, s1, -1.0, z1, surface, slot, depth)
            self._add_threshold(room, opening, depth)
            if opening.kind == "door_open":
                self._add_door_leaves(room, opening, depth)
        elif opening.kind == "door_shut" or (opening.kind == "door_open" and self.rng.random() < 0.5):
            self._add_shut_door(wall, s0, s1, z1)
        else:
            self._decal(wall, s0, s1, -1.0, z1, self.gloom)

    def _hole_depth(self, opening: Opening) -> float:
        """Distance to the facing wall of the room behind."""
        start, along, inwards = wall_frame(self.room, opening.wall)
        middle = start + along * 0.5 * (opening.start_m + opening.end_m)
        ray = shapely.LineString([middle, middle - inwards])
        shape = self.home.plan.rooms[opening.neighbour].shape
        depth = float(shapely.distance(shapely.Point(middle), shapely.intersection(ray, shape)))
        return depth if 0.0 < depth < 0.6 else _DEFAULT_WALL_DEPTH_M

    def _add_window(self, wall: int, s0: float, s1: float, z0: float, z1: float) -> None:
        rng, border = self.rng, self.rng.uniform(0.04, 0.09)
        self._decal(wall, s0 - 0.03, s1 + 0.03, z0 - 0.03, z1 + 0.03, self.trim)
        # The leaf of a French window has a broad rail at its foot.
        rail = rng.uniform(0.1, 0.35) if z0 < 0.1 and rng.random() < 0.5 else border
        self._decal(wall, s0 + border, s1 - border, z0 + rail, z1 - border, self.outdoors)
        sashes = max(1, round((s1 - s0) / rng.uniform(0.6, 1.4)))
        for k in range(1, sashes):
            s = s0 + (s1 - s0) * k / sashes
            self._decal(wall, s - 0.6 * border, s + 0.6 * border, z0, z1, self.trim)
        if rng.random() < 0.2:
            z = rng.uniform(0.4, 0.7) * (z1 - z0) + z0
            self._decal(wall, s0, s1, z - 0.02, z + 0.02, self.trim)
        if rng.random() < 0.15:
            # A roller blind.
            blind = self.table.add("furniture", bright(rng), glow=rng.uniform(0.4, 1.2))
            self._decal(wall, s0, s1, z1 - rng.uniform(0.2, 0.9) * (z1 - z0), z1, blind)
        elif rng.random() < 0.08:
            # A sheer curtain before the whole window.
            sheer = self.table.add("furniture", bright(rng), scale=rng.uniform(1.0, 3.0), glow=rng.uniform(0.3, 1.0))
            self._decal(wall, s0 - 0.15, s1 + 0.15, 0.04 if rng.random() < 0.6 else z0 - 0.05, z1 + 0.1, sheer)

    def _add_shut_door(self, wall: int, s0: float, s1: float, z1: float) -> None:
        rng, double = self.rng, s1 - s0 > 1.15
        self._decal(wall, s0, s1, -1.0, z1, self.door)
        leaves = [(s0, 0.5 * (s0 + s1)), (0.5 * (s0 + s1), s1)] if double else [(s0, s1)]
        panels = int(rng.integers(0, 4))
        panel = self.gloom if self.doors_are_glazed else self.door_panel
        for a, b in leaves:
            for k in range(panels):
                low, high = 0.15 + k * (z1 - 0.25) / panels, 0.05 + (k + 1) * (z1 - 0.25) / panels
                self._decal(wall, a + 0.12, b - 0.12, low, high, panel)
        s = 0.5 * (s0 + s1) - 0.08 if double else (s1 - 0.08 if rng.random() < 0.5 else s0 + 0.08)
        self._decal(wall, s - 0.05, s + 0.05, 1.0, 1.04, self.handle)
        if double:
            self._decal(wall, 0.5 * (s0 + s1) - 0.006, 0.5 * (s0 + s1) + 0.006, 0.0, z1, self.gloom)

    def _add_door_leaves(self, room: Room, opening: Opening, depth: float) -> None:
        neighbour = self.home.plan.rooms[opening.neighbour]
        for leaf in hang_leaves(opening, room, neighbour, depth, self.position, self.rng):
            for board in boards(leaf.half_width_m, opening.head_m, glazed=self.doors_are_glazed):
                centre = leaf.centre_m + leaf.axis * board.along_m
                self._add_box(centre, leaf.axis, board.half_a, board.half_b, board.z0, board.z1, self.door)
            knob = leaf.centre_m + leaf.axis * 0.8 * leaf.half_width_m
            self._add_box(knob, leaf.axis, 0.06, 0.06, 1.0, 1.03, self.handle)

    def _add_threshold(self, room: Room, opening: Opening, depth: float) -> None:
        """At times a strip in the doorway."""
        if self.rng.random() > 0.2:
            return
        start, along, inwards = wall_frame(room, opening.wall)
        centre = start + along * 0.5 * (opening.start_m + opening.end_m) - inwards * 0.5 * depth
        surface = self.trim if self.rng.random() < 0.5 else self.handle
        half = 0.5 * (opening.end_m - opening.start_m)
        self._add_box(centre, along, half, 0.5 * depth, 0.0, self.rng.uniform(0.006, 0.025), surface)

    def _add_box(
        self, centre: np.ndarray, axis: np.ndarray, a: float, b: float, z0: float, z1: float, surface: int
    ) -> None:
        x, y = float(centre[0]), float(centre[1])
        prism = Prism(x, y, float(axis[0]), float(axis[1]), a, b, z0, z1, "wood", -1, False)
        self._add_prism(prism, surface=surface)

    def _add_curtains(self, room: Room, opening: Opening) -> None:
        """Curtains beside a window, and a radiator below it."""
        rng = self.rng
        start, along, inwards = wall_frame(room, opening.wall)
        length = float(np.hypot(*(room.walls_m[opening.wall, 2:] - room.walls_m[opening.wall, :2])))
        boxes = []
        if rng.random() < (0.1 if self.level == "empty" else 0.45):
            cloth = self.table.add("furniture", np.clip(paint(rng), 0.03, 0.85), scale=rng.uniform(1.5, 4.0))
            width, top = rng.uniform(0.15, 0.6), min(opening.head_m + 0.15, room.ceiling_height_m - 0.01)
            bottom = 0.03 if rng.random() < 0.7 else max(0.03, opening.sill_m - 0.1)
            for s in (opening.start_m, opening.end_m):
                boxes.append((s, 0.5 * width, 0.05, 0.07, bottom, top, cloth))
        self._begin(_RADIATOR, self.home.openings.index(opening))
        if opening.sill_m > 0.45 and rng.random() < 0.35:
            middle, half = 0.5 * (opening.start_m + opening.end_m), 0.4 * (opening.end_m - opening.start_m)
            boxes.append((middle, half, 0.05, 0.06, 0.1, min(0.7, opening.sill_m - 0.05), self.trim))
        for s, half, depth, away, z0, z1, surface in boxes:
            half = min(half, s, length - s)
            centre = start + along * s + inwards * away
            footprint = rectangle(centre, along, half, depth) if half > 0.02 else None
            if footprint is None or not room.shape.contains(footprint):
                continue
            if shapely.distance(footprint, shapely.Point(self.position)) > CAMERA_CLEARANCE_M:
                self._add_box(centre, along, half, depth, z0, z1, surface)

    def _add_mirror(self, prisms: list[tuple[float, ...]], lights: np.ndarray) -> None:
        """A mirror on a wall of the own room, behind which the room is built once more, reflected."""
        drawn = draw_mirror(self.room, self.openings, self.rng, is_bare=self.level == "empty")
        if drawn is None:
            return
        wall, s0, s1, z0, z1 = drawn
        self.facts.add("mirror")
        reflection, count, slot = Reflection(self.walls[wall]), len(self.room.walls_m), len(self.slots)
        relative = Reflection(self.walls[wall] - np.tile(self.position, 2))
        own = np.array(self.slots[0], dtype=float)
        if len(lights):
            brightest = lights[lights[:, LIGHT_RGB].sum(axis=1).argmax()]
            x, y, z = brightest[LIGHT_XYZ]
            own[SLOT_LIGHT_XYZ] = [*relative.point(np.array([x, y])), z]
            own[SLOT_LIGHT_RGB] = brightest[LIGHT_RGB]
        own[SLOT_AMBIENT] = self.slots[0][SLOT_AMBIENT]
        self.slots.append(list(own))
        first = len(self.walls)
        for edge in range(count):
            self.walls.append(reflection.wall(self.walls[edge]))
            self.owner.append(slot)
            self.wall_surface.append(self.wall_surface[edge])
        for on, a, b, low, high, surface, behind, _ in [decal for decal in self.decals if decal[0] < count]:
            ends = self.walls[int(on)]
            length = float(np.hypot(*(ends[2:] - ends[:2])))
            seen = self.gloom if behind >= 0 else int(surface)
            self._decal(first + int(on), length - b, length - a, low, high, seen)
        self.prisms += [tuple(relative.prism(np.array(prism, dtype=float)).tolist()) for prism in prisms]
        if self.rng.random() < 0.6:
            border = self.rng.uniform(0.02, 0.08)
            frame = self.table.add_finish("wood")
            self._decal(wall, s0 - border, s1 + border, z0 - border, z1 + border, frame)
        self._decal(wall, s0, s1, z0, z1, self.handle, slot, _MIRROR_DEPTH_M)

    def _add_jambs(self) -> None:
        """The cheeks of every hole: walls from one room to the next."""
        for index, decal in enumerate(self.decals):
            wall, s0, s1, _, _, surface, slot, depth = decal
            if slot < 0:
                continue
            ends = self.walls[int(wall)]
            along = (ends[2:] - ends[:2]) / np.hypot(*(ends[2:] - ends[:2]))
            outward = np.array([along[1], -along[0]])
            for s in (s0, s1):
                near = ends[:2] + along * s
                # Reaching back into the room a little closes the gap that rounding may leave.
                self.walls.append(np.concatenate([near - outward * 1e-4, near + outward * (depth + 1e-4)]))
                self.owner.append(-1 - index)
                self.wall_surface.append(int(surface))
