"""Sketch of a storey, filled in by every importer: rooms and openings in metres, before they become a plan."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeVar

import shapely
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.floorplan.plan_words import mentions_roof
from lalaloc_core.importers.common.import_options import ImportOptions

OpeningKind = Literal["door", "window", "passage"]
Point = tuple[float, float]
T = TypeVar("T")
# Heights of rooms that are believed (m). No camera stands in the lowest of them: `assemble` leaves these out.
ROOM_HEIGHT_M = (0.5, 20.0)
_MAX_NAMED_LEVELS = 12
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


@dataclass(frozen=True, eq=False)
class SketchedRoom:
    """Room with its outline and holes in metres."""

    shape: shapely.Polygon
    name: str | None = None
    types: tuple[str, ...] = ()
    ceiling_height_m: float | None = None


@dataclass(frozen=True)
class SketchedOpening:
    """Door, window or passage from `start` to `end` along its wall, in metres."""

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
class SketchedFixture:
    """Fixture with its outline seen from above, in metres; `kind` is one of `conventions.FIXTURE_KINDS`."""

    kind: str
    shape: shapely.Polygon
    layer: str = ""


@dataclass(frozen=True)
class Level:
    """Storey of a building."""

    name: str
    number: float | None = None
    elevation_m: float | None = None

    @property
    def title(self) -> str:
        """Name of the storey in a plan's name: "Level 1", also if the file has the number alone."""
        return f"Level {self.name}" if _NUMBER.fullmatch(self.name) else self.name

    def matches(self, wanted: str) -> bool:
        """Return whether the option `level` names this storey, by name or number."""
        wanted = wanted.strip().casefold()
        number = None if self.number is None else f"{self.number:g}"
        return wanted in (self.name.casefold(), number)


@dataclass
class Sketch:
    """Contents of one storey.

    Attributes:
        obstacles: areas without floor, such as columns; cut out of the rooms that they lie in.
        north_deg: direction of north, clockwise from +y.
        anchor: place of the origin on Earth.
        opening_kinds: kinds of openings that the source shows completely; None to estimate the trust in each kind.
        recall: share of drawn openings that the importer finds.
        kinds: kinds of openings that the source can hold.
        drawn: box around the drawn walls, if rooms were found between them.
        walls: drawn walls of a picture, which tell apart the storeys that are drawn beside each other.
        leaves_m: widths of the leaves of doors that swing in gaps of walls.
        wall_m: usual thickness of the walls, 0 if unknown.
    """

    rooms: list[SketchedRoom] = field(default_factory=list)
    openings: list[SketchedOpening] = field(default_factory=list)
    obstacles: list[shapely.Polygon] = field(default_factory=list)
    inner_walls: list[shapely.LineString] = field(default_factory=list)
    name: str | None = None
    north_deg: float | None = None
    level: Level | None = None
    anchor: Anchor | None = None
    opening_kinds: tuple[str, ...] | None = None
    recall: float = 0.95
    kinds: tuple[OpeningKind, ...] = ("door", "window", "passage")
    drawn: BaseGeometry | None = None
    walls: BaseGeometry | None = None
    fixtures: list[SketchedFixture] = field(default_factory=list)
    leaves_m: list[float] = field(default_factory=list)
    wall_m: float = 0.0


def choose_levels(levels: Mapping[str, tuple[Level, T]], options: ImportOptions) -> list[tuple[Level, T]]:
    """Return all storeys, lowest first, or only the one named by the option `level`."""
    ordered = sorted(levels.values(), key=lambda item: (_height(item[0]), _order(item[0].name)))
    if options.level is None:
        return ordered
    found = [item for item in ordered if item[0].matches(options.level)]
    if not found:
        known = ", ".join(f"'{level.name}'" for level, _ in ordered[:_MAX_NAMED_LEVELS])
        raise InvalidFloorPlanError(f"the file has no level '{options.level}'; set level to one of {known}")
    return found


def _order(name: str) -> tuple[bool, list[int]]:
    """Return a key by which "Level 2" is before "Level 10", and a roof last; others stay in the order of the file."""
    return mentions_roof(name), [int(number) for number in re.findall(r"\d{1,9}", name)]


def _height(level: Level) -> float:
    return next((height for height in (level.elevation_m, level.number) if height is not None), 0.0)
