"""Placement of furniture along walls or in the middle of rooms, clear of doors and other furniture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, get_args

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from lalaloc_core.learn.heldout import fixtures, seats
from lalaloc_core.learn.heldout.geometry import Part
from lalaloc_core.learn.heldout.grown_plans import HeldoutPlan
from lalaloc_core.learn.heldout.outlines import RoomKind
from lalaloc_core.learn.heldout.seats import Piece
from lalaloc_core.learn.heldout.wall_holes import Opening, Wall, span_behind, walls_of

Level = Literal["empty", "simple", "full"]
LEVELS: tuple[Level, ...] = get_args(Level)
_Maker = Callable[[np.random.Generator], Piece]
# Pieces that each room needs at every level except "empty", and pieces added in "full" rooms.
_NEEDED: Mapping[RoomKind, Sequence[_Maker]] = {
    "living": (seats.sofa, seats.dining_set, fixtures.sideboard),
    "bedroom": (seats.bed, fixtures.wardrobe),
    "kitchen": (fixtures.kitchen_run, fixtures.fridge),
    "bathroom": (fixtures.toilet, fixtures.basin, fixtures.bathtub),
    "corridor": (fixtures.sideboard,),
    "closet": (fixtures.bookcase,),
    "study": (fixtures.desk, fixtures.bookcase),
}
_MORE: Mapping[RoomKind, Sequence[_Maker]] = {
    "living": (
        *(seats.curved_sofa, seats.armchair, seats.armchair, fixtures.bookcase, fixtures.plant, fixtures.plant),
        *(fixtures.floor_lamp, seats.ottoman, seats.bean_bag, fixtures.sideboard, fixtures.kitchen_run),
        *(fixtures.island, fixtures.desk, fixtures.radiator),
    ),
    "bedroom": (
        *(seats.ottoman, seats.ottoman, fixtures.plant, fixtures.floor_lamp, seats.armchair, fixtures.bookcase),
        *(fixtures.desk, seats.bean_bag, fixtures.radiator),
    ),
    "kitchen": (
        *(fixtures.kitchen_run, fixtures.island, seats.dining_set, fixtures.plant),
        *(fixtures.washer, fixtures.bookcase),
    ),
    "bathroom": (fixtures.washer, fixtures.radiator, fixtures.plant, seats.ottoman),
    "corridor": (fixtures.bookcase, fixtures.plant, fixtures.wardrobe, seats.ottoman, fixtures.radiator),
    "closet": (fixtures.bookcase, fixtures.wardrobe, fixtures.washer),
    "study": (
        *(seats.armchair, fixtures.plant, fixtures.bookcase, fixtures.floor_lamp, seats.bean_bag, fixtures.sideboard),
    ),
}
_FREE = (seats.dining_set, fixtures.island, seats.ottoman, seats.bean_bag, seats.armchair, seats.curved_sofa)
_DOORWAY_M = 0.75
_TRIES = 14
_FULLEST_SHARE = 0.5


class Furnishing:
    """Furniture of a home: `parts` with their rooms, and the floor that it covers per room."""

    def __init__(self, plan: HeldoutPlan, openings: Sequence[Opening], level: Level, rng: np.random.Generator) -> None:
        self.parts: list[tuple[int, Part]] = []
        self.taken: list[BaseGeometry] = [shapely.Polygon() for _ in plan.kinds]
        self._doorways = _doorways(openings)
        self._openings = openings
        for index, kind in enumerate(plan.kinds):
            # Each room has its own generator and places needed pieces first, so simple rooms are subsets of full ones.
            room_rng = np.random.default_rng(rng.integers(1 << 62))
            self._hang_lamp(plan, index, room_rng)
            if level == "empty":
                continue
            self._walls = walls_of(plan.plan.rooms[index], index)
            self._shape = plan.plan.rooms[index].shape
            self._inside = self._shape.buffer(-0.005)
            for maker in _NEEDED[kind]:
                self._place(index, maker, room_rng)
            if level == "full":
                self._add_more(plan, index, kind, room_rng)

    def _add_more(self, plan: HeldoutPlan, index: int, kind: RoomKind, rng: np.random.Generator) -> None:
        more = _MORE[kind]
        clutter = rng.uniform(0.4, 1.0)
        for k in rng.permutation(len(more)):
            if rng.random() < clutter and self.taken[index].area < _FULLEST_SHARE * self._shape.area:
                self._place(index, more[k], rng)
        if kind != "closet":
            self._dress_windows(plan, index, rng)
            self._hang_pictures(index, rng)
            if kind in ("living", "bedroom", "study") and rng.random() < 0.6:
                self._lay_rug(index, rng)

    def _place(self, index: int, maker: _Maker, rng: np.random.Generator) -> None:
        """Try several places for a piece; skip it if none fits."""
        piece = maker(rng)
        for attempt in range(_TRIES):
            if attempt == _TRIES // 2:
                # Draw another size.
                piece = maker(rng)
            assert piece.footprint is not None
            free = maker in _FREE and rng.random() < 0.7
            move, turn = self._somewhere(rng) if free else self._at_wall(piece.footprint, rng)
            if move is None:
                continue
            footprint = _set(piece.footprint, move, turn)
            if not self._inside.contains(footprint) or footprint.distance(self.taken[index]) < 0.02:
                continue
            if footprint.intersects(self._doorways):
                continue
            self._add(index, piece, move, turn)
            self.taken[index] = self.taken[index].union(footprint)
            return

    def _somewhere(self, rng: np.random.Generator) -> tuple[np.ndarray, float]:
        x0, y0, x1, y1 = self._shape.bounds
        return rng.uniform((x0, y0), (x1, y1)), rng.uniform(0, 2 * np.pi)

    def _at_wall(self, footprint: BaseGeometry, rng: np.random.Generator) -> tuple[np.ndarray | None, float]:
        left, _, right, _ = footprint.bounds
        roomy = [wall for wall in self._walls if wall.length_m > right - left]
        if not roomy:
            return None, 0.0
        wall = roomy[rng.integers(len(roomy))]
        low, high = -left + 0.01, wall.length_m - right - 0.01
        along_m = rng.choice([low, high, rng.uniform(min(low, high), max(low, high))])
        return wall.point_m(along_m, -rng.uniform(0.012, 0.06)), float(np.arctan2(wall.along[1], wall.along[0]))

    def _add(self, index: int, piece: Piece, move: np.ndarray, turn: float) -> None:
        self.parts += [(index, part.turned(turn).moved(float(move[0]), float(move[1]))) for part in piece.parts]

    def _hang_lamp(self, plan: HeldoutPlan, index: int, rng: np.random.Generator) -> None:
        """Hang a lamp in the middle of each room, at every level."""
        room = plan.plan.rooms[index]
        middle = lamp_place(room.shape)
        drop = float(rng.choice([0.09, 0.35, min(0.7, room.ceiling_height_m - 2.0)], p=[0.4, 0.4, 0.2]))
        parts = fixtures.pendant(rng, room.ceiling_height_m, max(drop, 0.09))
        self.parts += [(index, part.moved(*middle)) for part in parts]

    def _dress_windows(self, plan: HeldoutPlan, index: int, rng: np.random.Generator) -> None:
        if rng.random() < 0.35:
            return
        for opening in self._openings:
            if opening.kind != "window" or opening.wall.room != index:
                continue
            wall, top = opening.wall, min(opening.top_m + 0.15, plan.plan.rooms[index].ceiling_height_m - 0.02)
            turn = float(np.arctan2(wall.along[1], wall.along[0]))
            wide = rng.uniform(0.2, 0.55)
            for x in (max(0.02, opening.left_m - 0.2), min(opening.right_m + 0.2, wall.length_m - 0.02) - wide):
                place = wall.point_m(x)
                self.parts.append((index, fixtures.curtain(rng, wide, top).turned(turn).moved(*place)))

    def _hang_pictures(self, index: int, rng: np.random.Generator) -> None:
        for wall in self._walls:
            if wall.length_m > 1.2 and rng.random() < 0.45:
                along_m = rng.uniform(0.5, wall.length_m - 0.5)
                spans = [(o.left_m, o.right_m) for o in self._openings if _same(o.wall, wall)]
                spans += [span_behind(o) for o in self._openings if o.behind is not None and _same(o.behind, wall)]
                if all(along_m + 0.6 < low or along_m - 0.6 > high for low, high in spans):
                    turn = float(np.arctan2(wall.along[1], wall.along[0]))
                    self._add(index, fixtures.picture(rng), wall.point_m(along_m), turn)

    def _lay_rug(self, index: int, rng: np.random.Generator) -> None:
        middle = np.array(shapely.maximum_inscribed_circle(self._shape, 0.05).coords[0])
        radius = self._shape.exterior.distance(shapely.Point(middle))
        rug = fixtures.rug(rng)
        span = max(abs(b) for part in rug.parts for b in part.vertices_m[:, :2].ravel())
        shrink = min(1.0, 0.65 * radius / span)
        rug = Piece(tuple(part.scaled(shrink, shrink, 1.0) for part in rug.parts), None)
        self._add(index, rug, middle, rng.uniform(0, 6.28))


def lamp_place(shape: shapely.Polygon) -> np.ndarray:
    """Return the position of a room's lamp: the middle of its widest part."""
    return np.array(shapely.maximum_inscribed_circle(shape, 0.05).coords[0])


def _same(first: Wall, second: Wall) -> bool:
    return (first.room, first.edge) == (second.room, second.edge)


def _set(footprint: BaseGeometry, move: np.ndarray, turn: float) -> BaseGeometry:
    return affinity.translate(affinity.rotate(footprint, turn, origin=(0, 0), use_radians=True), *move)


def _doorways(openings: Sequence[Opening]) -> BaseGeometry:
    """Return the floor that doors and their leaves need."""
    ways = []
    for o in openings:
        if o.kind == "window" and o.sill_m > 0.3:
            continue
        reach = _DOORWAY_M if o.kind != "window" else 0.15
        near = o.right_m - o.left_m if o.kind == "open door" else reach
        ways.append(
            shapely.Polygon(
                [
                    o.wall.point_m(a, d)
                    for a, d in (
                        (o.left_m, -near),
                        (o.right_m, -near),
                        (o.right_m, o.depth_m + reach),
                        (o.left_m, o.depth_m + reach),
                    )
                ]
            )
        )
        if o.kind == "open door":
            hinge = shapely.Point(o.wall.point_m(o.left_m))
            ways.append(hinge.buffer(o.right_m - o.left_m))
    return shapely.union_all(ways)
