"""The walls of a plan, from which what a camera sees can be computed. Lengths in metres."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class OpeningPiece:
    """A piece of a wall that is an opening.

    Attributes:
        wall: index in the room's `walls_m`.
        start, end: shares of the wall, from its first end: 0 to 1.
        sill_m, head_m: heights of its edges over the floor; None where the plan does not say.
    """

    kind: str
    wall: int
    start: float
    end: float
    sill_m: float | None = None
    head_m: float | None = None


@dataclass(frozen=True)
class RoomLayout:
    """A room as a renderer sees it: `walls_m` are (x0, y0, x1, y1) each, the room to the left of it."""

    id: str
    name: str
    ceiling_height_m: float
    polygon: tuple[tuple[float, float], ...]
    holes: tuple[tuple[tuple[float, float], ...], ...]
    walls_m: tuple[tuple[float, float, float, float], ...]
    openings: tuple[OpeningPiece, ...]


@dataclass(frozen=True)
class Layout:
    """The walls of a plan's revision with the openings in them, room by room."""

    floorplan_id: str
    revision: str
    rooms: tuple[RoomLayout, ...]
