"""What every importer fills in: rooms and openings in metres, before they are a plan."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import shapely

from lalaloc_core.floorplan.earth import Anchor

OpeningKind = Literal["door", "window", "passage"]
Point = tuple[float, float]


@dataclass(frozen=True, eq=False)
class SketchedRoom:
    """A room; `shape` in metres, its holes are what is no floor."""

    shape: shapely.Polygon
    name: str | None = None
    type: str | None = None
    ceiling_height_m: float | None = None
    id: str | None = None


@dataclass(frozen=True)
class SketchedOpening:
    """A door, window or passage, along its wall; metres."""

    kind: OpeningKind
    start: Point
    end: Point
    name: str | None = None
    sill_m: float | None = None
    head_m: float | None = None

    @property
    def line(self) -> shapely.LineString:
        """The opening as a geometry."""
        return shapely.LineString([self.start, self.end])


@dataclass(frozen=True)
class Level:
    """A storey of a building."""

    name: str
    number: float | None = None
    elevation_m: float | None = None

    def answers_to(self, wanted: str) -> bool:
        """Whether somebody means this storey by a name or number."""
        wanted = wanted.strip().casefold()
        number = None if self.number is None else f"{self.number:g}"
        return wanted in (self.name.casefold(), number)


@dataclass
class Sketch:
    """Everything that was understood of one storey."""

    rooms: list[SketchedRoom] = field(default_factory=list)
    openings: list[SketchedOpening] = field(default_factory=list)
    # What stands in rooms and is no floor: cut out of the rooms that it lies in.
    obstacles: list[shapely.Polygon] = field(default_factory=list)
    # Free-standing walls.
    inner_walls: list[shapely.LineString] = field(default_factory=list)
    name: str | None = None
    north_deg: float | None = None
    level: Level | None = None
    anchor: Anchor | None = None
    # Kinds of openings that the source shows completely; None: those that occur.
    opening_kinds: tuple[str, ...] | None = None
