"""Furnishing of a room: pieces of the catalogue, placed along walls and on the floor as prisms in the plan frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.floorplan import Room
from lalaloc_core.learn.synth.furniture.built_in import Placed, Stretch, closet_shelves, kitchen, sanitary, wardrobes
from lalaloc_core.learn.synth.furniture.catalogue import ROOM_PIECES, counter, island
from lalaloc_core.learn.synth.furniture.pieces import Finish, Label, Maker, Piece, box, cylinder
from lalaloc_core.learn.synth.homes.openings import Opening

FurnitureLevel = Literal["empty", "simple", "full"]
FURNITURE_LEVELS: tuple[FurnitureLevel, ...] = get_args(FurnitureLevel)

CAMERA_CLEARANCE_M = 0.25
_MAX_PIECES = {"empty": 0, "simple": 3, "full": 24}
_TRIES = 20
_ROOM_IS_FULL_AFTER = 5
_WALL_GAP_M = 0.01
_DOOR_CLEARANCE_M = 0.55
_WORKTOP_M = 0.96
_KITCHEN_CHANCE = {"kitchen": 0.85, "living": 0.3, "dining": 0.2}
_WARDROBE_CHANCE = {"bedroom": 0.4, "corridor": 0.2, "closet": 0.3, "storage": 0.3, "study": 0.2}


# Centres and unit axes of one or several candidate poses.
Pose = tuple[Float[np.ndarray, "*n 2"], Float[np.ndarray, "*n 2"]]


class Prism(NamedTuple):
    """A vertical box or elliptic cylinder in the plan frame (m).

    `half_m` are half extents along the unit vector `axis` and across it, `z_m` are the lower and the upper end.
    """

    centre_m: Float[np.ndarray, "2"]
    axis: Float[np.ndarray, "2"]
    half_m: tuple[float, float]
    z_m: tuple[float, float]
    finish: Finish
    piece: int
    is_round: bool = False
    label: Label = ""


class _Floor:
    """Free floor of a room while it is furnished."""

    def __init__(self, room: Room, openings: Sequence[Opening], keep_clear: Sequence[shapely.Polygon]) -> None:
        self.room = room
        self._shape = room.shape.buffer(1e-6)
        shapely.prepare(self._shape)
        self._taken = list(keep_clear)
        self._windows = [opening for opening in openings if opening.kind == "window"]
        self._openings = openings
        self._start = room.walls_m[:, :2]
        along = room.walls_m[:, 2:] - self._start
        self._length = np.hypot(along[:, 0], along[:, 1])
        self._along = along / self._length[:, None]

    def find(self, piece: Piece, rng: np.random.Generator) -> Pose | None:
        """Find and take a free place for a piece; None if several tries found none."""
        pose = self._along_walls(piece, rng) if piece.against_wall else self._anywhere(rng)
        return None if pose is None else self._take(piece, *pose)

    def fit(self, placed: Placed) -> Pose | None:
        """Take the given place of a piece and return its pose; None if it is not free."""
        axis, wall = self._along[placed.wall], placed.wall
        inwards = np.array([-axis[1], axis[0]])
        from_wall = placed.from_wall_m + 0.5 * placed.piece.depth_m + _WALL_GAP_M
        centre = self._start[wall] + axis * placed.middle_m + inwards * from_wall
        return self._take(placed.piece, centre[None], axis[None])

    def stretches(self) -> tuple[list[Stretch], Float[np.ndarray, "n"]]:
        """Return the stretches of wall without doors and low windows, and the length of every wall."""
        found = []
        for wall, length in enumerate(self._length):
            holes = [opening for opening in self._openings if opening.wall == wall]
            high = [hole for hole in holes if hole.kind == "window" and hole.sill_m > _WORKTOP_M]
            ends = sorted((hole.start_m - 0.1, hole.end_m + 0.1) for hole in holes if hole not in high)
            start = 0.0
            for begin, end in [*ends, (float(length), 0.0)]:
                if begin - start > 0.3:
                    has_window = any(hole.start_m < begin and hole.end_m > start for hole in high)
                    found.append(Stretch(wall, start, begin, has_window))
                start = end
        return found, self._length

    def _take(self, piece: Piece, centre: Float[np.ndarray, "n 2"], axis: Float[np.ndarray, "n 2"]) -> Pose | None:
        """Take the first free pose of several, if any."""
        footprints = _rectangles(centre, axis, 0.5 * piece.width_m - 1e-3, 0.5 * piece.depth_m - 1e-3)
        free = shapely.contains_properly(self._shape, footprints)
        if self._taken:
            free &= ~shapely.intersects(footprints[:, None], np.array(self._taken)[None]).any(axis=1)
        if not free.any():
            return None
        chosen = int(free.argmax())
        self._taken.append(footprints[chosen])
        return centre[chosen], axis[chosen]

    def lay(self, half_a: float, half_b: float, rng: np.random.Generator) -> Pose | None:
        """Return a place for something flat that furniture can stand on."""
        centre, axis = self._anywhere(rng)
        inside = shapely.contains_properly(self._shape, _rectangles(centre, axis, half_a, half_b))
        return (centre[inside.argmax()], axis[inside.argmax()]) if inside.any() else None

    def _along_walls(self, piece: Piece, rng: np.random.Generator) -> Pose | None:
        """Return poses (n, 2) with the back to a wall that is long enough and whose windows stay uncovered."""
        walls = np.flatnonzero(self._length >= piece.width_m)
        if not len(walls):
            return None
        wall = rng.choice(walls, _TRIES)
        # Furniture likes corners.
        share = np.where(rng.random(_TRIES) < 0.5, rng.random(_TRIES), rng.integers(0, 2, _TRIES))
        along_m = share * (self._length[wall] - piece.width_m)
        hides = np.zeros(_TRIES, dtype=bool)
        for window in self._windows:
            if piece.height_m > window.sill_m + 0.15:
                hides |= (wall == window.wall) & (along_m < window.end_m) & (along_m + piece.width_m > window.start_m)
        wall, along_m = wall[~hides], along_m[~hides]
        axis = self._along[wall]
        inwards = np.stack([-axis[:, 1], axis[:, 0]], axis=1)
        from_wall = 0.5 * piece.depth_m + _WALL_GAP_M
        return self._start[wall] + axis * (along_m + 0.5 * piece.width_m)[:, None] + inwards * from_wall, axis

    def _anywhere(self, rng: np.random.Generator) -> Pose:
        """Return poses (n, 2) anywhere on the floor, parallel or perpendicular to a wall."""
        x_min, y_min, x_max, y_max = self.room.shape.bounds
        centre = rng.uniform((x_min, y_min), (x_max, y_max), (_TRIES, 2))
        along = self._along[rng.integers(len(self._along), size=_TRIES)]
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        return centre, np.where(rng.random((_TRIES, 1)) < 0.5, along, across)


def furnish(
    room: Room,
    openings: Sequence[Opening],
    level: FurnitureLevel,
    rng: np.random.Generator,
    camera_m: Float[np.ndarray, "2"] | None = None,
    *,
    built_in: bool = False,
    fitted: bool = False,
) -> list[Prism]:
    """Furnish one room.

    The room's name decides its furniture. The floor before doors and windows above the sill stays free, and everything
    keeps `CAMERA_CLEARANCE_M` away from `camera_m`. `built_in` builds kitchens, bathrooms and wardrobes in where they
    belong, in empty rooms too; `fitted` equips them as in real homes.
    """
    most = _MAX_PIECES[level]
    if most == 0 and not built_in:
        return []
    keep_clear = [_door_zone(room, opening) for opening in openings if opening.kind != "window"]
    if camera_m is not None:
        keep_clear.append(shapely.Point(camera_m).buffer(CAMERA_CLEARANCE_M + 0.01))
    floor = _Floor(room, openings, keep_clear)
    prisms = _build_in(floor, room, rng, fitted=fitted) if built_in else []
    first = 1 + max((prism.piece for prism in prisms), default=-1)
    has_kitchen = any(prism.label == "counter" for prism in prisms)
    placed = refused = 0
    for maker, chance in _wanted(room, level, rng):
        if placed >= most or refused >= _ROOM_IS_FULL_AFTER:
            break
        if rng.random() > chance or (has_kitchen and maker in (counter, island)):
            continue
        piece = maker(rng)
        if piece.height_m > room.ceiling_height_m - 0.02:
            continue
        pose = floor.find(piece, rng)
        if pose is None:
            refused += 1
            continue
        prisms += place(piece, *pose, first + placed)
        placed += 1
    return prisms + (_rugs(floor, rng, first_number=first + placed) if most else [])


def _build_in(floor: _Floor, room: Room, rng: np.random.Generator, *, fitted: bool) -> list[Prism]:
    """Return the built-in furniture of a room; pieces of one kitchen share a number, hence their looks."""
    kind = room.name.split()[0]
    stretches, lengths = floor.stretches()
    groups: list[list[Placed]] = []
    if rng.random() < _KITCHEN_CHANCE.get(kind, 0.0):
        groups.append(kitchen(stretches, lengths, room.ceiling_height_m, rng, fitted=fitted))
    if fitted and kind in ("closet", "storage"):
        groups.append(closet_shelves(stretches, room.ceiling_height_m, rng))
    if rng.random() < _WARDROBE_CHANCE.get(kind, 0.1):
        groups.append(wardrobes(stretches, room.ceiling_height_m, rng))
    prisms: list[Prism] = []
    for number, group in enumerate(groups):
        for placed in group:
            pose = floor.fit(placed)
            if pose is not None:
                prisms += place(placed.piece, *pose, number)
    if kind == "bathroom" and rng.random() < 0.7:
        for number, piece in enumerate(sanitary(rng), start=len(groups)):
            pose = floor.find(piece, rng)
            prisms += place(piece, *pose, number) if pose is not None else []
    return prisms


def place(piece: Piece, centre_m: Float[np.ndarray, "2"], axis: Float[np.ndarray, "2"], number: int) -> list[Prism]:
    """Return the parts of a piece whose width lies along the unit vector `axis`, its back to the right of it."""
    across = np.array([-axis[1], axis[0]])
    return [
        Prism(
            centre_m + axis * part.x + across * part.y,
            axis,
            (part.half_x, part.half_y),
            (part.z0, part.z1),
            part.finish,
            number,
            part.is_round,
            piece.label,
        )
        for part in piece.parts
    ]


def rectangle(centre_m: np.ndarray, axis: np.ndarray, half_a: float, half_b: float) -> shapely.Polygon:
    """Return an oriented rectangle."""
    a, b = axis * half_a, np.array([-axis[1], axis[0]]) * half_b
    return shapely.Polygon([centre_m - a - b, centre_m + a - b, centre_m + a + b, centre_m - a + b])


def _wanted(room: Room, level: FurnitureLevel, rng: np.random.Generator) -> list[tuple[Maker, float]]:
    kind = room.name.split()[0]
    wanted = list(ROOM_PIECES.get(kind, ROOM_PIECES["living"]))
    if level == "simple":
        return [(maker, 0.75 * chance) for maker, chance in wanted]
    # Larger rooms get the catalogue a second and a third time.
    for _ in range(int(room.area_m2 > 12.0) + int(room.area_m2 > 26.0)):
        wanted += [wanted[index] for index in rng.permutation(len(wanted))]
    return [(maker, min(1.0, 1.25 * chance)) for maker, chance in wanted]


def _door_zone(room: Room, opening: Opening) -> shapely.Polygon:
    start, along, inwards = wall_frame(room, opening.wall)
    centre = start + along * 0.5 * (opening.start_m + opening.end_m) + inwards * 0.5 * _DOOR_CLEARANCE_M
    return rectangle(centre, along, 0.5 * (opening.end_m - opening.start_m), 0.5 * _DOOR_CLEARANCE_M)


def wall_frame(room: Room, wall: int) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return (first vertex, unit vector along the wall, unit normal into the room)."""
    x0, y0, x1, y1 = room.walls_m[wall]
    along = np.array([x1 - x0, y1 - y0])
    along /= np.hypot(*along)
    return np.array([x0, y0]), along, np.array([-along[1], along[0]])


