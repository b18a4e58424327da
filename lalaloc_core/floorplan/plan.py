"""The floor plan: rooms as simple polygons in the plan frame (metres), each extruded to its own ceiling.

Rooms can have holes and free-standing walls. Openings are parts of walls: the wall profile treats them as wall.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float, Int

from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES, heading_to_degrees
from lalaloc_core.floorplan.earth import MAX_FROM_ORIGIN_M, Anchor, anchor_document
from lalaloc_core.floorplan.geometry import WallTable, pad_walls
from lalaloc_core.floorplan.json_values import DEFAULT_LIMITS, NO_LIMITS, PlanLimits, read_json
from lalaloc_core.floorplan.openings import DEFAULT_OPENING_TOLERANCE_M, Opening, OpeningFace
from lalaloc_core.floorplan.plan_document import DEFAULT_CAMERA_HEIGHT_M, Fixture, FixturePlaces, read_plan, state_types
from lalaloc_core.floorplan.room_types import type_fields
from lalaloc_core.floorplan.rooms import Room, frozen

# Plans with more rooms use a spatial index to find the room of a position.
_FEW_ROOMS = 32
# Directions of walls, one for each degree of a quarter turn.
_DIRECTIONS = 90


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """A validated floor plan; build one with `FloorPlan.from_dict` or `FloorPlan.from_json`.

    Attributes:
        camera_height_m: height of the camera assumed for photographs of this plan.
        warnings: problems that do not prevent use, such as overlapping rooms.
        north: azimuth of true north (radians), None if unknown.
        opening_trust: probability by kind that an opening that exists is drawn; kinds that are left out have 0.
        room_trust: the same for each room of a merged plan; empty if `opening_trust` holds for all rooms.
        opening_tolerance_m: maximum distance between an opening's line and its wall.
        opening_faces: the parts of walls that openings occupy.
        camera_height_std_m: standard deviation of `camera_height_m`; None if the plan does not give one.
        states_camera_height: True if the plan gives `camera_height_m`; otherwise the height is estimated per query.
        ceiling_height_m: ceiling height of rooms without their own; None if the plan gives none and it is assumed.
    """

    name: str
    rooms: tuple[Room, ...]
    camera_height_m: float = DEFAULT_CAMERA_HEIGHT_M
    warnings: tuple[str, ...] = ()
    north: float | None = None
    openings: tuple[Opening, ...] = ()
    opening_trust: Mapping[str, float] = field(default_factory=dict)
    room_trust: tuple[Mapping[str, float], ...] = ()
    opening_tolerance_m: float = DEFAULT_OPENING_TOLERANCE_M
    opening_faces: tuple[OpeningFace, ...] = ()
    camera_height_std_m: float | None = None
    states_camera_height: bool = False
    anchor: Anchor | None = None
    fixtures: tuple[Fixture, ...] = ()
    ceiling_height_m: float | None = None

    @classmethod
    def from_json(cls, text: str | bytes, limits: PlanLimits = DEFAULT_LIMITS) -> FloorPlan:
        """Parse the native JSON format.

        Raises:
            InvalidFloorPlanError: not JSON, or not a valid plan.
        """
        return cls.from_dict(read_json(text, limits.max_depth), limits)

    @classmethod
    def from_dict(cls, document: Any, limits: PlanLimits = DEFAULT_LIMITS) -> FloorPlan:
        """Validate a plan in the native format (docs/reference/plan-format.md); unknown keys are refused.

        Raises:
            InvalidFloorPlanError: the plan is invalid; the message names the room and the problem.
        """
        return cls(**read_plan(document, limits, None))

    @classmethod
    def from_stored(cls, text: str, warnings: Sequence[str] | None) -> FloorPlan:
        """Read a stored plan, which was valid when its `to_dict` was written as JSON, without size limits.

        Without the warnings of the first validation they are computed again, which is slow for large plans.

        Raises:
            InvalidFloorPlanError: `text` is not the JSON of a plan.
        """
        return cls(**read_plan(read_json(text, NO_LIMITS.max_depth), NO_LIMITS, warnings))

    def anchor_within(self, venue_anchor: Anchor | None) -> Anchor | None:
        """Return the plan's own anchor, else the venue's.

        Returns None without either, and for a plan too far from the venue's origin for the projection to hold.
        """
        if self.anchor is not None or venue_anchor is None:
            return self.anchor
        return venue_anchor if float(np.abs(self.bounds_m).max()) <= MAX_FROM_ORIGIN_M else None

    def to_dict(self) -> dict[str, Any]:
        """Return the plan in the native format; `from_dict` reads an equal plan from it."""
        document: dict[str, Any] = {"name": self.name}
        if self.states_camera_height:
            document["camera_height_m"] = self.camera_height_m
        if self.camera_height_std_m is not None:
            document["camera_height_std_m"] = self.camera_height_std_m
        if self.north is not None:
            # Rounding restores degrees that were converted to radians.
            document["north_deg"] = round(heading_to_degrees(self.north), 9) % 360.0
        if self.anchor is not None:
            document["anchor"] = anchor_document(self.anchor)
        if self.openings or self.opening_trust:
            document["opening_kinds"] = sorted(self.opening_kinds)
            doubted = {kind: trust for kind, trust in sorted(self.opening_trust.items()) if trust < 1.0}
            if doubted:
                document["opening_trust"] = doubted
            document["opening_tolerance_m"] = self.opening_tolerance_m
        if self.ceiling_height_m is not None:
            document["ceiling_height_m"] = self.ceiling_height_m
        document["rooms"] = [_room_document(room) for room in self.rooms]
        state_types(document["rooms"], self.rooms, self.fixtures)
        if self.openings:
            document["openings"] = [_opening_document(opening) for opening in self.openings]
        if self.fixtures:
            document["fixtures"] = [
                {"kind": fixture.kind, "outline": fixture.outline_m.tolist()} for fixture in self.fixtures
            ]
        return document

    @property
    def opening_kinds(self) -> frozenset[str]:
        """Kinds of openings that the plan shows completely."""
        return frozenset(kind for kind, trust in self.opening_trust.items() if trust == 1.0)

    @cached_property
    def class_trusts(self) -> tuple[Float[np.ndarray, "t c"], Int[np.ndarray, "r"]]:
        """The distinct trusts by opening class, walls first, and the number of each room's."""
        trusts = self.room_trust or (self.opening_trust,) * len(self.rooms)
        values = np.array([[trust.get(kind, 0.0) for kind in OPENING_CLASSES] for trust in trusts])
        distinct, number = np.unique(values, axis=0, return_inverse=True)
        return distinct, number.reshape(-1)

    @property
    def area_m2(self) -> float:
        """Sum of the rooms' floor areas."""
        return float(self.areas_m2.sum())

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """(x_min, y_min, x_max, y_max) over all rooms."""
        corners = np.concatenate([room.polygon_m for room in self.rooms])
        (x_min, y_min), (x_max, y_max) = corners.min(axis=0), corners.max(axis=0)
        return float(x_min), float(y_min), float(x_max), float(y_max)

    @cached_property
    def room_faces(self) -> tuple[tuple[OpeningFace, ...], ...]:
        """The opening faces of every room."""
        faces: list[list[OpeningFace]] = [[] for _ in self.rooms]
        for face in self.opening_faces:
            faces[face.room].append(face)
        return tuple(map(tuple, faces))

    @cached_property
    def wall_table(self) -> WallTable:
        """Walls and openings in one table without padding, for rendering many poses."""
        return WallTable.build(self.rooms, self.openings, self.opening_faces)

    @cached_property
    def walls_m(self) -> Float[np.ndarray, "rooms n 4"]:
        """Wall segments of every room, padded to one length by repeating each room's first wall.

        `render.profile` takes `plan.walls_m[room_index]`, the walls of each pose's room.
        """
        return frozen(self.room_walls(np.arange(len(self.rooms))))

    def room_walls(self, room_index: Int[np.ndarray, "k"]) -> Float[np.ndarray, "k n 4"]:
        """Return `walls_m[room_index]`, padded only to the largest number of walls in these rooms."""
        longest = max(len(self.rooms[index].walls_m) for index in room_index)
        return np.stack([pad_walls(self.rooms[index].walls_m, longest) for index in room_index])

    @cached_property
    def areas_m2(self) -> Float[np.ndarray, "rooms"]:
        """Floor area of every room."""
        return frozen(np.array([room.area_m2 for room in self.rooms]))

    @cached_property
    def ceiling_heights_m(self) -> Float[np.ndarray, "rooms"]:
        """Ceiling height of every room."""
        return frozen(np.array([room.ceiling_height_m for room in self.rooms]))

    @cached_property
    def wall_directions(self) -> Float[np.ndarray, "rooms 90"]:
        """Share of the length of each room's walls by direction: azimuths in degrees, modulo 90."""
        walls, shares = self.wall_table, np.zeros((len(self.rooms), _DIRECTIONS), np.float32)
        along_m = walls.end_m - walls.start_m
        degree = np.rint(np.degrees(np.arctan2(along_m[:, 0], along_m[:, 1]))).astype(np.intp) % _DIRECTIONS
        room = np.repeat(np.arange(len(shares)), np.diff(walls.first))
        np.add.at(shares, (room, degree), np.hypot(*along_m.T))
        return frozen(shares / shares.sum(axis=1, keepdims=True))

    @cached_property
    def fixtures_by_kind(self) -> Mapping[str, FixturePlaces]:
        """Places of the fixtures of each kind that the plan draws."""
        outlines: dict[str, list[np.ndarray]] = {}
        for fixture in self.fixtures:
            outlines.setdefault(fixture.kind, []).append(fixture.outline_m)
        places = {}
        for kind, outlines_m in outlines.items():
            low_m, high_m = (np.stack([edge(outline, axis=0) for outline in outlines_m]) for edge in (np.min, np.max))
            centre_m, width_m = (low_m + high_m) / 2.0, np.hypot(*(high_m - low_m).T)
            places[kind] = FixturePlaces(centre_m, width_m, self.room_index_at(centre_m))
        return places

    @cached_property
    def type_shares(self) -> Float[np.ndarray, "r t"]:
        """Share of each of `conventions.ROOM_TYPES` in every room, alike for a room's types."""
        share = np.zeros((len(self.rooms), len(ROOM_TYPES)))
        for row, room in zip(share, self.rooms, strict=True):
            types = room.types or ROOM_TYPES[:1]
            row[[ROOM_TYPES.index(kind) for kind in types]] = 1.0 / len(types)
        return share

    @cached_property
    def _room_tree(self) -> shapely.STRtree:
        return shapely.STRtree([room.shape for room in self.rooms])

    def room_index_at(self, position_m: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n"]:
        """Return the index of each position's room, -1 outside rooms and in holes; the first of overlapping rooms."""
        x, y = position_m[:, 0], position_m[:, 1]
        if len(self.rooms) > _FEW_ROOMS:
            point, room = self._room_tree.query(shapely.points(x, y), predicate="within")
            first = np.full(len(position_m), len(self.rooms))
            np.minimum.at(first, point, room)
            return np.where(first < len(self.rooms), first, -1)
        index = np.full(len(position_m), -1)
        for room_index in reversed(range(len(self.rooms))):
            index[shapely.contains_xy(self.rooms[room_index].shape, x, y)] = room_index
        return index


def _room_document(room: Room) -> dict[str, Any]:
    document: dict[str, Any] = {"id": room.id, "name": room.name}
    document |= type_fields(room.types)
    document["polygon"] = room.polygon_m.tolist()
    if room.holes_m:
        document["holes"] = [hole.tolist() for hole in room.holes_m]
    if len(room.inner_walls_m):
        document["walls"] = room.inner_walls_m.reshape(-1, 2, 2).tolist()
    if room.states_ceiling:
        document["ceiling_height_m"] = room.ceiling_height_m
    return document


def _opening_document(opening: Opening) -> dict[str, Any]:
    document: dict[str, Any] = {"kind": opening.kind, "line": opening.line_m.tolist()}
    optional = {
        "sill_m": opening.sill_m,
        "head_m": opening.head_m,
        "name": opening.name,
        "rooms": None if opening.rooms is None else list(opening.rooms),
    }
    return document | {key: value for key, value in optional.items() if value is not None}
