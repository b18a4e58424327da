"""What an import has to say beside the plan: where everything came from, and what is likely wrong with it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

# Lists of a report end here, so that a file of nothing but mistakes gives no answer of its own size.
_MAX_LINES = 50


@dataclass(frozen=True)
class LayerUse:
    """What was made of the entities of one layer (group, class, entity type)."""

    layer: str
    entities: int
    used_as: str


@dataclass(frozen=True)
class ImportReport:
    """The account of one import.

    Attributes:
        format: of the file, as it was recognised by its content.
        metres_per_unit: length of a unit of the file's coordinates.
        scale_source: where that was read.
        is_draft: the plan was guessed from a picture: have somebody look at it before it is used.
        layers: what was used, by layer.
        notes: what was done.
        warnings: what is likely wrong.
        unsure: what was guessed, and how sure that is.
    """

    format: str
    metres_per_unit: float
    scale_source: str
    is_draft: bool = False
    layers: tuple[LayerUse, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    unsure: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON has it."""
        return {
            "format": self.format,
            "metres_per_unit": self.metres_per_unit,
            "scale_source": self.scale_source,
            "is_draft": self.is_draft,
            "layers": [{"layer": use.layer, "entities": use.entities, "used_as": use.used_as} for use in self.layers],
            "notes": list(self.notes),
            "warnings": list(self.warnings),
            "unsure": list(self.unsure),
        }


@dataclass
class ReportBuilder:
    """What a report is made of while a file is read."""

    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    unsure: list[str] = field(default_factory=list)
    uses: Counter[tuple[str, str]] = field(default_factory=Counter)

    def use(self, layer: str, used_as: str, entities: int = 1) -> None:
        """Count entities of a layer that were used as something, `ignored` included."""
        self.uses[layer or "(none)", used_as] += entities

    def build(self, format: str, metres_per_unit: float, scale_source: str, *, is_draft: bool = False) -> ImportReport:
        """The report."""
        layers = [LayerUse(layer, count, used_as) for (layer, used_as), count in sorted(self.uses.items())]
        return ImportReport(
            format=format,
            metres_per_unit=metres_per_unit,
            scale_source=scale_source,
            is_draft=is_draft,
            layers=tuple(layers[:_MAX_LINES]),
            notes=_bounded(self.notes),
            warnings=_bounded(self.warnings),
            unsure=_bounded(self.unsure),
        )


def _bounded(lines: list[str]) -> tuple[str, ...]:
    distinct = list(dict.fromkeys(lines))
    if len(distinct) <= _MAX_LINES:
        return tuple(distinct)
    return (*distinct[:_MAX_LINES], f"and {len(distinct) - _MAX_LINES} more")
