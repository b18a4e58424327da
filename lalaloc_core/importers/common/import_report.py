"""Report of an import: the use of every layer, the steps taken, and likely mistakes; and its trace, for a picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import shapely
from shapely.geometry.base import BaseGeometry

from lalaloc_core.floorplan.opening_trust import OpeningTrust
from lalaloc_core.floorplan.plan_words import Role

TracePart = Literal["line", "wall line", "door", "window", "passage", "other", "wall", "gap", "room", "no room"]
# Corners of an area in metres.
Outline = tuple[tuple[float, float], ...]
# Limits the size of the report on a file full of mistakes.
_MAX_LINES, _MAX_AREAS = 50, 20
# Further shapes of a trace are left out: a picture would not show them.
_MAX_SHAPES = 100_000
# Detail (m) that outlines in reports leave out.
_COARSE_M = 0.1


@dataclass(frozen=True)
class LayerUse:
    """Use of the entities of one layer, group, class or entity type."""

    layer: str
    entities: int
    used_as: str


@dataclass(frozen=True)
class ScaleClue:
    """Scale by one kind of parts of a drawing.

    Attributes:
        kind: "leaf" of a door, "wall", "tread" of stairs, "fixture", "area" or "dimension" that is written.
        count: number of parts.
        metres_per_unit: scale by these parts alone.
        std: standard deviation of that scale, as a share of it.
        is_used: the scale agrees with it.
    """

    kind: str
    count: int
    metres_per_unit: float
    std: float
    is_used: bool


@dataclass(frozen=True)
class ImportReport:
    """Report of one import.

    Attributes:
        format: format of the file, detected from its content.
        metres_per_unit: length of one unit of the file's coordinates.
        scale_source: source of that length.
        is_draft: the plan was inferred from a picture or from unnamed lines; review it before use.
        layers: use of the entities, by layer.
        unsure: guesses and their reasons.
        no_room: outlines (m) of the largest areas inside the drawn walls that became no room.
        opening_trust: trust in each kind of openings; empty if the file states it.
        turned_deg: clockwise rotation about its centre that straightened a picture.
        scale_std: standard deviation of an estimated scale, as a share of it; 0 if the scale is given.
        scale_clues: sizes of parts that an estimated scale was found by.
        scale_factor: factor for all lengths by which they agree with the areas or dimensions that are written; None
            without a contradiction.
        rejected_texts: texts that were read as areas or dimensions and not believed, with the reason.
        levels: levels that are drawn beside each other in the file, the largest first; empty for a single one.
    """

    format: str
    metres_per_unit: float
    scale_source: str
    is_draft: bool = False
    layers: tuple[LayerUse, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    unsure: tuple[str, ...] = ()
    no_room: tuple[Outline, ...] = ()
    opening_trust: tuple[OpeningTrust, ...] = ()
    turned_deg: float = 0.0
    scale_std: float = 0.0
    scale_clues: tuple[ScaleClue, ...] = ()
    scale_factor: float | None = None
    rejected_texts: tuple[str, ...] = ()
    levels: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain JSON data."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}


@dataclass
class ReportBuilder:
    """Fields of an `ImportReport` while a file is read; `no_room` are areas in metres, the largest first.

    `places` are those (m) of lines that are about one place, and so about one storey of several.
    """

    format: str = ""
    metres_per_unit: float = 1.0
    scale_source: str = ""
    is_draft: bool = False
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    unsure: list[str] = field(default_factory=list)
    uses: Counter[tuple[str, str]] = field(default_factory=Counter)
    no_room: list[shapely.Polygon] = field(default_factory=list)
    opening_trust: tuple[OpeningTrust, ...] = ()
    turned_deg: float = 0.0
    scale_std: float = 0.0
    scale_clues: tuple[ScaleClue, ...] = ()
    scale_factor: float | None = None
    rejected_texts: list[str] = field(default_factory=list)
    levels: tuple[str, ...] = ()
    places: dict[str, BaseGeometry] = field(default_factory=dict)

    def use(self, layer: str, used_as: str, entities: int = 1) -> None:
        """Count entities of a layer by their use; "ignored" is a use too."""
        self.uses[layer or "(none)", used_as] += entities

    def leave_out(self, layer: str, role: Role | None) -> None:
        """Count an entity that is left out, and warn of what is to be demolished."""
        self.use(layer, "ignored")
        if role == "demolished":
            self.warnings.append(
                f"layer '{layer[:50]}' shows what is to be demolished and was left out; rename it if it stays"
            )

    def build(self) -> ImportReport:
        """Return the finished report."""
        layers = [LayerUse(layer, count, used_as) for (layer, used_as), count in sorted(self.uses.items())]
        facts: dict[str, Any] = {name: value for name, value in vars(self).items() if name not in ("uses", "places")}
        facts |= {name: _limit_lines(facts[name]) for name in ("notes", "warnings", "unsure", "rejected_texts")}
        outlines = [area.exterior.simplify(_COARSE_M).coords[:-1] for area in self.no_room[:_MAX_AREAS]]
        facts["no_room"] = tuple(tuple((round(x, 2), round(y, 2)) for x, y in outline) for outline in outlines)
        return ImportReport(**facts, layers=tuple(layers[:_MAX_LINES]))


@dataclass
class Trace:
    """Shapes of a drawing in metres, y up, with what they were taken for."""

    shapes: list[tuple[TracePart, BaseGeometry]] = field(default_factory=list)

    def add(self, part: TracePart, shapes: Iterable[BaseGeometry]) -> None:
        """Add shapes of one kind."""
        for shape in shapes:
            if len(self.shapes) < _MAX_SHAPES and not shape.is_empty:
                self.shapes.append((part, shape))


def _limit_lines(lines: list[str]) -> tuple[str, ...]:
    distinct = list(dict.fromkeys(lines))
    more = [f"and {len(distinct) - _MAX_LINES} more"] if len(distinct) > _MAX_LINES else []
    return (*distinct[:_MAX_LINES], *more)