def opening_ends_m(room: Room, opening: Opening) -> Float[np.ndarray, "2 2"]:
    """Return the ends of an opening on its wall."""
    start, along, _ = wall_frame(room, opening.wall)
    return start + np.array([[opening.start_m], [opening.end_m]]) * along


def _rugs(floor: _Floor, rng: np.random.Generator, first_number: int) -> list[Prism]:
    prisms = []
    for number in range(int(rng.choice(3, p=[0.5, 0.4, 0.1]))):
        half_a, half_b = rng.uniform(0.25, 1.5), rng.uniform(0.25, 1.0)
        pose = floor.lay(half_a, half_b, rng)
        if pose is not None:
            shape = cylinder if rng.random() < 0.2 else box
            part = shape(at=(0.0, 0.0), half=(half_a, half_b), z=(0.0, 0.012), finish="fabric")
            rug = Piece(2 * half_a, 2 * half_b, (part,), against_wall=False)
            prisms += place(rug, *pose, first_number + number)
    return prisms


def _rectangles(centre_m: np.ndarray, axis: np.ndarray, half_a: float, half_b: float) -> np.ndarray:
    a, b = axis * half_a, np.stack([-axis[:, 1], axis[:, 0]], axis=1) * half_b
    corners = np.stack([centre_m - a - b, centre_m + a - b, centre_m + a + b, centre_m - a + b], axis=1)
    return np.asarray(shapely.polygons(corners))
