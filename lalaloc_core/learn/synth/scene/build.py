"""Construction of a shot's scene: its parts, and the order in which they are drawn."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from lalaloc_core.floorplan import Room
from lalaloc_core.learn.synth.camera import sample_exposure, sample_staged_exposure
from lalaloc_core.learn.synth.furniture.furnish import FurnitureLevel, furnish
from lalaloc_core.learn.synth.furniture.pieces import Finish
from lalaloc_core.learn.synth.homes.openings import Opening
from lalaloc_core.learn.synth.records import Row
from lalaloc_core.learn.synth.scene import shells
from lalaloc_core.learn.synth.scene.doors import add_door
from lalaloc_core.learn.synth.scene.lighting import Lighting, light_room, relit, sample_backdrop
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.render_scene import Fact, Lights, Prisms, RenderScene, SceneTables, VisibleRooms
from lalaloc_core.learn.synth.scene.shots import Shot
from lalaloc_core.learn.synth.scene.surfaces import HouseStyle, SurfaceTable, sample_style


def build_scene(shot: Shot, materials: MaterialLibrary) -> RenderScene:
    """Build the scene of a shot; the shot's seed determines everything random."""
    scene = _Builder(shot, materials).build()
    return scene if shot.lighting is None else relit(scene, shot.lighting)


class _Builder:
    """Builds one scene, once: the random draws of a part depend on the parts before it."""

    def __init__(self, shot: Shot, materials: MaterialLibrary) -> None:
        self._shot, self._home = shot, shot.home
        self._room = shot.home.plan.rooms[shot.room_index]
        self._openings = self._openings_of(shot.room_index)
        seen = [opening.neighbour for opening in self._openings if opening.is_see_through]
        self._slot_rooms = [shot.room_index, *dict.fromkeys(seen)]
        self._streams = shells.Streams(shot.seed, is_staged=shot.lighting is not None)
        self._rng = self._streams.shapes
        self._is_bare = shot.furniture == "empty"
        # Homes for sale: bare, pale, in daylight.
        self._is_bright = self._is_bare and not self._streams.is_staged and self._rng.random() < 0.6
        surfaces = SurfaceTable(materials, self._streams.materials)
        self._tables = SceneTables(shot.position_m, surfaces)
        self._style = sample_style(surfaces, self._rng)
        if shot.is_night:
            surfaces.darken_outdoors(self._style.outdoors)
        self._shells = shells.Shells(
            self._tables, self._style, self._streams, is_bright=self._is_bright, is_bare=self._is_bare
        )
        self._facts: set[Fact] = set()

    def build(self) -> RenderScene:
        streams, tables, rng = self._streams, self._tables, self._rng
        streams.begin(shells.ScenePart.MOOD)
        lighting = Lighting(rng, neutral=streams.is_staged, bright=self._is_bright)
        if self._shot.is_night:
            lighting.daylight, lighting.lamps_on = 0.0, True
        self._add_room(0, self._shot.room_index, lighting)
        in_room = list(tables.prisms)
        for slot, room_index in enumerate(self._slot_rooms[1:], start=1):
            self._add_room(slot, room_index, lighting)
        streams.begin(shells.ScenePart.LAMPS, self._shot.room_index)
        lights, lamps, sun = light_room(self._room, self._openings, tables.camera_m, lighting, rng)
        before_lamps = len(tables.prisms)
        for lamp in lamps:
            tables.add_prism(lamp, tables.surfaces.add_finish(lamp.finish), opaque=False)
        if not streams.is_staged:
            mirror = sample_mirror(self._room, self._openings, rng, is_bare=self._is_bare)
            if mirror is not None:
                self._facts.add("mirror")
                in_room += tables.prisms[before_lamps:]
                add_mirror(tables, self._style, mirror, room=self._room, prisms=in_room, lights=lights, rng=rng)
        tables.add_jambs()
        if self._is_bright and any(opening.kind == "window" for opening in self._openings):
            self._facts.add("bare_bright")
        streams.begin(shells.ScenePart.CAMERA, self._shot.room_index)
        backdrop = sample_backdrop(rng)
        exposure = sample_staged_exposure(rng) if streams.is_staged else sample_exposure(rng, bright=self._is_bright)
        return tables.to_scene(
            self._shot.camera_height_m,
            self._shot.heading,
            lights=lights,
            sun=sun,
            backdrop=backdrop,
            exposure=exposure,
            facts=self._facts,
        )

    def _openings_of(self, room_index: int) -> list[Opening]:
        return [opening for opening in self._home.openings if opening.room == room_index]

    def _add_room(self, slot: int, room_index: int, lighting: Lighting) -> None:
        first = self._shells.add(slot, room_index, self._home.plan.rooms[room_index], lighting)
        for opening in self._openings_of(room_index):
            self._add_opening(first + opening.wall, opening, is_own=slot == 0)
        self._furnish(room_index, is_own=slot == 0)
        if slot == 0 and self._shot.is_fitted:
            self._lower_ceiling()

    def _lower_ceiling(self) -> None:
        tables = self._tables
        surfaces: dict[Finish, int] = {"paint": int(VisibleRooms.stacked(tables.rooms).ceiling_surface[0])}
        for box in shells.ceiling_boxes(self._room, self._openings, self._shot.camera_height_m, self._rng):
            if box.finish not in surfaces:
                surfaces[box.finish] = tables.surfaces.add_finish(box.finish)
            tables.add_prism(box, surfaces[box.finish])

    def _add_opening(self, wall: int, opening: Opening, *, is_own: bool) -> None:
        """Add a window, or a door that is see-through in the camera's own room."""
        tables, style, rng = self._tables, self._style, self._rng
        number = self._home.openings.index(opening)
        self._streams.begin(shells.ScenePart.OPENING, number)
        if opening.kind != "window":
            slot_behind = self._slot_rooms.index(opening.neighbour) if is_own and opening.is_see_through else None
            add_door(tables, style, self._home, opening, wall=wall, slot_behind=slot_behind, rng=rng)
            return
        shells.add_window(tables, style, wall, opening, rng)
        if is_own:
            shells.add_curtains(tables, self._room, opening, rng, is_bare=self._is_bare)
            self._streams.begin(shells.ScenePart.RADIATOR, number)
            shells.add_radiator(tables, style, self._room, opening, rng)

    def _furnish(self, room_index: int, *, is_own: bool) -> None:
        self._streams.begin(shells.ScenePart.FURNITURE, room_index)
        level: FurnitureLevel = self._shot.furniture if is_own or self._is_bare else "simple"
        camera = self._tables.camera_m if is_own else None
        # The empty rooms of a staged home are bare; others keep what is built in.
        built_in = not (self._streams.is_staged and level == "empty")
        room, openings = self._home.plan.rooms[room_index], self._openings_of(room_index)
        pieces = furnish(room, openings, level, self._rng, camera, built_in=built_in, fitted=self._shot.is_fitted)
        if is_own:
            self._facts |= {prism.label for prism in pieces if prism.label}
        self._tables.add_pieces(pieces)


# Probability of a large mirror by kind of room.
_CHANCE = {"bathroom": 0.4, "corridor": 0.22, "bedroom": 0.25, "living": 0.15, "dining": 0.12, "closet": 0.12}
_OTHERS = 0.05
_BARE_SHARE = 0.4
_CLEARANCE_M = 0.15
_MIN_WIDTH_M = 0.35
_DEPTH_M = 0.004


# Place of a mirror: wall, start and end along it, lower and upper edge (m).
Mirror = tuple[int, tuple[float, float], tuple[float, float]]


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
            return int(wall), (start, start + width), (low, high)
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
    wall, (s0, s1), (z0, z1) = mirror
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
